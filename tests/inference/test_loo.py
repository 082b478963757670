"""Leaving missions out: against refits without each mission, and joint normals written out."""

import itertools

import arviz as az
import numpy as np
import pytest
from missions import simulate_missions
from scipy import special, stats

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference import compare, fit, loo, params_of
from trustbo.models import HierarchicalTrust, PlaceEffect, PooledTrust, Priors

of_few_missions = pytest.mark.filterwarnings("ignore:Estimated shape parameter of Pareto")
PATHS = (
    [(0, 0), (0, 1), (1, 2), (2, 2)],
    [(0, 0), (0, 1), (0, 2), (1, 2)],
    [(2, 0), (1, 0), (0, 1), (1, 2)],
    [(2, 0), (2, 1), (2, 2), (1, 2)],
)


def missions_with_places(seed=0):
    """Missions of two robots whose bounds have effects larger than the noise."""
    rng, effects, missions = np.random.default_rng(seed), {}, []
    for path in PATHS:
        z = rng.uniform(size=(3, 2, 1))
        bounds = list(itertools.pairwise(path))
        level = [effects.setdefault(bound, 0.3 * rng.standard_normal()) for bound in bounds]
        y = 0.5 + 0.3 * (z[..., 0] - 0.5) + np.array(level)[:, None]
        y = np.clip(y + 0.15 * rng.standard_normal((3, 2)), 0.02, 0.98)
        missions.append(Mission.from_arrays(path, z, y, robots=["a", "b"]))
    return missions


