"""Tracks, worse lidars, threats, states: what a mission measures, and why."""

import math

import numpy as np
import pytest
from worlds import hillside

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.logs.netcdf import STATES
from trustbo.simulation import Degradation, KinematicSimulator, Threat
from trustbo.simulation.measure import REALTIME
from trustbo.simulation.sensing import contact_of, new_tracks
from trustbo.team import Robot, Team
from trustbo.terrain import CompositeIndex, synthetic_terrain
from trustbo.workspace import Workspace
from trustbo.workspace.sight import Sight, detection_probability

PATH = [(2, 0), (1, 1), (0, 2)]
CIRCLE = {"center": (0, 0), "radius": 1}


@pytest.fixture(scope="module")
def flat():
    terrain = synthetic_terrain((90.0, 90.0), seed=5, relief=0.5)
    terrain["dsm"] = terrain["dem"].copy()
    return Workspace.from_terrain(
        terrain, (3, 3), bounds=False, features={"traversability": ["slope", "tri"]}
    )


@pytest.fixture(scope="module")
def wooded():
    return Workspace.from_terrain(hillside(), (3, 3))


def track_by_hand(looks, acquire, drop):
    """The same rule, said plainly."""
    tracked, streak, contact = False, 0, []
    for found in looks:
        streak = streak + 1 if found != tracked else 0
        if streak == (drop if tracked else acquire):
            tracked, streak = not tracked, 0
        contact.append(tracked)
    return contact


@pytest.mark.parametrize(("acquire", "drop"), [(1, 1), (3, 1), (1, 4), (2, 3)])
def test_a_track_begins_after_some_finds_and_ends_after_some_misses(acquire, drop):
    looks = np.random.default_rng(0).random((200, 3)) < 0.6
    robots = [Robot(acquire=acquire, drop=drop)] * 3
    tracks = new_tracks(3)
    contact = np.concatenate(  # in two pieces: the state is carried over
        [contact_of(part, robots, tracks[0]) for part in (looks[:77], looks[77:])]
    )
    for i in range(3):
        assert contact[:, i].tolist() == track_by_hand(looks[:, i], acquire, drop)
    if acquire == drop == 1:
        np.testing.assert_array_equal(contact, looks)


def test_a_worse_lidar_has_less_contact(flat):
    poor = Robot(detection=0.6)
    team = Team(robots=(poor, Robot(), Robot()))
    workspace = Workspace.from_terrain(
        flat.terrain, (3, 3), team, features={"traversability": ["slope", "tri"]}
    )
    missions = KinematicSimulator(workspace, sight="bare").run_batch(PATH, range(20))
    watching = [m.contact_rate for m in missions]
    rates = np.mean(watching, axis=(0, 1))
    # T2 looks about half of the time, then the lead does, whose lidar is good.
    leading = np.mean([b.contact[:, 1].mean() for m in missions for b in m.bounds])
    assert leading == 1.0
    assert 0.7 < rates[0] < 0.9
    np.testing.assert_array_equal(rates[1:], 1.0)
    with pytest.raises(TrustboError, match=r"Robot.detection must be in \(0, 1\]; got 1.5"):
        Robot(detection=1.5)
    with pytest.raises(
        TrustboError, match=r"Robot.acquire must be a whole number from 1 on; got 0.5"
    ):
        Robot(acquire=0.5)


def test_a_lidar_that_degrades_is_noticed_by_the_model(flat):
    simulator = KinematicSimulator(
        flat, sight="bare", degradations=[Degradation("r2", 0.2, first_mission=6)]
    )
    missions = [simulator.run(PATH, seed=j, mission=j) for j in range(12)]
    before, after = (
        np.mean([m.contact_rate for m in part], axis=(0, 1))
        for part in (missions[:6], missions[6:])
    )
    np.testing.assert_array_equal(before, 1.0)
    assert after[1] < 0.75
    np.testing.assert_array_equal(after[[0, 2]], 1.0)
    # A little noise: rates that are all 1 have no Gaussian likelihood.
    rng = np.random.default_rng(0)
    noisy = []
    for m in missions:
        rates = np.clip(m.contact_rate - rng.uniform(0.0, 0.05, m.contact_rate.shape), 0.0, 1.0)
        noisy.append(tb.Mission.from_arrays(m.path, m.awareness, rates))
    model = tb.models.CoupledTrust(inter_robot="none")
    posteriors = (tb.fit(part, model, "exact", check=False) for part in (noisy[:6], noisy[6:]))
    early, late = (p["latent"]["trust_mean"].mean(("mission", "bound")) for p in posteriors)
    drop = (early - late).values
    assert drop[1] > 0.2
    assert (np.abs(drop[[0, 2]]) < 0.1).all()


def test_a_jam_hides_those_inside_while_it_is_there(flat):
    x, y = flat.grid.center((1, 1))
    jam = Threat("jam", center=(x, y), radius=40.0, first_mission=2, last_mission=3)
    simulator = KinematicSimulator(flat, sight="bare", threats=[jam])
    rates = [simulator.run(PATH, seed=0, mission=j).contact_rate[0].mean() for j in range(5)]
    assert rates[0] == rates[1] == rates[4] == 1.0
    assert rates[2] == rates[3] < 0.3
    half = KinematicSimulator(
        flat, sight="bare", threats=[Threat("jam", (x, y), 40.0, strength=0.5)]
    )
    assert rates[2] < half.run(PATH, seed=0).contact_rate[0].mean() < 1.0


