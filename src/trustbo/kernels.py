"""Numba decorator of all kernels: loops that are compiled to machine code."""

import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import njit


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


@cache
def _warn_of_no_cache() -> None:
    """Warn, once per process, that compiled kernels are not stored."""
    warnings.warn(
        "compiled kernels cannot be stored, because neither trustbo's folder nor your home folder "
        "can be written; they are compiled in each process, which takes about 30 s. Set "
        "NUMBA_CACHE_DIR to a folder that can be written.",
        stacklevel=2,
    )
