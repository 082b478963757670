"""Effects of robots in missions, from a fit to plans, against dense references."""

import jax
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from missions import walking_missions
from numpyro import handlers
from numpyro.infer.util import log_density
from references import dense_log_likelihood

import trustbo as tb
from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference.draws import params_of_missions
from trustbo.inference.left_out import by_hyperparameters, by_refit
from trustbo.inference.samplers.posterior import evidence_of
from trustbo.models import HierarchicalTrust, PlaceEffect, PooledTrust, RobotEffect, TrustParams
from trustbo.models.backend import own_settings
from trustbo.models.effects.effect import Slots
from trustbo.models.place import bounds_of, visited
from trustbo.models.record import model_from_record, model_to_record
from trustbo.models.ticks import weigh_ticks
from trustbo.stacking import stack_missions

FEATURES = ("line_of_sight", "slope")
BROKEN = 5  # mission from which the second robot sees half of what it did


@pytest.fixture(scope="module")
def missions():
    rng, missions = np.random.default_rng(0), []
    model, truth = PooledTrust(), TrustParams(0.2, np.array([0.7, 0.0]), 0.05, 0.03, 0.03)
    for j, drawn in enumerate(walking_missions(1, 8, n_bounds=(6, 9))):
        z = drawn.awareness.copy()
        lost = z * np.where(np.arange(3) == 1, 0.5, 1.0)[:, None] if j >= BROKEN else z
        key = jax.random.key(int(rng.integers(1000)))
        rates = model.simulate(key, truth, lost[None]).contact_rate[0]
        rates = np.where(np.isnan(drawn.contact_rate), np.nan, np.clip(rates, 0.0, 1.0))
        missions.append(Mission.from_arrays(drawn.path, z, rates, features=FEATURES))
    return missions


@pytest.fixture(scope="module")
def posterior(missions):
    model = PooledTrust(effects=[PlaceEffect(), RobotEffect()])
    return tb.fit(missions, model, draws=100, seed=1, progress=False)


def test_a_detector_that_breaks_is_named_with_its_mission(posterior):
    effect = posterior["robots"]["robot_effect"]
    assert effect.dims == ("chain", "draw", "mission", "robot")
    worse = (effect < -0.1).mean(("chain", "draw"))
    assert (worse.sel(robot="r2", mission=slice(BROKEN, None)) > 0.95).all()
    assert (worse.sel(robot=["r1", "r3"]) < 0.5).all()
    assert (worse.sel(mission=slice(0, BROKEN - 1)) < 0.5).all()


def require_same_moments(nuts, exact, largest_shift, largest_ratio):
    """Means within some sds, and sds within a factor, of all parameters and effects of robots."""
    pairs = [(nuts["posterior"][name], values) for name, values in exact["posterior"].items()]
    pairs.append((nuts["robots"]["robot_effect"], exact["robots"]["robot_effect"]))
    pairs += [(nuts["places"][name], exact["places"][name]) for name in ("place", "place_bound")]
    over = ("chain", "draw")
    for a, b in pairs:
        shift = abs(a.mean(over) - b.mean(over)) / b.std(over)
        assert float(shift.max()) < largest_shift, a.name
        assert float(abs(np.log(a.std(over) / b.std(over))).max()) < np.log(largest_ratio), a.name


def test_nuts_draws_from_the_posterior_of_the_exact_sampler(missions):
    model = PooledTrust(effects=[PlaceEffect(), RobotEffect()])
    exact = tb.fit(missions[:3], model, whole=False)
    run = {"n_chains": 2, "warmup": 100, "draws": 600, "check": False, "whole": False}
    nuts = tb.fit(missions[:3], model, "nuts", **run)
    assert nuts.attrs["sampler"] == "nuts"
    assert nuts["sample_stats"]["n_steps"].shape == (2, 600)
    assert not nuts["sample_stats"]["diverging"].any()
    require_same_moments(nuts, exact, 0.2, 1.2)


