"""Folder in which compiled code is stored, so that each machine compiles it only once.

Numba compiles kernels and JAX compiles programs at their first use, which takes up to a minute. The
environment variable `TRUSTBO_CACHE` moves the folder, or switches storage off if it is `off`.

Code of another processor or of another version of a library can crash. The checks of JAX have let
such code through (SIGILL in a home folder that two kinds of processor share, SIGSEGV after jaxlib
was downgraded: uwplasma/vmex#222). Therefore, each kind of processor and each set of versions has
its own subfolder, and code is never read from another one.
"""

import hashlib
import os
import platform
import shutil
import tempfile
import warnings
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import llvmlite.binding as llvm
from platformdirs import user_cache_path

VARIABLE = "TRUSTBO_CACHE"
"""Environment variable with the path of the folder, or `off`."""
_OFF = "off"
_FLAGS = "XLA_FLAGS", "NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES"
"""Environment variables that select the instructions of compiled code."""
_FREE = 200_000_000
"""Bytes that must be free on the disk; half-written files would have to be compiled each time."""


@cache
def folder_of(library: str, version: str) -> Path | None:
    """Return the folder for code that this version of a library compiles for this processor.

    The folder exists and can be written. Otherwise, or if storage is switched off, the result is
    None. A folder that cannot be used gives a warning, once per process.
    """
    chosen = os.environ.get(VARIABLE, "")
    if chosen == _OFF:
        return None

    root = Path(chosen).expanduser() if chosen else user_cache_path("trustbo")
    folder = root / f"{library}-{key_of(version, _processor())}"
    if problem := _problem_of(folder):
        warn_of_no_storage(root, problem)
        return None
    return folder


def key_of(version: str, processor: Mapping[str, str]) -> str:
    """Return the part of a folder's name that differs between processors and versions."""
    facts = {"version": version, **processor}
    text = "\n".join(f"{name}: {value}" for name, value in sorted(facts.items()))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _processor() -> dict[str, str]:
    """Return all that code depends on, besides the version of its compiler."""
    return {
        "system": platform.system(),
        "machine": platform.machine(),
        "python": platform.python_version(),
        "processor": llvm.get_host_cpu_name(),
        "features": llvm.get_host_cpu_features().flatten(),
        **{name: os.environ.get(name, "") for name in _FLAGS},
    }


def _problem_of(folder: Path) -> str:
    """Return why a folder cannot store code, or an empty string."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)  # others must not add code
        tempfile.TemporaryFile(dir=folder).close()
        free = shutil.disk_usage(folder).free
    except OSError as error:
        return error.strerror or str(error)
    # The text does not change with the free space, or processes would warn again and again.
    return "" if free >= _FREE else f"less than {_FREE / 1e6:.0f} MB are free"


@cache
def warn_of_no_storage(folder: Path, problem: str) -> None:
    """Warn that compiled code is not stored."""
    warnings.warn(
        f"compiled code cannot be stored in {folder} ({problem}), so each process compiles it in "
        f"about 30 s. Set {VARIABLE} to a folder that can be written, or to {_OFF!r}.",
        stacklevel=2,
    )
