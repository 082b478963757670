"""Set-up of a worker process: one core, freed memory kept, compiled code shared."""

import ctypes
import os
import socket
import tempfile
from contextlib import suppress
from pathlib import Path

import jax

from trustbo.files import cache_folder

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h
_ready = False


def this_process() -> tuple[str, int]:
    """Host and process number."""
    return socket.gethostname(), os.getpid()


def prepare(caller: tuple[str, int]) -> None:
    """Set this process up as a worker, once, before JAX starts; unless it is the caller itself."""
    global _ready
    if _ready or this_process() == caller:
        return
    _ready = True
    pin_to_core()
    keep_freed_memory()
    keep_compiled_code()


def pin_to_core() -> int | None:
    """Pin this process to a core that no other worker on this machine has taken, and return it.

    XLA's pool has as many threads as the process may use cores when it starts, whatever the usual
    flags say; two workers of two threads each slow each other down. The core is taken by a lock on
    a file that stays open, which the system releases when the process ends, however it ends. None
    if all are taken, or where there is no affinity: nothing is pinned then.
    """
    if not hasattr(os, "sched_setaffinity"):
        return None
    import fcntl  # where there is affinity, there is this

    for core in sorted(os.sched_getaffinity(0)):
        name = f"trustbo-{os.getuid()}-core-{core}.lock"
        try:
            file = os.open(Path(tempfile.gettempdir()) / name, os.O_RDWR | os.O_CREAT, 0o600)
        except OSError:
            continue
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(file)
            continue
        # Each thread has its own affinity, and new threads inherit it.
        for thread in os.listdir("/proc/self/task"):
            os.sched_setaffinity(int(thread), {core})
        return core
    return None


def keep_freed_memory() -> None:
    """Let glibc keep freed memory, instead of asking the system for it again and again.

    Dask's nanny sets MALLOC_TRIM_THRESHOLD_ to 64 KiB for its workers, with which a fit takes a
    third longer.
    """
    with suppress(OSError, AttributeError):  # without glibc
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_MMAP_THRESHOLD, 32 << 20)
        mallopt(_M_TRIM_THRESHOLD, 256 << 20)


def keep_compiled_code() -> None:
    """Share compiled code with the workers before and beside this one, on disk.

    The folder is in the user's cache, `$XDG_CACHE_HOME/trustbo/jax`, and not in the study's folder:
    anyone who can write to it can run code here. A folder that the user has set, e.g. by
    `JAX_COMPILATION_CACHE_DIR`, is used instead.
    """
    if jax.config.jax_compilation_cache_dir is None:  # pyright: ignore[reportAttributeAccessIssue]
        jax.config.update("jax_compilation_cache_dir", str(cache_folder("jax")))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
