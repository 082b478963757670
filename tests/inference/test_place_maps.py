"""Draws of effects in bounds that were not visited, against their distribution in closed form."""

import numpy as np
import pytest
from scipy.stats import norm

import trustbo as tb
from trustbo.inference.place_maps import place_group, place_maps_of
from trustbo.models.visited import visited

N_DRAWS, SHAPE = 20_000, (3, 3)
TAU, FLOOR = 0.1, 0.3
SIGHT = (0.0, 0.4, 0.9, 1.0)
"""Mean line of sight of the robots by move, in the middle of the map."""
VISITED = (5, 1, 1)


@pytest.fixture(scope="module")
def workspace():
    z = np.full((2, 8, *SHAPE, 1), 0.7)
    apart = np.array([0.0, 0.1, 0.1, 0.0])
    z[0, : len(SIGHT), 1, 1, 0] = SIGHT + apart
    z[1, : len(SIGHT), 1, 1, 0] = SIGHT - apart
    return tb.Workspace.from_awareness(z, features=("line_of_sight",))


def drawn(workspace, f_e=1.0):
    """Return effects (draw, move, row, col), of which those in one bound are 0.7."""
    places = visited(np.array([[VISITED]]), SHAPE)
    draws = {
        "place": np.zeros((1, N_DRAWS, 1)),
        "place_bound": np.full((1, N_DRAWS, 1), 0.7),
        "place_robot": np.zeros((1, N_DRAWS, 1, 2)),
    }
    group = place_group(draws, places, ["r1", "r2"], f_e=f_e, seed=5)
    values = {"tau_s": 0.0, "length_scale": 2.0, "tau_e": TAU}
    values = {name: np.full(N_DRAWS, value) for name, value in values.items()}
    return place_maps_of(group, values, workspace)["place_bound"][:, 0]


def test_a_driven_bound_teaches_the_other_sets_of_posts_of_the_same_bound():
    """Two of three sets were driven; the third has the conditional normal of all three."""
    z = np.full((2, 24, *SHAPE, 1), 0.7)
    z[:, 21, 1, 1] = 0.9
    space = tb.Workspace.from_awareness(z, features=("line_of_sight",))
    places = visited(np.array([[VISITED, (13, 1, 1)]]), SHAPE)
    known = np.random.default_rng(0).normal(0.05, 0.1, (1, N_DRAWS, 2))
    draws = {
        "place": np.zeros((1, N_DRAWS, 1)),
        "place_bound": known,
        "place_robot": np.zeros((1, N_DRAWS, 2, 2)),
    }
    values = {"tau_s": 0.0, "length_scale": 2.0, "tau_e": TAU}
    values = {name: np.full(N_DRAWS, value) for name, value in values.items()}
    group = place_group(draws, places, ["r1", "r2"], f_e=FLOOR, seed=5)
    e = place_maps_of(group, values, space)["place_bound"][:, 0]
    np.testing.assert_array_equal(e[:, [5, 13], 1, 1], known[0])

    m = np.array([0.7, 0.7, 0.9])
    sd = TAU * np.sqrt(FLOOR**2 + (1.0 - FLOOR**2) * 4.0 * m * (1.0 - m))
    cov = np.outer(sd, sd) * (0.5 + 0.5 * np.eye(3))
    gain = np.linalg.solve(cov[:2, :2], cov[:2, 2])
    rest = e[:, 21, 1, 1] - known[0] @ gain
    assert distance(rest, norm(scale=np.sqrt(cov[2, 2] - cov[2, :2] @ gain)).cdf) < 0.02

    # Without a driven set, those of a bound are alike, and those of other bounds are not.
    free = e[:, [0, 8, 16, 1], 2, 2]
    expected = 0.5 + 0.5 * np.eye(4)
    expected[3, :3] = expected[:3, 3] = 0.0
    ordinary = (np.abs(free) < 0.2).all(1)  # the map is wrong in a few draws, independently
    assert np.abs(np.corrcoef(free[ordinary].T) - expected).max() < 0.15


def distance(draws, cdf):
    """Return the largest distance of the empirical distribution from a continuous one."""
    x = np.sort(draws)
    return np.abs(cdf(x) - (np.arange(len(x)) + 0.5) / len(x)).max()


def test_effects_are_normal_except_for_few_that_are_large_and_lead_to_the_middle(workspace):
    e = drawn(workspace, f_e=FLOOR)
    np.testing.assert_allclose(e[:, *VISITED], 0.7)

    for move, m in enumerate(SIGHT):
        sign = 1.0 if m < 0.5 else -1.0
        sd = TAU * np.sqrt(FLOOR**2 + (1.0 - FLOOR**2) * 4.0 * m * (1.0 - m))
        mean = 0.05 * 3.0 * TAU * np.sqrt(2.0 / np.pi)

        def cdf(x, sd=sd, mean=mean, sign=sign):
            # That of the effects before they are centred, of which 5 % are half-normal.
            u = sign * x + mean
            p = 0.95 * norm.cdf(u / sd) + 0.05 * np.maximum(
                2.0 * norm.cdf(u / TAU / 3.0) - 1.0, 0.0
            )
            return p if sign > 0.0 else 1.0 - p

        assert e[:, move, 1, 1].mean() == pytest.approx(0.0, abs=1e-12)
        assert distance(e[:, move, 1, 1], cdf) < 0.02
        far = np.mean(sign * e[:, move, 1, 1] > 0.4)
        assert far == pytest.approx(0.05 * 2.0 * norm.sf((0.4 + mean) / TAU / 3.0), rel=0.2)
    assert np.abs(np.corrcoef(e[:, : len(SIGHT), 1, 1].T) - np.eye(len(SIGHT))).max() < 0.03


def test_all_effects_are_normal_where_no_line_of_sight_gives_them_a_scale(workspace):
    for e in (drawn(workspace), drawn(None, f_e=FLOOR)):
        assert e.shape == (N_DRAWS, 8, *SHAPE)
        assert distance(e[:, 0, 1, 1], norm(scale=TAU).cdf) < 0.02
        assert np.abs(e[:, 0]).max() < 6.5 * TAU
