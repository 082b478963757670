"""Effects of places against dense joint normals, which share no code with them."""

import itertools
from importlib import import_module

import jax
import numpy as np
import numpyro.distributions as dist
import pytest
import xarray as xr
from missions import walking_missions
from references import DenseOfPlaces
from scipy import stats

import trustbo as tb
from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference import complete, fit, params_of
from trustbo.inference.place_maps import PlaceScales, draw_maps, nowhere, place_group, place_maps_of
from trustbo.inference.samplers import scores
from trustbo.inference.samplers.importance import sample_scores
from trustbo.inference.samplers.posterior import posterior_of
from trustbo.models import CoupledTrust, HierarchicalTrust, PlaceEffect, PooledTrust, TrustParams
from trustbo.models.effects.effect import Slots
from trustbo.models.place import bounds_of, visited
from trustbo.models.priors import Priors

SHAPE = (5, 5)
PLACES = [
    PlaceEffect(),
    PlaceEffect(bounds=False),
    PlaceEffect(cells=False),
    PlaceEffect(shared=False),
]


def walk(rng, n_bounds):
    """Random walk over neighbouring cells."""
    cells = [tuple(rng.integers(SHAPE).tolist())]
    while len(cells) <= n_bounds:
        row, col = np.array(cells[-1]) + rng.integers(-1, 2, size=2)
        if 0 <= row < SHAPE[0] and 0 <= col < SHAPE[1] and (row, col) != cells[-1]:
            cells.append((int(row), int(col)))
    return cells


def random_missions(seed, n_missions=4, missing=0.2):
    return walking_missions(seed, n_missions, n_bounds=(4, 9), missing=missing)


NAMES = ("beta0", "delta_w", "delta_v", "tau_s", "length_scale", "tau_e")
ABSENT = {"tau_s": 0.0, "length_scale": 1.0, "tau_e": 0.0}


def target_of(missions, place, priors=None, family="gaussian", weight=None):
    """Posterior of the scores, by the evidence of a family."""
    batch = tb.stacking.stack_missions(missions)
    places = visited(bounds_of(missions, batch.contact_rate.shape[:2]), place, 3, SHAPE)
    slots = Slots.of(batch, len(missions), (), weight, places)
    return posterior_of(PooledTrust(priors or Priors(), family, place=place), slots)


def thetas(target, z):
    """Hyperparameters (point, 6) of scores."""
    theta = ABSENT | target.scores.theta(z)
    return np.stack([np.broadcast_to(theta[name], len(z)) for name in NAMES], axis=1)


@pytest.mark.parametrize("stationary", [False, True])
@pytest.mark.parametrize("place", PLACES, ids=str)
def test_the_marginal_likelihood_is_that_of_a_dense_joint_normal(place, stationary):
    priors = Priors(stationary=stationary)
    for seed in range(3):
        missions = random_missions(seed)
        target = target_of(missions, place, priors)
        rng = np.random.default_rng(seed)
        z = 0.7 * rng.standard_normal((4, target.n_scores))
        dense = [DenseOfPlaces(missions, place, theta, priors) for theta in thetas(target, z)]
        expected = scores.log_prior(z) + [each.log_likelihood() for each in dense]
        np.testing.assert_allclose(target.log_density(z), expected, rtol=1e-9)
        # No rate is at a limit: expectation propagation is exact.
        latent = target_of(missions, place, priors, "censored")
        np.testing.assert_allclose(latent.log_density(z), expected, rtol=1e-8)


@pytest.mark.parametrize("family", ["gaussian", "censored"])
@pytest.mark.parametrize("score", [-3000.0, -1450.0, 1450.0, 3000.0])
def test_a_length_scale_that_underflows_is_one_of_independent_cells(score, family):
    """Newton's search for the mode looks so far out, where exp is 0, denormal or infinite."""
    target = target_of(random_missions(0), PlaceEffect(), family=family)
    z = np.zeros((2, target.n_scores))
    z[:, 4] = score, 40.0 * np.sign(score)  # a length scale of 1e-9 cells, or of 1e9
    far, near = target.log_density(z) + 0.5 * z[:, 4] ** 2
    assert far == pytest.approx(near, abs=1e-6)


