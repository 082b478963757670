"""Real-time awareness of the paper: the map fused with the robot's state."""

import numpy as np
import pytest
from worlds import hillside

from trustbo.errors import TrustboError
from trustbo.simulation import KinematicSimulator
from trustbo.simulation.realtime import RealtimeAwareness, lidar_state
from trustbo.team import Team
from trustbo.workspace import Workspace

PATHS = ([(2, 0), (1, 1), (0, 2)], [(0, 0), (1, 0), (1, 1)], [(2, 2), (1, 2), (0, 1)])


@pytest.fixture(scope="module")
def simulator():
    return KinematicSimulator(Workspace.from_terrain(hillside(), (3, 3)))


@pytest.fixture(scope="module")
def missions(simulator):
    return [simulator.run(path, seed=seed) for path in PATHS for seed in range(12)]


@pytest.mark.filterwarnings("ignore:the first component of", "ignore:.*enters its composite")
def test_awareness_is_the_first_component_of_map_and_state(simulator, missions):
    realtime = RealtimeAwareness(simulator, missions)
    measured = realtime.measured(missions[0])
    assert measured.awareness.shape == missions[0].awareness.shape
    np.testing.assert_array_equal(measured.contact_rate, missions[0].contact_rate)
    fused = measured.awareness[..., :2]
    assert ((fused >= 0.0) & (fused <= 1.0)).all()
    assert not np.allclose(fused, missions[0].awareness[..., :2])
    np.testing.assert_array_equal(measured.awareness[..., 2], missions[0].awareness[..., 2])


@pytest.mark.filterwarnings("ignore:the first component of", "ignore:.*enters its composite")
def test_inputs_are_those_of_the_way(simulator, missions):
    inputs = RealtimeAwareness(simulator, missions).inputs(missions[0].bounds[0])
    motion, sensing = inputs["traversability"], inputs["visibility"]
    assert (motion["speed_ratio"] > 0.5).all()
    assert (np.hypot(motion["pitch"], motion["roll"]) < np.pi / 4).all()
    assert ((sensing["visible_share"] >= 0.0) & (sensing["visible_share"] <= 1.0)).all()
    assert (sensing["return_range"] <= 45.0 + 1e-9).all()


def test_on_open_ground_all_beams_are_clear(missions):
    terrain = hillside()
    terrain["dem"][:] = 0.0
    terrain["dsm"] = terrain["dem"].copy()
    flat = KinematicSimulator(
        Workspace.from_terrain(terrain, (3, 3), Team(1), bounds=False,
                               features={"traversability": ["slope", "tri"]})
    )  # fmt: skip
    seen = lidar_state(flat.world(), missions[0].bounds[0].poses[:, 1:2])
    return_range, visible = seen["return_range"], seen["visible_share"]
    np.testing.assert_allclose(visible, 1.0)
    np.testing.assert_allclose(return_range, 45.0)


def test_few_missions_are_refused(simulator, missions):
    with pytest.raises(TrustboError):
        RealtimeAwareness(simulator, missions[:2])
