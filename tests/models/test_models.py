"""Coupled and hierarchical trust: their parameters, posteriors, and what they refuse."""

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from missions import random_covariance, simulate_missions
from numpyro.infer.util import potential_energy
from references import dense_coupled

from trustbo.data import Mission
from trustbo.errors import ShapeError, TrustboError
from trustbo.inference import (
    TrustFilter,
    diagnostics,
    fit,
    params_of,
    prior_predictive,
    sample_prior,
)
from trustbo.inference.samplers.nuts_sites import SitesInJax
from trustbo.models import (
    CoupledParams,
    CoupledTrust,
    HierarchicalTrust,
    PooledTrust,
    Priors,
    RobotParams,
    TrustParams,
)
from trustbo.stacking import stack_missions

N = 40
MODELS = {
    "pooled": PooledTrust(),
    "hierarchical": HierarchicalTrust(),
    "coupled": CoupledTrust(),
    "apart": CoupledTrust(inter_robot="none"),
    "censored": CoupledTrust(observation="censored"),
    "counts": HierarchicalTrust(observation="beta_binomial"),
}


def fast(names, *few):
    """Cases of which `make test` runs a few; the others compile for long, see `make slow`."""
    cases = [(n, n if isinstance(n, tuple) else (n,)) for n in names]
    return [n if n in few else pytest.param(*c, marks=pytest.mark.slow) for n, c in cases]


@pytest.fixture(scope="module", autouse=True)
def _numpyro_promotes_ranks():
    """As soon as its Beta is expanded; our own code does not, see tests/conftest.py."""
    with jax.numpy_rank_promotion("allow"):
        yield


def counted_missions(n_missions=6, seed=0, family="censored"):
    """Missions with ticks, a third of whose rates are 0 or 1."""
    z = np.random.default_rng(seed).uniform(size=(n_missions, 8, 3, 2))
    truth = TrustParams(0.6, np.array([0.5, 0.3]), -0.05, 0.08, 0.08)
    if family == "beta_binomial":
        truth = TrustParams(0.6, np.array([2.0, 1.0]), -0.8, 0.3, 0.2, 0.0, 1.5)
    model = PooledTrust(observation=family)
    y = model.simulate(jax.random.key(seed), truth, z, n_ticks=N).contact_rate
    y = np.round(np.clip(y, 0.0, 1.0) * N) / N
    path = [(0, k) for k in range(9)]
    ticks = np.full((8, 3), N)
    return [Mission.from_arrays(path, a, b, n_ticks=ticks) for a, b in zip(z, y, strict=True)]


def coupled_params(rng, n=3, m=2):
    return CoupledParams(
        0.5 * np.eye(n) + rng.normal(0.0, 0.1, (n, n)),
        rng.normal(0.0, 0.3, (m, n, n)),
        rng.normal(0.0, 0.2, n),
        random_covariance(rng, n, 0.1),
        random_covariance(rng, n, 0.1),
        0.4,
        0.3,
    )


def test_coupled_log_likelihood_is_equations_1_and_2():
    rng = np.random.default_rng(0)
    params, missions = coupled_params(rng), simulate_missions(3)
    rates = missions[0].contact_rate.copy()
    rates[2, 1] = np.nan
    missions[0] = Mission.from_arrays(missions[0].path, missions[0].awareness, rates)
    expected = []
    for mission in missions:
        z = mission.awareness
        drift = params.b + sum(z[:, :, m] @ params.B[m].T for m in range(2))
        args = (params.B0, drift, params.Delta_w, params.Delta_v, 0.4, 0.3)
        expected.append(dense_coupled(*args, mission.contact_rate)[0])
    found = CoupledTrust().log_likelihood(params, missions)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_robots_with_equal_parameters_are_pooled():
    p, missions = TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.1, 0.2), simulate_missions(3)
    each = RobotParams(*(np.broadcast_to(v, (3, *np.shape(v))) for v in p[:5]))
    together = CoupledParams(
        np.eye(3) * p.beta0,
        p.beta[:, None, None] * np.eye(3),
        np.full(3, p.b),
        np.eye(3) * p.delta_w**2,
        np.eye(3) * p.delta_v**2,
    )
    expected = PooledTrust().log_likelihood(p, missions)
    np.testing.assert_allclose(HierarchicalTrust().log_likelihood(each, missions), expected)
    np.testing.assert_allclose(CoupledTrust().log_likelihood(together, missions), expected)


