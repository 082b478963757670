"""Expectation propagation and its weighted draws: integrals over trust and coefficients."""

import numpy as np
import pytest
from missions import N_TICKS, OF_FAMILY, counted_missions
from references import on_a_grid
from scipy import stats

from trustbo.data import Mission
from trustbo.inference.evidence import kalman_numpy
from trustbo.inference.evidence.ep import draws, joint, trust
from trustbo.models import TrustParams
from trustbo.models.families import FAMILIES, terms
from trustbo.stacking import MissionBatch, stack_missions

NO_COEFFICIENTS = np.zeros((0, 0)), np.zeros(0)


def known(p):
    """Parameters as the kernels take them, coefficients apart."""
    return np.array([p.beta0]), p.delta_w, p.delta_v, np.array([p.x0_mean, p.x0_sd])


def given_coefficients(family, p, z, y):
    """Chains of rates (chain, bound) whose drift is known, and their sites."""
    batch = MissionBatch(z[:, :, None], y[:, :, None], np.full((*y.shape, 1), N_TICKS))
    chains, sites = trust.gather_chains(FAMILIES[family], batch, np.full(len(y), y.shape[1]))
    return chains._replace(
        u=chains.u[..., :0], gamma_index=chains.gamma_index[:, :0], drift=z @ p.beta + p.b
    ), sites


@pytest.mark.parametrize("family", ["censored", "beta_binomial"])
def test_weights_average_to_the_integral_over_trust(family):
    p = OF_FAMILY[family]
    z, y, _ = counted_missions(family)
    z, y = z[:, :, 0], y[:, :, 0]
    args = *known(p), *NO_COEFFICIENTS
    for j in range(len(y)):
        chains, sites = given_coefficients(family, p, z[j : j + 1], y[j : j + 1])
        expected = on_a_grid(family, p, z[j], y[j])
        sites = joint.settle(*args, chains, sites, 8)
        points = [np.asarray(a)[None] for a in args[:3]]
        nothing = args[3], np.zeros((1, 0, 0)), np.zeros((1, 0))
        (by_ep,) = joint.log_evidence(*points, *nothing, chains, sites, 2)
        assert abs(by_ep - expected) < 0.01
        rng, numbers = np.random.default_rng(j), np.zeros((20_000, 0))
        weight = draws.draw_coefficients(*args, chains, sites, 2, 8.0, numbers, rng)
        ratio = np.exp(weight - expected)
        # 5 standard errors, and the grid's.
        assert abs(ratio.mean() - 1.0) < 5 * ratio.std() / np.sqrt(len(ratio)) + 2e-5
        assert np.std(weight) < 0.06


@pytest.mark.parametrize("lost", [0.0, 1.0])  # trust lasts, or its deviation from the drift
def test_a_rate_within_the_limits_is_integrated_exactly_with_the_coefficients(lost):
    """Gaussian terms: the dense joint normal of all rates, coefficients integrated out."""
    rng = np.random.default_rng(3)
    z, y = rng.uniform(size=(4, 5, 2, 2)), rng.uniform(0.2, 0.8, (4, 5, 2))
    y[1, 2, 0] = y[3, 4, 1] = np.nan
    batch = MissionBatch(z, y, np.full(y.shape, np.nan))
    chains, sites = trust.gather_chains(FAMILIES["censored"], batch, np.full(4, 5))
    chains = chains._replace(lost=lost)
    mean, precision = np.array([0.1, 0.2, -0.1]), np.array([1.0, 4.0, 2.0])
    beta0, Q, R, x0 = 0.7, 0.02, 0.01, (0.5, 0.3)
    point = np.array([[beta0]]), np.sqrt([Q]), np.sqrt([R]), np.array(x0)
    (found,) = joint.log_evidence(*point, np.diag(precision)[None], mean[None], chains, sites, 2)
    roll = np.linalg.inv(np.eye(5) - beta0 * np.eye(5, k=-1))
    rows, centre, own = [], [], []
    for j in range(4):
        for i in range(2):
            u = np.c_[z[j, :, i], np.ones(5)]
            u[1:] -= lost * beta0 * u[:-1].copy()
            rows.append(roll @ u)
            centre.append(roll[:, 0] * beta0 * x0[0] * (1.0 - lost))
            own.append(roll @ (Q * np.eye(5)) @ roll.T + R * np.eye(5))
            own[-1] += np.outer(roll[:, 0], roll[:, 0]) * (beta0 * x0[1]) ** 2
    X, flat = np.concatenate(rows), np.swapaxes(y, 1, 2).ravel()
    cov = np.kron(np.eye(8), np.ones((5, 5)))
    cov[cov > 0] = np.concatenate([c.ravel() for c in own])
    cov += X @ np.diag(1.0 / precision) @ X.T
    seen = ~np.isnan(flat)
    law = stats.multivariate_normal(
        (np.concatenate(centre) + X @ mean)[seen], cov[np.ix_(seen, seen)]
    )
    expected = law.logpdf(flat[seen])
    np.testing.assert_allclose(found + 0.5 * np.log(precision).sum(), expected, rtol=1e-9)


