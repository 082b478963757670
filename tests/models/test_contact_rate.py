"""Contact rates given any drift, of programs of users."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
from dense_statespace import form_of, mission_of
from numpyro import handlers
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal
from unit_noise import UnitNoise

from trustbo.errors import TrustboError
from trustbo.models import ContactRate
from trustbo.models.backend import own_settings
from trustbo.models.observations import median_resolution

N_ROBOTS = 3
RNG = np.random.default_rng(0)
DRIFT, OFFSET = RNG.uniform(-0.3, 0.5, (2, 2, 4, N_ROBOTS))
RATES = RNG.uniform(size=DRIFT.shape)
RATES[0, 2, 1] = RATES[1, 3] = np.nan
ROOT = 0.2 * RNG.normal(size=(2, N_ROBOTS, N_ROBOTS)) + 0.3 * np.eye(N_ROBOTS)
SHAPES = {
    "number": {"beta0": 0.6, "delta_w": 0.2, "delta_v": 0.1},
    "robot": {
        "beta0": np.array([0.2, 0.5, 0.9]),
        "delta_w": np.array([0.1, 0.2, 0.3]),
        "delta_v": np.array([0.3, 0.2, 0.1]),
    },
    "matrix": {
        "beta0": RNG.uniform(-0.2, 0.5, (N_ROBOTS, N_ROBOTS)),
        "delta_w": ROOT[0] @ ROOT[0].T,
        "delta_v": ROOT[1] @ ROOT[1].T,
    },
}
X0 = {"x0_mean": np.array([0.4, 0.5, 0.7]), "x0_sd": np.array([0.6, 0.0, 0.2])}
LAWS = [(*shapes, (None, 0.25)[i % 2]) for i, shapes in enumerate(product(SHAPES, SHAPES, SHAPES))]
LAWS.append(("number", "number", "number", 0.25))
"""Shapes of beta0, delta_w and delta_v, and delta_s."""


def law_of(of_beta0, of_delta_w, of_delta_v, delta_s, **options):
    """`ContactRate` with parameters of these shapes, and the dense normal of each mission."""
    shapes = {"beta0": of_beta0, "delta_w": of_delta_w, "delta_v": of_delta_v}
    given = {name: SHAPES[shape][name] for name, shape in shapes.items()}
    law = ContactRate(DRIFT, **given, **X0, offset=OFFSET, delta_s=delta_s, **options)
    form = form_of(**given, **X0, n_robots=N_ROBOTS, delta_s=delta_s or 0.0)
    return law, [mission_of(form, u, o) for u, o in zip(DRIFT, OFFSET, strict=True)]


@pytest.mark.parametrize(("of_beta0", "of_delta_w", "of_delta_v", "delta_s"), LAWS)
def test_the_density_is_that_of_the_joint_normal(of_beta0, of_delta_w, of_delta_v, delta_s):
    with own_settings():
        law, dense = law_of(of_beta0, of_delta_w, of_delta_v, delta_s)
        found = law.log_prob(RATES)
    expected = [one.log_density(y) for one, y in zip(dense, RATES, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("delta_s", [None, 0.3])
@pytest.mark.parametrize(("beta0", "x0_sd"), [(0.0, 0.5), (0.6, 0.0)])
def test_rates_of_a_known_trust_are_those_of_a_regression(beta0, x0_sd, delta_s):
    """Without process noise, trust is known, and only the noise of rates is left."""
    trust = np.zeros(DRIFT.shape)
    before = 0.5
    for k in range(DRIFT.shape[1]):
        before = trust[:, k] = beta0 * before + DRIFT[:, k]

    with own_settings():
        law = ContactRate(DRIFT, beta0, 0.0, 0.1, 0.5, x0_sd, delta_s=delta_s)
        found = law.log_prob(RATES)

    cov = 0.1**2 * np.eye(N_ROBOTS) + (delta_s or 0.0) ** 2
    expected = [
        sum(
            multivariate_normal(x[seen], cov[np.ix_(seen, seen)]).logpdf(y[seen])
            for x, y in zip(trust[j], RATES[j], strict=True)
            if (seen := ~np.isnan(y)).any()
        )
        for j in range(len(RATES))
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("shapes", LAWS[::4])
def test_rates_are_drawn_from_the_joint_normal(shapes, monkeypatch):
    """Of unit vectors instead of normal numbers; the numbers of missions differ."""
    rng = UnitNoise()
    monkeypatch.setattr(
        jax.random, "normal", lambda key, shape: jnp.asarray(rng.standard_normal(shape))
    )
    with own_settings():
        law, dense = law_of(*shapes)
        drawn = np.asarray(law.sample(jax.random.key(0), (1 + 4 * DRIFT.size,)))

    mean, cov = rng.moments(drawn)
    np.testing.assert_allclose(mean, np.concatenate([one.mean for one in dense]), rtol=1e-9)
    expected = block_diag(*(one.rate_cov for one in dense))
    np.testing.assert_allclose(cov, expected, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("delta_s", [None, 0.25])
def test_many_drawn_rates_have_the_moments_of_the_joint_normal(delta_s):
    """Within 5 standard errors of 20 000 draws, without a change of the generator."""
    n = 20_000
    with own_settings():
        law, dense = law_of("robot", "number", "robot", delta_s)
        rates = np.asarray(law.sample(jax.random.key(0), (n,)))
    assert rates.shape == (n, *DRIFT.shape)
    for j, one in enumerate(dense):
        y = rates[:, j].reshape(n, -1)
        sd = np.sqrt(np.diag(one.rate_cov))
        assert (np.abs(y.mean(0) - one.mean) < 5.0 * sd / np.sqrt(n)).all()
        error = (np.cov(y.T) - one.rate_cov) / np.outer(sd, sd)
        assert (np.abs(error) < 5.0 * np.sqrt(2.0 / n)).all()


def test_with_numbers_of_ticks_it_has_the_probability_of_counts():
    """The median resolution of the rates is added to the noise."""
    n_ticks = np.full(RATES.shape, 20.0)
    n_ticks[1] = 50.0
    n_ticks[np.isnan(RATES)] = 0.0
    some = n_ticks.copy()
    some[0, 0, 0] = np.nan  # then all are densities

    given = {**SHAPES["number"], "beta0": SHAPES["robot"]["beta0"], **X0}
    found = []
    expected = []
    with own_settings():
        for ticks in (n_ticks, some):
            law = ContactRate(DRIFT, **given, offset=OFFSET, n_ticks=ticks)
            found.append(law.log_prob(RATES))

            noise = np.hypot(given["delta_v"], np.median(1.0 / ticks[ticks > 0.0]))
            form = form_of(**{**given, "delta_v": noise}, n_robots=N_ROBOTS)
            dense = [mission_of(form, u, o) for u, o in zip(DRIFT, OFFSET, strict=True)]
            expected.append([one.log_density(y) for one, y in zip(dense, RATES, strict=True)])

    n_seen = (~np.isnan(RATES)).sum((1, 2))
    expected[0] -= n_seen * np.log([20.0, 50.0])
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("ticks", [[0.0, np.nan], [40.0, 20.0, 0.0], [40.0, 20.0, 10.0], [2.0]])
def test_the_resolution_is_the_median_of_the_counted_rates(ticks):
    ticks = np.array(ticks)
    counted = ticks[ticks > 0.0]
    expected = min(np.median(1.0 / counted), 0.1) if len(counted) else 0.005
    assert median_resolution(ticks) == pytest.approx(expected)
    with own_settings():
        assert float(median_resolution(jnp.asarray(ticks))) == pytest.approx(expected)


def test_a_model_of_ones_own_is_a_numpyro_program():
    z = jnp.asarray(np.random.default_rng(0).uniform(size=(3, 4, 2, 1)))

    def program(rates=None):
        slope = numpyro.sample("slope", numpyro.distributions.Normal(0.5, 0.1))
        with numpyro.plate("mission", len(z)):
            law = ContactRate(slope * z[..., 0], 0.5, 0.1, 0.1)
            return numpyro.sample("contact_rate", law, obs=rates)

    rates = handlers.seed(program, jax.random.key(0))()
    trace = handlers.trace(handlers.seed(program, jax.random.key(0))).get_trace(rates)
    assert trace["contact_rate"]["fn"].log_prob(rates).shape == (3,)


@pytest.mark.parametrize("shape", [(4, 3), (2, 4, 3, 1), ()])
def test_a_drift_of_another_shape_is_refused(shape):
    with pytest.raises(TrustboError, match="drift"):
        ContactRate(np.zeros(shape), 0.5, 0.1, 0.1)


def test_rates_and_parameters_must_have_the_shape_of_the_drift():
    rates = np.zeros((2, 4, 3))
    law = ContactRate(rates, np.full(3, 0.5), 0.1, 0.1)
    assert law.log_prob(rates).shape == (2,)
    with pytest.raises(TrustboError, match="mission, bound, robot"):
        law.log_prob(np.zeros((2, 3, 4)))
    with pytest.raises(TrustboError, match="beta0"):
        ContactRate(rates, np.full(4, 0.5), 0.1, 0.1)
    for beta0 in (0.5, np.eye(3)):
        with pytest.raises(TrustboError, match="delta_s"):
            ContactRate(rates, beta0, 0.1, 0.1, delta_s=np.full(3, 0.1))


def test_noise_scale_multiplies_each_rates_own_noise():
    """Against the joint normal of a mission's rates, with one factor for each rate."""
    scale = np.random.default_rng(3).uniform(0.1, 1.5, DRIFT.shape)
    given = {"beta0": 0.6, "delta_w": 0.2, "delta_v": 0.1}
    y = np.random.default_rng(4).uniform(size=DRIFT.shape)
    with own_settings():
        scaled = ContactRate(DRIFT, **given, noise_scale=scale)
        found = np.asarray(scaled.log_prob(y))
        drawn = np.asarray(scaled.sample(jax.random.key(0), (20_000,)))

    n = DRIFT.shape[1]
    lag = np.subtract.outer(np.arange(n), np.arange(n))
    T = np.where(lag >= 0, 0.6 ** np.maximum(lag, 0), 0.0)
    of_start = 0.6 ** np.arange(1.0, n + 1.0)
    cov = 0.2**2 * T @ T.T + 0.5**2 * np.outer(of_start, of_start)
    expected = np.zeros(len(DRIFT))
    for j, robot in product(range(len(DRIFT)), range(N_ROBOTS)):
        mean = T @ DRIFT[j, :, robot] + 0.5 * of_start
        total = cov + np.diag((0.1 * scale[j, :, robot]) ** 2)
        expected[j] += multivariate_normal.logpdf(y[j, :, robot], mean, total)
        sd = drawn[:, j, :, robot].std(0)
        np.testing.assert_allclose(sd, np.sqrt(np.diag(total)), rtol=0.03)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_noise_scale_needs_noise_that_is_no_matrix_and_the_shape_of_the_drift():
    with pytest.raises(TrustboError, match="noise_scale cannot be combined"):
        ContactRate(DRIFT, 0.5, 0.1, SHAPES["matrix"]["delta_v"], noise_scale=0.5)
    with pytest.raises(TrustboError, match="noise_scale must have the shape"):
        ContactRate(DRIFT, 0.5, 0.1, 0.1, noise_scale=np.ones(N_ROBOTS))
