"""The floor of delta_v: the resolution of the rates, and what it makes of constant data."""

import jax
import numpy as np
import numpyro.distributions as dist
import pytest
from missions import simulate_missions
from numpyro.distributions.transforms import biject_to
from references import pooled_posterior
from scipy import integrate, stats

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference import fit, prior_predictive, sample_prior, sbc
from trustbo.models import PooledTrust, Priors
from trustbo.models.backend import call
from trustbo.models.priors_numpy import draw, floored, log_prob
from trustbo.models.ticks import resolution, weigh_ticks
from trustbo.stacking import stack_missions


def constant_missions(rate, n_missions=6, n_ticks=None):
    return [
        Mission.from_arrays(
            m.path,
            m.awareness,
            np.full_like(m.contact_rate, rate),
            n_ticks=None if n_ticks is None else np.full(m.contact_rate.shape, n_ticks),
        )
        for m in simulate_missions(n_missions)
    ]


@pytest.mark.parametrize(
    "base", [dist.HalfNormal(0.2), dist.HalfCauchy(1.0), dist.LogNormal(-3, 1)]
)
def test_a_floored_prior_is_the_prior_given_that_it_is_above(base):
    prior = floored(base, 0.02)
    x = np.linspace(0.02, 2.0, 7)

    @jax.jit  # one program compiles faster than each operation by itself
    def by_numpyro(prior, z, key):
        transform = biject_to(prior.support)
        y, slope = transform(z), jax.vmap(jax.grad(transform))(z)
        of_transform = slope, transform.log_abs_det_jacobian(z, y), transform.inv(y)
        return prior.sample(key, (4000,)), *of_transform

    z = np.linspace(-8.0, 1.0, 5)
    with jax.enable_x64(True):
        at = np.asarray(call(prior, "log_prob", jax.numpy.asarray(x)))
        below = float(call(base, "cdf", jax.numpy.asarray(0.02)))
        before = np.asarray(call(base, "log_prob", x))
        compiled, *of_transform = map(np.asarray, by_numpyro(prior, z, jax.random.key(0)))
    np.testing.assert_allclose(at, before - np.log1p(-below), rtol=1e-6)
    slope, log_jacobian, back = of_transform
    np.testing.assert_allclose(log_jacobian, np.log(slope))
    # Close to the floor, x^2 - floor^2 loses digits.
    np.testing.assert_allclose(back, z, atol=1e-6)
    np.testing.assert_allclose(log_prob(prior, x), at, rtol=1e-6)
    assert log_prob(prior, np.array([0.0199]))[0] == -np.inf
    ours = draw(prior, (4000,), np.random.default_rng(0))
    for drawn in (ours, compiled):
        assert drawn.min() >= 0.02

        def cdf(x):
            with jax.enable_x64(True):
                return (np.asarray(call(base, "cdf", x)) - below) / (1.0 - below)

        assert stats.kstest(drawn, cdf).pvalue > 1e-3


def test_the_mean_of_a_floored_prior_is_its_integral():
    prior = floored(dist.HalfNormal(0.2), 0.05)
    expected = integrate.quad(lambda x: x * np.exp(log_prob(prior, np.array([x]))[0]), 0.05, 3.0)[0]
    assert float(prior.mean) == pytest.approx(expected, rel=1e-6)


def test_the_resolution_is_the_median_of_the_ticks_inverse():
    (one, two, *_) = simulate_missions(2, lengths=(4,))
    rates, ticks = np.full((4, 3), 0.5), np.array([[40.0, 50.0, 100.0]] * 4)
    known = Mission.from_arrays(one.path, one.awareness, rates, n_ticks=ticks)
    expected = {
        resolution(weigh_ticks(stack_missions([known]))): 1 / 50,
        # 12 rates of known ticks, 12 of .005: between .005 and .01, as a plain median.
        resolution(weigh_ticks(stack_missions([known, two]))): 0.0075,
        resolution(weigh_ticks(stack_missions([known, two]), np.r_[1.0, 0.1, np.ones(6)])): 1 / 50,
        resolution(weigh_ticks(stack_missions([known, two]), np.r_[0.0, 1.0, np.ones(6)])): 0.005,
        resolution({2.0: 1.0}): 0.1,
    }
    for found, value in expected.items():
        assert found == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("rate", [1.0, 0.0, 0.7])
