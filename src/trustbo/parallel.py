"""Parallel work in threads, which use all cores because compiled code releases the GIL."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
from joblib import cpu_count
from threadpoolctl import threadpool_limits

_BLOCK = 64  # rows per call: few enough to fit in the caches


def plain(values: np.ndarray) -> np.ndarray:
    """Return a contiguous, writable array; a copy if necessary.

    Kernels are compiled for each memory layout of their arguments, which takes seconds, so all
    arguments have the same layout.
    """
    return np.require(values, requirements=["C", "W"])


def over_rows(work: Callable[[int, int], None], n_rows: int) -> None:
    """Call `work(first, last)` on blocks of rows, on all cores."""
    if n_rows <= _BLOCK:
        return work(0, n_rows)
    blocks = [(first, min(first + _BLOCK, n_rows)) for first in range(0, n_rows, _BLOCK)]
    work(0, 0)  # compiles in one thread
    with ThreadPoolExecutor(cpu_count()) as pool:
        list(pool.map(lambda block: work(*block), blocks))


def in_order[T, R](work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Yield results in the order of the items; at most one result per core is in memory."""
    pending: deque[Future[R]] = deque()
    with ThreadPoolExecutor(cpu_count()) as pool:
        for item in items:
            pending.append(pool.submit(work, item))
            del item
            if len(pending) >= cpu_count():
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread; with more, matrices of about 20 rows take 20 times as long.

    The function can also be used as a decorator. It takes 3 ms to find the BLAS libraries.
    """
    with threadpool_limits(limits=1, user_api="blas"):
        yield
