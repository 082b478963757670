"""A drift of the user's own: its likelihood, its posterior, and where it is refused."""

import json
import warnings

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import xarray as xr
from references import dense_coupled
from worlds import random_cells

import trustbo as tb
from trustbo.errors import ShapeError, TrustboError
from trustbo.inference import (
    TrustFilter,
    diagnostics,
    fit,
    params_of,
    place_maps,
    prior_predictive,
    sbc,
)
from trustbo.inference.samplers import drift_scores
from trustbo.inference.updating import update_statistics
from trustbo.models import DriftTrust, PlaceEffect, PooledTrust
from trustbo.models.drift_form import find_drift
from trustbo.models.effects.effect import Slots
from trustbo.stacking import stack_missions
from trustbo.study.methods import model_of

NOISES = {"delta_w": 0.05, "delta_v": 0.05}


def linear(z, weight, level):
    return z @ weight + level


def saturating(z, top, slope, own):
    """Less for each robot alone than all see together: robots and features interact."""
    return top * (1.0 - jnp.exp(-slope * z[:, 0])) + own * z[:, 1] * z[:, 1].mean()


LINEAR = DriftTrust(
    linear, {"weight": (dist.Normal(0.0, 1.0), "feature"), "level": dist.Normal(0.0, 0.5)}
)
OWN = DriftTrust(
    saturating,
    {
        "top": dist.HalfNormal(1.0),
        "slope": dist.LogNormal(1.0, 0.7),
        "own": (dist.Normal(0.0, 0.3), "robot"),
    },
)
TRUTH = {"beta0": 0.4, "top": 0.5, "slope": 4.0, "own": [0.1, 0.0, -0.2], **NOISES}


def hierarchy(n_robots, n_features):
    """Robots whose weights come from a common distribution, not centred."""
    mean = numpyro.sample("mean", dist.Normal(0.5, 0.5))
    spread = numpyro.sample("spread", dist.HalfNormal(0.3))
    with numpyro.plate("robots", n_robots):
        off = numpyro.sample("off", dist.Normal(0.0, 1.0))
    return {"own": mean + spread * off, "level": numpyro.sample("level", dist.Normal(0.0, 0.5))}


ONE_LINE = r"^(?!.*\n)(?s:.)*cannot be compiled: .*traced array.*\. "
"""A message of one line, of a function that JAX cannot trace."""


def by_robot(z, own, level):
    return level + own * z[:, 1]


def simulated(model, values, n_missions=6, seed=0, n_bounds=7):
    rng = np.random.default_rng(seed)
    z = rng.uniform(size=(n_missions, n_bounds, 3, 2))
    rates = model.simulate(jax.random.key(seed), model.params(values, 2), z).contact_rate
    path = [(0, k) for k in range(n_bounds + 1)]
    return [
        tb.Mission.from_arrays(path, z[j], np.clip(rates[j], 0.0, 1.0)) for j in range(n_missions)
    ]


@pytest.fixture(scope="module")
def missions():
    return simulated(OWN, TRUTH)


@pytest.fixture(scope="module")
def posterior(missions):
    return fit(missions, OWN, seed=1)


# --- the likelihood ---


def test_a_linear_drift_is_the_pooled_model(missions):
    values = {"beta0": 0.6, "weight": [0.3, 0.2], "level": 0.05, **NOISES}
    pooled = tb.models.TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)
    own = LINEAR.log_likelihood(LINEAR.params(values, 2), missions)
    np.testing.assert_allclose(own, PooledTrust().log_likelihood(pooled, missions), rtol=1e-10)
    z, key = missions[0].awareness[None], jax.random.key(3)
    np.testing.assert_allclose(
        LINEAR.simulate(key, LINEAR.params(values, 2), z).contact_rate,
        PooledTrust().simulate(key, pooled, z).contact_rate,
        rtol=1e-12,
    )


def test_the_likelihood_is_the_dense_joint_normal(missions, posterior):
    params = OWN.params(TRUTH, 2)
    rates = [mission.contact_rate.copy() for mission in missions]
    rates[1][2, 0] = np.nan
    gaps = [
        tb.Mission.from_arrays(m.path, m.awareness, y) for m, y in zip(missions, rates, strict=True)
    ]
    own, eye = np.array(TRUTH["own"]), np.eye(3)
    expected = []
    for mission, y in zip(missions, rates, strict=True):
        z = mission.awareness
        u = 0.5 * (1.0 - np.exp(-4.0 * z[..., 0])) + own * z[..., 1] * z[..., 1:].mean(1)
        known = 0.4 * eye, u, 0.05**2 * eye, 0.05**2 * eye, 0.5, 0.5
        expected.append(dense_coupled(*known, y)[0])
    np.testing.assert_allclose(OWN.log_likelihood(params, gaps), expected, rtol=1e-10)