def density_of(name, missions):
    """The density that NUTS samples."""
    batch = stack_missions(missions)
    return SitesInJax.of(MODELS[name], batch, np.ones(len(batch.awareness)))


GAUSSIAN = [name for name, model in MODELS.items() if model.observation == "gaussian"]


@pytest.mark.parametrize("name", fast(GAUSSIAN, "pooled", "apart"))
def test_nuts_of_sites_samples_the_numpyro_model(name):
    """The Jacobian, and the density at the sites of a vector, by automatic differentiation."""

    @jax.jit  # one program compiles faster than each operation by itself
    def evaluate(density, noise):
        theta = density._flat[0] + 0.3 * noise[: len(density._flat[0])]

        def to_line(theta):
            site, _ = density.sites(theta)
            return jnp.concatenate([site[n].ravel() for n in density._priors])

        args, ticks = density.batch[:2], {"n_ticks": density.batch.n_ticks}
        site, claimed = density.sites(theta)
        plain = potential_energy(density.model, args, ticks, site)
        found = density.potential({"theta": theta})
        return jax.jacfwd(to_line)(theta), claimed, plain, found

    with jax.enable_x64(True):
        noise = jnp.asarray(np.random.default_rng(0).normal(size=60))
        density = density_of(name, counted_missions(2))
        if MODELS[name].robot_sets == "pooled":
            density, _ = jax.jit(SitesInJax.centred)(density)
        jacobian, claimed, plain, found = map(np.asarray, evaluate(density, noise))
    log_jacobian = np.linalg.slogdet(jacobian)[1]
    np.testing.assert_allclose(claimed, log_jacobian, atol=1e-8)
    np.testing.assert_allclose(found, plain - log_jacobian, rtol=1e-10)


@pytest.mark.slow  # it compiles for long
def test_the_mode_of_sites_has_no_slope_but_that_of_the_noise():
    """The search adds a power of the noise, see `SitesInJax.centred`: 22 unknowns, 6 noises."""
    density = density_of("coupled", simulate_missions(6))
    with jax.enable_x64(True):
        density, chain = jax.jit(SitesInJax.centred)(density)
        slope = jax.jit(jax.grad(lambda theta: density.potential({"theta": theta})))(chain.center)
        site = density._flat[1](slope)
    n_unknowns, noise = len(chain.center), site.pop("delta_w")
    np.testing.assert_allclose(noise, (n_unknowns - 6) / 3.0, atol=1e-4)
    assert max(np.abs(np.asarray(values)).max() for values in site.values()) < 1e-4


# One test a model, not a fixture for two: two workers would compile and sample it twice.
@pytest.mark.slow  # it compiles for long
def test_hierarchical_robots_lie_between_pooled_and_separate_ones(missions):
    hierarchical = fit(missions, HierarchicalTrust(), sampler="nuts")
    found = diagnostics(hierarchical)
    assert found["r_hat"] <= 1.01
    assert found["divergences"] == 0
    draws = hierarchical["posterior"]
    assert draws["beta"].dims == ("chain", "draw", "robot", "feature")
    assert draws["tau_beta"].dims == ("chain", "draw", "feature")
    apart = fit(missions, CoupledTrust(inter_robot="none"), sampler="exact")["posterior"]
    spread = {
        name: float(tree["beta"].mean(("chain", "draw")).std("robot").mean())
        for name, tree in (("hierarchical", draws), ("apart", apart))
    }
    # The missions are of equal robots: partial pooling draws them together.
    assert spread["hierarchical"] < spread["apart"]
    params = params_of(hierarchical)
    assert isinstance(params, RobotParams)
    assert np.shape(params.delta_w) == (4000, 3)
    require_trust_followed_in_real_time(hierarchical, HierarchicalTrust(), missions[0])


def test_a_coupled_posterior_has_the_paper_s_matrices(missions):
    coupled = fit(missions, CoupledTrust())
    assert diagnostics(coupled)["k_hat"] <= 0.7
    draws = coupled["posterior"]
    assert list(draws.data_vars) == ["B0", "B", "b", "Delta_w", "Delta_v"]
    assert draws["B"].dims == ("chain", "draw", "feature", "robot", "robot_")
    assert coupled["latent"]["trust"].sizes["mission"] == 6
    mean = draws.to_dataset().mean(("chain", "draw"))
    diagonal = np.diag(mean["B0"].values)
    assert (np.abs(mean["B0"].values - np.diag(diagonal)) < 0.15).all()  # shrunk, and truly 0
    assert (np.abs(diagonal - 0.6) < 0.25).all()
    az.summary(coupled)
    assert isinstance(params_of(coupled), CoupledParams)
    require_trust_followed_in_real_time(coupled, CoupledTrust(), missions[0])


