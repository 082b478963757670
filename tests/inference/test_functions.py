"""Models that are NumPyro functions: what they compute, how they are fitted, what is refused."""

import functools
import subprocess
import sys

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import xarray as xr
from numpyro import handlers
from numpyro.handlers import reparam
from numpyro.infer.reparam import LocScaleReparam
from numpyro.infer.util import constrain_fn, log_density, potential_energy
from scipy import stats
from scipy.linalg import block_diag

import trustbo as tb
from trustbo.errors import PosteriorError, TrustboError
from trustbo.inference import params_of
from trustbo.inference.functions.data import data_of
from trustbo.inference.functions.known import as_model, model_of_record
from trustbo.inference.functions.sampling import _judge as judge
from trustbo.inference.functions.target import targets_of
from trustbo.inference.nuts import Samples
from trustbo.inference.tree import parameters_alone
from trustbo.models import ContactRate, PooledTrust, TrustParams
from trustbo.models.backend import own_settings
from trustbo.models.observations import Observations

FEATURES = ("traversability", "line_of_sight")
N_DRAWS = 500
"""Draws per chain of most fits, as a function is compiled for each number of draws."""


def linear(awareness, contact_rate=None):
    """Drift that is linear in the features, with known noises."""
    n_features = awareness.shape[-1]
    weight = numpyro.sample("weight", dist.Normal(0.0, 0.5).expand([n_features]).to_event(1))
    level = numpyro.sample("level", dist.Normal(0.0, 0.3))
    drift = awareness @ weight + level
    with numpyro.plate("mission", len(awareness)):
        rates = ContactRate(drift, 0.4, 0.05, 0.05)
        numpyro.sample("contact_rate", rates, obs=contact_rate)


@pytest.fixture(scope="module")
def workspace():
    awareness = np.random.default_rng(0).uniform(size=(3, 5, 5, 2))
    return tb.Workspace.from_awareness(awareness, features=FEATURES)


@pytest.fixture(scope="module")
def missions(workspace):
    """Missions along different paths, with a rate that was not measured."""
    truth = TrustParams(0.4, np.array([0.2, 0.3]), 0.05, 0.05, 0.05)
    simulator = tb.simulation.ModelSimulator(workspace, truth)
    paths = (
        ((4, 0), (3, 1), (2, 2), (1, 3), (0, 4)),
        ((4, 0), (3, 0), (2, 0), (1, 1), (0, 2), (0, 3), (0, 4)),
        ((4, 0), (4, 1), (4, 2), (3, 3), (2, 4), (1, 4), (0, 4)),
    )
    run = [simulator.run(path, seed=n) for n, path in enumerate(paths)]
    rates = run[1].contact_rate.copy()
    rates[2, 1] = np.nan
    run[1] = tb.Mission.from_arrays(
        run[1].path, run[1].awareness, rates, features=FEATURES, robots=run[1].robots
    )
    return run


@pytest.fixture(scope="module")
def posterior(missions, workspace):
    return tb.fit(missions, linear, workspace=workspace, draws=N_DRAWS, progress=False)


@pytest.fixture(scope="module")
def of_one_robot():
    """A posterior of `linear` for one robot and one feature."""
    mission = tb.Mission.from_arrays(
        [(4, k) for k in range(5)],
        np.full((4, 1, 1), 0.5),
        np.full((4, 1), 0.7),
        features=("traversability",),
    )
    return tb.fit([mission], linear, draws=50, latent=False, check=False, progress=False)


@pytest.fixture(scope="module")
def with_days(missions, workspace):
    """A posterior of `by_mission`."""
    return tb.fit(
        missions, by_mission, workspace=workspace, draws=N_DRAWS, check=False, progress=False
    )


SCALES_OF_PRIOR = np.array([0.5, 0.5, 0.3])
"""Prior standard deviations of the weights and the level of `linear`."""


def regressions(missions):
    """Design, rates and covariance of each robot in each mission, given the weights of `linear`."""
    beta0, delta_w, delta_v, x0_mean, x0_sd = 0.4, 0.05, 0.05, 0.5, 0.5
    for mission in missions:
        n = len(mission.bounds)
        response = np.array([[beta0 ** (k - j) if j <= k else 0.0 for j in range(n)]
                             for k in range(n)])  # fmt: skip
        start = beta0 ** np.arange(1, n + 1)
        cov = delta_w**2 * response @ response.T + x0_sd**2 * np.outer(start, start)
        cov += delta_v**2 * np.eye(n)
        for i in range(mission.contact_rate.shape[1]):
            design = response @ np.column_stack([mission.awareness[:, i], np.ones(n)])
            y = mission.contact_rate[:, i] - start * x0_mean
            seen = ~np.isnan(y)
            yield design[seen], y[seen], cov[np.ix_(seen, seen)]


def exact_posterior(missions):
    """Mean and covariance of (weight, level) from the dense normal of all rates of `linear`."""
    precision = np.diag(1.0 / SCALES_OF_PRIOR**2)
    shift = np.zeros(3)
    for design, y, cov in regressions(missions):
        inverse = np.linalg.inv(cov)
        precision += design.T @ inverse @ design
        shift += design.T @ inverse @ y
    cov = np.linalg.inv(precision)
    return cov @ shift, cov


def log_evidence(missions):
    """Log-density of all rates of `linear`, whose weights are integrated out."""
    designs, rates, covs = zip(*regressions(missions), strict=True)
    design = np.concatenate(designs) * SCALES_OF_PRIOR
    cov = block_diag(*covs) + design @ design.T
    return stats.multivariate_normal(cov=cov).logpdf(np.concatenate(rates))


