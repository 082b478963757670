"""Files for GIS and tables, read back by other programs."""

import csv
import dataclasses
import json
import warnings

import numpy as np
import pytest
import rasterio
import shapely
from disks import full_disk
from rasterio.warp import transform
from worlds import unequal_robots

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.export import WRITERS, export_result, write_csv, write_geojson, write_geotiff
from trustbo.export.gis import cut_at_180


def test_bands_of_a_geotiff_are_the_maps_in_their_place(result, maps, tmp_path):
    write_geotiff(tmp_path / "größe.tif", maps)
    with rasterio.open(tmp_path / "größe.tif") as raster:
        assert raster.descriptions == tuple(maps)
        assert raster.crs == result.workspace.grid.require_crs()
        np.testing.assert_allclose(raster.read(1), maps["trust_mean"], rtol=1e-6)
        for cell in ((0, 1), (2, 3)):
            assert raster.index(*result.workspace.grid.center(cell)) == cell


CHANGED = {
    "coarsened": lambda maps: maps.coarsen(x=2).mean(),
    "thinned": lambda maps: maps.isel(x=slice(None, None, 2)),
    "picked": lambda maps: maps.isel(y=[0, 2], x=[1, 3]),
    "cut": lambda maps: maps.isel(y=slice(1, 3), x=slice(2, 4)),
    "reversed": lambda maps: maps.isel(y=slice(None, None, -1), x=slice(None, None, -1)),
    "shuffled": lambda maps: maps.isel(x=[2, 0, 3, 1]),
    "transposed": lambda maps: maps.transpose("x", "y"),
    "one row": lambda maps: maps.isel(y=[1]),
    "one column": lambda maps: maps.isel(x=[2], y=slice(0, 2)),
    "one cell": lambda maps: maps.isel(x=[2], y=[1]),
    "moved": lambda maps: maps.assign_coords(x=maps["x"] + 1000.0),
}


@pytest.mark.parametrize("change", CHANGED.values(), ids=CHANGED)
def test_a_geotiff_has_each_value_at_its_own_coordinates(change, maps, tmp_path):
    changed = change(maps)
    write_geotiff(tmp_path / "maps.tif", changed)
    with rasterio.open(tmp_path / "maps.tif") as raster:
        assert raster.transform.a > 0.0 > raster.transform.e
        assert raster.shape == (changed.sizes["y"], changed.sizes["x"])
        for x in changed["x"].values:
            for y in changed["y"].values:
                expected = changed["trust_mean"].sel(x=x, y=y).item()
                np.testing.assert_allclose(*next(raster.sample([(x, y)], 1)), expected, rtol=1e-6)
                np.testing.assert_allclose(raster.xy(*raster.index(x, y)), (x, y), atol=1e-6)


REFUSED = {
    "uneven": lambda maps: maps.isel(x=[0, 1, 3]),
    "repeated": lambda maps: maps.isel(y=[1, 1]),
    "without coordinates": lambda maps: maps.drop_vars("y"),
    "of rows": lambda maps: maps.rename(y="row", x="col"),
    "of texts": lambda maps: maps.assign_coords(x=list("abcd")),
    "with a missing coordinate": lambda maps: maps.assign_coords(y=[np.nan, 1.0, 0.0]),
    "empty": lambda maps: maps.isel(x=slice(0, 0)),
    "averaged to a column": lambda maps: maps.coarsen(x=4, y=2, boundary="trim").mean(),
    "of one row": lambda maps: maps.isel(y=0),
    "with a text": lambda maps: maps.assign(note="tuesday"),
    "of names": lambda maps: maps.assign(kind=maps["cost"].astype(str)),
    "of no variables": lambda maps: maps[[]],
}


@pytest.mark.parametrize("change", REFUSED.values(), ids=REFUSED)
def test_maps_without_a_place_of_their_own_are_refused(change, maps, tmp_path):
    with pytest.raises(TrustboError):
        write_geotiff(tmp_path / "maps.tif", change(maps))
    assert not list(tmp_path.iterdir())


def test_maps_of_robots_are_bands_named_by_quantity_and_robot(result, maps, tmp_path):
    robots = result.robot_maps()
    write_geotiff(tmp_path / "robots.tif", robots.assign(cost=maps["cost"]))
    with rasterio.open(tmp_path / "robots.tif") as raster:
        assert raster.descriptions[:2] == ("trust_mean r1", "trust_mean r2")
        for i, band in enumerate(raster.descriptions, start=1):
            name, *robot = band.split()
            expected = robots[name].sel(robot=robot[0]) if robot else maps[name]
            np.testing.assert_allclose(raster.read(i), expected, rtol=1e-6)


@pytest.mark.parametrize("format_", [name for name, (file, _) in WRITERS.items() if "." in file])
def test_a_full_disk_leaves_the_file_as_it_was(format_, result, tmp_path):
    [file] = export_result(result, tmp_path, [format_])
    before = file.read_bytes()
    with full_disk(), pytest.raises(TrustboError, match=file.name):
        export_result(result, tmp_path, [format_])
    assert file.read_bytes() == before
    assert list(tmp_path.iterdir()) == [file]


