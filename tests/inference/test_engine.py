"""The engine against the joint normal of all rates, and a plain NumPyro program."""

import sys

import jax
import numpy as np
import pytest
from joint_normal import Dense
from numpyro import handlers

from trustbo.inference import engine, factor
from trustbo.inference.density import Density, at
from trustbo.models import (
    CoupledTrust,
    HierarchicalTrust,
    PlaceEffect,
    PooledTrust,
    RobotEffect,
)
from trustbo.models.backend import own_settings
from trustbo.models.observations import Observations
from trustbo.models.visited import visited

FEATURES = ("line_of_sight", "vegetation")
EFFECTS = (PlaceEffect(), RobotEffect())
MODELS = {
    "pooled": PooledTrust(),
    "places and robots": PooledTrust(effects=EFFECTS),
    "deviation": PooledTrust(effects=(RobotEffect(),), memory="deviation"),
    "shared noise": PooledTrust(effects=EFFECTS, shared_noise=True),
    "hierarchical": HierarchicalTrust(effects=(RobotEffect(),)),
    "hierarchical, shared noise": HierarchicalTrust(shared_noise=True),
    "coupled": CoupledTrust(),
    "coupled, places and robots": CoupledTrust(effects=EFFECTS),
}


def slots_of(model, *, gaps=False, shape=(4, 5, 3)):
    rng = np.random.default_rng(0)
    z, y = rng.uniform(size=(*shape, 2)), rng.uniform(size=shape)
    if gaps:
        y[rng.random(shape) < 0.15] = np.nan
        y[1, 3:] = np.nan
    observations = Observations(y, z, np.full(shape, 50.0), FEATURES)
    if PlaceEffect() not in model.effects:
        return observations
    steps = [rng.integers(0, n, shape[:2]) for n in (8, 4, 4)]
    return observations._replace(visited=visited(np.stack(steps, -1), (4, 4)))


def posterior_of(name, **options):
    model = MODELS[name].for_features(FEATURES)
    posterior = Density(model, slots_of(model, **options))
    z = 0.5 * np.random.default_rng(1).standard_normal((3, posterior.n_scores))
    return posterior, posterior.theta(z)


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("name", MODELS)
def test_the_evidence_is_the_density_of_the_dense_joint_normal(name, gaps):
    posterior, theta = posterior_of(name, gaps=gaps)
    for i, value in enumerate(posterior.log_evidence(theta)):
        dense = Dense(posterior.model, posterior.observations, at(theta, slice(i, i + 1)))
        np.testing.assert_allclose(value, dense.log_density(), rtol=1e-9)


@pytest.fixture
def chained(monkeypatch):
    """Eliminates robots' effects as chains, as with a hundred missions, in blocks of 2 missions."""
    monkeypatch.setattr(sys.modules["trustbo.inference.density"], "_CHAINED", 2)
    monkeypatch.setattr(factor, "_CHAIN_BLOCK", 6)


@pytest.mark.usefixtures("chained")
@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("name", [name for name in MODELS if RobotEffect() in MODELS[name].effects])
def test_effects_split_into_chains_have_the_same_evidence_and_draws(name, gaps):
    posterior, theta = posterior_of(name, gaps=gaps, shape=(7, 5, 3))
    assert posterior.blocks.order.hidden.shape == (7, 3)
    for i, value in enumerate(posterior.log_evidence(theta)):
        dense = Dense(posterior.model, posterior.observations, at(theta, slice(i, i + 1)))
        np.testing.assert_allclose(value, dense.log_density(), rtol=1e-9)

    drawn = posterior.draw_coefficients(at(theta, np.zeros(4000, int)), np.random.default_rng(0))
    mean, cov = Dense(
        posterior.model, posterior.observations, at(theta, slice(0, 1))
    ).coefficients()
    sd = np.sqrt(np.diag(cov))
    assert (np.abs(drawn.mean(0) - mean) < 5.0 * sd / np.sqrt(4000)).all()
    np.testing.assert_allclose(drawn.std(0), sd, rtol=5.0 / np.sqrt(8000))


