"""Candidates of changes against changes enumerated one by one."""

import numpy as np
import pytest
from missions import walking_missions

from trustbo.data import Mission
from trustbo.models.effects.change import RADII, RATE, Candidates, Change
from trustbo.models.effects.effect import Slots
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.place import bounds_of, visited
from trustbo.stacking import stack_missions

SIDE = 5


def slots_of(missions, n_robots=3):
    missions = [
        Mission.from_arrays(m.path, m.awareness[:, :n_robots], m.contact_rate[:, :n_robots])
        for m in missions
    ]
    batch = stack_missions(missions)
    bounds = bounds_of(missions, batch.contact_rate.shape[:2])
    places = visited(bounds, PlaceEffect(), n_robots, (SIDE, SIDE))
    return Slots.of(batch, len(missions), ("line_of_sight", "slope"), None, places)


def until_last_rate(slots):
    """Slots whose drift reaches a rate."""
    seen = ~np.isnan(slots.y)
    return np.array([k <= np.flatnonzero(one)[-1] for one in seen for k in range(len(one))])


def enumerated(slots, n_robots, sides):
    """Column, prior odds and change of every start and profile, one by one."""
    n, ahead = slots.n_missions, until_last_rate(slots)
    mission = np.repeat(slots.mission, slots.y.shape[1])
    centres = [(row, col) for row in range(SIDE) for col in range(SIDE)]
    profiles = [("all", (), 0.2)]
    profiles += [("robot", (i,), 0.4 / n_robots) for i in range(n_robots)]
    profiles += [("area", (*c, r), 0.4 / 3 / SIDE**2) for r in RADII for c in centres]
    for kind, where, share in profiles:
        whole = Change(kind, where, 0).group(slots).columns.toarray()[:, 0] * ahead
        met = np.unique(mission[whole != 0.0])
        for j in range(n):
            if (met < j).sum() >= sides[0] and (met >= j).sum() >= sides[1]:
                yield whole * (mission >= j), RATE / (1 - RATE) * share, Change(kind, where, j)


@pytest.mark.parametrize(("n_robots", "sides"), [(3, (2, 2)), (3, (1, 1)), (1, (2, 1))])
def test_candidates_are_all_changes_that_the_paths_separate(n_robots, sides):
    """Equal ones are one candidate, which has the sum of their prior odds."""
    slots = slots_of(walking_missions(3, 7), n_robots)
    odds, changes = {}, {}
    for column, weight, change in enumerated(slots, n_robots, sides):
        key = column.tobytes() + bytes(change.kind == "area")
        odds[key] = odds.get(key, 0.0) + weight
        changes.setdefault(key, set()).add(change)
    candidates, ahead = Candidates.of(slots, sides), until_last_rate(slots)
    assert any(len(some) > 1 for some in changes.values())
    assert len(candidates.first) == len(odds)
    columns, ours = candidates.columns.toarray(), {}
    for i, first in enumerate(candidates.first):
        later = (candidates.run == candidates.run[first]) & (
            np.arange(len(candidates.run)) >= first
        )
        column, change = columns[:, later].sum(1), candidates.change(i)
        key = column.tobytes() + bytes(change.kind == "area")
        ours[key] = np.exp(candidates.log_odds[i])
        for one in (change, *candidates.ties(i)):
            again = one.group(slots).columns.toarray()[:, 0] * ahead
            np.testing.assert_array_equal(again, column)
            assert one in changes[key]
        starts = range(candidates.earliest[first], change.from_mission + 1)
        assert {Change(change.kind, change.where, j) for j in starts} <= changes[key]
    assert ours == pytest.approx(odds, rel=1e-12)


def test_of_equal_areas_the_smallest_stands_for_all():
    slots = slots_of(walking_missions(3, 7))
    candidates = Candidates.of(slots)
    for i in range(len(candidates.first)):
        change = candidates.change(i)
        for other in candidates.ties(i):
            assert other.where[2:] >= change.where[2:]


def test_one_robot_is_all_robots():
    candidates = Candidates.of(slots_of(walking_missions(3, 7), 1))
    kinds = [candidates.change(i).kind for i in range(len(candidates.first))]
    assert "all" in kinds
    assert "robot" not in kinds


def test_an_area_has_the_cells_within_its_radius():
    cells = np.stack(np.meshgrid(np.arange(9), np.arange(9), indexing="ij"), axis=-1)
    met = [Change("area", (4, 4, radius), 0).met(cells) for radius in RADII]
    assert [one.sum() for one in met] == [1, 5, 21]
    assert met[2][2, 3]
    assert not met[2][2, 2]
    assert Change("robot", (1,), 0).met(cells).all()


def test_without_places_only_robots_change():
    slots = slots_of(walking_missions(3, 7))._replace(places=None)
    candidates = Candidates.of(slots)
    kinds = {candidates.change(i).kind for i in range(len(candidates.first))}
    assert kinds == {"all", "robot"}


def test_few_missions_have_no_candidates():
    assert len(Candidates.of(slots_of(walking_missions(3, 3))).first) == 0


def test_a_change_is_in_units_of_stationary_trust():
    slots = slots_of(walking_missions(3, 7))
    group = Change("robot", (1,), 4).group(slots)
    theta = {"rest": np.array([0.5, 0.8])}
    np.testing.assert_allclose(group.prior(theta).sd, [[0.25], [0.4]])
    named = group.name(np.array([[0.2], [0.2]]), theta, np.random.default_rng(0))
    np.testing.assert_allclose(named["change"], [0.4, 0.25])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (Change("all", (), 3), "all robots, from mission 3"),
        (Change("robot", (1,), 2), "robot 1, from mission 2"),
        (Change("area", (4, 5, 2), 6), "area within 2 of (4, 5), from mission 6"),
    ],
)
def test_a_change_is_named(change, text):
    assert str(change) == text
