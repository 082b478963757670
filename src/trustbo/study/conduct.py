"""Running of a study, and its results."""

import warnings
from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any, Protocol

import pandas as pd
import xarray as xr
from tqdm import tqdm

from trustbo.errors import TrustboError
from trustbo.files import FilePath, interpreting
from trustbo.models.backend import VERSIONS
from trustbo.study.configuration import Study, read_study
from trustbo.study.executors import completed, require_executor
from trustbo.study.run import Run
from trustbo.study.store import Store
from trustbo.study.table import to_dataset


def run_study(
    study: Study | Mapping[str, Any] | FilePath,
    directory: FilePath,
    executor: Any = None,
    *,
    n_workers: int | None = None,
    progress: bool = True,
) -> xr.Dataset:
    """Run the runs of a study that have not ended yet.

    Args:
        study: Study, a mapping of its settings, or a YAML file of them.
        directory: Folder of the results, a file for each run. Called again, a study goes on where
            it stopped, and repeats runs that failed.
        executor: `None` or `"serial"`: this process, one run after the other. `"loky"` or `"dask"`:
            a process for each core, of a local cluster in the case of Dask. The address of a Dask
            scheduler (`"tcp://..."`), a `distributed.Client`, or any `concurrent.futures.Executor`
            that does not fork.
        n_workers: Number of processes that `"loky"` and `"dask"` start; by default one for each
            core.
        progress: Whether to show a progress bar.

    Returns:
        Results as `load_study` returns them. A warning names runs that failed; `failures` lists
        them.

    Raises:
        TrustboError: An impossible study or executor, before any work starts; or every run failed.
    """
    if isinstance(study, str | PathLike):
        study = read_study(study)
    return run_runs(Study.of(study), directory, executor, n_workers=n_workers, progress=progress)


class Runs(Protocol):
    """Table of runs, and its settings: a `Study`, or worlds."""

    def runs(self) -> list[Run]:
        """List the runs."""
        ...

    def settings(self) -> dict[str, Any]:
        """Settings as JSON can hold them."""
        ...


def run_runs(
    study: Runs, directory: FilePath, executor: Any, *, n_workers: int | None, progress: bool
) -> xr.Dataset:
    """Run the runs of a table that have not ended yet; see `run_study`."""
    require_executor(executor)
    store, runs = Store(directory), study.runs()
    pending = [run for run in runs if not store.has(run.key)]
    _rehearse(pending)
    store.write_study(study.settings(), runs)
    total, done = len(runs), len(runs) - len(pending)
    failed: list[tuple[Run, str]] = []
    with tqdm(total=total, initial=done, desc="runs", disable=not progress) as bar:
        for run, record in completed(pending, executor, n_workers=n_workers):
            _require_version(record)
            store.write(run, record)
            if "error" in record:
                failed.append((run, record["error"]))
                bar.set_postfix_str(f"{len(failed)} failed")
            bar.update()
    if failed:
        listed = "; ".join(f"{run}: {error}" for run, error in failed[:3])
        message = (
            f"{len(failed)} of {total} runs failed, and are run again at the next call: {listed}"
            f"{'; ...' if len(failed) > 3 else ''} (tracebacks: {store.folder / 'failed'})"
        )
        if len(failed) == total:
            raise TrustboError(message)
        warnings.warn(message, stacklevel=3)
    return load_study(directory)


def load_study(directory: FilePath) -> xr.Dataset:
    """Read the results of a study so far.

    Runs in the folder that are of another study, or another version of trustbo, are left out.

    Returns:
        Dataset with dims run and mission (1, 2, ...). For each mission: `value` (expected objective
        of its plan), `path` and `recommended` (row and col of each step, -1 after the goal),
        `regret` (true regret of the path recommended after it, in % of the contact that the best
        path keeps, see `Truth.regret`), `lost` (contact that it loses, in bounds), `p_arrive` (its
        probability to arrive), the same with `_followed` for the path it followed, `contact_rate`
        (mean), `status`, diagnostics of the posterior (see `models.diagnostics`), and seconds. For
        each run: `oracle` (contact lost on the best path), the three numbers with `_before` for the
        path recommended before the first mission, `seconds` and `seconds_cpu` (of its process). NaN
        where the truth is unknown, or where there is no such mission. Coordinates of run: its key,
        and its label along each axis of the study. Attributes: the study's number of runs,
        `n_runs`, and of failed ones, `n_failed`.

    Raises:
        TrustboError: The folder holds no study, or no run of it has ended.
    """
    store = Store(directory)
    table = store.table()
    records = {key: store.read(key) for key in table if store.has(key)}
    if not records:
        raise TrustboError(f"no run of the study in {str(store.folder)!r} has ended yet.")
    with interpreting(store.folder):
        dataset = to_dataset(records, table)
    n_failed = sum(store.failure(key) is not None for key in table)
    return dataset.assign_attrs(n_runs=len(table), n_failed=n_failed)


def failures(directory: FilePath) -> pd.DataFrame:
    """List the runs of a study that failed: labels, error and traceback, by key.

    Raises:
        TrustboError: The folder holds no study.
    """
    store = Store(directory)
    rows = {key: store.failure(key) for key in store.table()}
    return pd.DataFrame.from_dict(
        {
            key: row["labels"] | {"error": row["error"], "traceback": row.get("traceback", "")}
            for key, row in rows.items()
            if row is not None
        },
        orient="index",
    )


def _require_version(record: dict[str, Any]) -> None:
    """Make a record by another version of trustbo an error: the key has ours."""
    ours, theirs = VERSIONS["trustbo"], record.get("versions", {}).get("trustbo")
    if theirs not in (None, ours):
        record["error"] = f"the worker has trustbo {theirs}, and the study {ours}"


def _rehearse(runs: Sequence[Run]) -> None:
    """Set up a campaign of each kind, so that impossible ones are refused now, not in an hour."""
    seen = set()
    for run in runs:
        kind = repr({name: label for name, label in run.labels.items() if name != "seed"})
        if kind in seen:
            continue
        seen.add(kind)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                run.begin()
        except (TypeError, ValueError) as error:
            raise TrustboError(f"the run {run}: {error}") from error
