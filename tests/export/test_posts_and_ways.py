"""Posts and ways in every format, read back by readers that are not the writers, and driven."""

import itertools
import json
import sqlite3
from dataclasses import replace

import numpy as np
import pytest
import shapely
from pyproj import Transformer
from references import geometry_of_blob
from worlds import Steady, hillside

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.export import path_frame, write_path, write_waypoints

ROBOTS = ("lead", "r1", "r2", "r3")
FROM_DEGREES = Transformer.from_crs(4326, 32616, always_xy=True)
MILLIMETRE = 2e-3  # the last of eight digits of a degree, and rounding


@pytest.fixture(scope="module")
def workspace():
    terrain = hillside(90.0, 120.0)
    return tb.Workspace.from_terrain(terrain, (3, 4))


@pytest.fixture(scope="module")
def planner(workspace):
    return tb.planning.Planner(workspace, (2, 0), (0, 3), max_bounds="shortest+2")


@pytest.fixture(scope="module")
def params():
    return tb.models.TrustParams(0.5, np.array([0.1, 0.1, 0.4]), 0.1, 0.1, 0.1, 0.5, 0.5)


@pytest.fixture
def plan(planner, params):
    return planner.plan(params)


def metres(degrees):
    return np.transpose(FROM_DEGREES.transform(*np.transpose(degrees)))


def read_geojson(file):
    posts, ways = {}, {}
    for feature in json.loads(file.read_text())["features"]:
        said, place = feature["properties"], feature["geometry"]
        if said["layer"] == "posts":
            assert place["type"] == "Point"
            posts[said["bound"], said["robot"]] = metres([place["coordinates"]])[0]
        elif said["layer"] == "ways":
            assert place["type"] == "LineString"
            ways[said["bound"], said["robot"]] = metres(place["coordinates"])
    return posts, ways


def read_gpkg(file):
    base = sqlite3.connect(file)
    kinds = dict(
        base.execute("SELECT table_name, geometry_type_name FROM gpkg_geometry_columns").fetchall()
    )
    assert kinds == {
        "path": "LINESTRING",
        "bounds": "POINT",
        "posts": "POINT",
        "ways": "LINESTRING",
    }
    found = []
    for layer in ("posts", "ways"):
        rows = base.execute(f"SELECT bound, robot, geom FROM {layer}").fetchall()
        found.append({(k, robot): np.array(geometry_of_blob(g)[1].coords) for k, robot, g in rows})
    base.close()
    return {key: xy[0] for key, xy in found[0].items()}, found[1]


READERS = {"geojson": read_geojson, "gpkg": read_gpkg}


def assert_is_planned(posts, ways, workspace, path):
    """Each post and each way is that of its bound and robot, within millimetres."""
    n = len(path) - 1
    assert set(posts) == set(itertools.product(range(1, n + 1), ROBOTS[1:]))
    assert set(ways) == set(itertools.product(range(1, n + 1), ROBOTS))
    for k, (a, c) in enumerate(itertools.pairwise(path), start=1):
        ahead = path[k + 1] if k < n else None
        for robot, post in zip(ROBOTS[1:], workspace.posts(a, c), strict=True):
            np.testing.assert_allclose(posts[k, robot], post, atol=MILLIMETRE)
        for robot, way in zip(ROBOTS, workspace.ways(a, c, ahead), strict=True):
            np.testing.assert_allclose(ways[k, robot], way, atol=MILLIMETRE)


def faults(plan):
    """What an export may confuse, as plans that say it."""
    swapped = [tuple(way[:, ::-1] for way in ways) for ways in plan.ways]
    others = [(ways[0], *ways[:0:-1]) for ways in plan.ways]
    return {
        "x and y of posts": {"posts": plan.posts[..., ::-1]},
        "robots of posts": {"posts": plan.posts[:, ::-1]},
        "bounds of posts": {"posts": np.roll(plan.posts, 1, axis=0)},
        "x and y of ways": {"ways": tuple(swapped)},
        "robots of ways": {"ways": tuple(others)},
        "bounds of ways": {"ways": (*plan.ways[1:], plan.ways[0])},
    }


