"""The radio simulator: its truth against quadrature and its own missions."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import t as student
from worlds import contact_along, hillside, random_cells, terrain_of

from trustbo.errors import TrustboError
from trustbo.simulation import RadioSimulator, Truth
from trustbo.simulation.radio import expected_rate
from trustbo.team import Robot, Team
from trustbo.workspace import Sight, Workspace

PATH = ((2, 0), (1, 1), (1, 2), (0, 1))


@pytest.fixture(scope="module")
def radio():
    return RadioSimulator(Workspace.from_terrain(hillside(), (3, 3)))


@pytest.mark.parametrize("mean", [0.02, 0.3, 0.5, 0.97])
def test_the_expected_rate_is_that_of_quadrature(mean):
    noise = student(3.0, scale=0.06)
    middle, _ = quad(lambda x: (mean + x) * noise.pdf(x), -mean, 1.0 - mean, epsabs=1e-12)
    expected = middle + noise.sf(1.0 - mean)
    assert expected_rate(np.array(mean)) == pytest.approx(expected, rel=1e-9)


def test_its_truth_is_the_mean_of_its_missions(radio):
    known, n = Truth.from_simulator(radio), 1500
    rates = np.stack([radio.run(PATH, seed=seed).contact_rate.mean(1) for seed in range(n)])
    error = rates.std(0) / n**0.5
    np.testing.assert_array_less(np.abs(contact_along(known, PATH) - rates.mean(0)), 4.5 * error)
    assert known.at(7) is known
    best = known.best((2, 0), (0, 2))
    assert known.lost(best) <= known.lost(((2, 0), (1, 1), (0, 2)))


def test_contact_is_the_formula_of_distance_canopy_and_field():
    """On flat ground without canopy the field and the radio alone count; a canopy costs by c d."""
    ground = np.zeros((90, 90))
    bare, grown = (
        Workspace.from_terrain(terrain_of(ground, height), (3, 3)) for height in (0.0, 5.0)
    )
    one, other = (RadioSimulator(workspace, seed=3).mean for workspace in (bare, grown))

    def logit(p):
        return np.log(p / (1.0 - p))

    rest = logit(one) - 2.2  # .27 tanh(g) + q
    robots = rest - rest[:1]
    np.testing.assert_allclose(robots, robots[:, :1, :1, :1] * np.ones_like(robots), atol=1e-12)
    tanh = (rest - rest.mean((1, 2, 3), keepdims=True)) / 0.27
    # In full canopy c = 1: -3.5 d, and 1.3 in place of 0.3 before the field.
    d = np.hypot(*np.array([[-1, -1, -1, 0, 0, 1, 1, 1], [-1, 0, 1, -1, 1, -1, 0, 1]])) * 0.5
    lost = (logit(one) - logit(other) - 3.5 * d[:, None, None])[0]
    offset = lost + 0.9 * tanh[0]  # up to the mean of the field's tanh
    np.testing.assert_allclose(offset, offset.mean(), atol=1e-9)


def test_it_shares_nothing_with_line_of_sight():
    terrain = hillside()
    short = Team(robots=(Robot(lidar_range=5.0, detection=0.1),) * 3)
    one = RadioSimulator(Workspace.from_terrain(terrain, (3, 3), sight=Sight(extinction=1.0)))
    own = RadioSimulator(Workspace.from_terrain(terrain, (3, 3), short))
    np.testing.assert_array_equal(one.mean, own.mean)


def test_missions_are_seeded_and_the_field_is_drawn_from_the_terrain(radio):
    a, b, c = (radio.run(PATH, seed=seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(a.contact_rate, b.contact_rate)
    assert not np.array_equal(a.contact_rate, c.contact_rate)
    assert RadioSimulator(radio.workspace).describe() == radio.describe()
    assert not np.allclose(RadioSimulator(radio.workspace, seed=1).mean, radio.mean)


def test_a_true_terrain_is_read_like_other_terrains(radio):
    terrain = radio.workspace.terrain
    given = RadioSimulator(radio.workspace, terrain=terrain)
    assert given.describe() == radio.describe()
    np.testing.assert_array_equal(given.mean, radio.mean)

    south_first = RadioSimulator(radio.workspace, terrain=terrain.sortby("y"))
    np.testing.assert_array_equal(south_first.mean, radio.mean)

    elsewhere = terrain.assign_coords(x=terrain["x"] + 1000.0)
    with pytest.raises(TrustboError, match="covers"):
        RadioSimulator(radio.workspace, terrain=elsewhere)
    other_zone = terrain.rio.write_crs("EPSG:32617")
    with pytest.raises(TrustboError, match="CRS"):
        RadioSimulator(radio.workspace, terrain=other_zone)


def test_a_workspace_without_terrain_is_refused():
    with pytest.raises(TrustboError):
        RadioSimulator(random_cells())