@pytest.mark.parametrize("memory", ["level", "deviation"])
def test_the_numpyro_model_has_the_same_evidence(missions, memory):
    """Given hyperparameters, coefficients are Gaussian: Laplace's formula is exact for them."""
    missions = missions[:3]
    model = PooledTrust(effects=[PlaceEffect(), RobotEffect()], memory=memory)
    batch = stack_missions(missions)
    fitted = model.for_features(FEATURES).at_resolution(weigh_ticks(batch, np.ones(8)))
    places = visited(bounds_of(missions, batch.contact_rate.shape[:2]), PlaceEffect(), 3)
    evidence = evidence_of(fitted, Slots.of(batch, 3, FEATURES, None, places))
    theta = {"beta0": 0.3, "delta_w": 0.05, "delta_v": 0.07, "tau_s": 0.1, "tau_e": 0.05}
    theta |= {"length_scale": 1.5, "tau_slow": 0.1, "tau_day": 0.04}
    with own_settings():
        program = model.numpyro_model(missions)
        values = {name: jax.numpy.asarray(v) for name, v in theta.items()}
        fixed = handlers.substitute(program, values)
        sites = handlers.trace(handlers.seed(fixed, 0)).get_trace()
        prior = sum(float(sites[name]["fn"].log_prob(v)) for name, v in theta.items())
        free = {n: s["value"] for n, s in sites.items() if n.startswith(("white", "b"))}
        flat, unravel = ravel_pytree({n: v for n, v in free.items() if n not in theta})

        def log_joint(x):
            return log_density(program, (), {}, values | unravel(x))[0]

        both = jax.jit(jax.value_and_grad(log_joint))
        value, slope = both(0.0 * flat)
        hessian = np.array([both(step)[1] - slope for step in np.eye(len(flat))])
    slope = np.asarray(slope)
    highest = float(value) + 0.5 * slope @ np.linalg.solve(-hessian, slope)
    volume = 0.5 * len(flat) * np.log(2.0 * np.pi) - 0.5 * np.linalg.slogdet(-hessian)[1]
    point = {name: np.array([v]) for name, v in theta.items()} | {
        "rest": np.array([0.7 if memory == "level" else 1.0])
    }
    expected = evidence.log_density(point)[0]
    np.testing.assert_allclose(highest + volume - prior, expected, rtol=1e-8)


@pytest.mark.slow  # 8 000 draws of NUTS
def test_a_long_run_of_nuts_has_the_moments_of_the_exact_sampler(missions):
    model = PooledTrust(effects=[PlaceEffect(), RobotEffect()])
    exact = tb.fit(missions[:4], model, draws=5000, whole=False)
    nuts = tb.fit(missions[:4], model, "nuts", draws=2000, whole=False)
    require_same_moments(nuts, exact, 0.1, 1.1)


def test_its_evidence_is_larger_than_that_of_places_alone(posterior, missions):
    places = tb.fit(missions, PooledTrust(place=PlaceEffect()), draws=50, whole=False)
    assert posterior.attrs["log_evidence"] - places.attrs["log_evidence"] > 10.0
    again = tb.fit(
        missions,
        PooledTrust(effects=[PlaceEffect(), RobotEffect()]),
        draws=50,
        earlier=places,
        whole=False,
    )
    assert abs(again.attrs["log_evidence"] - posterior.attrs["log_evidence"]) < 1.0


def test_likelihoods_are_those_of_each_robot_with_its_effect(posterior, missions):
    draws = posterior["posterior"].isel(chain=0, draw=7)
    beta0, b = float(draws["beta0"]), float(draws["b"])
    d = posterior["robots"]["robot_effect"].values[0, 7]
    places = tb.inference.params_of(posterior).draw(7)
    for j, mission in enumerate(missions):
        expected, effect = 0.0, places.of_places(tb.workspace.moves.bounds_along(mission.path))
        for i in range(3):
            z = np.column_stack([mission.awareness[:, i], effect[:, 0]])
            beta = np.append(draws["beta"].values, 1.0)
            beta[0] += (1.0 - beta0) * d[j, i]
            noises = float(draws["delta_w"]), float(draws["delta_v"])
            y = mission.contact_rate[:, i]
            expected += dense_log_likelihood(beta0, beta, b, *noises, 0.5, 0.5, z, y)
        found = posterior["log_likelihood"]["contact_rate"].values[0, 7, j]
        np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_plans_have_what_stays_of_each_robot_and_no_bad_day(posterior):
    params = tb.inference.params_of(posterior)
    sites = posterior["posterior"].to_dataset().stack(d=("chain", "draw")).transpose("d", ...)
    effect = posterior["robots"]["robot_effect"].values.reshape(-1, 8, 3)
    slow, day = (sites[f"tau_{name}"].values[:, None, None] for name in ("slow", "day"))
    gap = np.abs(np.subtract.outer(np.arange(9), np.arange(9)))
    K = slow**2 * 0.9**gap + day**2 * (gap == 0)
    gain = np.linalg.solve(K[:, :8, :8], K[:, :8, 8:])[..., 0]
    d = np.einsum("nm,nmi->ni", gain, effect)
    rest = 1.0 - sites["beta0"].values[:, None]
    np.testing.assert_allclose(
        params.beta[:, :, 0], sites["beta"].values[:, :1] + rest * d, rtol=1e-6, atol=1e-9
    )
    np.testing.assert_array_equal(params.beta[:, 2, 1], sites["beta"].values[:, 1])
    assert params.beta[:, 1, 0].mean() < params.beta[:, [0, 2], 0].mean() - 0.1
    assert params.place.shape == (400, 1, 5, 5)