def test_a_mission_of_weight_one_half_counts_by_the_root_of_its_density():
    """With no effect in common, densities of missions multiply."""
    zero = dist.Normal(0.0, 1e-9)
    priors = Priors(beta=zero, b=zero)
    one, other = (random_missions(seed, 1) for seed in (3, 4))
    values = dict(zip((*NAMES, "rest"), (0.4, 0.1, 0.2, 0.0, 2.0, 0.0, 0.6), strict=True))
    theta = {name: np.array([value]) for name, value in values.items()}
    found = []
    for missions, weight in ((one, [1.0]), (other, [1.0]), (one + other, [1.0, 0.5])):
        target = target_of(missions, PlaceEffect(), priors, weight=np.array(weight))
        found.append(target.evidence.log_density(theta))
    np.testing.assert_allclose(found[2], found[0] + 0.5 * found[1], atol=1e-6)


@pytest.mark.parametrize("place", PLACES[:3], ids=str)
def test_effects_given_hyperparameters_are_those_of_dense_conditioning(place):
    """Moments of draws, those of cells and of bounds apart."""
    missions, n = random_missions(1), 20_000
    target = target_of(missions, place)
    z = np.array([[0.2, -0.5, 0.3, 0.4, 0.1, 0.2][: target.n_scores]])
    dense = DenseOfPlaces(missions, place, thetas(target, z)[0], Priors())
    drawn, _ = target.draw(z, np.zeros(1), np.zeros(n, dtype=int), np.random.default_rng(0))
    there = visited(bounds_of(missions), place, 3, SHAPE)
    moves = {tuple(m): i for i, m in enumerate(tb.workspace.moves.MOVES[8])}
    units, cells = there.units[:, 1:].tolist(), there.cells[:, 1:].tolist()
    expected = {"c": (dense.c_cov @ dense.U.T, dense.c_cov, dense.c_mean)}
    found = {"c": np.column_stack([drawn["beta"], drawn["b"]])}
    if place.cells:
        index = [cells.index(list(c)) for *_, c in dense.rows]
        found["s"], expected["s"] = drawn["place"][:, index], (dense.K_s, dense.K_s, 0.0)
    if place.bounds:
        index = [
            units.index([moves[tuple(np.subtract(c, a).tolist())], *c]) for _, a, c in dense.rows
        ]
        found["e"], expected["e"] = drawn["place_bound"][:, index], (dense.K_e, dense.K_e, 0.0)
    for name, draws in found.items():
        mean, cov = dense.posterior(*expected[name])
        sd = np.sqrt(np.diag(cov))
        # 5.5 standard errors, of some 70 means and 5000 products.
        assert (np.abs(draws.mean(0) - mean) < 5.5 * sd / np.sqrt(n)).all(), name
        correlation = cov / np.outer(sd, sd)
        error = np.sqrt((1.0 + correlation**2) / n)
        white = (draws - mean) / sd
        assert (np.abs(white.T @ white / n - correlation) < 5.5 * error).all(), name


