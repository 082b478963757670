"""Checks of a mission or failure that is passed to a campaign, before any work starts."""

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from trustbo.data import Cell, Mission, path_text
from trustbo.errors import TrustboError, require_pair
from trustbo.hazard.exposures import CAUSES
from trustbo.workspace import Workspace

RESERVED = (
    "objective", "path_changed", "contact_rate", "status", "state", "reason", "path", "trust_map",
    "seconds_plan", "seconds_run", "seconds_fit", "n_bounds", "k_hat", "kish", "r_hat", "ess_bulk",
    "divergences", "iteration", "mission", "step", "axis", "robot", "row", "col", "x",
    "y",
)  # fmt: skip
"""Names of the history's columns and axes."""


def require_mission(
    mission: Mission,
    workspace: Workspace,
    asked: Sequence[Cell],
    earlier: Iterable[Mission],
    *,
    other_path: bool,
) -> Mission:
    """Return a mission with its robots and features in the workspace's order.

    `asked` is the path that was asked for. See `Campaign.tell` for what is refused.
    """
    if not isinstance(mission, Mission):
        kind = type(mission).__name__
        raise TrustboError(f"tell takes one Mission at a time; got {kind}.")
    mission = workspace.in_order(mission)
    _require_path(mission, list(asked), workspace.grid.shape, other_path)
    for number, other in enumerate(earlier, start=1):
        if mission is other or _is_same(mission, other):
            raise TrustboError(
                f"this mission was told already: it is mission {number}, number by number. If it "
                "really was run again, tell(mission, again=True)."
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
    """Refuse a reason that is empty, a misspelt cause, or a cause for a mission that arrived."""
    if not isinstance(reason, str) or not reason.strip():
        raise TrustboError(f"give a reason, such as one of {', '.join(CAUSES)}; got {reason!r}.")
    if reason in CAUSES:
        if mission is not None and mission.status == "ok":
            raise TrustboError(
                f"the mission reached the goal, its status is 'ok', and {reason!r} is a failure; "
                "give the bounds that were run and their status, or tell the mission."
            )
        return
    plain = reason.strip().lower().replace(" ", "_")
    if near := difflib.get_close_matches(plain, CAUSES, n=1, cutoff=0.8):
        raise TrustboError(
            f"{reason!r} is no cause of failures, and teaches nothing; did you mean {near[0]!r}?"
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


def _require_path(
    mission: Mission, asked: Sequence[Cell], shape: tuple[int, int], other_path: bool
) -> None:
    path, (rows, cols) = list(mission.path), shape
    swapped = [(col, row) for row, col in path] == asked[: len(path)]
    maybe = "; were row and col swapped?" if swapped else "."
    for cell in path:
        if not (0 <= cell[0] < rows and 0 <= cell[1] < cols):
            raise TrustboError(
                f"the mission's path enters {cell}, outside the grid of {rows} rows and {cols} "
                f"columns{maybe}"
            )
    for before, after in pairwise(path):
        if max(abs(before[0] - after[0]), abs(before[1] - after[1])) > 1:
            raise TrustboError(
                f"the mission's path jumps from {before} to {after}, which are no neighbours; "
                "cells are (row, col), and every cell entered counts."
            )
    if path == asked or other_path or (mission.status != "ok" and path == asked[: len(path)]):
        return
    if not swapped and path[0] != asked[0]:
        maybe = f": it starts at {path[0]}, not at {asked[0]}."
    raise TrustboError(
        f"the mission followed {path_text(path)}, but {path_text(asked)} was asked for{maybe} If "
        "it really went there, tell(mission, other_path=True)."
    )


def _is_same(one: Mission, other: Mission) -> bool:
    """Whether two missions agree in every number, with a rate between 0 and 1 among them."""
    if one.path != other.path or one.status != other.status:
        return False
    names = ("awareness", "contact_rate", "duration", "n_ticks")
    if not all(np.array_equal(getattr(one, n), getattr(other, n), equal_nan=True) for n in names):
        return False
    if any(bound.poses is not None for bound in one.bounds):
        pairs = zip(one.bounds, other.bounds, strict=True)
        return all(np.array_equal(a.poses, b.poses) for a, b in pairs)  # pyright: ignore
    # Perfect contact of the same durations is common; rates in between, to the last bit, are not.
    return bool(((one.contact_rate > 0.0) & (one.contact_rate < 1.0)).any())
