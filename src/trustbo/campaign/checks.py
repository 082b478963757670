"""Checks of a mission or failure that is passed to a campaign, before any work starts."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from trustbo.data import Cell, Mission
from trustbo.errors import TrustboError, require_pair
from trustbo.hazard.exposures import CAUSES
from trustbo.workspace import Workspace
from trustbo.workspace.moves import require_on_grid

RESERVED = (
    "objective", "path_changed", "contact_rate", "status", "state", "reason", "path", "trust_map",
    "seconds_plan", "seconds_run", "seconds_fit", "n_bounds", "k_hat", "kish", "r_hat", "ess_bulk",
    "divergences", "iteration", "mission", "step", "axis", "robot", "row", "col", "x",
    "y",
)  # fmt: skip
"""Names of the history's columns and axes."""


def require_mission(mission: Mission, workspace: Workspace, asked: Sequence[Cell]) -> Mission:
    """Return a mission with its robots and features in the workspace's order.

    `asked` is the path that was asked for. See `Campaign.tell` for what is refused.
    """
    if not isinstance(mission, Mission):
        kind = type(mission).__name__
        raise TrustboError(f"tell takes one Mission at a time; got {kind}.")
    mission = workspace.in_order(mission)
    path = require_on_grid(mission.path, workspace.grid.shape)
    if path[0] != asked[0]:
        raise TrustboError(
            f"the mission starts at {path[0]}, not at {asked[0]}; cells are (row, col)."
        )
    return mission


def require_extra(extra: Mapping[str, Any]) -> dict[str, float]:
    """Return extra numbers of a mission as floats; NaN stands for a missing one.

    TrustboError: a value that is infinite or not a number, or a name that is reserved or no
    identifier, which files could not store.
    """
    checked = {}
    for name, value in extra.items():
        if name in RESERVED:
            raise TrustboError(f"{name!r} is a column of the history; give {value!r} another name.")
        if not name.isidentifier():
            raise TrustboError(f"{name!r} cannot name a column; use letters, digits and _.")
        try:
            number = math.inf if isinstance(value, bool | str) else float(value)
        except (TypeError, ValueError, OverflowError):
            number = math.inf
        if math.isinf(number):
            raise TrustboError(
                f"{name} must be a number, NaN where it is not known; got {value!r:.60}."
            )
        checked[name] = number
    return checked


def never_to_be_learned(filled: Mission) -> str:
    """Reason why nothing can ever be learned from a mission, or an empty string."""
    if not np.isfinite(filled.contact_rate).any():
        return "no contact rate was measured."
    if np.isnan(filled.awareness).any():
        k, i, m = np.argwhere(np.isnan(filled.awareness))[0]
        return (
            f"awareness of bound {k + 1}, robot {filled.robots[i]}, feature {filled.features[m]} "
            f"was not measured, and cell {filled.bounds[k].cell} has none in the map."
        )
    return ""


def require_reason(reason: object, mission: Mission | None) -> None:
    """Refuse an empty reason, or a cause of failures for a mission that arrived."""
    if not isinstance(reason, str) or not reason.strip():
        raise TrustboError(f"give a reason, such as one of {', '.join(CAUSES)}; got {reason!r}.")
    if reason in CAUSES and mission is not None and mission.status == "ok":
        raise TrustboError(
            f"the mission reached the goal, its status is 'ok', and {reason!r} is a failure; "
            "give the bounds that were run and their status, or tell the mission."
        )


def require_where(where: Cell, reason: str, path: Sequence[Cell]) -> Cell:
    """Return the cell that a mission failed to enter.

    TrustboError: The path does not enter it, or the reason is none of `CAUSES`.
    """
    cell = require_pair("where", where)
    if reason not in CAUSES:
        raise TrustboError(
            f"where = {cell} is for the reasons {', '.join(CAUSES)}, from which bounds are "
            f"learned; got {reason!r}."
        )
    if cell not in path[1:]:
        raise TrustboError(f"where must be a cell that the plan enters, {path}; got {cell}.")
    return cell