def test_the_posterior_is_that_of_a_linear_regression(posterior, missions):
    mean, cov = exact_posterior(missions)
    draws = posterior["posterior"].to_dataset()
    found = np.column_stack([draws["weight"].values.reshape(-1, 2), draws["level"].values.ravel()])

    error = 5.0 * np.sqrt(np.diag(cov) / 400.0)  # at least 400 effective draws
    np.testing.assert_array_less(np.abs(found.mean(0) - mean), error)
    np.testing.assert_allclose(np.cov(found.T), cov, atol=0.3 * cov.max())


def test_a_posterior_has_the_groups_of_a_model_class(posterior, missions):
    ours = tb.fit(missions, PooledTrust(), draws=50, progress=False)
    assert set(posterior.children) == set(ours.children)
    for group in ("latent", "log_likelihood", "posterior_predictive", "observed_data"):
        assert set(posterior[group].data_vars) == set(ours[group].data_vars)
        assert posterior[group].to_dataset().sizes.keys() == ours[group].to_dataset().sizes.keys()


def test_rates_are_predicted_from_the_draws_of_the_prior(posterior, missions):
    z = np.nanmean([mission.awareness.mean((0, 1)) for mission in missions], axis=0)
    predicted = posterior["prior_predictive"]["contact_rate"].mean(("mission", "bound", "robot"))
    prior = posterior["prior"].to_dataset().sel(draw=predicted["draw"])
    drift = prior["level"].values + prior["weight"].values @ z
    assert stats.spearmanr(drift.ravel(), predicted.values.ravel()).statistic > 0.8


def test_log_likelihoods_are_those_of_numpyro(posterior, missions):
    z = np.concatenate([mission.awareness for mission in missions[:1]])[None]
    y = missions[0].contact_rate[None]
    one = posterior["posterior"].isel(chain=0, draw=17)
    given = {name: jnp.asarray(one[name].values) for name in ("weight", "level")}
    with jax.enable_x64(True):
        total, _ = log_density(linear, (jnp.asarray(z), jnp.asarray(y)), {}, given)
    prior = stats.norm(0.0, 0.5).logpdf(one["weight"]).sum()
    prior += stats.norm(0.0, 0.3).logpdf(one["level"])
    found = posterior["log_likelihood"]["contact_rate"].isel(chain=0, draw=17, mission=0)
    np.testing.assert_allclose(found, float(total) - prior, rtol=1e-6)


def test_latent_trust_follows_the_rates(posterior, missions):
    """Where noise is small, trust is close to the measured rate."""
    for j, mission in enumerate(missions):
        rates = mission.contact_rate
        trust = posterior["latent"]["trust_mean"].values[j, : len(rates)]
        assert np.nanmax(np.abs(trust - rates)) < 0.2


def test_plans_start_from_the_trust_of_each_robot(workspace):
    start, beta0 = np.array([1.0, 0.5, 0.0]), np.array([0.95, 0.5, 0.1])

    def model(awareness, contact_rate=None):
        w = numpyro.sample("w", dist.Normal(0.1, 1e-6))
        with numpyro.plate("mission", len(awareness)):
            rates = ContactRate(w * awareness[..., 0], jnp.asarray(beta0), 0.01, 0.01, start, 0.01)
            numpyro.sample("contact_rate", rates, obs=contact_rate)

    plan = tb.Campaign(workspace, (4, 0), (0, 4), model=model, progress=False).ask()
    trust = start
    for k, z in enumerate(np.asarray(workspace.along(plan.path))):
        trust = beta0 * trust + 0.1 * z[:, 0]
        np.testing.assert_allclose(plan.trust[k], trust, atol=1e-5)


def test_draws_plan_like_the_parameters_of_a_model_class(posterior, workspace):
    """The drift of `linear` is that of `TrustParams` with the same weights."""
    n = 1000  # of more draws, the drift is averaged over some
    draws = params_of(posterior, workspace).draw(np.arange(n))
    values = posterior["posterior"].to_dataset()
    params = TrustParams(
        np.full(n, 0.4), values["weight"].values.reshape(-1, 2)[:n],
        values["level"].values.ravel()[:n], np.full(n, 0.05), np.full(n, 0.05),
    )  # fmt: skip
    for objective in tb.planning.OBJECTIVES:
        planner = tb.Planner(workspace, (4, 0), (0, 4), objective)
        plan, wanted = planner.plan(draws), planner.plan(params)
        assert plan.path == wanted.path
        np.testing.assert_allclose(plan.trust, wanted.trust, rtol=1e-9)
        np.testing.assert_allclose(plan.bands, wanted.bands, rtol=1e-9)
        np.testing.assert_allclose(plan.value, wanted.value, rtol=1e-9)

    trust, expected = planner.trust_map(draws.draw([3, 5])), planner.trust_map(params.draw([3, 5]))
    np.testing.assert_allclose(trust, expected, rtol=1e-9)
    simulators = [
        tb.simulation.ModelSimulator(workspace, given.draw(7)) for given in (draws, params)
    ]
    rates = [one.run(plan.path, seed=3).contact_rate for one in simulators]
    np.testing.assert_allclose(*rates, rtol=1e-9)
    filters = [tb.inference.TrustFilter(given, 3) for given in (draws, params)]
    for k, y in enumerate(rates[0]):
        z = workspace.along(plan.path)[k]
        states = [one.update(z, y, plan.path[k : k + 2]) for one in filters]
        np.testing.assert_allclose(*states, rtol=1e-9)


