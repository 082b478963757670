"""Events: each changes what is simulated, the truth of its missions and the description alike."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.special import ndtri
from worlds import hillside

from trustbo.errors import TrustboError
from trustbo.simulation import (
    Degradation,
    Dust,
    Fouling,
    KinematicSimulator,
    Season,
    Threat,
    Truth,
    Vegetation,
    truth,
)
from trustbo.simulation.events import Event
from trustbo.workspace import Workspace

PATH = ((1, 0), (0, 1), (1, 1), (0, 2), (1, 2))


@dataclass(frozen=True)
class Night(Event):
    """Event of a user: nobody but the lead detects anything."""

    first_mission: int = 0
    last_mission: int | None = None

    def change(self, world):
        return world._replace(detection=0.0 * world.detection)


EVENTS = {
    "jam": lambda xy: Threat("jam", xy, 30.0, strength=0.5, first_mission=1),
    "one lidar": lambda xy: Degradation("r2", 0.2, 1),
    "dust": lambda xy: Dust(0.5, 1),
    "felled": lambda xy: Vegetation(0.0, xy, 60.0, first_mission=1),
    "grown": lambda xy: Vegetation(9.0, xy, 30.0, first_mission=1),
    "season": lambda xy: Season(3.0, 1),
    "custom": lambda xy: Night(1),
    "fouling": lambda xy: Fouling(0.1, 0.2, every=4, first_mission=1),
}


@pytest.fixture(scope="module")
def wooded():
    # By posts that see all, vegetation would hide nothing.
    return Workspace.from_terrain(hillside(60.0, 90.0), (2, 3))


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    return tmp_path_factory.mktemp("truth")


def test_without_events_missions_are_those_of_a_simulator_without_any(wooded):
    event = Dust(0.5, 3)
    plain, dusty = KinematicSimulator(wooded), KinematicSimulator(wooded, events=[event])
    expected = plain.run(PATH, seed=0).contact_rate
    np.testing.assert_array_equal(dusty.run(PATH, seed=0, mission=2).contact_rate, expected)
    assert (dusty.run(PATH, seed=0, mission=3).contact_rate <= expected).all()


@pytest.mark.parametrize("name", EVENTS)
def test_the_truth_of_a_mission_with_an_event_is_the_mean_of_many(wooded, kept, name):
    event = EVENTS[name](wooded.grid.center((0, 1)))
    simulator, n = KinematicSimulator(wooded, events=[event]), 250
    known = Truth.of(simulator, folder=kept)
    if name == "fouling":  # the runs of a mission share its factors
        drawn = [simulator.run(PATH, seed=j, mission=j) for j in range(1, n + 1)]
    else:
        drawn = simulator.run_batch(PATH, range(n), mission=1)
    rates = np.mean([mission.contact_rate for mission in drawn], axis=0)[1:]
    # Scans add .5 / sqrt(60 ticks x 250 missions) = .004, fouling .26 / sqrt(250) = .016 at most,
    # and the table its own error. The first bound begins in position, so it is left out.
    tabulated = known.at(1).bounds.contact(PATH)[1:]
    np.testing.assert_allclose(tabulated, rates, atol=0.045 if name == "fouling" else 0.03)
    assert tabulated.mean() == pytest.approx(rates.mean(), abs=0.012)
    before = known.at(0).bounds.contact(PATH)[1:]
    assert np.abs(tabulated - before).max() > 0.03


def test_days_with_the_same_weather_have_one_truth(wooded, kept, monkeypatch):
    Truth.of(KinematicSimulator(wooded), folder=kept)
    rain = [Degradation("r2", 0.2, day, day) for day in (1, 3)]
    known = Truth.of(KinematicSimulator(wooded, events=[*rain, Dust(0.5, 3)]), folder=kept).at(1)
    monkeypatch.setattr(truth, "tabulate", None)  # would be an error
    again = Truth.of(KinematicSimulator(wooded, degradations=rain), folder=kept)
    assert again.at(1) is again.at(3)
    assert again.at(0) is again.at(2) is again.at(4)
    assert again.at(3).value(PATH) == known.value(PATH)
    with pytest.raises(TypeError):
        known.at(3)  # rain and dust


def test_events_are_described(wooded):
    simulator = KinematicSimulator(wooded, events=[Season(3.0, 6)], degradations=[])
    assert simulator.describe()["events"] == [
        {"event": "Season", "extinction": 3.0, "first_mission": 6, "last_mission": None}
    ]
    assert simulator.describe_mission(6)["acting"] == [{"event": "Season", "extinction": 3.0}]
    assert simulator.describe_mission(5) == KinematicSimulator(wooded).describe_mission(0)


def test_fouling_is_uniform_in_the_long_run_and_carries_over():
    event = Fouling(0.2, 0.9, every=16, seed=4)
    f = event.factors(400, 0, 2), event.factors(400, 1, 2)
    assert f[0].tolist() == event.factors(399, 16, 2).tolist()  # the time between missions
    several = np.array([
        [Fouling(0.2, 0.9, seed=s).factors(2, k, 4) for k in (1, 2, 17)] for s in range(800)
    ])  # fmt: skip
    n = several[:, 0].size
    assert ((several >= 0.2) & (several <= 1.0)).all()
    sd = 0.8 / math.sqrt(12.0)
    assert several.mean() == pytest.approx(event.mean, abs=4.0 * sd / math.sqrt(n))
    assert several.std() == pytest.approx(sd, rel=0.03)
    z = ndtri((several - 0.2) / 0.8)
    # 4 standard errors of a correlation: (1 - r^2) / sqrt(n).
    for step, lag in ((1, 1), (2, 16)):
        r = np.corrcoef(z[:, 0].ravel(), z[:, step].ravel())[0, 1]
        assert r == pytest.approx(0.9**lag, abs=4.0 * (1.0 - 0.81**lag) / math.sqrt(n))
    robots = np.corrcoef(z[:, 0].T)
    assert np.abs(robots[np.triu_indices(4, 1)]).max() < 4.0 / math.sqrt(800)
    drawn = event.draw(np.random.default_rng(0), n)
    assert drawn.mean() == pytest.approx(event.mean, abs=4.0 * sd / math.sqrt(n))


def test_fouling_is_that_of_the_bound_and_not_of_the_run(wooded):
    simulator = KinematicSimulator(wooded, events=[Fouling(0.0, 0.9, seed=1)])
    whole = simulator.run(PATH, seed=5, mission=2).contact_rate
    simulator.reset(PATH[0], 5, next_cell=PATH[1], mission=2)
    ahead = (*PATH[2:], None)
    bounds = [
        simulator.run_bound(k, cell, next_cell=after)
        for k, (cell, after) in enumerate(zip(PATH[1:], ahead, strict=True), start=1)
    ]
    np.testing.assert_array_equal([bound.contact_rate for bound in bounds], whole)


class Own(KinematicSimulator):
    """Simulator of a user, whose bounds are replicated one by one."""


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Dust(1.5), r"detection must be in \[0, 1\]; got 1.5"),
        (lambda: Season(0.0), "extinction must be positive and finite; got 0"),
        (lambda: Season(2.0, 3, 2), "last_mission must be a whole number from 3 on; got 2"),
        (lambda: Vegetation(3.0), "a vegetation is either a circle, .* or a polygon"),
        (lambda: Vegetation(-1.0, (0, 0), 1.0), "height must be 0 or positive, m; got -1"),
        (lambda: Fouling(-0.1), r"worst must be in \[0, 1\]; got -0.1"),
        (lambda: Fouling(0.1, 1.0), r"correlation must be in \[0, 1\); got 1.0"),
        (lambda: Fouling(0.1, every=0), "every must be a whole number from 1 on; got 0"),
    ],
)
def test_impossible_events_are_refused(make, message):
    with pytest.raises(TrustboError, match=message):
        make()


def test_events_that_a_simulator_cannot_have_are_refused(wooded):
    for events, message in (
        (Dust(0.5), r"events must be a list, \[Event\(\.\.\.\)\]; got Dust"),
        ([Vegetation(0.0, (-9e5, 0.0), 9.0)], "Vegetation.* has no pixel of the terrain"),
        ([Degradation("r9", 0.5)], "unknown robot 'r9'; choose one of r1, r2, r3"),
    ):
        with pytest.raises(TrustboError, match=message):
            KinematicSimulator(wooded, events=events)
    with pytest.raises(TrustboError, match=r"bounds of Own are replicated .* no long run of Foul"):
        Truth.of(Own(wooded, events=[Fouling(0.1)]))
