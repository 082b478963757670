"""`fit`: the right posterior, laid out for ArviZ, refused when it is bad."""

import re

import arviz as az
import jax
import matplotlib.pyplot as plt
import numpy as np
import numpyro.distributions as dist
import pytest
import xarray as xr
from missions import simulate_missions
from numpyro.infer import MCMC, NUTS
from threadpoolctl import threadpool_info, threadpool_limits

from trustbo.data import Mission
from trustbo.errors import PosteriorError, ShapeError, TrustboError
from trustbo.inference import diagnostics, fit, params_of
from trustbo.inference.samplers import convergence, nuts, run, watching
from trustbo.inference.samplers.nuts_scores import run_nuts_of_scores
from trustbo.inference.samplers.settings import NutsSettings
from trustbo.models import HierarchicalTrust, PooledTrust, Priors
from trustbo.stacking import stack_missions

SITES = ["beta0", "beta", "b", "delta_w", "delta_v"]


def test_groups_and_axes_are_named(posterior):
    assert list(posterior["posterior"].data_vars) == SITES
    assert posterior["posterior"]["beta"].dims == ("chain", "draw", "feature")
    trust = posterior["latent"]["trust"]
    assert trust.dims == ("chain", "draw", "mission", "bound", "robot")
    assert trust.sizes == {"chain": 4, "draw": 50, "mission": 6, "bound": 8, "robot": 3}
    assert list(trust["robot"].values) == ["r1", "r2", "r3"]
    assert list(trust["bound"].values) == list(range(1, 9))
    assert posterior["log_likelihood"]["contact_rate"].dims == ("chain", "draw", "mission")
    assert posterior["observed_data"]["contact_rate"].dims == ("mission", "bound", "robot")
    awareness = posterior["constant_data"]["awareness"]
    assert awareness.dims == ("mission", "bound", "robot", "feature")
    for group in ("posterior_predictive", "prior", "prior_predictive", "sample_stats"):
        assert group in posterior.children
    assert posterior.attrs["prior_delta_w"] == "HalfNormal(scale=0.2)"


def test_what_lies_beyond_a_mission_s_end_is_nan(posterior):
    for group, name in (
        ("latent", "trust_mean"),
        ("observed_data", "contact_rate"),
        ("posterior_predictive", "contact_rate"),
    ):
        second = posterior[group][name].sel(mission=1)  # 5 of 8 bounds
        assert second.sel(bound=slice(1, 5)).notnull().all()
        assert second.sel(bound=slice(6, 8)).isnull().all()


@pytest.mark.filterwarnings("ignore:Estimated shape parameter of Pareto")  # 6 missions
def test_arviz_reads_it(posterior, missions):
    summary = az.summary(posterior)
    assert "beta[traversability]" in summary.index
    assert az.loo(posterior).n_data_points == len(missions)
    vague = fit(missions, PooledTrust(Priors(beta=dist.Normal(0.0, 5.0))), seed=1)
    assert set(az.compare({"default": posterior, "vague": vague}).index) == {"default", "vague"}
    az.plot_trace_dist(posterior)
    az.plot_forest(posterior)
    plt.close("all")


@pytest.mark.slow  # NUTS compiles for this alone
def test_the_posterior_is_the_one_plain_numpyro_samples(posterior, missions):
    """The change of variables, the mass matrix and the padding leave the target as it is."""
    batch = stack_missions(missions)
    with jax.enable_x64(True):
        mcmc = MCMC(
            NUTS(PooledTrust(), dense_mass=True, target_accept_prob=0.9),
            num_warmup=1000,
            num_samples=4000,
            progress_bar=False,
        )
        mcmc.run(jax.random.key(3), batch.awareness, batch.contact_rate)
        plain = {name: np.asarray(draws) for name, draws in mcmc.get_samples().items()}
    for name in SITES:
        ours = posterior["posterior"][name].values.reshape(4000, -1)
        theirs = plain[name].reshape(4000, -1)
        for a, b in zip(ours.T, theirs.T, strict=True):
            sd = np.std(b)
            # Two samples of ESS > 1000 each: the difference of their means has sd < 0.045 sd, and
            # of their log sds < 0.045 (more for skewed noises); 4 of these.
            assert abs(a.mean() - b.mean()) < 0.18 * sd, name
            assert abs(np.log(np.std(a) / sd)) < 0.25, name


def test_latent_trust_agrees_with_its_moments(posterior):
    latent = posterior["latent"]
    sampled = latent["trust"].mean(("chain", "draw"))
    # 200 trajectories: 5 standard errors of a mean over some 120 values.
    bound = 5 * latent["trust_sd"] / np.sqrt(200)
    assert (np.abs(sampled - latent["trust_mean"]) < bound).where(sampled.notnull(), True).all()


