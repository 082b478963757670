"""All formats at once."""

import dataclasses

import numpy as np
import pytest
import yaml

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.export import FORMATS, Frame, export_result
from trustbo.export.everything import left_out
from trustbo.export.frame import OF_CRS

FILES = {
    "geotiff": ["maps.tif"],
    "geojson": ["path.geojson"],
    "geopackage": ["path.gpkg"],
    "csv": ["missions.csv"],
    "ros_map": ["cost_map.yaml", "cost_map.pgm"],
    "nav2": [
        "route_graph.geojson",
        "route_graph_params.yaml",
        *(f"waypoints_{robot}.yaml" for robot in ("lead", "r1", "r2", "r3")),
    ],
}
NEEDS_A_PLACE = ("geotiff", "geojson", "geopackage")


def test_every_format_is_written_under_its_name(result, tmp_path):
    assert list(FORMATS) == list(FILES)
    written = export_result(result, tmp_path / "out", FORMATS)
    names = [name for names in FILES.values() for name in names]
    assert written == [tmp_path / "out" / name for name in (*names, "frame.yaml")]
    assert set((tmp_path / "out").iterdir()) == set(written)
    assert all(file.stat().st_size for file in written)


def test_by_default_it_is_what_a_gis_takes_and_a_second_time_replaces_it(result, tmp_path):
    for _ in range(2):
        written = export_result(result, tmp_path)
        assert [file.name for file in written] == ["maps.tif", "path.geojson"]
    assert len(list(tmp_path.iterdir())) == 2
    assert export_result(result, tmp_path, "geopackage") == [tmp_path / "path.gpkg"]


def test_maps_for_ros_have_the_frame_that_is_asked_for(result, tmp_path):
    lon, lat = result.workspace.grid.lonlat(result.path[0])
    frame = Frame(rotation=0.1, name="odom")
    (tmp_path / "cost_map_frame.yaml").touch()  # as version 0.2 wrote it
    written = export_result(result, tmp_path, ["csv", "ros_map"], frame=frame)
    assert written[-1] == tmp_path / "frame.yaml"
    assert all(file.exists() for file in written)
    assert not (tmp_path / "cost_map_frame.yaml").exists()
    record = yaml.safe_load(written[-1].read_text())
    assert record["origin"] == list(result.workspace.grid.center(result.path[0]))
    export_result(result, tmp_path / "b", "ros_map",
                  frame=frame._replace(origin=f"lon={lon},lat={lat}"))  # fmt: skip
    again = yaml.safe_load((tmp_path / "b" / "frame.yaml").read_text())
    np.testing.assert_allclose(again["origin"], record["origin"], rtol=0.0, atol=1e-3)
    for name, given in (
        ("origin='crs'", OF_CRS),
        ("rotation=0.1", Frame(rotation=0.1)),
        ("frame='odom'", Frame(name="odom")),
    ):
        with pytest.raises(TrustboError, match=f"{name} is of files for robots; leave it"):
            export_result(result, tmp_path, "geotiff", frame=given)
    with pytest.raises(TrustboError, match=r"origin 'x=0,y=0' .* is 5239 km from the grid, x 380"):
        export_result(result, tmp_path, "ros_map", frame=Frame((0.0, 0.0)))


def test_files_for_robots_in_one_folder_have_one_frame(result, tmp_path):
    odom, start = Frame(name="odom"), result.workspace.grid.center(result.path[0])
    export_result(result, tmp_path, "nav2")
    with pytest.raises(TrustboError, match=r"holds .*route_graph.geojson, .* in another frame"):
        export_result(result, tmp_path, "ros_map", frame=odom)
    assert not (tmp_path / "cost_map.yaml").exists()
    export_result(result, tmp_path, "ros_map", frame=Frame(start))
    export_result(result, tmp_path / "b", "ros_map", frame=OF_CRS)
    export_result(result, tmp_path / "b", "ros_map")  # alone, it is replaced
    export_result(result, tmp_path / "b", "ros_map", frame=OF_CRS)
    (tmp_path / "b" / "frame.yaml").unlink()  # as an export of version 0.2
    with pytest.raises(TrustboError, match=r"asked for, 'map' at x 380015, y 5224925 of the"):
        export_result(result, tmp_path / "b", "nav2")
    export_result(result, tmp_path / "b", ["ros_map", "nav2"])
    with pytest.raises(TrustboError, match=r"float32, in steps of 0.5 m .* origin='auto' is the"):
        export_result(result, tmp_path / "c", "nav2", frame=OF_CRS)


