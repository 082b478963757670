"""Trust map: the largest expected trust with which each cell can be reached.

Method: dynamic programming forwards (Bellman 1958) over the fewest bounds from the start, with the
extra bounds of a path as a second coordinate.

State: (cell, extra), where a path that enters the cell with bound k has k - fewest(cell) extra
bounds; the number of extra bounds never falls along a path. For each state the largest trust and
the move that gave it, the largest by any other move, and the same of minus the least trust.

Invariant: states are processed in the order of k, so those of all predecessors are final.

Exact because x -> beta0 x + u is monotone: the largest trust on entering c by a move comes out of
the largest in the cell left if beta0 >= 0, and out of the least if beta0 < 0. U-turns are
forbidden: a predecessor entered by the reverse move is excluded, which is one move, so the best and
the best by another are enough.

Up to two extra bounds, such paths enter no cell twice: a loop has at least three bounds, and
without it the path would be shorter than the fewest possible.
"""

import numpy as np
from numba import njit

from trustbo.parallel import over_rows, plain

_NO_MOVE, _NO_WAY = -1, 1 << 30
_compiled = njit(cache=True, nogil=True, error_model="numpy")


def best_trust(
    u: np.ndarray,
    beta0: np.ndarray,
    x0: np.ndarray,
    fewest: np.ndarray,
    steps: np.ndarray,
    extra: int = 0,
) -> np.ndarray:
    """Compute the largest expected trust with which each cell can be reached without U-turns.

    Drift u (draw, move, row, col), of one move where all into a cell are alike; beta0 and x0, trust
    at the start, (draw,); `fewest` bounds from the start (row, col), -1 where there is no way;
    moves `steps` (move, 2), each the reverse of the one as far from the other end; `extra` bounds
    beyond the fewest possible, 0 to 2. Returns (draw, row, col), NaN where a cell cannot be
    reached.
    """
    order = np.argsort(fewest, axis=None, kind="stable")
    order = order[np.searchsorted(fewest.ravel()[order], 0) :]
    first = np.searchsorted(fewest.ravel()[order], np.arange(fewest.max() + 2))
    best = np.full((len(u), fewest.size), np.nan)
    # A border of cells without a way: the kernel needs no test of rows and columns.
    bordered = np.pad(np.where(fewest < 0, _NO_WAY, fewest), 1, constant_values=_NO_WAY)
    width = bordered.shape[1]
    cells = order, (order // fewest.shape[1] + 1) * width + order % fewest.shape[1] + 1
    grid = bordered.ravel(), steps @ (width, 1), *cells, first

    drift, beta0, x0 = plain(u.reshape(*u.shape[:2], -1)), plain(beta0), plain(x0)

    def work(begin: int, end: int) -> None:
        some = slice(begin, end)
        _reach(drift[some], beta0[some], x0[some], best[some], *grid, extra)

    over_rows(work, len(u)) if len(u) > 1 else work(0, 1)
    return best.reshape(len(u), *fewest.shape)


@_compiled
def _reach(u, beta0, x0, best, fewest, offsets, order, place, first, extra):
    n_moves, by_move = len(offsets), 1 if u.shape[1] > 1 else 0
    # Of trust (0) and minus trust (1), per extra and place: the largest, its move, and the largest
    # by another move. Places are indices of cells in `fewest`, `order` has those in `u`.
    top = np.full((2, extra + 1, len(fewest)), -np.inf)
    second = np.full(top.shape, -np.inf)
    by = np.full(top.shape, _NO_MOVE, np.int8)
    for d in range(len(u)):
        best[d, order[0]] = top[0, 0, place[0]] = x0[d]
        top[1, 0, place[0]] = -x0[d]
        # The largest comes out of the largest if beta0 >= 0, else of minus the least, and so on.
        turns, size = beta0[d] < 0.0, abs(beta0[d])
        for k in range(1, len(first) - 1 + extra):
            for s in range(max(0, k - len(first) + 2), min(extra, k - 1) + 1):
                for n in range(first[k - s], first[k - s + 1]):
                    for side in range(2 if turns else 1):
                        source = 1 - side if turns else side
                        sign = -1.0 if side else 1.0
                        most, next_most, move = -np.inf, -np.inf, _NO_MOVE
                        for m in range(n_moves):
                            before = place[n] - offsets[m]
                            e = k - 1 - fewest[before]
                            # More extra bounds than here: the bound from there is closed.
                            if e < 0 or e > s:
                                continue
                            known = top[source, e, before]
                            if by[source, e, before] == n_moves - 1 - m:
                                known = second[source, e, before]
                            value = size * known + sign * u[d, m * by_move, order[n]]
                            if value > most:
                                most, next_most, move = value, most, m
                            elif value > next_most:
                                next_most = value
                        here = side, s, place[n]
                        top[here], second[here], by[here] = most, next_most, move
        for n in range(1, len(order)):
            best[d, order[n]] = top[0, :, place[n]].max()
