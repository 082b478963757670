"""Folder of a campaign, with one file for each mission and one for each posterior.

    workspace.nc          written once
    difficulty.nc         difficulty of all bounds, written once a plan has needed it
    earlier.nc            missions of earlier campaigns, if there are any; written once
    missions/0001.nc      measurements and plan of the first mission, written before learning
    posteriors/0001.nc    draws of the parameters after the first mission; 0000.nc contains those
                          given the missions of earlier campaigns, if there are any
    campaign.json         settings, the rows of completed missions, failures, and hashes of the
                          other files; written last

Every file is written under a temporary name, flushed to disk and renamed. A mission counts as
recorded once its file has been renamed. Everything else counts as recorded once campaign.json has
been replaced. If the process dies, no mission is lost: `Campaign.load` learns from the missions
that are not in campaign.json yet.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Self

import xarray as xr

from trustbo.campaign.earlier import earlier_to_tree
from trustbo.campaign.lock import FolderLock
from trustbo.campaign.record import (
    DIFFICULTY,
    EARLIER,
    RECORD,
    WORKSPACE,
    mission_file,
    mission_files,
    posterior_file,
    record_to_bytes,
)
from trustbo.campaign.replace import (
    commit_replacement,
    finish_replacement,
    has_campaign,
    new_folder,
    recorded_files,
    recover,
    remove_tree,
)
from trustbo.campaign.state import Entry, Posterior, State, StoredFile
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
from trustbo.logs.netcdf import missions_to_tree, read_tree, tree_from_bytes, tree_to_bytes
from trustbo.planning.plan import plan_to_record
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
        lock = FolderLock(path, take_over=take_over)

        try:
            recover(lock.path)
            if not overwrite:
                _require_no_campaign(path)
            if (lock.path / RECORD).exists():
                files = _replace_campaign(lock.path, workspace, state)
            else:
                files = _write_first(lock.path, workspace, state)
            return cls(lock, files, workspace)
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

    def add_mission(self, n: int, entry: Entry) -> None:
        """Write the measurements, plan and table row of mission n."""
        self.require_open()
        name = mission_file(n)
        if (self.path / name).exists():
            raise TrustboError(
                f"{str(self.path / name)!r} exists, but is not a mission of this campaign; move it "
                "to another folder."
            )
        self._write(name, tree_to_bytes(_entry_to_tree(entry)))

    def write(self, state: State) -> None:
        """Write the posteriors that have no files yet, and then campaign.json."""
        self.require_open()

        for posterior in state.stored:
            if posterior.tree is None:
                continue
            if posterior.file is None:
                name = posterior_file(posterior.name)
                posterior.file = self._write(name, tree_to_bytes(posterior.tree))
            if posterior is not state.last:
                posterior.tree = None  # frees the memory

        if DIFFICULTY not in self.files:
            for name, content in _measured(self._workspace):
                self._write(name, content)

        record = record_to_bytes(state, self.files)
        write_file(self.path / RECORD, record, make_folder=False)
        self._written = _version_of(self.path / RECORD)

    def stored(self, posterior: Posterior) -> StoredFile:
        """Return the file of a posterior in this folder."""
        name = posterior_file(posterior.name)
        return StoredFile(self.path / name, self.files[name])

    def close(self) -> None:
        """Release the folder."""
        self._lock.release()

    def _write(self, name: str, content: bytes) -> StoredFile:
        """Write a file in the folder; if the folder was moved, it is not created again."""
        stored = _write_stored(self.path, name, content)
        self.files[name] = stored.sha256
        return stored


def _write_stored(folder: Path, name: str, content: bytes) -> StoredFile:
    """Write a file of a folder, given its path in the folder."""
    file = folder / name
    try:
        file.parent.mkdir(exist_ok=True)
    except OSError as error:
        raise TrustboError(f"cannot create {str(file.parent)!r}: {error.strerror}.") from error

    write_file(file, content, make_folder=False)
    return StoredFile(file, hash_of(content))


def _entry_to_tree(entry: Entry) -> xr.DataTree:
    """Convert a mission with its plan and its table row to a data tree."""
    planned = xr.Dataset({"trust_map": entry.trust_map})
    planned.attrs = {"plan": to_json(plan_to_record(entry.plan)), "row": to_json(entry.row)}
    tree = missions_to_tree([entry.measured])
    tree["planned"] = xr.DataTree(planned)
    return tree


def _contents(workspace: Workspace, state: State) -> Iterator[tuple[str, bytes]]:
    """Make the files of a campaign, except campaign.json: path in the folder, and content."""
    yield WORKSPACE, tree_to_bytes(workspace_to_tree(workspace))
    yield from _measured(workspace)
    if state.earlier.missions:
        yield EARLIER, tree_to_bytes(earlier_to_tree(state.earlier))

    for n, entry in enumerate(state.entries, start=1):
        yield mission_file(n), tree_to_bytes(_entry_to_tree(entry))
    posteriors = {posterior.name: posterior for posterior in state.stored}
    for name, posterior in posteriors.items():
        yield posterior_file(name), _content_of(posterior)


def _measured(workspace: Workspace) -> Iterator[tuple[str, bytes]]:
    """Make the file of the difficulty of bounds, if all of them have been measured."""
    if workspace.posts is not None and workspace.difficulty.is_whole:
        yield DIFFICULTY, tree_to_bytes(difficulty_to_tree(workspace.difficulty))


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

    If the last one is missing, a fit is due, so that the next plan does not come from the prior.
    """
    initial = state.initial
    lost = []
    if initial is not None and _is_lost(initial):
        initial = None
        lost.append(0)

    entries = []
    for n, entry in enumerate(state.entries, start=1):
        if entry.posterior is not None and _is_lost(entry.posterior):
            entry = replace(entry, posterior=None)
            lost.append(n)
        entries.append(entry)

    if not lost:
        return state
    warn(
        f"the posteriors after the missions {lost} cannot be read and are not saved. The missions "
        "are complete, and Campaign.load computes the last posterior again."
    )
    remaining = replace(state, entries=entries, initial=initial)
    if entries and remaining.last is None and state.due is None:
        remaining.due = state.seed_of("fit")
    return remaining


