"""Effects of places and robots in NumPyro functions."""

import arviz as az
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import stats

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.inference.functions.function import keys_of
from trustbo.inference.functions.known import as_model
from trustbo.inference.functions.missions import FunctionData
from trustbo.inference.functions.target import targets_of
from trustbo.models import ContactRate, PlaceEffect, PooledTrust, RobotEffect, TrustParams
from trustbo.models.priors import Priors

FEATURES = ("traversability", "line_of_sight")
PRIORS = Priors.from_features(FEATURES)
PATHS = ((4, 0), (3, 1), (2, 2), (1, 3), (0, 4)), ((4, 0), (3, 0), (2, 1), (1, 2), (0, 3), (0, 4))


def observed(drift, beta0, delta_w, delta_v, contact_rate, n_ticks, effects):
    with numpyro.plate("mission", len(drift)):
        rates = ContactRate(drift, beta0, delta_w, delta_v, n_ticks=n_ticks, effects=effects)
        numpyro.sample("contact_rate", rates, obs=contact_rate)


def linear(awareness, contact_rate=None, n_ticks=None):
    """The pooled model with effects, whose weights are variables."""
    beta0 = numpyro.sample("beta0", PRIORS.beta0)
    delta_w = numpyro.sample("delta_w", PRIORS.delta_w)
    delta_v = numpyro.sample("delta_v", PRIORS.delta_v)
    mean, sd = PRIORS.coefficients(len(FEATURES))
    c = numpyro.sample("c", dist.Normal(mean, sd).to_event(1))
    drift = (1.0 - beta0) * (awareness @ c[:-1] + c[-1])
    effects = [PlaceEffect().sample(), RobotEffect().sample()]
    observed(drift, beta0, delta_w, delta_v, contact_rate, n_ticks, effects)


CLASS = PooledTrust(priors=PRIORS, effects=(PlaceEffect(), RobotEffect()))


def of_each_robot(awareness, contact_rate=None, n_ticks=None):
    """Memory and noises of each robot, and noise that all robots share."""
    with numpyro.plate("robot", awareness.shape[2]):
        beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
        delta_w = numpyro.sample("delta_w", dist.HalfNormal(0.1))
        delta_v = numpyro.sample("delta_v", dist.HalfNormal(0.1))
    level = numpyro.sample("level", dist.Normal(0.3, 0.3))
    drift = level + 0.0 * awareness[..., 0]
    observed(drift, beta0, delta_w, delta_v, contact_rate, n_ticks, [RobotEffect().sample()])


def with_own_noises(awareness, contact_rate=None, n_ticks=None):
    """Noises of each robot, and memory that all robots share."""
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
    with numpyro.plate("robot", awareness.shape[2]):
        delta_w = numpyro.sample("delta_w", dist.HalfNormal(0.1))
        delta_v = numpyro.sample("delta_v", dist.HalfNormal(0.1))
    level = numpyro.sample("level", dist.Normal(0.3, 0.3))
    drift = level + 0.0 * awareness[..., 0]
    observed(drift, beta0, delta_w, delta_v, contact_rate, n_ticks, [RobotEffect().sample()])


def in_a_plate(awareness, contact_rate=None, n_ticks=None):
    """An effect whose standard deviations would differ between missions."""
    level = numpyro.sample("level", dist.Normal(0.3, 0.3))
    with numpyro.plate("mission", len(awareness)):
        effect = RobotEffect().sample()
    observed(level + 0.0 * awareness[..., 0], 0.4, 0.1, 0.1, contact_rate, n_ticks, [effect])


def test_an_effect_in_a_plate_is_refused(missions):
    with pytest.raises(TrustboError, match=r"RobotEffect.sample\(\) was called within"):
        tb.fit(missions, in_a_plate, progress=False)


@pytest.fixture(scope="module")
def workspace():
    awareness = np.random.default_rng(0).uniform(size=(3, 5, 5, 2))
    return tb.Workspace.from_awareness(awareness, features=FEATURES)


@pytest.fixture(scope="module")
def missions(workspace):
    places = np.random.default_rng(1).normal(0.0, 0.08, (5, 5))
    truth = TrustParams(0.3, np.array([0.0, 0.4]), 0.1, 0.03, 0.04, place=places[None])
    simulator = tb.simulation.ModelSimulator(workspace, truth)
    return [simulator.run(PATHS[k % 2], seed=k) for k in range(5)]


def target_of(function, missions):
    model = as_model(function)
    known = FunctionData(model, missions)
    return targets_of(model, known.data, known.sites, known)[0]


