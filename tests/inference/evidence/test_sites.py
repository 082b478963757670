"""The exact sampler of censored rates and counts: its draws, its evidence, odd data, refusals."""

import jax
import numpy as np
import numpyro.distributions as dist
import pytest
from missions import simulate_missions
from references import pooled_posterior, require_weighted
from scipy import special, stats

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference import complete, diagnostics, fit
from trustbo.inference.samplers.choice import resolve_sampler
from trustbo.inference.samplers.importance import sample_scores
from trustbo.inference.samplers.posterior import posterior_of
from trustbo.models import CoupledTrust, PooledTrust, Priors, TrustParams
from trustbo.models.effects.effect import Slots
from trustbo.stacking import stack_missions

FAMILIES = ("censored", "beta_binomial")
TRUTHS = {
    "censored": TrustParams(0.6, np.array([0.5, 0.3]), 0.05, 0.12, 0.1),
    "beta_binomial": TrustParams(0.6, np.array([2.0, 1.0]), -0.3, 0.4, 0.25, 0.0, 1.5),
}
N = 20


def counted(family, n_missions=2, n_bounds=3, n_robots=2, seed=1):
    """Missions of rates that are shares of ticks, some of them 0 or 1."""
    z = np.random.default_rng(seed).uniform(size=(n_missions, n_bounds, n_robots, 2))
    model = PooledTrust(observation=family)
    y = model.simulate(jax.random.key(seed), TRUTHS[family], z, n_ticks=N).contact_rate
    y = np.round(np.clip(y, 0.0, 1.0) * N) / N
    path = [(0, k) for k in range(n_bounds + 1)]
    ticks = np.full((n_bounds, n_robots), N)
    return [Mission.from_arrays(path, a, b, n_ticks=ticks) for a, b in zip(z, y, strict=True)]


def sample_exactly(missions, model, n_seeds=3, n_draws=2000):
    """Draws of several seeds together, and the mean of their log evidence."""
    slots = Slots.of(stack_missions(missions), len(missions))
    found = [
        sample_scores(posterior_of(model, slots), n_draws, seed).draws for seed in range(n_seeds)
    ]
    assert max(each.khat for each in found) < 0.7
    params = {name: np.concatenate([f.params[name] for f in found]) for name in found[0].params}
    return params, np.mean([each.log_evidence for each in found])


def from_the_prior(missions, family, n, seed=0):
    """Parameters drawn from the prior with trust, and the log density of the rates given trust."""
    rng, counts = np.random.default_rng(seed), family == "beta_binomial"
    beta0, beta = rng.beta(2, 2, n), rng.normal(0, 2.0 if counts else 1.0, (n, 2))
    b, delta_v = rng.normal(0, 1.0 if counts else 0.5, n), np.abs(rng.normal(0, 0.2, n))
    delta_w = np.abs(rng.normal(0, 0.5 if counts else 0.2, n))
    log_weight = np.zeros(n)
    for mission in missions:
        for i in range(mission.contact_rate.shape[1]):
            x = rng.normal(0.0, 1.5, n) if counts else rng.normal(0.5, 0.5, n)
            for z, y in zip(mission.awareness[:, i], mission.contact_rate[:, i], strict=True):
                x = beta0 * x + beta @ z + b + delta_w * rng.standard_normal(n)
                if counts:
                    phi, p = 1.0 / (delta_v**2 + 1e-6), special.expit(x)
                    law = stats.betabinom(N, phi * p, phi * (1.0 - p))
                    log_weight += law.logpmf(round(y * N))
                elif y <= 0.0 or y >= 1.0:
                    log_weight += special.log_ndtr((x - 1.0 if y >= 1.0 else -x) / delta_v)
                else:
                    log_weight += stats.norm.logpdf(y, x, delta_v)
    params = {"beta0": beta0, "beta": beta, "b": b, "delta_w": delta_w, "delta_v": delta_v}
    return params, log_weight


@pytest.mark.parametrize("family", FAMILIES)
def test_draws_and_evidence_are_those_of_the_weighted_prior(family):
    rng, model = np.random.default_rng(2), PooledTrust(observation=family)
    missions = [
        Mission.from_arrays([(0, 0), (0, 1), (0, 2)], rng.uniform(size=(2, 1, 2)), y, n_ticks=ticks)
        for y, ticks in [([[1.0], [0.55]], [[N], [N]]), ([[0.9], [1.0]], [[N], [N]])]
    ]
    exact, log_evidence = sample_exactly(missions, model)
    prior, log_weight = from_the_prior(missions, family, 600_000)
    # The prior's average: 4 standard errors; three runs of some 400 points: 1 % each. Effective
    # numbers of 400 and of 3 x 350: a standard error of .06 sd; 4 of it.
    errors = {"kish": 400, "nats": 0.03, "shift": 0.24, "log_ratio": 0.2}
    require_weighted(exact, log_evidence, prior, log_weight, **errors)


