"""The set of worlds: its kinds, its cases, and the events that names draw."""

import dataclasses
import hashlib
import itertools

import numpy as np
import pytest
from world_set import REAL, drawn, worlds

from trustbo.simulation import KinematicSimulator, RadioSimulator, Truth
from trustbo.simulation.events import Event
from trustbo.simulation.replicates import table_of


@pytest.fixture(scope="module")
def listed():
    return worlds()


def test_every_kind_is_of_three_terrains_or_more(listed):
    by_kind = {}
    for world in listed.values():
        by_kind.setdefault(world.kind, set()).add(world.ground)
    assert all(len(grounds) >= 3 for grounds in by_kind.values())
    assert all(name == world.name for name, world in listed.items())
    assert set.union(*by_kind.values()) >= set(REAL)


def test_cases_are_named_and_dated(listed):
    cases = {world.case for world in listed.values()}
    assert cases >= {"rain", "dead-detector", "jammer-lifted", "thin-canopy"}
    assert listed["synthetic-0"].case == "right"
    rain = listed["synthetic-0-rain"].events
    assert [(e.robot, e.detection, e.first, e.last) for e in rain] == [
        ("r2", 0.3, day, day) for day in (1, 3, 4, 7)
    ]
    (dead,) = listed["synthetic-0-dead-detector"].events
    assert (dead.detection, dead.first, dead.last) == (0.0, 6, None)
    (lifted,) = listed["synthetic-0-jammer-lifted"].events
    assert (lifted.first, lifted.last) == (0, 5)


def test_no_two_worlds_are_the_same(listed):
    for one, other in itertools.combinations(listed.values(), 2):
        assert dataclasses.replace(one, name=other.name, kind=other.kind) != other


def test_assumed_teams_differ_from_the_true_ones_where_robots_do(listed):
    for world in listed.values():
        unlike = world.kind == "robots"
        assert (unlike or world.kind == "limit") == (world.assumed_team is not None)
        assert unlike == (len({*world.team.robots}) > 1)
        if unlike:
            assert world.assumed_team.names == world.team.names
            assert len({*world.assumed_team.robots}) == 1


def test_limits_are_assumed_wrong_for_all_robots_and_nothing_else_is_wrong(listed):
    """By as many degrees as the case says."""
    for world in (world for world in listed.values() if world.kind == "limit"):
        (true,), (assumed,) = (
            {*team.robots, team.lead} for team in (world.team, world.assumed_team)
        )
        excess = np.rad2deg(assumed.max_slope - true.max_slope)
        assert world.case == (f"limit-{excess:.0f}" if excess > 0 else f"limit-low-{-excess:.0f}")
        assert excess == pytest.approx(round(excess))
        assert dataclasses.replace(true, max_slope=assumed.max_slope) == assumed
        assert world.assumed is None
        assert not world.aged
        assert not world.events


LIMITS = [world for world in worlds().values() if world.kind == "limit"]


@pytest.mark.slow  # half a minute each
@pytest.mark.parametrize("world", LIMITS, ids=lambda world: world.name)
def test_under_the_true_limit_a_path_leads_to_the_goal_on_both_courses(world, request):
    """Each bound is run once: by the true limit, bounds always fail or never do."""
    if not world.is_packaged:
        world = dataclasses.replace(world, data=str(request.getfixturevalue("real_data")))
    workspace = world.workspace()
    passed = (
        Truth.from_simulator(world.simulator(workspace), n_replicates=1).bounds["passed"].values
    )
    assert np.nanmin(passed) == 0.0 or "low" in world.case
    # Where every bound that passes keeps all contact, a path that arrives loses none.
    truth = Truth(workspace, table_of(np.where(np.isfinite(passed), 1.0, np.nan), passed))
    for course in ("sw-ne", "nw-se"):
        path = truth.best(*world.ends(course), failures=True)
        assert truth.lost_or_failed(path) == 0.0


def test_the_rule_is_a_hash_of_the_terrain_s_name():
    digest = hashlib.sha256(b"synthetic-alder terrain").digest()
    expected = np.random.default_rng(list(digest)).integers(2**31)
    assert drawn("synthetic-alder", "terrain").integers(2**31) == expected == 1936518304
    assert drawn("tahoe", "days").random() == drawn("tahoe", "days").random()
    assert drawn("tahoe", "days").random() != drawn("tahoe", "place").random()
    again, before = worlds(), worlds()
    assert again == before


def test_worlds_of_synthetic_terrain_can_be_made(listed):
    """Small ones, of each case: events fit the terrain, simulators take what is true."""
    one_of_each = {world.case: world for world in listed.values() if world.is_made}
    seeds = set()
    for world in one_of_each.values():
        small = dataclasses.replace(world, shape=(3, 3), cell=20.0)
        simulator = small.simulator(small.workspace(bounds=False))
        assert isinstance(simulator, RadioSimulator if world.radio else KinematicSimulator)
        if isinstance(simulator, RadioSimulator):  # not a hash of heights, which are rounded
            assert simulator.seed == drawn(world.ground, "radio").integers(2**31)
        assert len(getattr(simulator, "events", ())) == len(world.events)
        assert all(isinstance(event, Event) for event in world.events)
        seeds.add(float(small.true_terrain()["dem"].mean()))
    assert len(seeds) == len({world.ground for world in one_of_each.values()})  # terrains
