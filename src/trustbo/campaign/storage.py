"""Folder of a campaign, with one file for each mission and one for each posterior.

    workspace.nc          written once
    missions/0001.nc      measurements and plan of the first mission, written before learning
    posteriors/0001.nc    draws of the parameters after the first mission
    campaign.json         settings, the rows of completed missions, and failures; written last

Every file is written under a temporary name, flushed to disk and renamed. If the process dies, no
mission is lost: `Campaign.load` learns from the missions that are not in campaign.json yet.
"""

import itertools
import json
from pathlib import Path
from typing import Self

import numpy as np
import xarray as xr
from filelock import FileLock, Timeout

from trustbo.campaign.learning import as_learned
from trustbo.campaign.state import Entry, Failure, Posterior, State
from trustbo.errors import TrustboError
from trustbo.files import FilePath, interpreting, read_file, to_json, write_text
from trustbo.logs.netcdf import missions_from_tree, missions_to_tree, read_tree, write_tree
from trustbo.models.backend import VERSIONS
from trustbo.planning.plan import plan_from_record, plan_to_record
from trustbo.workspace import Workspace
from trustbo.workspace import netcdf as archive

RECORD, WORKSPACE, MISSIONS, POSTERIORS = "campaign.json", "workspace.nc", "missions", "posteriors"


class Storage:
    """Folder of a campaign, locked until `release` or the end of the process.

    Attributes:
        path: Path of the folder.
    """

    def __init__(self, directory: FilePath) -> None:
        """Lock a folder, and create it if necessary.

        Raises TrustboError if another process has locked it or the path is a file.
        """
        self.path = Path(directory)
        self._lock = FileLock(self.path / ".lock", timeout=0)
        try:
            self._lock.acquire()
        except Timeout:
            raise TrustboError(
                f"another campaign is using {str(directory)!r}; close it first, or give another "
                "folder."
            ) from None
        except OSError as error:
            raise TrustboError(f"cannot create {str(directory)!r}: {error.strerror}.") from None

    def release(self) -> None:
        """Release the lock of the folder."""
        self._lock.release()

    @classmethod
    def begin(
        cls, directory: FilePath, workspace: Workspace, state: State, *, overwrite: bool
    ) -> Self:
        """Lock a folder and write a whole campaign; an existing campaign is removed.

        Raises TrustboError if the folder is locked, or has a campaign and `overwrite` is False.
        """
        path = Path(directory)
        if not overwrite and any((path / name).exists() for name in (RECORD, MISSIONS)):
            raise TrustboError(
                f"{str(directory)!r} contains a campaign: continue it (Campaign.load, resume), "
                "give another folder, or replace it (overwrite)."
            )
        storage = cls(path)
        try:
            storage._write_campaign(workspace, state)
        except BaseException:
            storage.release()
            raise
        return storage

    def _write_campaign(self, workspace: Workspace, state: State) -> None:
        stored = {e.posterior.name: e.posterior for e in state.entries if e.posterior is not None}
        trees = {name: posterior() for name, posterior in stored.items()}  # read before deletion
        (self.path / RECORD).unlink(missing_ok=True)  # first, so that nothing partial is loaded
        for folder in (MISSIONS, POSTERIORS):
            for file in (self.path / folder).glob("*.nc"):
                file.unlink()
        write_tree(self.path / WORKSPACE, archive.workspace_to_tree(workspace))
        for n, entry in enumerate(state.entries, start=1):
            self.add_mission(n, entry)
        for name, tree in trees.items():
            self.add_posterior(name, tree)
        self.write_record(state)

    def add_mission(self, n: int, entry: Entry) -> None:
        """Write the measurements, plan and table row of mission n, counted from 1."""
        planned = xr.Dataset({"trust_map": entry.trust_map})
        planned.attrs = {"plan": to_json(plan_to_record(entry.plan)), "row": to_json(entry.row)}
        tree = missions_to_tree([entry.measured])
        tree["planned"] = xr.DataTree(planned)
        write_tree(self.locked() / MISSIONS / f"{n:04d}.nc", tree)

    def add_posterior(self, name: str, tree: xr.DataTree) -> Path:
        """Write the posterior draws of the parameters, and return the file."""
        file = self.locked() / POSTERIORS / f"{name}.nc"
        write_tree(file, tree)
        return file

    def write_record(self, state: State) -> None:
        """Write campaign.json; called last because it lists the completed missions."""
        record = {
            "settings": state.settings,
            "simulation": state.simulation,
            "asked": None if state.asked is None else plan_to_record(state.asked),
            "rows": [entry.row for entry in state.entries],
            "posteriors": [entry.posterior and entry.posterior.name for entry in state.entries],
            "failures": state.failures,
            "stop_reason": state.stop_reason,
            "versions": VERSIONS | {"numpy": np.__version__},
        }
        write_text(self.locked() / RECORD, to_json(record))

    def locked(self) -> Path:
        """Return the folder's path; raises TrustboError after `release`, when others may use it."""
        if not self._lock.is_locked:
            raise TrustboError(
                f"the campaign in {str(self.path)!r} was closed at the end of its `with` block; "
                "continue it with Campaign.load."
            )
        return self.path


def read_campaign(directory: FilePath) -> tuple[State, Workspace, list[Entry]]:
    """Read the state, the workspace, and the missions that are not in campaign.json yet.

    Raises TrustboError if the folder contains no campaign, or a file is missing or damaged.
    """
    folder = Path(directory)
    require_campaign(folder)
    content, tree = read_file(folder / RECORD), read_tree(folder / WORKSPACE)
    with interpreting(folder / WORKSPACE):
        workspace = archive.workspace_from_tree(tree)
    with interpreting(folder / RECORD):
        record = json.loads(content)
        asked = record["asked"] and plan_from_record(record["asked"], workspace)
        failures = [
            Failure(after, reason, tuple(map(tuple, path)), where and tuple(where))
            for after, reason, path, where in record["failures"]
        ]
        reason = str(record["stop_reason"])
        state = State(record["settings"], [], failures, asked, record["simulation"], reason)
        rows, names = list(record["rows"]), list(record["posteriors"])
    posteriors = {n: Posterior(n, file=folder / POSTERIORS / f"{n}.nc") for n in names if n}
    entries = []
    for n in itertools.count(1):
        file = folder / MISSIONS / f"{n:04d}.nc"
        if n > len(rows) and not file.exists():
            break
        tree = read_tree(file)
        with interpreting(file):
            [measured], planned = missions_from_tree(tree), tree["planned"].to_dataset()
            plan = plan_from_record(json.loads(planned.attrs["plan"]), workspace)
            learned, row = as_learned(measured, workspace), json.loads(planned.attrs["row"])
            entries.append(Entry(plan, measured, learned, planned["trust_map"], row))
    for entry, row, name in zip(entries, rows, names, strict=False):
        entry.row, entry.posterior = row, posteriors.get(name)
    state.entries = entries[: len(rows)]
    return state, workspace, entries[len(rows) :]


def require_campaign(directory: FilePath) -> None:
    """Raise TrustboError if a folder contains no campaign."""
    if not (Path(directory) / RECORD).exists():
        raise TrustboError(f"{str(directory)!r} contains no campaign; give another folder.")