def test_the_same_seed_gives_the_same_posterior(posterior, missions):
    again = fit(missions, PooledTrust(), sampler="nuts", seed=1)
    for name in SITES:
        np.testing.assert_array_equal(
            again["posterior"][name].values, posterior["posterior"][name].values
        )
    np.testing.assert_array_equal(
        again["latent"]["trust"].values, posterior["latent"]["trust"].values
    )
    other = fit(missions, PooledTrust(), sampler="nuts", seed=2, draws=30, check=False, whole=False)
    assert (other["posterior"]["b"].values != posterior["posterior"]["b"].values[:, :30]).any()


def test_draws_do_not_depend_on_how_often_the_clock_is_looked_at(missions, monkeypatch, capsys):
    few = {"sampler": "nuts", "draws": 30, "check": False, "whole": False, "progress": False}
    usual = fit(missions, **few)["posterior"].to_dataset()
    monkeypatch.setattr(nuts, "_SECONDS", 0.0)  # one draw at a time
    xr.testing.assert_identical(fit(missions, **few)["posterior"].to_dataset(), usual)
    assert capsys.readouterr().err == ""


def test_a_long_run_and_its_retry_are_said_in_a_file_unless_progress_is_off(
    missions, monkeypatch, capsys
):
    monkeypatch.setattr(watching, "LONG", 0.0)
    monkeypatch.setattr(watching, "_TRIAL_SECONDS", 0.0)
    few = NutsSettings(150, 30)  # of the program that is compiled already; so the longer run
    monkeypatch.setattr(run, "run_nuts_of_scores", lambda _, *args: run_nuts_of_scores(few, *args))
    for options in ({}, {"progress": False}):
        with pytest.raises(PosteriorError, match="refused after a longer retry"):
            fit(missions, sampler="nuts", whole=False, **options)
        said = capsys.readouterr().err
        if options:
            assert said == ""
        else:
            assert f"\nNUTS: 4 chains of {few.warmup} + 30 draws, about " in said
            assert "\nNUTS again, for longer (4 chains of 300 + 2000 draws" in said
            assert "\r" not in said


def test_a_long_fit_by_the_exact_sampler_is_said_in_a_file(missions, monkeypatch, capsys):
    monkeypatch.setattr(watching, "LONG", -1.0)
    fit(missions, HierarchicalTrust(), whole=False)
    assert re.fullmatch(r"fit, after \d s: exact sampler seeks the mode\n", capsys.readouterr().err)
    fit(missions, HierarchicalTrust(), whole=False, progress=False)
    assert capsys.readouterr().err == ""


