"""The exact sampler: its likelihood, its draws, its evidence, and when it steps aside."""

import importlib

import numpy as np
import numpyro.distributions as dist
import pytest
from missions import TRUTH, random_missions, random_params, simulate_missions
from references import dense_log_likelihood, pooled_posterior
from scipy import stats
from scipy.interpolate import PchipInterpolator

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference import diagnostics, fit
from trustbo.inference.evidence.gram import sufficient_statistics
from trustbo.inference.evidence.statistics import gather
from trustbo.inference.samplers.exact import backward, forward, sample_exact, small_cholesky
from trustbo.models import CoupledTrust, PooledTrust, Priors, TrustParams
from trustbo.stacking import stack_missions


@pytest.mark.parametrize("seed", range(10))
def test_the_quadratic_form_is_the_dense_joint_normal(seed):
    """Complete missions by sine transform, those with gaps by the filter, both at once."""
    rng = np.random.default_rng(seed)
    missions = random_missions(rng, 4, missing=0.3 * (seed % 2))
    draws = [random_params(rng)._replace(x0_mean=0.4, x0_sd=0.3 * (seed % 3)) for _ in range(3)]
    statistics = sufficient_statistics(stack_missions(missions), 0.4)
    theta = np.array([[p.beta0, p.delta_w**2, p.delta_v**2] for p in draws])
    q = statistics.evaluate(theta, 0.3 * (seed % 3))
    for i, p in enumerate(draws):
        c = np.append(p.beta, p.b)
        found = -0.5 * (q.alpha[i] - 2 * c @ q.h[i] + c @ q.P[i] @ c + q.log_det[i])
        found -= 0.5 * statistics.n_measured * np.log(2 * np.pi)
        expected = sum(
            dense_log_likelihood(*p[:7], m.awareness[:, r], m.contact_rate[:, r])
            for m in missions
            for r in range(3)
        )
        np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_exact_draws_are_those_of_a_quadrature(seed):
    missions = simulate_missions(6, seed)
    statistics = sufficient_statistics(stack_missions(missions), 0.5)
    exact = sample_exact(statistics, Priors(), 4000, seed).params
    on_grid, (mean, sd, weight) = pooled_posterior(missions)
    laws = {}
    for name, (points, share) in zip(("beta0", "delta_w", "delta_v"), on_grid, strict=True):
        edges = np.r_[0.0, points + points[0]]  # points are midpoints
        below = np.r_[0.0, np.cumsum(share)]
        moments = share @ points, np.sqrt(share @ points**2 - (share @ points) ** 2)
        laws[name] = exact[name], *moments, PchipInterpolator(edges, below)
    likely = weight > 1e-8
    for m in range(mean.shape[-1]):
        draws = np.c_[exact["beta"], exact["b"]][:, m]
        centre = (weight * mean[..., m]).sum()
        spread = np.sqrt((weight * (sd[..., m] ** 2 + (mean[..., m] - centre) ** 2)).sum())
        at = np.linspace(centre - 6.0 * spread, centre + 6.0 * spread, 200)
        below = stats.norm.cdf(at[:, None], mean[likely, m], sd[likely, m]) @ weight[likely]
        laws[f"c{m}"] = draws, centre, spread, lambda x, a=at, b=below: np.interp(x, a, b)
    for name, (ours, centre, spread, cdf) in laws.items():
        # Quasi-random points of Kish size > 2000: standard errors below 0.022 sd and 1.6 %.
        # Pareto smoothing thins delta_v's tail to 0 in data set 2, which takes 3 % off its sd.
        assert abs(ours.mean() - centre) < 0.05 * spread, name
        assert abs(np.log(ours.std() / spread)) < 0.048, name
        assert stats.kstest(ours, cdf).pvalue > 0.01, name


