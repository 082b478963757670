"""One small campaign for all figures."""

import dataclasses

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest

import trustbo as tb

mpl.use("Agg")


@pytest.fixture(scope="package")
def result():
    """Of robots that differ: were two of them mixed up, a figure would show it."""
    terrain = tb.terrain.synthetic_terrain((90.0, 120.0), seed=5, relief=6.0)
    workspace = tb.Workspace.from_terrain(terrain, (3, 4))
    awareness = workspace.awareness * np.array([1.0, 0.8, 0.5])[:, None, None, None]
    workspace = dataclasses.replace(workspace, awareness=awareness)
    return tb.iterate(
        workspace, (2, 0), (0, 3), n_iterations=2, sampler="exact", seed=1, progress=False
    )


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")