@pytest.mark.usefixtures("chained")
def test_slopes_of_chains_in_jax_are_those_in_numpy():
    posterior, _ = posterior_of("places and robots", gaps=True)
    z = 0.5 * np.random.default_rng(3).standard_normal(posterior.n_scores)
    steps = 1e-4 * np.eye(len(z))
    expected = (posterior.log_density(z + steps) - posterior.log_density(z - steps)) / 2e-4
    with own_settings():
        found = jax.grad(lambda one: posterior.log_density(one[None])[0])(jax.numpy.asarray(z))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 1, 3), (3, 4, 1)])
def test_one_bound_and_one_robot_are_cases_like_others(shape):
    posterior, theta = posterior_of("shared noise", shape=shape)
    dense = Dense(posterior.model, posterior.observations, at(theta, slice(0, 1)))
    np.testing.assert_allclose(posterior.log_evidence(theta)[0], dense.log_density(), rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "value"),
    [("beta0", 0.0), ("beta0", 1 - 1e-6), ("delta_w", 1e-3), ("delta_v", 3.0), ("tau_e", 0.0)],
)
def test_the_evidence_holds_at_extreme_hyperparameters(name, value):
    posterior, theta = posterior_of("places and robots", gaps=True)
    theta = {**theta, name: np.full(3, value)}
    theta["inverse_gain"] = 1.0 - theta["beta0"]
    dense = Dense(posterior.model, posterior.observations, at(theta, slice(0, 1)))
    np.testing.assert_allclose(posterior.log_evidence(theta)[0], dense.log_density(), rtol=1e-7)


def test_a_matrix_that_is_not_positive_definite_costs_its_point_alone():
    A = np.stack([np.eye(2), -np.eye(2), 4.0 * np.eye(2)])
    factors = engine.cholesky(A)
    assert np.isnan(factors[1]).any()
    np.testing.assert_allclose(factors[[0, 2]], np.stack([np.eye(2), 2.0 * np.eye(2)]))


@pytest.mark.parametrize("name", ["shared noise", "coupled, places and robots"])
def test_coefficients_drawn_often_at_visited_points_have_the_moments_of_the_joint_normal(name):
    posterior, theta = posterior_of(name)
    z = np.repeat(0.5 * np.random.default_rng(1).standard_normal((3, posterior.n_scores)), 500, 0)
    rng = np.random.default_rng(0)
    log_p, coefficients = posterior.visit(z, rng)
    np.testing.assert_allclose(log_p[::500], posterior.log_density(z[::500]), rtol=1e-12)
    for k in range(3):
        first = np.arange(500 * k, 500 * (k + 1))
        drawn = coefficients.draw(np.repeat(first, 20), rng)
        one = at(theta, slice(k, k + 1))
        mean, cov = Dense(posterior.model, posterior.observations, one).coefficients()
        sd = np.sqrt(np.diag(cov))
        n_independent = 4 * 500
        assert (np.abs(drawn.mean(0) - mean) < 5.0 * sd / np.sqrt(n_independent)).all()
        np.testing.assert_allclose(drawn.std(0), sd, rtol=5.0 / np.sqrt(2 * n_independent))


@pytest.mark.parametrize("name", ["shared noise", "coupled, places and robots"])
def test_drawn_coefficients_have_the_moments_of_the_joint_normal(name):
    posterior, theta = posterior_of(name)
    one = at(theta, slice(0, 1))
    drawn = posterior.draw_coefficients(at(theta, np.zeros(20_000, int)), np.random.default_rng(0))
    mean, cov = Dense(posterior.model, posterior.observations, one).coefficients()
    sd = np.sqrt(np.diag(cov))
    assert (np.abs(drawn.mean(0) - mean) < 5.0 * sd / np.sqrt(20_000)).all()
    np.testing.assert_allclose(drawn.std(0), sd, rtol=0.04)


