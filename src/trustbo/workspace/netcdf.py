"""Conversion of workspaces to and from data trees, for storage in files."""

import json
from dataclasses import asdict

import numpy as np
import xarray as xr

from trustbo.files import to_json
from trustbo.team import Robot, Team
from trustbo.terrain import CompositeIndex
from trustbo.workspace.difficulty import Difficulty, Measured
from trustbo.workspace.grid import Grid
from trustbo.workspace.moves import MOVES, next_names, way_names
from trustbo.workspace.posts import TRAVERSABLE, Posts
from trustbo.workspace.sight import Sight
from trustbo.workspace.surface import surface_of
from trustbo.workspace.workspace import Workspace


def workspace_to_tree(workspace: Workspace) -> xr.DataTree:
    """Convert a workspace to a data tree.

    Attributes of the terrain that netCDF cannot store become JSON. If robots stay at home, the tree
    has the workspace of the whole team and the names of the others.
    """
    robots = workspace.team.names
    workspace = workspace.whole
    cells = xr.Dataset({"awareness": workspace.awareness, "passable": workspace.passable})
    if workspace.onward is not None:
        cells["onward"] = workspace.onward
    tree = {"cells": cells}
    tree |= {f"composites/{n}": index.fitted for n, index in workspace.composites.items()}

    if workspace.terrain is not None and workspace.pixels is not None:
        pixels = workspace.pixels.drop_vars("spatial_ref", errors="ignore")  # in the terrain
        terrain = workspace.terrain.copy()
        terrain.attrs = {
            name: value if _is_storable(value) else to_json(value)
            for name, value in terrain.attrs.items()
        }
        tree |= {"terrain": terrain, "pixels": pixels}

    result = xr.DataTree.from_dict(tree)
    result.attrs = {
        "grid": to_json(asdict(workspace.grid)),
        "team": to_json(asdict(workspace.team)),
        "sight": to_json(workspace.sight and asdict(workspace.sight)),
        "places": to_json(workspace.places),
        "closed": to_json([*workspace.closed.items()]),
    }
    if robots != workspace.team.names:
        result.attrs["robots"] = to_json(robots)
    return result


def workspace_from_tree(tree: xr.DataTree) -> Workspace:
    """Restore a workspace from a data tree made by `workspace_to_tree`."""
    cells = tree["cells"].to_dataset()
    grid = json.loads(tree.attrs["grid"])
    team = json.loads(tree.attrs["team"])

    grid = Grid(**grid | {"shape": tuple(grid["shape"])})
    team = Team(
        robots=tuple(Robot(**robot) for robot in team["robots"]),
        lead=Robot(**team["lead"]),
        names=tuple(team["names"]),
    )

    terrain = pixels = posts = None
    if "terrain" in tree:
        terrain = tree["terrain"].to_dataset().set_coords("spatial_ref")
        for array in terrain.data_vars.values():  # rioxarray reads the encoding
            if "grid_mapping" in array.attrs:
                array.encoding["grid_mapping"] = array.attrs.pop("grid_mapping")

        pixels = tree["pixels"].to_dataset().assign_coords(spatial_ref=terrain["spatial_ref"])

        surface = surface_of(terrain)._replace(passable=pixels["passable"].values.astype(bool))
        sight = Sight(**json.loads(tree.attrs["sight"]))
        traversability = pixels[TRAVERSABLE].values if TRAVERSABLE in pixels else None
        posts = Posts(grid, team, sight, surface, traversability)

    nodes = tree["composites"].children if "composites" in tree else {}
    composites = {
        name: CompositeIndex(node["sign"].to_series().to_dict(), node.to_dataset())
        for name, node in nodes.items()
    }

    maps = cells["awareness"], cells["passable"]
    onward = cells.get("onward")
    places = json.loads(tree.attrs.get("places", "{}"))
    closed = json.loads(tree.attrs.get("closed", "[]"))
    workspace = Workspace(
        *maps, grid, team, terrain, pixels, composites, posts, onward,
        places={name: tuple(position) for name, position in places.items()},
        closed={tuple(map(tuple, cells)): reason for cells, reason in closed},
    )  # fmt: skip
    robots = tree.attrs.get("robots")
    return workspace if robots is None else workspace.of_robots(json.loads(robots))


def difficulty_to_tree(difficulty: Difficulty) -> xr.DataTree:
    """Convert the difficulty of all bounds to a data tree."""
    values, unit = difficulty.whole()
    bounds = "move", "row", "col", "next_move"
    n_posts = len(unit) // len(MOVES)
    names = {"move": way_names(n_posts), "next_move": next_names(n_posts)}
    maps = {"difficulty": ((*bounds, "measure"), values), "unit": (bounds, unit.astype(np.int8))}
    return xr.DataTree(xr.Dataset(maps, names | {"measure": list(difficulty.measures)}))


def restore_difficulty(workspace: Workspace, tree: xr.DataTree) -> None:
    """Give a workspace its difficulty, from a tree made by `difficulty_to_tree`."""
    maps = tree.to_dataset()
    measured = Measured(maps["difficulty"].values, maps["unit"].values.astype(int))
    workspace.difficulty.restore(measured)


def _is_storable(value: object) -> bool:
    """Return whether netCDF can store an attribute: text, numbers, or a list of either."""
    try:
        array = np.asarray(value)
    except ValueError:  # lists of different lengths
        return False
    return array.ndim <= 1 and array.dtype.kind in "iufU"