def _is_lost(posterior: Posterior) -> bool:
    """Return whether a posterior cannot be read any more."""
    if posterior.tree is not None or posterior.file is None:
        return False
    try:
        read_file(*posterior.file)
    except TrustboError:
        return True
    return False


def _write_first(folder: Path, workspace: Workspace, state: State) -> dict[str, str]:
    """Write a campaign to a folder that contains none, and return the hashes of its files.

    If this fails, the files are removed again. Files with these names that exist already are
    replaced only if they have the same content, as when an earlier process died here.
    """
    _require_no_missions_of_others(folder, len(state.entries), [])
    files: dict[str, str] = {}
    written: list[Path] = []
    try:
        for name, content in _contents(workspace, state):
            file = folder / name
            if file.exists() and not _has_content(file, content):
                raise TrustboError(
                    f"{str(file)!r} exists, but no campaign in this folder lists it; move it, or "
                    "give another folder."
                )
            files[name] = _write_stored(folder, name, content).sha256
            written.append(file)
        write_file(folder / RECORD, record_to_bytes(state, files), make_folder=False)
    except BaseException:
        for file in (folder / RECORD, *written):
            file.unlink(missing_ok=True)
        raise
    return files


def _replace_campaign(folder: Path, workspace: Workspace, state: State) -> dict[str, str]:
    """Write a campaign beside the one in the folder, and then replace the old one."""
    old = recorded_files(folder)
    _require_no_missions_of_others(folder, len(state.entries), old)
    beside = new_folder(folder)
    try:
        files = {
            name: _write_stored(beside, name, content).sha256
            for name, content in _contents(workspace, state)
        }

        for name in files:
            if name not in old and (folder / name).exists():
                raise TrustboError(
                    f"{str(folder / name)!r} exists, but is not a file of the campaign in this "
                    "folder; move it, or give another folder."
                )
        write_file(beside / RECORD, record_to_bytes(state, files), make_folder=False)

        with holding_interrupts():
            commit_replacement(folder, beside, old, list(files))
            finish_replacement(folder)
    except BaseException:
        remove_tree(beside)
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


def _require_no_missions_of_others(folder: Path, n_missions: int, old: Sequence[str]) -> None:
    """Raise TrustboError for missions that the new campaign in a folder would take for its own.

    Args:
        folder: Folder of the campaign.
        n_missions: Number of missions of the new campaign.
        old: Files of the campaign that is replaced.
    """
    for file in mission_files(folder):
        if int(file.stem) > n_missions and file.relative_to(folder).as_posix() not in old:
            raise TrustboError(
                f"{str(file)!r} exists, but no campaign in this folder lists it; move it, or give "
                "another folder."
            )


def _has_content(file: Path, content: bytes) -> bool:
    """Compare a netCDF file by its values, because the bytes contain the time of writing."""
    try:
        return read_tree(file).identical(tree_from_bytes(content))
    except TrustboError:
        return False


def _version_of(file: Path) -> tuple[int, int, int] | None:
    """Return numbers that change when a file is replaced or edited; None if there is none."""
    try:
        found = file.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size
