"""Files of campaigns and results, written atomically and read back."""

import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from filelock import FileLock, Timeout

from trustbo.campaign.folder import (
    FILES,
    HISTORY,
    MEASURED,
    MISSIONS,
    POSTERIOR,
    POSTERIORS,
    RESULT,
    STATE,
    TABLE,
    TICKS,
    WORKSPACE,
    require_free,
)
from trustbo.campaign.posteriors import Posterior, Posteriors
from trustbo.campaign.result import Result
from trustbo.campaign.state import CampaignState, Entry, Failure
from trustbo.data import Mission
from trustbo.errors import DamagedFileError, TrustboError
from trustbo.files import (
    FilePath,
    as_path,
    interpreting,
    naming_refusal,
    read_record,
    remove_leftovers,
    require_folder,
    to_json,
    write_text,
)  # fmt: skip
from trustbo.logs.netcdf import (
    missions_of_tree,
    read_missions,
    read_tree,
    write_missions,
    write_tree,
)  # fmt: skip
from trustbo.planning.plan import plan_from_record
from trustbo.spreadsheet import frame_as_csv
from trustbo.workspace import Workspace
from trustbo.workspace import netcdf as archive
from trustbo.workspace.moves import require_on_grid

_Extras = Sequence[Mapping[str, float]]


class Storage:
    """Files of a campaign, written as it goes and read back.

    `measured.nc` holds the missions as measured, before anything is learned from them. The rest is
    what `Result.save` writes, and last comes `campaign.json`, which holds the number of missions
    that are complete: a process that dies in between loses nothing.

    Attributes:
        path: Path of the folder.
    """

    def __init__(
        self, directory: FilePath, *, begun: bool = False, overwrite: bool = False
    ) -> None:
        """Lock the folder, until `release` or the end of the process.

        Args:
            directory: Path of the folder.
            begun: Whether it holds the campaign already.
            overwrite: Whether `write_whole` may replace another campaign or result in it.

        Raises:
            TrustboError: The folder holds no campaign and must, or one and must not; it is locked
                by another process or not writable; or its name belongs to a file.
        """
        self.path = as_path(directory)
        if begun and not (self.path / STATE).exists():
            raise TrustboError(
                f"{str(directory)!r} holds no campaign; give a folder that one was saved to."
            )
        if not (begun or overwrite):
            require_free(self.path)
        self._lock = _locked(self.path)
        self._overwrite = overwrite
        self._n_ticks = 0  # missions whose ticks are in separate files

    def release(self) -> None:
        """Release the lock of the folder."""
        self._lock.release()

    def write_whole(
        self, workspace: Workspace, state: CampaignState, result: Result | None
    ) -> None:
        """Write a whole campaign; with `overwrite`, another one is removed first."""
        if self._overwrite:
            _clear(self.path, state.posteriors.stored)
        self._overwrite, self._n_ticks = False, 0
        write_tree(self.path / WORKSPACE, archive.workspace_to_tree(workspace))
        if state.entries:
            self.write_measured(state.measured, [entry.extra for entry in state.entries])
        self.write(state, result, whole=True)

    def write_measured(self, missions: Sequence[Mission], extras: _Extras) -> None:
        """Write missions as measured, the new one included, and their extra numbers."""
        since, self._n_ticks = min(self._n_ticks, len(missions) - 1), len(missions)
        notes = {"extra": json.dumps(list(extras))}
        write_missions(self.path / MEASURED, missions, since=since, notes=notes)

    def write(
        self,
        state: CampaignState,
        result: Result | None,
        *,
        whole: bool = False,
        ended: bool = False,
    ) -> None:
        """Write the result and then the state.

        By default only what the last mission added to the result is written. Without a `result`,
        that in the folder stays. With `ended`, `posterior.nc` with all groups is written too.
        """
        if result is not None:
            _write_result(result, self.path, whole=whole)
            if ended and result.has_posterior:
                write_tree(self.path / POSTERIOR, result.posterior)
            else:
                (self.path / POSTERIOR).unlink(missing_ok=True)  # of the missions before
        write_text(self.path / STATE, to_json(state.to_record()))

    def read(self) -> tuple[CampaignState, Workspace, list[tuple[Mission, dict[str, float]]]]:
        """Read the state, the workspace, and missions that the state does not count yet.

        Those have their extra numbers with them. DamagedFileError: a file is missing or damaged.
        """
        record, file = read_record(self.path / STATE), self.path / MEASURED
        measured: list[Mission] = []
        extras: list[dict[str, float]] = []
        with interpreting(self.path / STATE):
            n = int(record["n_missions"])
        if n or file.exists():
            tree = read_tree(file)
            measured = missions_of_tree(tree, file)
            with interpreting(file):
                extras = json.loads(tree["missions"].attrs["extra"])
        if len(measured) < n:
            raise DamagedFileError(f"{str(file)!r} holds {len(measured)} missions of {n}.")
        stored = _read_missions(self.path / STATE, record) if n else None
        workspace = read_workspace(self.path)
        self._n_ticks = len(measured) if (self.path / TICKS).exists() else 0
        entries: list[Entry] = []
        with interpreting(self.path / STATE):
            if stored is not None:
                filled, posteriors, history = stored
                plans = [plan_from_record(plan, workspace) for plan in record["plans"]]
                maps = [history["trust_map"].isel(iteration=i, drop=True) for i in range(n)]
                columns = filled, measured[:n], plans, maps, record["rows"], posteriors.stored
                entries = [Entry(*fields) for fields in zip(*columns, extras[:n], strict=True)]
            state = CampaignState.from_record(record, entries, workspace)
        return state, workspace, list(zip(measured[n:], extras[n:], strict=True))