def test_bands_have_the_day_to_come_with_its_variance(posterior):
    """Of the draws, and of them alone: the mean is that of plans, up to 4 standard errors."""
    plan, day = (tb.inference.params_of(posterior, day=day) for day in (False, True))
    sites = posterior["posterior"].to_dataset().stack(d=("chain", "draw"))
    slow, tau_day = sites["tau_slow"].values, sites["tau_day"].values
    gap = np.abs(np.subtract.outer(np.arange(9), np.arange(9)))
    K = slow[:, None, None] ** 2 * 0.9**gap + tau_day[:, None, None] ** 2 * (gap == 0)
    gain = np.linalg.solve(K[:, :8, :8], K[:, :8, 8:])[..., 0]
    sd = np.sqrt(K[:, 8, 8] - (gain * K[:, 8, :8]).sum(1)) * (1.0 - sites["beta0"].values)
    e = (day.beta - plan.beta)[:, :, 0] / sd[:, None]
    assert abs(e.mean()) < 4.0 / np.sqrt(e.size)
    assert abs((e**2).mean() - 1.0) < 4.0 * np.sqrt(2.0 / e.size)
    np.testing.assert_array_equal(day.beta[..., 1], plan.beta[..., 1])
    np.testing.assert_array_equal(day.place, plan.place)


def test_without_line_of_sight_a_robot_changes_the_intercept(missions):
    blind = [Mission.from_arrays(m.path, m.awareness, m.contact_rate) for m in missions]
    posterior = tb.fit(blind, PooledTrust(effects=[RobotEffect()]), draws=25, progress=False)
    params = tb.inference.params_of(posterior)
    assert (np.ptp(params.b, axis=1) > 0.0).all()
    assert not np.ptp(params.beta, axis=1).any()
    on = params_of_missions(posterior, blind, stack_missions(blind, pad=False))
    d = posterior["robots"]["robot_effect"].values.reshape(-1, 8, 1, 3)
    b, beta0 = (posterior["posterior"][n].values.reshape(-1, 1, 1, 1) for n in ("b", "beta0"))
    expected = np.broadcast_to(b + (1.0 - beta0) * d, on.b.shape)
    np.testing.assert_allclose(on.b, expected, rtol=1e-12)


def test_rates_one_by_one_and_missions_left_out_have_the_effects(posterior):
    rates = tb.inference.by_rate(posterior)["log_likelihood"]["contact_rate"]
    by_mission = rates.groupby("mission").sum()
    whole = posterior["log_likelihood"]["contact_rate"]
    np.testing.assert_allclose(by_mission.values, whole.values, rtol=1e-8)


@pytest.mark.parametrize("family", ["censored", "beta_binomial"])
def test_other_families_name_a_detector_that_breaks(missions, family):
    n = 50
    counted = [
        Mission.from_arrays(
            m.path, m.awareness, np.round(m.contact_rate * n) / n, features=FEATURES,
            n_ticks=np.full(m.contact_rate.shape, n),
        )
        for m in missions
    ]  # fmt: skip
    model = PooledTrust(effects=[PlaceEffect(), RobotEffect()], observation=family)
    posterior = tb.fit(counted, model, draws=100, progress=False)
    assert posterior.attrs["sampler"] == "exact"
    assert posterior.attrs["k_hat"] < 0.7
    effect = posterior["robots"]["robot_effect"].mean(("chain", "draw"))
    broken = effect.sel(robot="r2", mission=slice(BROKEN, None))
    assert (broken.max() < effect.sel(robot=["r1", "r3"]).min()).all()
    assert np.isfinite(posterior["log_likelihood"]["contact_rate"]).all()
    params = tb.inference.params_of(posterior)
    assert params.beta[:, 1, 0].mean() < params.beta[:, [0, 2], 0].mean()


