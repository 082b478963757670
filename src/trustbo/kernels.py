"""Numba decorator of all kernels: loops that are compiled to machine code."""

import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

from numba import njit
from numba.core import event


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return the decorator of a kernel; `options` are further options of `numba.njit`.

    Kernels release the GIL, evaluate 1 / 0 as inf, and are cached on disk. Where no folder for the
    cache can be written, as in some containers, they are compiled in each process instead.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        made = njit(nogil=True, error_model="numpy", **options)(function)
        try:
            made.enable_caching()
        except RuntimeError:  # numba found no folder
            _warn_of_no_cache()
        return made

    return compiled


def part(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return the decorator of a function that only kernels call; see `kernel`.

    The function has no wrappers, which saves a quarter of the compile time. It is not cached on
    disk, but its compiled callers are.
    """
    no_wrappers: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return njit(nogil=True, error_model="numpy", **no_wrappers, **options)


@contextmanager
def stopwatch() -> Iterator[Callable[[], float]]:
    """Measure a block; the function that it yields returns the seconds so far.

    The time in which this thread compiles kernels, or reads them from the cache, does not count.
    """
    compiler = _CompilerTime()
    started = time.perf_counter()
    with event.install_listener("numba:compiler_lock", compiler):
        yield lambda: time.perf_counter() - started - compiler.seconds


class _CompilerTime(event.Listener):
    """Adds up the seconds in which the thread that made it holds numba's compiler, or waits for it.

    Numba's lock is re-entered for each kernel that a kernel calls; only the outermost entry counts.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self._thread = threading.get_ident()
        self._depth = 0
        self._entered = 0.0

    def on_start(self, event: event.Event) -> None:
        if threading.get_ident() != self._thread:
            return
        if self._depth == 0:
            self._entered = time.perf_counter()
        self._depth += 1

    def on_end(self, event: event.Event) -> None:
        if threading.get_ident() != self._thread:
            return
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.perf_counter() - self._entered


@cache
def _warn_of_no_cache() -> None:
    """Warn, once per process, that compiled kernels are not stored."""
    warnings.warn(
        "compiled kernels cannot be stored, because neither trustbo's folder nor your home folder "
        "can be written; they are compiled in each process, which takes about 30 s. Set "
        "NUMBA_CACHE_DIR to a folder that can be written.",
        stacklevel=2,
    )
