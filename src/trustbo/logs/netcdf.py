"""Missions as trees of arrays, for netCDF files."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from xarray.backends import NetCDF4DataStore
from xarray.conventions import encode_dataset_coordinates

from trustbo.data import NOWHERE, Bound, Mission
from trustbo.errors import DamagedFileError, TrustboError
from trustbo.files import (
    FilePath,
    interpreting,
    read_file,
    write_file,
)
from trustbo.stacking import require_same_team

STATES = ("speed_ratio", "pitch", "roll", "return_range", "visible_share")
"""State of a robot at a tick: share of its speed on level ground; rad; rad; m; share of beams."""
_TICKS = "ticks"


def read_tree(path: FilePath) -> xr.DataTree:
    """Read a netCDF file of groups into memory.

    Raises:
        DamagedFileError: There is no such file, it is damaged, or it is no netCDF.
    """
    content = read_file(path)
    try:
        with xr.open_datatree(content, engine="netcdf4") as tree:
            return tree.load()
    except Exception:  # the library raises many kinds for bytes that are no netCDF
        raise DamagedFileError(f"{str(path)!r} is damaged, or no netCDF file.") from None


def write_tree(path: FilePath, tree: xr.DataTree) -> None:
    """Write a netCDF file of groups."""
    content = _encode(tree)
    write_file(path, lambda file: file.write_bytes(content))


def _encode(tree: xr.DataTree) -> bytes:
    """Return a file with the content of `tree.to_netcdf()`, in half the time.

    All variables are defined before the first is filled: the library flushes the file whenever
    definitions follow data, which in xarray's order they do at every variable.
    """
    import netCDF4  # loaded only where netCDF is written

    data, arrays = netCDF4.Dataset("a file", "w", memory=0), _Arrays()
    root = NetCDF4DataStore(data)
    for node in tree.subtree:
        store = root if node is tree else root.get_child_store(node.path)
        encoded = encode_dataset_coordinates(node.to_dataset(inherit=node is tree))
        store.store(*encoded, writer=arrays)
    for values, target in arrays:
        target[...] = values
    with root.lock:
        return bytes(data.close())


class _Arrays(list[tuple[Any, Any]]):
    """Arrays to write and their targets, in place of xarray's writer, which writes at once."""

    def add(self, source: Any, target: Any, region: None = None) -> None:
        self.append((source, target))


def write_missions(
    path: FilePath,
    missions: Sequence[Mission],
) -> None:
    """Write missions to a netCDF file, and the ticks of each to a file in a folder next to it.

    The folder is named after the file.

    Args:
        path: File of all missions.
        missions: Missions, at least one.

    TrustboError: states with another shape than (tick, robot, state).
    """
    for j in range(len(missions)):
        file, recorded = ticks_file(path, _ticks_name(path), j), _ticks(missions[j])
        if recorded is None:
            file.unlink(missing_ok=True)
        else:
            write_tree(file, xr.DataTree(recorded))
    table = _table(missions).assign_attrs({_TICKS: _ticks_name(path)})
    write_tree(path, xr.DataTree.from_dict({"missions": table}))


def mission_to_tree(mission: Mission) -> xr.DataTree:
    """Tree of one mission, with its ticks if they were recorded."""
    groups = {"mission": _table([mission])}
    if (recorded := _ticks(mission)) is not None:
        groups[_TICKS] = recorded
    return xr.DataTree.from_dict(groups)


def mission_from_tree(tree: xr.DataTree) -> Mission:
    """Mission of a tree of `mission_to_tree`; LookupError or ValueError if it is none."""
    table = {str(n): a.values for n, a in tree["mission"].to_dataset().variables.items()}
    return _mission(table, 0, tree[_TICKS].to_dataset() if _TICKS in tree.children else None)


def ticks_file(path: FilePath, folder: str, j: int) -> Path:
    """Name of the file with the ticks of mission j, from 0, in a folder next to the missions'."""
    return Path(path).parent / Path(folder).name / f"{j + 1:04d}.nc"


def _ticks_name(path: FilePath) -> str:
    """Name of the folder of ticks."""
    return f"{Path(path).stem}.{_TICKS}"


def read_missions(path: FilePath) -> list[Mission]:
    """Read missions, and their ticks, from a netCDF file or from the folder of a campaign.

    Args:
        path: File of missions, with the folder of their ticks next to it if they have some; or
            folder of a campaign, whose missions are as measured.

    Raises:
        DamagedFileError: There is no such file, it is damaged, or it holds no missions.
    """
    if files := sorted(Path(path).glob("missions/[0-9]*.nc")):
        missions = []
        for file in files:
            tree = read_tree(file)
            with interpreting(file):
                missions.append(mission_from_tree(tree))
        return missions
    return missions_of_tree(read_tree(path), path)


