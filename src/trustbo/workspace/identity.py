"""Identity of a workspace by its content, so that copies and files of it are recognised."""

import hashlib
from dataclasses import asdict

import numpy as np

from trustbo.data import THREAT
from trustbo.files import to_json
from trustbo.workspace.workspace import Workspace

_LENGTH = 16
"""Digits of the name of a map; two maps get the same name with probability 1e-19."""


def map_name(workspace: Workspace) -> str:
    """Return a name for the map of a workspace; maps with equal content have equal names.

    The content consists of the grid, the passable cells, the slope limit and the names of the
    features. With a terrain, the heights, the maps of the features and the model of sight are
    added; teams of different size therefore share a map. Without a terrain, the awareness is added.
    If robots stay at home, the map is that of the whole team.
    """
    workspace = workspace.whole
    settings = {
        "grid": asdict(workspace.grid),
        "features": workspace.features,
        "max_slope": workspace.team.max_slope,
        "sight": workspace.sight and asdict(workspace.sight),
    }
    arrays = {"passable": workspace.passable.values}
    if workspace.terrain is None or workspace.pixels is None:
        names = [name for name in workspace.features if name != THREAT]  # threats come and go
        arrays["awareness"] = workspace.awareness.sel(feature=names).values
    else:
        of_terrain = {"dem": workspace.terrain["dem"], "dsm": workspace.terrain["dsm"]}
        of_pixels = {name: workspace.pixels[name] for name in map(str, workspace.pixels)}
        arrays |= {name: array.values for name, array in (of_terrain | of_pixels).items()}

    digest = hashlib.sha256(to_json(settings).encode())
    for name in sorted(arrays):
        numbers = np.ascontiguousarray(arrays[name], dtype=float)
        digest.update(f"{name} {numbers.shape}".encode())
        digest.update(numbers.tobytes())
    return digest.hexdigest()[:_LENGTH]
