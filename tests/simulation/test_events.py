"""Events: each changes what is simulated, the truth of its missions and the description alike."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.special import ndtri
from worlds import contact_along, hillside

from trustbo.errors import TrustboError
from trustbo.simulation import (
    Degradation,
    Dust,
    Fouling,
    Jam,
    KinematicSimulator,
    Season,
    Trees,
    Truth,
)
from trustbo.simulation.events import Event
from trustbo.workspace import Sight, Workspace

PATH = ((1, 0), (0, 1), (1, 1), (0, 2), (1, 2))


@dataclass(frozen=True)
class Night(Event):
    """Event of a user: nobody but the lead detects anything."""

    def change(self, world):
        return world._replace(detection=0.0 * world.detection)


EVENTS = {
    "jam": lambda xy: Jam(xy, 30.0, strength=0.5, first=1),
    "one lidar": lambda xy: Degradation("r2", 0.2, first=1),
    "dust": lambda xy: Dust(0.5, first=1),
    "felled": lambda xy: Trees(0.0, xy, 60.0, first=1),
    "grown": lambda xy: Trees(9.0, xy, 30.0, first=1),
    "season": lambda xy: Season(3.0, first=1),
    "custom": lambda xy: Night(first=1),
    "fouling": lambda xy: Fouling(0.1, 0.2, every=4, first=1),
}


@pytest.fixture(scope="module")
def wooded():
    return Workspace.from_terrain(hillside(60.0, 90.0), (2, 3))


def test_an_event_acts_in_its_missions_alone(wooded):
    plain = KinematicSimulator(wooded)
    dusty = KinematicSimulator(wooded, events=[Dust(0.3, first=3, last=4)])
    expected = plain.run(PATH, seed=0).contact_rate
    for mission in (0, 2, 5):
        rates = dusty.run(PATH, seed=0, mission=mission).contact_rate
        np.testing.assert_array_equal(rates, expected)
    for mission in (3, 4):
        rates = dusty.run(PATH, seed=0, mission=mission).contact_rate
        assert (rates < expected).all()


@pytest.mark.parametrize("name", EVENTS)
def test_the_truth_of_a_mission_with_an_event_is_the_mean_of_many(wooded, name):
    scrub = wooded.terrain.assign(dsm=wooded.terrain["dem"] + 2.0)  # higher than the sensors
    thin = Sight(extinction=0.03, crown_base=0.3)
    event = EVENTS[name](wooded.grid.center((0, 1)))
    simulator = KinematicSimulator(wooded, terrain=scrub, sight=thin, events=[event])
    known, n = Truth.from_simulator(simulator), 120
    # The runs of a mission share the factors of fouling.
    numbers = range(1, n + 1) if name == "fouling" else [1] * n
    drawn = [simulator.run(PATH, seed=j, mission=m) for j, m in enumerate(numbers)]
    rates = np.mean([mission.contact_rate for mission in drawn], axis=(0, 2))[1:]
    # Fouling has sd .26 / sqrt(120) = .024, three replicates some .02. The first bound begins in
    # position and is left out.
    contact = contact_along(known.at(1), PATH)
    np.testing.assert_allclose(contact[1:], rates, atol=0.06)
    before = contact_along(known.at(0), PATH)
    assert np.abs(contact - before)[1:].max() > 0.03


def test_days_with_the_same_weather_have_one_truth(wooded, tmp_path):
    rain = [Degradation("r2", 0.2, first=day, last=day) for day in (1, 3)]
    known = Truth.from_simulator(
        KinematicSimulator(wooded, events=rain), n_replicates=1, folder=tmp_path
    )
    assert known.at(1) is known.at(3)
    assert known.at(0) is known.at(2) is known.at(4)
    assert len(list(tmp_path.iterdir())) == 2
    other = KinematicSimulator(wooded, events=[Degradation("r2", 0.2)])
    Truth.from_simulator(other, n_replicates=1, folder=tmp_path)  # the world of rain
    assert len(list(tmp_path.iterdir())) == 2


def test_fouling_is_uniform_in_the_long_run_and_carries_over(wooded):
    def factors(event, mission):
        world = KinematicSimulator(wooded, events=[event]).world(mission)
        return world.detection  # (bound, robot)

    event = Fouling(0.2, 0.9, every=16, seed=4)
    both = np.concatenate([factors(event, 0), factors(event, 1)])
    np.testing.assert_array_equal(both, factors(Fouling(0.2, 0.9, every=32, seed=4), 0))
    several = np.stack([factors(Fouling(0.2, 0.9, seed=s), 2) for s in range(400)])
    assert ((several >= 0.2) & (several <= 1.0)).all()
    n, sd = 3 * 400, 0.8 / math.sqrt(12.0)
    assert several[:, 0].mean() == pytest.approx(0.6, abs=4.0 * sd / math.sqrt(n))
    z = ndtri((several - 0.2) / 0.8)
    for lag in (1, 15):
        r = np.corrcoef(z[:, 0].ravel(), z[:, lag].ravel())[0, 1]
        # 4 standard errors of a correlation, (1 - r^2) / sqrt(n).
        assert r == pytest.approx(0.9**lag, abs=4.0 * (1.0 - 0.81**lag) / math.sqrt(n))
    mean = KinematicSimulator(wooded, events=[event]).world(5, long_run=True).detection
    np.testing.assert_allclose(mean, 0.6)


def test_foulings_of_different_periods_multiply(wooded):
    short, long = Fouling(0.2, every=3, seed=1), Fouling(0.5, every=5, seed=2)
    plain = KinematicSimulator(wooded).world(1).detection
    one, other = (KinematicSimulator(wooded, events=[e]).world(1).detection for e in (short, long))
    assert (len(one), len(other)) == (3, 5)
    for events in ((short, long), (long, short)):
        both = KinematicSimulator(wooded, events=events).world(1).detection
        last = np.minimum(np.arange(5), 2)  # the last row applies to all later bounds
        np.testing.assert_allclose(both, one[last] * other / plain, rtol=1e-12)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Dust(1.5),
        lambda: Degradation("r1", math.nan),
        lambda: Season(0.0),
        lambda: Season(2.0, first=3, last=2),
        lambda: Trees(-1.0, (0, 0), 1.0),
        lambda: Jam((0, 0), 1.0, strength=2.0),
        lambda: Jam((0, 0), 1.0, strength="strong"),
        lambda: Jam((0, 0), "y"),
        lambda: Jam((0, math.nan), 1.0),
        lambda: Jam(3, 1.0),
        lambda: Trees(1.0, (0, 0), "y"),
        lambda: Trees("tall", (0, 0), 1.0),
        lambda: Fouling(0.1, every=0),
    ],
)
def test_impossible_events_are_refused(make):
    with pytest.raises(TrustboError):
        make()


@pytest.mark.parametrize("event", [Trees(0.0, (-9e5, 0.0), 9.0), Degradation("r9", 0.5), 3])
def test_events_that_do_not_fit_the_terrain_or_the_team_are_refused(wooded, event):
    with pytest.raises(TrustboError):
        KinematicSimulator(wooded, events=[event])
