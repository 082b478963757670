"""Folder of a campaign, with one file for each mission and one for each posterior.

    workspace.nc          written once
    difficulty.nc         difficulty of all bounds, written once a plan has needed it
    earlier.nc            missions of earlier campaigns, if there are any; written once
    missions/0001.nc      measurements and plan of the first mission, written before learning
    posteriors/0001.nc    draws of the parameters after the first mission; 0000.nc contains those
                          given the missions of earlier campaigns, if there are any
    campaign.json         settings, exclusions, failures, closings, and hashes of the other files

Files are only added; campaign.json, which lists them with their hashes, is replaced. Every file is
written under a temporary name, flushed to disk and renamed, and campaign.json comes last: what it
contains is recorded. If the process dies during `tell`, the following happens:

    before the file of the mission exists   nothing is recorded; tell the mission again
    before campaign.json lists the mission  nothing is recorded; `Campaign.load` warns, and the next
                                            `tell` sets the file aside as `.unrecorded`
    before campaign.json lists its posterior
                                            the mission is recorded; `Campaign.load` computes the
                                            same posterior, with the same seed
"""

import json
import os
from collections.abc import Callable, Container, Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import xarray as xr

from trustbo.campaign.lock import FolderLock
from trustbo.campaign.record import (
    DIFFICULTY,
    EARLIER,
    MISSIONS,
    RECORD,
    WORKSPACE,
    mission_file,
    posterior_file,
    record_to_bytes,
    require_no_missions_above,
)
from trustbo.campaign.replace import (
    discard,
    has_campaign,
    new_folder,
    put_in_place,
    recorded_files,
    recover,
    remove_tree,
)
from trustbo.campaign.state import EarlierMissions, Entry, Posterior, State
from trustbo.errors import TrustboError, warn
from trustbo.files import (
    FilePath,
    hash_of,
    holding_interrupts,
    read_file,
    to_json,
    to_path,
    write_file,
)
from trustbo.hazard.trials import LostMission
from trustbo.logs.netcdf import missions_from_tree, missions_to_tree, tree_to_bytes
from trustbo.planning.plan import as_tuples, plan_to_record
from trustbo.workspace import Workspace
from trustbo.workspace.netcdf import difficulty_to_tree, workspace_to_tree