def _locked(directory: FilePath) -> FileLock:
    """Lock a folder, made if need be; TrustboError if another process has locked it."""
    folder = require_folder(directory)
    lock = FileLock(folder / ".trustbo.lock", timeout=0)
    with naming_refusal(folder):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire()
        except Timeout:
            raise TrustboError(
                f"another campaign is at work in {str(folder)!r}; close it first, or choose "
                "another folder."
            ) from None
        for room in (folder, folder / POSTERIORS, folder / TICKS):
            remove_leftovers(room)
    return lock


def _clear(folder: Path, posteriors: Iterable[Posterior | None]) -> None:
    """Remove a campaign from a folder; `posteriors` to be written may be among its files."""
    for posterior in posteriors:
        if posterior is not None:
            posterior()  # into memory
    with naming_refusal(folder):
        for name in FILES:
            (folder / name).unlink(missing_ok=True)
        for room in (POSTERIORS, TICKS):
            if (folder / room).is_dir():
                shutil.rmtree(folder / room)


def save_result(result: Result, directory: FilePath, *, overwrite: bool = False) -> None:
    """Write a result to a folder, see `Result.save`."""
    folder = require_folder(directory)
    if not overwrite:
        require_free(folder)
    lock = _locked(folder)
    try:
        if overwrite:
            _clear(folder, Posteriors.from_trees(result.posteriors).stored)
        write_tree(folder / WORKSPACE, archive.workspace_to_tree(result.workspace))
        if result.has_posterior:
            write_tree(folder / POSTERIOR, result.posterior)
        _write_result(result, folder, whole=True)
    finally:
        lock.release()


