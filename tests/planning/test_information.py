"""How much a path teaches, against a dense joint normal and closed forms."""

import numpy as np
import pytest
from references import dense_coupled
from scipy.stats import multivariate_normal

from trustbo.errors import ShapeError
from trustbo.models import CoupledTrust, HierarchicalTrust, PooledTrust, TrustParams, sample_prior
from trustbo.models.params import CoupledParams
from trustbo.planning.dynamics import transition
from trustbo.planning.information import information_gain, rate_noise

PATH = [(0, 0), (0, 1), (1, 2), (2, 2)]


def prior_draws(model):
    return sample_prior(model, 2, 60, seed=5, n_robots=2)


@pytest.mark.parametrize("model", [PooledTrust(), HierarchicalTrust(), CoupledTrust()])
def test_the_rates_noise_is_that_of_their_joint_normal(model):
    n_bounds, n_robots = 4, 2
    params = prior_draws(model).draw(0)
    if isinstance(params, CoupledParams):
        Q, R = params.Delta_w, params.Delta_v
    else:
        Q, R = (np.eye(n_robots) * np.square(sd) for sd in (params.delta_w, params.delta_v))
    noise = rate_noise(params, n_bounds, n_robots)
    rng = np.random.default_rng(6)
    for _ in range(20):
        y = rng.standard_normal((n_bounds, n_robots))
        expected, _, _ = dense_coupled(
            transition(params, n_robots), np.zeros_like(y), Q, R, 0.0, params.x0_sd, y
        )
        got = multivariate_normal.logpdf(y.ravel(), np.zeros(y.size), noise)
        np.testing.assert_allclose(got, expected, rtol=1e-9)


def test_the_noise_of_a_shorter_mission_is_the_leading_part():
    params = prior_draws(CoupledTrust()).draw(0)
    np.testing.assert_array_equal(rate_noise(params, 2, 2), rate_noise(params, 5, 2)[:4, :4])


def only_b_is_unknown(b):
    """beta0 = 0: rates are b plus independent noise of variance 0.1^2 + 0.2^2."""
    n = len(b)
    return TrustParams(np.zeros(n), np.zeros((n, 2)), b, np.full(n, 0.1), np.full(n, 0.2))


def test_one_unknown_mean_has_a_closed_form():
    b = np.random.default_rng(7).standard_normal(50)
    params, awareness = only_b_is_unknown(b), np.full((3, 3, 3, 2), 0.5)
    gains = information_gain(params, awareness, [PATH, PATH[:2]])
    n_rates = np.array([9, 3])
    np.testing.assert_allclose(gains, 0.5 * np.log1p(n_rates * b.var() / 0.05), rtol=1e-9)


def test_one_unknown_weight_is_learned_where_awareness_is_high():
    rng = np.random.default_rng(8)
    awareness, weight = rng.uniform(size=(2, 3, 3, 2)), rng.standard_normal(40)
    params = only_b_is_unknown(np.zeros(40))
    params = params._replace(beta=np.stack([weight, np.zeros(40)], axis=1))
    z = awareness[:, *zip(*PATH[1:], strict=True), 0]
    expected = 0.5 * np.log1p((z**2).sum() * weight.var() / 0.05)
    np.testing.assert_allclose(information_gain(params, awareness, [PATH]), [expected], rtol=1e-9)
    # With a map for each draw, what varies with the map counts too.
    maps = np.stack([awareness] * 40)
    np.testing.assert_allclose(information_gain(params, maps, [PATH]), [expected], rtol=1e-9)


def test_who_is_certain_learns_nothing():
    params = sample_prior(PooledTrust(), 2, 1, seed=9)
    awareness = np.random.default_rng(9).uniform(size=(3, 3, 3, 2))
    np.testing.assert_allclose(information_gain(params, awareness, [PATH]), 0.0, atol=1e-12)


@pytest.mark.parametrize("model", [PooledTrust(), HierarchicalTrust(), CoupledTrust()])
def test_every_further_bound_teaches_more(model):
    params = prior_draws(model)
    awareness = np.random.default_rng(10).uniform(size=(2, 3, 3, 2))
    gains = information_gain(params, awareness, [PATH[: k + 1] for k in range(1, len(PATH))])
    assert gains[0] > 0.0
    assert (np.diff(gains) > 0.0).all()


def test_maps_and_draws_go_in_pairs():
    params = sample_prior(PooledTrust(), 2, 5, seed=0)
    with pytest.raises(ShapeError, match="4 maps of awareness need as many draws"):
        information_gain(params, np.full((4, 1, 3, 3, 2), 0.5), [PATH])