def require_trust_followed_in_real_time(posterior, model, mission):
    """Each draw's filter is the Kalman filter, and draws are weighted by their likelihood."""
    live = TrustFilter(posterior, max_draws=3)
    for z, y in zip(mission.awareness, mission.contact_rate, strict=True):
        state = live.update(z, y)
    log_weight = model.log_likelihood(live.params, [mission])[:, 0]
    weight = np.exp(log_weight - log_weight.max())
    np.testing.assert_allclose(live.weights, weight / weight.sum(), rtol=1e-8)
    means = []
    for i in range(3):
        p = live.params.draw(i)
        with jax.enable_x64(True):
            ssm = p.ssm(jnp.asarray(mission.awareness[None]))
            filtered = ssm.filter(jnp.swapaxes(jnp.asarray(mission.contact_rate[None]), 0, 1))
            means.append(np.asarray(filtered.mean[-1, 0]))
    np.testing.assert_allclose(state.mean, live.weights @ np.array(means), rtol=1e-8)
    ahead = live.predict(mission.awareness[:2])
    nothing = live.update(mission.awareness[0], np.full(3, np.nan))
    np.testing.assert_allclose(ahead.mean[0], nothing.mean, rtol=1e-10)
    np.testing.assert_allclose(ahead.sd[0], nothing.sd, rtol=1e-10)


@pytest.mark.filterwarnings("ignore:Estimated shape parameter of Pareto")  # 6 missions
def test_families_are_compared_on_equal_terms_and_predict_in_their_own():
    """One test, not three: two workers would sample the posteriors twice."""
    missions = counted_missions()
    families = {"gaussian": fit(missions, PooledTrust(), sampler="exact")} | {
        family: fit(missions, PooledTrust(observation=family))
        for family in ("censored", "beta_binomial")
    }
    require_equal_terms(families)
    require_trust_beyond_the_ends(families)
    require_predicted_counts(families["beta_binomial"])


def require_equal_terms(families):
    for family, posterior in families.items():
        assert diagnostics(posterior)["k_hat"] <= 0.7, family
        assert posterior.attrs["log_likelihood_of"] == "ticks"
        # Probabilities of counts: none can be positive.
        assert float(posterior["log_likelihood"]["contact_rate"].max()) < 0.0
    table = az.compare(families)
    # A third of the rates are at the ends, cut off from a Gaussian: censored is the truth.
    assert table.index[0] == "censored"


def require_trust_beyond_the_ends(families):
    posterior = families["censored"]
    rates = posterior["observed_data"]["contact_rate"]
    trust = posterior["latent"]["trust_mean"]
    gaussian = families["gaussian"]["latent"]["trust_mean"]
    full = rates == 1.0
    assert float(trust.where(full).mean()) > float(gaussian.where(full).mean()) + 0.02
    predicted = posterior["posterior_predictive"]["contact_rate"]
    assert float(predicted.min()) == 0.0
    assert float(predicted.max()) == 1.0
    sampled = posterior["latent"]["trust"].mean(("chain", "draw"))
    bound = 6 * posterior["latent"]["trust_sd"] / np.sqrt(200)
    assert (np.abs(sampled - trust) < bound).all()


def require_predicted_counts(posterior):
    predicted = posterior["posterior_predictive"]["contact_rate"] * N
    np.testing.assert_allclose(predicted, np.round(predicted), atol=1e-9)
    share = float((predicted / N).mean())
    assert abs(share - float(posterior["observed_data"]["contact_rate"].mean())) < 0.05


@pytest.mark.parametrize("name", MODELS)
def test_the_prior_predicts_in_one_call(name):
    z = np.random.default_rng(0).uniform(size=(2, 4, 3, 2))
    tree = prior_predictive(MODELS[name], z, n_ticks=N, n_draws=50)
    assert tree["prior_predictive"]["contact_rate"].sizes["draw"] == 50
    assert set(tree["prior"].data_vars) == set(MODELS[name].dims)
    assert np.isfinite(tree["prior_predictive"]["contact_rate"].values).all()