def missions_of_tree(tree: xr.DataTree, path: FilePath) -> list[Mission]:
    """Missions of a tree that was read from a file, see `read_missions`."""
    with interpreting(path):
        try:
            kept = tree["missions"].to_dataset()
            table = {str(n): a.values for n, a in kept.variables.items()}
            folder = str(kept.attrs[_TICKS])
            missions = []
            for j in range(len(table["status"])):
                file = ticks_file(path, folder, j)
                ticks = read_tree(file).to_dataset() if file.exists() else None
                missions.append(_mission(table, j, ticks))
            return missions
        except KeyError as error:
            raise DamagedFileError(f"{str(path)!r} holds no missions: it lacks {error}.") from None


def _table(missions: Sequence[Mission]) -> xr.Dataset:
    """Arrays of missions, padded with NaN; TrustboError if robots or features differ."""
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
    own: dict[str, Any] = {}
    if any(mission.scale for mission in missions):
        own["scale"] = (dims[:1], [mission.scale for mission in missions])
    return xr.Dataset(
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
            **own,
        },
        {"robot": list(robots), "feature": list(features), "axis": ["row", "col"]},
    )


def _mission(table: dict[str, np.ndarray], j: int, ticks: xr.Dataset | None) -> Mission:
    """Mission j of a table, with the ticks of its bounds if they were recorded."""
    robots, features = (tuple(map(str, table[d])) for d in ("robot", "feature"))
    path = tuple((int(r), int(c)) for r, c in table["path"][j] if r >= 0)
    bounds = []
    for k in range(int(table["n_bounds"][j])):
        z, y, seconds, n = (
            table[name][j, k] for name in ("awareness", "contact_rate", "duration", "n_ticks")
        )
        status, t0 = str(table["bound_status"][j, k]), float(table["start"][j, k])
        poses, contact, states = _ticks_of(ticks, k)
        cell = path[k + 1] if path else NOWHERE
        bounds.append(Bound(cell, z, y, seconds, status, t0, poses, contact, n, states))
    status, scale = str(table["status"][j]), str(table["scale"][j]) if "scale" in table else ""
    return Mission(path, tuple(bounds), status, features, robots, scale)


def _ticks_of(ticks: xr.Dataset | None, k: int) -> tuple[np.ndarray | None, ...]:
    """Poses, contact and states of bound k; None if not recorded."""
    if ticks is None or not (mine := ticks["bound"].values == k).any():
        return None, None, None
    states = ticks["states"].values[mine] if "states" in ticks else None
    if states is not None and np.isnan(states).all():
        states = None
    return ticks["pose"].values[mine], ticks["contact"].values[mine].astype(bool), states


def _ticks(mission: Mission) -> xr.Dataset | None:
    """Poses, contacts and states of a mission's recorded ticks, concatenated; None if none are."""
    recorded: list[tuple[int, Any]] = [
        (k, bound)
        for k, bound in enumerate(mission.bounds)
        if bound.poses is not None and bound.contact is not None
    ]
    if not recorded:
        return None
    lengths = [len(bound.poses) for _, bound in recorded]
    states = {}
    if any(bound.states is not None for _, bound in recorded):
        values = [_states(f"bound {k + 1}", bound) for k, bound in recorded]
        states["states"] = (("tick", "robot", "state"), np.concatenate(values))
    return xr.Dataset(
        {
            "bound": ("tick", np.repeat([k for k, _ in recorded], lengths).astype(int)),
            "pose": (
                ("tick", "member", "component"),
                np.concatenate([b.poses for _, b in recorded]),
            ),
            "contact": (("tick", "robot"), np.concatenate([b.contact for _, b in recorded])),
            **states,
        },
        {"component": ["x", "y", "heading"], **({"state": list(STATES)} if states else {})},
    )


def _states(where: str, bound: Any) -> np.ndarray:
    """States of a bound's ticks, NaN if not recorded."""
    shape = (*np.shape(bound.contact), len(STATES))
    states = np.full(shape, np.nan) if bound.states is None else bound.states
    if np.shape(states) != shape:
        raise TrustboError(
            f"{where}: states must be {shape}, (tick, robot, state), see Bound.states; got "
            f"{np.shape(states)}."
        )
    return states
