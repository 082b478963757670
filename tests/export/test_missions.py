"""A plan with its times for ground stations, TAK, Google Earth and Foxglove, as others read it."""

import dataclasses
import io
import json
import math
import re
import sys
import zipfile
from datetime import datetime, timedelta, timezone
from itertools import pairwise

import numpy as np
import pytest
import shapely
from jsonschema import Draft202012Validator
from pyproj import Transformer

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.export import Frame, export_result, write_cot, write_foxglove, write_kmz, write_qgc
from trustbo.export.schedule import schedule_of

ROBOTS = ("lead", "r1", "r2", "r3")
START = datetime(2026, 5, 1, 6, 0, tzinfo=timezone(timedelta(hours=2)))


@pytest.fixture(scope="module")
def schedule(result):
    return schedule_of(result.plan)


def to_degrees(result, positions):
    crs = result.workspace.grid.crs
    lon, lat = Transformer.from_crs(crs, 4326, always_xy=True).transform(*np.asarray(positions).T)
    return np.column_stack([lon, lat])


def near(result, degrees, positions):
    """Distance on the ground of places in degrees from positions in the CRS, m."""
    return np.abs((degrees - to_degrees(result, positions)) * [75_000.0, 111_000.0]).max()


# --- times ---


def test_bounds_last_as_long_as_they_are_driven(result, schedule):
    """The simulator turns on the spot, which takes up to 3 s a bound, and slips by 5 %."""
    simulator = tb.simulation.KinematicSimulator(result.workspace)
    mission = simulator.run(list(result.plan.path), seed=0)
    driven = np.array([bound.duration.max() for bound in mission.bounds])
    planned = np.diff(schedule.begins)
    assert (np.abs(driven - planned) <= 0.15 * planned + 8.0).all()


def test_in_alternate_bounding_robots_stand_while_the_others_pass(result):
    """The lead drives in bounds 1, 3, ..., T2 in 2, 4, ..., and at the goal the one behind."""
    rules = dataclasses.replace(result.workspace.formation, bounding="alternate")
    workspace = dataclasses.replace(result.workspace, formation=rules)
    plan = dataclasses.replace(result.plan, workspace=workspace)
    assert len(plan.path) == 6
    found = schedule_of(plan)
    lead, *others = (found.robots[name] for name in ROBOTS)
    assert [stand.name for stand in lead] == ["start", "stop 1", "stop 3", "goal"]
    for stand, k in zip(lead[1:3], (1, 3), strict=True):
        times = stand.leaves, stand.arrives
        np.testing.assert_allclose(times, found.begins[k - 1 : k + 1], atol=1e-6)
    for robot in others:
        assert [stand.name for stand in robot] == ["post 1", "post 3", "post 5", "goal"]
        for stand, k in zip(robot[1:3], (2, 4), strict=True):
            assert stand.leaves == pytest.approx(found.begins[k - 1])
            assert stand.leaves < stand.arrives <= found.begins[k] + 1e-6
    assert {robot[-1].until for robot in found.robots.values()} == {found.begins[-1]}
    mission = tb.simulation.KinematicSimulator(workspace).run(plan.path, seed=0)
    driven, planned = [b.duration.max() for b in mission.bounds], np.diff(found.begins)
    assert (np.abs(driven - planned) <= 0.15 * planned + 8.0).all()


def test_robots_stand_while_the_others_drive(result, schedule):
    """The lead drives while T2 stands at its posts; T2 sets out when the lead has stopped."""
    lead, *others = (schedule.robots[name] for name in ROBOTS)
    n_bounds = len(result.plan.path) - 1
    stops, posts = (f"stop {k}" for k in range(1, n_bounds)), range(1, n_bounds + 1)
    assert [stand.name for stand in lead] == ["start", *stops, "goal"]
    for i, stands in enumerate(others):
        assert [stand.name for stand in stands] == [*(f"post {k}" for k in posts), "goal"]
        for k, stand in enumerate(stands[:-1]):
            np.testing.assert_allclose(stand.place, result.plan.posts[k, i], rtol=0.0, atol=1e-6)
            assert stand.arrives <= lead[k + 1].leaves + 1e-9  # before the lead begins the bound
            assert stand.until == lead[k + 1].arrives
    for stands in (lead, *others):
        for before, after in pairwise(stands):
            assert before.until == after.leaves
            assert before.arrives <= before.until
            np.testing.assert_array_equal(before.place, after.way[0])
    last = max(stands[-1].arrives for stands in others)
    assert schedule.begins[-1] == pytest.approx(last)


# --- QGroundControl ---

