"""Random numbers of sparse vectors, by which equal ones are merged."""

from typing import Any

import numpy as np


def fingerprints(compressed: Any) -> np.ndarray:
    """Numbers of the rows of a CSR matrix, or of the columns of a CSC one, that add up.

    Random numbers of indices and values, multiplied and added modulo 2^64: equal vectors have equal
    numbers, others with a chance of 2^-64; numbers of vectors without a common index add up to that
    of their sum.
    """
    rng = np.random.default_rng(0)
    _, value = np.unique(compressed.data, return_inverse=True)
    size = max(*compressed.shape, int(value.max(initial=0)) + 1)
    of_index, of_value = rng.integers(1, 2**64, (2, size), dtype=np.uint64)
    numbers = of_index[compressed.indices] * of_value[value.ravel()]
    up_to = np.append(np.uint64(0), np.cumsum(numbers, dtype=np.uint64))
    return np.diff(up_to[compressed.indptr])
