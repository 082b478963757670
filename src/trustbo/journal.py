"""A campaign's folder: one owner at a time, and nothing half-written."""

import json
from os import PathLike
from pathlib import Path
from typing import Any, Self

from filelock import FileLock, Timeout

from trustbo import archive, records
from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.files import to_json, write_file, write_text
from trustbo.result import Learned, Result, read_learned, require_folder
from trustbo.terrain import Workspace

_STATE, _MEASURED, _WORKSPACE = "campaign.json", "measured.nc", "workspace.nc"


class Journal:
    """Writes a campaign to a folder as it goes, and reads it back.

    `measured.nc` holds the missions as they were told, before anything is learned from them. The
    rest is what `Result.save` writes, and last comes `campaign.json`, which says how many missions
    of it are complete: a process that dies in between loses nothing.

    Attributes:
        folder: Where.
    """

    def __init__(self, directory: str | PathLike[str]) -> None:
        """Take hold of the folder, until `close` or the end of the process.

        Raises:
            TrustboError: Another campaign holds it, or its name belongs to a file.
        """
        self.folder = require_folder(directory)
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = FileLock(self.folder / ".lock", timeout=0)
        try:
            self._lock.acquire()
        except Timeout:
            raise TrustboError(
                f"another campaign is at work in {str(self.folder)!r}; close it first, or choose "
                "another folder."
            ) from None

    @classmethod
    def existing(cls, directory: str | PathLike[str]) -> Self:
        """Take hold of a folder that holds a campaign.

        Raises:
            TrustboError: It holds none, or another campaign is at work in it.
        """
        if not (Path(directory) / _STATE).exists():
            raise TrustboError(
                f"{str(directory)!r} holds no campaign; give a folder that one was saved to."
            )
        return cls(directory)

    @property
    def is_used(self) -> bool:
        """Whether the folder holds a campaign already."""
        return (self.folder / _STATE).exists()

    def clear(self) -> None:
        """Forget the campaign and the result that the folder holds."""
        for name in (_STATE, "result.json", _MEASURED):
            (self.folder / name).unlink(missing_ok=True)

    def close(self) -> None:
        """Let go of the folder."""
        self._lock.release()

    def write_workspace(self, workspace: Workspace) -> None:
        """Keep where it is."""
        tree = archive.workspace_to_tree(workspace)
        write_file(self.folder / _WORKSPACE, tree.to_netcdf)

    def read_workspace(self) -> Workspace:
        """Where it is."""
        return archive.workspace_from_tree(records.read_tree(self.folder / _WORKSPACE))

    def write_measured(self, missions: list[Mission]) -> None:
        """Keep missions as they were told."""
        write_file(self.folder / _MEASURED, records.missions_to_tree(missions).to_netcdf)

    def write(self, state: dict[str, Any], result: Result | None, *, whole: bool = False) -> None:
        """Keep everything.

        Args:
            state: What `read` gives back.
            result: What was learned, if anything.
            whole: Whether all of the result is new, or only the last mission.
        """
        if result is not None:
            result.save(self.folder) if whole else result.checkpoint(self.folder)
        write_text(self.folder / _STATE, to_json(state))

    def read(self) -> tuple[dict[str, Any], list[Mission], Learned | None]:
        """State, the missions as told, and what was learned from all but maybe the last."""
        state = json.loads((self.folder / _STATE).read_text(encoding="utf-8"))
        measured: list[Mission] = []
        if (self.folder / _MEASURED).exists():
            measured = records.missions_from_tree(records.read_tree(self.folder / _MEASURED))
        n = state["n_missions"]
        return state, measured, read_learned(self.folder, n) if n else None
