"""The exact sampler of partially pooled robots: its integrals, its draws, its evidence."""

import numpy as np
import numpyro.distributions as dist
import pytest
from missions import simulate_missions
from references import named, require_weighted
from scipy import special, stats
from scipy.linalg import block_diag

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference import complete, diagnostics, fit
from trustbo.inference.samplers.importance import sample_scores
from trustbo.inference.samplers.posterior import posterior_of
from trustbo.models import HierarchicalTrust, PlaceEffect, Priors
from trustbo.models.effects.effect import Slots
from trustbo.models.model import TrustModel
from trustbo.models.place import bounds_of, visited
from trustbo.stacking import stack_missions


def small(n_missions=2, n_bounds=3, n_robots=2, seed=0):
    rng = np.random.default_rng(seed)
    path = [(0, k) for k in range(n_bounds + 1)]
    return [
        Mission.from_arrays(path, rng.uniform(size=(n_bounds, n_robots, 2)),
                            rng.uniform(0.3, 0.9, (n_bounds, n_robots)))
        for _ in range(n_missions)
    ]  # fmt: skip


def target_of(missions, model: TrustModel):
    batch, places = stack_missions(missions), None
    if model.place is not None:
        bounds = bounds_of(missions, batch.contact_rate.shape[:2])
        places = visited(bounds, model.place, batch.contact_rate.shape[2])
    slots = Slots.of(batch, len(missions), places=places)
    return posterior_of(model, slots)


@pytest.mark.parametrize("place", [None, PlaceEffect(), PlaceEffect(shared=False)])
@pytest.mark.parametrize("stationary", [False, True])
def test_the_density_is_the_dense_joint_normal_s_with_the_priors(stationary, place):
    """Weights, intercepts, their means and places are in the covariance of all rates of all."""
    missions, rng = small(), np.random.default_rng(1)
    priors = Priors(
        beta=dist.Normal(np.array([0.2, -0.1]), np.array([0.7, 0.5])),
        b=dist.Normal(0.1, 0.4),
        stationary=stationary,
    )
    target = target_of(missions, HierarchicalTrust(priors, place=place))
    target.recentre(np.zeros(target.n_scores))
    z = 0.7 * rng.standard_normal((4, target.n_scores))
    found = target.log_density(z)
    theta, log_prior = target.scores.theta(z), target.scores.log_prior(z)
    for t in range(len(z)):
        delta_w, delta_v = theta["delta_w"][t], theta["delta_v"][t]
        tau, rest = np.append(theta["tau_beta"][t], theta["tau_b"][t]), 1.0
        if stationary:
            rest = 1.0 - theta["mean_beta0"][t]
        mean_of_mu = rest * np.array([0.2, -0.1, 0.1])
        sd_of_mu = rest * np.array([0.7, 0.5, 0.4])
        X, centre, own, robots, rolls = [], [], [], [], []
        for m in missions:
            for i in range(2):
                a, n = theta["beta0"][t, i], len(m.contact_rate)
                roll = np.linalg.inv(np.eye(n) - a * np.eye(n, k=-1))
                rolls.append(roll)
                X.append(roll @ np.c_[m.awareness[:, i], np.ones(n)])
                centre.append(roll[:, 0] * a * 0.5)
                own.append(delta_w**2 * roll @ roll.T + delta_v**2 * np.eye(n))
                own[-1] += np.outer(roll[:, 0], roll[:, 0]) * (a * 0.5) ** 2
                robots += [i] * n
        X, robots = np.concatenate(X), np.array(robots)
        cov = (X * sd_of_mu**2) @ X.T
        cov += (X * tau**2) @ X.T * (robots[:, None] == robots)
        cov[np.kron(np.eye(4), np.ones((3, 3))) > 0] += np.concatenate([c.ravel() for c in own])
        if place is not None:  # bounds of both missions are the same three, one cell apart
            tau_s, ell, tau_e = (theta[name][t] for name in ("tau_s", "length_scale", "tau_e"))
            h = np.sqrt(3.0) * np.abs(np.subtract.outer(np.arange(3), np.arange(3))) / ell
            of_bounds = tau_s**2 * (1.0 + h) * np.exp(-h) + tau_e**2 * np.eye(3)
            same = place.shared | (robots[:, None] == robots)
            T = block_diag(*rolls)
            cov += T @ (np.tile(of_bounds, (4, 4)) * same) @ T.T
        y = np.concatenate([m.contact_rate[:, i] for m in missions for i in range(2)])
        law = stats.multivariate_normal(np.concatenate(centre) + X @ mean_of_mu, cov)
        np.testing.assert_allclose(found[t] - log_prior[t], law.logpdf(y), rtol=1e-9)


