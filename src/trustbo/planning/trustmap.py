"""The trust map: with how much expected trust can each cell be reached?"""

import numpy as np

from trustbo.data import Cell
from trustbo.planning.course import Course
from trustbo.planning.dynamics import Dynamics
from trustbo.planning.engines import plan_compiled
from trustbo.planning.graph import MOVES, Steps
from trustbo.planning.objectives import Aim
from trustbo.planning.values import trust_along


def best_map(course: Course, moves: Dynamics) -> np.ndarray:
    """Largest expected trust of the team with which each cell can be reached.

    Over the paths to each cell with the fewest possible bounds, or, unless the course is of
    "shortest" paths, up to two more without turning straight back.

    Args:
        course: Where.
        moves: With a leading axis (draw,).

    Returns:
        Shape (draw, row, col); NaN where a cell cannot be reached.
    """
    slack = min(2, course.longest - course.shortest)
    fewest = np.where(course.bounds_from_start >= 0, course.bounds_from_start, np.inf)
    if moves.is_scalar:
        beta0, x0 = moves.transition[:, 0, 0], moves.start[:, 0]
        return best_trust(moves.drift[:, 0], beta0, x0, fewest, MOVES[course.connectivity], slack)
    values = np.full((len(moves.start), *fewest.shape), np.nan)
    for row, col in np.argwhere(np.isfinite(fewest)).tolist():
        values[:, row, col] = _trust_at(course, moves, (row, col), slack)
    return values


def robot_maps(course: Course, moves: Dynamics) -> np.ndarray:
    """The same for each robot by itself, shape (draw, robot, row, col).

    Args:
        course: Where.
        moves: With a leading axis (draw,), its states the robots.
    """
    n_robots = moves.start.shape[-1]
    alone = (moves.transition == moves.transition * np.eye(n_robots)).all()
    maps = []
    for i in range(n_robots):
        one = slice(i, i + 1)
        own = moves._replace(views=np.eye(n_robots)[one])
        if alone:
            own = Dynamics(
                moves.transition[:, one, one], moves.drift[:, one], moves.start[:, one], np.eye(1)
            )
        maps.append(best_map(course, own))
    return np.stack(maps, axis=1)


def _trust_at(course: Course, moves: Dynamics, cell: Cell, slack: int) -> np.ndarray:
    """Where one number does not say all about the team: the best path to each cell by itself."""
    if cell == course.start:
        return (moves.start @ moves.views.T).min(-1)
    kind = ("shortest", "shortest+1", "shortest+2")[slack]
    there = Course(course.workspace, course.start, cell, course.connectivity, kind, revisit=True)
    paths = plan_compiled(there, moves, Aim("terminal")).paths
    return np.array(
        [trust_along(moves.draw(d), there.cells(path))[-1] for d, path in enumerate(paths)]
    )


def best_trust(
    u: np.ndarray,
    beta0: np.ndarray,
    x0: np.ndarray,
    fewest: np.ndarray,
    moves: Steps,
    slack: int = 0,
) -> np.ndarray:
    """Largest expected trust with which each cell can be reached, without turning straight back.

    Dynamic programming over the bounds; the state is the cell and the move that led there. Where
    beta0 < 0 the most trust comes out of the least, so both are carried. Up to a slack of 2, a walk
    without U-turns enters no cell twice: a loop takes three bounds, more than there are to spare.

    Args:
        u: Drift of each cell, shape (draw, row, col).
        beta0: Autoregression, shape (draw,).
        x0: Expected trust at the start, shape (draw,).
        fewest: Fewest bounds from the start, shape (row, col); inf where there is no way.
        moves: Steps to the neighbouring cells.
        slack: How many bounds more than the fewest possible a path may take, 0 to 2.

    Returns:
        Shape (draw, row, col); NaN where a cell cannot be reached.
    """
    beta0 = beta0[:, None, None]
    start = fewest == 0
    best = np.where(start, x0[:, None, None], np.full(u.shape, -np.inf))
    # Most and least trust on arrival by each move; the start is arrived at by a move of its own.
    most = np.full((len(moves) + 1, *u.shape), -np.inf)
    most[-1] = best
    least = np.where(np.isfinite(most), most, np.inf)
    reverse = [moves.index((-down, -right)) for down, right in moves]
    last_layer = int(fewest[np.isfinite(fewest)].max()) + slack
    for k in range(1, last_layer + 1):
        new_most, new_least = np.full_like(most, -np.inf), np.full_like(least, np.inf)
        admissible = np.isfinite(fewest) & (fewest <= k) & ~start
        for m, move in enumerate(moves):
            onward = [d for d in range(len(moves) + 1) if d != reverse[m]]
            before = most[onward].max(0), least[onward].min(0)
            came = np.isfinite(before[0])
            ends = [beta0 * np.where(came, trust, 0.0) for trust in before]
            high = np.where(came, np.maximum(*ends), -np.inf)
            low = np.where(came, np.minimum(*ends), np.inf)
            new_most[m] = np.where(admissible, _shift(high, move, -np.inf) + u, -np.inf)
            new_least[m] = np.where(admissible, _shift(low, move, np.inf) + u, np.inf)
        most, least = new_most, new_least
        best = np.where(fewest + slack >= k, np.maximum(best, most.max(0)), best)
    return np.where(np.isfinite(best), best, np.nan)


def _shift(values: np.ndarray, move: tuple[int, int], fill: float) -> np.ndarray:
    """Each cell gets the value of the cell it is entered from by `move`."""
    rows, cols = values.shape[-2:]
    padded = np.pad(values, [(0, 0)] * (values.ndim - 2) + [(1, 1), (1, 1)], constant_values=fill)
    down, right = move
    return padded[..., 1 - down : 1 - down + rows, 1 - right : 1 - right + cols]