def test_the_evidence_is_the_prior_mean_of_the_likelihood():
    (mission,) = simulate_missions(1, lengths=(3,))
    exact = sample_exact(sufficient_statistics(stack_missions([mission]), 0.5), Priors(), 100, 0)
    rng = np.random.default_rng(0)
    n = 200_000
    draws = TrustParams(
        rng.beta(2, 2, n),
        rng.normal(0, 1, (n, 2)),
        rng.normal(0, 0.5, n),
        np.abs(rng.normal(0, 0.2, n)),
        np.abs(rng.normal(0, 0.2, n)),
        0.5,
        0.5,
    )
    likelihood = np.exp(PooledTrust().log_likelihood(draws, [mission])[:, 0])
    se = likelihood.std() / np.sqrt(n) / likelihood.mean()
    # 5 standard errors of the prior average, and 2 % for 4096 Sobol points.
    assert abs(exact.log_evidence - np.log(likelihood.mean())) < 5 * se + 0.02


@pytest.mark.slow  # NUTS compiles for this alone
def test_fit_lays_exact_draws_out_as_it_does_nuts_s(missions, posterior):
    exact = fit(missions, PooledTrust(), sampler="exact", seed=1)
    assert set(exact.children) == set(posterior.children)
    assert exact["posterior"].sizes == posterior["posterior"].sizes
    assert exact["latent"]["trust"].dims == posterior["latent"]["trust"].dims
    assert set(exact["sample_stats"].data_vars) == {"lp", "log_weight"}
    found = diagnostics(exact)
    assert found["k_hat"] < 0.7
    assert found["kish"] > 1000
    again = fit(missions, PooledTrust(), sampler="exact", seed=1)
    np.testing.assert_array_equal(
        exact["posterior"]["beta"].values, again["posterior"]["beta"].values
    )


def test_other_priors_within_reach_move_the_posterior(missions):
    batch = stack_missions(missions)
    priors = Priors(
        beta0=dist.Normal(0.0, 0.05),
        beta=dist.Normal(0.1, 0.01),
        delta_v=dist.LogNormal(-3.0, 0.2),
    )
    exact = sample_exact(sufficient_statistics(batch, 0.5), priors, 2000, 0)
    assert exact.khat < 0.7
    assert abs(exact.params["beta"].mean() - 0.1) < 0.05
    assert exact.params["beta0"].mean() < 0.5  # against a likelihood around 0.6
    assert TRUTH.beta0 == 0.6


def odd(rates):
    """Missions of one column of rates for each robot."""
    rng = np.random.default_rng(5)
    rates = [np.atleast_2d(np.asarray(each, dtype=float)) for each in rates]
    return [
        Mission.from_arrays([(0, k) for k in range(len(y) + 1)], rng.uniform(size=(*y.shape, 2)), y)
        for y in rates
    ]


VAGUE = Priors(beta=dist.Normal(0.0, 1000.0), b=dist.Normal(0.0, 1000.0))
ODD = {
    "equal but for rounding": [np.full((7, 1), 0.7) + 1e-12 * (np.arange(7)[:, None] == 3)] * 2,
    "one rate": [[[0.7]]],
    "two rates": [[[0.7], [0.7 + 1e-12]]],
    "two rates apart": [[[0.1], [0.9]]],
    "one rate in the middle": [np.where(np.arange(5) == 2, 0.7, np.nan)[:, None]],
    "contact but once": [np.where(np.arange(7) == j, 0.3, 1.0)[:, None] for j in (3, 9, 9)],
    "none or all": [(np.arange(12).reshape(6, 2) % 5 < 2) * 1.0] * 2,
}


@pytest.mark.parametrize("priors", [Priors(), VAGUE], ids=["ours", "1e6"])
@pytest.mark.parametrize("name", list(ODD))
def test_odd_data_have_a_posterior(name, priors):
    floored = PooledTrust(priors).at_resolution({})
    statistics = gather(floored, stack_missions(odd(ODD[name])))[0]
    exact = sample_exact(statistics, floored.priors, 1000, 0)
    assert exact.khat < 0.6
    for values in exact.params.values():
        assert np.isfinite(values).all()


