"""Columns and priors of effects against their equations, written out rate by rate."""

import json
from dataclasses import dataclass

import numpy as np
import pytest
from missions import walking_missions

from trustbo.data import Mission
from trustbo.inference.fit import fit
from trustbo.models import CoupledTrust, HierarchicalTrust, PlaceEffect, PooledTrust, RobotEffect
from trustbo.models.record import effects_from_record, model_to_record

N_MISSIONS = 4
N_ROBOTS = 3
THETA = {
    "inverse_gain": np.array([0.4, 0.7]),
    "tau_slow": np.array([0.3, 0.1]),
    "tau_mission": np.array([0.2, 0.4]),
    "tau_beta": np.array([[0.3, 0.2], [0.1, 0.5]]),
    "tau_b": np.array([0.2, 0.3]),
}
"""Two draws of the hyperparameters of all effects here."""
DIFFERENT_ROBOTS = THETA | {"inverse_gain": np.array([[0.4, 0.5, 0.9], [0.2, 1.0, 0.6]])}


@pytest.fixture(scope="module")
def missions():
    """Missions on random walks, with a feature that predicts line of sight."""
    features = ["line_of_sight", "slope"]
    return [
        Mission.from_arrays(m.path, m.awareness, m.contact_rate, features=features)
        for m in walking_missions(0, N_MISSIONS)
    ]


def drift_of(effect, observations, theta):
    """Draw coefficients; return the values by name, and the drift (draw, mission, bound, robot)."""
    U = effect.design(observations).toarray()
    c = np.random.default_rng(1).normal(size=(2, U.shape[1]))
    values = effect.to_variables(c, theta, observations)
    np.testing.assert_allclose(effect.coefficients(values, theta, observations), c, rtol=1e-12)
    return values, (c @ U.T).reshape(2, *observations.contact_rate.shape)


def common_weights(values, z, i):
    """Equation (3): one weight of each feature, for all robots."""
    return values["beta"] @ z[i] + values["b"]


def own_weights(values, z, i):
    """Equation (3) with weights of each robot."""
    return values["beta"][:, i] @ z[i] + values["b"][:, i]


def coupled_weights(values, z, i):
    """Equation (1): a matrix B_m of each feature m, by which robots influence each other."""
    drift = values["b"][:, i]
    for m in range(z.shape[1]):
        drift = drift + values["B"][:, m, i] @ z[:, m]
    return drift


@pytest.mark.parametrize(
    ("model", "equation"),
    [
        (PooledTrust(), common_weights),
        (HierarchicalTrust(), own_weights),
        (CoupledTrust(), coupled_weights),
    ],
    ids=["pooled", "hierarchical", "coupled"],
)
def test_the_drift_of_weights_is_that_of_the_equation(model, equation, missions):
    observations = model.observations(missions)
    values, drift = drift_of(model.weights, observations, THETA)
    for j, mission in enumerate(missions):
        for k, z in enumerate(mission.awareness):
            for i in range(N_ROBOTS):
                expected = equation(values, z, i)
                np.testing.assert_allclose(drift[:, j, k, i], expected, rtol=1e-10)


@pytest.mark.parametrize("theta", [THETA, DIFFERENT_ROBOTS], ids=["one gain", "different robots"])
def test_a_robot_s_effect_in_a_mission_changes_its_own_trust_there(theta, missions):
    (effect,) = PooledTrust(effects=RobotEffect()).effects
    values, drift = drift_of(effect, PooledTrust().observations(missions), theta)
    inverse_gain = theta["inverse_gain"].reshape(2, -1) * np.ones(N_ROBOTS)
    for j, mission in enumerate(missions):
        for k, z in enumerate(mission.awareness):
            for i in range(N_ROBOTS):
                expected = inverse_gain[:, i] * z[i, 0] * values["robot_effect"][:, j, i]
                np.testing.assert_allclose(drift[:, j, k, i], expected, rtol=1e-10)


def test_a_place_changes_the_trust_of_robots_on_bounds_into_it(missions):
    model = PooledTrust(effects=PlaceEffect())
    observations = model.observations(missions)
    values, drift = drift_of(model.effects[0], observations, THETA)
    places = observations.visited
    cells = places.cells.tolist()
    bounds = places.bounds.tolist()

    moves = [(-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)]
    for j, mission in enumerate(missions):
        for k in range(len(mission.bounds)):
            before, cell = mission.path[k], list(mission.path[k + 1])
            move = moves.index((cell[0] - before[0], cell[1] - before[1]))
            expected = values["place"][:, cells.index(cell)]
            bound = bounds.index([move, *cell])
            expected = expected + values["place_bound"][:, bound]
            for i in range(N_ROBOTS):
                of_robot = expected + values["place_robot"][:, bound, i]
                np.testing.assert_allclose(drift[:, j, k, i], of_robot, rtol=1e-10)
    np.testing.assert_allclose(values["place_robot"].sum(2), 0.0, atol=1e-12)


