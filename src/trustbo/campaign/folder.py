"""Folder of a campaign: one owner at a time, no file half-written, and every damage noticed."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import xarray as xr

from trustbo.campaign.damage import naming_what_is_left, read_fields, salvage
from trustbo.campaign.history import Kept
from trustbo.campaign.replacing import (
    MEASURED,
    POSTERIOR,
    STATE,
    TICKS,
    WORKSPACE,
    current,
    finish_replacing,
    hold,
    replacing,
    require_ours,
    warn_of_others,
)
from trustbo.campaign.result import Result, read_kept, read_workspace
from trustbo.campaign.told import require_extra
from trustbo.data import Mission
from trustbo.errors import DamagedFileError, TrustboError
from trustbo.files import (
    FilePath,
    as_path,
    interpreting,
    remove_checked,
    to_json,
    write_checked,
)
from trustbo.logs.netcdf import missions_of_tree, read_tree, write_missions, write_tree
from trustbo.workspace import Workspace
from trustbo.workspace import netcdf as archive


class Contents(NamedTuple):
    """State of a campaign, its missions as told, and all that was learned from them."""

    state: dict[str, Any]
    measured: list[Mission]
    extras: list[dict[str, float]]
    kept: Kept | None


class CampaignFolder:
    """Files of a campaign, written as it goes and read back.

    `measured.nc` holds the missions as they were told, before anything is learned from them. The
    rest is what `Result.save` writes, and last comes `campaign.json`, which holds the number of
    missions that are complete: a process that dies in between loses nothing.

    Attributes:
        path: Path of the folder.
    """

    def __init__(self, directory: FilePath, *, begun: bool = False) -> None:
        """Take hold of the folder, until `close` or the end of the process.

        Args:
            directory: Path of the folder.
            begun: Whether it has to hold a campaign already.

        Raises:
            TrustboError: The folder holds no campaign and has to; another process holds it; it
                may not be written to; or its name belongs to a file.
        """
        self.path = as_path(directory)
        if begun and not self.is_used:
            measured = self.path / MEASURED
            said = f"{str(directory)!r} holds no campaign;"
            if measured.exists():
                raise DamagedFileError(f"{said} {STATE!r} is missing. {salvage(measured)}")
            raise TrustboError(f"{said} give a folder that one was saved to.")
        read = " tb.load_result reads one that may not." if begun else ""
        self._lock = hold(directory, read)
        self._at = self.path  # or the folder that its successor is being written to
        self._n_ticks = 0  # missions whose ticks are in files of their own

    @property
    def is_used(self) -> bool:
        """Whether the folder holds a campaign."""
        return (current(self.path) / STATE).exists()

    def close(self) -> None:
        """Let go of the folder."""
        self._lock.release()

    @contextmanager
    def replaced(self, workspace: Workspace) -> Iterator[None]:
        """Write a campaign that takes the place of what the folder holds when it is whole.

        Args:
            workspace: Its workspace, which is written first.

        Raises:
            TrustboError: A file of another program would be replaced; see `require_ours`.
        """
        require_ours(self.path)
        warn_of_others(self.path)
        n_ticks, self._n_ticks = self._n_ticks, 0
        try:
            with replacing(self.path) as self._at:
                write_tree(self._at / WORKSPACE, archive.workspace_to_tree(workspace))
                yield
                n_ticks = self._n_ticks
        finally:
            self._at, self._n_ticks = self.path, n_ticks

    def read_workspace(self) -> Workspace:
        """Read the campaign's workspace."""
        with naming_what_is_left(self.path):
            return read_workspace(self.path)

    def write_measured(
        self, missions: Sequence[Mission], extras: Sequence[Mapping[str, float]]
    ) -> None:
        """Write missions as they were told, and the numbers that they were told with."""
        finish_replacing(self.path)
        since, self._n_ticks = min(self._n_ticks, len(missions) - 1), len(missions)
        notes = {"extra": json.dumps(list(extras))}
        write_missions(self._at / MEASURED, missions, since=since, notes=notes)

    def write(
        self,
        state: dict[str, Any],
        result: Result | None,
        *,
        whole: bool = False,
        ended: bool = False,
    ) -> None:
        """Write the campaign's state, after its result.

        Args:
            state: State that `read` returns.
            result: Result so far; None leaves the one in the folder.
            whole: Whether all of the result is new, or only the last mission.
            ended: Whether to write `posterior.nc` too, with all groups.
        """
        finish_replacing(self.path)
        if result is not None:
            result.write(self._at, whole=whole, home=self.path)
            if ended and result.has_posterior:
                write_tree(self._at / POSTERIOR, result.posterior)
            elif not whole:
                remove_checked(self._at / POSTERIOR)  # of the missions before
        write_checked(self._at / STATE, to_json(state).encode())

    def read(self) -> Contents:
        """Read the state, the missions as told, and what was learned from all but maybe the last.

        Raises:
            DamagedFileError: A file is missing or damaged; the message says what can be read.
        """
        with naming_what_is_left(self.path):
            state = read_fields(self.path / STATE)
            measured: list[Mission] = []
            extras: list[dict[str, float]] = []
            n = state["n_missions"]
            if n or (self.path / MEASURED).exists():
                tree = read_tree(self.path / MEASURED)
                measured = missions_of_tree(tree, self.path / MEASURED)
                with interpreting(self.path / MEASURED):
                    extras = _extras(tree, len(measured))
            if len(measured) < n:
                raise DamagedFileError(
                    f"{str(self.path / MEASURED)!r} holds {len(measured)} missions of {n}."
                )
            kept = read_kept(self.path, state) if n else None
        self._n_ticks = len(measured) if (self.path / TICKS).exists() else 0
        return Contents(state, measured, extras, kept)


def _extras(tree: xr.DataTree, n: int) -> list[dict[str, float]]:
    """Numbers that missions were told with; none in a file of version 0.1."""
    text = tree["missions"].attrs.get("extra")
    extras = [{} for _ in range(n)] if text is None else json.loads(text)
    if len(extras) != n:
        raise ValueError(f"{len(extras)} extras of {n} missions")
    # Names that are reserved by now were free once.
    return [require_extra(extra, reserved=()) for extra in extras]
