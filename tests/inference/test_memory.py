"""Whether trust carries over between bounds: evidence against quadrature, and simulated rates."""

import jax
import numpy as np
import pytest
from references import dense_log_likelihood
from scipy import stats

import trustbo as tb
from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference.evidence.gaussian import Gaussian
from trustbo.inference.memory import Memory
from trustbo.inference.samplers.importance import sample_scores
from trustbo.inference.samplers.posterior import posterior_of
from trustbo.models import (
    HierarchicalTrust,
    PlaceEffect,
    PooledTrust,
    Priors,
    RobotEffect,
    TrustParams,
)
from trustbo.models.effects.effect import Slots
from trustbo.models.effects.weights import Weights
from trustbo.models.params import DeviationParams, DeviationRobotParams
from trustbo.models.record import model_from_record, model_to_record
from trustbo.stacking import stack_missions

FEATURES = ("line_of_sight", "slope")


def missions_with(beta0, n=4, seed=0):
    """Missions of a straight path whose trust has that memory, and the same level."""
    rng, missions = np.random.default_rng(seed), []
    rest = 1.0 - beta0
    truth = TrustParams(beta0, rest * np.array([0.6, 0.1]), rest * 0.1, 0.08 * rest, 0.03)
    for _ in range(n):
        z = rng.uniform(size=(12, 3, 2))
        key = jax.random.key(int(rng.integers(1000)))
        y = np.clip(PooledTrust().simulate(key, truth, z[None]).contact_rate[0], 0.0, 1.0)
        path = [(k, 0) for k in range(13)]
        missions.append(Mission.from_arrays(path, z, y, features=FEATURES))
    return missions


def test_the_evidence_without_memory_is_that_of_quadrature():
    """Over both noises, half-normal a priori; the sampler's error of 400 draws is some .03 nat."""
    (mission,) = missions_with(0.3, 1)
    priors = Priors.of(FEATURES)
    slots = Slots.of(stack_missions([mission]), 1, FEATURES)
    target = posterior_of(PooledTrust(priors), slots, carries=False)
    found = sample_scores(target, 400, 0).draws.log_evidence
    scale = 0.2  # of the priors of both noises
    p = (np.arange(80) + 0.5) / 80
    w, v = (x.ravel() for x in np.meshgrid(*[scale * stats.halfnorm.ppf(p)] * 2))
    theta = {"beta0": 0.0 * w, "rest": 0.0 * w + 1.0, "delta_w": w, "delta_v": v}
    evidence = Gaussian(slots, [Weights(priors).group(slots)], (0.5, 0.5))
    expected = np.logaddexp.reduce(evidence.log_density(theta)) - np.log(len(w))
    assert found == pytest.approx(expected, abs=0.15)


@pytest.mark.parametrize(
    "model",
    [
        PooledTrust(),
        PooledTrust(effects=RobotEffect()),
        PooledTrust(observation="censored"),
    ],
    ids=["pooled", "robots", "censored"],
)
def test_memory_is_found_where_it_is_and_not_where_it_is_not(model):
    carried, not_carried = (
        tb.inference.memory(tb.fit(missions_with(beta0), model, whole=False))
        for beta0 in (0.5, 0.0)
    )
    assert carried.log_bf > 3.0
    assert abs(carried.beta0 - 0.5) < 0.25
    assert str(carried).startswith("trust carries over from one bound to the next: beta0 0.")
    assert not_carried.log_bf < 0.0
    assert not_carried.p_none > 0.5


def test_the_finding_is_open_between_odds_of_19():
    assert Memory(0.0, 0.3, 0.1).p_none == 0.5
    assert str(Memory(1.0, 0.3, 0.1)).startswith("open whether trust carries over")
    assert str(Memory(1.0, 0.3, 0.1)).endswith("log Bayes factor 1.0 for beta0 > 0")
    assert str(Memory(-4.0, 0.3, 0.1)).startswith("trust does not carry over")
    assert Memory(2000.0, 0.9, 0.1).p_none == 0.0