def test_rates_within_the_limits_have_the_gaussian_posterior_thin_tails_included():
    """A dense grid of (beta0, noises): the censored sampler must find its tail of delta_v to 0."""
    missions = [
        Mission.from_arrays(m.path, m.awareness, 0.1 + 0.8 * m.contact_rate)
        for m in simulate_missions(6)
    ]
    assert max(m.contact_rate.max() for m in missions) < 1.0
    exact, _ = sample_exactly(missions, PooledTrust(observation="censored"), n_seeds=5)
    on_grid, (mean, sd, weight) = pooled_posterior(missions)
    for name, (points, share) in zip(("beta0", "delta_w", "delta_v"), on_grid, strict=True):
        centre = share @ points
        spread = np.sqrt(share @ (points - centre) ** 2)
        # Five runs of Kish size > 350 each: a standard error of .024 sd, of 1.7 % in the sd.
        assert abs(exact[name].mean() - centre) < 0.06 * spread, name
        assert abs(np.log(exact[name].std() / spread)) < 0.05, name
        edges = np.r_[0.0, points + points[0]]  # points are midpoints
        at = np.interp([0.05, 0.5, 0.95], np.r_[0.0, np.cumsum(share)], edges)
        found = np.quantile(exact[name], [0.05, 0.5, 0.95])
        assert (np.abs(found - at) < 0.12 * spread).all(), name
    ours = np.c_[exact["beta"], exact["b"]]
    for m in range(3):
        centre = (weight * mean[..., m]).sum()
        spread = np.sqrt((weight * (sd[..., m] ** 2 + (mean[..., m] - centre) ** 2)).sum())
        assert abs(ours[:, m].mean() - centre) < 0.06 * spread
        assert abs(np.log(ours[:, m].std() / spread)) < 0.05


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("rates", ["ones", "zeros", "both", "one rate", "mostly missing"])
def test_odd_data_have_a_posterior(family, rates):
    rng, n_ticks = np.random.default_rng(5), 1 if rates == "both" else N
    y = {"ones": np.ones((4, 6, 2)), "zeros": np.zeros((4, 6, 2)), "one rate": np.ones((1, 1, 1))}
    y = y.get(rates, (rng.uniform(size=(4, 6, 2)) < 0.5) * 1.0)
    if rates == "mostly missing":
        y[rng.uniform(size=y.shape) < 0.8] = np.nan
    path = [(0, k) for k in range(y.shape[1] + 1)]
    ticks = np.full(y.shape[1:], n_ticks)
    missions = [
        Mission.from_arrays(path, rng.uniform(size=(*one.shape, 2)), one, n_ticks=ticks)
        for one in y
    ]
    posterior = fit(missions, PooledTrust(observation=family), n_draws=200)
    assert posterior.attrs["sampler"] == "exact"
    assert diagnostics(posterior)["k_hat"] < 0.7
    assert diagnostics(posterior)["kish"] > 100
    for values in posterior["posterior"].data_vars.values():
        assert np.isfinite(values).all()
    for values in (posterior["latent"]["trust_sd"], posterior["log_likelihood"]["contact_rate"]):
        assert np.isfinite(values).all()


@pytest.mark.parametrize("family", FAMILIES)
def test_robots_apart_are_each_sampled_alone(family):
    missions = counted(family, 4, 5, seed=3)
    model = CoupledTrust(observation=family, inter_robot="none")
    posterior = fit(missions, model, seed=3, draws=250)
    assert posterior.attrs["sampler"] == "exact"
    assert "by expectation propagation" in posterior.attrs["sampler_reason"]
    alone = [
        Mission.from_arrays(
            m.path, m.awareness[:, 1:], m.contact_rate[:, 1:], n_ticks=np.full((5, 1), N)
        )
        for m in missions
    ]
    pooled = PooledTrust(observation=family).at_resolution({float(N): 1.0})
    one, _ = sample_exactly(alone, pooled, n_draws=1000)
    for name, draws in one.items():
        ours = posterior["posterior"][name].isel(robot=1).values.reshape(1000, -1)
        for a, b in zip(ours.T, draws.reshape(3000, -1).T, strict=True):
            assert abs(a.mean() - b.mean()) < 0.25 * b.std(), name
    assert posterior["posterior"]["delta_v"].dims == ("chain", "draw", "robot")


def test_trust_can_be_added_later_and_is_the_same():
    missions = counted("censored", 3, 4)
    model = PooledTrust(observation="censored")
    whole = fit(missions, model, seed=4, draws=100)
    bare = fit(missions, model, seed=4, draws=100, whole=False)
    assert "latent" not in bare.children
    again = complete(bare)
    for group in ("latent", "log_likelihood", "posterior_predictive", "prior_predictive"):
        assert again[group].to_dataset().identical(whole[group].to_dataset())
    assert (whole["posterior_predictive"]["contact_rate"] <= 1.0).all()


def test_priors_of_ones_own_move_the_posterior_and_those_without_quantiles_are_refused():
    missions = counted("censored", 4, 5)
    own = Priors(beta=dist.Normal(0.1, 0.01), delta_v=dist.LogNormal(-3.0, 0.2))
    posterior = fit(missions, PooledTrust(own, observation="censored"), n_draws=250)
    assert posterior.attrs["sampler"] == "exact"
    assert abs(float(posterior["posterior"]["beta"].mean()) - 0.1) < 0.02
    without = Priors(delta_w=dist.InverseGamma(3.0, 0.3))
    with pytest.raises(TrustboError, match=r"no sampler .* prior of delta_w has no quantiles; got"):
        resolve_sampler(PooledTrust(without, observation="censored"), "auto")


@pytest.mark.parametrize(
    ("model", "reason"),
    [
        (CoupledTrust(observation="censored"), "its robots influence each other, and its observ"),
    ],
)
def test_models_it_cannot_treat_are_refused(model, reason):
    with pytest.raises(TrustboError, match=f'sampler "exact" cannot treat .*: {reason}'):
        fit(counted("censored"), model, "exact")