def test_the_density_of_scores_is_the_likelihood_at_their_parameters(missions):
    """Of changes of trust, too; JAX's scan against the evidence, all but the priors of scores."""
    rng, batch = np.random.default_rng(2), stack_missions(missions)
    slots = Slots.of(batch, len(missions))
    for response in ("level", "change"):
        model = DriftTrust(saturating, OWN.parameters, response=response)
        target = drift_scores.DriftPosterior.of(model, batch, slots)
        z = 0.5 * rng.standard_normal((3, target.n_scores))
        params = model.params(target.scores.named(z), 2)
        found = target.log_density(z) - target.scores.log_prior(z)
        expected = model.log_likelihood(params, missions).sum(1)
        np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_trust_and_likelihood_of_a_posterior_are_those_of_its_draws(missions, posterior):
    """NumPy's recursions, of the drift as an intercept of each bound, against JAX's."""
    params = params_of(posterior)
    some = params.draw(slice(0, 5))
    expected = OWN.log_likelihood(some, missions)
    found = posterior["log_likelihood"]["contact_rate"].values[0, :5]
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    live = TrustFilter(posterior, max_draws=3)
    for z, y in zip(missions[0].awareness, missions[0].contact_rate, strict=True):
        live.update(z, y)
    log_weight = OWN.log_likelihood(live.params, [missions[0]])[:, 0]
    weight = np.exp(log_weight - log_weight.max())
    np.testing.assert_allclose(live.weights, weight / weight.sum(), rtol=1e-8)


# --- the posterior ---


def test_a_linear_drift_has_the_pooled_posterior(missions):
    """Means within 4 of the larger standard errors, of some 1000 effective draws."""
    own, exact = fit(missions, LINEAR, seed=3), fit(missions, PooledTrust(), seed=3)
    assert own.attrs["sampler"] == exact.attrs["sampler"] == "exact"
    assert own.attrs["k_hat"] < 0.5
    assert own.attrs["kish"] > 500
    np.testing.assert_allclose(own.attrs["log_evidence"], exact.attrs["log_evidence"], atol=0.15)
    for name, as_pooled in {"weight": "beta", "level": "b"}.items() | {
        (name, name) for name in ("beta0", "delta_w", "delta_v")
    }:
        a, b = own["posterior"][name], exact["posterior"][as_pooled]
        sd = b.std(("chain", "draw"))
        gap = np.abs(a.mean(("chain", "draw")) - b.mean(("chain", "draw"))) / sd
        assert (gap < 4.0 / np.sqrt(own.attrs["kish"]) + 4.0 / np.sqrt(2000.0)).all(), name
        assert (np.abs(np.log(a.std(("chain", "draw")) / sd)) < 0.15).all(), name