class FolderStorage:
    """Folder of a campaign, locked until `close` or the end of the process.

    Attributes:
        path: Absolute path of the folder.
        turn: Lock between threads, held during each operation of the campaign.
        files: Hash of each file of the campaign, keyed by its path in the folder.
    """

    def __init__(self, lock: FolderLock, files: dict[str, str], workspace: Workspace) -> None:
        """Use a locked folder that contains a campaign with these files in a workspace."""
        self.path = lock.path
        self.turn = lock.turn
        self.files = files
        self._lock = lock
        self._workspace = workspace
        self._written = _version_of(self.path / RECORD)

    @classmethod
    def begin(
        cls,
        directory: FilePath,
        workspace: Workspace,
        state: State,
        *,
        overwrite: bool,
        take_over: bool = False,
        turn: AbstractContextManager[Any] | None = None,
    ) -> Self:
        """Lock a folder and write a whole campaign.

        If this fails, the folder is as before. An existing campaign is replaced only when the new
        one is complete on disk, and no other files are changed.

        Args:
            directory: Folder, which is created if it does not exist.
            workspace: Workspace of the campaign.
            state: State of the campaign.
            overwrite: Whether to replace an existing campaign in the folder.
            take_over: Whether to close an older campaign of this process that uses the folder.
            turn: Lock of the campaign between threads; by default, a new one.

        Raises:
            TrustboError: Another campaign uses the folder; it contains a campaign and `overwrite`
                is False; it contains other files with the names of a campaign's files; or it cannot
                be written.
        """
        path = to_path(directory)
        if not overwrite:
            _require_no_campaign(path)

        is_new = not path.exists()
        _make_folder(path)
        lock = FolderLock(path, take_over=take_over, turn=turn)

        try:
            recover(lock.path)
            if not overwrite:
                _require_no_campaign(path)
            return cls(lock, _write_campaign(lock.path, workspace, state), workspace)
        except BaseException:
            # Another process may have made the folder, and written a campaign, in the meantime.
            if is_new and not has_campaign(path):
                remove_tree(path)
            lock.release()
            raise

    def require_open(self) -> None:
        """Raise TrustboError if the campaign was closed, or if others have changed its folder."""
        path = self._lock.require()
        found = _version_of(path / RECORD)
        # A missing record is written again; a different record was written by somebody else.
        if found is not None and found != self._written:
            raise TrustboError(
                f"{str(path / RECORD)!r} was changed by another program while the campaign was "
                "open, so nothing was recorded. Continue with Campaign.load."
            )

    def write(self, state: State) -> None:
        """Write the missions and posteriors that have no files yet, and then campaign.json.

        If this fails, campaign.json is as before, and the new files are removed.
        """
        self.require_open()
        new: dict[str, str] = {}
        try:
            for name, content in _contents(self._workspace, state, known=self.files):
                if name.startswith(MISSIONS):
                    _set_aside(self.path / name)
                new[name] = _write(self.path, name, content)
            record = record_to_bytes(state, self.files | new)
            write_file(self.path / RECORD, record)
        except BaseException:
            if _version_of(self.path / RECORD) == self._written:
                for name in new:
                    with suppress(OSError):
                        (self.path / name).unlink()
            raise

        self.files |= new
        self._written = _version_of(self.path / RECORD)
        self.adopt(state)

    def adopt(self, state: State) -> None:
        """Let the posteriors of a state that was written be read from this folder."""
        for posterior in state.posteriors:
            name = posterior_file(posterior.name)
            posterior.file = self.path / name, self.files[name]
            if posterior is not state.last:
                posterior.tree = None  # frees the memory

    def close(self) -> None:
        """Release the folder."""
        self._lock.release()


class MemoryStorage:
    """Storage of a campaign that exists in memory only: its state is all there is to record."""

    def require_open(self) -> None:
        """Do nothing; it is always open."""

    def write(self, state: State) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing; the campaign can go on."""


def _write(folder: Path, name: str, content: bytes) -> str:
    """Write a file, given its path in a folder, and return its hash."""
    write_file(folder / name, content)
    return hash_of(content)


def _set_aside(file: Path) -> None:
    """Rename a file with the name of a new mission, which campaign.json does not list.

    A process died before it recorded this mission, or an older campaign.json was restored.
    """
    if file.exists():
        try:
            os.replace(file, file.with_suffix(".unrecorded"))
        except OSError as error:
            raise TrustboError(f"cannot rename {str(file)!r}: {error.strerror}.") from error


def _contents(
    workspace: Workspace, state: State, known: Container[str] = ()
) -> Iterator[tuple[str, bytes]]:
    """Make the files of a campaign, except campaign.json and known ones: path and content."""
    makers: dict[str, Callable[[], xr.DataTree]] = {WORKSPACE: lambda: workspace_to_tree(workspace)}
    if workspace.posts is not None and workspace.difficulty.is_whole:
        makers[DIFFICULTY] = lambda: difficulty_to_tree(workspace.difficulty)
    if state.earlier.missions:
        makers[EARLIER] = lambda: earlier_to_tree(state.earlier)
    for n, entry in enumerate(state.entries, start=1):
        makers[mission_file(n)] = lambda entry=entry: _entry_to_tree(entry)

    for name, make in makers.items():
        if name not in known:
            yield name, tree_to_bytes(make())
    for posterior in state.posteriors:
        name = posterior_file(posterior.name)
        if name not in known:
            yield name, _content_of(posterior)


def _entry_to_tree(entry: Entry) -> xr.DataTree:
    """Convert a mission with its plan to a data tree."""
    planned = xr.Dataset({"trust_map": entry.trust_map})
    planned.attrs = {"plan": to_json(plan_to_record(entry.plan)), "cause": entry.cause}
    tree = missions_to_tree([entry.measured])
    tree["planned"] = xr.DataTree(planned)
    return tree


def _content_of(posterior: Posterior) -> bytes:
    """Return the content of a posterior's file; an existing file is copied and keeps its hash."""
    if posterior.file is not None:
        try:
            return read_file(*posterior.file)
        except TrustboError:
            if posterior.tree is None:
                raise
    return tree_to_bytes(posterior())


