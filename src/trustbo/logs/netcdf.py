"""Missions in netCDF files, stored as consecutive bounds with the ticks of the robots."""

import re
from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from trustbo.data import POST_SETS, Mission, Sighting, cells_of
from trustbo.display import joined
from trustbo.errors import TrustboError, warn
from trustbo.files import FilePath, interpreting, read_file, to_path, write_file
from trustbo.stacking import require_same_team

_ARRAYS = {"awareness": "1", "contact_rate": "1", "duration": "s", "n_ticks": "1"}
"""Arrays of a bound, (robot,) or (robot, feature), and their units."""
_NUMBERED = re.compile(r"[0-9]{4,}\.nc")
"""Names of the files of missions in the folder of a campaign."""
_TEXTS = ("status", "scale", "map")
"""Texts of a mission."""


def read_tree(path: FilePath, sha256: str = "") -> xr.DataTree:
    """Read a netCDF file of groups into memory.

    Raises:
        TrustboError: The file is missing or damaged, or `sha256` is given and is not its hash.
    """
    content = read_file(path, sha256)
    try:
        with xr.open_datatree(content, engine="netcdf4") as tree:
            return tree.load()
    except Exception:  # the library raises many types of errors for bad files
        raise TrustboError(f"{str(path)!r} is damaged or not a netCDF file.") from None


def write_tree(path: FilePath, tree: xr.DataTree) -> None:
    """Write a netCDF file of groups atomically; see `write_file`."""
    write_file(path, tree_to_bytes(tree))


def tree_to_bytes(tree: xr.DataTree) -> bytes:
    """Return the content of a netCDF file.

    It is made in memory, because the netCDF library keeps a file open if the disk is full.
    """
    encoding: dict[str, Any] = {}
    for group in tree.subtree:
        variables = group.to_dataset(inherit=False).variables
        encoding[group.path] = {
            name: {"zlib": True}  # such as draw numbers
            for name, variable in variables.items()
            if variable.ndim and variable.dtype.kind in "iu"
        }
    return bytes(tree.to_netcdf(engine="netcdf4", encoding=encoding))


def write_missions(path: FilePath, missions: Iterable[Mission]) -> None:
    """Write missions with the same robots and features to a netCDF file.

    The poses and contacts of bounds that have both are included.

    Example:
        >>> tb.logs.write_missions("missions.nc", result.missions)
    """
    write_tree(path, missions_to_tree(missions))


def read_missions(path: FilePath | Sequence[FilePath]) -> list[Mission]:
    """Read missions, as measured.

    Args:
        path: File, folder of a campaign, or a list of these, which are read in order. In a folder,
            files with other names than campaigns write, such as copies of sync programs, are left
            out with a warning.

    Raises:
        TrustboError: A file does not exist, is damaged, or contains no missions.

    Example:
        >>> missions = tb.logs.read_missions("missions.nc")
        >>> missions[0].status
        'ok'
    """
    paths: Any = path
    if isinstance(path, str | PathLike) or not isinstance(path, Sequence):
        paths = [path]
    files = []
    for place in map(to_path, paths):
        files += _files_of_missions(place) or [place]

    missions = []
    for file in files:
        tree = read_tree(file)
        with interpreting(file):
            missions += missions_from_tree(tree)
    return missions


def _files_of_missions(folder: Path) -> list[Path]:
    """Return the files of missions in the folder of a campaign; warn of files with other names."""
    found = sorted(folder.glob("missions/[!.]*.nc"))
    files = [file for file in found if _NUMBERED.fullmatch(file.name)]
    others = [file for file in found if file not in files]
    if others:
        warn(
            f"left out {joined([file.name for file in others])} in {str(others[0].parent)!r}, as "
            "missions have names such as '0001.nc'; give the paths of these files to read them."
        )
    return sorted(files, key=lambda file: int(file.stem))