@pytest.mark.parametrize(
    "name", ["pooled", "deviation", "places and robots", "hierarchical", "coupled"]
)
def test_the_plain_program_has_the_density_of_the_equations(name):
    """Given coefficients: the program's filter, and the matrices of `linear_predictor`."""
    posterior, theta = posterior_of(name, gaps=True)
    model, observations, rng = posterior.model, posterior.observations, np.random.default_rng(2)
    values = posterior.scores.draw(20, rng)
    theta = model.theta(values, observations.resolution)
    density = log_density_of_rates(model, observations)
    y = observations.contact_rate
    resolution = np.nan_to_num(-np.log(observations.n_ticks[~np.isnan(y)]).sum())
    with own_settings():
        for i in range(20):
            given = {n: jax.numpy.asarray(v[i]) for n, v in values.items()}
            c, start = posterior.prior(at(theta, slice(i, i + 1))).draw(rng)[0], 0
            for effect in model.terms:
                mean, parts = effect.prior(at(theta, slice(i, i + 1)), observations)
                first = start
                for k, part in enumerate(parts):
                    stop = start + part.shape[1]
                    of_part = c[start:stop] - (
                        0.0 if mean is None else mean[0, start - first : stop - first]
                    )
                    given[f"{effect.group or 'weights'}_{k}"] = jax.numpy.asarray(of_part)
                    start = stop
            found = float(density(given))
            predictor = model.linear_predictor(
                at(theta, slice(i, i + 1)), observations, posterior.layout
            )
            at_ = engine.expected(posterior.blocks, predictor, c[None])
            W, log_sites = engine.whiten(
                posterior.blocks, predictor, posterior.blocks.seen / predictor.noise_sd**2
            )
            w = W[:, posterior.blocks.kind] @ (posterior.blocks.y - at_)[..., None]
            wanted = log_sites[:, posterior.blocks.kind].sum() - 0.5 * (w**2).sum()
            wanted += resolution  # the program has the probability of tick counts
            np.testing.assert_allclose(found, wanted, rtol=1e-9)


def log_density_of_rates(model, observations):
    """By the program; noise that it samples is integrated out, as its log-density is quadratic."""

    def sites(given):
        program = handlers.substitute(handlers.seed(model.program, 0), given)
        return handlers.trace(program).get_trace(observations)

    def density(given):
        found = sites(given)
        if "trust_noise" not in found:
            rates = found["contact_rate"]
            return rates["fn"].log_prob(rates["value"]).sum()
        prior = found["trust_noise"]["fn"]

        def log_joint(e):
            noise = e.reshape(prior.event_shape)
            rates = sites({**given, "trust_noise": noise})["contact_rate"]
            return prior.log_prob(noise) + rates["fn"].log_factor

        zero = jax.numpy.zeros(prior.event_shape).ravel()
        slope, precision = jax.grad(log_joint)(zero), -jax.hessian(log_joint)(zero)
        gain = slope @ jax.numpy.linalg.solve(precision, slope)
        size = zero.size * np.log(2 * np.pi) - jax.numpy.linalg.slogdet(precision)[1]
        return log_joint(zero) + 0.5 * (gain + size)

    return jax.jit(density)


@pytest.mark.parametrize("name", ["places and robots", "coupled"])
def test_jax_and_numpy_give_one_evidence(name):
    posterior, theta = posterior_of(name, gaps=True)
    with own_settings():
        in_jax = {key: jax.numpy.asarray(values) for key, values in theta.items()}
        found = np.asarray(posterior.log_evidence(in_jax))
    np.testing.assert_allclose(found, posterior.log_evidence(theta), rtol=1e-9)


@pytest.mark.parametrize("name", ["places and robots", "shared noise", "coupled"])
def test_slopes_in_jax_are_those_of_the_density_in_numpy(name):
    posterior, _ = posterior_of(name, gaps=True)
    z = 0.5 * np.random.default_rng(3).standard_normal(posterior.n_scores)
    steps = 1e-4 * np.eye(len(z))
    expected = (posterior.log_density(z + steps) - posterior.log_density(z - steps)) / 2e-4
    with own_settings():
        found = jax.grad(lambda one: posterior.log_density(one[None])[0])(jax.numpy.asarray(z))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
