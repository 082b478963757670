"""Leaving missions out: against refits without each mission, and joint normals written out."""

import importlib
import itertools

import arviz as az
import numpy as np
import pytest
from dense_coefficients import DenseRates
from dense_statespace import log_density
from missions import counted_missions, simulate_missions
from scipy import special, stats

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference import compare, fit, loo
from trustbo.inference.loo import good_khat, mean_likelihood, ratio_of_evidence, refit
from trustbo.models import HierarchicalTrust, PlaceEffect, PooledTrust, RobotEffect
from trustbo.models.observations import Observations
from trustbo.workspace.moves import bounds_along

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


def dense_left_out(missions, model, n=1 << 12):
    """Log p(rates of each mission | others) by joint normals at Sobol points of the prior.

    Coefficients and effects are in the covariance; evidence is the mean density over the points.
    """
    u = stats.qmc.Sobol(7, seed=1).random(n).T
    noise = stats.halfnorm(scale=0.2)
    [place] = model.effects
    theta = {
        "beta0": stats.beta(2.0, 2.0).ppf(u[0]),
        "delta_w": noise.ppf(u[1]),
        "tau_s": noise.ppf(u[2]),
        "tau_e": noise.ppf(u[3]),
        "delta_v": np.hypot(noise.ppf(u[4]), 0.005),  # the resolution of unknown ticks
        "tau_r": stats.halfnorm(scale=place.tau_r).ppf(u[6]),
        "length_scale": place.length_scale * np.exp(place.length_scale_sd * special.ndtri(u[5])),
    }
    bounds = np.stack([bounds_along(mission.path) for mission in missions])
    joint = DenseRates(model, Observations.from_missions(missions), theta, bounds)
    moments = joint.mean, joint.cov + joint.noise

    of_mission = np.repeat(np.arange(len(missions)), missions[0].contact_rate.size)
    whole, *others = (
        special.logsumexp(log_density(*moments, np.where(of_mission == j, np.nan, joint.y)))
        for j in range(-1, len(missions))
    )
    return whole - np.array(others)


def test_with_places_loo_is_that_of_joint_normals():
    missions, model = missions_with_places(seed=1), PooledTrust(effects=PlaceEffect())
    posterior = fit(missions, model, progress=False)
    expected = dense_left_out(missions, model)
    result = loo(posterior)
    # Weights of draws are optimistic: in eight seeds, by .26 +- .21 nats for one of these missions.
    np.testing.assert_allclose(result.elpd_i, expected, atol=0.5)
    assert not result.warning


def test_two_missions_are_left_out_by_refits_as_joint_normals_say():
    """Weights of draws are too optimistic by .08 to .46 nats for two missions."""
    missions, model = missions_with_places(seed=2)[:2], PooledTrust(effects=PlaceEffect())
    result = loo(fit(missions, model, progress=False, check=False))
    assert result.elpd_i["refitted"].values.all()
    expected = dense_left_out(missions, model)
    # Evidence of 4096 prior points and two of some 400 of the sampler.
    np.testing.assert_allclose(result.elpd_i, expected, atol=0.25)


def test_the_limit_of_k_hat_falls_with_few_draws():
    assert [round(good_khat(n), 2) for n in (1, 100, 500, 2000, 1e6)] == [
        -2.32,
        0.5,
        0.63,
        0.7,
        0.7,
    ]


def test_a_mission_whose_weights_fail_is_left_out_of_a_refit(monkeypatch, capsys):
    """With a limit that no weights meet, every mission is; the densities are the same."""
    missions = simulate_missions(5, lengths=(8,))
    posterior = fit(missions, PooledTrust(), progress=False)
    by_weights = loo(posterior)
    # The package's `loo` is the function.
    module = importlib.import_module("trustbo.inference.loo")
    monkeypatch.setattr(module, "good_khat", lambda n_effective: -10.0)
    monkeypatch.setattr(module, "_LONG", 0.0)
    by_refits = loo(posterior)
    assert "4 more missions" in capsys.readouterr().err  # no bar tells the time here
    loo(posterior, progress=False)
    assert capsys.readouterr().err == ""
    assert by_refits.elpd_i["refitted"].values.all()
    np.testing.assert_allclose(by_refits.elpd_i, by_weights.elpd_i, atol=0.35)

    monkeypatch.setattr(module, "MAX_KHAT", -10.0)
    with pytest.warns(UserWarning, match="Pareto"):
        loo(posterior)


@pytest.mark.parametrize(
    "model",
    [
        PooledTrust(family="censored"),
        HierarchicalTrust(),
        PooledTrust(shared_noise=True, effects=(RobotEffect(),)),
    ],
    ids=["censored", "hierarchical", "shared noise"],
)
def test_every_model_is_left_out_as_its_evidence_says(model):
    missions = simulate_missions(5, lengths=(4,))
    posterior = fit(missions, model, progress=False, latent=False)
    result = loo(posterior)
    rest = fit(missions[:-1], model, seed=7, progress=False, latent=False)
    expected = posterior.attrs["log_evidence"] - rest.attrs["log_evidence"]
    # Two evidences, of some 200 effective points each.
    assert float(result.elpd_i[-1]) == pytest.approx(expected, abs=0.5)


