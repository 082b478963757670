"""How much a path teaches, against a dense joint normal and closed forms."""

import numpy as np
import pytest
from references import dense_coupled
from scipy.special import expit
from scipy.stats import multivariate_normal

from trustbo.errors import ShapeError
from trustbo.inference import sample_prior
from trustbo.models import CoupledTrust, HierarchicalTrust, PooledTrust, TrustParams
from trustbo.models.families import FAMILIES
from trustbo.models.params import CoupledParams
from trustbo.planning.information import information_gain, rate_noise
from trustbo.workspace.moves import along

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
    noise = rate_noise(params, np.zeros((n_bounds, n_robots)))
    rng = np.random.default_rng(6)
    for _ in range(20):
        y = rng.standard_normal((n_bounds, n_robots))
        expected, _, _ = dense_coupled(
            params.transition(n_robots), np.zeros_like(y), Q, R, 0.0, params.x0_sd, y
        )
        got = multivariate_normal.logpdf(y.ravel(), np.zeros(y.size), noise)
        np.testing.assert_allclose(got, expected, rtol=1e-9)


def test_the_noise_of_a_shorter_mission_is_the_leading_part():
    params = prior_draws(CoupledTrust()).draw(0)
    short, long = (rate_noise(params, np.zeros((n, 2))) for n in (2, 5))
    np.testing.assert_allclose(short, long[:4, :4], rtol=1e-12)


def only_b_is_unknown(b):
    """beta0 = 0: rates are b plus independent noise of variance 0.1^2 + 0.2^2."""
    n = len(b)
    return TrustParams(np.zeros(n), np.zeros((n, 2)), b, np.full(n, 0.1), np.full(n, 0.2))


def test_one_unknown_mean_has_a_closed_form():
    b = np.random.default_rng(7).standard_normal(50)
    params, awareness = only_b_is_unknown(b), np.full((3, 1, 3, 3, 2), 0.5)
    gains = information_gain(params, awareness, [PATH, PATH[:2]])
    n_rates = np.array([9, 3])
    np.testing.assert_allclose(gains, 0.5 * np.log1p(n_rates * b.var() / 0.05), rtol=1e-9)


def test_one_unknown_weight_is_learned_where_awareness_is_high():
    rng = np.random.default_rng(8)
    awareness, weight = rng.uniform(size=(2, 8, 3, 3, 2)), rng.standard_normal(40)
    params = only_b_is_unknown(np.zeros(40))
    params = params._replace(beta=np.stack([weight, np.zeros(40)], axis=1))
    z = along(awareness, PATH)[..., 0]
    expected = 0.5 * np.log1p((z**2).sum() * weight.var() / 0.05)
    np.testing.assert_allclose(information_gain(params, awareness, [PATH]), [expected], rtol=1e-9)
    # With a map for each draw, what varies with the map counts too.
    maps = np.stack([awareness] * 40)
    np.testing.assert_allclose(information_gain(params, maps, [PATH]), [expected], rtol=1e-9)


def test_who_is_certain_learns_nothing():
    params = sample_prior(PooledTrust(), 2, 1, seed=9)
    awareness = np.random.default_rng(9).uniform(size=(3, 1, 3, 3, 2))
    np.testing.assert_allclose(information_gain(params, awareness, [PATH]), 0.0, atol=1e-12)


@pytest.mark.parametrize("model", [PooledTrust(), HierarchicalTrust(), CoupledTrust()])
def test_every_further_bound_teaches_more(model):
    params = prior_draws(model)
    awareness = np.random.default_rng(10).uniform(size=(2, 1, 3, 3, 2))
    gains = information_gain(params, awareness, [PATH[: k + 1] for k in range(1, len(PATH))])
    assert gains[0] > 0.0
    assert (np.diff(gains) > 0.0).all()