ITEM = {
    "type": "object",
    "required": ["type", "command", "frame", "params", "doJumpId", "autoContinue"],
    "properties": {
        "type": {"const": "SimpleItem"},
        "command": {"const": 16},  # MAV_CMD_NAV_WAYPOINT
        "frame": {"const": 3},  # MAV_FRAME_GLOBAL_RELATIVE_ALT
        "autoContinue": {"type": "boolean"},
        "doJumpId": {"type": "integer", "minimum": 1},
        "AltitudeMode": {"type": "integer"},
        "Altitude": {"type": "number"},
        "AMSLAltAboveTerrain": {"type": ["number", "null"]},
        "params": {
            "prefixItems": [
                {"type": "integer", "minimum": 0, "maximum": 65535},  # ArduPilot: uint16, s
                {"type": "number"},
                {"type": "number"},
                {"type": ["number", "null"]},
                {"type": "number", "minimum": -90, "maximum": 90},
                {"type": "number", "minimum": -180, "maximum": 180},
                {"type": "number"},
            ],
            "minItems": 7, "maxItems": 7,
        },
    },
}  # fmt: skip
OF_PLAN = {  # docs.qgroundcontrol.com: Plan File Format
    "type": "object",
    "required": ["version", "fileType", "groundStation", "mission"],
    "properties": {
        "version": {"const": 1},
        "fileType": {"const": "Plan"},
        "groundStation": {"type": "string"},
        "geoFence": {
            "required": ["circles", "polygons", "version"], "properties": {"version": {"const": 2}}
        },
        "rallyPoints": {
            "required": ["points", "version"], "properties": {"version": {"const": 2}}
        },
        "mission": {
            "required": ["version", "firmwareType", "globalPlanAltitudeMode", "vehicleType",
                         "cruiseSpeed", "hoverSpeed", "items", "plannedHomePosition"],
            "properties": {
                "version": {"const": 2},
                "firmwareType": {"enum": [3, 12]},  # MAV_AUTOPILOT
                "vehicleType": {"const": 10},  # MAV_TYPE_GROUND_ROVER
                "cruiseSpeed": {"type": "number", "exclusiveMinimum": 0},
                "items": {"type": "array", "minItems": 1, "items": ITEM},
                "plannedHomePosition": {
                    "type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3
                },
            },
        },
    },
}  # fmt: skip


@pytest.mark.parametrize(("robot", "autopilot"), [("lead", "px4"), ("r2", "ardupilot")])
def test_a_plan_of_qgroundcontrol_drives_the_ways_and_holds_at_the_stops(
    result, schedule, tmp_path, robot, autopilot
):
    with pytest.warns(UserWarning, match=r"at the stops of r\.plan .* do not wait for each other"):
        write_qgc(tmp_path / "r.plan", result, robot=robot, autopilot=autopilot)
    record = json.loads((tmp_path / "r.plan").read_text())
    Draft202012Validator(OF_PLAN).validate(record)
    mission = record["mission"]
    assert mission["firmwareType"] == {"px4": 12, "ardupilot": 3}[autopilot]
    assert [item["doJumpId"] for item in mission["items"]] == list(
        range(1, len(mission["items"]) + 1)
    )
    params = [item["params"] for item in mission["items"]]
    places = np.array([(lon, lat) for *_, lat, lon, _ in params])
    way = result.plan.ways
    index = ROBOTS.index(robot)
    line = shapely.LineString(np.concatenate([bound[index] for bound in way]))
    crs = result.workspace.grid.crs
    driven = np.column_stack(Transformer.from_crs(4326, crs, always_xy=True).transform(*places.T))
    pixel = min(result.workspace.surface.pixel)
    assert shapely.hausdorff_distance(shapely.LineString(driven), line, 0.01) <= 0.5 * pixel + 0.01
    holds = [hold for hold, *_ in params if hold]
    expected = [math.ceil(stand.hold) for stand in schedule.robots[robot][:-1]]
    assert holds == [hold for hold in expected if hold]
    assert params[-1][0] == 0
    assert mission["plannedHomePosition"] == [*params[0][4:6], 0.0]


# --- TAK ---