def test_maps_are_those_of_dense_conditioning():
    n, rng = 20000, np.random.default_rng(0)
    place = PlaceEffect()
    places = visited(bounds_of(random_missions(5)), place, 3, SHAPE)
    ell = np.exp(0.7)  # one of the steps that length scales are rounded to
    scales = PlaceScales(np.full(n, 0.3), np.full(n, ell), np.full(n, 0.1))
    known = 0.2 * rng.standard_normal(len(places.cells))
    e = np.tile(0.1 * rng.standard_normal(len(places.units)), (n, 1))
    s, of_bounds = draw_maps(scales, places, np.tile(known, (n, 1)), e, 1)
    grid, cells = np.indices(SHAPE).reshape(2, -1).T, places.cells[:, 1:]

    def kernel(a, b):
        h = np.sqrt(3.0) * np.linalg.norm(a[:, None] - b[None], axis=2) / ell
        return 0.09 * (1.0 + h) * np.exp(-h)

    gain = np.linalg.solve(kernel(cells, cells), kernel(cells, grid)).T
    covariance = kernel(grid, grid) - gain @ kernel(cells, grid)
    flat = s.reshape(n, -1)
    np.testing.assert_allclose(flat.mean(0), gain @ known, atol=1e-8)  # centred, hence exact
    # An entry of a covariance of 20 000 draws has a standard error of .0009 at most.
    np.testing.assert_allclose(np.cov(flat.T), covariance, atol=5 * 0.0009)
    np.testing.assert_array_equal(of_bounds[:, *places.units.T], e)
    free = np.ones(of_bounds.shape[1:], bool)
    free[*places.units.T] = False
    np.testing.assert_allclose(of_bounds[:, free].mean(0), 0.0, atol=1e-12)
    np.testing.assert_allclose(of_bounds[:, free].std(0), 0.1, rtol=5 * 0.005)


@pytest.mark.parametrize("place", PLACES, ids=str)
def test_place_maps_are_the_moments_of_the_drawn_maps(place):
    n, rng = 5000, np.random.default_rng(0)
    places = visited(bounds_of(random_missions(5, 2)), place, 3, SHAPE)
    ell = np.exp(rng.choice([0.2, 0.7], n))  # two of the steps that length scales are rounded to
    sites = {
        "beta0": np.full(n, 0.3), "tau_s": rng.uniform(0.1, 0.3, n), "length_scale": ell,
        "tau_e": rng.uniform(0.1, 0.3, n),
    }  # fmt: skip
    sites = {name: sites[name] for name in ("beta0", *place.names)}
    on, sizes = (
        (place.cells, place.bounds),
        {"place": len(places.cells), "place_bound": len(places.units)},
    )
    sizes = {name: sizes[name] for name, yes in zip(sizes, on, strict=True) if yes}
    draws = {name: 0.2 * rng.standard_normal((1, n, size)) for name, size in sizes.items()}
    group = place_group(draws, places, 1)
    robots = {"contact_rate": ("robot", np.zeros(3))}
    posterior = xr.DataTree.from_dict(
        {
            "posterior": xr.Dataset({k: (("chain", "draw"), v[None]) for k, v in sites.items()}),
            "places": group,
            "observed_data": xr.Dataset(robots, {"robot": ["a", "b", "c"]}),
        }
    )
    maps, drawn = tb.inference.place_maps(posterior), place_maps_of(group, sites)
    assert set(maps) == {f"{name}_{kind}" for name in draws for kind in ("mean", "sd")}
    assert ("robot" in maps.dims) is not place.shared
    for name, expected in drawn.items():
        if expected is None:
            continue
        mean, sd = (maps[f"{name}_{kind}"].values for kind in ("mean", "sd"))
        there = np.isfinite(mean)
        assert there.mean() == pytest.approx(1.0 if name == "place" else 144 / 200)
        expected = expected if not place.shared else expected[:, 0]
        # Means of the drawn maps have no Monte Carlo error.
        np.testing.assert_allclose(mean[there], expected.mean(0)[there], atol=1e-9)
        # A standard deviation of n draws has a relative standard error of 1 / sqrt(2 n), and some
        # more as tails of mixtures are heavier.
        np.testing.assert_allclose(sd[there], expected.std(0)[there], rtol=6 / np.sqrt(2 * n))
    if place.bounds:
        assert maps["move"].values.tolist() == ["nw", "n", "ne", "w", "e", "sw", "s", "se"]
        assert np.isnan(maps["place_bound_mean"].sel(row=0, move="s")).all()  # from row -1