def test_one_censored_rate_has_the_probability_of_its_side():
    """Trust and coefficients are normal before the rate is cut: one normal probability."""
    for y, limit, side in ((1.0, 1.0, 1.0), (0.0, 0.0, -1.0)):
        z = np.array([[[[0.4, 0.9]]]])
        batch = MissionBatch(z, np.full((1, 1, 1), y), np.full((1, 1, 1), np.nan))
        chains, sites = trust.gather_chains(FAMILIES["censored"], batch, np.ones(1, dtype=int))
        point = np.array([[0.6]]), np.array([0.2]), np.array([0.1]), np.array([0.5, 0.4])
        P, g = np.diag([1.0, 2.0, 4.0])[None], np.array([[0.3, -0.1, 0.2]])
        (found,) = joint.log_evidence(*point, P, g, chains, sites, 12)
        u = np.array([0.4, 0.9, 1.0])
        center = 0.6 * 0.5 + u @ g[0]
        var = (0.6 * 0.4) ** 2 + 0.2**2 + 0.1**2 + u**2 @ (1.0 / np.diag(P[0]))
        expected = stats.norm.logcdf(side * (center - limit) / np.sqrt(var))
        found += 0.5 * np.linalg.slogdet(P[0])[1]
        np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("h", [-30.0, -6.5, -4.5, -2.0, 0.0, 3.0])
def test_draws_beyond_a_limit_are_of_a_truncated_normal(h):
    rng = np.random.default_rng(0)
    sd, delta_v, n = 0.3, 0.2, 4000
    mean = 1.0 + h * np.hypot(sd, delta_v)
    x, log_p = zip(*(terms.draw_censored(terms.AT_ONE, delta_v, mean, sd, rng) for _ in range(n)),
                   strict=True)  # fmt: skip
    np.testing.assert_allclose(log_p[0], stats.norm.logcdf(h), rtol=1e-6)
    # E[x] and var[x] by the moments of a normal cut at h (Tobin 1958).
    ratio = np.exp(stats.norm.logpdf(h) - stats.norm.logcdf(h))
    gain = sd**2 / np.hypot(sd, delta_v)
    expected = mean + gain * ratio
    var = sd**2 - gain**2 * ratio * (ratio + h)
    assert abs(np.mean(x) - expected) < 5 * np.sqrt(var / n)
    assert abs(np.var(x) / var - 1.0) < 5 * np.sqrt(2.0 / n)


