"""Families of observations against quadrature."""

from itertools import pairwise

import jax
import numpy as np
import pytest
from scipy.integrate import quad

from trustbo.models.backend import own_settings
from trustbo.models.families import FAMILIES, Levels

ALL = {**FAMILIES, "levels": Levels(7)}
CASES = [
    (name, y, m, v, sd)
    for name, rates in {
        "gaussian": (0.3, 1.2),
        "censored": (0.0, 0.4, 1.0),
        "beta_binomial": (0.0, 0.3, 1.0),
        "levels": (0.0, 0.5, 1.0),
    }.items()
    for y in rates
    for m, v, sd in ((0.4, 0.04, 0.1), (0.9, 0.5, 0.05), (-0.5, 0.1, 0.3))
]
N = 40.0


def density(family, y, m, v, sd):
    """N(f; m, v) times the term of a rate, as a function of the predictor f."""

    def of(f):
        log_p = family.log_prob(np.array(y), np.array(N), np.array([f]), np.array(sd))[0]
        return np.exp(log_p - 0.5 * (f - m) ** 2 / v) / np.sqrt(2.0 * np.pi * v)

    return of


@pytest.mark.parametrize(("name", "y", "m", "v", "sd"), CASES)
def test_match_has_the_moments_of_quadrature(name, y, m, v, sd):
    family = ALL[name]
    of = density(family, y, m, v, sd)
    points = np.linspace(m - 8.0 * np.sqrt(v), m + 8.0 * np.sqrt(v), 41)
    ends = list(pairwise(points))
    mass, first, second = (
        sum(quad(lambda f, k=k: f**k * of(f), a, b)[0] for a, b in ends) for k in range(3)
    )
    one = (np.array([x]) for x in (y, N, m, v, sd))
    log_mass, mean, var = (float(x[0]) for x in family.moment_match(*one))
    rtol = 2e-2 if name == "beta_binomial" else 1e-5
    np.testing.assert_allclose(np.exp(log_mass), mass, rtol=rtol)
    np.testing.assert_allclose(mean, first / mass, atol=rtol * np.sqrt(v))
    np.testing.assert_allclose(var, second / mass - (first / mass) ** 2, rtol=3.0 * rtol)


@pytest.mark.parametrize(("name", "y", "m", "v", "sd"), CASES)
def test_weighted_draws_have_the_matched_moments(name, y, m, v, sd):
    family, n = ALL[name], 20_000
    args = [np.full(n, x) for x in (y, N, m, v, sd)]
    f, log_weight = family.draw(*args, np.random.default_rng(0))
    weight = np.exp(log_weight)
    log_mass, mean, var = (x[0] for x in family.moment_match(*args))
    rtol = 0.03 if name == "beta_binomial" else 1e-6
    np.testing.assert_allclose(np.log(weight.mean()), log_mass, atol=rtol)
    found = weight @ f / weight.sum()
    assert abs(found - mean) < 6.0 * np.sqrt(var / n) + 0.02 * np.sqrt(var)


@pytest.mark.parametrize("name", ALL)
def test_a_rate_that_was_not_measured_teaches_nothing(name):
    none = (np.array([x]) for x in (np.nan, N, 0.3, 0.2, 0.1))
    np.testing.assert_allclose(np.ravel(ALL[name].moment_match(*none)), [0.0, 0.3, 0.2])


@pytest.mark.parametrize("name", FAMILIES)
def test_drawn_rates_have_the_mean_that_plans_take(name):
    family, n = ALL[name], 100_000
    trust, sd = np.full(n, 0.45), np.full(n, 0.2)
    rates = family.sample(trust, sd, np.full(n, 200.0), np.random.default_rng(1))
    mean = float(family.mean_rate(trust[:1], sd[:1])[0])
    assert abs(rates.mean() - mean) < 5.0 * rates.std() / np.sqrt(n)


@pytest.mark.parametrize("name", ALL)
def test_the_density_is_the_same_in_jax(name):
    y, f = np.array([0.0, 0.5, 1.0]), np.array([0.2, 0.6, 0.9])
    numpy = ALL[name].log_prob(y, np.full(3, N), f, np.array(0.1))
    with own_settings():
        found = ALL[name].log_prob(y, np.full(3, N), jax.numpy.asarray(f), 0.1)
    np.testing.assert_allclose(found, numpy, rtol=1e-6)


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("y", [0.0, 0.5, 1.0])
def test_the_derivatives_in_jax_are_differences_of_the_density(name, y):
    at = np.array([0.7, 0.15])  # predictor and sd
    with own_settings():
        found = jax.grad(lambda x: ALL[name].log_prob(jax.numpy.asarray(y), N, x[0], x[1]))(at)

    step = 1e-5 * np.eye(2)
    high, low = (ALL[name].log_prob(np.array(y), np.array(N), *x.T) for x in (at + step, at - step))
    np.testing.assert_allclose(found, (high - low) / 2e-5, rtol=1e-5, atol=1e-6)