@pytest.fixture(scope="module")
def learned():
    """Missions over a true map of effects, and the posterior of a model that learns it."""
    rng = np.random.default_rng(0)
    truth = TrustParams(0.2, np.array([0.2, 0.1]), 0.4, 0.03, 0.03)
    maps = draw_maps(
        PlaceScales(*np.array([[0.1], [2.0], [0.1]])), nowhere(SHAPE, 1),
        np.zeros((1, 0)), np.zeros((1, 0)), 3,
    )  # fmt: skip
    truth = truth._replace(place=maps[0][0], place_bound=maps[1][0])
    missions = []
    for j in range(12):
        path, z = walk(rng, 8), rng.uniform(size=(8, 3, 2))
        bounds = np.column_stack([tb.workspace.moves.moves_along(path), np.array(path)[1:]])
        sample = PooledTrust().simulate(jax.random.key(j), truth.on(bounds[None]), z[None])
        missions.append(Mission.from_arrays(path, z, np.clip(sample.contact_rate[0], 0.0, 1.0)))
    workspace = tb.Workspace.from_awareness(rng.uniform(size=(3, *SHAPE, 2)))
    posterior = fit(missions, PooledTrust(place=PlaceEffect()), workspace=workspace)
    return workspace, missions, truth, posterior


def test_effects_of_visited_bounds_are_learned(learned):
    _, missions, truth, posterior = learned
    assert posterior.attrs["sampler"] == "exact"
    params, bounds = params_of(posterior), bounds_of(missions)
    drawn, true = (p.of_places(bounds.reshape(-1, 3))[..., 0] for p in (params, truth))
    # The level is the intercept's as well: effects are compared with their mean taken away.
    drawn, true = drawn - drawn.mean(-1, keepdims=True), true - true.mean()
    error = (drawn.mean(0) - true) / drawn.std(0)
    assert np.corrcoef(drawn.mean(0), true)[0, 1] > 0.95
    assert (np.abs(error) < 1.645).mean() == pytest.approx(0.9, abs=0.1)
    none = fit(missions, PooledTrust())
    assert posterior.attrs["log_evidence"] > none.attrs["log_evidence"] + 50.0


def test_a_filter_over_a_mission_follows_its_places(learned):
    """After the last bound, trust is that of a dense posterior given one draw."""
    _, missions, _, posterior = learned
    params, mission = params_of(posterior), missions[0]
    one = params.draw(np.array([7]))
    live = tb.inference.TrustFilter(one, 3)
    for k in range(len(mission.bounds)):
        live.update(mission.awareness[k], mission.contact_rate[k], mission.path[k : k + 2])
    effect = one.of_places(bounds_of([mission])[0])[0, :, 0]
    x, P = float(one.x0_mean), float(one.x0_sd) ** 2
    for k, z in enumerate(mission.awareness[:, 0]):
        x = one.beta0[0] * x + z @ one.beta[0] + one.b[0] + effect[k]
        P = one.beta0[0] ** 2 * P + one.delta_w[0] ** 2
        gain = P / (P + one.delta_v[0] ** 2)
        x, P = x + gain * (mission.contact_rate[k, 0] - x), (1.0 - gain) * P
    assert live.state.mean[0] == pytest.approx(x, rel=1e-10)
    assert live.state.sd[0] == pytest.approx(np.sqrt(P), rel=1e-10)
    with pytest.raises(TrustboError, match="say which 2 cells"):
        live.update(mission.awareness[0], mission.contact_rate[0])


def test_an_earlier_posterior_changes_the_way_and_not_the_result(learned):
    workspace, missions, _, posterior = learned
    model = PooledTrust(place=PlaceEffect())
    warm = fit(missions, model, workspace=workspace, earlier=posterior, whole=False)
    for name in ("beta0", "b", "tau_e"):
        draws, others = (p["posterior"][name].values for p in (posterior, warm))
        assert abs(draws.mean() - others.mean()) < 0.15 * draws.std()
    again = fit(missions, model, workspace=workspace, earlier=posterior, whole=False)
    np.testing.assert_array_equal(warm["places"]["place"], again["places"]["place"])