def test_a_posterior_is_continued_from_the_last_one(posterior, missions, workspace):
    again = tb.fit(
        missions, linear, workspace=workspace, draws=N_DRAWS, start=posterior, progress=False
    )
    mean, cov = exact_posterior(missions)
    error = 5.0 * np.sqrt(cov[2, 2] / 400.0)
    assert abs(float(again["posterior"]["level"].mean()) - mean[2]) < error


def test_three_missions_are_left_out_by_refits_as_joint_normals_say(posterior, missions):
    result = tb.inference.loo(posterior)
    assert result.elpd_i["refitted"].values.all()

    whole = log_evidence(missions)
    expected = [whole - log_evidence(missions[:j] + missions[j + 1 :]) for j in range(3)]
    np.testing.assert_allclose(result.elpd_i, expected, atol=0.2)


def test_a_posterior_in_a_file_needs_its_function_in_another_process(
    posterior, elsewhere, tmp_path
):
    file = tmp_path / "posterior.nc"
    posterior.to_netcdf(file)
    code = f"""
import trustbo as tb, xarray as xr
tree = xr.open_datatree({str(file)!r})
try:
    tb.inference.params_of(tree)
except tb.TrustboError as error:
    print(error)
"""
    assert "give it with model=" in elsewhere(code)

    tree = xr.open_datatree(file).load()
    draws = params_of(tree, model=linear)
    np.testing.assert_array_equal(
        draws.values["level"], posterior["posterior"]["level"].values.ravel()
    )
    with pytest.raises(tb.TrustboError, match="not of 'other'"):
        params_of(tree, model=functools.update_wrapper(functools.partial(shaped), other))


@pytest.mark.parametrize(
    ("stored", "given", "message"),
    [
        ({"n": 2}, {"n": 1}, "'shaped'.* not of 'shaped'.* constant n differs"),
        ({"n": 2}, {}, "use of functools.partial differs"),  # n is 2 by default
        ({}, {}, ""),
    ],
)
def test_a_constant_that_differs_is_named(stored, given, message):
    """A constant is an argument of a partial function here."""
    record = as_model(functools.partial(shaped, **stored)).record()
    model = functools.partial(shaped, **given)
    if stored == given:
        assert model_of_record(record, model).record() == record
        return
    with pytest.raises(tb.TrustboError, match=message):
        model_of_record(record, model)


def other(awareness, contact_rate=None):
    """Another function."""


def shaped(awareness, contact_rate=None, n=2):
    a = numpyro.sample("a", dist.Normal())
    rates = ContactRate(a + awareness[..., :n, 0], 0.5, 0.1, 0.1)
    numpyro.sample("contact_rate", rates, obs=contact_rate)


def by_mission(awareness, contact_rate=None):
    """Variables of any name, one of which a latent variable has too."""
    level = numpyro.sample("level/of", dist.Normal(0.2, 0.1))
    with numpyro.plate("mission", len(awareness)):
        off = numpyro.sample("trust", dist.Normal(0.0, 0.05))
        rates = ContactRate(level + off[:, None, None] + 0.0 * awareness[..., 0], 0.4, 0.05, 0.05)
        numpyro.sample("contact_rate", rates, obs=contact_rate)


def test_a_function_of_one_robot_and_one_feature_is_read_from_a_file(of_one_robot, tmp_path):
    awareness = np.random.default_rng(0).uniform(size=(1, 5, 5, 1))
    workspace = tb.Workspace.from_awareness(awareness, features=("traversability",))
    file = tmp_path / "posterior.nc"
    of_one_robot.to_netcdf(file)
    with xr.open_datatree(file) as read:
        draws = params_of(read.load(), workspace)
    assert (draws.robots, draws.features) == (("r1",), ("traversability",))


def test_missions_in_another_order_are_put_in_that_of_the_posterior(posterior, missions):
    """A function reads robots and features by position, so another order is another drift."""
    turned = [one.in_order(one.robots[::-1], one.features[::-1], ()) for one in missions]
    alone = parameters_alone(posterior)
    later = tb.inference.add_latent(alone, turned)["log_likelihood"].to_dataset()
    np.testing.assert_array_equal(
        later["contact_rate"], posterior["log_likelihood"].to_dataset()["contact_rate"]
    )
    for tree in (posterior, alone):
        with pytest.raises(TrustboError, match="robots"):
            tb.inference.score(tree, turned)


def test_a_start_with_other_variables_is_ignored(posterior, of_one_robot, missions):
    """There is one weight less."""
    started = tb.fit(
        missions, linear, start=of_one_robot, draws=N_DRAWS, latent=False, progress=False
    )
    xr.testing.assert_identical(
        started["posterior"].to_dataset(), posterior["posterior"].to_dataset()
    )


def test_variables_of_one_mission_are_drawn_for_the_next(with_days, workspace):
    assert with_days["posterior"]["trust"].dims == ("chain", "draw", "mission")
    assert with_days["posterior"].sizes["mission"] == 3

    draws = params_of(with_days, workspace)
    u = draws.inputs(workspace.awareness.values)
    known = ~np.isnan(u[0])
    assert np.ptp(u[:, known], axis=1).max() < 1e-12  # equal in all bounds of a mission
    off = u[:, known][:, 0] - with_days["posterior"]["level.of"].values.ravel()
    np.testing.assert_allclose(off.std(), 0.05, rtol=0.1)