COT = """<xs:schema xmlns:xs="http://www.w3.org/2001/XMLSchema">
  <xs:simpleType name="latitude"><xs:restriction base="xs:decimal">
    <xs:minInclusive value="-90"/><xs:maxInclusive value="90"/></xs:restriction></xs:simpleType>
  <xs:simpleType name="longitude"><xs:restriction base="xs:decimal">
    <xs:minInclusive value="-180"/><xs:maxInclusive value="180"/></xs:restriction></xs:simpleType>
  <xs:element name="event"><xs:complexType><xs:all>
      <xs:element name="point"><xs:complexType>
        <xs:attribute name="lat" type="latitude" use="required"/>
        <xs:attribute name="lon" type="longitude" use="required"/>
        <xs:attribute name="hae" type="xs:decimal" use="required"/>
        <xs:attribute name="ce" type="xs:decimal" use="required"/>
        <xs:attribute name="le" type="xs:decimal" use="required"/>
      </xs:complexType></xs:element>
      <xs:element name="detail" minOccurs="0"><xs:complexType><xs:sequence>
        <xs:any minOccurs="0" maxOccurs="unbounded" processContents="skip"/>
      </xs:sequence></xs:complexType></xs:element>
    </xs:all>
    <xs:attribute name="version" use="required"><xs:simpleType>
      <xs:restriction base="xs:decimal"><xs:enumeration value="2.0"/></xs:restriction>
    </xs:simpleType></xs:attribute>
    <xs:attribute name="type" use="required"><xs:simpleType><xs:restriction base="xs:string">
      <xs:pattern value="\\w+(-\\w+)*(;[^;]*)?"/></xs:restriction></xs:simpleType></xs:attribute>
    <xs:attribute name="uid" type="xs:string" use="required"/>
    <xs:attribute name="time" type="xs:dateTime" use="required"/>
    <xs:attribute name="start" type="xs:dateTime" use="required"/>
    <xs:attribute name="stale" type="xs:dateTime" use="required"/>
    <xs:attribute name="how" use="required"><xs:simpleType><xs:restriction base="xs:string">
      <xs:pattern value="\\w(-\\w+)*"/></xs:restriction></xs:simpleType></xs:attribute>
  </xs:complexType></xs:element>
</xs:schema>"""
"""Base fields of Cursor on Target 2.0, after MITRE's Event.xsd and point.xsd."""


def package(file):
    """Events of a data package by uid, as the manifest names them."""
    from lxml import etree

    with zipfile.ZipFile(file) as content:
        manifest = etree.fromstring(content.read("MANIFEST/manifest.xml"))
        assert (manifest.tag, manifest.get("version")) == ("MissionPackageManifest", "2")
        names = {p.get("name") for p in manifest.find("Configuration")}
        assert names == {"uid", "name"}
        entries = [one.get("zipEntry") for one in manifest.find("Contents")]
        assert sorted(content.namelist()) == sorted(["MANIFEST/manifest.xml", *entries])
        events = [etree.fromstring(content.read(entry)) for entry in entries]
    return {event.get("uid"): event for event in events}


def test_events_of_tak_are_routes_and_posts(result, schedule, tmp_path):
    from lxml import etree

    write_cot(tmp_path / "a.zip", result, name="ridge", start=START)
    events, schema = package(tmp_path / "a.zip"), etree.XMLSchema(etree.fromstring(COT))
    for event in events.values():
        schema.assertValid(event)
    broken = next(iter(events.values()))
    broken.find("point").set("lat", "91")
    assert not schema.validate(broken)
    assert {e.get("time") for e in events.values()} == {"2026-05-01T04:00:00.000Z"}
    stale = START + timedelta(days=1, seconds=schedule.begins[-1])
    for event in events.values():
        assert abs(datetime.fromisoformat(event.get("stale")) - stale) < timedelta(milliseconds=2)
    routes = [e for e in events.values() if e.get("type") == "b-m-r"]
    assert [e.find("detail/contact").get("callsign") for e in routes] == [
        f"ridge {robot}" for robot in ROBOTS
    ]
    for robot, event in zip(ROBOTS, routes, strict=True):
        links = event.findall("detail/link")
        assert len({link.get("uid") for link in links}) == len(links)
        assert {link.get("relation") for link in links} == {"c"}
        named = [link for link in links if link.get("type") == "b-m-p-w"]
        stands = schedule.robots[robot]
        assert [link.get("callsign") for link in named] == [stand.name for stand in stands]
        points = np.array([[float(v) for v in link.get("point").split(",")] for link in named])
        assert near(result, points[:, ::-1], [stand.place for stand in stands]) < 0.01
        others = [link for link in links if link not in named]
        assert {link.get("type") for link in others} <= {"b-m-p-c"}
        assert len(links) == sum(len(stand.way) for stand in stands) - len(stands) + 1
    posts = {e.find("detail/contact").get("callsign"): e for e in events.values()
             if e.get("type") == "b-m-p-s-m"}  # fmt: skip
    assert len(posts) == sum(len(stands) for stands in schedule.robots.values())
    for robot, stands in schedule.robots.items():
        for stand in stands:
            event = posts[f"{robot} {stand.name}"]
            point = event.find("point")
            degrees = np.array([[float(point.get("lon")), float(point.get("lat"))]])
            assert near(result, degrees, [stand.place]) < 0.01
            since = datetime.fromisoformat(event.get("start")) - START
            assert since.total_seconds() == pytest.approx(stand.arrives, abs=2e-3)
    write_cot(tmp_path / "b.zip", result, name="ridge")
    assert package(tmp_path / "b.zip").keys() == events.keys()
    write_cot(tmp_path / "c.zip", result, name="valley")
    assert not package(tmp_path / "c.zip").keys() & events.keys()