def test_a_posterior_is_around_its_truth_and_read_by_arviz(posterior, missions):
    assert diagnostics(posterior)["k_hat"] <= 0.7
    draws = posterior["posterior"].to_dataset()
    assert draws["own"].dims == ("chain", "draw", "robot")
    for name, value in TRUTH.items():
        off = (draws[name].mean(("chain", "draw")) - value) / draws[name].std(("chain", "draw"))
        assert (np.abs(off) < 3.5).all(), name
    assert set(posterior["log_prior"].data_vars) == {*TRUTH}
    density = dist.Normal(0.0, 0.3).log_prob(draws["own"].values).sum(-1)
    np.testing.assert_allclose(posterior["log_prior"]["own"], density, rtol=1e-5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # 6 missions
        table = az.compare({"own": posterior, "default": fit(missions, PooledTrust())})
    assert table.index[0] == "own"


@pytest.mark.slow  # its programs compile for this alone
def test_with_places_a_linear_drift_has_the_pooled_posterior_too(missions):
    """A drift that is no column against weights that are; tolerances as above."""
    own = fit(missions[:2], DriftTrust(linear, LINEAR.parameters, place=PlaceEffect()), seed=3)
    exact = fit(missions[:2], PooledTrust(place=PlaceEffect()), seed=3)
    assert own.attrs["sampler"] == "exact"
    assert own.attrs["k_hat"] < 0.7
    np.testing.assert_allclose(own.attrs["log_evidence"], exact.attrs["log_evidence"], atol=0.3)
    for name in ("beta0", "delta_v", "tau_s", "length_scale", "tau_e"):
        a, b = own["posterior"][name], exact["posterior"][name]
        gap = abs(float(a.mean() - b.mean())) / float(b.std())
        assert gap < 4.0 / np.sqrt(own.attrs["kish"]) + 4.0 / np.sqrt(exact.attrs["kish"]), name
    one, other = (place_maps(each) for each in (own, exact))
    sd = other["place_bound_sd"].max()
    assert (np.abs(one["place_bound_mean"] - other["place_bound_mean"]) < 0.3 * sd).sum() == (
        other["place_bound_mean"].notnull().sum()
    )


def test_the_next_mission_compiles_nothing(missions, posterior):
    before = drift_scores._compiled_drifts._cache_size()
    fit(missions[:5], OWN, seed=2, whole=False)
    other = {**OWN.parameters, "top": dist.HalfNormal(2.0)}  # numbers of priors are data
    fit(missions, DriftTrust(saturating, other), seed=2, whole=False)
    assert drift_scores._compiled_drifts._cache_size() == before


def test_statements_of_numpyro_make_a_hierarchy(missions):
    model = DriftTrust(by_robot, hierarchy)
    assert model.dims["own"] == model.dims["off"] == ("robot",)
    drawn = prior_predictive(model, np.full((1, 2, 3, 2), 0.5), n_draws=400)["prior"]
    by_hand = drawn["mean"] + drawn["spread"] * drawn["off"]
    np.testing.assert_allclose(drawn["own"], by_hand.transpose(*drawn["own"].dims), rtol=1e-12)
    assert abs(float(drawn["mean"].mean()) - 0.5) < 4 * 0.5 / np.sqrt(400)  # 4 standard errors
    posterior = fit(missions, model, seed=1, whole=False)
    assert posterior.attrs["sampler"] == "exact"
    assert posterior["posterior"]["own"].dims == ("chain", "draw", "robot")


@pytest.mark.slow  # compiles NUTS
def test_nuts_finds_the_same_posterior(missions, posterior):
    nuts = fit(missions, OWN, "nuts", seed=1, whole=False)
    for name in TRUTH:
        a, b = nuts["posterior"][name], posterior["posterior"][name]
        gap = np.abs(a.mean(("chain", "draw")) - b.mean(("chain", "draw"))) / b.std()
        assert (gap < 0.2).all(), name  # some 4 standard errors of 1000 effective draws, twice


@pytest.mark.slow
def test_ranks_of_the_truth_are_uniform():
    result = sbc(OWN, "exact", n_datasets=100, shape=(3, 6, 2, 2), progress=False)
    assert (result["p_value"] > 0.01 / result.sizes["parameter"]).all(), result["p_value"].values


# --- campaigns ---


@pytest.mark.slow  # its programs compile for this alone
def test_a_campaign_that_was_killed_comes_to_the_same(tmp_path, monkeypatch):
    workspace = random_cells()
    simulator = tb.simulation.ModelSimulator(workspace, OWN.params(TRUTH, 2), OWN)
    assert json.dumps(simulator.describe())
    truth = tb.simulation.Truth.of(simulator)
    case = {"model": OWN, "simulator": simulator, "truth": truth, "progress": False}
    whole = tb.iterate(workspace, (3, 0), (0, 3), n_iterations=3, policy="thompson", **case)
    assert np.isfinite(whole.history["regret"]).all()
    folder = tmp_path / "killed"

    def die(*args, **kwargs):
        raise KeyboardInterrupt

    tb.iterate(
        workspace, (3, 0), (0, 3), n_iterations=1, policy="thompson", checkpoint=folder, **case
    )
    with monkeypatch.context() as patch:
        patch.setattr("trustbo.campaign.learning.fit", die)
        with pytest.raises(KeyboardInterrupt):
            tb.resume(folder, n_iterations=3, **case)
    with pytest.raises(TrustboError, match="is your own; give it again with model="):
        tb.resume(folder, n_iterations=3, **{**case, "model": None})
    again = tb.resume(folder, n_iterations=3, **case)
    assert again.path == whole.path
    for name in whole.posterior["posterior"].data_vars:
        np.testing.assert_array_equal(
            again.posterior["posterior"][name].values, whole.posterior["posterior"][name].values
        )
    kept = tb.load_result(folder)
    np.testing.assert_allclose(kept.trust_map.values, whole.trust_map.values, rtol=1e-12)
    with pytest.raises(TrustboError, match="the campaign's model is"):
        tb.Campaign.load(folder, model=DriftTrust(saturating, {**OWN.parameters, "top": SMALL}))


SMALL = dist.HalfNormal(0.1)


@pytest.mark.parametrize("policy", ["greedy", "ucb"])
def test_policies_plan_with_it(policy, posterior):
    workspace = random_cells()
    planner = tb.planning.Planner(workspace, (3, 0), (0, 3))
    plan = tb.planning.POLICIES[policy](jax.random.key(0), params_of(posterior), planner)
    assert plan.path[-1] == (0, 3)


def test_places_are_added_to_it_in_every_room():
    """A linear drift with effects of places equals the pooled model with them."""
    rng, workspace = np.random.default_rng(3), random_cells()
    n = 4
    maps = {
        "place": rng.normal(0.0, 0.3, (n, 1, 4, 4)),
        "place_bound": rng.normal(0.0, 0.3, (n, 3, 8, 4, 4)),
    }
    beta0, weight, level = rng.uniform(0.2, 0.7, n), rng.normal(size=(n, 2)), rng.normal(size=n)
    noises = {name: np.full(n, 0.05) for name in NOISES}
    pooled = tb.models.TrustParams(beta0, weight, level, **noises, **maps)
    own = LINEAR.params({"beta0": beta0, "weight": weight, "level": level, **noises}, 2)
    own = own._replace(**maps)
    planner = tb.planning.Planner(workspace, (3, 0), (0, 3))
    path = [(3, 0), (2, 1), (1, 2), (0, 3)]
    z = np.swapaxes(workspace.along(path), 0, 1)
    mission = tb.Mission.from_arrays(path, z, rng.uniform(size=(3, 3)))
    by_hand = PooledTrust().log_likelihood(pooled, [mission])
    np.testing.assert_allclose(LINEAR.log_likelihood(own, [mission]), by_hand, rtol=1e-10)
    for i in range(n):
        one, other = planner.plan(own.draw(i)), planner.plan(pooled.draw(i))
        assert one.path == other.path
        np.testing.assert_allclose(one.trust, other.trust, rtol=1e-10)
    found, expected = (planner.evaluate(path, p) for p in (own, pooled))
    np.testing.assert_allclose(found.value, expected.value, rtol=1e-10)
    np.testing.assert_allclose(found.bands, expected.bands, rtol=1e-10)
    live = [
        TrustFilter(p, 3).update(z[0], [0.5, 0.4, np.nan], (path[0], path[1]))
        for p in (own, pooled)
    ]
    np.testing.assert_allclose(live[0].mean, live[1].mean, rtol=1e-10)


# --- functions and files ---


def test_a_posterior_from_a_file_finds_its_function_or_says_that_it_is_gone(posterior, tmp_path):
    file = tmp_path / "posterior.nc"
    posterior.to_netcdf(file)
    read = xr.open_datatree(file)
    np.testing.assert_array_equal(params_of(read).drift.theta["own"].shape, (4000, 3))

    def of(factor):
        def drift(z, top):
            return factor * top * z[:, 0]

        return DriftTrust(drift, {"top": dist.Normal(0.0, 1.0)})

    one, two = of(1.0), of(2.0)  # of one name
    assert one.form.name == two.form.name
    for model in (one, two):
        about = {"drift": model.form.name, **model.marks((3, 2))}
        assert find_drift(about, {"top": np.zeros(5)}).form == model.form
    gone = {**one.marks((3, 2)), "drift": one.form.name, "drift_mark": [9.0, 9.0, 9.0]}
    with pytest.raises(TrustboError, match="gives other values by now: first make its DriftTrust"):
        find_drift(gone, {"top": np.zeros(5)})
    with pytest.raises(TrustboError, match="nowhere:drift of the posterior is not known here"):
        find_drift({**gone, "drift": "nowhere:drift"}, {"top": np.zeros(5)})


def test_a_study_imports_a_model_of_its_own():
    study = tb.study.Study(terrains=["random_workspace"], models={"mine": {"kind": HERE}})
    assert model_of(study.models["mine"]) is OWN
    with pytest.raises(TrustboError, match="'nowhere:OWN' cannot be imported: No module named"):
        tb.study.Study(terrains=["random_workspace"], models={"mine": {"kind": "nowhere:OWN"}})


HERE = f"{__name__}:OWN"


# --- what is refused ---

TOP = {"top": dist.HalfNormal(1.0)}
ROBOT = dist.Normal(0.0, 1.0).expand([3])


@pytest.mark.parametrize(
    ("drift", "parameters", "message"),
    [
        (3.0, TOP, r"drift must be a function drift\(z, ...\); got 3.0"),
        (lambda z, top, slope: z[:, 0], TOP, "takes 'slope', which is no parameter; there are top"),
        (lambda z: z[:, 0], TOP, "parameter 'top' is none of the drift .* which takes none"),
        (lambda z, delta_w: z[:, 0], {"delta_w": TOP["top"]}, "parameter 'delta_w' is the model's"),
        (lambda z, top: z[:, 0], {"top": 0.5}, "top must be a scalar numpyro distribution"),
        (lambda z, top: z[:, 0], {"top": ROBOT}, "top must be a scalar numpyro distribution"),
        (lambda z, top: z[:, 0], {"top": (TOP["top"], "cell")}, 'and "robot" or "feature"; got'),
        (lambda z, top: z[:, 0], lambda n_robots: TOP, r"must take \(n_robots, n_features\)"),
        (lambda z, top: z[:, 0], lambda r, f: 1.0, "must return them by name"),
        (
            lambda z, top: z[:, 0],
            lambda r, f: {"top": jnp.zeros(4)},
            r"top must be \(\), \(robot,\), .* for 5 robots and 7 features it is \(4,\)",
        ),
    ],
)
def test_a_model_that_is_none_is_refused_when_it_is_made(drift, parameters, message):
    with pytest.raises(TrustboError, match=message):
        DriftTrust(drift, parameters)


@pytest.mark.parametrize(
    ("drift", "error", "message"),
    [
        (lambda z, top: top, ShapeError, r"one number for each robot, shape \(3,\), .* gives \(\)"),
        (lambda z, top: top * z, ShapeError, r"it gives \(3, 2\)"),
        (lambda z, top: top * z[:, 2], TrustboError, "fails for awareness .* IndexError: index 2"),
        (lambda z, top: top * jnp.log(z[:, 0]), TrustboError, r"is -inf at awareness \[0.0, 0.0\]"),
        (lambda z, top: jnp.sqrt(-top - z[:, 0]), TrustboError, "is nan at awareness .* top = "),
        (lambda z, top: np.log1p(top * z[:, 0]), TrustboError, ONE_LINE + "Use jax.numpy in place"),
        (
            lambda z, top: z[:, 0] if top > 0 else 0 * z[:, 0],
            TrustboError,
            ONE_LINE + ".*jnp.where",
        ),
        (lambda z, top: nothing + top, TrustboError, "NameError: name 'nothing'"),  # noqa: F821
    ],
)
def test_a_drift_that_is_none_is_refused_before_work_starts(drift, error, message, missions):
    model = DriftTrust(drift, TOP)
    with pytest.raises(error, match=message):
        fit(missions, model)
    with pytest.raises(error, match=message):
        tb.Campaign(random_cells(), (3, 0), (0, 3), model=model)


def test_what_a_sampler_or_a_function_cannot_treat_says_so(missions, posterior):
    counts = DriftTrust(saturating, OWN.parameters, observation="censored")
    with pytest.raises(TrustboError, match=r'"exact" cannot treat .* not Gaussian'):
        fit(missions, counts, "exact")
    with pytest.raises(TrustboError, match="no sufficient statistics: its drift is a function of"):
        update_statistics(OWN, None, missions)
    with pytest.raises(TrustboError, match=r"parameter 'own' is missing; .* needs beta0, top"):
        OWN.params({name: TRUTH[name] for name in TRUTH if name != "own"}, 2)
    params = params_of(posterior)
    with pytest.raises(ShapeError, match=r"is of 2 features, but awareness has 1"):
        OWN.simulate(jax.random.key(0), params.draw(0), np.ones((1, 2, 3, 1)))
    with pytest.raises(ShapeError, match=r"own of the drift .* is of 3 robots, but .* have 2"):
        OWN.simulate(jax.random.key(0), params.draw(0), np.ones((1, 2, 2, 2)))
