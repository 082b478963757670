"""Overwatch maps of a path in a file, read with rasterio."""

from itertools import pairwise

import numpy as np
import pytest
import rasterio

from trustbo import Workspace
from trustbo.errors import TrustboError
from trustbo.export import write_overwatch
from trustbo.models import TrustParams
from trustbo.planning import Planner
from trustbo.terrain import synthetic_terrain


@pytest.fixture(scope="module")
def plan():
    terrain = synthetic_terrain((160.0, 160.0), seed=5, relief=8.0)
    workspace = Workspace.from_terrain(terrain, (4, 4))
    params = TrustParams(0.0, np.array([0.0, 0.0, 1.0]), 0.0, 0.05, 0.05)
    return Planner(workspace, (3, 0), (0, 3)).plan(params)


def test_a_band_for_each_bound_is_its_overwatch_map(plan, tmp_path):
    write_overwatch(tmp_path / "seen.tif", plan, robot="r2")
    with rasterio.open(tmp_path / "seen.tif") as raster:
        assert raster.crs == plan.workspace.terrain.rio.crs
        assert raster.count == len(plan.path) - 1
        for k, bound in enumerate(pairwise(plan.path), start=1):
            (a, b), (c, d) = bound
            assert raster.descriptions[k - 1] == f"bound {k}: {a},{b} {c},{d}"
            seen, band = plan.workspace.overwatch_map(bound, robot="r2"), raster.read(k)
            y, x = np.meshgrid(seen["y"], seen["x"], indexing="ij")
            rows, cols = rasterio.transform.rowcol(raster.transform, x.ravel(), y.ravel())
            np.testing.assert_array_equal(band[rows, cols], seen.values.ravel().astype(np.float32))
            assert np.isfinite(band).sum() == np.isfinite(seen.values).sum()


def test_without_a_terrain_there_is_none(tmp_path):
    flat = Workspace.from_awareness(np.full((2, 4, 4, 1), 0.5))
    plan = Planner(flat, (3, 0), (0, 3)).plan(TrustParams(0.0, np.ones(1), 0.0, 0.1, 0.1))
    with pytest.raises(TrustboError, match="only a workspace made from a terrain has a CRS"):
        write_overwatch(tmp_path / "seen.tif", plan)
    assert not (tmp_path / "seen.tif").exists()