# --- KMZ ---


def test_gdal_reads_the_kmz_with_its_times(result, maps, schedule, tmp_path):
    import geopandas as gpd
    import matplotlib
    import pyogrio
    from PIL import Image

    write_kmz(tmp_path / "a.kmz", result, maps["cost"], start=START)
    layers = [name for name, _ in pyogrio.list_layers(tmp_path / "a.kmz")]
    assert [name for name in layers if name in ROBOTS] == [*ROBOTS]
    for i, robot in enumerate(ROBOTS):
        table = gpd.read_file(tmp_path / "a.kmz", layer=robot)
        assert table.crs.to_epsg() == 4326
        stands = schedule.robots[robot]
        places = table[table.geom_type == "Point"]
        assert list(places["Name"]) == [f"{robot} {stand.name}" for stand in stands]
        degrees = shapely.get_coordinates(places.geometry.to_numpy())[:, :2]
        assert near(result, degrees, [stand.place for stand in stands]) < 0.01
        for name, times in (("begin", "arrives"), ("end", "until")):
            since = [(time.to_pydatetime() - START).total_seconds() for time in places[name]]
            expected = [getattr(stand, times) for stand in stands]
            np.testing.assert_allclose(since, expected, rtol=0.0, atol=1.5e-3)
        ways = table[table.geom_type.isin(["LineString"])]
        assert len(ways) == len(result.plan.path) - 1
        for line, bound in zip(ways.geometry, result.plan.ways, strict=True):
            ends = shapely.get_coordinates(line)[[0, -1], :2]
            assert near(result, ends, bound[i][[0, -1]]) < 0.01
    with zipfile.ZipFile(tmp_path / "a.kmz") as content:
        assert sorted(content.namelist()) == ["doc.kml", "files/cost.png", "files/dot.png"]
        text = content.read("doc.kml").decode()
        picture = content.read("files/cost.png")
    assert "http://maps.google.com" not in text  # in the field there is no network
    box = {side: float(re.search(f"<{side}>(.*)</{side}>", text)[1])
           for side in ("west", "south", "east", "north")}  # fmt: skip
    left, bottom, right, top = result.workspace.grid.bounds
    corners = to_degrees(result, [(left, bottom), (left, top), (right, bottom), (right, top)])
    assert box["west"] == pytest.approx(corners[:, 0].min(), abs=1e-4)
    assert box["north"] == pytest.approx(corners[:, 1].max(), abs=1e-4)
    red, green, blue, alpha = np.moveaxis(np.asarray(Image.open(io.BytesIO(picture))), -1, 0)
    for cell in ((1, 1), (2, 3), (0, 0)):
        lon, lat = result.workspace.grid.lonlat(cell)
        col = int((lon - box["west"]) / (box["east"] - box["west"]) * red.shape[1])
        row = int((box["north"] - lat) / (box["north"] - box["south"]) * red.shape[0])
        cost = float(maps["cost"].values[cell])
        if np.isnan(cost):
            assert alpha[row, col] == 0
            continue
        expected = np.array(matplotlib.colormaps["viridis"](cost)[:3]) * 255
        shown = red[row, col], green[row, col], blue[row, col]
        np.testing.assert_allclose(shown, expected, rtol=0.0, atol=15.0)


# --- Foxglove ---