def dense_log_density(target, values):
    """Log density of all rates as one normal, whose means and covariances are summed in loops."""
    effects = target.integrated.density.columns
    rates = effects.observations.contact_rate
    n_missions, n_bounds, n_robots = rates.shape
    theta = {name: np.atleast_1d(values[name]) for name in ("tau_slow", "tau_mission")}
    others = (*PlaceEffect.names, "tau_lasting")
    theta |= {name: np.atleast_1d(values[name]) for name in others if name in values}
    beta0 = np.broadcast_to(values["beta0"], n_robots)
    theta["inverse_gain"] = np.atleast_1d(1.0 - values["beta0"])
    if np.ndim(values["beta0"]):
        theta["inverse_gain"] = theta["inverse_gain"][None]

    # Covariance of the effects, one coefficient of unit variance after the other.
    covariance = np.zeros((rates.size, rates.size))
    for effect in effects.effects:
        U = effect.design(effects.observations).toarray()
        start = 0
        for part in effect.prior(theta, effects.observations)[1]:
            precision = part[0] if part.ndim == 3 else np.diag(part[0])
            own = U[:, start : start + len(precision)]
            covariance += own @ np.linalg.inv(precision) @ own.T
            start += len(precision)

    drift = values["drift"]
    mean = np.zeros(rates.shape)
    gain = np.zeros((rates.size, rates.size))  # of the drift of each bound
    noise = np.zeros((rates.size, rates.size))
    number = np.arange(rates.size).reshape(rates.shape)
    noises = [np.broadcast_to(values[name], n_robots) for name in ("delta_w", "delta_v")]
    for j in range(n_missions):
        for i in range(n_robots):
            for k in range(n_bounds):
                mean[j, k, i] = beta0[i] ** (k + 1) * 0.5
                noise[number[j, k, i], number[j, k, i]] += noises[1][i] ** 2
                for a in range(k + 1):
                    mean[j, k, i] += beta0[i] ** (k - a) * drift[j, a, i]
                    gain[number[j, k, i], number[j, a, i]] = beta0[i] ** (k - a)
                for b in range(n_bounds):
                    start = beta0[i] ** (k + b + 2) * 0.5**2
                    steps = [beta0[i] ** (k + b - 2 * a) for a in range(min(k, b) + 1)]
                    own = start + noises[0][i] ** 2 * sum(steps)
                    noise[number[j, k, i], number[j, b, i]] += own

    whole = gain @ covariance @ gain.T + noise
    seen = ~np.isnan(rates.ravel())
    law = stats.multivariate_normal(mean.ravel()[seen], whole[np.ix_(seen, seen)])
    return law.logpdf(rates.ravel()[seen])


@pytest.mark.parametrize("function", [linear, of_each_robot, with_own_noises])
def test_the_density_is_that_of_one_large_normal(function, missions):
    target = target_of(function, missions[:3])
    model = target.model
    keys = keys_of(2, 0)
    prior = model.over_draws("prior", 1, target.data)(keys)
    x = target.points(prior)
    found = target.log_density(x) - target.outer(x).log_p

    n_missions, n_bounds, n_robots = target.integrated.observations.contact_rate.shape
    resolution = target.integrated.observations.resolution
    _, inputs = model.over_draws("space_and_inputs", 2, target.data)(prior, keys)
    for one in range(2):
        values = {name: v[one] for name, v in prior.items()}
        values["delta_v"] = np.hypot(values["delta_v"], resolution)
        drift = inputs.drift[one].reshape(*inputs.drift[one].shape[:2], n_robots)
        values["drift"] = drift[:n_missions, :n_bounds]
        assert found[one] == pytest.approx(dense_log_density(target, values), rel=1e-9)


@pytest.mark.slow  # the density and the draws of coefficients are compared by other tests
def test_the_posterior_is_that_of_the_model_class(missions, workspace):
    fitted = tb.fit(missions, linear, workspace=workspace, progress=False)
    wanted = tb.fit(missions, CLASS, workspace=workspace, progress=False)
    for group, names in {
        "posterior": ("beta0", "delta_w", "tau_s", "tau_e", "tau_r", "tau_slow", "tau_mission"),
        "robots": ("robot_effect",),
        "places": ("place", "place_bound", "place_robot"),
        "latent": ("trust",),
    }.items():
        for name in names:
            a, b = (tree[group][name] for tree in (wanted, fitted))
            assert a.dims == b.dims
            axes = ("chain", "draw")
            difference = np.abs(a.mean(axes) - b.mean(axes)) / a.std(axes)
            assert float(difference.max()) < 0.4, name
            assert float(difference.mean()) < 0.15, name
    assert fitted.attrs["n_missions"] == len(missions)
    own = fitted.attrs["log_evidence"]
    assert own == pytest.approx(wanted.attrs["log_evidence"], abs=0.3)