def test_a_result_read_from_disk_is_exported_alike(result, tmp_path):
    result.save(tmp_path / "result")
    again = tb.load_result(tmp_path / "result")
    formats = ("geotiff", "geojson", "csv")
    for one, folder in ((result, "a"), (again, "b")):
        export_result(one, tmp_path / folder, formats)
    for name in (name for kind in formats for name in FILES[kind]):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_maps_are_made_for_formats_that_have_maps_and_once(result, tmp_path):
    made = []

    class Watched(tb.Result):
        def maps(self, **options):
            made.append(options)
            return super().maps(**options)

    fields = {f.name: getattr(result, f.name) for f in dataclasses.fields(result)}
    watched = Watched(**fields)
    export_result(watched, tmp_path, ["geojson", "geopackage", "csv"])
    assert made == []
    export_result(watched, tmp_path, ["geotiff", "ros_map"])
    assert made == [{}]


def test_what_cannot_be_written_is_said_beforehand(result, nowhere, tmp_path):
    absent = left_out(nowhere, tmp_path)
    assert list(absent) == [*NEEDS_A_PLACE]
    assert "only a workspace made from a terrain has a CRS" in absent["geojson"]
    (tmp_path / "missions.csv").mkdir()
    assert list(left_out(result, tmp_path)) == ["csv"]
    (tmp_path / "file").touch()
    with pytest.raises(TrustboError, match=r"cannot write to '.*file': .* is a file"):
        left_out(result, tmp_path / "file")


def test_without_a_terrain_there_are_tables_and_ros(nowhere, tmp_path):
    for name in NEEDS_A_PLACE:
        with pytest.raises(TrustboError, match="only a workspace made from a terrain has a CRS"):
            export_result(nowhere, tmp_path / "out", ["csv", name])
    assert list(tmp_path.iterdir()) == []
    rest = [name for name in FORMATS if name not in NEEDS_A_PLACE]
    written = export_result(nowhere, tmp_path, rest)
    assert set(tmp_path.iterdir()) == set(written)


def test_what_one_format_refuses_keeps_all_from_being_written(result, tmp_path):
    with pytest.raises(TrustboError, match="unknown format 'kml'; choose one of geotiff, geojson"):
        export_result(result, tmp_path, ["csv", "kml"])
    with pytest.raises(TrustboError, match=r"resolution must be positive and finite; got 0"):
        export_result(result, tmp_path, ["csv", "ros_map"], resolution=0)
    with pytest.raises(
        TrustboError, match=r"resolution=5 is of files for robots; leave it out, or"
    ):
        export_result(result, tmp_path, ["csv", "geojson"], resolution=5)
    assert list(tmp_path.iterdir()) == []


def test_what_is_in_the_way_is_named_before_anything_is_written(result, tmp_path):
    (tmp_path / "missions.csv").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(TrustboError, match=r"missions\.csv': it is a folder"):
        export_result(result, tmp_path, ["geojson", "csv"])
    with pytest.raises(TrustboError, match=r"cannot write to '.*file': .* is a file"):
        export_result(result, tmp_path / "file")
    assert {file.name for file in tmp_path.iterdir()} == {"missions.csv", "file"}


def test_names_that_a_format_cannot_hold_are_refused_before_anything_is_written(result, tmp_path):
    workspace = result.workspace
    team = tb.Team(3, names=("R1", "r1", "r/2"))
    awareness = workspace.awareness.assign_coords(robot=list(team.names), feature=["a/b", "x", "y"])
    odd = dataclasses.replace(workspace, team=team, awareness=awareness, of_bounds=None)
    odd = dataclasses.replace(result, workspace=odd)
    with pytest.raises(TrustboError, match=r"does not tell capitals .* \('R1', 'r1', 'r/2'\)"):
        export_result(odd, tmp_path, ["geojson", "geopackage"])
    with pytest.raises(TrustboError, match=r"robot 'r/2' cannot be in a topic"):
        export_result(odd, tmp_path, ["geojson", "nav2"])
    assert list(tmp_path.iterdir()) == []
    assert "geopackage" in left_out(odd, tmp_path)
