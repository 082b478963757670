"""Executors of runs: this process, processes of this machine, or a Dask cluster."""

import importlib.util
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from typing import Any

from trustbo.errors import TrustboError, pip_install, require_choice
from trustbo.parallel import n_cores
from trustbo.study import workers
from trustbo.study.run import Run, execute

EXECUTORS = ("serial", "loky", "dask")
_N_POOLS = 3
"""Pools in a row in which no run ends, before a study gives up."""


def completed(
    runs: Sequence[Run], executor: object = None, *, n_workers: int | None = None
) -> Iterator[tuple[Run, dict[str, Any]]]:
    """Execute runs; yield each with its record, as they end.

    A run whose worker dies is repeated: by Dask on another worker, else in a new pool. "loky" and
    "dask" start `n_workers` processes, by default as many as there are cores. TrustboError: an
    unknown executor (see `run_study`), one that forks, or whose package is not installed.
    """
    if not runs:
        return
    caller = workers.this_process()
    if executor is None or executor == "serial":
        for run in runs:
            yield run, execute(run, caller)
        return
    pending, tries = list(runs), _N_POOLS
    while pending and tries:
        lost: list[Run] = []
        with _pool(executor, min(n_workers or n_cores(), len(pending))) as pool:
            for run, record in _through(pool, pending, caller):
                if record is None:
                    lost.append(run)
                else:
                    yield run, record
        if executor == "loky":  # a pool ends with a worker; another one may help
            tries = tries - 1 if len(lost) == len(pending) else _N_POOLS
        else:
            tries = 0
        pending = lost
    for run in pending:
        yield run, {"error": "lost: the workers of its pool died"}


def _through(
    pool: Executor, runs: Sequence[Run], caller: tuple[str, int]
) -> Iterator[tuple[Run, dict[str, Any] | None]]:
    """Each run with its record; None if the pool broke before."""
    futures: dict[Future[dict[str, Any]], Run] = {}
    broken: list[Run] = []
    try:
        for run in runs:
            try:
                futures[pool.submit(execute, run, caller)] = run
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
    if executor is None or hasattr(executor, "get_executor"):
        return
    if isinstance(executor, str):
        if "://" not in executor:
            require_choice('executor (or give an address, "tcp://...")', executor, EXECUTORS)
        package = executor if executor in ("serial", "loky") else "distributed"
        if package != "serial" and importlib.util.find_spec(package) is None:
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
        yield from _loky(n_workers)
    elif isinstance(executor, str):
        yield from _dask(executor, n_workers)
    elif hasattr(executor, "get_executor"):  # a distributed.Client
        yield _of_client(executor)
    else:
        yield executor


def _loky(n_workers: int) -> Iterator[Executor]:
    from loky import ProcessPoolExecutor as LokyExecutor

    pool = LokyExecutor(n_workers)
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=True, kill_workers=True)
        raise
    pool.shutdown(wait=True)


def _dask(address: str, n_workers: int) -> Iterator[Executor]:
    from dask.config import set as configured
    from distributed import Client, LocalCluster

    if address != "dask":
        with Client(address) as client:
            yield _of_client(client)
        return
    with (
        configured({"distributed.worker.profile.enabled": False}),  # it takes 5 %
        LocalCluster(
            n_workers=n_workers,
            threads_per_worker=1,
            processes=True,
            memory_limit=0,
            dashboard_address=None,  # pyright: ignore[reportArgumentType]
        ) as cluster,
        Client(cluster) as client,
    ):
        yield _of_client(client)


def _of_client(client: Any) -> Executor:
    threads = max(client.nthreads().values(), default=1)
    if threads > 1:
        warnings.warn(
            f"workers of the Dask cluster have up to {threads} threads, and would pin them all to "
            "one core; start one worker of one thread for each core.",
            stacklevel=2,
        )
    return client.get_executor(pure=False)
