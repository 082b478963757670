"""Files of campaigns and results, written atomically with checksums, and read back."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from trustbo.campaign.damage import MISSIONS_AS_TOLD, naming_what_is_left, read_fields
from trustbo.campaign.posteriors import Posterior, Posteriors
from trustbo.campaign.replacing import (
    BELIEVED,
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
    current,
    finish_replacing,
    hold,
    replacing,
    require_ours,
    warn_of_others,
)  # fmt: skip
from trustbo.campaign.result import Result
from trustbo.campaign.state import CampaignState, Entry, Failure
from trustbo.data import Mission
from trustbo.errors import DamagedFileError, TrustboError
from trustbo.files import (
    FilePath,
    as_path,
    interpreting,
    remove_checked,
    require_folder,
    to_json,
    write_checked,
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

    def __init__(self, directory: FilePath, *, begun: bool | None = None) -> None:
        """Lock the folder, until `release` or the end of the process.

        Args:
            directory: Path of the folder.
            begun: Whether it must hold a campaign already, or must not; None for either.

        Raises:
            TrustboError: The folder holds no campaign and must, or one and must not; it is locked
                by another process or not writable; or its name belongs to a file.
        """
        self.path = as_path(directory)
        if begun and not self._is_used:
            measured = self.path / MEASURED
            reason = f"{str(directory)!r} holds no campaign;"
            if measured.exists():
                remedy = MISSIONS_AS_TOLD.format(str(measured))
                raise DamagedFileError(f"{reason} {STATE!r} is missing. {remedy}")
            raise TrustboError(f"{reason} give a folder that one was saved to.")
        remedy = " tb.load_result reads one that may not." if begun else ""
        self._lock = hold(directory, remedy)
        self._target = self.path  # or the folder that its successor is being written to
        self._n_ticks = 0  # missions whose ticks are in separate files
        if begun is False and self._is_used:
            self.release()
            raise TrustboError(
                f"{str(self.path)!r} holds a campaign already: go on with it by Campaign.load, or "
                "choose another folder."
            )

    @property
    def _is_used(self) -> bool:
        return (current(self.path) / STATE).exists()

    def release(self) -> None:
        """Release the lock of the folder."""
        self._lock.release()

    def replace(self, workspace: Workspace, state: CampaignState, result: Result | None) -> None:
        """Write a whole campaign, which then replaces the content of the folder at once.

        TrustboError: a file of another program would be replaced, see `require_ours`.
        """
        require_ours(self.path)
        warn_of_others(self.path)
        n_ticks, self._n_ticks = self._n_ticks, 0
        try:
            with replacing(self.path) as self._target:
                write_tree(self._target / WORKSPACE, archive.workspace_to_tree(workspace))
                if state.entries:
                    self.write_measured(state.measured, [entry.extra for entry in state.entries])
                self.write(state, result, whole=True)
                n_ticks = self._n_ticks
        finally:
            self._target, self._n_ticks = self.path, n_ticks
        if result is not None:
            _mark_stored(result, self.path)

    def write_measured(self, missions: Sequence[Mission], extras: _Extras) -> None:
        """Write missions as measured, the new one included, and their extra numbers."""
        finish_replacing(self.path)
        since, self._n_ticks = min(self._n_ticks, len(missions) - 1), len(missions)
        notes = {"extra": json.dumps(list(extras))}
        write_missions(self._target / MEASURED, missions, since=since, notes=notes)

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
        finish_replacing(self.path)
        if result is not None:
            _write_result(result, self._target, whole=whole, home=self.path)
            if ended and result.has_posterior:
                write_tree(self._target / POSTERIOR, result.posterior)
            elif not whole:
                remove_checked(self._target / POSTERIOR)  # of the missions before
        write_checked(self._target / STATE, to_json(state.to_record()).encode())

    def read(self) -> tuple[CampaignState, Workspace, list[tuple[Mission, dict[str, float]]]]:
        """Read the state, the workspace, and missions that the state does not count yet.

        Those have their extra numbers with them. DamagedFileError: a file is missing or damaged;
        the message names what can be read.
        """
        measured: list[Mission] = []
        extras: list[dict[str, float]] = []
        file = self.path / MEASURED
        with naming_what_is_left(self.path):
            record = read_fields(self.path / STATE)
            n = record["n_missions"]
            if n or file.exists():
                tree = read_tree(file)
                measured = missions_of_tree(tree, file)
                with interpreting(file):
                    extras = json.loads(tree["missions"].attrs["extra"])
                    if len(extras) != len(measured):
                        raise ValueError(f"{len(extras)} extras of {len(measured)} missions")
            if len(measured) < n:
                raise DamagedFileError(f"{str(file)!r} holds {len(measured)} missions of {n}.")
            stored = _read_missions(self.path, record) if n else None
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


def save_result(result: Result, directory: FilePath) -> None:
    """Write a result to a folder, see `Result.save`."""
    folder = require_folder(directory)
    present = current(folder)
    if (present / STATE).exists():
        if not _is_in(result, present):
            raise TrustboError(
                f"{str(folder)!r} holds a campaign, with missions as they were told, which a "
                "result does not have; give another folder."
            )
        whole = present / POSTERIOR
        if result.has_posterior and not whole.exists():  # written when a campaign ends
            write_tree(whole, result.posterior)
        return
    lock = hold(folder)
    try:
        with replacing(folder) as new:
            write_tree(new / WORKSPACE, archive.workspace_to_tree(result.workspace))
            _write_result(result, new, whole=True, home=folder)
            if result.has_posterior:
                write_tree(new / POSTERIOR, result.posterior)
    finally:
        lock.release()
    _mark_stored(result, folder)


def load_result(directory: FilePath) -> Result:
    """Read a result that `Result.save` wrote.

    Args:
        directory: Folder that it was written to.

    Raises:
        TrustboError: The folder holds no result.
        DamagedFileError: A file is missing or damaged; the message names what can be read.
    """
    folder = current(as_path(directory))
    if not (folder / RESULT).exists():
        raise TrustboError(f"{str(directory)!r} holds no result; give a folder written by save().")
    with naming_what_is_left(folder):
        record = read_fields(folder / RESULT)
        # A run killed while it saved may have left one mission more than the record counts.
        missions, posteriors, history = _read_missions(folder, record)
        workspace, believed = read_workspace(folder), None
        if record["settings"].get("awareness") == "belief":
            believed = read_tree(folder / BELIEVED).to_dataset()
        with interpreting(folder / HISTORY):
            trust_map = history["final_trust_map"].rename("trust")
            history = history.drop_vars("final_trust_map")
        with interpreting(folder / RESULT):
            trust = np.array(record["trust"], dtype=float)
            path = require_on_grid(record["path"], workspace.grid.shape)
            if trust.shape != (len(path) - 1, workspace.awareness.sizes["robot"]):
                raise ValueError(f"trust of shape {trust.shape} along {len(path)} cells")
            failures = tuple(Failure.restore(failure) for failure in record["failures"])
        return Result(
            workspace, missions, posteriors, list(path), trust, record["value"], trust_map,
            history, record["settings"], record["stop_reason"], believed, failures,
        )  # fmt: skip


def read_workspace(folder: Path) -> Workspace:
    """Read the workspace of a campaign or result; DamagedFileError if it is missing or damaged."""
    tree = read_tree(folder / WORKSPACE)
    with interpreting(folder / WORKSPACE):
        return archive.workspace_from_tree(tree)


def _write_result(result: Result, folder: Path, *, whole: bool, home: Path) -> None:
    """Write all but the workspace of a result.

    Not `whole`, only the last mission is written, to a folder that has all before it: earlier
    posteriors never change. The files will be in `home`; where that is not the folder, they replace
    what is there, and `_mark_stored` is to be called once they did.
    """
    stored = Posteriors.from_trees(result.posteriors).stored
    files = list({posterior.after: posterior for posterior in stored if posterior}.values())
    for posterior in files if whole else files[-2:]:  # the last but one may have shrunk
        name = _posterior_file(posterior.after)
        if whole or home / name != posterior.file:
            write_tree(folder / name, posterior())
            if folder == home:
                posterior.file = home / name
    since = 0 if whole else len(result.missions)  # whose ticks are there
    write_missions(folder / MISSIONS, result.missions, since=since)
    history = result.history.assign(final_trust_map=result.trust_map)
    write_tree(folder / HISTORY, xr.DataTree(history))
    if result.believed is not None:
        write_tree(folder / BELIEVED, xr.DataTree(result.believed))
    write_text(folder / TABLE, frame_as_csv(result.table()))
    # Written last: its presence means that the rest is complete.
    write_checked(folder / RESULT, to_json(_record_of(result)).encode())


def _mark_stored(result: Result, home: Path) -> None:
    """Record that the posteriors are in a folder, all of them, from where they are read."""
    for posterior in Posteriors.from_trees(result.posteriors).stored:
        if posterior:
            posterior.file = home / _posterior_file(posterior.after)


def _posterior_file(after: int) -> Path:
    return Path(POSTERIORS) / f"{after:04d}.nc"


def _record_of(result: Result) -> dict[str, Any]:
    """Record of everything that no other file holds."""
    return {
        "n_missions": len(result.missions),
        "path": result.path,
        "trust": result.trust.tolist(),
        "value": result.value,
        "settings": result.settings,
        "stop_reason": result.stop_reason,
        "posterior_after": Posteriors.from_trees(result.posteriors).after,
        "failures": result.failures,
    }


def _is_in(result: Result, folder: Path) -> bool:
    """Whether a folder holds this very result."""
    record = json.loads(to_json(_record_of(result)))
    try:
        return to_json(read_fields(folder / RESULT)) == to_json(record)
    except DamagedFileError:
        return False


def _read_missions(
    folder: Path, record: dict[str, Any]
) -> tuple[list[Mission], Posteriors, xr.Dataset]:
    """Read the missions that a record counts, their posteriors and the history."""
    n, order = record["n_missions"], record["posterior_after"]
    posteriors: dict[int | None, Posterior] = {}
    for after in {*order} - {None}:
        file = folder / _posterior_file(after)
        if not file.exists():
            raise DamagedFileError(f"{str(file)!r} is missing.")
        posteriors[after] = Posterior(after, file=file)
    history, missions = read_tree(folder / HISTORY).to_dataset(), folder / MISSIONS
    with interpreting(folder / HISTORY):
        history = history.isel(iteration=slice(n))
        if (rows := history.sizes["iteration"]) != n:
            raise ValueError(f"{rows} missions of {n}")
    filled = read_missions(missions)[:n]
    if len(filled) != n:
        raise DamagedFileError(f"{str(missions)!r} holds {len(filled)} missions of {n}.")
    return filled, Posteriors(posteriors.get(after) for after in order), history