def recorded(awareness, features, contact_rate=None):
    """A function that records what it computes."""
    with numpyro.plate("robot", awareness.shape[2]):
        weight = numpyro.sample("weight", dist.Normal(0.3, 0.1))
        numpyro.deterministic("double", 2.0 * weight)
    with numpyro.plate("feature", 5):
        lam = numpyro.sample("lam", dist.Normal(0.0, 0.1))
        numpyro.deterministic("cube", lam**3)
    plate = numpyro.plate("mission", len(awareness))
    with plate:
        z = numpyro.sample("z", dist.Normal())
    day = numpyro.deterministic("day", 0.05 * z)
    drift = weight * awareness[..., features.index("line_of_sight")] + day[:, None, None]
    numpyro.deterministic("drift", drift)
    with plate:
        rates = ContactRate(drift, 0.4, 2.0, 2.0)  # the posterior is near the prior
        numpyro.sample("contact_rate", rates, obs=contact_rate)


def test_deterministic_sites_are_stored_with_the_axes_of_their_plates(missions, workspace):
    model = reparam(recorded, config={"weight": LocScaleReparam(0.0)})
    options = {"draws": 100, "check": False, "latent": False, "progress": False}
    fitted = tb.fit(missions, model, workspace=workspace, **options)
    for group, sizes in (("posterior", (1, 400)), ("prior", (1, 500))):
        found = fitted[group].to_dataset()
        assert {n: found[n].dims[2:] for n in ("weight", "double", "cube", "lam", "day")} == {
            "weight": ("robot",),  # moved there by the reparametrisation
            "double": ("robot",),
            "cube": ("feature_plate",),  # there are two features
            "lam": ("feature_plate",),
            "day": ("mission",),
        }
        assert "drift" not in found  # has the axis of bounds
        assert found["day"].shape == (*sizes, 3)  # without padding
        np.testing.assert_allclose(found["double"], 2.0 * found["weight"], rtol=1e-12)
        np.testing.assert_allclose(found["cube"], found["lam"] ** 3, rtol=1e-12)
        np.testing.assert_allclose(found["day"], 0.05 * found["z"], rtol=1e-12)
    assert list(fitted["posterior"]["double"]["robot"].values) == ["r1", "r2", "r3"]


def labelled(awareness, contact_rate=None):
    """A function whose axes have names in several ways; there are three robots and two features."""
    n_robots, n_features = awareness.shape[2:]
    unit = dist.Normal(0.0, 0.1)
    weight = numpyro.sample(
        "weight", unit.expand([n_features]).to_event(1), infer={"event_dims": ["feature"]}
    )
    mixing = numpyro.sample(
        "mixing",
        unit.expand([n_robots, n_robots]).to_event(2),
        infer={"event_dims": ["robot", "robot"]},
    )
    with handlers.scope(prefix="a"), numpyro.plate("robots", n_robots):
        offset = numpyro.sample(
            "offset", unit.expand([3]).to_event(1), infer={"event_dims": ["axis"]}
        )
        numpyro.deterministic("turned", offset[:, ::-1])
    with numpyro.plate("feature", n_features, dim=-2), numpyro.plate("robot", n_robots, dim=-1):
        first = numpyro.sample("first", unit)
    with numpyro.plate("robot", n_robots, dim=-2), numpyro.plate("feature", n_features, dim=-1):
        second = numpyro.sample("second", unit)

    numpyro.deterministic("skill", 2.0 * offset.sum(-1))  # outside of the plate
    numpyro.deterministic("by_feature", 2.0 * weight)
    numpyro.deterministic("column", offset[0])  # three entries, which are no robots
    drift = jnp.einsum("jkif,if->jki", awareness, weight + first.T + second) @ mixing
    rates = ContactRate(drift + offset.sum(-1), 0.4, 2.0, 2.0)  # the posterior is near the prior
    numpyro.sample("contact_rate", rates, obs=contact_rate)


def test_axes_have_the_names_that_the_function_gives_and_the_labels_of_robots(missions):
    options = {"draws": 4, "chains": 1, "check": False, "latent": False, "progress": False}
    tree = tb.fit(missions, labelled, **options)
    fitted = tree["posterior"].to_dataset()
    assert {name: fitted[name].dims[2:] for name in fitted} == {
        "weight": ("feature",),
        "mixing": ("robot", "robot_"),
        "a.offset": ("a.robots", "axis"),
        "a.turned": ("a.robots", "a.turned_dim_1"),
        "first": ("feature", "robot"),
        "second": ("second_robot", "second_feature"),
        "skill": ("robot",),
        "by_feature": ("feature",),
        "column": ("column_dim_0",),
    }
    robots = ["r1", "r2", "r3"]
    for dim in ("robot", "robot_", "a.robots", "second_robot"):
        assert list(fitted[dim].values) == robots
    assert list(fitted["feature"].values) == list(fitted["second_feature"].values)
    assert list(fitted["axis"].values) == [0, 1, 2]

    rows = az.summary(tree, var_names=["second"], kind="stats", round_to="none")["mean"]
    feature = fitted["feature"].values[0]
    own = fitted["second"].sel(second_robot="r2", second_feature=feature)
    np.testing.assert_allclose(float(rows[f"second[r2, {feature}]"]), float(own.mean()))