@pytest.mark.slow  # NUTS on all hyperparameters, effects integrated out by dense algebra
def test_the_exact_sampler_agrees_with_nuts(learned):
    workspace, missions, _, _ = learned
    model = PooledTrust(place=PlaceEffect(cells=False))
    exact = fit(missions[:4], model, workspace=workspace, whole=False)
    nuts = fit(missions[:4], model, "nuts", workspace=workspace, whole=False)
    for group in ("posterior", "places"):
        for name, draws in exact[group].data_vars.items():
            other = nuts[group][name]
            shift = (draws.mean(("chain", "draw")) - other.mean(("chain", "draw"))).values
            sd = draws.std(("chain", "draw")).values
            # 4 standard errors of both, NUTS with some 800 effective draws, and smoothing.
            assert np.abs(shift / sd).max() < 0.25, name
            ratio = other.std(("chain", "draw")).values / sd
            assert np.abs(ratio - 1.0).max() < 0.15, name


def test_the_exact_sampler_agrees_with_a_quadrature():
    """Hyperparameters by Sobol points of their prior, then of a Student-t at these' moments."""
    rng, missions = np.random.default_rng(5), []
    for _ in range(2):
        path, z = walk(rng, 8), rng.uniform(size=(8, 3, 2))
        noise = 0.15 * rng.normal(size=(8, 1)) + 0.05 * rng.normal(size=(8, 3))
        rate = np.clip(0.3 + 0.3 * z[..., 0] + noise, 0.0, 1.0)
        missions.append(Mission.from_arrays(path, z, rate))
    target = target_of(missions, PlaceEffect())
    d = target.n_scores
    uniform = [stats.qmc.Sobol(d + k, seed=k).random_base2(13) for k in (0, 1)]
    z = stats.norm.ppf(uniform[0])
    weight = np.exp(target.log_density(z) - stats.norm.logpdf(z).sum(1))
    center, cov = np.average(z, axis=0, weights=weight), np.cov(z.T, aweights=weight)
    normal, size = stats.norm.ppf(uniform[1][:, :d]), 5.0 / stats.chi2(5).ppf(uniform[1][:, d])
    z = center + np.sqrt(1.5 * size)[:, None] * normal @ np.linalg.cholesky(cov).T
    proposal = stats.multivariate_t(center, 1.5 * cov, df=5)
    weight = np.exp(target.log_density(z) - proposal.logpdf(z))
    assert weight.sum() ** 2 / (weight**2).sum() > 1500
    theta = thetas(target, z)
    mean = np.average(theta, axis=0, weights=weight)
    sd = np.sqrt(np.average((theta - mean) ** 2, axis=0, weights=weight))
    drawn = [sample_scores(target, 4000, seed).draws.params for seed in range(3)]
    for k, name in enumerate(NAMES):
        values = np.concatenate([np.ravel(draws[name]) for draws in drawn])
        # The quadrature's own error is .026 sd, that of 10 000 draws .01; skew tails double them.
        assert abs(values.mean() - mean[k]) < 0.06 * sd[k], name
        assert abs(values.std() / sd[k] - 1.0) < 0.05, name


def test_rates_within_the_limits_have_the_gaussian_effects_of_places():
    """Draws by expectation propagation and its weights, against those of the exact marginal."""
    missions = random_missions(5, n_missions=5, missing=0.0)
    rng, place = np.random.default_rng(0), PlaceEffect()
    missions = [
        Mission.from_arrays(m.path, m.awareness, rng.normal(0.5, 0.1, m.contact_rate.shape))
        for m in missions
    ]
    exact = target_of(missions, place)
    latent = target_of(missions, place, family="censored")
    theirs = sample_scores(exact, 2000, 0).draws
    ours = [sample_scores(latent, 1000, seed).draws for seed in range(3)]
    assert max(one.khat for one in ours) < 0.7
    # Weights of a wide proposal of 26 effects and 3 coefficients: even to a third.
    assert min(one.kish for one in ours) > 80
    evidence = np.mean([one.log_evidence for one in ours])
    assert abs(evidence - theirs.log_evidence) < 0.15
    for name, draws in theirs.params.items():
        drawn = np.concatenate([one.params[name] for one in ours]).reshape(3000, -1)
        other = draws.reshape(2000, -1)
        gap = (drawn.mean(0) - other.mean(0)) / other.std(0)
        # Three runs of some 120 points, against one of some 300: .08 sd; 4 of it at most.
        assert np.abs(gap).max() < 0.33, name
        assert np.sqrt((gap**2).mean()) < 0.16, name