def test_a_robot_never_measured_keeps_its_prior_and_one_always_in_contact_has_a_posterior():
    missions = odd([np.c_[np.full(6, np.nan), np.ones(6), y] for y in np.full((3, 6), 0.5)])
    rates = [m.contact_rate.copy() for m in missions]
    for j, y in enumerate(rates):
        y[:, 2] += 0.1 * np.random.default_rng(j).standard_normal(6)
    missions = [
        Mission.from_arrays(m.path, m.awareness, y) for m, y in zip(missions, rates, strict=True)
    ]
    posterior = fit(missions, CoupledTrust(inter_robot="none"), "exact")
    assert posterior.attrs["sampler"] == "exact"
    sites = posterior["posterior"].isel(robot=0)
    floor = stats.halfnorm.cdf(0.005, scale=0.2)
    laws = {
        "beta0": (sites["beta0"], stats.beta(2, 2).cdf),
        "beta": (sites["beta"].isel(feature=0), stats.norm(0, 1).cdf),
        "b": (sites["b"], stats.norm(0, 0.5).cdf),
        "delta_w": (sites["delta_w"], stats.halfnorm(0, 0.2).cdf),
        "delta_v": (
            sites["delta_v"],
            lambda x: (stats.halfnorm.cdf(x, scale=0.2) - floor) / (1 - floor),
        ),
    }
    for name, (draws, cdf) in laws.items():
        # Resampled points repeat: as many independent ones as the Kish size.
        found = stats.kstest(draws.values.ravel(), cdf).statistic
        assert found < 1.95 / np.sqrt(posterior.attrs["kish"]), name  # one chance in a thousand
    assert float(posterior["posterior"]["delta_v"].isel(robot=1).mean()) < 0.02


@pytest.mark.parametrize(
    ("name", "prior", "what"),
    [
        ("b", dist.Cauchy(0.0, 1.0), "a Normal distribution"),
        ("beta0", dist.Uniform(-1.0, 1.0), r"on \(0, 1\) or the real line"),
        ("delta_w", dist.TruncatedNormal(0.0, 0.2, low=0.01), r"on \(0, inf\)"),
    ],
)
def test_priors_out_of_reach_are_named(missions, name, prior, what):
    with pytest.raises(TrustboError, match=f"the prior of {name} to be {what}; got"):
        fit(missions, PooledTrust(Priors(**{name: prior})), sampler="exact")


@pytest.mark.slow  # compiles NUTS
def test_uneven_weights_fall_back_on_nuts_and_say_so(missions, monkeypatch):
    # By its module: the package's `fit` is the function.
    monkeypatch.setattr(
        importlib.import_module("trustbo.inference.samplers.run"), "MAX_KHAT", -10.0
    )
    with pytest.warns(UserWarning, match=r"k-hat -?\d.\d\d, limit -10.0\); NUTS is used"):
        posterior = fit(missions, PooledTrust(), sampler="exact")
    assert posterior.attrs["sampler"] == "nuts"
    assert "r_hat" in diagnostics(posterior)


def test_factors_and_solutions_are_numpy_s_and_one_bad_matrix_spoils_no_other():
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(6, 4, 4))
    A = roots @ roots.mT + 0.1 * np.eye(4)
    A[2] -= 10.0 * np.eye(4)
    good, b = [0, 1, 3, 4, 5], rng.normal(size=(6, 4))
    with np.errstate(invalid="ignore"):
        L = small_cholesky(np.moveaxis(A, 0, -1))
    assert np.isnan(L[..., 2]).any()
    for i in good:
        np.testing.assert_allclose(L[..., i], np.linalg.cholesky(A[i]), atol=1e-12)
    lower = L[..., good]
    solution = backward(lower, forward(lower, b[good].T)).T
    np.testing.assert_allclose(solution, np.linalg.solve(A[good], b[good, :, None])[..., 0])
