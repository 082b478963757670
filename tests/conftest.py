"""What every test runs under."""

from pathlib import Path

import jax
import matplotlib as mpl
import pytest

mpl.use("Agg")
jax.config.update("jax_numpy_rank_promotion", "raise")

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture
def real_terrain():
    """Paths of a real DEM and DSM by name; skips where the shared data are absent."""

    def paths(name):
        if not DATA.exists():
            pytest.skip(f"no shared data at {DATA}")
        return DATA / name / "dem.tif", DATA / name / "dsm.tif"

    return paths
