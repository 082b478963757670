"""One small campaign for all figures."""

import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest

import trustbo as tb

mpl.use("Agg")


@pytest.fixture(scope="package")
def result():
    terrain = tb.terrain.synthetic_terrain((90.0, 120.0), seed=5, relief=6.0)
    workspace = tb.Workspace.from_terrain(terrain, (3, 4))
    return tb.iterate(
        workspace, (2, 0), (0, 3), n_iterations=2, sampler="exact", seed=1, progress=False
    )


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")
