"""The set of worlds: its kinds, its rows, and the rule that draws half of it."""

import dataclasses
import hashlib
import itertools

import numpy as np
import pytest

from trustbo.simulation import KinematicSimulator, RadioSimulator
from trustbo.simulation.events import Event
from trustbo.study import worlds
from trustbo.study.world import COURSES, REAL, SIMULATORS, drawn

OLD = {"right": 7, "wall": 3, "bare": 3, "aged": 6, "canopy": 7, "slopes": 3}
"""Worlds of version 0.2 by kind."""
FIXED = "synthetic-0", "synthetic-1", "synthetic-2"


@pytest.fixture(scope="module")
def listed():
    return worlds()


def test_there_are_enough_worlds_of_every_kind(listed):
    by_kind = {}
    for world in listed.values():
        by_kind.setdefault(world.kind, []).append(world)
    assert all(len({world.ground for world in those}) >= 3 for those in by_kind.values())
    assert len(listed) - sum(OLD.values()) >= 24
    assert all(len(by_kind[kind]) >= n for kind, n in OLD.items())
    assert by_kind.keys() == OLD.keys() | {
        "robots", "days", "foul", "change", "jammer", "physics", "shapes", "teams", "four-ways",
    }  # fmt: skip
    assert len(COURSES) == 4
    assert all(name == world.name for name, world in listed.items())
    assert {world.ground for world in listed.values()} >= {*REAL, *FIXED}


def test_the_audit_s_cases_are_rows(listed):
    cases = {world.case for world in listed.values()}
    assert cases >= {"rain", "dead-detector", "jammer-lifted", "thin-canopy"}
    assert listed["synthetic-0"].case == "right"
    rain = listed["synthetic-0-rain"].events
    assert [(e.robot, e.detection, e.first_mission, e.last_mission) for e in rain] == [
        ("r2", 0.3, day, day) for day in (1, 3, 4, 7)
    ]
    (dead,) = listed["synthetic-0-dead-detector"].events
    assert (dead.detection, dead.first_mission, dead.last_mission) == (0.0, 6, None)
    (lifted,) = listed["synthetic-0-jammer-lifted"].events
    assert (lifted.first_mission, lifted.last_mission) == (0, 5)


def test_no_two_worlds_are_the_same(listed):
    for one, other in itertools.combinations(listed.values(), 2):
        assert dataclasses.replace(one, name=other.name, kind=other.kind) != other


def test_assumed_teams_differ_from_the_true_ones_where_robots_do(listed):
    for world in listed.values():
        unlike = world.kind == "robots"
        assert unlike == (world.assumed_team is not None)
        assert unlike == (len({*world.team.robots}) > 1)
        if unlike:
            assert world.assumed_team.names == world.team.names
            assert len({*world.assumed_team.robots}) == 1


def test_at_least_half_of_the_new_worlds_are_drawn_by_rule(listed):
    new = list(listed.values())[sum(OLD.values()) :]
    by_rule = [world for world in new if world.ground not in (*FIXED, *REAL)]
    by_rule += [world for world in new if world.ground in REAL and world.events]
    assert 2 * len(by_rule) >= len(new)


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
        radio = world.simulate == "radio"
        assert isinstance(simulator, RadioSimulator if radio else KinematicSimulator)
        assert len(getattr(simulator, "events", ())) == len(world.events)
        assert all(isinstance(event, Event) for event in world.events)
        seeds.add(float(small.true_terrain()["dem"].mean()))
    assert {world.simulate for world in listed.values()} == SIMULATORS.keys()
    assert len(seeds) == 6  # terrains
