"""Records of versions 0.1 and 0.2, converted to those of this version.

A campaign's folder is read by `damage.read_fields`, which converts each record here, so that no
other module of `campaign/` has a case for an older version.
"""

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from trustbo.errors import TrustboError

if TYPE_CHECKING:
    import xarray as xr

_PLANNING = {"max_failure": None, "failure_cost": None, "unseen_cost": 0.0}
"""Options of planning that versions 0.1, which had no failures, and 0.2 lack."""
_LEARNED = {"state": "learned", "reason": ""}
"""State of every mission of version 0.1, which had no other."""
_SIMULATORS = {"MujocoBackend": "MujocoSimulator", "ReplayBackend": "ReplaySimulator"}
"""Simulators by their names in version 0.1."""
_MOST = 10_000
"""Missions of a record of version 0.1 at most; a damaged one may count more."""
_RULES = {"Seconds": "TimeLimit"}
"""Rules to stop by their names in version 0.2."""


def migrate_state(record: dict[str, Any]) -> dict[str, Any]:
    """Convert the record of `campaign.json`."""
    options, notes = dict(record["options"]), record["notes"]
    if options.pop("update", "refit") != "refit":  # of version 0.2 and before
        raise TrustboError(
            'the campaign was run with update="moment_matched", which 0.2 was the last version to '
            "have: its result can be read, and its missions told to a new campaign."
        )
    if "replan" in notes:  # of version 0.1
        options.setdefault("replan", notes["replan"])
    # Version 0.2 had a weight of the tilt, where there is a margin of the limit now.
    hazard = {n: v for n, v in options.get("hazard", {}).items() if n != "log_tilt"}
    if "stop" in notes:
        rules = [r | {"rule": _RULES.get(r["rule"], r["rule"])} for r in notes["stop"]]
        notes = notes | {"stop": rules}
    return {
        **record,
        "options": options | {"hazard": hazard},
        "notes": notes,
        "rows": [row if "state" in row else row | _LEARNED for row in record["rows"]],
        "posterior_after": posterior_after(record),
        "failures": _failures(record),
    }


def migrate_result(record: dict[str, Any]) -> dict[str, Any]:
    """Convert the record of `result.json`."""
    return {
        **record,
        "settings": {**record["settings"], **_PLANNING, **record["settings"]},
        "posterior_after": posterior_after(record),
        "failures": _failures(record),
    }


def posterior_after(record: Mapping[str, Any]) -> list[int | None]:
    """Number of missions after which the posterior of each was fitted; one a mission in 0.1."""
    if "posterior_after" in record:
        return record["posterior_after"]
    return list(range(1, min(record["n_missions"], _MOST) + 1))


def extras_of(attributes: Mapping[Any, Any], n: int) -> list[dict[str, Any]]:
    """Numbers that were passed with each of `n` missions; version 0.1 stored none."""
    return json.loads(attributes.get("extra", json.dumps([{}] * n)))


def migrate_notes(notes: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    """Convert the notes of the simulator that a campaign was begun with.

    Version 0.1 recorded less: only its name, and lists by their lengths; the rest is taken from the
    notes of now, and cannot be compared. Version 0.2 had no events.
    """
    before = {n: _SIMULATORS.get(v, v) if isinstance(v, str) else v for n, v in notes.items()}
    if "stop" not in notes:
        before = {**now, **before}
    if "events" in now:
        before.setdefault("events", [])
    for name, value in now.items():
        if isinstance(value, list) and before.get(name) == len(value):
            before[name] = value
    return before


def is_whole(posterior: "xr.DataTree") -> bool:
    """Whether a posterior was written with all groups, as version 0.1 did."""
    return "missions" not in posterior.attrs


def _failures(record: Mapping[str, Any]) -> list[list[Any]]:
    """Failures with all fields of `Failure`; version 0.1 had the number and the reason alone."""
    rest = [], None, False
    return [[*failure, *rest[max(len(failure) - 2, 0) :]] for failure in record.get("failures", [])]
