"""Effects of robots in bounds, against arrays of all draws in all bounds."""

import numpy as np
import pytest
from scipy import stats

from trustbo.models import TrustParams
from trustbo.models.robots_in_bounds import RobotsInBounds

N_DRAWS, N_ROBOTS, SHAPE = 400, 3, (8, 4, 5)
VISITED = ((0, 1, 2), (7, 3, 4))


@pytest.fixture
def effects():
    rng = np.random.default_rng(0)
    known = rng.normal(size=(N_DRAWS, N_ROBOTS, len(VISITED)))
    known -= known.mean(1, keepdims=True)
    column = np.full(SHAPE, -1)
    for k, bound in enumerate(VISITED):
        column[bound] = k
    return RobotsInBounds(
        known=known,
        column=column,
        tau_r=rng.uniform(0.1, 0.2, N_DRAWS),
        scale=rng.uniform(0.1, 1.0, size=SHAPE),
        number=np.arange(N_DRAWS),
        seed=3,
    )


def test_visited_bounds_have_the_effects_that_are_known(effects):
    found = effects.at(np.array(VISITED))
    np.testing.assert_array_equal(found, effects.known)


def test_other_bounds_have_contrasts_of_independent_normals(effects):
    every = effects.everywhere()
    np.testing.assert_allclose(every.sum(1), 0.0, atol=1e-12)

    # A contrast of n independent normals with standard deviation g tau_r is a normal with it.
    sd = effects.tau_r[:, None, None, None] * effects.scale
    contrast = (every[:, 0] - every[:, 1]) / np.sqrt(2.0) / sd
    other = contrast[:, effects.column < 0]
    assert stats.kstest(other.ravel(), "norm").pvalue > 0.001
    for correlation in (np.corrcoef(other.T), np.corrcoef(other)):
        off = correlation - np.eye(len(correlation))
        n = other.size / len(correlation)
        assert np.abs(off).max() < 5.5 / np.sqrt(n)


def test_without_visited_bounds_all_effects_are_drawn(effects):
    nowhere = effects._replace(known=effects.known[..., :0], column=np.full(SHAPE, -1))
    every = effects.everywhere()
    is_new = effects.column < 0
    np.testing.assert_array_equal(nowhere.everywhere()[:, :, is_new], every[:, :, is_new])
    np.testing.assert_array_equal(nowhere.mean().everywhere(), np.zeros((1, N_ROBOTS, *SHAPE)))


def test_effects_do_not_depend_on_the_bounds_or_draws_that_are_asked_for(effects):
    every = effects.everywhere()
    bounds = np.array([[1, 0, 0], [0, 1, 2], [-1, -1, -1], [7, 2, 3]])
    found = effects.at(bounds)
    for k, (move, row, col) in enumerate(bounds):
        expected = 0.0 if move < 0 else every[:, :, move, row, col]
        np.testing.assert_array_equal(found[..., k], np.broadcast_to(expected, found.shape[:2]))

    some = np.array([5, 5, 399])
    np.testing.assert_array_equal(effects.draw(some).everywhere(), every[some])
    again = effects.draw(some).draw(np.array([1, 2]))
    np.testing.assert_array_equal(again.everywhere(), every[[5, 399]])
    assert not np.array_equal(effects._replace(seed=4).everywhere(), every)


def test_inputs_of_robots_include_their_effects_and_those_of_the_team_do_not(effects):
    rng = np.random.default_rng(1)
    n = np.full(N_DRAWS, 0.1)
    place = rng.normal(size=(N_DRAWS, 1, *SHAPE[1:]))
    plain = TrustParams(n, rng.normal(size=(N_DRAWS, 2)), n, n, n, place=place)
    params = plain.replace(place_robot=effects)
    z = rng.uniform(size=(N_ROBOTS, *SHAPE, 2))
    every = effects.everywhere()
    np.testing.assert_allclose(params.inputs(z), plain.inputs(z) + every, atol=1e-12)

    bounds = np.array([*VISITED, (2, 2, 2)])
    along = z[:, *bounds.T]
    expected = plain.inputs(along, bounds) + every[:, :, *bounds.T]
    np.testing.assert_allclose(params.inputs(along, bounds), expected, atol=1e-12)
    team = plain.team_inputs(along, bounds)
    np.testing.assert_allclose(params.team_inputs(along, bounds), team, atol=1e-12)


def test_selected_and_averaged_parameters_keep_the_effects(effects):
    rng = np.random.default_rng(1)
    n = np.full(N_DRAWS, 0.1)
    place = rng.normal(size=(N_DRAWS, 1, *SHAPE[1:]))
    params = TrustParams(
        n, rng.normal(size=(N_DRAWS, 2)), n, n, n, place=place, place_robot=effects
    )
    bounds = np.array([*VISITED, (2, 2, 2)])
    z = rng.uniform(size=(N_ROBOTS, len(bounds), 2))
    inputs = params.inputs(z, bounds)

    some = np.array([3, 8])
    np.testing.assert_array_equal(params.draw(some).inputs(z, bounds), inputs[some])
    known = slice(len(VISITED))
    [mean] = params.mean().inputs(z, bounds)
    np.testing.assert_allclose(mean[:, known], inputs.mean(0)[:, known], atol=1e-12)
