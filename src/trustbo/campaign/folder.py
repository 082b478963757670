"""Folder of a campaign: one owner at a time, and no file half-written."""

import json
from os import PathLike
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from trustbo.campaign.history import Learned
from trustbo.campaign.result import Result, read_learned
from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.files import require_folder, to_json, write_file, write_text
from trustbo.logs import netcdf as records
from trustbo.workspace import Workspace
from trustbo.workspace import netcdf as archive

_STATE, _MEASURED, _WORKSPACE = "campaign.json", "measured.nc", "workspace.nc"


class CampaignFolder:
    """Files of a campaign, written as it goes and read back.

    `measured.nc` holds the missions as they were told, before anything is learned from them. The
    rest is what `Result.save` writes, and last comes `campaign.json`, which holds the number of
    missions that are complete: a process that dies in between loses nothing.

    Attributes:
        path: Path of the folder.
    """

    def __init__(self, directory: str | PathLike[str], *, begun: bool = False) -> None:
        """Take hold of the folder, until `close` or the end of the process.

        Args:
            directory: Path of the folder.
            begun: Whether it has to hold a campaign already.

        Raises:
            TrustboError: The folder holds no campaign and has to; another process holds it; or its
                name belongs to a file.
        """
        self.path = Path(directory)
        if begun and not self.is_used:
            raise TrustboError(
                f"{str(directory)!r} holds no campaign; give a folder that one was saved to."
            )
        require_folder(directory).mkdir(parents=True, exist_ok=True)
        self._lock = FileLock(self.path / ".lock", timeout=0)
        try:
            self._lock.acquire()
        except Timeout:
            raise TrustboError(
                f"another campaign is at work in {str(self.path)!r}; close it first, or choose "
                "another folder."
            ) from None

    @property
    def is_used(self) -> bool:
        """Whether the folder holds a campaign."""
        return (self.path / _STATE).exists()

    def close(self) -> None:
        """Let go of the folder."""
        self._lock.release()

    def begin(self, workspace: Workspace, measured: list[Mission]) -> None:
        """Replace what the folder holds by a campaign's workspace and its missions as told."""
        for name in (_STATE, "result.json", _MEASURED):
            (self.path / name).unlink(missing_ok=True)
        write_file(self.path / _WORKSPACE, archive.workspace_to_tree(workspace).to_netcdf)
        if measured:
            self.write_measured(measured)

    def read_workspace(self) -> Workspace:
        """Read the campaign's workspace."""
        return archive.workspace_from_tree(records.read_tree(self.path / _WORKSPACE))

    def write_measured(self, missions: list[Mission]) -> None:
        """Write missions as they were told."""
        write_file(self.path / _MEASURED, records.missions_to_tree(missions).to_netcdf)

    def write(self, state: dict[str, Any], result: Result | None, *, whole: bool = False) -> None:
        """Write the campaign's state, after its result.

        Args:
            state: State that `read` returns.
            result: Result so far; None leaves the one in the folder.
            whole: Whether all of the result is new, or only the last mission.
        """
        if result is not None:
            result.save(self.path) if whole else result.checkpoint(self.path)
        write_text(self.path / _STATE, to_json(state))

    def read(self) -> tuple[dict[str, Any], list[Mission], Learned | None]:
        """Read the state, the missions as told, and the result of all but maybe the last."""
        state = json.loads((self.path / _STATE).read_text(encoding="utf-8"))
        measured: list[Mission] = []
        if (self.path / _MEASURED).exists():
            measured = records.missions_from_tree(records.read_tree(self.path / _MEASURED))
        n = state["n_missions"]
        return state, measured, read_learned(self.path, n) if n else None