def test_more_names_than_axes_are_refused(missions):
    def model(awareness, contact_rate=None):
        unit = dist.Normal(0.0, 0.1).expand([2]).to_event(1)
        weight = numpyro.sample("weight", unit, infer={"event_dims": ["feature", "side"]})
        rates = ContactRate(awareness @ weight, 0.4, 0.05, 0.05)
        numpyro.sample("contact_rate", rates, obs=contact_rate)

    with pytest.raises(tb.TrustboError, match="event_dims"):
        tb.fit(missions, model, progress=False)


def test_features_are_found_by_their_names(workspace):
    """Without a mission, the drift is that of the feature in any order."""
    awareness = np.random.default_rng(0).uniform(size=(3, 5, 5, 2))  # that of `workspace`
    other = tb.Workspace.from_awareness(awareness[..., ::-1], features=FEATURES[::-1])
    drifts = []
    for one in (workspace, other):
        campaign = tb.Campaign(one, (4, 0), (0, 4), model=by_name)
        drifts.append(campaign.draw_prior(3).inputs(one.awareness.values))
    np.testing.assert_allclose(*drifts, rtol=1e-12)


def by_name(awareness, features, contact_rate=None):
    weight = numpyro.sample("weight", dist.Normal(0.3, 0.1))
    drift = weight * awareness[..., features.index("line_of_sight")]
    numpyro.sample("contact_rate", ContactRate(drift, 0.4, 0.05, 0.05), obs=contact_rate)


def refused(inner):
    def model(awareness, contact_rate=None):
        inner(awareness, contact_rate)

    return model


def without_site(awareness, rates):
    numpyro.sample("a", dist.Normal())


def normal(awareness, rates):
    a = numpyro.sample("a", dist.Normal())
    numpyro.sample("contact_rate", dist.Normal(a + awareness[..., 0], 0.1), obs=rates)


def independent(awareness, rates):
    a = numpyro.sample("a", dist.Normal())
    normal = dist.Normal(a + awareness[..., 0], 0.1).to_event(2)
    numpyro.sample("contact_rate", normal, obs=rates)


def out_of_range(awareness, rates):
    a = numpyro.sample("a", dist.Normal())
    drift = a * awareness[..., 2]  # JAX would take the last of two features
    numpyro.sample("contact_rate", ContactRate(drift, 0.5, 0.1, 0.1), obs=rates)


def of_lost_feature(awareness, features, contact_rate=None):
    a = numpyro.sample("a", dist.Normal())
    drift = a * awareness[..., features.index("vegetation")]
    numpyro.sample("contact_rate", ContactRate(drift, 0.5, 0.1, 0.1), obs=contact_rate)


def by_label(awareness, rates):
    a = numpyro.sample("a", dist.Normal())
    drift = a * awareness["line_of_sight"]
    numpyro.sample("contact_rate", ContactRate(drift, 0.5, 0.1, 0.1), obs=rates)


def by_xarray(awareness, rates):
    a = numpyro.sample("a", dist.Normal())
    drift = a * awareness.sel(feature="line_of_sight")
    numpyro.sample("contact_rate", ContactRate(drift, 0.5, 0.1, 0.1), obs=rates)


def without_sum(awareness, rates):
    a = numpyro.sample("a", dist.Normal())
    numpyro.sample("contact_rate", ContactRate(a * awareness, 0.5, 0.1, 0.1), obs=rates)


def of_the_team_with_ticks(awareness, contact_rate=None, n_ticks=None):
    a = numpyro.sample("a", dist.Normal())
    drift = a * awareness[..., 0].mean(-1, keepdims=True)
    rates = ContactRate(drift, 0.5, 0.1, 0.1, n_ticks=n_ticks)
    numpyro.sample("contact_rate", rates, obs=contact_rate)


def of_the_team_with_own_noise(awareness, contact_rate=None):
    a = numpyro.sample("a", dist.Normal())
    drift = a * awareness[..., 0].mean(-1, keepdims=True)
    rates = ContactRate(drift, 0.5, np.full(awareness.shape[2], 0.1), 0.1)
    numpyro.sample("contact_rate", rates, obs=contact_rate)


def without_axes(awareness, rates):
    a = numpyro.sample("a", dist.Normal())
    with numpyro.plate("mission", len(awareness)):
        off = numpyro.sample("off", dist.Normal())
    drift = a + off + awareness[..., 0]
    numpyro.sample("contact_rate", ContactRate(drift, 0.5, 0.1, 0.1), obs=rates)


def without_robots(awareness, rates):
    a = numpyro.sample("a", dist.Normal())
    drift = a + awareness[..., 0].mean(-1)
    numpyro.sample("contact_rate", ContactRate(drift, 0.5, 0.1, 0.1), obs=rates)


def unobserved(awareness, rates):
    a = numpyro.sample("a", dist.Normal())
    numpyro.sample("contact_rate", ContactRate(a + awareness[..., 0], 0.5, 0.1, 0.1))


def discrete(awareness, rates):
    a = numpyro.sample("a", dist.Bernoulli(0.5))
    numpyro.sample("contact_rate", ContactRate(a + awareness[..., 0], 0.5, 0.1, 0.1), obs=rates)


def same_names(awareness, rates):
    drift = numpyro.sample("a/b", dist.Normal()) + numpyro.sample("a.b", dist.Normal())
    numpyro.sample("contact_rate", ContactRate(drift + awareness[..., 0], 0.4, 0.1, 0.1), obs=rates)


def named_draw(awareness, rates):
    a = numpyro.sample("draw", dist.Normal())
    numpyro.sample("contact_rate", ContactRate(a + awareness[..., 0], 0.5, 0.1, 0.1), obs=rates)


