"""Kernels of a scan over columns: quadratic forms of sums of columns.

Columns come in runs, and a candidate is the sum of a column and all later ones of its run, the
change "from mission j on" of a column for each mission. Sums are carried from the last column of a
run to its first, so that a candidate costs the entries of one column.
"""

import numba as nb
import numpy as np

_compiled = nb.njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})


@_compiled
def add_squares(out, T, row_of, start, slot, value, run):
    """Add |T' z|^2 of each candidate z to `out` (column,).

    T (row, factor) has a row for each slot of `row_of` (slot,), -1 for none; columns are sparse,
    compressed by column: start (column + 1,), slot and value (entry,). run (column,).
    """
    total, m = np.zeros(T.shape[1]), T.shape[1]
    for i in range(len(run) - 1, -1, -1):
        if i == len(run) - 1 or run[i] != run[i + 1]:
            total[:] = 0.0
        for entry in range(start[i], start[i + 1]):
            row = row_of[slot[entry]]
            if row >= 0:
                x = value[entry]
                for f in range(m):
                    total[f] += x * T[row, f]
        square = 0.0
        for f in range(m):
            square += total[f] * total[f]
        out[i] += square


@_compiled
def weigh_chains(out, product, S, kind, weight, residual, start, slot, value, run):
    """Set z'S z and z'residual of each candidate z, in `out` and `product` (column,).

    S (kind, bound, bound) is block diagonal by chain, of kind (chain,) and weight (chain,); slots
    of a column are in order, and no two columns of a run share a chain.
    """
    K = S.shape[1]
    square = linear = 0.0
    for i in range(len(run) - 1, -1, -1):
        if i == len(run) - 1 or run[i] != run[i + 1]:
            square = linear = 0.0
        for entry in range(start[i], start[i + 1]):
            chain, k = divmod(slot[entry], K)
            linear += value[entry] * residual[slot[entry]]
            row = value[entry] ** 2 * S[kind[chain], k, k]
            for other in range(entry + 1, start[i + 1]):
                if slot[other] // K != chain:
                    break
                row += 2.0 * value[entry] * value[other] * S[kind[chain], k, slot[other] % K]
            square += weight[chain] * row
        out[i], product[i] = square, linear