def test_coordinates_leave_the_priors_as_they_are():
    """With the Jacobian, the density of (mean, beta0_i, noises, tau) is that of their priors."""
    target = target_of(small(), HierarchicalTrust())
    target.recentre(np.zeros(9))
    z = 0.5 * np.random.default_rng(0).standard_normal(9)

    def natural(z):
        theta = target.scores.theta(z[None])
        memory = special.logit(np.append(theta["mean_beta0"], theta["beta0"][0]))
        noises = np.log([theta["delta_w"][0], theta["delta_v"][0]])
        return np.concatenate([memory, noises, np.log(taus(theta))])

    def taus(theta):
        return np.array([theta["tau_beta0"][0], *theta["tau_beta"][0], theta["tau_b"][0]])

    h = 1e-5
    jacobian = np.array([(natural(z + h * e) - natural(z - h * e)) / (2 * h) for e in np.eye(9)])
    theta, log_prior = target.scores.theta(z[None]), target.scores.log_prior(z[None])
    mean, beta0 = special.logit(theta["mean_beta0"][0]), special.logit(theta["beta0"][0])
    expected = stats.beta(2, 2).logpdf(special.expit(mean))
    expected += special.log_expit(mean) + special.log_expit(-mean)
    expected += stats.norm.logpdf(beta0, mean, theta["tau_beta0"][0]).sum()
    for name in ("delta_w", "delta_v"):
        expected += stats.halfnorm.logpdf(theta[name][0], scale=0.2) + np.log(theta[name][0])
    for tau in taus(theta):
        expected += stats.halfnorm.logpdf(tau, scale=0.3) + np.log(tau)
    log_det = np.linalg.slogdet(jacobian)[1]
    assert abs(log_prior[0] - expected - log_det) < 1e-6


def test_new_coordinates_are_of_the_same_point():
    """And the density differs by the Jacobian alone, of the mean and of each robot's beta0."""
    target = target_of(small(), HierarchicalTrust())
    z = 0.5 * np.random.default_rng(1).standard_normal(9)
    before, value = target.scores.theta(z[None]), target.log_density(z[None])
    likelihood = value - target.scores.log_prior(z[None])
    again = target.recentre(z)
    assert np.abs(again - z).max() > 0.05
    for name, values in target.scores.theta(again[None]).items():
        np.testing.assert_allclose(values, before[name], rtol=1e-9)
    found = target.log_density(again[None]) - target.scores.log_prior(again[None])
    np.testing.assert_allclose(found, likelihood, rtol=1e-9)


def from_the_prior(missions, n, rng):
    """Parameters drawn from the prior, and the log likelihood of the rates (Kalman filter)."""
    mean, taus = rng.beta(2, 2, n), np.abs(rng.normal(0, 0.3, (n, 4)))
    mu = np.c_[rng.normal(0, 1, (n, 2)), rng.normal(0, 0.5, n)]
    delta_w, delta_v = np.abs(rng.normal(0, 0.2, (2, n)))
    log_weight, own = np.zeros(n), []
    for i in range(2):
        beta0 = special.expit(special.logit(mean) + taus[:, 0] * rng.standard_normal(n))
        c = mu + taus[:, 1:] * rng.standard_normal((n, 3))
        own.append(np.c_[beta0, c])
        for mission in missions:
            m, v = np.full(n, 0.5), np.full(n, 0.25)
            for z, y in zip(mission.awareness[:, i], mission.contact_rate[:, i], strict=True):
                m, v = beta0 * m + c[:, :2] @ z + c[:, 2], beta0**2 * v + delta_w**2
                S = v + delta_v**2
                log_weight += stats.norm.logpdf(y, m, np.sqrt(S))
                m, v = m + v / S * (y - m), v * delta_v**2 / S
    return named(mean, mu, taus, delta_w, delta_v, own), log_weight


