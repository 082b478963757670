"""Paths, each format read back by a reader that is not the writer."""

import json
import sqlite3
from dataclasses import replace

import numpy as np
import pytest
from pyproj import Transformer
from references import geometry_of_blob

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.export import path_frame, write_path

ROBOTS = ("r1", "r2", "r3")
TO_DEGREES = Transformer.from_crs(32616, 4326, always_xy=True)


@pytest.fixture(scope="module")
def centers(result):
    """Metres in the terrain's CRS: 30 m cells from the corner (380000, 5225000)."""
    return np.array([(380015.0 + 30.0 * c, 5224985.0 - 30.0 * r) for r, c in result.path])


def trust_of(plan, k, robot):
    """Expected trust after bound k with its 5 % and 95 % quantiles."""
    i = ROBOTS.index(robot)
    return [plan.trust[k - 1, i], plan.bands[0, k - 1, i], plan.bands[3, k - 1, i]]


def test_a_frame_has_a_point_per_cell(result, centers):
    frame = path_frame(result)
    assert frame.crs.to_epsg() == 4326
    assert frame["bound"].tolist() == list(range(len(result.path)))
    assert list(zip(frame["row"], frame["col"], strict=True)) == result.path
    np.testing.assert_array_equal(frame[["x", "y"]], centers)
    degrees = np.transpose(TO_DEGREES.transform(*centers.T))
    found = np.column_stack([frame.geometry.x, frame.geometry.y])
    np.testing.assert_allclose(found, degrees, rtol=0.0, atol=1e-10)
    for robot in ROBOTS:
        names = [f"trust_{robot}{end}" for end in ("", "_low", "_high")]
        assert frame.loc[0, names].isna().all()
        for k in range(1, len(frame)):
            np.testing.assert_array_equal(frame.loc[k, names], trust_of(result.plan, k, robot))


def test_a_frame_may_be_in_another_crs_or_in_none(result, nowhere, centers):
    own = path_frame(result.plan, crs=None)
    assert own.crs.to_epsg() == 32616
    np.testing.assert_array_equal(own.get_coordinates(), centers)
    assert path_frame(result, crs=32617).crs.to_epsg() == 32617
    placed = replace(result.plan, workspace=nowhere.workspace)
    bare = path_frame(placed, crs=None)
    assert bare.crs is None
    np.testing.assert_array_equal(bare.get_coordinates(), centers)
    with pytest.raises(TrustboError, match=r"unknown crs 'EPSG:0'; give e\.g\. 'EPSG:4326'"):
        path_frame(result, crs="EPSG:0")
    with pytest.raises(TrustboError, match="only a workspace made from a terrain has a CRS"):
        path_frame(nowhere)


def test_geojson_is_in_degrees_on_the_right_place(result, centers, tmp_path):
    write_path(tmp_path / "path.geojson", result)
    collection = json.loads((tmp_path / "path.geojson").read_text())
    assert set(collection) == {"type", "features"}  # RFC 7946 knows no "crs"
    of_layer = {"path": [], "bounds": [], "posts": [], "ways": []}
    for feature in collection["features"]:
        of_layer[feature["properties"].pop("layer")].append(feature)
    (line,), points = of_layer["path"], of_layer["bounds"]
    assert line["geometry"]["type"] == "LineString"
    assert {point["geometry"]["type"] for point in points} == {"Point"}
    positions = line["geometry"]["coordinates"]
    assert [point["geometry"]["coordinates"] for point in points] == positions
    back = Transformer.from_crs(4326, 32616, always_xy=True).transform(*np.transpose(positions))
    np.testing.assert_allclose(np.transpose(back), centers, atol=2e-3)  # 1e-8 degree is 1 mm
    facts = line["properties"]
    assert (facts["name"], facts["n_bounds"]) == ("most trustworthy path", len(points) - 1)
    assert facts["value"] == pytest.approx(result.value)
    length = np.hypot(*np.diff(centers, axis=0).T).sum()
    assert facts["length_m"] == pytest.approx(length)
    assert points[0]["properties"] == {"bound": 0, "cell": [2, 0], "p_arrive": 1.0}
    for k, (point, cell) in enumerate(zip(points, result.path, strict=True)):
        said = point["properties"]
        assert (said["bound"], said["cell"]) == (k, list(cell))
        for robot in ROBOTS if k else ():
            found = [said[f"trust_{robot}{end}"] for end in ("", "_low", "_high")]
            assert found == trust_of(result.plan, k, robot)


