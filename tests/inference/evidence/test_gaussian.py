"""Evidence of Gaussian rates against the joint normal of all rates, and against closed forms."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from joint_normal import Dense
from missions import walking_missions
from references import dense_log_likelihood
from scipy import sparse

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference.evidence.gaussian import Gaussian
from trustbo.inference.evidence.gaussian_jax import GaussianJax
from trustbo.inference.evidence.statistics import gather
from trustbo.inference.samplers import exact
from trustbo.models import PlaceEffect, PooledTrust, Priors
from trustbo.models.backend import own_settings
from trustbo.models.effects.effect import Prior, Slots
from trustbo.models.effects.robot import RobotEffect
from trustbo.models.effects.weights import Weights
from trustbo.models.place import bounds_of, visited
from trustbo.stacking import stack_missions

PRIORS = Priors.of(("line_of_sight", "slope"))
EFFECTS = {
    "weights": [],
    "robots": [RobotEffect()],
    "robots twice": [RobotEffect(rho=0.5), RobotEffect()],  # of shared chains: one set goes first
    "places": [PlaceEffect()],
    "places and robots": [PlaceEffect(), RobotEffect()],
    "cells and robots": [RobotEffect(rho=0.5), PlaceEffect(bounds=False)],
    "bounds": [PlaceEffect(cells=False)],
    "places by robot, and robots": [PlaceEffect(shared=False), RobotEffect()],
}
X0 = 0.4, 0.6
SCALES = {"tau_s", "tau_e", "tau_slow", "tau_day"}


def gathered(missions, effects, weight=None):
    batch = stack_missions(missions)
    bounds = bounds_of(missions, batch.contact_rate.shape[:2])
    place = next((e for e in effects if isinstance(e, PlaceEffect)), PlaceEffect())
    places = visited(bounds, place, batch.contact_rate.shape[2], (5, 5))
    slots = Slots.of(batch, len(missions), ("line_of_sight", "slope"), weight, places)
    return slots, [effect.group(slots) for effect in (Weights(PRIORS), *effects)]


def random_theta(effects, rng, n, memory="level"):
    """Hyperparameters; some scales are 0, and beta0 once."""
    beta0 = rng.uniform(0.0, 0.95, n)
    beta0[0] = 0.0
    theta = {"beta0": beta0, "rest": 1.0 - beta0 if memory == "level" else np.ones(n)}
    theta |= {name: rng.uniform(0.01, 0.3, n) for name in ("delta_w", "delta_v")}
    for effect in effects:
        theta |= effect.scales(rng.standard_normal((n, len(effect.names))))
    for t, name in enumerate(sorted(theta.keys() & SCALES)):
        theta[name][1 + t % 2 :: 3] = 0.0
    return theta


def point(theta, t):
    return {name: values[t : t + 1] for name, values in theta.items()}


@pytest.mark.parametrize("memory", ["level", "deviation"])
@pytest.mark.parametrize("name", EFFECTS)
def test_the_evidence_is_that_of_the_joint_normal(name, memory):
    """With gaps, missions of any length and weight, scales of 0 and no memory."""
    rng, effects = np.random.default_rng(3), EFFECTS[name]
    for seed, missing in ((0, 0.0), (1, 0.3)):
        weight = rng.uniform(0.2, 1.0, 5) if missing else None
        missions = walking_missions(seed, 5, missing=missing)
        slots, groups = gathered(missions, effects, weight)
        theta = random_theta(effects, rng, 6, memory)
        expected = [
            Dense(slots, groups, point(theta, t), X0, memory).log_density() for t in range(6)
        ]
        found = Gaussian(slots, groups, X0, memory).log_density(theta)
        np.testing.assert_allclose(found, expected, rtol=1e-10)


@pytest.mark.parametrize("name", ["weights", "places and robots"])
def test_robots_of_separate_memory_have_the_joint_normal_too(name):
    """With gaps, of which robots share some."""
    rng, effects = np.random.default_rng(3), EFFECTS[name]
    slots, groups = gathered(walking_missions(1, 5, missing=0.3), effects)
    theta = random_theta(effects, rng, 5)
    theta["beta0"] = rng.uniform(0.0, 1.1, (5, slots.n_robots))
    found = Gaussian(slots, groups, X0, apart=True).log_density(theta)
    for t in range(5):
        dense = Dense(slots, groups, point(theta, t), X0)
        np.testing.assert_allclose(found[t], dense.log_density(), rtol=1e-10)


@pytest.mark.parametrize("memory", ["level", "deviation"])
@pytest.mark.parametrize("name", EFFECTS)
def test_the_evidence_in_jax_is_that_in_numpy(name, memory):
    """With gaps, weights, scales of 0 and no memory."""
    rng, effects = np.random.default_rng(3), EFFECTS[name]
    missions = walking_missions(1, 4, missing=0.3)
    evidence = Gaussian(*gathered(missions, effects, rng.uniform(0.2, 1.0, 4)), X0, memory)
    theta = random_theta(effects, rng, 4, memory)
    with own_settings():
        density, in_jax = GaussianJax.of(evidence), jax.jit(GaussianJax.log_density)
        found = [in_jax(density, jax.tree.map(jnp.asarray, point(theta, t))) for t in range(4)]
    np.testing.assert_allclose(found, evidence.log_density(theta), rtol=1e-9)


@pytest.mark.parametrize("memory", ["level", "deviation"])
def test_given_coefficients_the_evidence_is_that_of_each_chain(memory):
    """The reference itself: without spread of the coefficients, chains are independent."""
    (mission,) = walking_missions(0, 1)
    slots, groups = gathered([mission], [])
    narrow = groups[0]._replace(mean=np.array([0.4, 0.2, 0.1]), sd=np.full(3, 1e-9))
    narrow = narrow._replace(stationary=False)
    theta = point(random_theta([], np.random.default_rng(0), 2, memory), 1)
    beta0, w, v = (theta[name][0] for name in ("beta0", "delta_w", "delta_v"))
    expected = 0.0
    for i in range(3):
        z, u = mission.awareness[:, i], mission.awareness[:, i] @ [0.4, 0.2] + 0.1
        if memory == "deviation":  # x - u is a chain without drift that begins at x_0 - E x_0
            y = mission.contact_rate[:, i] - u
            chain = dense_log_likelihood(beta0, np.zeros(2), 0.0, w, v, 0.0, X0[1], z, y)
        else:
            y = mission.contact_rate[:, i]
            chain = dense_log_likelihood(beta0, np.array([0.4, 0.2]), 0.1, w, v, *X0, z, y)
        expected += chain
    found = Dense(slots, [narrow], theta, X0, memory).log_density()
    np.testing.assert_allclose(found, expected, rtol=1e-10)


@pytest.mark.parametrize("n_robots", [1, 3])
def test_robots_alone_or_without_a_rate_are_treated_too(n_robots, capfd):
    """Blocks of the arrow may be empty: LAPACK prints a line about matrices of no rows."""
    missions = []
    for m in walking_missions(2, 4, missing=0.0):
        rates = np.where(np.arange(n_robots) == 1, np.nan, m.contact_rate[:, :n_robots])
        missions.append(Mission.from_arrays(m.path, m.awareness[:, :n_robots], rates))
    rng = np.random.default_rng(0)
    for effects in EFFECTS.values():
        slots, groups = gathered(missions, effects)
        theta = random_theta(effects, rng, 3)
        evidence = Gaussian(slots, groups, X0)
        expected = [Dense(slots, groups, point(theta, t), X0).log_density() for t in range(3)]
        np.testing.assert_allclose(evidence.log_density(theta), expected, rtol=1e-10)
        drawn = evidence.coefficients(theta, np.array([1, 2, 3]), rng)
        assert np.isfinite(drawn).all()
        assert len(drawn) == 6
    assert not any(capfd.readouterr())


def test_without_memory_level_and_deviation_are_one_model():
    missions = walking_missions(4)
    slots, groups = gathered(missions, EFFECTS["places and robots"])
    theta = random_theta(EFFECTS["places and robots"], np.random.default_rng(0), 4)
    theta |= {"beta0": np.zeros(4), "rest": np.ones(4)}
    level, deviation = (Gaussian(slots, groups, X0, m).log_density(theta)
                        for m in ("level", "deviation"))  # fmt: skip
    np.testing.assert_allclose(level, deviation, rtol=1e-12)


@pytest.mark.parametrize("name", ["weights", "places and robots"])
def test_rates_that_are_just_as_expected_have_a_density(name):
    """Full contact on a line of sight of 1, of weight 1 a priori, without memory."""
    path, clear = [(0, 0), (0, 1), (1, 2)], np.tile([1.0, 0.0], (2, 3, 1))
    mission = Mission.from_arrays(path, clear, np.ones((2, 3)), features=("line_of_sight", "slope"))
    slots, groups = gathered([mission], EFFECTS[name])
    theta = random_theta(EFFECTS[name], np.random.default_rng(0), 3)
    theta |= {"beta0": np.zeros(3), "rest": np.ones(3)}
    expected = [Dense(slots, groups, point(theta, t), X0).log_density() for t in range(3)]
    np.testing.assert_allclose(Gaussian(slots, groups, X0).log_density(theta), expected, rtol=1e-10)


def test_a_mission_of_weight_0_is_not_there():
    missions = walking_missions(5)
    effects = EFFECTS["places and robots"]
    theta = random_theta(effects, np.random.default_rng(0), 4)
    rates = [m.contact_rate for m in missions]
    rates[2] = np.full_like(rates[2], np.nan)
    blank = [
        Mission.from_arrays(m.path, m.awareness, y) for m, y in zip(missions, rates, strict=True)
    ]
    found = [
        Gaussian(*gathered(some, effects, weight), X0).log_density(theta)
        for some, weight in ((missions, np.array([1.0, 1.0, 0.0, 1.0])), (blank, None))
    ]
    np.testing.assert_allclose(*found, rtol=1e-12)


@pytest.mark.parametrize("name", ["places", "places and robots", "places by robot, and robots"])
def test_draws_have_the_moments_of_dense_conditioning(name):
    effects, rng = EFFECTS[name], np.random.default_rng(0)
    slots, groups = gathered(walking_missions(6), effects)
    theta = point(random_theta(effects, rng, 4), 3)
    theta |= {name: np.array([0.2]) for name in theta.keys() & SCALES}
    mean, cov = Dense(slots, groups, theta, X0).coefficients()
    n = 20_000
    drawn = Gaussian(slots, groups, X0).coefficients(theta, np.array([n]), rng)
    sd = np.sqrt(np.diag(cov))
    # 5.5 standard errors, of some 100 means and 10 000 products.
    assert (np.abs(drawn.mean(0) - mean) < 5.5 * sd / np.sqrt(n) + 1e-12).all()
    white = (drawn - mean) / np.where(sd > 0.0, sd, 1.0)
    correlation = cov / np.where(sd > 0.0, sd, 1.0) / np.where(sd > 0.0, sd, 1.0)[:, None]
    error = np.sqrt((1.0 + correlation**2) / n)
    assert (np.abs(white.T @ white / n - correlation) < 5.5 * error + 1e-9).all()


def test_draws_of_many_points_are_those_of_each():
    evidence, theta = (
        Gaussian(*gathered(walking_missions(6), []), X0),
        random_theta([], np.random.default_rng(0), 5),
    )
    one = np.ones(5, dtype=int)
    together = evidence.coefficients(theta, one, np.random.default_rng(1))
    rng = np.random.default_rng(1)
    factors = evidence._factors(theta)
    apart = [evidence._draw(factors, t, 1, rng)[0] for t in range(5)]
    np.testing.assert_allclose(together, apart, rtol=1e-9)


def test_the_pooled_evidence_is_that_of_the_exact_sampler():
    missions = walking_missions(7)
    slots, groups = gathered(missions, [])
    theta = random_theta([], np.random.default_rng(1), 20)
    theta["beta0"][0] = 0.5
    theta["rest"] = 1.0 - theta["beta0"]
    model = PooledTrust(PRIORS)
    (statistics,) = gather(model, stack_missions(missions))
    z = np.stack([
        np.log(theta["beta0"] / theta["rest"]),
        np.log(np.hypot(theta["delta_w"], theta["delta_v"])),
        np.log(theta["delta_w"] / theta["delta_v"]),
    ], axis=1)  # fmt: skip
    target = exact._target(statistics, PRIORS)
    *_, jacobian = target.constrain(z)
    prior = sum(PRIORS.log_density(name, theta[name], theta["beta0"])
                for name in ("beta0", "delta_w", "delta_v"))  # fmt: skip
    found = Gaussian(slots, groups, (PRIORS.x0_mean, PRIORS.x0_sd)).log_density(theta)
    np.testing.assert_allclose(found, target.log_density(z) - jacobian - prior, rtol=1e-9)


def test_an_unknown_memory_is_refused():
    slots, groups = gathered(walking_missions(9), [])
    with pytest.raises(TrustboError, match="'levels'"):
        Gaussian(slots, groups, X0, "levels")


class Further(NamedTuple):
    """One more column, of a coefficient N(mean, sd^2)."""

    columns: sparse.csr_array
    sd: float
    mean: float = 0.0
    joined = ()
    fades = False

    def prior(self, theta):
        shape = len(theta["beta0"]), 1
        return Prior(np.full(shape, self.mean), np.full(shape, self.sd))

    def name(self, c, theta, rng):
        return {}
