"""Missions of logs: windows, crossings, leads, masks, the sensor, and joined missions."""

import numpy as np
import pytest
from scipy.special import expit

import trustbo as tb
from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.logs import Log, fit_sensor, geometry, join_missions, missions_of, synthetic_log


@pytest.fixture(scope="module")
def log():
    return synthetic_log(3, 8.0, seed=4)


@pytest.fixture(scope="module")
def known(log):
    return geometry(log)


@pytest.fixture(scope="module")
def sensor(known):
    return fit_sensor(known)


def test_rates_are_shares_of_ticks_with_contact(log, known):
    missions = missions_of(log, 20.0)
    assert len(missions) == 3
    contact = known["contact"].values
    for j, mission in enumerate(missions):
        assert not mission.has_map
        assert len(mission.bounds) == 24
        assert mission.robots == log.robots
        assert np.isnan(mission.contact_rate[:, j]).all()
        assert (mission.awareness[:, j] == 0.0).all()
        for i in {0, 1, 2} - {j}:
            expected = contact[i, j, :480].reshape(24, 20).mean(1)
            np.testing.assert_allclose(mission.contact_rate[:, i], expected)
            np.testing.assert_array_equal(mission.n_ticks[:, i], 20.0)
        assert ((mission.awareness >= 0.0) & (mission.awareness <= 1.0)).all()
    r = float(known["range"].median())
    near = (r / (r + known["range"].values[1, 0, :20])).mean()
    np.testing.assert_allclose(missions[0].awareness[0, 1, 0], near)


def test_a_sensor_gives_the_log_odds_of_the_share_that_it_expects(log, known, sensor):
    (mission,) = missions_of(log, 10.0, lead="r2", sensor=sensor, geometry=known)
    assert mission.features == ("expected",)
    share = sensor.predict(known).values[0, 1, :10].mean() * 10.0
    expected = np.log((share + 0.05) / (10.0 - share + 0.05))
    np.testing.assert_allclose(mission.awareness[0, 0, 0], expected)


def test_a_sensor_finds_the_chance_that_detections_were_drawn_with():
    rng = np.random.default_rng(0)
    log = synthetic_log(4, 20.0, seed=1)
    known = geometry(log)
    away, bearing = known["range"].values, np.abs(known["bearing"].values)
    truth = expit(2.0 - 0.6 * away - 3.0 * np.maximum(bearing - 0.6, 0.0))
    drawn = known.assign(
        contact=known["contact"].copy(
            data=np.where(np.isnan(away), np.nan, rng.random(away.shape) < truth)
        )
    )
    sensor = fit_sensor(drawn, ["range", "bearing"])
    there = np.isfinite(away)
    fresh = drawn.copy()  # as if of another log: the fit itself
    error = (sensor.predict(fresh).values - truth)[there]
    # 14 400 ticks and 19 coefficients: an rms error of some (19 / 14 400 x p(1 - p))^(1/2).
    assert np.sqrt((error**2).mean()) < 3.0 * np.sqrt(19 / 14_400 * 0.1)
    left_out = (sensor.predict(drawn).values - truth)[there]
    assert np.sqrt((left_out**2).mean()) < 4.0 * np.sqrt(19 / 14_400 * 0.1)
    assert (left_out != error).all()
    entropy = -(truth * np.log(truth) + (1 - truth) * np.log1p(-truth))[there].mean()
    assert abs(sensor.log_score + entropy) < 0.02


def test_ticks_in_which_nobody_could_see_are_none(log, known):
    def could(geometry):
        return (np.abs(geometry["bearing"]) < 0.6) & (geometry["range"] < 5.5)

    mission = missions_of(log, 20.0, lead="r1", could_see=could)[0]
    there = could(known).values[1, 0, :480].reshape(24, 20)
    n = there.sum(1)
    np.testing.assert_array_equal(np.nan_to_num(mission.n_ticks[:, 1]), n)
    assert np.isnan(mission.contact_rate[n == 0, 1]).all()
    seen = (known["contact"].values[1, 0, :480].reshape(24, 20) * there).sum(1)
    np.testing.assert_allclose((mission.contact_rate * mission.n_ticks)[n > 0, 1], seen[n > 0])
    assert np.isfinite(mission.awareness).all()
    with pytest.raises(TrustboError, match="could_see must return booleans over"):
        missions_of(log, could_see=lambda geometry: True)


def test_leads_may_change(log):
    missions = missions_of(log, 20.0, lead=[(0.0, "r1"), (100.0, "r3"), (300.0, "r1")])
    assert [np.isnan(m.contact_rate).all(0).argmax() for m in missions] == [0, 2, 0]
    assert [len(m.bounds) for m in missions] == [5, 10, 9]
    assert [len(m.bounds) for m in missions_of(log, 20.0, lead="r1", length=10)] == [10, 10, 4]
    joined = join_missions(missions_of(log, 20.0, lead="r1", length=10))
    whole = missions_of(log, 20.0, lead="r1")[0]
    np.testing.assert_array_equal(joined.contact_rate, whole.contact_rate)
    assert [b.t0 for b in joined.bounds] == [b.t0 for b in whole.bounds]


