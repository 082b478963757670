"""One small result for all formats."""

import copy
import dataclasses

import pytest
from worlds import unequal_robots

import trustbo as tb


@pytest.fixture(scope="session")
def result():
    """Of a workspace whose north-western cell is impassable."""
    workspace = unequal_robots(blocked=[(0, 0)])
    return tb.iterate(
        workspace, (2, 0), (0, 3), objective="terminal", n_iterations=2, seed=3,
        progress=False,
    )  # fmt: skip


@pytest.fixture(scope="session")
def maps(result):
    return result.maps(n_draws=100)


@pytest.fixture(scope="session")
def nowhere(result):
    """The same without a terrain."""
    workspace, grid = result.workspace, dataclasses.replace(result.workspace.grid, crs=None)
    bare = dataclasses.replace(workspace, terrain=None, pixels=None, posts=None, grid=grid)
    unplaced = copy.copy(result)
    unplaced.workspace = bare
    return unplaced
