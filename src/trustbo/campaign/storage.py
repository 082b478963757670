"""Folder of a campaign: one owner at a time, no file half-written, and every damage noticed."""

import json
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import xarray as xr

from trustbo.campaign.damage import naming_what_is_left, read_fields, salvage
from trustbo.campaign.migrate import extras_of
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
from trustbo.campaign.result import Result
from trustbo.campaign.result_files import mark_kept, read_kept, read_workspace, write_result
from trustbo.campaign.state import CampaignState
from trustbo.campaign.told import require_extra
from trustbo.data import Mission
from trustbo.errors import DamagedFileError, TrustboError
from trustbo.files import FilePath, as_path, interpreting, remove_checked, to_json, write_checked
from trustbo.logs.netcdf import missions_of_tree, read_tree, write_missions, write_tree
from trustbo.workspace import Workspace
from trustbo.workspace import netcdf as archive


class Saved(NamedTuple):
    """Campaign that was read from a folder."""

    state: CampaignState
    workspace: Workspace
    pending: list[tuple[Mission, dict[str, float]]]
    """Missions on disk that the state does not count, with the numbers that they were told with."""


class Storage:
    """Files of a campaign, written as it goes and read back.

    `measured.nc` holds the missions as they were told, before anything is learned from them. The
    rest is what `Result.save` writes, and last comes `campaign.json`, which holds the number of
    missions that are complete: a process that dies in between loses nothing.

    Attributes:
        path: Path of the folder.
    """

    def __init__(self, directory: FilePath, *, begun: bool | None = None) -> None:
        """Take hold of the folder, until `release` or the end of the process.

        Args:
            directory: Path of the folder.
            begun: Whether it has to hold a campaign already, or must not; None for either.

        Raises:
            TrustboError: The folder holds no campaign and has to, or one and must not; another
                process holds it; it may not be written to; or its name belongs to a file.
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
        if begun is False and self.is_used:
            self.release()
            raise TrustboError(
                f"{str(self.path)!r} holds a campaign already: go on with it by Campaign.load, or "
                "choose another folder."
            )

    @property
    def is_used(self) -> bool:
        """Whether the folder holds a campaign."""
        return (current(self.path) / STATE).exists()

    def release(self) -> None:
        """Let go of the folder."""
        self._lock.release()

    def is_at(self, directory: FilePath) -> bool:
        """Whether this is the folder of a name."""
        return self.path.resolve() == as_path(directory).resolve()

    def replace(self, workspace: Workspace, state: CampaignState, result: Result | None) -> None:
        """Write a campaign, which takes the place of what the folder holds when it is whole.

        Raises:
            TrustboError: A file of another program would be replaced; see `require_ours`.
        """
        require_ours(self.path)
        warn_of_others(self.path)
        n_ticks, self._n_ticks = self._n_ticks, 0
        try:
            with replacing(self.path) as self._at:
                write_tree(self._at / WORKSPACE, archive.workspace_to_tree(workspace))
                if state.entries:
                    self._write_measured(state.measured, [entry.extra for entry in state.entries])
                self._write(state, result, whole=True)
                n_ticks = self._n_ticks
        finally:
            self._at, self._n_ticks = self.path, n_ticks
        if result is not None:
            mark_kept(result, self.path)

    def write_told(
        self, state: CampaignState, mission: Mission, extra: Mapping[str, float]
    ) -> None:
        """Write a mission as it was told, before it is in the state."""
        extras = [*(entry.extra for entry in state.entries), extra]
        self._write_measured([*state.measured, mission], extras)

    def write(self, state: CampaignState, result: Result | None, *, ended: bool = False) -> None:
        """Write the state, after what the last mission added to the result.

        Args:
            state: State that `read` returns.
            result: Result so far; None leaves the one in the folder.
            ended: Whether to write `posterior.nc` too, with all groups.
        """
        self._write(state, result, whole=False, ended=ended)

    def read(self) -> Saved:
        """Read the campaign, and the missions that were told and are not complete.

        Raises:
            DamagedFileError: A file is missing or damaged; the message says what can be read.
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
                    extras = _extras(tree, len(measured))
            if len(measured) < n:
                raise DamagedFileError(f"{str(file)!r} holds {len(measured)} missions of {n}.")
            kept = read_kept(self.path, record) if n else None
            workspace = read_workspace(self.path)
        self._n_ticks = len(measured) if (self.path / TICKS).exists() else 0
        with interpreting(self.path / STATE):
            complete = record, measured[:n], extras[:n], kept, workspace
            state = CampaignState.from_record(*complete)
        return Saved(state, workspace, list(zip(measured[n:], extras[n:], strict=True)))

    def _write_measured(
        self, missions: Sequence[Mission], extras: Sequence[Mapping[str, float]]
    ) -> None:
        finish_replacing(self.path)
        since, self._n_ticks = min(self._n_ticks, len(missions) - 1), len(missions)
        notes = {"extra": json.dumps(list(extras))}
        write_missions(self._at / MEASURED, missions, since=since, notes=notes)

    def _write(
        self, state: CampaignState, result: Result | None, *, whole: bool, ended: bool = False
    ) -> None:
        """Write the result, all of it or only the last mission, then the state."""
        finish_replacing(self.path)
        if result is not None:
            write_result(result, self._at, whole=whole, home=self.path)
            if ended and result.has_posterior:
                write_tree(self._at / POSTERIOR, result.posterior)
            elif not whole:
                remove_checked(self._at / POSTERIOR)  # of the missions before
        write_checked(self._at / STATE, to_json(state.to_record()).encode())


def _extras(tree: xr.DataTree, n: int) -> list[dict[str, float]]:
    """Numbers that missions were told with."""
    extras = extras_of(tree["missions"].attrs, n)
    if len(extras) != n:
        raise ValueError(f"{len(extras)} extras of {n} missions")
    # Names that are reserved by now were free once.
    return [require_extra(extra, reserved=()) for extra in extras]
