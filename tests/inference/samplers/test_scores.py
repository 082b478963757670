"""Normal scores of hyperparameters: quantiles by SciPy, and a prior that is the scores' own."""

import numpy as np
import numpyro.distributions as dist
import pytest
from scipy import stats

from trustbo.inference.samplers.scores import (
    beta0_and_noises,
    half_normal,
    log_prior,
    noise,
    quantile,
)
from trustbo.models.priors import Priors

SCORES = np.array([-6.0, -2.0, -0.3, 0.0, 0.7, 3.0, 6.0])


@pytest.mark.parametrize(
    ("prior", "theirs"),
    [
        (dist.Beta(2.0, 5.0), stats.beta(2.0, 5.0)),
        (dist.HalfNormal(0.3), stats.halfnorm(scale=0.3)),
        (dist.Normal(0.4, 2.0), stats.norm(0.4, 2.0)),
        (dist.LogNormal(-1.0, 0.5), stats.lognorm(0.5, scale=np.exp(-1.0))),
        (dist.Exponential(2.0), stats.expon(scale=0.5)),
    ],
)
def test_a_parameter_is_the_quantile_of_its_prior_at_the_score(prior, theirs):
    low = SCORES < 0.0  # each tail by its small probability
    expected = np.where(low, theirs.ppf(stats.norm.cdf(SCORES)), theirs.isf(stats.norm.sf(SCORES)))

    # Shares of 1e-9 and 1 - 1e-9 are rounded, by SciPy and by numpyro.
    np.testing.assert_allclose(quantile(prior, SCORES), expected, rtol=1e-7)


def test_a_half_normal_is_right_far_into_both_tails():
    z = np.array([-30.0, -8.0, 8.0, 30.0])
    far = stats.halfnorm.isf(stats.norm.sf(z[2:]))
    near = np.sqrt(np.pi / 2.0) * stats.norm.cdf(z[:2])  # of a density 2 phi(0) at 0
    np.testing.assert_allclose(half_normal(z, 1.0), [*near, *far], rtol=1e-9)


def test_the_noise_of_a_size_is_the_prior_s_quantile_of_a_half_normal():
    sizes = np.array([0.01, 0.5, 2.0])
    np.testing.assert_allclose(noise(dist.HalfNormal(0.2), sizes), 0.2 * sizes, rtol=1e-12)
    uniform = noise(dist.Uniform(0.0, 1.0), sizes)
    np.testing.assert_allclose(uniform, stats.halfnorm.cdf(sizes), rtol=1e-6)


def test_draws_of_the_scores_prior_are_draws_of_the_parameters_priors():
    # The size of two independent half-normal scores is Rayleigh, and the angle's share uniform.
    rng = np.random.default_rng(0)
    z = rng.standard_normal((20_000, 3))
    z[:, 1] = np.log(stats.rayleigh.rvs(size=len(z), random_state=rng))
    beta0, delta_w, delta_v = beta0_and_noises(Priors(), z).T
    for drawn, prior in ((beta0, "beta0"), (delta_w, "delta_w"), (delta_v, "delta_v")):
        shares = np.linspace(0.1, 0.9, 9)
        score = stats.norm.ppf(shares)
        expected = quantile(getattr(Priors(), prior), score)
        below = [(drawn <= limit).mean() for limit in expected]
        np.testing.assert_allclose(below, shares, atol=0.015)  # 4 standard errors
    assert abs(np.corrcoef(delta_w, delta_v)[0, 1]) < 0.03


def test_the_log_prior_of_the_scores_integrates_to_one():
    side = np.linspace(-12.0, 4.0, 4001)
    z = np.zeros((len(side), 3))
    z[:, 1] = side
    normal = 1.0 / (2.0 * np.pi)  # the density of the other two at 0
    total = np.exp(log_prior(z)).sum() * (side[1] - side[0])
    np.testing.assert_allclose(total, normal, rtol=1e-6)