@pytest.mark.parametrize("family", ["censored", "beta_binomial"])
def test_families_have_effects_of_places(family):
    rng = np.random.default_rng(3)
    missions = []
    for _ in range(6):
        path = walk(rng, 6)
        z = rng.uniform(size=(6, 3, 2))
        mean = 0.7 + 0.4 * (np.array(path[1:])[:, :1] > 2) + 0.1 * rng.standard_normal((6, 3))
        rates = np.round(np.clip(mean, 0.0, 1.0) * 20) / 20
        missions.append(Mission.from_arrays(path, z, rates, n_ticks=np.full((6, 3), 20)))
    model = PooledTrust(observation=family, place=PlaceEffect())
    bare = fit(missions, model, draws=100, whole=False)
    assert bare.attrs["sampler"] == "exact"
    whole = complete(bare)
    assert whole["latent"]["trust_mean"].notnull().all()
    place = params_of(whole).flat().place.mean((0, 1))
    cells = np.array(sorted({c for m in missions for c in m.path[1:]}))
    south = cells[:, 0] > 2
    assert place[tuple(cells[south].T)].mean() > place[tuple(cells[~south].T)].mean()
    again = fit(missions, model, earlier=bare, draws=100, whole=False)
    for name in ("beta0", "delta_w", "b"):
        one, other = (p["posterior"][name].values for p in (bare, again))
        assert abs(one.mean() - other.mean()) < 0.4 * one.std()


def test_places_that_cannot_be_are_named():
    bare = xr.DataTree.from_dict({"posterior": xr.Dataset()})
    with pytest.raises(TrustboError, match=r"no maps of them; fit a model with place=PlaceEffect"):
        tb.inference.place_maps(bare)
    missions = random_missions(0)
    small = tb.Workspace.from_awareness(np.full((3, 2, 2, 2), 0.5))
    model = PooledTrust(place=PlaceEffect())
    with pytest.raises(TrustboError, match=r"outside the grid of 2 rows and 2 columns"):
        fit(missions, model, workspace=small)
    z = np.full((2, 3, 2), 0.5)
    jump = Mission.from_arrays([(0, 0), (0, 3), (0, 4)], z, z[..., 0])
    with pytest.raises(TrustboError, match=r"no bound leads from \(0, 0\) to \(0, 3\).*place=None"):
        fit([jump], model)
    with pytest.raises(TrustboError, match="effect of cells or of bounds"):
        PlaceEffect(cells=False, bounds=False)
    with pytest.raises(TrustboError, match=r"PlaceEffect.tau_s must be"):
        PlaceEffect(tau_s=0.0)
    with pytest.raises(TrustboError, match="place must be a PlaceEffect"):
        PooledTrust(place=True)
    apart = CoupledTrust(inter_robot="none", place=PlaceEffect())
    with pytest.raises(TrustboError, match=r'"exact" cannot treat CoupledTrust.*nothing else in'):
        fit(missions, apart, "exact")
    with pytest.raises(TrustboError, match='need inter_robot="none"'):
        tb.models.CoupledTrust(place=PlaceEffect())


def test_places_by_nuts_are_said_to_take_minutes(monkeypatch):
    class BegunError(Exception):
        """Sampling has begun, of which nothing is needed here."""

    def begin(*args, **options):
        raise BegunError

    monkeypatch.setattr(import_module("trustbo.inference.fit"), "draw_posterior", begin)
    missions = random_missions(0)
    model = CoupledTrust(inter_robot="none", place=PlaceEffect())
    said = pytest.warns(UserWarning, match=r"by NUTS, .* minutes .* PooledTrust\(place=...\)")
    with said, pytest.raises(BegunError):
        fit(missions, model)
    for quick in (
        lambda: fit(missions, model, "nuts"),  # asked for
        lambda: fit(missions, HierarchicalTrust(place=PlaceEffect())),
        lambda: fit(missions, PooledTrust(place=PlaceEffect())),
    ):
        with pytest.raises(BegunError):  # a warning would be an error
            quick()