@pytest.mark.parametrize("n_ticks", [1, 40, 600])
def test_the_table_of_counts_is_that_of_scipy(n_ticks):
    counts = np.array([[n, n_ticks] for n in sorted({0, n_ticks // 3, n_ticks})], dtype=float)
    row = np.zeros((len(counts), terms.N_X))
    terms.table_at(terms.count_tables(counts), 0.23, row)
    phi = terms.concentration(0.23)
    constant = terms.constants(counts, phi)
    for x in (-6.1, -0.37, 0.5, 3.3):
        p = 1.0 / (1.0 + np.exp(-x))
        for i, (n, N_) in enumerate(counts):
            law = stats.betabinom(int(N_), phi * p, phi * (1.0 - p))
            exact = constant[i] + terms.log_count(n, N_, phi, x)
            np.testing.assert_allclose(exact, law.logpmf(n), rtol=1e-8, atol=1e-8)
            assert abs(terms._read(row[i], x) - exact) < 1e-2  # moves sites, not weights


@pytest.mark.parametrize("family", ["censored", "beta_binomial"])
def test_trust_given_parameters_is_that_of_a_grid(family):
    p, n = OF_FAMILY[family], 1000
    _, _, missions = counted_missions(family)
    many = TrustParams(*(np.broadcast_to(np.asarray(v), (n, *np.shape(v))).copy() for v in p[:7]))
    many = many._replace(b=many.b + 1e-9 * np.arange(n))  # draws that repeat are looked at once
    batch, rng = stack_missions(missions, pad=False), np.random.default_rng(0)
    n_bounds = np.full(len(missions), 5)
    found = trust.summarize(FAMILIES[family], many, batch, n_bounds, rng)
    z, y = batch.awareness[:, :, 0], batch.contact_rate[:, :, 0]
    expected, mean, sd = np.transpose(
        [on_a_grid(family, p, z[j], y[j], last_trust=True) for j in range(len(y))]
    )
    np.testing.assert_allclose(found.log_likelihood.mean(0), expected, atol=5e-3)
    x = trust.sample(FAMILIES[family], many, batch, n_bounds, rng)[:, :, -1, 0]
    for ours, spread in ((found.mean[:, -1, 0], found.sd[:, -1, 0]), (x.mean(0), x.std(0))):
        # 1000 draws of near-even weights: 5 standard errors.
        assert (np.abs(ours - mean) < 5 * sd / np.sqrt(n)).all()
        assert (np.abs(spread / sd - 1.0) < 5 / np.sqrt(2 * n)).all()
    assert found.sd[0, 2, 0] > found.sd[0, 3, 0]  # no rate


def test_gaussian_terms_give_the_smoother_s_moments():
    _, _, missions = counted_missions("gaussian", low=0.1)
    p = OF_FAMILY["gaussian"]
    n = 500
    rng = np.random.default_rng(1)
    many = TrustParams(
        rng.uniform(0.4, 0.8, n),
        p.beta + 0.05 * rng.standard_normal((n, 2)),
        p.b + 0.05 * rng.standard_normal(n),
        rng.uniform(0.05, 0.2, n),
        rng.uniform(0.05, 0.2, n),
        np.full(n, 0.5),
        np.full(n, 0.5),
    )
    batch, n_bounds = stack_missions(missions, pad=False), np.full(len(missions), 5)
    exact = kalman_numpy.summarize(many, 0.0, batch, n_bounds)
    found = trust.summarize(FAMILIES["censored"], many, batch, n_bounds, rng)
    np.testing.assert_allclose(found.log_likelihood, exact.log_likelihood, rtol=1e-9)
    # Two trajectories of each draw: 5 standard errors of a mean of 1000, and of an sd.
    assert (np.abs(found.mean - exact.mean) < 5 * exact.sd / np.sqrt(2 * n)).all()
    np.testing.assert_allclose(found.sd, exact.sd, rtol=5 / np.sqrt(4 * n))


def test_a_mission_without_a_rate_leaves_the_evidence_as_it_is():
    _, _, missions = counted_missions("censored")
    none = Mission.from_arrays([(0, 0), (0, 1)], np.full((1, 1, 2), 0.5), [[np.nan]])
    args = *(np.asarray(a)[None] for a in known(OF_FAMILY["censored"])[:3]), np.array([0.5, 0.5])
    prior = np.eye(3)[None], np.zeros((1, 3))
    found = []
    for some in (missions, [*missions, none]):
        batch, n_bounds = stack_missions(some, pad=False), [len(m.bounds) for m in some]
        chains = trust.gather_chains(FAMILIES["censored"], batch, np.array(n_bounds))
        found.append(joint.log_evidence(*args, *prior, *chains, 4))
    np.testing.assert_allclose(found[0], found[1], rtol=1e-12)