def with_parameter(awareness, rates):
    a = numpyro.sample("a", dist.Normal())
    b = numpyro.param("b", 0.3)
    drift = a + b * awareness[..., 0]
    numpyro.sample("contact_rate", ContactRate(drift, 0.5, 0.1, 0.1), obs=rates)


def improper(awareness, rates):
    a = numpyro.sample("a", dist.ImproperUniform(dist.constraints.positive, (), ()))
    numpyro.sample("contact_rate", ContactRate(a + awareness[..., 0], 0.5, 0.1, 0.1), obs=rates)


def masked(awareness, rates):
    a = numpyro.sample("a", dist.Normal())
    given = ContactRate(a + awareness[..., 0], 0.5, 0.1, 0.1).mask(np.zeros(len(awareness), bool))
    numpyro.sample("contact_rate", given, obs=rates)


@jax.jit
def jitted_part(z):
    return z + numpyro.sample("a", dist.Normal())


def with_jit(awareness, rates):
    drift = jitted_part(awareness[..., 0])
    numpyro.sample("contact_rate", ContactRate(drift, 0.5, 0.1, 0.1), obs=rates)


def without_variables(awareness, rates):
    numpyro.sample("contact_rate", ContactRate(awareness[..., 0], 0.5, 0.1, 0.1), obs=rates)


def broken(awareness, rates):
    raise RuntimeError("no such luck")


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (refused(without_site), "has no site 'contact_rate', only 'a'"),
        (refused(normal), "has the distribution Normal; it must be tb.models.ContactRate"),
        (refused(independent), "has the distribution Normal"),
        (refused(unobserved), "is not observed; pass obs=contact_rate"),
        (refused(named_draw), "has the name of an axis"),
        (refused(same_names), "the sites 'a/b' and 'a.b'"),
        (refused(discrete), "the site 'a' .* is discrete"),
        (refused(with_parameter), "the site 'b' .* is a parameter .* use numpyro.sample"),
        (refused(improper), "failed with NotImplementedError: .* proper priors"),
        (refused(masked), "has a ContactRate that was changed by expand, mask"),
        (refused(with_jit), "the site 'a' in its first run only; remove jax.jit"),
        (jax.jit(linear), "in its first run only; remove jax.jit"),
        (refused(without_variables), "has no latent variable"),
        (refused(broken), "failed with RuntimeError: no such luck"),
        (
            refused(out_of_range),
            r"index 2 is out of bounds.*line_of_sight \(1\)",
        ),
        (
            refused(without_axes),
            r"Incompatible shapes.*the drift must be \(mission, bound, robot\)",
        ),
        (refused(without_robots), r"the function model: drift must .*the axis of the robots"),
        (shaped, r"must have the shape .* = \(4, 8, 3\).*got \(4, 8, 2\)"),
        (of_lost_feature, r"of_lost_feature.*'vegetation'.*traversability, line_of_sight"),
        (refused(by_label), r"awareness\[..., features.index\(name\)\]"),
        (refused(by_xarray), r"awareness\[..., features.index\(name\)\]"),
        (refused(without_sum), "drift must .* awareness @ weights"),
        (of_the_team_with_ticks, r"the drift of .* = \(4, 8, 3\).*got \(4, 8, 1\)"),
        (of_the_team_with_own_noise, r"the drift of .* = \(4, 8, 3\).*got \(4, 8, 1\)"),
        (lambda z, rates=None: None, "must have the parameters awareness and contact_rate"),
        (lambda awareness, contact_rate, colour: None, "the parameter 'colour'"),
        (PooledTrust, "model: got type PooledTrust|give a model"),
    ],
)
def test_a_function_that_is_no_model_is_refused_before_sampling(missions, function, message):
    with pytest.raises(tb.TrustboError, match=message):
        tb.fit(missions, function, progress=False)


def numbered(awareness, rates):
    a = numpyro.sample("a", dist.Normal())
    drift = a * jnp.arange(len(awareness))[:, None, None] + awareness[..., 0]
    numpyro.sample("contact_rate", ContactRate(drift, 0.5, 0.1, 0.1), obs=rates)


def with_history(awareness, rates):
    a = numpyro.sample("a", dist.Normal())
    drift = a * jnp.cumsum(awareness[..., 0], axis=1)
    numpyro.sample("contact_rate", ContactRate(drift, 0.5, 0.1, 0.1), obs=rates)


def standardised(awareness, rates):
    a = numpyro.sample("a", dist.Normal())
    x = awareness[..., 0]
    drift = a * (x - x.mean()) / x.std()
    numpyro.sample("contact_rate", ContactRate(drift, 0.5, 0.1, 0.1), obs=rates)


def with_offset(awareness, rates):
    a = numpyro.sample("a", dist.Normal())
    given = ContactRate(awareness[..., 0], 0.5, 0.1, 0.1, offset=a * awareness[..., 1])
    numpyro.sample("contact_rate", given, obs=rates)


def without_plate(awareness, rates):
    a = numpyro.sample("a", dist.Normal().expand([len(awareness)]).to_event(1))
    drift = a[:, None, None] + awareness[..., 0]
    numpyro.sample("contact_rate", ContactRate(drift, 0.5, 0.1, 0.1), obs=rates)


