"""The most and the least trust with which each cell can be reached, compiled.

Bound k enters cell c with k - fewest(c) bounds more than it takes: its slack. A path has no less
slack the further it goes, so slacks up to the one that is allowed are all there is to keep of each
cell, and of the moves that led there the best two: the second serves whoever may not turn straight
back along the best.
"""

import numpy as np
from numba import njit

from trustbo.terrain.parallel import over_rows

_NO_MOVE = -1
_compiled = njit(cache=True, nogil=True, error_model="numpy")


def best_trust(
    u: np.ndarray,
    beta0: np.ndarray,
    x0: np.ndarray,
    fewest: np.ndarray,
    steps: np.ndarray,
    slack: int = 0,
) -> np.ndarray:
    """Largest expected trust with which each cell can be reached, without turning straight back.

    Where beta0 < 0 the most trust comes out of the least, so both are carried. Up to a slack of 2,
    a walk without U-turns enters no cell twice: a loop takes three bounds, more than there are to
    spare.

    Args:
        u: Drift of each cell, shape (draw, row, col).
        beta0: Autoregression, shape (draw,).
        x0: Expected trust at the start, shape (draw,).
        fewest: Fewest bounds from the start, shape (row, col); -1 where there is no way.
        steps: Moves to the neighbouring cells, shape (move, 2), each the reverse of the one as far
            from the other end.
        slack: How many bounds more than the fewest possible a path may take, 0 to 2.

    Returns:
        Shape (draw, row, col); NaN where a cell cannot be reached.
    """
    order = np.argsort(fewest, axis=None, kind="stable")
    order = order[np.searchsorted(fewest.ravel()[order], 0) :]
    first = np.searchsorted(fewest.ravel()[order], np.arange(fewest.max() + 2))
    best = np.full(u.shape, np.nan)

    # One layout, for the kernel to be compiled once.
    u, beta0, x0 = (np.ascontiguousarray(values) for values in (u, beta0, x0))

    def work(begin: int, end: int) -> None:
        some = slice(begin, end)
        own = u[some], beta0[some], x0[some], best[some]
        _reach(*own, fewest, steps, order, first, slack)

    over_rows(work, len(u)) if len(u) > 1 else work(0, 1)
    return best


@_compiled
def _reach(u, beta0, x0, best, fewest, steps, order, first, slack):
    rows, cols = fewest.shape
    # Of each cell and slack: the most trust and the move that gave it, the most by another; the
    # same of minus the least.
    top = np.empty((2, slack + 1, rows * cols))
    second = np.empty_like(top)
    by = np.empty(top.shape, np.int64)
    for d in range(len(u)):
        top[:], second[:], by[:] = -np.inf, -np.inf, _NO_MOVE
        start = order[0]
        top[0, 0, start], top[1, 0, start] = x0[d], -x0[d]
        best[d, start // cols, start % cols] = x0[d]
        for k in range(1, len(first) - 1 + slack):
            for s in range(min(slack, k - 1) + 1):
                if k - s > len(first) - 2:
                    continue
                for n in range(first[k - s], first[k - s + 1]):
                    _enter(u[d], beta0[d], fewest, steps, order[n], s, top, second, by)
        for n in range(1, len(order)):
            cell = order[n]
            most = -np.inf
            for s in range(slack + 1):
                most = max(most, top[0, s, cell])
            best[d, cell // cols, cell % cols] = most


@_compiled
def _enter(u, beta0, fewest, steps, cell, s, top, second, by):
    """Trust on entering a cell with a slack, by each move from where that can be done."""
    rows, cols = fewest.shape
    row, col = cell // cols, cell % cols
    n_moves = len(steps)
    for m in range(n_moves):
        i, j = row - steps[m, 0], col - steps[m, 1]
        if i < 0 or i >= rows or j < 0 or j >= cols or fewest[i, j] < 0:
            continue
        earlier = fewest[row, col] + s - 1 - fewest[i, j]
        if earlier < 0:
            continue
        before = i * cols + j
        back = n_moves - 1 - m
        most = _unless(back, earlier, before, top[0], second[0], by[0])
        least = _unless(back, earlier, before, top[1], second[1], by[1])
        if most == -np.inf:
            continue
        a, b = beta0 * most, -beta0 * least  # `least` is minus the least trust
        _keep(max(a, b) + u[row, col], m, s, cell, top[0], second[0], by[0])
        _keep(-min(a, b) - u[row, col], m, s, cell, top[1], second[1], by[1])


@_compiled
def _unless(back, s, cell, top, second, by):
    """The most with which a cell was reached, but by one move."""
    return second[s, cell] if by[s, cell] == back else top[s, cell]


@_compiled
def _keep(value, m, s, cell, top, second, by):
    if value > top[s, cell]:
        second[s, cell] = top[s, cell]
        top[s, cell], by[s, cell] = value, m
    elif value > second[s, cell]:
        second[s, cell] = value