def missions_to_tree(missions: Iterable[Mission]) -> xr.DataTree:
    """Convert missions to a tree; see `write_missions`.

    Raises:
        TrustboError: The robots or features differ between missions.
    """
    missions = require_same_team(missions)
    bounds = [bound for mission in missions for bound in mission.bounds]
    names = {"robot": list(missions[0].robots), "feature": list(missions[0].features)}

    # Ticks of the bounds that have both poses and contact.
    n_robots = len(names["robot"])
    none = np.empty((0, 1 + n_robots, 3)), np.empty((0, n_robots), dtype=bool)
    ticks = [(bound.poses, bound.contact) for bound in bounds]
    ticks = [
        none if poses is None or contact is None else (poses, contact) for poses, contact in ticks
    ]
    poses, contacts = zip(*ticks, strict=True)

    steps = [station for mission in missions for station in mission.stations]
    cells = cells_of(steps)
    variables: dict[str, Any] = {
        "path": (("step", "axis"), np.reshape(cells, (-1, 2)).astype(int)),
        "start": ("bound", [bound.t0 for bound in bounds], {"units": "s"}),
        "bound_status": ("bound", [bound.status for bound in bounds]),
        "recorded": ("bound", [len(of_bound) for of_bound in poses]),
        "pose": (("tick", "member", "component"), np.concatenate(poses)),
        "contact": (("tick", "robot"), np.concatenate(contacts)),
        "n_bounds": ("mission", [len(mission.bounds) for mission in missions]),
        "n_steps": ("mission", [len(mission.path) for mission in missions]),
    }

    for name, units in _ARRAYS.items():
        values = np.concatenate([getattr(mission, name) for mission in missions])
        dims = ("bound", "robot", "feature")[: values.ndim]
        variables[name] = (dims, values, {"units": units})
    if cells != steps:
        variables["posts"] = "step", [(*station, POST_SETS[0])[2] for station in steps]
    sightings = [(j, *s) for j, mission in enumerate(missions) for s in mission.sightings]
    if sightings:
        numbers, *columns = zip(*sightings, strict=True)
        variables["sighted_in"] = "sighting", [*numbers]
        variables |= {
            f"sighting_{name}": ("sighting", [*values])
            for name, values in zip(Sighting._fields, columns, strict=True)
        }
    variables["began"] = "mission", [mission.began for mission in missions], {"units": "s"}
    for name in _TEXTS:
        variables[name] = ("mission", [getattr(mission, name) for mission in missions])

    axes = {"axis": ["row", "col"], "component": ["x", "y", "heading"]}
    return xr.DataTree(xr.Dataset(variables, names | axes))


def missions_from_tree(tree: xr.DataTree) -> list[Mission]:
    """Invert `missions_to_tree`; raises LookupError or ValueError for a tree of another form."""
    table = {str(name): array.values for name, array in tree.to_dataset().variables.items()}

    def parts(values: Any, counts: str) -> list[Any]:
        ends = np.cumsum(table[counts]).tolist()
        return [values[end - n : end] for end, n in zip(ends, table[counts], strict=True)]

    def ticks(name: str) -> list[tuple[np.ndarray | None, ...]]:
        of_bounds = [values if len(values) else None for values in parts(table[name], "recorded")]
        return [tuple(of_mission) for of_mission in parts(of_bounds, "n_bounds")]

    steps = table["path"].tolist()
    if "posts" in table:
        steps = [(*cell, name) for cell, name in zip(steps, table["posts"].tolist(), strict=True)]

    columns = {name: parts(table[name], "n_bounds") for name in _ARRAYS}
    columns |= {
        "path": parts(steps, "n_steps"),
        "starts": parts(table["start"].tolist(), "n_bounds"),
        "bound_status": parts(table["bound_status"].tolist(), "n_bounds"),
        "poses": ticks("pose"),
        "contact": ticks("contact"),
    }
    table.setdefault("map", np.full(len(table["status"]), ""))  # not in files of version 0.5
    table.setdefault("began", np.full(len(table["status"]), np.nan))
    columns |= {name: table[name].tolist() for name in (*_TEXTS, "began")}
    names = {name: tuple(table[name].tolist()) for name in ("robot", "feature")}

    sightings: list[list[Sighting]] = [[] for _ in table["n_bounds"]]
    if "sighted_in" in table:
        values = (table[f"sighting_{name}"].tolist() for name in Sighting._fields)
        for j, *one in zip(table["sighted_in"].tolist(), *values, strict=True):
            sightings[j].append(Sighting(*one))
    columns["sightings"] = sightings
    return [
        Mission(
            robots=names["robot"],
            features=names["feature"],
            **{name: of_missions[j] for name, of_missions in columns.items()},
        )
        for j in range(len(table["n_bounds"]))
    ]