def test_the_ratio_of_evidence_does_not_depend_on_a_refit():
    """A fit moves the EP sites from which the evidence of non-Gaussian rates is computed."""
    _, _, missions = counted_missions("beta_binomial")
    model = PooledTrust(family="beta_binomial")
    posterior = fit(missions, model, draws=50, progress=False)
    log_density = ratio_of_evidence(posterior, missions, model)
    before = log_density(4)
    refit(posterior, model, 0)
    np.testing.assert_array_equal(log_density(4), before)


def test_the_acceptance_ratio_is_exact_for_a_normal_mean():
    """One rate of 3 given theta ~ N(0, 1): an average over the prior needs a rare draw."""
    rng = np.random.default_rng(0)
    y, sd, n = 3.0, 0.3, 4000
    var = 1.0 / (1.0 + 1.0 / sd**2)
    prior = rng.standard_normal(n)
    posterior = var * y / sd**2 + np.sqrt(var) * rng.standard_normal(n)
    without, whole = (stats.norm.logpdf(y, theta, sd) for theta in (prior, posterior))
    expected = stats.norm.logpdf(y, 0.0, np.hypot(1.0, sd))
    assert mean_likelihood(without, whole) == pytest.approx(expected, abs=0.15)
    constant = np.full(n, -700.0)
    assert mean_likelihood(constant, constant) == pytest.approx(-700.0, abs=1e-9)


@of_few_missions
def test_where_weights_of_draws_hold_it_is_arviz_s():
    posterior = fit(simulate_missions(8), PooledTrust())
    ours, theirs = loo(posterior), az.loo(posterior, pointwise=True)
    held = theirs.pareto_k.values <= 0.5
    assert held.sum() >= 5
    np.testing.assert_allclose(ours.elpd_i[held], theirs.elpd_i[held], atol=0.15)
    assert ours.elpd == pytest.approx(float(ours.elpd_i.sum()), rel=1e-12)


@of_few_missions
def test_a_mission_without_rates_is_left_out_of_the_sum():
    missions = simulate_missions(6)
    nothing = np.full_like(missions[2].contact_rate, np.nan)
    missions[2] = Mission.from_arrays(missions[2].path, missions[2].awareness, nothing)
    result = loo(fit(missions, PooledTrust()))
    assert result.n_data_points == 5
    assert result.elpd_i["mission"].values.tolist() == [0, 1, 3, 4, 5]
    alone = fit(missions[1:3], PooledTrust())
    with pytest.raises(TrustboError):
        loo(alone)


@of_few_missions
def test_missions_have_the_labels_of_the_posterior():
    missions = simulate_missions(6)
    posterior = fit(missions[2:], PooledTrust(), earlier=missions[:2], draws=100)
    labels = loo(posterior).elpd_i["mission"].values
    np.testing.assert_array_equal(labels, posterior["log_likelihood"]["mission"])
    assert labels.tolist() == [-2, -1, 0, 1, 2, 3]


@of_few_missions
def test_compare_ranks_as_arviz_does_and_refuses_other_missions():
    missions = simulate_missions(8)
    fits = {
        "level": fit(missions, PooledTrust()),
        "deviation": fit(missions, PooledTrust(memory="deviation")),
    }
    loos = {name: loo(tree) for name, tree in fits.items()}
    table, theirs = compare(fits), az.compare(loos)
    assert list(table.index) == list(theirs.index)
    raw = az.compare(loos, round_to="none")
    np.testing.assert_allclose(table["elpd_diff"], raw["elpd_diff"], atol=1e-9)
    np.testing.assert_allclose(table["elpd"], raw["elpd"], atol=1e-9)
    assert table["elpd_diff"].iloc[1] == pytest.approx(
        table["elpd"].iloc[1] - table["elpd"].iloc[0]
    )
    rounded = compare(fits, round_to="auto")
    assert rounded["elpd"].tolist() == theirs["elpd"].tolist()
    with pytest.raises(TrustboError, match="fewer"):
        compare({"level": fits["level"], "fewer": fit(missions[:5], PooledTrust())})
    with pytest.raises(TrustboError):
        compare({"level": fits["level"]})
    ticks = [
        [
            Mission.from_arrays(m.path, m.awareness, np.round(10 * m.contact_rate) / 10, n_ticks=n)
            for m in missions[:2]
        ]
        for n in (10, None)
    ]
    counted, uncounted = (fit(given, PooledTrust(), latent=False, check=False) for given in ticks)
    with pytest.raises(TrustboError, match="tick"):
        compare({"counted": counted, "uncounted": uncounted})