def test_forgetting_follows_a_place_that_changes():
    """A jam halves contact in one bound from the seventh mission on."""
    rng = np.random.default_rng(1)
    path = [(k, k) for k in range(5)]
    missions = []
    for j in range(12):
        z = np.full((4, 3, 2), 0.5)
        rates = 0.8 + 0.02 * rng.standard_normal((4, 3))
        rates[2] -= 0.4 * (j >= 8)
        missions.append(Mission.from_arrays(path, z, np.clip(rates, 0.0, 1.0)))
    model, found = PooledTrust(place=PlaceEffect(cells=False)), {}
    for forgetting in (1.0, 0.5):
        weights = forgetting ** np.arange(11, -1, -1)
        params = params_of(fit(missions, model, weights=weights, whole=False))
        effect = params.of_places(bounds_of(missions[:1])[0])[..., 0]
        found[forgetting] = (effect[:, 2] - effect[:, [0, 1, 3]].mean(1)).mean()
    # A third of the missions were jammed, and 94 % of what is not forgotten.
    assert found[0.5] < -0.3 < -0.25 < found[1.0]


@pytest.mark.parametrize("objective", ["mean", "lost_contact", "terminal", "success"])
def test_plans_with_effects_of_places_are_the_best_of_all(objective):
    """By enumeration of all admissible paths, the value by its own recursion."""
    rng = np.random.default_rng(3)
    for seed in range(10):
        z = rng.uniform(size=(3, 4, 4, 2))
        workspace = tb.Workspace.from_awareness(z)
        place = 0.2 * rng.standard_normal((1, 4, 4))
        place_bound = 0.2 * rng.standard_normal((1, 8, 4, 4))
        params = TrustParams(
            0.5, rng.uniform(-0.3, 0.3, 2), 0.2, 0.1, 0.1, 0.5, 0.5, place, place_bound
        )
        bounds = "shortest+1" if objective != "success" else 4
        planner = tb.planning.Planner(workspace, (3, 0), (0, 3), objective, max_bounds=bounds)
        plan = planner.plan(params)
        values = []
        for path in walks(4, (3, 0), (0, 3), 4):
            x, trust = 0.5, []
            for a, c in itertools.pairwise(path):
                move = tb.workspace.moves.MOVES[8].index((c[0] - a[0], c[1] - a[1]))
                u = z[:, *c].mean(0) @ params.beta + 0.2 + place[0, *c] + place_bound[0, move, *c]
                if objective == "lost_contact":
                    u = min(u, 0.5)
                x = 0.5 * x + u
                trust.append(x)
            trust = np.array(trust)
            values.append(
                {
                    "mean": trust.mean(),
                    "lost_contact": -(1.0 - trust).sum(),
                    "terminal": 1.0 / (1.0 + np.exp(-trust[-1])),
                    "success": np.prod(1.0 / (1.0 + np.exp(-trust))),
                }[objective]
            )
        assert plan.value == pytest.approx(max(values), abs=1e-9), seed


def walks(n, start, goal, longest):
    """Paths without U-turns from start to goal, which ends them, of at most so many bounds."""
    found, open_paths = [], [(start,)]
    while open_paths:
        path = open_paths.pop()
        for down, right in tb.workspace.moves.MOVES[8]:
            cell = (path[-1][0] + down, path[-1][1] + right)
            inside = 0 <= cell[0] < n and 0 <= cell[1] < n
            if not inside or (len(path) > 1 and cell == path[-2]):
                continue
            if cell == goal:
                found.append((*path, cell))
            elif len(path) < longest:
                open_paths.append((*path, cell))
    return found


@pytest.mark.parametrize("name", ["cells", "bounds", "shared"])
def test_a_switch_of_effects_of_places_is_true_or_false(name):
    with pytest.raises(TrustboError, match=rf"PlaceEffect.{name} must be True or False; got \[1\]"):
        PlaceEffect(**{name: [1]})
