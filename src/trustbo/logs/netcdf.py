"""Missions in netCDF files: a table of all missions, and the ticks of the robots."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from trustbo.data import NOWHERE, Bound, Mission
from trustbo.errors import TrustboError
from trustbo.files import FilePath, interpreting, read_file, write_file
from trustbo.stacking import require_same_team

STATES = ("speed_ratio", "pitch", "roll", "return_range", "visible_share")
"""State of a robot at a tick, see `data.Bound.states`."""


def read_tree(path: FilePath) -> xr.DataTree:
    """Read a netCDF file of groups into memory.

    Raises:
        TrustboError: The file does not exist, is damaged, or is not netCDF.
    """
    content = read_file(path)
    try:
        with xr.open_datatree(content, engine="netcdf4") as tree:
            return tree.load()
    except Exception:  # the library raises many kinds for bytes that are no netCDF
        raise TrustboError(f"{str(path)!r} is damaged, or no netCDF file.") from None


def write_tree(path: FilePath, tree: xr.DataTree) -> None:
    """Write a netCDF file of groups."""
    write_file(path, lambda file: tree.to_netcdf(file, engine="netcdf4"))


def write_missions(path: FilePath, missions: Sequence[Mission]) -> None:
    """Write at least one mission, with ticks, to a netCDF file."""
    write_tree(path, missions_to_tree(missions))


def read_missions(path: FilePath) -> list[Mission]:
    """Read missions, and their ticks, from a netCDF file or from the folder of a campaign.

    Args:
        path: File of missions, or folder of a campaign, whose missions are returned as measured.

    Raises:
        TrustboError: The file does not exist, is damaged, or contains no missions.
    """
    missions = []
    for file in sorted(Path(path).glob("missions/[0-9]*.nc")) or [path]:
        tree = read_tree(file)
        with interpreting(file):
            missions += missions_from_tree(tree)
    return missions


def missions_to_tree(missions: Sequence[Mission]) -> xr.DataTree:
    """Convert missions to a tree, padded with NaN, with ticks if they were recorded.

    TrustboError: the missions have different robots or features.
    """
    require_same_team(missions)
    n_steps = max(max(len(mission.path), len(mission.bounds) + 1) for mission in missions)
    shape = (len(missions), n_steps - 1)
    robots, features = missions[0].robots, missions[0].features
    path = np.full((len(missions), n_steps, 2), -1)
    awareness = np.full((*shape, len(robots), len(features)), np.nan)
    rates, duration, n_ticks = (np.full((*shape, len(robots)), np.nan) for _ in range(3))
    start, status = np.full(shape, np.nan), np.full(shape, "", dtype=object)
    for j, mission in enumerate(missions):
        n = len(mission.bounds)
        path[j, : len(mission.path)] = np.reshape(mission.path, (-1, 2))
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
            "scale": (dims[:1], [mission.scale for mission in missions]),
            "n_bounds": (dims[:1], [len(mission.bounds) for mission in missions]),
        },
        {"robot": list(robots), "feature": list(features), "axis": ["row", "col"]},
    )
    ticks = _ticks(missions)
    return xr.DataTree.from_dict({"missions": table} | ({} if ticks is None else {"ticks": ticks}))


def missions_from_tree(tree: xr.DataTree) -> list[Mission]:
    """Convert a tree of `missions_to_tree` back; LookupError or ValueError if it is not one."""
    table = {str(n): a.values for n, a in tree["missions"].to_dataset().variables.items()}
    robots, features = (tuple(map(str, table[d])) for d in ("robot", "feature"))
    ticks = _by_bound(tree["ticks"].to_dataset()) if "ticks" in tree.children else {}
    missions = []
    for j, n_bounds in enumerate(table["n_bounds"].tolist()):
        path = tuple((int(r), int(c)) for r, c in table["path"][j] if r >= 0)
        bounds = []
        for k in range(n_bounds):
            z, y, seconds, n = (
                table[name][j, k] for name in ("awareness", "contact_rate", "duration", "n_ticks")
            )
            status, t0 = str(table["bound_status"][j, k]), float(table["start"][j, k])
            poses, contact, states = ticks.get((j, k), (None, None, None))
            cell = path[k + 1] if path else NOWHERE
            bounds.append(Bound(cell, z, y, seconds, status, t0, poses, contact, n, states))
        status, scale = str(table["status"][j]), str(table["scale"][j])
        missions.append(Mission(path, tuple(bounds), status, features, robots, scale))
    return missions


def _ticks(missions: Sequence[Mission]) -> xr.Dataset | None:
    """Poses, contacts and states at the recorded ticks of all bounds; None if there are none."""
    rows: dict[str, list[Any]] = {"of": [], "pose": [], "contact": [], "states": []}
    for j, mission in enumerate(missions):
        for k, bound in enumerate(mission.bounds):
            if bound.poses is None or bound.contact is None:
                continue
            unknown = np.full((*bound.contact.shape, len(STATES)), np.nan)
            rows["of"].append(np.tile([j, k], (len(bound.poses), 1)))
            rows["pose"].append(bound.poses)
            rows["contact"].append(bound.contact)
            rows["states"].append(unknown if bound.states is None else bound.states)
    if not rows["of"]:
        return None
    of, pose, contact, states = (np.concatenate(values) for values in rows.values())
    variables = {
        "mission": ("tick", of[:, 0]),
        "bound": ("tick", of[:, 1]),
        "pose": (("tick", "member", "component"), pose),
        "contact": (("tick", "robot"), contact),
    }
    coords = {"component": ["x", "y", "heading"]}
    if not np.isnan(states).all():
        variables["states"] = (("tick", "robot", "state"), states)
        coords["state"] = list(STATES)
    return xr.Dataset(variables, coords)


def _by_bound(ticks: xr.Dataset) -> dict[tuple[int, int], tuple[Any, Any, Any]]:
    """Poses, contact and states (None if not recorded) of each mission and bound with ticks."""
    of = np.column_stack([ticks["mission"].values, ticks["bound"].values])
    unknown = np.full(len(of), np.nan)
    values = [of, ticks["pose"].values, ticks["contact"].values.astype(bool)]
    values.append(ticks["states"].values if "states" in ticks else unknown)
    edges = np.flatnonzero(np.diff(of, axis=0).any(axis=1)) + 1
    parts = zip(*(np.split(array, edges) for array in values), strict=True)
    return {
        tuple(key[0].tolist()): (pose, contact, None if np.isnan(states).all() else states)
        for key, pose, contact, states in parts
    }