def load_result(directory: FilePath) -> Result:
    """Read a result that `Result.save` wrote.

    Args:
        directory: Folder that it was written to.

    Raises:
        TrustboError: The folder holds no result.
        DamagedFileError: A file is missing or damaged.
    """
    folder = as_path(directory)
    if not (folder / RESULT).exists():
        raise TrustboError(f"{str(directory)!r} holds no result; give a folder written by save().")
    record = read_record(folder / RESULT)
    # A run killed while it saved may have left one mission more than the record counts.
    with interpreting(folder / RESULT):
        settings = dict(record["settings"])
    missions, posteriors, history = _read_missions(folder / RESULT, record)
    workspace = read_workspace(folder)
    with interpreting(folder / HISTORY):
        trust_map = history["final_trust_map"].rename("trust")
        history = history.drop_vars("final_trust_map")
    with interpreting(folder / RESULT):
        trust = np.array(record["trust"], dtype=float)
        path = require_on_grid(record["path"], workspace.grid.shape)
        if trust.shape != (len(path) - 1, workspace.awareness.sizes["robot"]):
            raise ValueError(f"trust of shape {trust.shape} along {len(path)} cells")
        failures = tuple(Failure.restore(failure) for failure in record["failures"])
        value, reason = float(record["value"]), str(record["stop_reason"])
    return Result(
        workspace, missions, posteriors, list(path), trust, value, trust_map, history, settings,
        reason, failures,
    )  # fmt: skip


def read_workspace(folder: Path) -> Workspace:
    """Read the workspace of a campaign or result; DamagedFileError if it is missing or damaged."""
    tree = read_tree(folder / WORKSPACE)
    with interpreting(folder / WORKSPACE):
        return archive.workspace_from_tree(tree)


def _write_result(result: Result, folder: Path, *, whole: bool) -> None:
    """Write all but the workspace of a result.

    Not `whole`, only the last mission is written, to a folder that has all before it: earlier
    posteriors never change.
    """
    stored = Posteriors.from_trees(result.posteriors).stored
    files = list({posterior.name: posterior for posterior in stored if posterior}.values())
    for posterior in files if whole else files[-2:]:  # the last but one may have shrunk
        file = _posterior_file(folder, posterior.name)
        if whole or posterior.file != file:
            write_tree(file, posterior())
            posterior.file = file
    since = 0 if whole else len(result.missions)  # whose ticks are there
    write_missions(folder / MISSIONS, result.missions, since=since)
    history = result.history.assign(final_trust_map=result.trust_map)
    write_tree(folder / HISTORY, xr.DataTree(history))
    write_text(folder / TABLE, frame_as_csv(result.table()))
    # Written last: its presence means that the rest is complete.
    write_text(folder / RESULT, to_json(_record_of(result)))


def _posterior_file(folder: Path, name: str) -> Path:
    return folder / POSTERIORS / f"{name}.nc"


def _record_of(result: Result) -> dict[str, Any]:
    """Record of everything that no other file holds."""
    return {
        "n_missions": len(result.missions),
        "path": result.path,
        "trust": result.trust.tolist(),
        "value": result.value,
        "settings": result.settings,
        "stop_reason": result.stop_reason,
        "posteriors": Posteriors.from_trees(result.posteriors).names,
        "failures": result.failures,
    }


def _read_missions(
    file: Path, record: dict[str, Any]
) -> tuple[list[Mission], Posteriors, xr.Dataset]:
    """Read the missions that the record of a file counts, their posteriors and the history."""
    folder = file.parent
    with interpreting(file):
        n = int(record["n_missions"])
        order = [None if name is None else str(name) for name in record["posteriors"]]
    posteriors: dict[str | None, Posterior] = {}
    for name in filter(None, order):
        stored = _posterior_file(folder, name)
        if not stored.exists():
            raise DamagedFileError(f"{str(stored)!r} is missing.")
        posteriors[name] = posteriors.get(name) or Posterior(name, file=stored)
    history, missions = read_tree(folder / HISTORY).to_dataset(), folder / MISSIONS
    with interpreting(folder / HISTORY):
        history = history.isel(iteration=slice(n))
        if (rows := history.sizes["iteration"]) != n:
            raise ValueError(f"{rows} missions of {n}")
    filled = read_missions(missions)[:n]
    if len(filled) != n:
        raise DamagedFileError(f"{str(missions)!r} holds {len(filled)} missions of {n}.")
    return filled, Posteriors(posteriors.get(name) for name in order), history
