"""Truth: tables against missions, best paths against enumeration, files."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import xarray as xr
from disks import full_disk
from enumeration import every_path
from worlds import contact_along, hillside, random_cells

from trustbo.data import POST_SETS, Mission
from trustbo.errors import TrustboError
from trustbo.planning import NoPathError
from trustbo.simulation import KinematicSimulator, Truth
from trustbo.simulation.replicates import edges_of, table_of
from trustbo.team import Robot, Team
from trustbo.terrain import TRAVERSABILITY
from trustbo.workspace import Workspace
from trustbo.workspace.moves import existing_bounds

PATH = ((2, 0), (1, 1), (1, 2), (0, 1))


@pytest.fixture(scope="module")
def wooded():
    return KinematicSimulator(Workspace.from_terrain(hillside(), (3, 3), n_posts=1))


@pytest.fixture(scope="module")
def with_sets():
    return KinematicSimulator(Workspace.from_terrain(hillside(), (3, 3)))


@pytest.fixture(scope="module")
def of_wooded(wooded):
    return Truth.from_simulator(wooded, n_replicates=6)


def grid(shape=(3, 4), walls=()):
    passable = np.ones(shape, bool)
    for wall in walls:
        passable[wall] = False
    return Workspace.from_awareness(np.full((1, *shape, 2), 0.5), passable)


def made_up(workspace, rng, some_fail=True, n_posts=1):
    """Truth with contact and probabilities to pass drawn at random."""
    shape = 8 * n_posts, *workspace.passable.shape, 8 * n_posts + 1
    contact, passed = np.full(shape, np.nan), np.full(shape, np.nan)
    for edge in edges_of(workspace, n_posts):
        for n in edge.next_ways:
            contact[edge.way, *edge.cell, n] = rng.uniform()
            passed[edge.way, *edge.cell, n] = rng.choice([0.0, 0.6, 1.0]) if some_fail else 1.0
    return Truth(workspace, table_of(contact, passed))


def test_the_table_is_the_mean_of_many_missions(wooded, of_wooded):
    missions = [wooded.run(PATH, seed=seed) for seed in range(200)]
    rates = np.mean([mission.contact_rate for mission in missions], axis=(0, 2))
    # Looks add .5 / sqrt(3 x 60 ticks x 200) = .003; the first bound begins in position, which the
    # table averages with arrivals.
    np.testing.assert_allclose(contact_along(of_wooded, PATH), rates, atol=0.02)
    assert of_wooded.lost(PATH) == pytest.approx(3.0 - rates.sum(), abs=0.03)
    assert of_wooded.lost_or_failed(PATH) == of_wooded.lost(PATH)


def test_the_table_of_several_sets_is_the_mean_of_many_missions(with_sets):
    truth = Truth.from_simulator(with_sets, n_replicates=4)
    path = ((2, 0, "far"), (1, 1), (1, 2, "route"), (0, 1))
    missions = [with_sets.run(path, seed=seed) for seed in range(200)]
    lost = 3.0 - np.mean([mission.contact_rate for mission in missions], axis=(0, 2)).sum()
    assert truth.lost(path) == pytest.approx(lost, abs=0.05)
    assert truth.lost(path) != truth.lost(PATH)  # cells, whose set is the standard one


def test_replicates_of_another_seed_agree(wooded, of_wooded):
    other = Truth.from_simulator(wooded, n_replicates=3, seed=1).bounds
    gap = (of_wooded.bounds["contact"] - other["contact"]).values
    assert np.sqrt(np.nanmean(gap**2)) < 0.015


def test_tracks_that_outlast_misses_are_simulated():
    robot = Robot(acquire=2, drop=3)
    workspace = Workspace.from_terrain(
        hillside(60.0, 60.0), (2, 2), Team(robots=(robot,), lead=robot)
    )
    simulator = KinematicSimulator(workspace)
    found, path = Truth.from_simulator(simulator, n_replicates=20), ((1, 0), (0, 0), (0, 1))
    rates = np.mean([simulator.run(path, seed=s).contact_rate for s in range(150)], axis=(0, 2))
    np.testing.assert_allclose(contact_along(found, path), rates, atol=0.05)


def test_cached_truths_of_two_terrains_are_two(wooded, tmp_path):
    features = {"traversability": TRAVERSABILITY}  # of the ground alone
    bare = hillside()
    bare["dsm"].values[:] = bare["dem"].values
    for terrain in (bare, hillside()):
        workspace = Workspace.from_terrain(
            terrain, (3, 3), Team(1), features=features, bounds=False
        )
        simulator = KinematicSimulator(workspace)
        cached = Truth.from_simulator(simulator, n_replicates=1, folder=tmp_path)
        xr.testing.assert_identical(
            cached.bounds, Truth.from_simulator(simulator, n_replicates=1).bounds
        )
    assert len(list(tmp_path.iterdir())) == 2


def test_a_full_disk_leaves_no_damaged_table_in_the_cache(wooded, tmp_path):
    simulator = KinematicSimulator(wooded.workspace)
    with full_disk(), pytest.raises(TrustboError, match="truth"):
        Truth.from_simulator(simulator, n_replicates=1, folder=tmp_path)
    assert not list(tmp_path.iterdir())


def test_bounds_that_fail_say_so_and_keep_no_contact(wooded):
    simulator = KinematicSimulator(wooded.workspace, bound_timeout=5.0)  # nobody arrives in 5 s
    found = Truth.from_simulator(simulator, n_replicates=1)
    exists = existing_bounds(simulator.workspace.passable.values)
    assert (found.bounds["passed"].values[exists, 8] == 0.0).all()
    assert found.lost(PATH) == found.lost_or_failed(PATH) == 3.0


def test_a_time_limit_whose_ticks_exhaust_the_memory_is_refused(wooded):
    with pytest.raises(TrustboError, match="bound_timeout"):
        KinematicSimulator(wooded.workspace, bound_timeout=1e12)


class Undescribed:
    """Simulator of a user: contact .2 along rows, .8 otherwise; none if it goes on to the east."""

    def __init__(self, workspace):
        self.workspace = workspace

    def run(self, path, *, seed, mission=0):
        noise = 0.05 * np.random.default_rng(seed).uniform(-1.0, 1.0)
        rate = 0.2 if path[1][0] == path[0][0] else 0.8
        rate = 0.0 if len(path) > 2 and path[2] == (path[1][0], path[1][1] + 1) else rate + noise
        n = len(path) - 1
        return Mission.from_arrays(path, np.full((n, 1, 2), np.nan), np.full((n, 1), rate))


class Plain(Undescribed):
    def describe(self):
        return {"simulator": "plain"}


def test_truths_of_unknown_settings_are_not_cached(tmp_path):
    """Two such simulators would share a file, whatever their contact is."""
    with pytest.raises(TrustboError, match="describe"):
        Truth.from_simulator(Undescribed(grid((2, 2))), n_replicates=2, folder=tmp_path)
    assert not list(tmp_path.iterdir())


def test_any_simulator_has_a_truth():
    found = Truth.from_simulator(Undescribed(grid((2, 3))), n_replicates=30)
    rates = contact_along(found, [(0, 0), (1, 0), (1, 1), (1, 2), (0, 2)])
    np.testing.assert_allclose(rates, [0.0, 0.0, 0.2, 0.8], atol=0.025)


class Partial(Undescribed):
    """Simulator of two robots, of which it often measures one and sometimes none."""

    def run(self, path, *, seed, mission=0):
        rates = super().run(path, seed=seed, mission=mission).contact_rate[:, [0, 0]]
        rates[0, : seed % 3] = np.nan
        return Mission.from_arrays(path, np.full((*rates.shape, 2), np.nan), rates)


def test_rates_that_are_not_measured_are_left_out_of_the_truth():
    found = Truth.from_simulator(Partial(grid((2, 3))), n_replicates=30)
    rates = contact_along(found, [(0, 0), (1, 0), (1, 1), (1, 2), (0, 2)])
    np.testing.assert_allclose(rates, [0.0, 0.0, 0.2, 0.8], atol=0.03)
    assert len(found.best((0, 0), (0, 2))) > 2

    unknown = np.full((8, 2, 3, 9), np.nan)
    with pytest.raises(NoPathError):
        Truth(grid((2, 3)), table_of(unknown, unknown)).best((0, 0), (0, 2))


def test_a_truth_is_found_once_and_read_from_its_file_again(tmp_path, monkeypatch):
    first = Truth.from_simulator(Plain(grid((2, 2))), n_replicates=2, folder=tmp_path)
    monkeypatch.setattr(Plain, "run", None)  # would be an error
    again = Truth.from_simulator(Plain(grid((2, 2))), n_replicates=2, folder=tmp_path)
    xr.testing.assert_equal(again.bounds, first.bounds)
    for options in ({"n_replicates": 3}, {"n_replicates": 2, "seed": 1}):
        with pytest.raises(TypeError):
            Truth.from_simulator(Plain(grid((2, 2))), folder=tmp_path, **options)
    with pytest.raises(TypeError):
        Truth.from_simulator(Plain(grid((2, 3))), n_replicates=2, folder=tmp_path)
    patient = Team(robots=(Robot(acquire=3),))
    with pytest.raises(TypeError):
        Truth.from_simulator(
            Plain(replace(grid((2, 2)), team=patient)), n_replicates=2, folder=tmp_path
        )


@pytest.mark.parametrize("failures", [False, True])
@pytest.mark.parametrize("max_bounds", ["shortest", "shortest+2", 6])
def test_the_best_path_is_that_of_enumeration(max_bounds, failures):
    rng = np.random.default_rng(3)
    for seed in range(3):
        workspace, ends = grid(walls=[(1, seed)]), ((2, 0), (0, 3))
        truth = made_up(workspace, rng)
        measure = truth.lost_or_failed if failures else truth.lost
        options = {"max_bounds": max_bounds}
        best = truth.best(*ends, **options, failures=failures)
        u_turns = isinstance(max_bounds, int)
        bounds = workspace.passable_bounds.values
        every = every_path(bounds, *ends, 6, u_turns=False)
        shortest = min(len(path) - 1 for path in every)
        longest = 6 if u_turns else shortest + int(max_bounds.partition("+")[2] or 0)
        admissible = every_path(bounds, *ends, longest, u_turns=u_turns)
        assert best in admissible
        assert measure(best) == pytest.approx(min(map(measure, admissible)), rel=1e-12)
        if not failures:
            kept = len(best) - 1 - truth.lost(best)
            lacking = (truth.lost(admissible[0]) - truth.lost(best)) / kept
            regret = truth.regret(admissible[0], **options)
            assert regret == pytest.approx(100.0 * lacking)


@pytest.mark.parametrize("failures", [False, True])
def test_the_best_path_with_sets_is_that_of_enumeration(failures):
    workspace, ends = grid((3, 3)), ((2, 0), (0, 2))
    truth = made_up(workspace, np.random.default_rng(5), n_posts=2)
    measure = truth.lost_or_failed if failures else truth.lost
    best = truth.best(*ends, max_bounds=4, failures=failures)
    every = [
        [*zip(*zip(*path[:-1], strict=True), names, strict=True), path[-1]]
        for path in every_path(workspace.passable_bounds.values, *ends, 4, u_turns=True)
        for names in product(POST_SETS[:2], repeat=len(path) - 1)
    ]
    assert measure(best) == pytest.approx(min(map(measure, every)), rel=1e-12)


def test_impossible_truths_are_refused():
    with pytest.raises(TrustboError):
        Truth.from_simulator(object())
    truth = made_up(random_cells(), np.random.default_rng(0))
    with pytest.raises(TrustboError):
        truth.lost([(2, 0), (0, 2)])
    with pytest.raises(TrustboError):
        truth.best((2, 0), (0, 2), "longest")