def with_rough_noise(awareness, rates):
    a = numpyro.sample("a", dist.Normal())
    noise = 0.1 * (1.0 + awareness.mean())
    numpyro.sample("contact_rate", ContactRate(a + awareness[..., 0], 0.5, noise, 0.1), obs=rates)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (numbered, "changes with the order or the number of bounds or missions"),
        (with_history, "changes with the order"),
        (standardised, "changes with the order"),
        (with_offset, "has an offset"),
        (without_plate, "a size that depends on the number of missions"),
        (with_rough_noise, "a noise or the trust at the start depends on the awareness"),
    ],
)
def test_a_drift_that_depends_on_more_than_its_bound_cannot_plan(workspace, function, message):
    with pytest.raises(tb.TrustboError, match=message):
        tb.Campaign(workspace, (4, 0), (0, 4), model=refused(function))


def test_bad_diagnostics_are_refused_and_the_posterior_is_kept(missions):
    """Two modes of the drift, between which chains do not move."""

    def model(awareness, contact_rate=None):
        modes = dist.Normal(jnp.array([-3.0, 3.0]), 0.1)
        halves = dist.Categorical(probs=jnp.array([0.5, 0.5]))
        a = numpyro.sample("a", dist.MixtureSameFamily(halves, modes))
        rates = ContactRate(0.3 + 0.1 * a + 0.0 * awareness[..., 0], 0.1, 1.0, 1.0)
        numpyro.sample("contact_rate", rates, obs=contact_rate)

    with pytest.raises(PosteriorError, match=r"R-hat|bulk ESS") as error:
        tb.fit(missions[:1], model, sampler="nuts", seed=1, progress=False)
    assert "posterior" in error.value.posterior.children


def test_variables_that_are_not_identified_are_named_if_the_drift_is(missions):
    """The sign of a does not matter, and chains keep theirs."""

    def model(awareness, contact_rate=None):
        a = numpyro.sample("a", dist.Normal(0.0, 1.0))
        rates = ContactRate(jnp.abs(a) + 0.0 * awareness[..., 0], 0.1, 0.02, 0.02)
        numpyro.sample("contact_rate", rates, obs=contact_rate)

    with pytest.warns(UserWarning, match="the chains of a differ") as said:
        posterior = tb.fit(missions, model, sampler="nuts", latent=False, seed=1, progress=False)
    assert {one.filename for one in said} == {__file__}  # the line of the caller
    assert posterior.attrs["not_identified"] == ["a"]


def test_a_noise_is_not_called_unidentified_where_the_noises_are_accepted(missions):
    """Few effective draws of delta_v are enough in the last run, for itself as for the noises."""

    def model(awareness, contact_rate=None):
        numpyro.sample("unused", dist.Normal())
        delta_v = numpyro.sample("delta_v", dist.HalfNormal(0.1))
        delta_w = numpyro.sample("delta_w", dist.HalfNormal(0.1))
        rates = ContactRate(0.3 * awareness[..., 0], 0.4, delta_w, delta_v)
        numpyro.sample("contact_rate", rates, obs=contact_rate)

    n_draws = 500
    rng = np.random.default_rng(0)
    step = rng.normal(size=(3, 4, n_draws))
    slow = np.empty(step.shape)
    slow[..., 0] = step[..., 0]
    for k in range(1, n_draws):  # about 100 effective draws
        slow[..., k] = 0.9 * slow[..., k - 1] + np.sqrt(1.0 - 0.9**2) * step[..., k]
    apart = slow[2] + 5.0 * np.arange(4)[:, None]  # chains that do not mix

    # The coordinates are the log total of the noises, their share, and `unused`.
    x = np.stack([slow[1] - 3.0, slow[0], apart], axis=-1)
    samples = Samples(x, {"diverging": np.zeros((4, n_draws), bool)})

    data = data_of(missions, Observations.from_missions(missions))
    function = as_model(model)
    [target] = targets_of(function, data, function.sites(data))
    assert target.coordinates.names == ["delta_v", "delta_w", "unused"]
    strict = judge(target, samples, patient=True)
    rough = judge(target, samples, patient=True, last=True)
    assert any("ESS" in complaint for complaint in strict.complaints)
    assert rough.complaints == []
    assert rough.not_identified == ["unused"]


def test_the_prior_of_a_function_is_drawn_by_numpyro():
    with pytest.raises(tb.TrustboError, match="Predictive"):
        tb.inference.sample_prior(linear, 2, 10, 0)


def test_other_samplers_are_refused(missions):
    with pytest.raises(tb.TrustboError, match="sampler"):
        tb.fit(missions, linear, sampler="gibbs")


def test_a_guard_against_transfers_does_not_stop_a_function(missions):
    model = as_model(linear)
    data = data_of(missions, Observations.from_missions(missions))
    with own_settings():
        keys = np.asarray(jax.random.key_data(jax.random.split(jax.random.key(0), 2)))

    with jax.transfer_guard("disallow"):
        drawn = model.over_draws("prior", 1, data)(keys)
    assert drawn["weight"].shape == (2, 2)


def test_log_priors_of_missions_leave_out_the_padding(with_days):
    off = with_days["posterior"]["trust"].values
    np.testing.assert_allclose(
        with_days["log_prior"]["trust"], stats.norm.logpdf(off, 0.0, 0.05).sum(-1)
    )


def test_a_variable_may_have_any_name(with_days):
    for group in ("posterior", "log_prior"):
        assert set(with_days[group].data_vars) == {"trust", "level.of"}