@pytest.fixture(scope="module")
def campaign(missions, workspace):
    campaign = tb.Campaign(workspace, (4, 0), (0, 4), model=linear, progress=False)
    campaign.tell(missions[0])
    return campaign


def test_draws_for_planning_contain_the_effects(campaign, missions, workspace):
    fitted = campaign.posterior
    drawn = tb.inference.params_of(fitted, workspace, next_mission=True)
    cell, bound = missions[0].bounds[1].cell, 2
    awareness = workspace.awareness.values
    inputs = drawn.inputs(awareness)
    assert inputs.shape == (1000, *awareness.shape[:-1])

    places = fitted["places"].to_dataset().squeeze("chain")
    at = (places["cell_row"] == cell[0]) & (places["cell_col"] == cell[1])
    s = places["place"].isel(cell=int(np.argmax(at.values))).values
    np.testing.assert_allclose(drawn.arrays["place"][:, 0, *cell], s, atol=1e-8)
    np.testing.assert_allclose(
        drawn.draw(3).inputs(awareness)[0], inputs[3], rtol=1e-12, equal_nan=True
    )

    # A bound that is given alone has the same input as on the map.
    moves, rows, cols = np.nonzero(~np.isnan(awareness[0, ..., 0]))
    some = np.column_stack([moves, rows, cols])[:: len(moves) // bound]
    alone = drawn.inputs(awareness[:, *some.T], some)
    np.testing.assert_allclose(alone, inputs[:, :, *some.T], rtol=1e-9)

    expected = tb.inference.params_of(fitted, workspace)
    np.testing.assert_allclose(
        expected.mean().inputs(awareness)[0], expected.inputs(awareness).mean(0), rtol=1e-7
    )
    plan = tb.Planner(workspace, (4, 0), (0, 4)).plan(drawn)
    assert plan.path[-1] == (0, 4)


def test_a_campaign_learns_the_effects_and_resumes(campaign, tmp_path):
    campaign.save(tmp_path / "saved")
    again = tb.Campaign.load(tmp_path / "saved", model=linear)
    np.testing.assert_array_equal(
        again.posterior["places"]["place"], campaign.posterior["places"]["place"]
    )
    assert again.path == campaign.path
    assert campaign.table()["state"].tolist() == ["learned"]
    maps = campaign.planner.robot_maps(campaign.posterior)
    assert set(maps.data_vars) >= {"trust_mean", "trust_sd"}


@pytest.mark.slow  # gradients by differences take minutes
def test_nuts_has_the_same_posterior(missions):
    """Means differ by at most 4 standard errors of their difference."""
    quiet = {"latent": False, "progress": False}
    ours = tb.fit(missions, linear, sampler="importance", **quiet)
    nuts = tb.fit(missions, linear, sampler="nuts", draws=300, check=False, **quiet)

    over = ("chain", "draw")
    for group in ("posterior", "places"):
        one, other = ours[group].to_dataset(), nuts[group].to_dataset()
        error = np.sqrt(1.0 / ours.attrs["kish"] + 1.0 / az.ess(other))
        gap = abs(one.mean(over) - other.mean(over)) / other.std(over)
        for name in error.data_vars:
            assert float((gap[name] / error[name]).max()) < 4.5, name
    assert nuts.attrs["divergences"] == 0


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"effects": [RobotEffect()]}, "PlaceEffect\\(\\).sample\\(\\)"),
        ({"effects": "twice"}, "different classes; got RobotEffect and RobotEffect"),
        ({"beta0": 0.3 * jnp.eye(3)}, "effects need a beta0 of the shape"),
        ({"offset": 0.1}, "cannot be combined with an offset"),
    ],
)
def test_what_effects_cannot_be_combined_with_is_named(changed, message):
    def rates():
        one = RobotEffect().sample()
        options = {"effects": [one], "beta0": 0.3, "delta_w": 0.1, "delta_v": 0.1} | changed
        if options["effects"] == "twice":
            options["effects"] = [one, one]
        ContactRate(jnp.zeros((1, 4, 3)), **options)

    with numpyro.handlers.seed(rng_seed=0), pytest.raises(TrustboError, match=message):
        rates()


def test_effects_have_no_density_of_single_missions():
    with numpyro.handlers.seed(rng_seed=0):
        rates = ContactRate(jnp.zeros((1, 4, 3)), 0.3, 0.1, 0.1, effects=[RobotEffect().sample()])
    with pytest.raises(TrustboError, match=r"fit the function with trustbo\.fit"):
        rates.log_prob(jnp.zeros((1, 4, 3)))
