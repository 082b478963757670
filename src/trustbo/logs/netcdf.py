"""Missions as trees of arrays, for netCDF files."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from trustbo.data import Bound, Mission
from trustbo.errors import TrustboError

STATES = ("speed_ratio", "pitch", "roll", "return_range", "visible_share")
"""State of a robot at a tick: share of its speed on level ground; rad; rad; m; share of beams."""


def read_tree(path: Path) -> xr.DataTree:
    """Read a netCDF file of groups into memory.

    Raises:
        TrustboError: There is no such file.
    """
    if not path.exists():
        raise TrustboError(f"there is no file {str(path)!r}; was it saved by trustbo?")
    with xr.open_datatree(path, engine="netcdf4") as tree:
        return tree.load()


def missions_to_tree(missions: Sequence[Mission]) -> xr.DataTree:
    """Convert missions to arrays padded with NaN, and their ticks to one long table.

    Raises:
        TrustboError: States with another shape than (tick, robot, state).
    """
    n_steps = max(len(mission.path) for mission in missions)
    shape = (len(missions), n_steps - 1)
    robots, features = missions[0].robots, missions[0].features
    path = np.full((len(missions), n_steps, 2), -1)
    awareness = np.full((*shape, len(robots), len(features)), np.nan)
    rates, duration, n_ticks = (np.full((*shape, len(robots)), np.nan) for _ in range(3))
    start, status = np.full(shape, np.nan), np.full(shape, "", dtype=object)
    for j, mission in enumerate(missions):
        n = len(mission.bounds)
        path[j, : len(mission.path)] = mission.path
        awareness[j, :n], rates[j, :n] = mission.awareness, mission.contact_rate
        duration[j, :n], n_ticks[j, :n] = mission.duration, mission.n_ticks
        start[j, :n] = [bound.t0 for bound in mission.bounds]
        status[j, :n] = [bound.status for bound in mission.bounds]
    dims = ("mission", "bound", "robot")
    table = xr.Dataset(
        {
            "path": (("mission", "step", "axis"), path),
            "awareness": ((*dims, "feature"), awareness),
            "contact_rate": (dims, rates),
            "duration": (dims, duration, {"units": "s"}),
            "n_ticks": (dims, n_ticks, {"units": "1"}),
            "start": (dims[:2], start, {"units": "s"}),
            "bound_status": (dims[:2], status.astype(str)),
            "status": (dims[:1], [mission.status for mission in missions]),
            "n_bounds": (dims[:1], [len(mission.bounds) for mission in missions]),
        },
        {"robot": list(robots), "feature": list(features), "axis": ["row", "col"]},
    )
    return xr.DataTree.from_dict({"missions": table, "ticks": _ticks(missions)})


def missions_from_tree(tree: xr.DataTree) -> list[Mission]:
    """Convert a tree of `missions_to_tree` back."""
    table, ticks = tree["missions"].to_dataset(), tree["ticks"].to_dataset()
    if "exposure" in table:  # its name in version 0.1
        table = table.rename(exposure="n_ticks")
    robots, features = (tuple(str(n) for n in table[d].values) for d in ("robot", "feature"))
    missions = []
    for j in range(table.sizes["mission"]):
        one = table.isel(mission=j)
        path = tuple((int(r), int(c)) for r, c in one["path"].values if r >= 0)
        bounds = []
        for k in range(int(one["n_bounds"])):
            row = one.isel(bound=k)
            mine = (ticks["mission"].values == j) & (ticks["bound"].values == k)
            bounds.append(
                Bound(
                    path[k + 1],
                    row["awareness"].values,
                    row["contact_rate"].values,
                    row["duration"].values,
                    str(row["bound_status"].values),
                    float(row["start"]),
                    ticks["pose"].values[mine] if mine.any() else None,
                    ticks["contact"].values[mine].astype(bool) if mine.any() else None,
                    row["n_ticks"].values,
                    _states_of(ticks, mine),
                )
            )
        missions.append(Mission(path, tuple(bounds), str(one["status"].values), features, robots))
    return missions


def _ticks(missions: Sequence[Mission]) -> xr.Dataset:
    """Poses, contacts and states of all recorded ticks, concatenated."""
    recorded: list[tuple[int, int, Any]] = [
        (j, k, bound)
        for j, mission in enumerate(missions)
        for k, bound in enumerate(mission.bounds)
        if bound.poses is not None and bound.contact is not None
    ]
    n_robots = len(missions[0].robots)
    lengths = [len(bound.poses) for _, _, bound in recorded]
    # An empty table first: there may be no ticks at all.
    poses = [np.empty((0, 1 + n_robots, 3)), *(bound.poses for _, _, bound in recorded)]
    contacts = [np.empty((0, n_robots), bool), *(bound.contact for _, _, bound in recorded)]
    states = {}
    if any(bound.states is not None for _, _, bound in recorded):
        values = [_states(f"mission {j}, bound {k + 1}", bound) for j, k, bound in recorded]
        states["states"] = (("tick", "robot", "state"), np.concatenate(values))
    return xr.Dataset(
        {
            "mission": ("tick", np.repeat([j for j, _, _ in recorded], lengths).astype(int)),
            "bound": ("tick", np.repeat([k for _, k, _ in recorded], lengths).astype(int)),
            "pose": (("tick", "member", "component"), np.concatenate(poses)),
            "contact": (("tick", "robot"), np.concatenate(contacts)),
            **states,
        },
        {"component": ["x", "y", "heading"], **({"state": list(STATES)} if states else {})},
    )


def _states(where: str, bound: Any) -> np.ndarray:
    """States of a bound's ticks, NaN if not recorded."""
    shape = (*np.shape(bound.contact), len(STATES))
    if bound.states is None:
        return np.full(shape, np.nan)
    if np.shape(bound.states) != shape:
        raise TrustboError(
            f"{where}: states must be {shape}, (tick, robot, state), see logs.STATES; got "
            f"{np.shape(bound.states)}."
        )
    return bound.states


def _states_of(ticks: xr.Dataset, mine: np.ndarray) -> np.ndarray | None:
    """States of several ticks, (tick, robot, state); None if not recorded."""
    if "states" not in ticks or not mine.any():
        return None
    states = ticks["states"].values[mine]
    return None if np.isnan(states).all() else states