def make_side_files(raster):
    """Let GDAL store statistics, overviews, a mask and their statistics beside a raster."""
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=False, TIFF_USE_OVR=True):
        with rasterio.open(raster, "r+") as opened:
            if opened.driver == "GTiff":
                opened.write_mask(np.ones(opened.shape, dtype=bool))
            opened.build_overviews([2])

        for name in (raster, *raster.parent.glob(f"{raster.name}.*")):
            quiet = warnings.catch_warnings(action="ignore")  # `stats` does not store them
            with quiet, rasterio.open(name) as opened:
                opened.statistics(1, approx=False, clear_cache=True)


@pytest.mark.parametrize("format_", ["geotiff", "nav2"])
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_a_raster_that_is_written_again_has_no_side_files_of_the_old_one(format_, result, tmp_path):
    export_result(result, tmp_path, [format_])
    before = set(tmp_path.rglob("*"))
    [raster] = (file for file in before if file.suffix in (".tif", ".pgm"))
    make_side_files(raster)
    made = {file.name.removeprefix(raster.name) for file in set(tmp_path.rglob("*")) - before}
    assert {".aux.xml", ".ovr", ".ovr.aux.xml"} <= made

    raster.unlink()  # GDAL would leave the side files of a missing raster
    export_result(result, tmp_path, [format_])
    assert set(tmp_path.rglob("*")) == before

    make_side_files(raster)
    export_result(result, tmp_path, [format_])
    assert set(tmp_path.rglob("*")) == before
    with rasterio.open(raster) as opened:
        assert len(opened.files) == 1


def test_side_files_beside_a_link_to_a_raster_are_removed(maps, tmp_path):
    raster, link = tmp_path / "maps_1.tif", tmp_path / "maps.tif"
    write_geotiff(raster, maps)
    link.symlink_to(raster)
    for file in (raster, link):
        make_side_files(file)
    write_geotiff(link, maps)
    assert sorted(tmp_path.iterdir()) == [link, raster]


def test_a_full_disk_leaves_the_side_files(maps, tmp_path):
    write_geotiff(tmp_path / "maps.tif", maps)
    make_side_files(tmp_path / "maps.tif")
    before = set(tmp_path.iterdir())
    with full_disk(), pytest.raises(TrustboError, match=r"maps\.tif"):
        write_geotiff(tmp_path / "maps.tif", maps)
    assert set(tmp_path.iterdir()) == before


def test_places_in_geojson_are_those_of_the_plan(result, tmp_path):
    write_geojson(tmp_path / "高度.geojson", result)
    features = json.loads((tmp_path / "高度.geojson").read_text("utf-8"))["features"]
    plan, crs = result.plan(), result.workspace.grid.crs
    layers = {layer: [f for f in features if f["properties"]["layer"] == layer]
              for layer in ("path", "bounds", "posts", "routes")}  # fmt: skip
    assert len(layers["bounds"]) == len(plan.path)
    line = np.array(layers["path"][0]["geometry"]["coordinates"])
    x, y = transform("EPSG:4326", crs, *line.T.tolist())
    stops = np.array([result.workspace.posts.stop(cell) for cell in plan.path])
    np.testing.assert_allclose(np.transpose([x, y]), stops, atol=0.01)
    at_bounds = [one["geometry"]["coordinates"] for one in layers["bounds"]]
    np.testing.assert_array_equal(at_bounds, line)
    length = np.hypot(*np.diff(stops, axis=0).T).sum()
    assert layers["path"][0]["properties"]["length_m"] == pytest.approx(length)
    last = layers["bounds"][-1]["properties"]
    assert last["cell"] == [*plan.path[-1]]
    assert last["trust_r1"] == plan.trust[-1, 0]
    posts = [f["geometry"]["coordinates"] for f in layers["posts"]]
    x, y = transform("EPSG:4326", crs, *np.transpose(posts).tolist())
    np.testing.assert_allclose(np.transpose([x, y]), plan.posts.reshape(-1, 2), atol=0.01)
    assert len(layers["routes"]) == sum(one is not None for bound in plan.routes for one in bound)


def test_driven_bounds_are_marked_in_geojson(result, tmp_path):
    write_geojson(tmp_path / "path.geojson", dataclasses.replace(result.plan(), n_driven=1))
    features = json.loads((tmp_path / "path.geojson").read_text())["features"]
    about = [feature["properties"] for feature in features]
    assert about[0]["n_driven"] == 1
    for layer in ("bounds", "posts", "routes"):
        of_layer = [one for one in about if one["layer"] == layer and one["bound"] > 0]
        assert all(one["driven"] == (one["bound"] == 1) for one in of_layer)
        assert len({one["driven"] for one in of_layer}) == 2


def features_in(file):
    return json.loads(file.read_text())["features"]


