"""Numba decorator of all kernels: loops that are compiled to machine code."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba import njit
from numba.core import event

from trustbo.compiled import folder_of, warn_of_no_storage
from trustbo.display import say_once

_CONFIG: Any = numba.config  # pyright: ignore[reportPrivateImportUsage]
_VERSION = f"numba {numba.__version__}, llvmlite {llvmlite.__version__}, {version('trustbo')}"
"""Numba checks the sources of a kernel, but not of the kernels that it calls."""


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return the decorator of a kernel; `options` are further options of `numba.njit`.

    Kernels release the GIL, evaluate 1 / 0 as inf, and are stored on disk; see `compiled`.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        made = njit(nogil=True, error_model="numpy", **options)(function)
        if not _CONFIG.DISABLE_JIT:  # with NUMBA_DISABLE_JIT=1, Python runs the function, slowly
            _store(made)
        return made

    return compiled


def part(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return the decorator of a function that only kernels call; see `kernel`.

    The function has no wrappers, which saves a quarter of the compile time. It is not cached on
    disk, but its compiled callers are.
    """
    no_wrappers: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return njit(nogil=True, error_model="numpy", **no_wrappers, **options)


def _store(made: Any) -> None:
    """Let numba store a kernel in the folder of compiled code, or in the user's NUMBA_CACHE_DIR."""
    chosen = _CONFIG.CACHE_DIR
    folder = Path(chosen) if chosen else folder_of("numba", _VERSION)
    if folder is None:
        return

    # Numba reads the setting here, and only here. Kernels of other packages keep their folder.
    _CONFIG.CACHE_DIR = str(folder)
    try:
        made.enable_caching()
    except RuntimeError:  # numba found no folder that can be written
        warn_of_no_storage(folder, "numba cannot write there")
    finally:
        _CONFIG.CACHE_DIR = chosen


class _Announcement(event.Listener):
    """Announces the first compilation of a kernel of each subpackage."""

    def on_start(self, event: event.Event) -> None:
        details: Any = event.data
        function = details["dispatcher"].py_func
        package, _, module = str(function.__module__).partition(".")  # None in another namespace
        if package == "trustbo":
            room = module.partition(".")[0]
            say_once(f"First use: compiling kernels of trustbo.{room} (stored for later).")

    def on_end(self, event: event.Event) -> None:
        pass


event.register("numba:compile", _Announcement())


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