def test_a_drift_may_depend_on_the_duration(missions):
    """Short missions are padded, and NaN in the padding would make all gradients NaN."""
    timed = [
        tb.Mission.from_arrays(
            one.path, one.awareness, one.contact_rate, np.full(one.contact_rate.shape, 60.0),
            features=FEATURES, robots=one.robots,
        )
        for one in missions
    ]  # fmt: skip

    def model(awareness, contact_rate=None, duration=None):
        a = numpyro.sample("a", dist.Normal(0.0, 1.0))
        rates = ContactRate(a * duration / 60.0 + 0.0 * awareness[..., 0], 0.4, 0.05, 0.05)
        numpyro.sample("contact_rate", rates, obs=contact_rate)

    fitted = tb.fit(timed, model, draws=200, latent=False, progress=False)
    assert fitted.attrs["k_hat"] < 0.7


@pytest.mark.parametrize("of", ["drift", "noise"])
def test_what_depends_on_the_duration_cannot_plan(of, workspace):
    """The duration of a mission is not known before it."""

    def model(awareness, contact_rate=None, duration=None):
        a = numpyro.sample("a", dist.Normal(0.0, 1.0))
        drift = a * awareness[..., 0] * (duration / 60.0 if of == "drift" else 1.0)
        scale = jnp.sqrt(duration / 60.0) if of == "noise" else jnp.ones(duration.shape)
        rates = ContactRate(drift, 0.4, 0.05, 0.05, noise_scale=scale)
        numpyro.sample("contact_rate", rates, obs=contact_rate)

    with pytest.raises(tb.TrustboError, match="not finite"):
        tb.iterate(workspace, (0, 0), (0, 2), model=model, n_iterations=1, progress=False)


def test_a_path_may_jump_if_the_function_reads_no_moves(missions):
    cells = [missions[0].path[0], (2, 2), (0, 4)]
    z = missions[0].awareness[:2]
    jump = tb.Mission.from_arrays(
        cells, z, missions[0].contact_rate[:2], features=FEATURES, robots=missions[0].robots
    )
    fitted = tb.fit([jump, *missions], linear, draws=N_DRAWS, check=False, progress=False)
    assert fitted["posterior"]["level"].shape == (1, 4 * N_DRAWS)

    def of_moves(awareness, contact_rate=None, bound=None):
        linear(awareness, contact_rate)

    with pytest.raises(tb.TrustboError, match="not neighbours"):
        tb.fit([jump, *missions], of_moves, progress=False)


@pytest.mark.slow
def test_the_program_of_a_model_class_is_a_function(missions):
    """The posterior and log-likelihoods are those of the class, sampled in other coordinates."""
    model = PooledTrust()
    ours = tb.fit(missions, model, sampler="nuts", draws=2000, seed=1, progress=False)
    theirs = tb.fit(missions, model.program, draws=2000, seed=1, progress=False)
    resolution = model.observations(missions).resolution
    for name in ("beta0", "delta_w", "delta_v"):
        a = ours["posterior"][name]
        b = theirs["posterior"][name]
        if name == "delta_v":
            b = np.hypot(b, resolution)  # as the class reports it
        assert abs(float(a.mean() - b.mean())) < 0.1 * float(a.std())

    totals = [tree["log_likelihood"]["contact_rate"].sum("mission") for tree in (ours, theirs)]
    means = [float(total.mean()) for total in totals]
    assert abs(means[0] - means[1]) < 0.1 * float(totals[0].std())


def test_densities_in_unconstrained_space_are_those_of_numpyro(missions):
    def model(awareness, contact_rate=None):
        mix = numpyro.sample("mix", dist.Dirichlet(jnp.ones(2)))
        with numpyro.plate("robot", 3):
            scale = numpyro.sample("scale", dist.LogNormal(jnp.zeros(3), 0.3))
        with numpyro.plate("mission", len(awareness)):
            noise = numpyro.sample("noise", dist.Beta(2.0, 20.0))
            drift = awareness @ mix * scale + noise[:, None, None]
            numpyro.sample("contact_rate", ContactRate(drift, 0.4, 0.1, 0.1), obs=contact_rate)

    n = len(missions)
    z = {"mix": jnp.array([0.3]), "scale": jnp.array([0.1, -0.4, 0.2]), "noise": jnp.zeros(n)}
    data = {
        "awareness": jnp.asarray(np.stack([mission.awareness[:4] for mission in missions])),
        "contact_rate": jnp.asarray(np.stack([mission.contact_rate[:4] for mission in missions])),
    }
    ours = as_model(model)
    with own_settings():
        wanted = potential_energy(model, (), data, z)
        np.testing.assert_allclose(ours.potential(z, data), wanted, rtol=1e-12)
        wanted = constrain_fn(model, (), data, z)
        jax.tree.map(np.testing.assert_allclose, ours.constrain(z, data), wanted)


@pytest.mark.slow  # a process starts for long
def test_a_function_is_fitted_if_numpyro_is_half_loaded():
    """`import arviz, numpyro.distributions` loses submodules of NumPyro, which its NUTS needs."""
    code = """
import arviz, numpyro.distributions as dist
import numpy as np
import trustbo as tb
from numpyro import sample

def model(awareness, contact_rate=None):
    a = sample("a", dist.HalfNormal())
    rates = tb.models.ContactRate(a * awareness[..., 0], 0.4, 0.05, 0.05)
    sample("contact_rate", rates, obs=contact_rate)

z = np.random.default_rng(0).uniform(size=(4, 3, 1))
mission = tb.Mission.from_arrays(None, z, 0.5 * z[..., 0])
options = {"draws": 100, "check": False, "latent": False, "progress": False}
tree = tb.fit([mission], model, sampler="nuts", **options)
print(tree["posterior"]["a"].shape)
"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout == "(4, 100)\n"