def test_nuts_keeps_blas_to_one_thread(missions, monkeypatch):
    seen = []

    def look(_):
        seen.extend(one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas")

    monkeypatch.setattr(watching.Watch, "compiled", look)
    with threadpool_limits(2, user_api="blas"):
        fit(missions, PooledTrust(), sampler="nuts", draws=30, check=False, whole=False)
    assert set(seen) == {1}


def test_settings_of_nuts_are_for_nuts_alone(missions):
    drawn = fit(missions, sampler="exact", whole=False, n_chains=2, draws=60)["posterior"]
    assert (drawn.sizes["chain"], drawn.sizes["draw"]) == (2, 60)
    for name, value in {"warmup": 50, "target_accept": 0.95, "max_tree_depth": 8}.items():
        expected = f'{name} is for NUTS, and the sampler is "exact": give sampler "nuts"'
        with pytest.raises(TrustboError, match=expected):
            fit(missions, **{name: value})
    for wrong in (0, 1.0, "0.9", True, np.nan):
        with pytest.raises(TrustboError, match="target_accept must be between 0 and 1; got"):
            fit(missions, sampler="nuts", target_accept=wrong)
    with pytest.raises(TrustboError, match=r"max_tree_depth must be a .* from 1 on; got 0"):
        fit(missions, sampler="nuts", max_tree_depth=0)


@pytest.mark.slow  # NUTS compiles for this alone
def test_trajectories_keep_to_their_limit(missions):
    few = {"draws": 30, "warmup": 30, "n_chains": 1, "check": False, "whole": False}
    short = fit(missions, sampler="nuts", max_tree_depth=2, **few)["sample_stats"]
    assert short["tree_depth"].max() == 2
    assert short.sizes["draw"] == 30


def test_more_missions_and_other_priors_meet_the_same_compiled_program(posterior):
    compiled = nuts.advance._cache_size()
    for n in (3, 4, 8):  # three lengths of missions each
        model = PooledTrust(Priors(x0_sd=0.1 * n))
        fit(simulate_missions(n), model, "nuts", draws=30, check=False, whole=False)
    assert nuts.advance._cache_size() == compiled


HEAVY = Priors(b=dist.Cauchy(0.0, 0.5), delta_v=dist.HalfCauchy(0.2))


@pytest.fixture(scope="module")
def with_a_gap(missions):
    """Rates are missing, and priors have no mean: one program for both."""
    rates = missions[0].contact_rate.copy()
    rates[2:4, 1] = np.nan
    gap = Mission.from_arrays(missions[0].path, missions[0].awareness, rates)
    return fit([gap, *missions[1:]], PooledTrust(HEAVY))


@pytest.mark.slow  # NUTS compiles for this alone
def test_missing_rates_are_predicted_through(with_a_gap):
    posterior = with_a_gap
    sd = posterior["latent"]["trust_sd"].sel(mission=0, robot="r2")
    assert sd.notnull().sel(bound=slice(1, 7)).all()
    assert sd.sel(bound=3) > sd.sel(bound=6)
    assert np.isnan(posterior["observed_data"]["contact_rate"].sel(mission=0, bound=3, robot="r2"))


def test_a_bad_posterior_is_refused_with_the_parameter_s_name(missions, monkeypatch, capsys):
    """A limit that no run meets; the longer run takes the short one's length, and its program."""
    assert (convergence.MAX_RHAT, convergence.MIN_ESS) == (1.01, 400.0)
    tried = []

    def short(settings, *args):
        tried.append(settings)
        return run_nuts_of_scores(NutsSettings(150), *args)

    monkeypatch.setattr(run, "run_nuts_of_scores", short)
    monkeypatch.setattr(convergence, "MIN_ESS", 1e6)
    expected = r"bulk ESS of beta0 is \d{3,} \(at least 1000000\)"
    with pytest.raises(PosteriorError, match=expected) as error:
        fit(missions, PooledTrust(), sampler="nuts", progress=True, whole=False)
    assert capsys.readouterr().err.startswith(
        "NUTS again, for longer (4 chains of 300 + 2000 draws, target_accept 0.98): bulk ESS of b"
    )
    assert tried == [NutsSettings(150), NutsSettings(300, 2000, 4, 0.98)]
    assert error.value.posterior.attrs["retries"] == 1
    unchecked = fit(missions, PooledTrust(), sampler="nuts", draws=30, check=False, whole=False)
    assert unchecked.attrs["retries"] == 0


def test_params_come_out_of_the_posterior_and_go_through_its_draws(posterior):
    params = params_of(posterior)
    assert np.shape(params.beta) == (4000, 2)
    assert params.x0_mean == 0.5
    one = params.draw(7)
    assert np.shape(one.beta0) == ()
    assert np.shape(one.beta) == (2,)
    np.testing.assert_allclose(one.beta, np.asarray(params.beta)[7])
    mean = params.mean()
    np.testing.assert_allclose(mean.beta, posterior["posterior"]["beta"].mean(("chain", "draw")))


def test_diagnostics_are_the_worst_over_parameters(posterior):
    found = diagnostics(posterior)
    assert found["r_hat"] == pytest.approx(
        float(az.summary(posterior)["r_hat"].astype(float).max()), abs=0.006
    )
    assert found["ess_bulk"] >= 400
    assert found["divergences"] == 0


def test_the_caller_s_jax_configuration_is_untouched(posterior):
    assert not jax.config.jax_enable_x64
    assert jax.numpy.ones(()).dtype == "float32"


def test_bad_input_is_refused_before_sampling(missions):
    with pytest.raises(
        TrustboError, match="unknown sampler 'gibbs'; choose one of auto, exact, nuts"
    ):
        fit(missions, sampler="gibbs")
    with pytest.raises(ShapeError, match="no missions"):
        fit([])
    awareness = missions[0].awareness.copy()
    awareness[3, 1, 0] = np.nan
    hole = Mission.from_arrays(missions[0].path, awareness, missions[0].contact_rate)
    expected = "mission 1, bound 4, robot r2, feature traversability is NaN"
    with pytest.raises(TrustboError, match=expected):
        fit([missions[0], hole])
    named = Mission.from_arrays(
        missions[0].path, missions[0].awareness, missions[0].contact_rate, robots=["a", "b", "c"]
    )
    with pytest.raises(ShapeError, match="mission 1 has robots"):
        fit([missions[0], named])


@pytest.mark.parametrize("name", ["beta0", "delta_w"])
def test_a_prior_must_be_a_scalar_distribution(name):
    for value in (0.5, dist.Normal(np.zeros(2), 1.0)):
        with pytest.raises(TrustboError, match=f"Priors.{name} must be a scalar numpyro"):
            Priors(**{name: value})


@pytest.mark.slow  # NUTS compiles for this alone
def test_priors_without_a_mean_can_be_fitted(with_a_gap):
    assert diagnostics(with_a_gap)["r_hat"] <= 1.01
    assert HEAVY.mean(2)["b"] == 0.0


def test_trust_before_the_first_bound_cannot_have_a_negative_sd():
    with pytest.raises(TrustboError, match="x0_sd must be finite, not negative; got -1"):
        Priors(x0_sd=-1.0)