@pytest.mark.parametrize("suffix", READERS)
def test_a_file_has_the_posts_and_ways_of_each_bound_and_robot(plan, workspace, suffix, tmp_path):
    file = tmp_path / f"path.{suffix}"
    write_path(file, plan)
    assert_is_planned(*READERS[suffix](file), workspace, plan.path)
    for wrong in faults(plan).values():
        broken = replace(plan)
        vars(broken).update(stops=plan.stops, posts=plan.posts, ways=plan.ways)
        vars(broken).update(wrong)
        write_path(file, broken)
        with pytest.raises(AssertionError):
            assert_is_planned(*READERS[suffix](file), workspace, plan.path)


def test_a_post_says_what_it_watches(plan, workspace):
    frame = path_frame(plan, layer="posts", crs=None)
    for row in frame.to_dict("records"):
        k = row["bound"]
        assert (row["row"], row["col"]) == plan.path[k - 1]
        watched = workspace.ground.posts.stop(plan.path[k])
        np.testing.assert_array_equal((row["lead_x"], row["lead_y"]), watched)
        np.testing.assert_array_equal((row["geometry"].x, row["geometry"].y), (row["x"], row["y"]))
    ways = path_frame(plan, layer="ways", crs=None)
    np.testing.assert_allclose(ways["length_m"], ways.length)
    assert path_frame(plan, layer="ways").crs.to_epsg() == 4326
    with pytest.raises(
        TrustboError, match="unknown layer 'post'; choose one of bounds, posts, ways"
    ):
        path_frame(plan, layer="post")


def test_where_a_robot_has_no_way_it_has_no_line(plan, tmp_path):
    lead, r1, _, r3 = plan.ways[1]
    broken = replace(plan)
    vars(broken)["ways"] = (plan.ways[0], (lead, r1, None, r3), *plan.ways[2:])
    for suffix in READERS:
        write_path(tmp_path / f"path.{suffix}", broken)
        _, ways = READERS[suffix](tmp_path / f"path.{suffix}")
        assert {robot for k, robot in ways if k == 2} == {"lead", "r1", "r3"}
        assert (3, "r2") in ways
    with pytest.raises(TrustboError, match="r2 has no way in bound 2, so that it cannot be sent"):
        write_waypoints(tmp_path / "r1.yaml", broken, robot="r1")
    assert not (tmp_path / "r1.yaml").exists()


@pytest.mark.parametrize("slip", [False, True])
def test_what_is_exported_is_what_is_driven(plan, workspace, slip, tmp_path, monkeypatch):
    """Within a pixel of 1 m, and .5 m more with slip."""
    if not slip:
        of_simulator = "trustbo.simulation.kinematic.np.random.default_rng"
        monkeypatch.setattr(of_simulator, lambda *_: Steady())
    mission = tb.simulation.KinematicSimulator(workspace).run(plan.path, seed=0)
    assert mission.status == "ok"
    for suffix in READERS:
        write_path(tmp_path / f"path.{suffix}", plan)
        posts, ways = READERS[suffix](tmp_path / f"path.{suffix}")
        for k, bound in enumerate(mission.bounds, start=1):
            for i, robot in enumerate(ROBOTS):
                track = shapely.points(bound.poses[:, i, :2])
                gap = shapely.distance(track, shapely.LineString(ways[k, robot])).max()
                assert gap <= (1.5 if slip else 1.0)
                if i:  # it stands there while the lead runs the bound
                    post = posts[k, robot]
                    assert np.linalg.norm(bound.poses[0, i, :2] - post) <= (1.5 if slip else 1.0)


def test_a_robot_called_as_the_lead_is_refused(plan, workspace, tmp_path):
    named = replace(workspace, team=tb.Team(3, names=("lead", "r2", "r3")))
    with pytest.raises(TrustboError, match="a robot is called 'lead', as the lead is"):
        write_path(tmp_path / "path.geojson", replace(plan, workspace=named))
    bare = tb.Workspace.from_awareness(np.full((3, 3, 4, 2), 0.5))
    with pytest.raises(TrustboError, match="posts and ways where its workspace was made from a"):
        path_frame(replace(plan, workspace=bare), layer="ways", crs=None)
    assert list(tmp_path.iterdir()) == []