def deviating(beta0, n=5, seed=0):
    """Missions of a straight path whose deviations from expected trust last."""
    rng, missions = np.random.default_rng(seed), []
    truth = DeviationParams(beta0, np.array([0.6, 0.1]), 0.15, 0.08, 0.02)
    for _ in range(n):
        z = rng.uniform(size=(12, 3, 2))
        key = jax.random.key(int(rng.integers(1000)))
        y = np.clip(PooledTrust().simulate(key, truth, z[None]).contact_rate[0], 0.0, 1.0)
        missions.append(Mission.from_arrays([(k, 0) for k in range(13)], z, y, features=FEATURES))
    return missions


@pytest.fixture(scope="module")
def deviations():
    return deviating(0.8)


@pytest.fixture(scope="module")
def of_deviations(deviations):
    model = PooledTrust(effects=[PlaceEffect(), RobotEffect()], memory="deviation")
    return tb.fit(deviations, model, draws=50, seed=1, progress=False)


def test_deviations_that_last_are_told_from_trust_that_does(deviations):
    models = PooledTrust(memory="deviation"), PooledTrust()
    for missions, sign in ((deviations, 1.0), (missions_with(0.7, 5), -1.0)):
        right, wrong = (tb.fit(missions, model, whole=False) for model in models)
        assert sign * (right.attrs["log_evidence"] - wrong.attrs["log_evidence"]) > 5.0
    fitted = tb.fit(deviations, models[0], whole=False)["posterior"]["beta0"]
    assert abs(float(fitted.mean()) - 0.8) < 4.0 * float(fitted.std())


def test_likelihoods_are_those_of_a_chain_of_deviations(of_deviations, deviations):
    draws = of_deviations["posterior"].isel(chain=0, draw=7)
    beta0, b = float(draws["beta0"]), float(draws["b"])
    d = of_deviations["robots"]["robot_effect"].values[0, 7]
    params = tb.inference.params_of(of_deviations)
    assert isinstance(params, DeviationRobotParams)
    noises = float(draws["delta_w"]), float(draws["delta_v"])
    for j, mission in enumerate(deviations):
        place = params.draw(7).of_places(tb.workspace.moves.bounds_along(mission.path))
        z, expected = mission.awareness, 0.0
        for i in range(3):
            u = z[:, i] @ draws["beta"].values + b + d[j, i] * z[:, i, 0] + place[:, 0]
            y = mission.contact_rate[:, i] - u
            no = np.zeros((len(y), 1))
            expected += dense_log_likelihood(beta0, [0.0], 0.0, *noises, 0.0, 0.5, no, y)
        found = of_deviations["log_likelihood"]["contact_rate"].values[0, 7, j]
        np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_the_likelihood_in_jax_is_that_of_numpy(deviations):
    model = PooledTrust(memory="deviation")
    posterior = tb.fit(deviations, model, draws=25, progress=False)
    params = tb.inference.params_of(posterior)
    assert isinstance(params, DeviationParams)
    found = model.log_likelihood(params, deviations)
    expected = posterior["log_likelihood"]["contact_rate"].values.reshape(found.shape)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    table = tb.inference.score(posterior, deviations)
    assert 0.8 < float(table["coverage_90"].sel(among="all")) <= 1.0
    k, y = np.arange(1, 13), deviations[2].contact_rate[:, 1]
    beta0, w, v = (x[:, None] for x in (params.beta0, params.delta_w, params.delta_v))
    mean = params.beta @ deviations[2].awareness[:, 1].T + params.b[:, None]
    lasting = beta0 ** (2 * k)
    variance = lasting * 0.5**2 + w**2 * (1.0 - lasting) / (1.0 - beta0**2) + v**2
    density = stats.norm.pdf(y, mean, np.sqrt(variance)).mean(0)
    np.testing.assert_allclose(table["log_score"][2, :, 1], np.log(density), rtol=1e-6)