def test_nobody_goes_through_forbidden_ground(flat):
    grid = flat.grid
    wall = [(grid.left, grid.top - 40.0), (grid.left + 90.0, grid.top - 40.0),
            (grid.left + 90.0, grid.top - 44.0), (grid.left, grid.top - 44.0)]  # fmt: skip
    simulator = KinematicSimulator(flat, threats=[Threat("forbid", polygon=wall, first_mission=1)])
    assert simulator.run(PATH, seed=0).status == "ok"
    cut_off = simulator.run(PATH, seed=0, mission=1)
    assert cut_off.status == "stuck"
    assert all((b.poses[..., 1] < grid.top - 44.0).all() for b in cut_off.bounds)


@pytest.mark.parametrize("cell", PATH)
def test_a_mission_into_or_out_of_a_forbidden_cell_is_stuck(flat, cell):
    x, y = flat.grid.center(cell)
    square = [(x - 15, y - 15), (x + 15, y - 15), (x + 15, y + 15), (x - 15, y + 15)]
    simulator = KinematicSimulator(flat, threats=[Threat("forbid", polygon=square)])
    mission = simulator.run(PATH, seed=0)
    assert mission.status == "stuck"
    assert len(mission.bounds) == max(1, PATH.index(cell))  # it gets as far as that


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kind": "smoke"}, "unknown threat 'smoke'; choose one of jam, forbid"),
        ({}, "either a circle, center and radius, or a polygon"),
        ({"polygon": [(0, 0), (1, 1)]}, "a polygon needs three corners"),
        ({"polygon": [(0, 0), (1, 1), (2, math.nan)]}, r"corners .*; got .*nan\)\]"),
        ({"polygon": [(0, 0), (1, 1), (2, "0")]}, r"corners .*; got .*'0'\)\]"),
        ({"polygon": [(0, 0), (1, 1), (2,)]}, r"corners .*; got .*\(2,\)\]"),
        ({"polygon": [(0, 0), (1, 1), (2, 0)], "radius": 3.0}, "either a circle, center and rad"),
        (CIRCLE | {"center": (0.0, math.nan)}, r"center must be x and y .* got \(0\.0, nan\)"),
        (CIRCLE | {"center": ("0", 0.0)}, r"center must be x and y .* got \('0', 0\.0\)"),
        (CIRCLE | {"center": 3.0}, "center must be x and y in CRS metres; got 3.0"),
        (CIRCLE | {"radius": -1}, "radius must be positive"),
        (CIRCLE | {"radius": math.nan}, "radius must be positive and finite; got nan"),
        (CIRCLE | {"radius": "5"}, "radius must be positive and finite; got '5'"),
        (CIRCLE | {"strength": math.nan}, r"strength must be in \(0, 1\]; got nan"),
        (CIRCLE | {"strength": "1"}, r"strength must be in \(0, 1\]; got '1'"),
        (CIRCLE | {"strength": 0}, r"strength must be in \(0, 1\]"),
        (CIRCLE | {"first_mission": 3, "last_mission": 2}, "must be a whole number from 3 on"),
    ],
)
def test_impossible_threats_are_refused(arguments, message):
    with pytest.raises(TrustboError, match=message):
        Threat(**{"kind": "jam"} | arguments)


def test_threats_that_act_nowhere_or_are_no_list_are_refused(flat):
    grid = flat.grid
    (left, bottom), right = grid.corner, grid.left + 3 * grid.cell_width
    off = Threat("jam", (right + 50.0, grid.top), 20.0)
    bounds = rf"x from {left:.7g} to {right:.7g} and y from {bottom:.7g} to {grid.top:.7g}"
    with pytest.raises(TrustboError, match=rf"Threat\(kind='jam', .*no pixel .*{bounds}; give CRS"):
        KinematicSimulator(flat, threats=[off])
    lonlat = [(15.0, 50.0), (15.1, 50.0), (15.1, 50.1)]
    with pytest.raises(TrustboError, match=r"Threat\(kind='forbid', .* has no pixel"):
        KinematicSimulator(flat, threats=[Threat("forbid", polygon=lonlat, first_mission=9)])
    for threats in (Threat("jam", grid.center((1, 1)), 20.0), ["jam"], None):
        with pytest.raises(
            TrustboError, match=r"threats must be a list, \[Threat\(\.\.\.\)\]; got"
        ):
            KinematicSimulator(flat, threats=threats)


def test_impossible_degradations_are_refused(flat):
    for value in (2, math.nan, "0.5"):
        with pytest.raises(TrustboError, match=rf"detection must be in \[0, 1\]; got {value!r}"):
            Degradation("r1", value)
    with pytest.raises(TrustboError, match=r"degradations must be a list, .*; got Degradation\("):
        KinematicSimulator(flat, degradations=Degradation("r1", 0.5))
    with pytest.raises(TrustboError, match="unknown robot 'r9'; choose one of r1, r2, r3"):
        KinematicSimulator(flat, degradations=[Degradation("r9", 0.5)])