def test_maps_and_draws_go_in_pairs():
    params = sample_prior(PooledTrust(), 2, 5, seed=0)
    with pytest.raises(ShapeError, match="4 maps of awareness need as many draws"):
        information_gain(params, np.full((4, 1, 1, 3, 3, 2), 0.5), [PATH])


# --- rates that are not trust plus noise ---


def test_rates_of_change_are_differences_of_trust():
    """Against the noise of x0, w and v put through the recursion by hand."""
    params = TrustParams(0.7, np.zeros(2), 0.1, 0.2, 0.1, 0.5, 0.4)
    n = 4
    x = np.zeros((n + 1, 1 + 2 * n))  # rows: steps; columns: x0, w_1.., v_1..
    x[0, 0] = params.x0_sd
    for k in range(1, n + 1):
        x[k] = params.beta0 * x[k - 1]
        x[k, k] += params.delta_w
    y = np.diff(x, axis=0)
    y[:, 1 + n :] += params.delta_v * np.eye(n)
    found = rate_noise(params, np.zeros((n, 1)), lag=1.0)
    np.testing.assert_allclose(found, y @ y.T, rtol=1e-12, atol=1e-15)


def test_a_change_tells_nothing_of_where_trust_began():
    """With beta0 = 1 and no drift, rates of change are noise alone, whatever x0 is."""
    n = 30
    x0 = np.random.default_rng(0).standard_normal(n)
    params = TrustParams(
        np.ones(n), np.zeros((n, 2)), np.zeros(n), np.full(n, 0.1), np.full(n, 0.1), x0, np.zeros(n)
    )
    awareness = np.full((1, 1, 3, 3, 2), 0.5)
    of_change = information_gain(params, awareness, [PATH], lag=1.0)
    np.testing.assert_allclose(of_change, 0.0, atol=1e-12)
    assert information_gain(params, awareness, [PATH]) > 1.0


@pytest.mark.parametrize("name", list(FAMILIES))
@pytest.mark.parametrize("trust", [-1.3, 0.2, 0.95])
def test_moments_of_a_rate_are_those_of_simulated_ones(name, trust):
    """1e5 rates: mean and variance within 5 standard errors; the slope by differences."""
    family, sd, n = FAMILIES[name], np.array(0.15), 100_000
    mean, slope, variance = family.rate_moments(np.array(trust), sd)
    rng = np.random.default_rng(1)
    if name == "beta_binomial":
        p, phi = expit(trust), 1.0 / (sd**2 + 1e-6)
        y = rng.binomial(200, rng.beta(phi * p, phi * (1.0 - p), n)) / 200
    else:
        t = rng.standard_t(4, n) if name == "student_t" else rng.standard_normal(n)
        y = trust + sd * t
        y = np.clip(y, 0.0, 1.0) if name == "censored" else y
    assert abs(y.mean() - mean) <= 5.0 * y.std() / np.sqrt(n) + 1e-15
    fourth = ((y - y.mean()) ** 4).mean() - y.var() ** 2
    assert abs(y.var() - variance) <= 5.0 * np.sqrt(fourth / n) + 1e-11
    ends = [family.rate_moments(np.array(trust + h), sd)[0] for h in (-1e-5, 1e-5)]
    np.testing.assert_allclose(slope, (ends[1] - ends[0]) / 2e-5, rtol=1e-6, atol=1e-9)


def test_counts_teach_less_where_nearly_all_or_none_are_in_contact():
    """The same spread of logits moves rates less at an end; so the policy must not see logits."""
    rng = np.random.default_rng(2)
    awareness = np.full((1, 1, 3, 3, 2), 0.5)

    def gain(level, family):
        params = only_b_is_unknown(level + 0.3 * rng.standard_normal(200))
        return information_gain(params, awareness, [PATH], FAMILIES[family])[0]

    assert gain(4.0, "beta_binomial") < 0.7 * gain(0.0, "beta_binomial")
    assert abs(gain(4.0, "gaussian") / gain(0.0, "gaussian") - 1.0) < 0.15
