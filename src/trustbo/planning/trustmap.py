"""The trust map: with how much expected trust can each cell be reached?"""

import numpy as np

from trustbo.data import Cell
from trustbo.planning.arrivals import best_trust
from trustbo.planning.course import Course
from trustbo.planning.dynamics import Dynamics
from trustbo.planning.engines import plan_compiled
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
    fewest = course.bounds_from_start
    if moves.is_scalar:
        beta0, x0 = moves.transition[:, 0, 0], moves.start[:, 0]
        return best_trust(moves.drift[:, 0], beta0, x0, fewest, course.steps, slack)
    values = np.full((len(moves.start), *fewest.shape), np.nan)
    for row, col in np.argwhere(fewest >= 0).tolist():
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
