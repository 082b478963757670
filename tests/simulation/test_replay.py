"""Replayed missions: by their number, on the path asked for."""

import numpy as np
import pytest

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.simulation import ReplaySimulator

LEFT, MIDDLE = [(2, 0), (1, 0), (0, 0)], [(2, 0), (1, 1), (0, 0)]


def mission(path, rate):
    n = len(path) - 1
    return Mission.from_arrays(path, np.full((n, 1, 2), 0.5), np.full((n, 1), rate))


MISSIONS = [mission(LEFT, 0.1), mission(MIDDLE, 0.2)]


def test_missions_are_replayed_in_their_order():
    replay = ReplaySimulator(MISSIONS)
    assert replay.run(np.array(LEFT), seed=0, mission=0) is MISSIONS[0]
    assert replay.run(MIDDLE, seed=0, mission=1) is MISSIONS[1]
    with pytest.raises(TrustboError):
        replay.run(LEFT, seed=0, mission=2)


def test_another_path_is_refused_unless_any_will_do():
    with pytest.raises(TrustboError):
        ReplaySimulator(MISSIONS).run(MIDDLE, seed=0, mission=0)
    assert ReplaySimulator(MISSIONS, any_path=True).run(MIDDLE, seed=0) is MISSIONS[0]


@pytest.mark.parametrize("missions", [[], MISSIONS[0]])
def test_a_replay_needs_missions(missions):
    with pytest.raises(TrustboError):
        ReplaySimulator(missions)
