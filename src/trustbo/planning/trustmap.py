"""The trust map: with how much expected trust can each cell be reached?"""

from collections.abc import Mapping

import numpy as np

from trustbo.data import Cell
from trustbo.planning.graph import Steps


def best_trust(
    u: np.ndarray,
    beta0: float,
    x0: float,
    n_bounds: Mapping[Cell, int],
    moves: Steps,
    slack: int = 0,
) -> np.ndarray:
    """Largest expected trust with which each cell can be reached, without turning straight back.

    Dynamic programming over the bounds; the state is the cell and the move that led there. Where
    beta0 < 0 the most trust comes out of the least, so both are carried. Up to a slack of 2, a walk
    without U-turns enters no cell twice: a loop takes three bounds, more than there are to spare.

    Args:
        u: Drift of each cell, shape (*batch, row, col); each batch element is maximised by itself.
        beta0: Autoregression.
        x0: Expected trust at the start.
        n_bounds: Fewest bounds from the start, by cell; cells that are missing cannot be reached.
        moves: Steps to the neighbouring cells.
        slack: How many bounds more than the fewest possible a path may take, 0 to 2.

    Returns:
        Shape (*batch, row, col); NaN where a cell cannot be reached.
    """
    rows, cols = u.shape[-2:]
    batch = u.shape[:-2]
    fewest = np.full((rows, cols), np.inf)
    for cell, k in n_bounds.items():
        fewest[cell] = k
    start = fewest == 0
    best = np.where(start, x0, np.full(u.shape, -np.inf))
    # Most and least trust on arrival by each move; the start is arrived at by a move of its own.
    most = np.full((len(moves) + 1, *batch, rows, cols), -np.inf)
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