def test_plans_expect_of_each_bound_what_its_features_give(of_deviations):
    z = np.random.default_rng(2).uniform(size=(3, 13, 1, 2))
    workspace = tb.Workspace.from_awareness(z, features=FEATURES)
    mean = tb.inference.params_of(of_deviations).mean()
    planner = tb.planning.Planner(workspace, (0, 0), (12, 0), objective="mean")
    path = [(k, 0) for k in range(13)]
    plan = planner.evaluate(path, mean)
    u = (z[:, 1:, 0] * mean.beta[:, None]).sum(2) + mean.b[:, None]
    u = u + mean.of_places(tb.workspace.moves.bounds_along(path)).T
    np.testing.assert_allclose(plan.trust, u.T, rtol=1e-9)


def test_nuts_draws_from_the_posterior_of_deviations(deviations):
    model = PooledTrust(memory="deviation")
    exact = tb.fit(deviations, model, whole=False)["posterior"]
    run = {"n_chains": 2, "warmup": 100, "draws": 400, "check": False, "whole": False}
    nuts = tb.fit(deviations, model, "nuts", progress=False, **run)["posterior"]
    for name in exact:
        # Of 200 effective draws at least: 4 standard errors of the mean.
        shift = abs(nuts[name].mean(("chain", "draw")) - exact[name].mean(("chain", "draw")))
        assert (shift < 4.0 / np.sqrt(200.0) * exact[name].std(("chain", "draw"))).all(), name


def test_a_campaign_with_deviations_goes_on_from_disk(tmp_path):
    z = np.random.default_rng(2).uniform(size=(3, 5, 5, 2))
    workspace = tb.Workspace.from_awareness(z, features=FEATURES)
    truth = DeviationParams(0.7, np.array([0.6, 0.05]), 0.15, 0.05, 0.03)
    options = {"simulator": tb.simulation.ModelSimulator(workspace, truth), "progress": False}
    model = PooledTrust(effects=RobotEffect(), memory="deviation")
    ends = (4, 0), (0, 4)
    whole = tb.iterate(workspace, *ends, n_iterations=3, seed=3, model=model, **options)
    tb.iterate(workspace, *ends, n_iterations=2, seed=3, model=model, directory=tmp_path, **options)
    resumed = tb.resume(tmp_path, n_iterations=3, **options)
    assert resumed.posterior.attrs["memory"] == "deviation"
    assert [m.path for m in resumed.missions] == [m.path for m in whole.missions]
    for name, values in whole.posterior["posterior"].items():
        np.testing.assert_array_equal(resumed.posterior["posterior"][name], values)


def test_records_of_the_usual_memory_are_as_before():
    assert "memory" not in model_to_record(PooledTrust())
    model = PooledTrust(memory="deviation")
    assert model_from_record(model_to_record(model)) == model
    assert "memory deviation" in model.in_short()


def test_what_cannot_treat_deviations_refuses_them(deviations, of_deviations):
    with pytest.raises(TrustboError, match=r"'trust'.*level"):
        PooledTrust(memory="trust")
    censored = PooledTrust(memory="deviation", observation="censored")
    with pytest.raises(TrustboError, match="observations are not Gaussian"):
        tb.fit(deviations, censored, "nuts")
    with pytest.raises(TrustboError, match='criticise takes memory="level"'):
        tb.criticise(of_deviations)