def dense_left_out(missions, priors, place, n=1 << 13):
    """Log p(rates of each mission | others) by joint normals at Sobol points of the prior.

    Coefficients and effects are in the covariance; evidence is the mean density over the points.
    """
    u = stats.qmc.Sobol(6, seed=1).random(n)
    noise = stats.halfnorm(scale=0.2)
    beta0, w, tau_s, tau_e = (
        prior.ppf(u[:, i, None, None])
        for i, prior in enumerate((stats.beta(2.0, 2.0), noise, noise, noise))
    )
    v = noise.isf(u[:, 4, None, None] * noise.sf(0.005))  # the floor where ticks are unknown
    length = place.length_scale * np.exp(place.length_scale_sd * special.ndtri(u[:, 5, None, None]))
    k = np.arange(3)
    T = np.where(k[:, None] >= k, beta0 ** np.maximum(k[:, None] - k, 0), 0.0)
    start = beta0 ** (k[:, None] + 1)
    of_mission = w**2 * T @ T.mT + v**2 * np.eye(3) + priors.x0_sd**2 * start @ start.mT
    bounds = [bound for m in missions for _ in range(2) for bound in itertools.pairwise(m.path)]
    cells = np.array([entered for _, entered in bounds])
    h = np.sqrt(3.0) * np.linalg.norm(cells[:, None] - cells, axis=2) / length
    same = np.array([[one == other for other in bounds] for one in bounds])
    U = np.column_stack([np.concatenate([m.awareness[..., 0].T.ravel() for m in missions]),
                         np.full(len(bounds), 0.5)])  # fmt: skip
    drift = U @ U.T + tau_s**2 * (1.0 + h) * np.exp(-h) + tau_e**2 * same
    blocks = np.kron(np.eye(len(bounds) // 3), np.ones((3, 3)))
    several = (1, len(bounds) // 3, len(bounds) // 3)
    carry = np.tile(T, several) * blocks
    cov = np.tile(of_mission, several) * blocks + carry @ drift @ carry.mT
    y = np.concatenate([m.contact_rate.T.ravel() for m in missions])
    off = y - priors.x0_mean * np.tile(start[..., 0], several[1])
    mission = np.repeat(np.arange(len(missions)), 6)
    whole, *others = (log_mean_density(off[:, kept], cov[:, kept][:, :, kept])
                      for kept in (mission != j for j in range(-1, len(missions))))  # fmt: skip
    return whole - np.array(others)


def log_mean_density(off, cov):
    """Log of the mean of normal densities, nats."""
    quadratic = (off * np.linalg.solve(cov, off[..., None])[..., 0]).sum(1)
    log_p = -0.5 * (quadratic + np.linalg.slogdet(cov)[1] + off.shape[1] * np.log(2.0 * np.pi))
    return np.logaddexp.reduce(log_p) - np.log(len(off))


def test_with_places_loo_is_that_of_joint_normals_where_weights_of_draws_are_optimistic():
    missions, place = missions_with_places(seed=1), PlaceEffect()
    posterior = fit(missions, PooledTrust(place=place), sampler="exact", progress=False)
    expected = dense_left_out(missions, Priors(), place)
    result = loo(posterior)
    # Evidence of 8192 prior points and of some 400 of the sampler: .06 nats together, 4 of these.
    np.testing.assert_allclose(result.elpd_i, expected, atol=0.25)
    assert not result.warning
    refits = result.elpd_i["refitted"].values
    assert 0 < refits.sum() < len(missions)  # both ways are tested
    with pytest.warns(UserWarning, match="Estimated shape parameter of Pareto"):
        assert az.loo(posterior).elpd > expected.sum() + 4.0


@of_few_missions
@pytest.mark.parametrize("robots", ["pooled", "hierarchical"])
def test_a_mission_whose_weights_fail_is_left_out_of_a_refit(robots):
    """One mission noisier than the others: weights of draws cannot follow."""
    missions = simulate_missions(4, lengths=(8,))
    noise = 0.16 * np.random.default_rng(1).standard_normal((8, 3))
    rates = np.clip(missions[2].contact_rate + noise, 0.0, 1.0)
    missions[2] = Mission.from_arrays(missions[2].path, missions[2].awareness, rates)
    model = PooledTrust() if robots == "pooled" else HierarchicalTrust()
    posterior = fit(missions, model, sampler="exact", progress=False)
    result = loo(posterior)
    assert result.elpd_i["refitted"].values[2]
    assert not result.warning
    others = [mission for j, mission in enumerate(missions) if j != 2]
    rest = fit(others, model, sampler="exact", seed=7, n_chains=4, draws=5000, progress=False)
    each = model.log_likelihood(params_of(rest), [missions[2]])[:, 0]
    expected = np.logaddexp.reduce(each) - np.log(len(each))
    # A mean over 20000 draws, some 500 of them effective, and two evidences: .06 nats together.
    assert float(result.elpd_i[2]) == pytest.approx(expected, abs=0.25)


def refitted(missions, weights):
    """Log predictive density of each mission under the posterior of the others."""
    found = []
    for j, left_out in enumerate(missions):
        rest = [i for i in range(len(missions)) if i != j]
        posterior = fit(
            [missions[i] for i in rest],
            PooledTrust(),
            sampler="exact",
            weights=weights[rest],
            seed=1,
        )
        each = PooledTrust().log_likelihood(params_of(posterior), [left_out])[:, 0]
        found.append(np.logaddexp.reduce(each) - np.log(len(each)))
    return np.array(found)


@of_few_missions
@pytest.mark.parametrize("forgetting", [0.6, 1.0])
def test_loo_is_what_refits_without_each_mission_give(forgetting):
    missions = simulate_missions(10, lengths=(8,))
    weights = forgetting ** np.arange(9.0, -1.0, -1.0)
    result = loo(fit(missions, PooledTrust(), sampler="exact", weights=weights))
    expected = refitted(missions, weights)
    good = result.pareto_k.values < 0.5
    assert good.sum() >= 7
    # Importance weights of 4000 draws and refits of 4000: some .05 nats a mission each.
    np.testing.assert_allclose(result.elpd_i.values[good], expected[good], atol=0.25)
    assert abs(result.elpd_i.values[good].sum() - expected[good].sum()) < 0.5


@of_few_missions
def test_where_weights_of_draws_hold_it_is_arviz_s():
    posterior = fit(simulate_missions(8), PooledTrust(), sampler="exact")
    ours, theirs = loo(posterior), az.loo(posterior, pointwise=True)
    held = theirs.pareto_k.values <= theirs.good_k
    assert held.sum() >= 6
    np.testing.assert_array_equal(ours.elpd_i["refitted"], ~held)
    np.testing.assert_allclose(ours.elpd_i[held], theirs.elpd_i[held], rtol=1e-12)
    np.testing.assert_allclose(ours.pareto_k[held], theirs.pareto_k[held])
    assert ours.elpd == pytest.approx(float(ours.elpd_i.sum()), rel=1e-12)


@of_few_missions
def test_arviz_does_not_read_a_weighted_posterior_and_compares_our_results():
    missions, weights = simulate_missions(8), np.linspace(0.0, 1.0, 8)
    aged, other = (
        fit(missions, PooledTrust(), sampler="exact", weights=weights, seed=seed) for seed in (0, 1)
    )
    with pytest.raises(Exception, match=r"log[_ ]likelihood"):
        az.loo(aged)
    # The mission of weight 0 is left out already: its density is a plain average.
    each = aged["mission_log_likelihood"]["contact_rate"].sel(mission=0).values.ravel()
    first = np.logaddexp.reduce(each) - np.log(len(each))
    assert float(loo(aged).elpd_i[0]) == pytest.approx(first, rel=1e-9)
    assert set(az.compare({"a": loo(aged), "b": loo(other)}).index) == {"a", "b"}


@of_few_missions
def test_a_mission_without_rates_is_left_out_of_the_sum():
    missions = simulate_missions(6)
    nothing = np.full_like(missions[2].contact_rate, np.nan)
    missions[2] = Mission.from_arrays(missions[2].path, missions[2].awareness, nothing)
    result = loo(fit(missions, PooledTrust(), sampler="exact"))
    assert result.n_data_points == 5
    assert result.elpd_i["mission"].values.tolist() == [0, 1, 3, 4, 5]
    alone = fit(missions[1:3], PooledTrust(), sampler="exact")
    with pytest.raises(TrustboError, match="one of several missions; 1 of 2 have rates"):
        loo(alone)


@of_few_missions
def test_compare_ranks_as_arviz_does_and_refuses_other_missions():
    missions = simulate_missions(8)
    fits = {
        "level": fit(missions, PooledTrust(), sampler="exact"),
        "wide": fit(missions, PooledTrust(Priors(x0_sd=3.0)), sampler="exact"),
    }
    table, theirs = compare(fits), az.compare({name: loo(tree) for name, tree in fits.items()})
    assert list(table.index) == list(theirs.index)
    np.testing.assert_allclose(table["elpd_diff"], theirs["elpd_diff"], atol=1e-9)
    with pytest.raises(TrustboError, match="'fewer' and 'level' are posteriors of different"):
        compare(
            {"level": fits["level"], "fewer": fit(missions[:5], PooledTrust(), sampler="exact")}
        )
    with pytest.raises(TrustboError, match="two or more posteriors by name"):
        compare({"level": fits["level"]})