def test_poses_that_are_lost_are_not_measured():
    whole = synthetic_log(3, 4.0, seed=0)
    tracks = np.concatenate(whole.tracks)
    robot = np.repeat(whole.robots, [len(track) for track in whole.tracks])
    t, x, y, heading = tracks.T
    kept = ~((robot == "r2") & (t > 60.0) & (t < 120.0))
    columns = {"t": t, "robot": robot, "x": x, "y": y, "heading": heading}
    poses = {name: values[kept] for name, values in columns.items()}
    watcher, seen = (np.array(whole.robots)[whole.detections[:, k].astype(int)] for k in (1, 2))
    log = Log(poses, {"t": whole.detections[:, 0], "watcher": watcher, "seen": seen})
    mission = missions_of(log, 20.0, lead="r1")[0]
    assert np.isnan(mission.contact_rate[3:6, 1]).all()
    assert np.isfinite(mission.contact_rate[[2, 6], 1]).all()
    assert np.isfinite(mission.contact_rate[:, 2]).all()
    mean = np.delete(mission.awareness[:, 1], [3, 4, 5], axis=0).mean(0)
    np.testing.assert_allclose(mission.awareness[4, 1], mean)


def test_crossings_between_cells_are_bounds():
    workspace = tb.Workspace.from_awareness(np.full((2, 2, 4, 1), 0.5), cell_size=10.0)
    west, south = workspace.grid.corner
    y = south + 5.0
    t = np.arange(0.0, 61.0)
    x = west + np.minimum(2.0 + 0.5 * t, 31.0)
    x[45:55], x[55:] = west - 500.0, west + 5.0  # carried off, and to the first cell
    poses = {"t": np.tile(t, 2), "robot": ["lead"] * 61 + ["watch"] * 61,
             "x": np.append(x, x), "y": np.full(122, y), "heading": np.zeros(122)}  # fmt: skip
    seen = {"t": [20.2, 21.3], "watcher": ["watch"] * 2, "seen": ["lead"] * 2}
    log = Log(poses, seen)
    (mission,) = missions_of(log, lead="lead", workspace=workspace)
    assert mission.path == ((1, 0), (1, 1), (1, 2))
    np.testing.assert_allclose(mission.duration[:, 1], [20.0, 8.0])
    np.testing.assert_allclose(mission.contact_rate[:, 1], [2.0 / 20.0, 0.0])


def test_missions_that_do_not_continue_each_other_are_not_joined():
    z, y = np.full((2, 1, 2), 0.5), np.full((2, 1), 0.5)
    one = Mission.from_arrays([(0, 0), (0, 1), (0, 2)], z, y, duration=3.0 * np.ones(2))
    two = Mission.from_arrays([(0, 2), (0, 3), (0, 2)], z, y)
    joined = join_missions([one, two])
    assert joined.path == ((0, 0), (0, 1), (0, 2), (0, 3), (0, 2))
    assert joined.bounds[2].t0 == 6.0
    failed = Mission.from_arrays(one.path, z, y, failed_at=2, reason="stuck")
    assert join_missions([one, Mission.from_arrays([(0, 2)] + [(0, 1)] * 2, z, y, failed_at=2)])
    for given, message in (
        ([], "at least one mission"),
        ([two, two, one], r"mission 2 begins in \(0, 0\), and the one before ended in \(0, 2\)"),
        ([failed, two], "mission 0 ended 'stuck': no other continues it"),
        ([one, Mission.from_arrays(None, z, y)], "mission 1 has a path"),
        ([one, Mission.from_arrays([(0, 2)] * 3, z[..., :1], y)], "other robots or features"),
    ):
        with pytest.raises(TrustboError, match=message):
            join_missions(given)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"window": 0.2}, "shorter than a tick"),
        ({"window": -1.0}, "window must be positive"),
        ({"window": 400.0}, "the log of 480 s has no two bounds of 400 s"),
        ({"lead": "r9"}, "r9"),
        ({"lead": 3}, "lead must be"),
        ({"sensor": 3}, "Sensor"),
    ],
)
def test_odd_options_have_one_line_each(log, options, message):
    with pytest.raises(TrustboError, match=message):
        missions_of(log, **options)


def test_sensors_need_contact_and_its_absence(known):
    with pytest.raises(TrustboError, match="variable of the geometry"):
        fit_sensor(known, ["rnge"])
    with pytest.raises(TrustboError, match="a sensor needs 5 ticks with contact and without"):
        fit_sensor(known.assign(contact=known["contact"] * 0.0))
    sensor = fit_sensor(known, ["range"])
    with pytest.raises(TrustboError, match="the geometry lacks range"):
        sensor.predict(known.drop_vars("range").assign(range_=known["range"]))
