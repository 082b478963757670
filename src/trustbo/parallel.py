"""Parallel work in threads, which use all cores because compiled code releases the GIL."""

import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import numpy as np
from joblib import cpu_count
from threadpoolctl import ThreadpoolController

_BLOCK = 64
"""Rows per call, few enough to fit in the caches."""


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


class _Limit:
    """Limit of one BLAS thread, shared by all threads of the process that are inside."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._n_inside = 0
        self._limiter: Any = None

    def enter(self) -> None:
        """Set the limit if no other thread is inside."""
        with self._lock:
            if self._n_inside == 0:
                controller = _controller(len(sys.modules))
                _take_control(controller)
                self._limiter = controller.limit(limits=1, user_api="blas")
            self._n_inside += 1

    def leave(self) -> None:
        """Restore the previous number of threads if no other thread is inside."""
        with self._lock:
            self._n_inside -= 1
            if self._n_inside == 0:
                controller = _controller(len(sys.modules))
                _take_control(controller)
                self._limiter.restore_original_limits()
                _take_control(controller)


_LIMIT = _Limit()


@lru_cache(1)
def _controller(n_modules: int) -> ThreadpoolController:
    """Find the BLAS libraries, which takes 3 ms, again only if modules were imported."""
    return ThreadpoolController()


def _take_control(controller: ThreadpoolController) -> None:
    """Let any thread change the limit; threadpoolctl 3.8 ignores all threads but the first."""
    for library in controller.lib_controllers:
        if hasattr(library, "clear_controlling_thread"):
            library.clear_controlling_thread(force=True)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread; with more, matrices of about 20 rows take 20 times as long.

    The limit applies to the whole process. If several threads are inside, the last one to leave
    restores the caller's setting.
    """
    _LIMIT.enter()
    try:
        yield
    finally:
        _LIMIT.leave()


@contextmanager
def computing() -> Iterator[None]:
    """Settings for numerical work: one BLAS thread, and small numbers may round to 0.

    All public functions that compute posteriors, predictions and plans are decorated with this
    function, so inner functions need no settings of their own. Underflow is harmless in weights and
    tails, but an error for users of `numpy.seterr(all="raise")`.
    """
    with one_blas_thread(), np.errstate(under="ignore"):
        yield