def test_a_batch_is_the_missions_one_by_one(wooded):
    simulator = KinematicSimulator(wooded, record_states=True)
    batch = simulator.run_batch(PATH, [3, 4, 3])
    for seed, mission in zip([3, 4, 3], batch, strict=True):
        alone = KinematicSimulator(wooded, record_states=True).run(PATH, seed=seed)
        assert alone.status == mission.status
        for one, other in zip(alone.bounds, mission.bounds, strict=True):
            for name in ("awareness", "contact_rate", "duration", "poses", "contact", "states"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert not np.array_equal(batch[0].contact_rate, batch[1].contact_rate)


def test_states_are_those_of_the_way(wooded):
    bound = KinematicSimulator(wooded, record_states=True).run(PATH, seed=0).bounds[0]
    assert bound.states.shape == (len(bound.poses), 3, len(STATES))
    states = dict(zip(STATES, np.moveaxis(bound.states, -1, 0), strict=True))
    standing = (np.diff(bound.poses[:, 1:, :2], axis=0) == 0.0).all(-1)
    np.testing.assert_array_equal(states["speed_ratio"][1:][standing], 0.0)
    assert states["speed_ratio"].max() > 0.5
    assert (np.hypot(states["pitch"], states["roll"]) < np.pi / 4).all()
    assert ((states["visible_share"] >= 0.0) & (states["visible_share"] <= 1.0)).all()
    assert (states["return_range"] <= 45.0 + 1e-9).all()
    assert KinematicSimulator(wooded).run(PATH, seed=0).bounds[0].states is None


@pytest.mark.parametrize("mode", ["bare", "wall", "transmittance"])
def test_states_see_as_far_as_the_simulator_s_sight(wooded, mode):
    """Shares of beams beside rays cast one by one, all around some pixels."""
    reach, robot = 20.0, Robot(lidar_range=20.0)
    workspace = Workspace.from_terrain(wooded.terrain, (3, 3), Team(robots=(robot,)))
    simulator = KinematicSimulator(workspace, sight=mode)
    lidar, surface = simulator._measure._lidar, simulator._surface
    rows, cols = np.random.default_rng(0).integers(21, 90 - 21, (2, 40))
    here = np.stack([surface.origin[0] + cols, surface.origin[1] - rows], axis=1).astype(float)
    angle = 2.0 * np.pi / 12 * np.arange(12)
    there = here[:, None] + reach * np.stack([np.cos(angle), -np.sin(angle)], axis=1)
    ends = np.repeat(here, 12, axis=0), there.reshape(-1, 2)
    cast = detection_probability(surface, Sight(mode), *ends, np.array([1.0, 1.0, np.inf, 1.0]))
    shares = lidar[rows, cols, 1]
    if mode == "wall":  # which also tests the lines that a ray crosses the fewer of
        assert np.abs(shares - cast.reshape(-1, 12).mean(1)).mean() < 0.02
    else:
        np.testing.assert_allclose(shares, cast.reshape(-1, 12).mean(1), atol=1e-4)


@pytest.mark.filterwarnings("ignore:the first component of", "ignore:the loading of")
def test_measured_awareness_can_be_fused_with_the_robots_states(wooded):
    plain = KinematicSimulator(wooded)
    samples = plain.calibration(n_bounds=80)
    indices = {name: CompositeIndex(REALTIME[name]).fit(samples[name]) for name in samples}
    fused = KinematicSimulator(wooded, realtime=indices).run(PATH, seed=0)
    mapped = plain.run(PATH, seed=0)
    np.testing.assert_array_equal(fused.contact_rate, mapped.contact_rate)
    measured = fused.awareness[..., :2]
    assert ((measured >= 0.0) & (measured <= 1.0)).all()
    assert not np.allclose(fused.awareness, mapped.awareness)
    # Missions that are measured together do not see each other's states.
    batch = KinematicSimulator(wooded, realtime=indices).run_batch(PATH, [4, 0, 2])
    np.testing.assert_array_equal(batch[1].awareness, fused.awareness)
    with pytest.raises(TrustboError, match="unknown awareness feature 'trust'"):
        KinematicSimulator(wooded, realtime={"trust": indices["visibility"]})


def test_iterate_tells_the_simulator_which_mission_it_is(flat):
    jam = Threat("jam", flat.grid.center((1, 1)), 60.0, first_mission=1, strength=0.9)
    # Rates that are all 1 would be refused.
    worn = Degradation("r1", 0.8)
    simulator = KinematicSimulator(flat, sight="bare", threats=[jam], degradations=[worn])
    result = tb.iterate(
        flat,
        (2, 0),
        (0, 2),
        n_iterations=2,
        sampler="exact",
        simulator=simulator,
        progress=False,
    )
    first, second = (m.contact_rate[:, 1:].mean() for m in result.missions)
    assert first == 1.0
    assert second < 0.5
