"""The exact sampler of partially pooled robots with censored rates or counts."""

import numpy as np
import pytest
from references import named, require_weighted
from scipy import special, stats

from trustbo.data import Mission
from trustbo.inference import complete, diagnostics, fit
from trustbo.inference.samplers.importance import sample_scores
from trustbo.inference.samplers.posterior import posterior_of
from trustbo.models import HierarchicalTrust
from trustbo.models.effects.effect import Slots
from trustbo.stacking import stack_missions

FAMILIES = ("censored", "beta_binomial")
N = 20


def missions_of(y, seed=2, n_ticks=N):
    """Missions of rates (mission, bound, robot), rounded to shares of ticks, and any awareness."""
    rng, path = np.random.default_rng(seed), [(0, k) for k in range(y.shape[1] + 1)]
    ticks, y = np.full(y.shape[1:], n_ticks), np.round(n_ticks * y) / n_ticks
    return [
        Mission.from_arrays(path, rng.uniform(size=(*one.shape, 2)), one, n_ticks=ticks)
        for one in y
    ]


def target_of(missions, model):
    slots = Slots.of(stack_missions(missions), len(missions))
    return posterior_of(model, slots)


def test_rates_within_the_limits_have_the_closed_form_s_density():
    """The normal equations of the Gaussian sampler, at other spreads and beta0 of each robot."""
    rng = np.random.default_rng(0)
    y = rng.uniform(0.2, 0.8, (3, 4, 3))
    y[1, 2:, 1] = np.nan
    missions = missions_of(y)
    latent = target_of(missions, HierarchicalTrust(observation="censored"))
    exact = target_of(missions, HierarchicalTrust(latent.scores.quantiles.priors))
    exact.recentre(np.zeros(10))
    theta = exact.scores.theta(0.7 * rng.standard_normal((5, 10)))
    found, expected = (each.evidence.log_density(theta) for each in (latent, exact))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def from_the_prior(missions, family, n, seed=0):
    """Parameters drawn from the prior, and a log weight that averages to the rates' evidence.

    Trust is drawn where a rate is at the limit or a count, else filtered.
    """
    rng, counts = np.random.default_rng(seed), family == "beta_binomial"
    taus, delta_v = np.abs(rng.normal(0, 0.3, (n, 4))), np.abs(rng.normal(0, 0.2, n))
    delta_w = np.abs(rng.normal(0, 0.5 if counts else 0.2, n))
    mean, beta = rng.beta(2, 2, n), rng.normal(0, 2.0 if counts else 1.0, (n, 2))
    mu = np.c_[beta, rng.normal(0, 1.0 if counts else 0.5, n)]
    log_weight, own = np.zeros(n), []
    for i in range(2):
        beta0 = special.expit(special.logit(mean) + taus[:, 0] * rng.standard_normal(n))
        c = mu + taus[:, 1:] * rng.standard_normal((n, 3))
        own.append(np.c_[beta0, c])
        for mission in missions:
            m, v = (np.zeros(n), np.full(n, 1.5**2)) if counts else (np.full(n, 0.5), 0.25)
            for z, y in zip(mission.awareness[:, i], mission.contact_rate[:, i], strict=True):
                m, v = beta0 * m + c[:, :2] @ z + c[:, 2], beta0**2 * v + delta_w**2
                if counts or y >= 1.0:
                    m, v = m + np.sqrt(v) * rng.standard_normal(n), np.zeros(n)
                if counts:
                    phi, p = 1.0 / (delta_v**2 + 1e-6), special.expit(m)
                    law = stats.betabinom(N, phi * p, phi * (1.0 - p))
                    log_weight += law.logpmf(round(y * N))
                elif y >= 1.0:
                    log_weight += special.log_ndtr((m - 1.0) / delta_v)
                else:
                    S = v + delta_v**2
                    log_weight += stats.norm.logpdf(y, m, np.sqrt(S))
                    m, v = m + v / S * (y - m), v * delta_v**2 / S
    return named(mean, mu, taus, delta_w, delta_v, own), log_weight


@pytest.mark.parametrize("family", FAMILIES)
def test_draws_and_evidence_are_those_of_the_weighted_prior(family):
    missions = missions_of(np.array([[[1.0, 0.8], [0.55, 1.0]]]))
    target = target_of(missions, HierarchicalTrust(observation=family))
    found = [sample_scores(target, 2000, seed).draws for seed in range(3)]
    assert max(each.khat for each in found) < 0.7
    prior, log_weight = from_the_prior(missions, family, 600_000)
    # The prior's average: 4 standard errors; three runs of some 400 points: 1 % each. Effective
    # numbers of 500 and of 3 x 350: a standard error of .055 sd; 4 of it.
    log_evidence = np.mean([each.log_evidence for each in found])
    draws = {name: np.concatenate([each.params[name] for each in found]) for name in prior}
    errors = {"kish": 500, "nats": 0.03, "shift": 0.22, "log_ratio": 0.18}
    require_weighted(draws, log_evidence, prior, log_weight, **errors)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("rates", ["ones", "zeros", "one tick", "one rate", "one robot"])
def test_odd_data_have_a_posterior(family, rates):
    y = {"ones": np.ones((4, 6, 2)), "zeros": np.zeros((4, 6, 2))}.get(rates)
    if y is None:
        y = (np.random.default_rng(5).uniform(size=(4, 6, 2)) < 0.5) * 1.0
    if rates == "one rate":
        y = np.full((1, 3, 2), np.nan)
        y[0, 1, 1] = 1.0
    if rates == "one robot":
        y[..., 1] = np.nan
    missions = missions_of(y, n_ticks=1 if rates == "one tick" else N)
    posterior = fit(missions, HierarchicalTrust(observation=family), n_draws=200)
    assert posterior.attrs["sampler"] == "exact"
    assert "by expectation propagation" in posterior.attrs["sampler_reason"]
    assert diagnostics(posterior)["k_hat"] < 0.7
    assert diagnostics(posterior)["kish"] > 100
    assert set(posterior["posterior"].data_vars) == set(HierarchicalTrust().dims)
    for values in posterior["posterior"].data_vars.values():
        assert np.isfinite(values).all()
    assert np.isfinite(posterior["log_likelihood"]["contact_rate"]).all()


def test_trust_can_be_added_later():
    y = np.minimum(np.random.default_rng(1).uniform(0.4, 1.4, (3, 4, 3)), 1.0)
    model = HierarchicalTrust(observation="censored")
    bare = fit(missions_of(y), model, n_draws=100, whole=False)
    trust = complete(bare)["latent"]["trust_mean"]
    assert np.isfinite(trust).all()
    # Beyond the limit trust is not known to be at it.
    assert (trust.values[y == 1.0] > 0.8).all()
