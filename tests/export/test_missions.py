"""A plan with its times for Foxglove, as others read it."""

import dataclasses
import sys
from itertools import pairwise

import numpy as np
import pytest

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.export import Frame, export_result, write_foxglove
from trustbo.export.schedule import schedule_of

ROBOTS = ("lead", "r1", "r2", "r3")


@pytest.fixture(scope="module")
def schedule(result):
    return schedule_of(result.plan)


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
    with pytest.raises(TrustboError, match="a plan has posts and ways where"):
        write_foxglove(tmp_path / "a.mcap", nowhere)
    with pytest.raises(TrustboError, match=r"must end in .*\.mcap"):
        write_foxglove(tmp_path / "a.txt", result)
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(TrustboError, match=r"need foxglove-sdk: .* -m pip install foxglove-sdk"):
        export_result(result, tmp_path / "out", ["csv", "foxglove"])
    assert list(tmp_path.iterdir()) == []
