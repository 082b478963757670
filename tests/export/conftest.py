"""One small result for all formats."""

import dataclasses

import numpy as np
import pytest

import trustbo as tb


@pytest.fixture(scope="session")
def result():
    """Of 3 rows and 4 columns, the north-western cell impassable, and robots that differ."""
    terrain = tb.terrain.synthetic_terrain((90.0, 120.0), seed=5, relief=6.0)
    workspace = tb.Workspace.from_terrain(terrain, (3, 4))
    passable = workspace.passable.copy()
    passable[0, 0] = False
    awareness = workspace.awareness * np.array([1.0, 0.8, 0.5])[:, None, None, None]
    workspace = dataclasses.replace(workspace, passable=passable, awareness=awareness)
    return tb.iterate(
        workspace, (2, 0), (0, 3), objective="terminal", n_iterations=2, sampler="exact", seed=3,
        progress=False,
    )  # fmt: skip


@pytest.fixture(scope="session")
def maps(result):
    return result.maps(n_draws=100)


@pytest.fixture(scope="session")
def nowhere(result):
    """The same without a terrain."""
    workspace, grid = result.workspace, dataclasses.replace(result.workspace.grid, crs=None)
    bare = dataclasses.replace(workspace, terrain=None, pixels=None, grid=grid)
    return dataclasses.replace(result, workspace=bare)
