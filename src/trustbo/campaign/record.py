"""The file campaign.json: settings, what users reported, posteriors, and hashes of all files."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from trustbo.campaign.closing import Closing
from trustbo.campaign.state import Entry, Exclusion, Failure, Posterior, State
from trustbo.errors import TrustboError
from trustbo.files import hash_of, interpreting, read_file, to_json
from trustbo.models.backend import VERSIONS
from trustbo.planning.plan import as_tuples, plan_from_record, plan_to_record
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


def require_no_missions_above(folder: Path, n_last: int, known: Mapping[str, str]) -> None:
    """Raise TrustboError for unknown files of missions above `n_last`, which would be taken over.

    Args:
        folder: Folder of a campaign.
        n_last: Number of the last mission that may have a file.
        known: Files of the campaign.
    """
    for file in sorted((folder / MISSIONS).glob("*.nc")):
        is_numbered = file.stem.isdecimal() and file == folder / mission_file(int(file.stem))
        if not is_numbered or int(file.stem) <= n_last or mission_file(int(file.stem)) in known:
            continue
        raise TrustboError(
            f"{str(file)!r} exists, but {RECORD} in this folder does not list it. Move it; or "
            f"restore the latest {RECORD}, if this one is an older copy; or give another folder."
        )


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
        "exclusions": [entry.exclusion for entry in state.entries],
        "after_missions": [entry.posterior and entry.posterior.name for entry in state.entries],
        "initial": state.initial and state.initial.name,
        "posteriors": {one.name: [one.used, one.diagnostics] for one in state.posteriors},
        "fitted": state.fitted,
        "why_not": state.why_not,
        "failures": state.failures,
        "closings": state.closings,
        "stop_reason": state.stop_reason,
        "files": files,
    }

    plain = json.loads(to_json(record))
    return to_json(plain | {"checksum": _checksum(plain)}).encode()


def read_record(path: Path) -> dict[str, Any]:
    """Read campaign.json.

    Raises:
        TrustboError: Another version of trustbo wrote it, or it is missing or damaged.
    """
    content = read_file(path)
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


def state_from_record(
    record: dict[str, Any], entries: Sequence[Entry], folder: Path, workspace: Workspace
) -> State:
    """Restore the state of a campaign, without earlier missions.

    Args:
        record: Content of campaign.json.
        entries: Missions without their exclusions and posteriors.
        folder: Folder of the campaign.
        workspace: Workspace of the campaign.
    """
    posteriors: dict[str | None, Posterior | None] = {None: None}
    for name, (used, diagnostics) in record["posteriors"].items():
        file = posterior_file(name)
        stored = folder / file, record["files"][file]
        posteriors[name] = Posterior(name, tuple(used), diagnostics, file=stored)

    complete = []
    of_entries = zip(entries, record["exclusions"], record["after_missions"], strict=True)
    for entry, excluded, name in of_entries:
        exclusion = None if excluded is None else Exclusion(*excluded)
        complete.append(replace(entry, exclusion=exclusion, posterior=posteriors[name]))

    failures = []
    for after, reason, path, where, withdrawn in record["failures"]:
        cells = tuple(map(tuple, path))
        cell = None if where is None else tuple(where)
        failures.append(Failure(after, reason, cells, cell, withdrawn))

    closings = []
    for where, *others in record["closings"]:
        closings.append(Closing(as_tuples(where), *others))

    asked = record["asked"]
    fitted = record["fitted"]
    return State(
        settings=record["settings"],
        entries=tuple(complete),
        failures=tuple(failures),
        closings=tuple(closings),
        asked=None if asked is None else plan_from_record(asked, workspace),
        simulation=record["simulation"],
        stop_reason=record["stop_reason"],
        fitted=None if fitted is None else tuple(fitted),
        why_not=record["why_not"],
        initial=posteriors[record["initial"]],
    )


def _series(version: str) -> list[str]:
    """Return the major and minor numbers; the format of the folder depends on no others."""
    return version.split(".")[:2]


def _checksum(record: Mapping[str, Any]) -> str:
    return hash_of(json.dumps(record, sort_keys=True).encode())
