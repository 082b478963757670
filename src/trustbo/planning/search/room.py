"""Room for labels: arrays that grow before a label is written.

Kernels do not check indices, and a label beyond the end of its array overwrites other memory. Each
array of labels therefore passes `with_room` before it takes labels, however few or many.
"""

import numpy as np
from numba import njit

from trustbo.parallel import PART


@njit(nogil=True, error_model="numpy", **PART)
def with_room(rows, n) -> np.ndarray:
    """Array (row, column) for at least `n` rows: the same one, or one doubled as often as need be.

    Number by number: `np.concatenate` takes a second to compile.
    """
    size = len(rows)
    if size >= n:
        return rows
    while size < n:
        size *= 2
    grown = np.empty((size, rows.shape[1]), rows.dtype)
    for i in range(len(rows)):
        for j in range(rows.shape[1]):
            grown[i, j] = rows[i, j]
    return grown
