"""A result's own planner, plan and maps are the campaign's."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import rasterio
from scipy.special import expit
from worlds import hillside

import trustbo as tb

AWARENESS = np.random.default_rng(3).uniform(size=(2, 4, 4, 2))
PASSABLE = np.ones((4, 4), bool)
PASSABLE[1, 1] = False


@pytest.fixture(scope="module", params=["terminal", "success", "mean"])
def result(request):
    workspace = tb.Workspace.from_awareness(AWARENESS, PASSABLE)
    truth = tb.models.TrustParams(0.4, np.array([0.5, 0.2]), 0.1, 0.05, 0.05)
    return tb.iterate(
        workspace,
        (3, 0),
        (0, 3),
        n_iterations=2,
        objective=request.param,
        sampler="exact",
        simulator=tb.simulation.ModelSimulator(workspace, truth),
        progress=False,
    )


def test_its_plan_is_the_recommended_path(result):
    plan = result.plan
    assert list(plan.path) == result.path
    assert plan.exact
    np.testing.assert_allclose(plan.value, result.value, rtol=1e-12)
    np.testing.assert_allclose(plan.trust, result.trust, rtol=1e-12)
    assert (plan.bands[0] < plan.bands[-1]).all()


def test_its_planner_gives_its_trust_map(result):
    mean = tb.inference.params_of(result.posterior).mean()
    np.testing.assert_allclose(result.planner.trust_map(mean), result.trust_map, rtol=1e-12)


def test_its_maps_are_over_the_posterior(result):
    maps = result.maps(n_draws=300)
    assert list(maps) == [
        "trust_mean", "trust_sd", "cost", "traversability", "visibility", "path_probability",
        "place_mean", "place_sd", "place_bounds_mean",
    ]  # fmt: skip
    places = tb.inference.place_maps(result.posterior)
    np.testing.assert_array_equal(maps["place_sd"], places["place_sd"].where(PASSABLE))
    into = places["place_bound_mean"][:, 3, 0].sel(move=["sw", "w", "s"])  # a corner
    np.testing.assert_allclose(maps["place_bounds_mean"][3, 0], into.mean())
    assert all(np.isnan(maps[name][1, 1]) for name in maps)
    share = maps["path_probability"]
    assert share[3, 0] == share[0, 3] == 1.0
    # The mean cost and the cost of the mean differ by little, as sigma bends little: its second
    # derivative is at most .1, and the sd of trust with effects of robots some .4.
    np.testing.assert_allclose(maps["cost"], 1.0 - expit(maps["trust_mean"]), atol=1e-2)
    assert result.maps(n_draws=300).identical(maps)
    known = result.workspace.awareness
    expected = np.where(PASSABLE, known.sel(feature="visibility").mean("robot"), np.nan)
    np.testing.assert_allclose(maps["visibility"], expected)


def test_its_table_has_a_row_for_each_mission(result, tmp_path):
    table = result.table()
    assert len(table) == len(result.missions) == table.index[-1]
    assert (table.index.name, *table.columns[:2]) == ("mission", "status", "state")
    for number, mission in enumerate(result.missions, start=1):
        row = table.loc[number]
        assert row["path"].split() == [f"{r},{c}" for r, c in mission.path]
        assert row["n_bounds"] == len(mission.bounds)
        assert row["contact_rate"] == np.nanmean(mission.contact_rate)
        assert row["objective"] == float(result.history["objective"].sel(iteration=number))
    assert {"k_hat", "seconds_fit"} <= set(table)
    result.save(tmp_path)
    kept = pd.read_csv(tmp_path / "history.csv", index_col="mission", keep_default_na=False)
    pd.testing.assert_frame_equal(kept, table, check_dtype=False)


def test_maps_on_terrain_are_rasters_of_their_place(tmp_path):
    terrain = hillside(90.0, 120.0)
    workspace = tb.Workspace.from_terrain(terrain, (3, 4))
    options = {"n_iterations": 1, "sampler": "exact", "progress": False}
    maps = tb.iterate(workspace, (2, 0), (0, 3), **options).maps(n_draws=20)
    assert maps.rio.crs == terrain.rio.crs
    assert maps["cost"].rio.bounds() == terrain.rio.bounds()
    maps["cost"].rio.to_raster(tmp_path / "cost.tif")
    with rasterio.open(tmp_path / "cost.tif") as raster:
        assert raster.crs == terrain.rio.crs
        x, y = workspace.grid.center((1, 2))
        assert next(raster.sample([(x, y)])).item() == float(maps["cost"][1, 2])
        assert maps["cost"].sel(x=x, y=y) == maps["cost"].isel(y=1, x=2)
    assert maps["cost"].rio.reproject("EPSG:4326").rio.crs == "EPSG:4326"


def test_a_loaded_result_plans_alike(result, tmp_path):
    result.save(tmp_path)
    loaded = tb.load_result(tmp_path)
    assert loaded.plan.path == result.plan.path
    np.testing.assert_array_equal(loaded.plan.bands, result.plan.bands)
    assert loaded.plan.value_band == result.plan.value_band
    assert loaded.maps(n_draws=50).equals(result.maps(n_draws=50))


def test_features_that_are_called_as_maps_are_told_apart(tmp_path):
    workspace = tb.Workspace.from_awareness(AWARENESS, features=("cost", "x"))
    truth = tb.models.TrustParams(0.4, np.array([0.5, 0.2]), 0.1, 0.05, 0.05)
    result = tb.iterate(
        workspace,
        (3, 0),
        (0, 3),
        n_iterations=1,
        sampler="exact",
        simulator=tb.simulation.ModelSimulator(workspace, truth),
        progress=False,
    )
    maps = result.maps(n_draws=20)
    np.testing.assert_allclose(maps["awareness_cost"], AWARENESS[..., 0].mean(0))
    np.testing.assert_allclose(maps["awareness_x"], AWARENESS[..., 1].mean(0))
    np.testing.assert_allclose(maps["cost"], 1.0 - expit(maps["trust_mean"]), atol=5e-2)


def test_a_damaged_result_is_refused(result, tmp_path):
    result.save(tmp_path)
    whole = (tmp_path / "result.json").read_text()
    (tmp_path / "result.json").write_text(whole[:40])
    with pytest.raises(tb.TrustboError, match=r"result\.json' is damaged"):
        tb.load_result(tmp_path)


def test_settings_that_lack_something_are_named(result):
    some = {name: value for name, value in result.settings.items() if name != "team"}
    with pytest.raises(tb.TrustboError, match="the result's settings lack team"):
        _ = replace(result, settings=some).planner