def test_bounds_driven_again_do_not_make_weights_certain():
    """Line of sight is wrong for each robot in each of ten bounds, equally so in six missions."""
    rng = np.random.default_rng(0)
    sight = rng.uniform(0.3, 0.9, (10, 3))
    rates = sight + rng.normal(0.0, 0.08, sight.shape)
    path = [(0, k) for k in range(11)]
    missions = []
    for _ in range(6):
        measured = np.clip(rates + rng.normal(0.0, 0.01, rates.shape), 0.0, 1.0)
        features = ["line_of_sight"]
        missions.append(Mission.from_arrays(path, sight[..., None], measured, features=features))

    spread = {}
    for tau_r in (1e-4, 0.1):
        model = PooledTrust(effects=PlaceEffect(tau_r=tau_r))
        draws = fit(missions, model, progress=False, latent=False)["posterior"]
        spread[tau_r] = float((draws["beta"] / (1.0 - draws["beta0"])).std())

    assert spread[1e-4] < 0.7 * spread[0.1]


def covariance_of_missions(point, n, rho):
    """Covariance (mission, mission) of the effects d of one robot, from its definition."""
    slow = THETA["tau_slow"][point]
    day = THETA["tau_mission"][point]
    cov = np.empty((n, n))
    for m in range(n):
        for other in range(n):
            cov[m, other] = slow**2 * rho ** abs(m - other) + day**2 * (m == other)
    return cov


@pytest.mark.parametrize("theta", [THETA, DIFFERENT_ROBOTS], ids=["one gain", "different robots"])
def test_the_prior_of_a_robot_s_effects_has_a_lasting_and_an_independent_part(theta, missions):
    effect = RobotEffect(rho=0.8)
    observations = PooledTrust().observations(missions)
    _, parts = effect.prior(theta, observations)
    inverse_gain = theta["inverse_gain"].reshape(2, -1) * np.ones(N_ROBOTS)
    assert len(parts) == N_ROBOTS
    for point in range(2):
        for i, precision in enumerate(parts):
            expected = covariance_of_missions(point, N_MISSIONS, 0.8)
            expected = inverse_gain[point, i] ** 2 * expected  # of coefficients, which are drift
            np.testing.assert_allclose(np.linalg.inv(precision[point]), expected, rtol=1e-9)


def test_a_robot_s_effect_in_the_next_mission_is_normal_given_the_missions_before():
    effect = RobotEffect(rho=0.8)
    n_draws = 20_000
    rng = np.random.default_rng(2)
    d = rng.normal(size=(2, N_MISSIONS, N_ROBOTS))
    values = {"robot_effect": d}
    expected = effect.predict_next(values, DIFFERENT_ROBOTS, N_MISSIONS, None)
    drawn = [effect.predict_next(values, DIFFERENT_ROBOTS, N_MISSIONS, rng) for _ in range(n_draws)]

    for point in range(2):
        # The next effect, which is last, given the others in the joint normal of all missions.
        cov = covariance_of_missions(point, N_MISSIONS + 1, 0.8)
        weight = np.linalg.solve(cov[:-1, :-1], cov[:-1, -1])
        variance = cov[-1, -1] - weight @ cov[:-1, -1]
        inverse_gain = DIFFERENT_ROBOTS["inverse_gain"][point]
        np.testing.assert_allclose(expected[point], inverse_gain * (weight @ d[point]), rtol=1e-9)

        sd = inverse_gain * np.sqrt(variance)
        of_draws = np.array(drawn)[:, point]
        np.testing.assert_allclose(of_draws.std(0), sd, rtol=5.0 / np.sqrt(2 * n_draws))
        error = np.abs(of_draws.mean(0) - expected[point])
        assert (error < 5.0 * sd / np.sqrt(n_draws)).all()


@dataclass(frozen=True)
class Payload(RobotEffect):
    """Effect with nested settings."""

    kg: tuple[tuple[float, ...], ...] = ()


def test_an_effect_with_nested_settings_is_rebuilt_as_it_was():
    model = PooledTrust(effects=[Payload(kg=((1.0, 2.0), (3.0, 4.0)))])
    record = json.loads(json.dumps(model_to_record(model)))
    assert {*effects_from_record(record)} == {*model.effects}  # effects are keys of dicts
