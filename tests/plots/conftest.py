"""One small campaign for all figures."""

import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest
from worlds import unequal_robots

import trustbo as tb

mpl.use("Agg")


@pytest.fixture(scope="package")
def result():
    return tb.iterate(
        unequal_robots(), (2, 0), (0, 3), n_iterations=2, sampler="exact", seed=1, progress=False
    )


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")
