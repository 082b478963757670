"""Executors of runs: this process, processes of this machine, or a Dask cluster; their set-up."""

import ctypes
import importlib.util
import os
import socket
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import jax

from trustbo.errors import TrustboError, pip_install, require_choice
from trustbo.files import cache_folder
from trustbo.parallel import n_cores

EXECUTORS = ("serial", "loky", "dask")
_N_POOLS = 3
"""Pools in a row in which no run ends, before a study gives up."""
_LOST = {"error": "lost: the workers of its pool died"}
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h
_ready = False

type Work[R] = Callable[[R, tuple[str, int]], dict[str, Any]]
"""Record of a run; the second argument is the host and process of the caller."""


def completed[R](
    runs: Sequence[R], work: Work[R], executor: object = None, *, n_workers: int | None = None
) -> Iterator[tuple[R, dict[str, Any]]]:
    """Work on runs; yield each with its record, as they end.

    A run whose worker dies is repeated: by Dask on another worker, by "loky" in a new pool. "loky"
    and "dask" start `n_workers` processes, by default as many as there are cores. TrustboError: an
    unknown executor (see `run_study`), one that forks, or whose package is not installed.
    """
    caller = this_process()
    if executor is None or executor == "serial":
        yield from ((run, work(run, caller)) for run in runs)
        return
    pending, tries = list(runs), _N_POOLS if executor == "loky" else 1
    while pending and tries:
        lost: list[R] = []
        with _pool(executor, min(n_workers or n_cores(), len(pending))) as pool:
            for run, record in _through(pool, pending, work, caller):
                if record is None:
                    lost.append(run)
                else:
                    yield run, record
        # A pool of loky ends with a worker; another one may help.
        tries = _N_POOLS if executor == "loky" and len(lost) < len(pending) else tries - 1
        pending = lost
    yield from ((run, dict(_LOST)) for run in pending)


def _through[R](
    pool: Executor, runs: Sequence[R], work: Work[R], caller: tuple[str, int]
) -> Iterator[tuple[R, dict[str, Any] | None]]:
    """Each run with its record; None if the pool broke before."""
    futures: dict[Future[dict[str, Any]], R] = {}
    broken: list[R] = []
    try:
        for run in runs:
            try:
                futures[pool.submit(work, run, caller)] = run
            except BrokenExecutor:
                broken.append(run)
        for future in as_completed(list(futures)):
            try:
                record = future.result()
            except BrokenExecutor:
                record = None
            except Exception as error:  # of the network, or of a worker that Dask gave up on
                record = {"error": f"lost: {type(error).__name__}: {error}"}
            run = futures.pop(future)
            # While it is referenced, Dask keeps the result, and repeats the run if the worker dies.
            del future
            yield run, record
        yield from ((run, None) for run in broken)
    finally:
        for future in futures:
            future.cancel()


def require_executor(executor: object) -> None:
    """Refuse an executor that cannot run a study: unknown, not installed, or one that forks."""
    if executor is None or executor == "serial" or hasattr(executor, "get_executor"):
        return
    if isinstance(executor, str):
        if "://" not in executor:
            require_choice('executor (or give an address, "tcp://...")', executor, EXECUTORS)
        package = "loky" if executor == "loky" else "distributed"
        if importlib.util.find_spec(package) is None:
            raise TrustboError(
                f'executor {executor!r} needs {package}: {pip_install(package)}; or take "serial".'
            )
    elif isinstance(executor, ProcessPoolExecutor):
        context: Any = getattr(executor, "_mp_context", None)
        if context is not None and context.get_start_method() == "fork":
            raise TrustboError(
                "the executor forks, which JAX does not survive: make it with "
                'ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")), or use '
                'executor="loky".'
            )
    elif not callable(getattr(executor, "submit", None)):
        raise TrustboError(
            f"executor must be one of {', '.join(EXECUTORS)}, an address, an Executor, or a "
            f"distributed.Client; got {executor!r}."
        )


@contextmanager
def _pool(executor: Any, n_workers: int) -> Iterator[Executor]:
    """Open the executor; one that is made here ends here."""
    if executor == "loky":
        from loky import ProcessPoolExecutor as LokyExecutor

        pool = LokyExecutor(n_workers)
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=True, kill_workers=True)
            raise
        pool.shutdown(wait=True)
    elif isinstance(executor, str):
        from distributed import Client

        with ExitStack() as stack:
            address = _cluster(stack, n_workers) if executor == "dask" else executor
            yield _of_client(stack.enter_context(Client(address)))
    else:
        yield _of_client(executor) if hasattr(executor, "get_executor") else executor


def _cluster(stack: ExitStack, n_workers: int) -> Any:
    """Local Dask cluster of processes of one thread each."""
    from dask.config import set as configured
    from distributed import LocalCluster

    stack.enter_context(configured({"distributed.worker.profile.enabled": False}))  # it takes 5 %
    options: dict[str, Any] = {"processes": True, "memory_limit": 0, "dashboard_address": None}
    return stack.enter_context(LocalCluster(n_workers=n_workers, threads_per_worker=1, **options))


def _of_client(client: Any) -> Executor:
    threads = max(client.nthreads().values(), default=1)
    if threads > 1:
        warnings.warn(
            f"workers of the Dask cluster have up to {threads} threads, and would pin them all to "
            "one core; start one worker of one thread for each core.",
            stacklevel=2,
        )
    return client.get_executor(pure=False)


# --- set-up of a worker process: one core, freed memory kept, compiled code shared ---


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

    XLA's pool has as many threads as the process may use cores when it starts, for any of the usual
    flags; two workers of two threads each slow each other down. The core is taken by a lock on a
    file that stays open, which the system releases when the process ends, also if it is killed.
    None if all are taken, or where there is no affinity: nothing is pinned then.
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
    """Share compiled code with all workers of this user, on disk.

    The folder is in the user's cache, `$XDG_CACHE_HOME/trustbo/jax`, and not in the study's folder:
    anyone who can write to it can run code here. A folder that the user has set, e.g. by
    `JAX_COMPILATION_CACHE_DIR`, is used instead.
    """
    if jax.config.jax_compilation_cache_dir is None:  # pyright: ignore[reportAttributeAccessIssue]
        jax.config.update("jax_compilation_cache_dir", str(cache_folder("jax")))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