def test_deviations_are_found_in_counts_and_through_limits():
    """Of 600 rates each: the exact sampler of families that are not Gaussian."""
    rng = np.random.default_rng(0)
    for family, scale in (("censored", 1.0), ("beta_binomial", 5.0)):
        model = PooledTrust(observation=family, memory="deviation")
        beta = scale * np.array([0.9, -0.4])
        truth = DeviationParams(0.8, beta, 0.2, scale * 0.15, 0.05, 0.5, 0.5)
        z = rng.uniform(size=(10, 20, 3, 2))
        rates = model.simulate(jax.random.key(5), truth, z, n_ticks=100).contact_rate
        missions = [
            Mission.from_arrays(None, *zy, n_ticks=np.full((20, 3), 100), features=FEATURES)
            for zy in zip(z, np.round(rates * 100.0) / 100.0, strict=True)
        ]
        fitted = tb.fit(missions, model, whole=False, check=False)
        assert fitted.attrs["k_hat"] < 0.7
        for name in ("beta0", "beta"):
            draws = fitted["posterior"][name]
            off = np.abs(draws.mean(("chain", "draw")) - getattr(truth, name))
            assert (off < 4.0 * draws.std(("chain", "draw"))).all(), (family, name)
        level = tb.fit(missions, PooledTrust(observation=family), whole=False, check=False)
        assert fitted.attrs["log_evidence"] - level.attrs["log_evidence"] > 5.0


def test_a_filter_follows_deviations_as_the_joint_normal_has_them():
    params = DeviationParams(*(np.asarray(v)[None] for v in (
        0.7, [0.6, -0.2], 0.15, 0.08, 0.05, 0.4, 0.3)))  # fmt: skip
    rng = np.random.default_rng(1)
    z, y = rng.uniform(size=(6, 1, 2)), rng.uniform(size=(6, 1))
    follow = tb.inference.TrustFilter(params, 1)
    np.testing.assert_allclose(follow.state, [[0.4], [0.3]])  # x0
    u = z[:, 0] @ [0.6, -0.2] + 0.15
    # Deviations d_1, ..., d_6: an AR(1) from d_0 ~ N(0, .3^2).
    roll = np.linalg.inv(np.eye(6) - 0.7 * np.eye(6, k=-1))
    cov = roll @ (0.08**2 * np.eye(6) + np.diag([0.3**2 * 0.7**2] + [0.0] * 5)) @ roll.T
    for k in range(4):
        state = follow.update(z[k], y[k])
        seen = slice(k + 1)
        gain = np.linalg.solve(cov[seen, seen] + 0.05**2 * np.eye(k + 1), cov[seen, k])
        np.testing.assert_allclose(state.mean, u[k] + gain @ (y[seen, 0] - u[seen]), rtol=1e-9)
        sd = np.sqrt(cov[k, k] - gain @ cov[seen, k])
        np.testing.assert_allclose(state.sd, sd, rtol=1e-9)
    seen, ahead = slice(4), slice(4, 6)
    gain = np.linalg.solve(cov[seen, seen] + 0.05**2 * np.eye(4), cov[seen, ahead])
    forecast = follow.predict(z[ahead])
    expected = u[ahead] + gain.T @ (y[seen, 0] - u[seen])
    np.testing.assert_allclose(forecast.mean[:, 0], expected, rtol=1e-9)
    many = tb.inference.TrustFilter(params.map(lambda v, _: np.repeat(v, 4000, axis=0)), 1,
                                    max_draws=4000)  # fmt: skip
    for k in range(4):
        many.update(z[k], y[k])
    drawn = many.predict(z[ahead]).draws[:, :, 0]
    left = cov[ahead, ahead] - gain.T @ cov[seen, ahead] + 0.05**2 * np.eye(2)
    # 5 standard errors of 4000 draws.
    assert (abs(drawn.mean(0) - expected) < 5.0 * np.sqrt(np.diag(left) / 4000.0)).all()
    np.testing.assert_allclose(np.cov(drawn.T), left, rtol=0.15)


def test_what_has_no_such_evidence_is_refused():
    missions = missions_with(0.3, 2)
    with pytest.raises(TrustboError, match=r"memory is weighed under PooledTrust.*Hierarchical"):
        tb.inference.memory(tb.fit(missions, HierarchicalTrust(), whole=False, check=False))
    with pytest.raises(TrustboError, match="takes a posterior from fit"):
        tb.inference.memory(missions)