def test_constant_rates_have_the_posterior_of_a_quadrature(rate):
    missions = constant_missions(rate)
    exact = fit(missions, PooledTrust(), sampler="exact")
    assert exact.attrs["k_hat"] < 0.5
    assert exact.attrs["delta_v_floor"] == 0.005
    sites = exact["posterior"]
    assert float(sites["delta_v"].min()) >= 0.005
    marginals, _ = pooled_posterior(missions, (40, 40), reach=0.02, floor=0.005, power=3)
    for name, (points, share) in zip(("beta0", "delta_w", "delta_v"), marginals, strict=True):
        mean = share @ points
        sd = np.sqrt(share @ points**2 - mean**2)
        # Kish size > 2000: a standard error of 0.022 sd; the grid adds 0.01 sd.
        assert abs(float(sites[name].mean()) - mean) < 0.09 * sd, name
        assert abs(np.log(float(sites[name].std()) / sd)) < 0.1, name
    np.testing.assert_allclose(
        exact["latent"]["trust_mean"].isel(mission=0, bound=6), rate, atol=0.002
    )


@pytest.mark.slow  # its program takes longest of all to compile
def test_nuts_has_the_floor_of_the_exact_sampler():
    missions = constant_missions(1.0, n_ticks=40)
    exact, nuts = (fit(missions, PooledTrust(), sampler=name) for name in ("exact", "nuts"))
    for name in ("beta0", "delta_w", "delta_v"):
        one, other = (p["posterior"][name] for p in (exact, nuts))
        # ESS and Kish size > 1500: 5 standard errors of a difference are 0.18 sd.
        assert abs(float(one.mean() - other.mean())) < 0.18 * float(other.std()), name
    for posterior in (exact, nuts):
        assert posterior.attrs["delta_v_floor"] == 0.025
        assert posterior.attrs["prior_delta_v"] == "HalfNormal(scale=0.2)"
        for group in ("posterior", "prior"):
            assert float(posterior[group]["delta_v"].min()) >= 0.025


def test_the_evidence_is_that_of_the_normalised_prior():
    """A floor cuts 10 % of the prior off, and next to nothing of this posterior."""
    missions = simulate_missions(6)
    ticks = [
        Mission.from_arrays(m.path, m.awareness, np.round(40 * m.contact_rate) / 40, n_ticks=n)
        for m in missions
        for n in [np.full(m.contact_rate.shape, 40)]
    ]
    without = [Mission.from_arrays(m.path, m.awareness, m.contact_rate) for m in ticks]
    tight = PooledTrust(Priors(delta_w=dist.LogNormal(np.log(0.05), 0.05)))
    of_ticks, of_rates = (fit(m, tight, "exact") for m in (ticks, without))
    assert float((of_rates["posterior"]["delta_v"] < 0.025).mean()) < 0.002
    cut = np.log(stats.halfnorm.sf(0.025 / 0.2)) - np.log(stats.halfnorm.sf(0.005 / 0.2))
    found = of_ticks.attrs["log_evidence"] - of_rates.attrs["log_evidence"]
    assert found == pytest.approx(-cut, abs=0.02)  # two sums over 4096 points
    assert -cut > 0.07


def test_draws_from_the_prior_have_the_floor_too():
    awareness = np.zeros((1, 2, 1, 2))
    for ticks, floor in ((None, 0.005), (20, 0.05)):
        prior = prior_predictive(PooledTrust(), awareness, n_ticks=ticks)["prior"]
        assert floor <= float(prior["delta_v"].min()) < floor + 0.01
        assert float(prior["delta_w"].min()) < floor
    assert sample_prior(PooledTrust(), 2, 2000, 0).delta_v.min() >= 0.005
    counts = PooledTrust(observation="beta_binomial")  # delta_v is no sd of a rate there
    assert sample_prior(counts, 2, 2000, 0).delta_v.min() < 0.005


def test_sbc_draws_the_truth_from_the_prior_with_the_floor():
    """With 10 ticks, half of the truths would lie below the least draw."""
    prior = Priors(delta_v=dist.HalfNormal(0.15))
    ranks = sbc(PooledTrust(prior), n_datasets=60, shape=(2, 4, 2, 2), n_ticks=10, progress=False)
    assert float(ranks["p_value"].sel(parameter="delta_v")) > 1e-3


def test_what_cannot_be_learned_from_is_refused():
    missions = simulate_missions(2)
    unmeasured = Mission.from_arrays(
        missions[0].path, missions[0].awareness, np.full_like(missions[0].contact_rate, np.nan)
    )
    with pytest.raises(TrustboError, match="every contact rate is NaN"):
        fit([unmeasured])
    with pytest.raises(TrustboError, match="only missions of weight 0 have a contact rate"):
        fit([unmeasured, missions[1]], weights=[1.0, 0.0])
    tiny = PooledTrust(Priors(delta_v=dist.HalfNormal(0.001)))
    with pytest.raises(TrustboError, match=r"5.7e-07 of its mass above 0.005, the resolution"):
        fit(missions, tiny)
