"""The file campaign.json: settings, rows of completed missions, failures, and hashes of files."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from trustbo.campaign.state import Failure, State
from trustbo.errors import TrustboError
from trustbo.files import FilePath, hash_of, interpreting, to_json
from trustbo.models.backend import VERSIONS
from trustbo.planning.plan import plan_from_record, plan_to_record
from trustbo.workspace import Workspace

RECORD = "campaign.json"
WORKSPACE = "workspace.nc"
DIFFICULTY = "difficulty.nc"
"""File of the difficulty of all bounds, if a plan has needed it."""
EARLIER = "earlier.nc"
"""File of the missions of earlier campaigns, if there are any."""
MISSIONS = "missions"
"""Folder of the missions in the folder of a campaign."""
POSTERIORS = "posteriors"
"""Folder of the posteriors in the folder of a campaign."""


def mission_file(n: int) -> str:
    """Return the path of mission n, counted from 1, in the folder of its campaign."""
    return f"{MISSIONS}/{n:04d}.nc"


def mission_files(folder: Path) -> list[Path]:
    """Return the files in a folder that are named like the missions of a campaign, in order."""
    numbered = {}
    for file in (folder / MISSIONS).glob("*.nc"):
        if file.stem.isdecimal() and file == folder / mission_file(int(file.stem)):
            numbered[int(file.stem)] = file
    return [numbered[n] for n in sorted(numbered)]


def posterior_file(name: str) -> str:
    """Return the path of a posterior in the folder of its campaign."""
    return f"{POSTERIORS}/{name}.nc"


def record_to_bytes(state: State, files: Mapping[str, str]) -> bytes:
    """Return the content of campaign.json.

    Args:
        state: State of the campaign.
        files: Hash of each other file of the campaign, keyed by its path in the folder.
    """
    record = {
        "versions": VERSIONS | {"numpy": np.__version__},
        "settings": state.settings,
        "simulation": state.simulation,
        "asked": None if state.asked is None else plan_to_record(state.asked),
        "rows": [entry.row for entry in state.entries],
        "posteriors": [entry.posterior and entry.posterior.name for entry in state.entries],
        "initial": state.initial and state.initial.name,
        "due": state.due,
        "failures": state.failures,
        "stop_reason": state.stop_reason,
        "files": files,
    }

    plain = json.loads(to_json(record))
    return to_json(plain | {"checksum": _checksum(plain)}).encode()


def record_from_bytes(content: bytes, path: FilePath) -> dict[str, Any]:
    """Read the content of campaign.json; `path` is named in messages.

    Raises:
        TrustboError: Another version of trustbo wrote it, or it is damaged.
    """
    with interpreting(path):
        record = dict(json.loads(content))
        versions = record.get("versions")
        written = versions.get("trustbo") if isinstance(versions, dict) else None

    if not isinstance(written, str) or _series(written) != _series(VERSIONS["trustbo"]):
        raise TrustboError(
            f"{str(path)!r} was written by trustbo {written or 'of an unknown version'}; this is "
            f"trustbo {VERSIONS['trustbo']}, which cannot read it. Use the version that wrote it."
        )

    checksum = record.pop("checksum", None)
    if checksum != _checksum(record):
        raise TrustboError(f"{str(path)!r} is damaged or was edited; restore it from a copy.")
    return record


def state_from_record(record: dict[str, Any], workspace: Workspace) -> State:
    """Restore the state of a campaign, without its missions."""
    failures = []
    for after, reason, path, where in record["failures"]:
        cells = tuple((row, col) for row, col in path)
        failures.append(Failure(after, reason, cells, None if where is None else tuple(where)))

    asked = record["asked"]
    return State(
        settings=record["settings"],
        failures=failures,
        asked=None if asked is None else plan_from_record(asked, workspace),
        simulation=record["simulation"],
        stop_reason=str(record["stop_reason"]),
        due=record["due"],
    )


def _series(version: str) -> list[str]:
    """Return the major and minor numbers; the format of the folder depends on no others."""
    return version.split(".")[:2]


def _checksum(record: Mapping[str, Any]) -> str:
    return hash_of(json.dumps(record, sort_keys=True).encode())