# Every pair of a model, a number of robots and one of features: each case compiles its own program.
@pytest.mark.parametrize(
    ("name", "n_robots", "n_features"),
    [
        *(("pooled", 1, 1), ("hierarchical", 2, 4)),
        *fast([("coupled", 2, 1), ("pooled", 2, 4), ("hierarchical", 1, 1), ("coupled", 1, 4)]),
    ],
)
def test_any_number_of_robots_and_features(name, n_robots, n_features):
    model = MODELS[name]
    rng = np.random.default_rng(0)
    mission = Mission.from_arrays(
        [(0, k) for k in range(4)],
        rng.uniform(size=(3, n_robots, n_features)),
        rng.uniform(size=(3, n_robots)),
    )
    params = sample_prior(model, n_features, 5, 0, n_robots=n_robots)
    found = model.log_likelihood(params, [mission])
    assert found.shape == (5, 1)
    assert np.isfinite(found).all()
    backwards = params._replace(**{n: v[::-1] for n, v in params._asdict().items() if np.ndim(v)})
    np.testing.assert_allclose(model.log_likelihood(backwards, [mission]), found[::-1])
    one = params.draw(2)
    sample = model.simulate(jax.random.key(0), one, mission.awareness[None])
    assert sample.trust.shape == (1, 3, n_robots)


def test_priors_by_feature():
    by_feature = Priors(beta=dist.Normal(np.array([1.0, -1.0]), np.array([0.1, 0.2])))
    assert by_feature.describe()["beta"] == "Normal(loc=[1, -1], scale=[0.1, 0.2])"
    drawn = sample_prior(PooledTrust(by_feature), 2, 2000, 0).beta
    np.testing.assert_allclose(drawn.mean(0), [1.0, -1.0], atol=0.02)
    posterior = fit(simulate_missions(2), PooledTrust(by_feature), sampler="exact")
    mean = posterior["posterior"]["beta"].mean(("chain", "draw")).values
    assert mean[0] > mean[1]


def test_priors_of_the_wrong_support_are_named():
    with pytest.raises(TrustboError, match=r"Priors.delta_w is a standard deviation"):
        Priors(delta_w=dist.Normal(0.0, 1.0))
    with pytest.raises(TrustboError, match=r"Priors.tau is a standard deviation"):
        Priors(tau=dist.Uniform(-1.0, 1.0))
    with pytest.raises(TrustboError, match=r"Priors.concentration must be positive"):
        Priors(concentration=0.0)
    with pytest.raises(TrustboError, match=r"Priors.b must be a scalar"):
        Priors(b=dist.Normal(np.zeros(2), 1.0))


def test_covariances_and_sizes_that_do_not_fit_are_named():
    rng = np.random.default_rng(0)
    params, missions = coupled_params(rng), simulate_missions(1)
    model = CoupledTrust()
    singular = params._replace(Delta_w=np.ones((3, 3)))
    with pytest.raises(
        TrustboError, match=r"params.Delta_w must be positive definite; its smallest"
    ):
        model.log_likelihood(singular, missions)
    lopsided = params.Delta_v.copy()
    lopsided[0, 1] += 1.0
    with pytest.raises(TrustboError, match=r"params.Delta_v must be symmetric"):
        model.log_likelihood(params._replace(Delta_v=lopsided), missions)
    with pytest.raises(
        ShapeError, match=r"params.Delta_w must end in the axes .* got shape \(3, 2\)"
    ):
        model.log_likelihood(params._replace(Delta_w=np.ones((3, 2))), missions)
    with pytest.raises(ShapeError, match=r"params.B has 4 weights, but awareness has 2 features"):
        model.log_likelihood(coupled_params(rng, m=4), missions)
    with pytest.raises(ShapeError, match=r"params.B is of 2 robots, but the missions have 3"):
        model.log_likelihood(coupled_params(rng, n=2), missions)
    with pytest.raises(ShapeError, match="no missions"):
        model.log_likelihood(params, [])
    with pytest.raises(TrustboError, match="unknown inter_robot 'half'; choose one of full, none"):
        CoupledTrust(inter_robot="half")
    with pytest.raises(TrustboError, match=r"priors must be a trustbo.models.Priors; got 3"):
        PooledTrust(3)
    with pytest.raises(TrustboError, match="model must be a trust model"):
        fit(missions, "pooled")
    with pytest.raises(TrustboError, match=r'"exact" cannot treat CoupledTrust.*influence'):
        fit(missions, CoupledTrust(observation="censored"), sampler="exact")
