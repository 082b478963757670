"""Censored rates and counts of ticks, against integrals over a grid of trust."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from missions import N_TICKS, OF_FAMILY, counted_missions
from references import on_a_grid
from scipy import special, stats

from trustbo.data import Mission
from trustbo.errors import ShapeError, TrustboError
from trustbo.inference import fit
from trustbo.models import CoupledParams, CoupledTrust, HierarchicalTrust, PooledTrust, TrustParams
from trustbo.models.families import FAMILIES, Observed


@pytest.mark.parametrize("family", ["censored", "beta_binomial"])
def test_importance_sampling_finds_the_integral_over_trust(family):
    z, y, missions = counted_missions(family)
    assert ((y == 0.0) | (y == 1.0)).any()
    model, p = PooledTrust(observation=family), OF_FAMILY[family]
    expected = [on_a_grid(family, p, z[j, :, 0], y[j, :, 0]) for j in range(len(y))]
    found = np.array([model.log_likelihood(p, missions, seed=s) for s in range(60)])
    estimate = special.logsumexp(found, axis=0) - np.log(len(found))
    # 60 runs of 32: the standard error of the log of their mean, 5 of it, and the grid's error.
    se = np.exp(found - estimate).std(0) / np.sqrt(len(found))
    assert (np.abs(estimate - expected) < 5 * se + 1e-3).all()
    # One run is what LOO sees: good to a few hundredths of a nat.
    assert np.abs(found - expected).mean() < 0.1


def test_a_grid_agrees_with_the_exact_gaussian_likelihood():
    """The reference of the test above, checked where the answer is known."""
    z, y, missions = counted_missions("gaussian", low=0.1)
    p = OF_FAMILY["gaussian"]._replace(delta_w=0.2, delta_v=0.2)
    expected = [on_a_grid("gaussian", p, z[j, :, 0], y[j, :, 0]) for j in range(len(y))]
    np.testing.assert_allclose(PooledTrust().log_likelihood(p, missions), expected, atol=1e-6)


def test_rates_that_are_not_at_the_ends_are_not_censored():
    _, _, missions = counted_missions("gaussian", low=0.1)
    np.testing.assert_allclose(
        PooledTrust(observation="censored").log_likelihood(OF_FAMILY["gaussian"], missions),
        PooledTrust().log_likelihood(OF_FAMILY["gaussian"], missions),
        rtol=1e-10,
    )


def test_correlated_censored_rates_of_coupled_robots():
    """Two robots, one bound: a bivariate normal, its half-lines and its quadrant."""
    Delta = np.array([[0.04, 0.03], [0.03, 0.05]])
    p = CoupledParams(0.5 * np.eye(2), np.zeros((1, 2, 2)), np.array([0.1, 0.2]), Delta, Delta)
    mean = 0.5 * 0.5 + p.b
    cov = 2.0 * Delta + 0.25 * 0.25 * np.eye(2)
    model = CoupledTrust(observation="censored")
    for y in itertools.product((0.0, 0.4, 1.0), repeat=2):
        mission = Mission.from_arrays([(0, 0), (0, 1)], np.zeros((1, 2, 1)), [y])
        low = [-np.inf if v == 0 else v for v in y]
        high = [np.inf if v == 1 else v for v in y]
        inside = [i for i in range(2) if y[i] == 0.4]
        law = stats.multivariate_normal(mean, cov)
        if len(inside) == 2:
            expected = law.logpdf(y)
        elif not inside:
            expected = np.log(law.cdf(high, lower_limit=low))
        else:
            (i,), o = inside, 1 - inside[0]
            slope = cov[o, i] / cov[i, i]
            given = stats.norm(
                mean[o] + slope * (y[i] - mean[i]), np.sqrt(cov[o, o] - slope * cov[o, i])
            )
            tail = given.logcdf(0.0) if y[o] == 0 else given.logsf(1.0)
            expected = stats.norm.logpdf(y[i], mean[i], np.sqrt(cov[i, i])) + tail
        found = [model.log_likelihood(p, [mission], seed=s)[0] for s in range(40)]
        estimate = special.logsumexp(found) - np.log(len(found))
        se = np.exp(np.array(found) - estimate).std() / np.sqrt(len(found))
        assert abs(estimate - expected) < 5 * se + 1e-5, y


def test_counts_have_the_beta_binomial_s_moments():
    """With trust fixed: no process noise, no autoregression."""
    p = TrustParams(0.0, np.array([1.0]), 0.3, 1e-9, 0.3)
    n = 20_000
    z = np.full((n, 1, 1, 1), 0.5)
    sample = PooledTrust(observation="beta_binomial").simulate(
        jax.random.key(0), p, z, n_ticks=N_TICKS
    )
    share, phi = special.expit(0.8), 0.3**-2.0
    law = stats.betabinom(N_TICKS, phi * share, phi * (1.0 - share))
    counts = sample.contact_rate.ravel() * N_TICKS
    assert abs(counts.mean() - law.mean()) < 5 * law.std() / np.sqrt(n)
    assert abs(counts.var() / law.var() - 1.0) < 5 * np.sqrt(3.0 / n)
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)


def test_a_linearisation_point_at_the_mode_evens_the_weights():
    z, y, _ = counted_missions("beta_binomial", seed=2)
    with jax.enable_x64(True):
        params = OF_FAMILY["beta_binomial"].map(lambda v, _: jnp.asarray(v, dtype=float))
        family, ssm = FAMILIES["beta_binomial"], params.ssm(jnp.asarray(z))
        rough = Observed.of(jnp.asarray(y), jnp.full(y.shape, float(N_TICKS)))
        fine = jax.jit(family.refine)(ssm, rough)
        innovations = np.random.default_rng(0).normal(size=(400, *rough.y.shape))
        weigh = jax.jit(jax.vmap(family.log_density, in_axes=(None, None, 0)))
        spreads = [
            float(np.asarray(weigh(ssm, observed, innovations)).std(0).mean())
            for observed in (rough, fine)
        ]
    assert spreads[1] < 0.5
    assert spreads[1] <= spreads[0]


def test_the_resolution_of_a_rate_is_one_tick():
    y = np.array([0.0, 0.5, 1.0, np.nan])
    ticks = np.full(4, 50.0)
    log = -np.log(50.0)
    found = {name: family.log_resolution(y, ticks) for name, family in FAMILIES.items()}
    np.testing.assert_allclose(found["gaussian"], [log, log, log, 0.0])
    np.testing.assert_allclose(found["censored"], [0, log, 0, 0])
    np.testing.assert_allclose(found["beta_binomial"], np.zeros(4))
    assert np.isnan(FAMILIES["gaussian"].log_resolution(y, ticks * np.nan)[0])


def test_families_that_do_not_suit_are_refused():
    _, _, missions = counted_missions("gaussian")
    bare = [Mission.from_arrays(m.path, m.awareness, m.contact_rate) for m in missions]
    counted = PooledTrust(observation="beta_binomial")
    expected = "mission 0, bound 1, robot 0 has a contact rate but no n_ticks. .* give n_ticks"
    with pytest.raises(TrustboError, match=expected):
        fit(bare, counted)
    with pytest.raises(TrustboError, match="unknown observation 'poisson'"):
        PooledTrust(observation="poisson")
    with pytest.raises(TrustboError, match='sampler "nuts" is for Gaussian rates'):
        fit(missions, HierarchicalTrust(observation="censored"), sampler="nuts")
    with pytest.raises(TrustboError, match="fractional mission"):
        fit(missions, PooledTrust(observation="censored"), weights=[0.5] * 6)


def test_ticks_are_whole_and_rates_are_shares_of_them():
    z, path = np.full((1, 1, 1), 0.5), [(0, 0), (0, 1)]
    with pytest.raises(TrustboError, match=r"n_ticks\[0\] = 10.5 must be a whole number of ticks"):
        Mission.from_arrays(path, z, [[0.5]], n_ticks=10.5)
    with pytest.raises(TrustboError, match=r"contact_rate\[0\] = 0.55 is no share of 10 ticks"):
        Mission.from_arrays(path, z, [[0.55]], n_ticks=10)
    with pytest.raises(ShapeError, match=r"n_ticks must be \(1, 1\); got \(3, 1\)"):
        Mission.from_arrays(path, z, [[0.5]], n_ticks=[1, 2, 3])
    assert Mission.from_arrays(path, z, [[0.5]], n_ticks=10).n_ticks[0, 0] == 10


@pytest.mark.parametrize("name", list(FAMILIES))
@pytest.mark.parametrize("trust", [-1.3, 0.2, 0.95])
def test_moments_of_a_rate_are_those_of_simulated_ones(name, trust):
    """1e5 rates: mean and variance within 5 standard errors; the slope by differences."""
    family, sd, n = FAMILIES[name], np.array(0.15), 100_000
    mean, slope, variance = family.rate_moments(np.array(trust), sd)
    rng = np.random.default_rng(1)
    if name == "beta_binomial":
        p, phi = special.expit(trust), 1.0 / (sd**2 + 1e-6)
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