def test_a_scene_is_read_by_mcap_and_its_schemas(result, maps, schedule, tmp_path):
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    frame = Frame((380010.0, 5224920.0), name="odom")
    write_foxglove(tmp_path / "s.mcap", result, maps, frame=frame)
    with (tmp_path / "s.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        found = [(c.topic, s.name, m.log_time, d) for s, c, m, d in reader.iter_decoded_messages()]
    kinds = {topic: kind for topic, kind, *_ in found}
    assert kinds == {
        "/tf": "foxglove.FrameTransforms", "/trustbo/maps": "foxglove.Grid",
        "/trustbo/scene": "foxglove.SceneUpdate",
    }  # fmt: skip
    by_topic = {topic: [(time, m) for on, _, time, m in found if on == topic] for topic in kinds}
    ((start, transforms),) = by_topic["/tf"]
    (one,) = transforms.transforms
    assert (one.parent_frame_id, one.child_frame_id) == ("epsg_32616", "odom")
    shift = np.array([one.translation.x, one.translation.y])
    assert tuple(shift) == frame.origin
    ((_, grid),) = by_topic["/trustbo/maps"]
    rows = len(grid.data) // grid.row_stride
    assert (rows, grid.column_count) == result.workspace.grid.shape
    assert grid.row_stride == grid.column_count * grid.cell_stride
    for field in grid.fields:
        assert field.type == 7  # FLOAT32
        for cell in np.ndindex(rows, grid.column_count):
            at = cell[0] * grid.row_stride + cell[1] * grid.cell_stride + field.offset
            (value,) = np.frombuffer(grid.data[at : at + 4], "<f4")
            x = grid.pose.position.x + (cell[1] + 0.5) * grid.cell_size.x + shift[0]
            y = grid.pose.position.y + (cell[0] + 0.5) * grid.cell_size.y + shift[1]
            expected = maps[field.name].values[result.workspace.grid.cell_at(x, y)]
            np.testing.assert_equal(value, np.float32(expected))
    assert {field.name for field in grid.fields} == set(maps.data_vars)
    (_, scene), *bounds = by_topic["/trustbo/scene"]
    entities = {entity.id: entity for entity in scene.entities}
    for robot, stands in schedule.robots.items():
        (line,) = entities[f"{robot}/way"].lines
        points = np.array([(p.x, p.y) for p in line.points]) + shift
        np.testing.assert_allclose(points[[0, -1]], [stands[0].place, stands[-1].place], atol=1e-6)
        for stand in stands:
            (sphere,) = entities[f"{robot}/{stand.name}"].spheres
            place = sphere.pose.position.x + shift[0], sphere.pose.position.y + shift[1]
            np.testing.assert_allclose(place, stand.place, atol=1e-6)
    assert {entity.frame_id for entity in scene.entities} == {"odom"}
    assert len(bounds) == len(result.plan.path) - 1
    for k, (time, update) in enumerate(bounds):
        assert (time - start) / 1e9 == pytest.approx(schedule.begins[k], abs=1e-6)
        (entity,) = update.entities
        assert entity.id == "bound"  # it replaces that of the bound before
        about = {pair.key: float(pair.value) for pair in entity.metadata}
        assert about["bound"] == k + 1
        assert about["r2"] == pytest.approx(np.clip(result.plan.trust[k, 1], 0.0, 1.0), rel=1e-4)
        _, *sights = entity.lines
        for line, post in zip(sights, result.plan.posts[k], strict=True):
            begins = np.array([line.points[0].x, line.points[0].y]) + shift
            np.testing.assert_allclose(begins, post, rtol=0.0, atol=1e-6)


# --- refusals ---


def test_what_cannot_be_sent_is_refused_before_anything_is_written(
    result, nowhere, tmp_path, monkeypatch
):
    for write, name in (
        (write_kmz, "a.kmz"), (write_qgc, "a.plan"), (write_cot, "a.zip"),
        (write_foxglove, "a.mcap"),
    ):  # fmt: skip
        with pytest.raises(TrustboError, match=r"has a CRS; use|a plan has posts and ways where"):
            write(tmp_path / name, nowhere)
        with pytest.raises(TrustboError, match=rf"must end in .*\{name[1:]}"):
            write(tmp_path / "a.txt", result)
    for start in (datetime(2026, 5, 1), "now"):
        with pytest.raises(TrustboError, match="start must be a datetime with a time zone"):
            write_cot(tmp_path / "a.zip", result, start=start)
    with pytest.raises(TrustboError, match="unknown autopilot 'apm'; choose one of px4, ardupilot"):
        write_qgc(tmp_path / "a.plan", result, autopilot="apm")
    with pytest.raises(TrustboError, match="unknown robot 'r9'; choose one of lead, r1"):
        write_qgc(tmp_path / "a.plan", result, robot="r9")
    extras = (("simplekml", "simplekml", "kmz"), ("foxglove", "foxglove-sdk", "foxglove"))
    for name, needed, kind in extras:
        monkeypatch.setitem(sys.modules, name, None)
        with pytest.raises(TrustboError, match=f"needs? {needed}: .* -m pip install {needed}"):
            export_result(result, tmp_path / "out", ["csv", kind])
    assert list(tmp_path.iterdir()) == []