def without_lost_posteriors(state: State) -> State:
    """Return a state without the posteriors whose files cannot be read any more, with a warning.

    If the last one is missing, it is computed again, so that no plan comes from the prior.
    """
    lost = [posterior for posterior in state.posteriors if posterior.is_lost]
    if not lost:
        return state

    warn(
        f"the posteriors {', '.join(one.name for one in lost)} cannot be read and are not saved. "
        "The missions are complete, and Campaign.load computes the last posterior again."
    )
    entries = tuple(
        replace(entry, posterior=None) if entry.posterior in lost else entry
        for entry in state.entries
    )
    initial = None if state.initial in lost else state.initial
    fitted = None if state.last in lost else state.fitted
    return replace(state, entries=entries, initial=initial, fitted=fitted)


def _write_campaign(folder: Path, workspace: Workspace, state: State) -> dict[str, str]:
    """Write a campaign beside the one in the folder, if any, and put it in place.

    Returns the hashes of its files. If this fails, a folder without campaign is as before.
    """
    old = recorded_files(folder)
    require_no_missions_above(folder, len(state.entries), old)
    files: dict[str, str] = {}
    beside = new_folder(folder)
    try:
        for name, content in _contents(workspace, state):
            if name not in old and (folder / name).exists():
                raise TrustboError(
                    f"{str(folder / name)!r} exists, but no campaign in this folder lists it; "
                    "move it, or give another folder."
                )
            files[name] = _write(beside, name, content)
        write_file(beside / RECORD, record_to_bytes(state, files))

        with holding_interrupts():
            put_in_place(folder, beside)
    except BaseException:
        remove_tree(beside)
        if not old:
            discard(folder)
            for name in (RECORD, *files):
                (folder / name).unlink(missing_ok=True)
        raise
    return files


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TrustboError(f"cannot create {str(path)!r}: {error.strerror}.") from error


def _require_no_campaign(path: Path) -> None:
    """Raise TrustboError if a folder contains a campaign."""
    if has_campaign(path):
        raise TrustboError(
            f"{str(path)!r} contains a campaign: continue it (Campaign.load, resume), give another "
            "folder, or replace it (overwrite)."
        )


def _version_of(file: Path) -> tuple[int, int, int] | None:
    """Return numbers that change when a file is replaced or edited; None if there is none."""
    try:
        found = file.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size


def earlier_to_tree(earlier: EarlierMissions) -> xr.DataTree:
    """Convert earlier missions to a data tree."""
    tree = missions_to_tree(earlier.missions)
    tree.attrs["planned"] = to_json(earlier.planned)
    tree.attrs["lost"] = to_json([mission._asdict() for mission in earlier.lost])
    return tree


def earlier_from_tree(tree: xr.DataTree) -> EarlierMissions:
    """Restore earlier missions from a data tree made by `earlier_to_tree`."""
    lost = []
    records: list[dict[str, Any]] = json.loads(tree.attrs["lost"])
    for record in records:
        where = record["where"]
        path = tuple(map(tuple, record["path"]))
        lost.append(LostMission(path, None if where is None else tuple(where)))
    missions = tuple(missions_from_tree(tree))
    planned = as_tuples(json.loads(tree.attrs.get("planned", "[]"))) or ((),) * len(missions)
    return EarlierMissions(missions, planned, tuple(lost))