def test_a_geopackage_has_a_layer_of_the_line_and_one_of_the_bounds(result, centers, tmp_path):
    write_path(tmp_path / "path.gpkg", result)
    assert [file.name for file in tmp_path.iterdir()] == ["path.gpkg"]
    base = sqlite3.connect(tmp_path / "path.gpkg")
    base.row_factory = sqlite3.Row
    layers = base.execute("SELECT table_name, data_type FROM gpkg_contents").fetchall()
    names = {"path", "bounds", "posts", "ways"}
    assert {tuple(layer) for layer in layers} == {(name, "features") for name in names}
    kinds = base.execute("SELECT table_name, geometry_type_name FROM gpkg_geometry_columns")
    assert {("path", "LINESTRING"), ("bounds", "POINT")} <= {tuple(k) for k in kinds}
    (line,) = base.execute("SELECT * FROM path").fetchall()
    srs, way = geometry_of_blob(line["geom"])
    place = base.execute(
        "SELECT organization_coordsys_id AS code FROM gpkg_spatial_ref_sys WHERE srs_id = ?", [srs]
    ).fetchone()
    assert place["code"] == 32616
    np.testing.assert_array_equal(way.coords, centers)
    assert line["n_bounds"] == len(centers) - 1
    assert line["value"] == pytest.approx(result.value)
    points = base.execute("SELECT * FROM bounds ORDER BY bound").fetchall()
    base.close()
    for k, (point, center, cell) in enumerate(zip(points, centers, result.path, strict=True)):
        np.testing.assert_array_equal(geometry_of_blob(point["geom"])[1].coords, [center])
        assert (point["bound"], point["row"], point["col"]) == (k, *cell)
        for robot in ROBOTS:
            found = [point[f"trust_{robot}{end}"] for end in ("", "_low", "_high")]
            assert found == (trust_of(result.plan, k, robot) if k else [None] * 3)


def test_what_cannot_be_written_is_refused_before_anything_is(result, nowhere, tmp_path):
    choices = r"choose one of \.geojson, \.gpkg"
    for name, suffix in (("path.kml", r"\.kml"), ("path", "")):
        with pytest.raises(TrustboError, match=f"unknown suffix '{suffix}'; {choices}"):
            write_path(tmp_path / name, result)
    for name in ("path.geojson", "path.gpkg"):
        with pytest.raises(TrustboError, match=r"has a CRS; use Workspace\.from_t"):
            write_path(tmp_path / name, nowhere)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "path.gpkg").mkdir()
    with pytest.raises(TrustboError, match=r"cannot write '.*path\.gpkg': it is a folder"):
        write_path(tmp_path / "path.gpkg", result)


def test_a_file_is_replaced_whole(result, tmp_path):
    for suffix in ("geojson", "gpkg"):
        file = tmp_path / f"path.{suffix.upper()}"
        file.write_text("an older file " * 100_000)
        write_path(file, result)
        assert b"an older file" not in file.read_bytes()
    assert len(list(tmp_path.iterdir())) == 2


def test_bounds_carry_their_chances_to_fail_and_to_get_as_far(result):
    table, risk = path_frame(result), result.plan.risk
    assert np.isnan(table["p_fail"][0])
    np.testing.assert_array_equal(table["p_fail"][1:], risk.p_fail)
    for end, p in zip(("low", "high"), risk.p_fail_band, strict=True):
        np.testing.assert_array_equal(table[f"p_fail_{end}"][1:], np.where(p < 1e-6, 0.0, p))
    np.testing.assert_array_equal(table["p_arrive"], [1.0, *risk.p_reach])
    assert (np.diff(table["p_arrive"]) < 0.0).all()
    assert table["p_arrive"].iloc[-1] == pytest.approx(result.plan.p_arrive)
    causes = [table[f"p_fail_{cause}"][1:] for cause in tb.hazard.exposures.CAUSES]
    np.testing.assert_allclose(sum(causes), risk.p_fail, rtol=1e-12)


def test_a_chance_too_small_to_mean_anything_is_0_in_tables(result):
    risk = result.plan.risk
    by_cause = {cause: np.full(len(risk.p_fail), 4.8e-161) for cause in risk.by_cause}
    plan = replace(result.plan, risk=risk._replace(by_cause=by_cause))
    table = path_frame(plan)
    assert (table[[f"p_fail_{cause}" for cause in by_cause]][1:] == 0.0).all(axis=None)
    np.testing.assert_array_equal(table["p_fail"][1:], risk.p_fail)