def test_layers_in_files_of_their_own_are_those_of_one_file(result, tmp_path):
    plan = result.plan()
    ground = plan.workspace.closing([(0, 1), ((1, 1), (2, 1))], "mud")
    plan = dataclasses.replace(plan, workspace=ground.with_places({"camp": plan.start}))
    write_geojson(tmp_path / "all.geojson", plan)
    write_geojson(tmp_path / "field", plan)
    every = json.loads((tmp_path / "all.geojson").read_text())["features"]
    found = {file.stem: features_in(file) for file in (tmp_path / "field").iterdir()}
    assert sorted(found) == ["bounds", "closed", "path", "places", "posts", "routes"]
    for layer, features in found.items():
        assert features == [one for one in every if one["properties"]["layer"] == layer]
    cell, bound = found["closed"]
    assert (cell["geometry"]["type"], bound["geometry"]["type"]) == ("Point", "LineString")
    assert bound["properties"] == {"layer": "closed", "reason": "mud", "cells": [[1, 1], [2, 1]]}
    x, y = transform("EPSG:4326", ground.grid.crs, *np.transpose([cell["geometry"]["coordinates"]]))
    np.testing.assert_allclose(np.ravel([x, y]), ground.grid.center((0, 1)), atol=0.01)

    write_geojson(tmp_path / "field", result.plan())  # without closings: none is left over
    assert features_in(tmp_path / "field" / "closed.geojson") == []


@pytest.mark.parametrize("west", [-180.5, 179.5])
def test_a_line_across_180_degrees_is_cut_there(west):
    cut = cut_at_180(shapely.LineString([(west, -17.0), (west + 1.0, -16.0)]))
    parts = [np.array(part.coords) for part in cut.geoms]
    assert len(parts) == 2
    assert max(np.ptp(part[:, 0]) for part in parts) <= 0.5
    ends = sorted(tuple(end) for part in parts for end in part)
    assert ends == [(-180.0, -16.5), (-179.5, -16.0), (179.5, -17.0), (180.0, -16.5)]


def test_a_table_has_measurements_and_trust(result, tmp_path):
    write_csv(tmp_path / "missions.csv", result)
    with (tmp_path / "missions.csv").open(newline="", encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if row["trust_mean"]]
    assert len(rows) == 3 * sum(len(mission.bounds) for mission in result.missions)
    latent = result.posterior["latent"]
    for row in rows:
        mission, k = result.missions[int(row["mission"]) - 1], int(row["bound"])
        rate = mission.bounds[k - 1].contact_rate[mission.robots.index(row["robot"])]
        assert float(row["contact_rate"]) == rate
        at = {"mission": int(row["mission"]) - 1, "bound": k, "robot": row["robot"]}
        assert float(row["trust_sd"]) == float(latent["trust_sd"].sel(at))


def test_all_formats_are_written_to_a_folder(result, tmp_path):
    written = export_result(result, tmp_path, list(WRITERS))
    assert written == [tmp_path / name for name, _ in WRITERS.values()]
    assert all(file.exists() for file in written)
    with pytest.raises(TrustboError, match="format"):
        export_result(result, tmp_path, ["kmz"])
    with pytest.raises(TrustboError, match="list"):
        export_result(result, tmp_path, "geotiff")


def test_a_file_has_the_suffix_of_its_format(maps, tmp_path):
    write_geotiff(tmp_path / "maps.TIF", maps)
    with pytest.raises(TrustboError, match=r"maps\.png"):
        write_geotiff(tmp_path / "maps.png", maps)
    assert [file.name for file in tmp_path.iterdir()] == ["maps.TIF"]


def test_without_a_terrain_there_is_no_place_on_earth(result, maps, nowhere, tmp_path):
    bare = dataclasses.replace(result.plan(), workspace=nowhere.workspace)
    for write, what in ((write_geojson, bare), (write_geotiff, maps.drop_vars("spatial_ref"))):
        with pytest.raises(TrustboError):
            write(tmp_path / "a.tif", what)
    assert not list(tmp_path.iterdir())


def test_a_plan_is_written_in_the_formats_that_it_has(result, tmp_path):
    assert export_result(result.plan(), tmp_path) == [tmp_path / "path.geojson"]
    written = export_result(result.plan(), tmp_path / "both", ["geojson", "nav2"])
    assert all(file.exists() for file in written)
    for name in ("geotiff", "csv"):
        with pytest.raises(TrustboError, match=name):
            export_result(result.plan(), tmp_path / "none", [name])
    for write in (write_geotiff, write_csv):
        with pytest.raises(TrustboError, match="campaign"):
            write(tmp_path / "a.tif", result.plan())
    assert not (tmp_path / "none").exists()


def test_maps_before_the_first_mission_are_those_of_the_prior(tmp_path):
    campaign = tb.Campaign(unequal_robots(), (2, 0), (0, 3))
    write_geotiff(tmp_path / "maps.tif", campaign)
    with rasterio.open(tmp_path / "maps.tif") as raster:
        mean = raster.read(1 + raster.descriptions.index("trust_mean"))
        sd = raster.read(1 + raster.descriptions.index("trust_sd"))
    trust = campaign.trust_map.values  # at the prior mean
    is_assumed = np.zeros(trust.shape, dtype=bool)
    is_assumed[2, 0] = True  # the start
    assert (np.abs(mean - trust) < sd)[~is_assumed].all()
    assert (sd > 0.0)[~is_assumed].all()