def test_draws_and_evidence_are_those_of_the_weighted_prior():
    missions = small(1, 3, seed=3)
    drawn = sample_scores(target_of(missions, HierarchicalTrust()), 4000, 0).draws
    assert drawn.khat < 0.5
    prior, log_weight = from_the_prior(missions, 600_000, np.random.default_rng(0))
    # Effective numbers above 1500 on both sides: a standard error of .036 sd; 4 of it.
    errors = {"kish": 1500, "nats": 0.02, "shift": 0.15, "log_ratio": 0.12}
    require_weighted(drawn.params, drawn.log_evidence, prior, log_weight, **errors)


def test_fit_takes_it_and_adds_trust_later():
    missions = simulate_missions(5)
    rates = missions[0].contact_rate.copy()
    rates[2:4, 1] = np.nan
    gap = Mission.from_arrays(missions[0].path, missions[0].awareness, rates)
    model = HierarchicalTrust()
    weights = 0.9 ** np.arange(5)[::-1]
    bare = fit([gap, *missions[1:]], model, weights=weights, draws=100, whole=False)
    assert bare.attrs["sampler"] == "exact"
    assert diagnostics(bare)["k_hat"] < 0.5
    assert bare["posterior"]["beta"].dims == ("chain", "draw", "robot", "feature")
    assert set(bare["posterior"].data_vars) == set(model.dims)
    trust = complete(bare)["latent"]["trust_mean"]
    assert trust.sel(mission=0).notnull().sum() == 7 * 3


@pytest.mark.parametrize("rates", ["equal", "one robot", "one rate"])
def test_odd_data_have_a_posterior(rates):
    missions = small(3, 4, 3)
    y = {"equal": np.ones((4, 3)), "one robot": np.full((4, 3), np.nan)}.get(rates)
    if rates == "one rate":
        missions, y = missions[:1], np.full((4, 3), np.nan)
        y[1, 1] = 0.5
    elif rates == "one robot":
        y[:, 0] = [0.3, 0.5, 0.4, 0.6]
    missions = [Mission.from_arrays(m.path, m.awareness, y) for m in missions]
    posterior = fit(missions, HierarchicalTrust(), n_draws=100)
    assert diagnostics(posterior)["k_hat"] < 0.7
    for values in posterior["posterior"].data_vars.values():
        assert np.isfinite(values).all()


def test_what_it_cannot_treat_is_refused():
    missions = small()
    heavy = HierarchicalTrust(Priors(beta=dist.StudentT(3.0, 0.0, 0.5)))
    with pytest.raises(TrustboError, match=r"it needs the prior of beta to be a Normal.*StudentT"):
        fit(missions, heavy, "exact")


@pytest.mark.slow  # the weighted prior, above, says the same for little data
def test_draws_and_a_long_run_of_nuts_agree():
    missions = simulate_missions(12, seed=3)
    exact = fit(missions, HierarchicalTrust(), "exact")["posterior"]
    nuts = fit(missions, HierarchicalTrust(), "nuts", n_draws=4000)["posterior"]
    for name in exact.data_vars:
        ours, theirs = (p[name].values.reshape(4 * p.sizes["draw"], -1) for p in (exact, nuts))
        for a, b in zip(ours.T, theirs.T, strict=True):
            assert abs(a.mean() - b.mean()) < 0.12 * b.std(), name
            assert abs(np.log(a.std() / b.std())) < 0.1, name