def test_rates_within_the_limits_have_the_gaussian_effects_of_robots(missions):
    """Evidence by expectation propagation and its weights: .1 nat, as k-hat and Kish have it."""
    inside = [
        Mission.from_arrays(m.path, m.awareness, 0.1 + 0.8 * m.contact_rate, features=FEATURES)
        for m in missions
    ]
    effects = [PlaceEffect(), RobotEffect()]
    gaussian, censored = (
        tb.fit(inside, PooledTrust(effects=effects, observation=family), draws=100, whole=False)
        for family in ("gaussian", "censored")
    )
    gap = gaussian.attrs["log_evidence"] - censored.attrs["log_evidence"]
    assert abs(gap) < 0.3
    a, b = (tree["robots"]["robot_effect"].values.reshape(-1, 24) for tree in (gaussian, censored))
    assert np.abs((a.mean(0) - b.mean(0)) / a.std(0)).max() < 0.5


def test_a_campaign_learns_and_plans_with_robots(tmp_path):
    rng = np.random.default_rng(2)
    z = rng.uniform(size=(3, 5, 5, 2))
    workspace = tb.Workspace.from_awareness(z, features=FEATURES)
    truth = TrustParams(0.2, np.array([0.7, 0.0]), 0.05, 0.03, 0.03)
    simulator = tb.simulation.ModelSimulator(workspace, truth)
    model = PooledTrust(effects=[PlaceEffect(), RobotEffect()])
    options = {"simulator": simulator, "progress": False, "model": model}
    tb.iterate(workspace, (4, 0), (0, 4), n_iterations=2, seed=3, directory=tmp_path, **options)
    del options["model"]  # it is in the record
    result = tb.resume(tmp_path, n_iterations=3, **options)
    assert [tree["robots"].sizes["mission"] for tree in result.posteriors] == [1, 2, 3]
    live = tb.inference.TrustFilter(result.posterior)
    mission = result.missions[-1]
    now = live.update(mission.awareness[0], mission.contact_rate[0], bound=tuple(mission.path[:2]))
    assert now.mean.shape == (3,)


def test_place_is_a_short_form_of_an_effect():
    assert PooledTrust(effects=[PlaceEffect(tau_s=0.1)]) == PooledTrust(
        place=PlaceEffect(tau_s=0.1)
    )
    assert PooledTrust(effects=RobotEffect()).effects == (RobotEffect(),)


def test_a_record_has_the_effects():
    model = PooledTrust(effects=[PlaceEffect(), RobotEffect(tau_day=0.1)])
    again = model_from_record(model_to_record(model))
    assert again.effects == (RobotEffect(tau_day=0.1),)
    assert again.place == PlaceEffect()
    assert "effects" not in model_to_record(PooledTrust())


@pytest.mark.parametrize(
    ("effects", "told"),
    [
        ([PooledTrust], "PooledTrust"),
        ([RobotEffect(), RobotEffect()], "different kinds"),
        ([None], "None"),
    ],
)
def test_effects_of_no_kind_or_of_one_kind_twice_are_refused(effects, told):
    with pytest.raises(TrustboError, match=told):
        PooledTrust(effects=effects)


@pytest.mark.slow
@pytest.mark.parametrize("family", ["gaussian", "censored"])
def test_draws_are_calibrated(family):
    """200 data sets, rates and effects from the prior, p of 8 ranks; benchmarks has more rows."""
    model = PooledTrust(effects=[RobotEffect()], observation=family)
    result = tb.inference.sbc(model, n_datasets=200, shape=(4, 5, 2, 2), progress=False)
    assert {"tau_slow", "tau_day", "robot_effect[0]"} <= set(result["parameter"].values)
    assert float(result["p_value"].min()) > 0.01 / result.sizes["parameter"]


def test_what_has_no_effects_of_robots_refuses_them(missions):
    model = PooledTrust(effects=[RobotEffect()])
    censored = PooledTrust(effects=[RobotEffect()], observation="censored")
    with pytest.raises(TrustboError, match=r'"nuts" cannot treat.*observations are not Gaussian'):
        tb.fit(missions, censored, "nuts")
    with pytest.raises(TrustboError, match="effects of robots"):
        tb.inference.prior_predictive(model, np.zeros((1, 2, 3, 2)))
    with pytest.raises(TypeError, match="effects"):
        HierarchicalTrust(effects=[RobotEffect()])


def test_missions_left_out_by_hyperparameters_have_the_effects_of_robots(posterior):
    model = PooledTrust(effects=[PlaceEffect(), RobotEffect()]).for_features(FEATURES)
    left_out = by_hyperparameters(posterior, model)
    for j in (0, 7):  # the others keep their distances in missions, by which effects fade
        # Evidences of two samplers of some 300 points each: .1 nats.
        assert left_out[j].log_density == pytest.approx(
            by_refit(posterior, model, j).log_density, abs=0.4
        )
