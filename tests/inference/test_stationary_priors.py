"""Priors of stationary trust: line of sight is a predicted contact rate."""

from dataclasses import replace

import numpy as np
import numpyro.distributions as dist
import pytest
from missions import random_missions
from references import dense_log_likelihood
from scipy import stats

from trustbo.errors import TrustboError
from trustbo.inference import prior_predictive
from trustbo.inference.evidence.statistics import gather
from trustbo.inference.prior_predictive import sample_prior
from trustbo.inference.samplers.exact import _target
from trustbo.models import CoupledTrust, HierarchicalTrust, PooledTrust, Priors
from trustbo.models.priors_numpy import log_prob
from trustbo.models.record import model_from_record, model_to_record
from trustbo.stacking import stack_missions

FEATURES = ("traversability", "visibility", "line_of_sight")


def test_the_exact_sampler_integrates_weights_of_these_priors_out():
    """p(y, theta) = p(y | c, theta) p(c | theta) p(theta) / p(c | y, theta), for any weights c."""
    rng = np.random.default_rng(0)
    missions = random_missions(rng, 4)
    priors = Priors.of(("traversability", "line_of_sight"))
    target = _target(gather(PooledTrust(priors), stack_missions(missions))[0], priors)
    z = rng.normal([0.0, -1.5, 0.0], 0.5, (5, 3))
    found, mean, factor = target.evaluate(z)
    beta0, delta_w, delta_v, log_jacobian = target.constrain(z)
    for i in range(len(z)):
        c = rng.normal(0.2, 0.3, 3)
        rest = 1.0 - beta0[i]
        conditional = [stats.norm(m * rest, s * rest) for m, s in [(0, 0.25), (1, 0.3), (0, 0.15)]]
        log_p = log_jacobian[i] + sum(n.logpdf(v) for n, v in zip(conditional, c, strict=True))
        for name, value in (("beta0", beta0), ("delta_w", delta_w), ("delta_v", delta_v)):
            log_p += log_prob(getattr(priors, name), value[i])
        log_p += sum(
            dense_log_likelihood(
                beta0[i], c[:2], c[2], delta_w[i], delta_v[i], 0.5, 0.5,
                m.awareness[:, r], m.contact_rate[:, r],
            )
            for m in missions
            for r in range(3)
        )  # fmt: skip
        covariance = np.linalg.inv(factor[..., i] @ factor[..., i].T)
        log_p -= stats.multivariate_normal(mean[:, i], covariance).logpdf(c)
        assert found[i] == pytest.approx(log_p, rel=1e-9)


@pytest.mark.parametrize(
    "model", [PooledTrust(), CoupledTrust(inter_robot="none"), HierarchicalTrust()]
)
def test_draws_have_the_slopes_of_stationary_trust(model):
    draws = sample_prior(model.for_features(FEATURES), 3, 4000, 0, n_robots=2)
    rest = 1.0 - np.asarray(draws.beta0)
    slopes, level = draws.beta / rest[..., None], draws.b / rest
    if isinstance(model, HierarchicalTrust):  # the robots' own deviations are not scaled
        assert np.median(slopes[..., 2]) == pytest.approx(1.0, abs=0.1)
        return
    # The standard error of a mean of 4000 is .3 / sqrt(4000) = .005, of a sd .0035.
    axes = tuple(range(slopes.ndim - 1))
    np.testing.assert_allclose(slopes.mean(axes), [0.0, 0.0, 1.0], atol=0.02)
    np.testing.assert_allclose(slopes.std(axes), [0.25, 0.25, 0.3], atol=0.015)
    assert level.std() == pytest.approx(0.15, abs=0.01)


@pytest.mark.parametrize("observation", ["gaussian", "censored", "beta_binomial"])
def test_most_rates_of_the_prior_are_rates_and_follow_the_line_of_sight(observation):
    rng = np.random.default_rng(0)
    z = rng.uniform(0.4, 0.9, (40, 9, 1, 3))
    z[..., 2] = rng.beta(6.0, 1.5, (40, 1, 1))  # a line of sight that stays as it is
    model = PooledTrust(observation=observation).for_features(FEATURES)
    drawn = prior_predictive(model, z, n_ticks=60, features=FEATURES, n_draws=1200)
    rates = drawn["prior_predictive"]["contact_rate"].values[0][..., -1, 0]  # (draw, mission)
    assert ((rates >= 0.0) & (rates <= 1.0)).mean() > 0.5
    slopes = [np.polyfit(z[:, -1, 0, 2], of_draw, 1)[0] for of_draw in rates]
    expected = 1.0 if observation == "gaussian" else 0.75  # saturated at 1
    assert np.median(slopes) == pytest.approx(expected, abs=0.25)
    assert list(drawn["prior"]["feature"].values) == list(FEATURES)


def test_several_sights_share_the_slope():
    priors = Priors.of(("visibility", "line_of_sight_1", "line_of_sight_2"))
    np.testing.assert_allclose(np.asarray(priors.beta.loc), [0.0, 0.5, 0.5], rtol=1e-6)
    np.testing.assert_allclose(
        np.asarray(priors.beta.scale), [0.25] + [0.3 / 2**0.5] * 2, rtol=1e-6
    )
    assert Priors.of(("traversability", "visibility")) is Priors.default()


def test_priors_of_one_s_own_stay():
    own = PooledTrust(Priors())
    assert own.for_features(FEATURES) is own
    assert PooledTrust().for_features(FEATURES).priors.stationary
    for model in (PooledTrust(), own):
        again = model_from_record(model_to_record(model))
        assert again.for_features(FEATURES).priors.stationary == (
            model.for_features(FEATURES).priors.stationary
        )


def test_the_mean_of_the_prior_is_what_is_seen():
    mean = Priors.of(FEATURES).mean(3)
    np.testing.assert_allclose(mean["beta"] / (1.0 - mean["beta0"]), [0.0, 0.0, 1.0])


def test_other_priors_of_stationary_trust_are_refused():
    with pytest.raises(TrustboError, match="need Normal beta and b, and beta0 on"):
        replace(Priors.of(FEATURES), beta0=dist.Normal(0.5, 0.2))
    with pytest.raises(TrustboError, match="need Normal beta and b, and beta0 on"):
        Priors(b=dist.Laplace(0.0, 1.0), stationary=True)
