"""Families of observations chosen by the rates."""

import warnings

import numpy as np
import pytest

import trustbo as tb
from trustbo.errors import PosteriorError
from trustbo.inference import fit
from trustbo.inference.samplers import run
from trustbo.models import CoupledTrust, HierarchicalTrust, PooledTrust, Priors
from trustbo.simulation import KinematicSimulator

PATH = [(2, 0), (1, 1), (0, 2)]


def missions(share, *, ticks=True, n=10):
    """Missions of which a share of the rates is exactly 1."""
    rng = np.random.default_rng(0)
    rates = np.round(rng.uniform(0.3, 0.9, n * 4), 2)
    rates[: round(share * len(rates))] = 1.0
    z = rng.uniform(size=(n, 2, 2, 1))
    more = {"n_ticks": np.full((2, 2), 100)} if ticks else {}
    return [
        tb.Mission.from_arrays(PATH, z[j], of, **more)
        for j, of in enumerate(rates.reshape(n, 2, 2))
    ]


@pytest.mark.parametrize(
    ("share", "ticks", "family", "reason"),
    [
        (0.0, True, "gaussian", "0% of the rates are 0 or 1"),
        (0.025, True, "gaussian", "2% of the rates are 0 or 1"),
        (0.1, True, "censored", "10% of the rates are 0 or 1"),
        (0.1, False, "censored", "10% of the rates are 0 or 1"),
    ],
)
def test_the_rates_choose_the_family_and_the_posterior_says_why(share, ticks, family, reason):
    some = missions(share, ticks=ticks)
    posterior = fit(some, PooledTrust(observation="auto"), n_draws=50)
    assert posterior.attrs["observation"] == family
    assert posterior.attrs["observation_reason"] == reason
    asked = fit(some, PooledTrust(observation=family), n_draws=50)
    assert asked.attrs["observation_reason"] == "asked for"
    for group in ("posterior", "log_prior", "log_likelihood", "prior"):
        assert (
            posterior[group]
            .to_dataset()
            .drop_attrs()
            .identical(asked[group].to_dataset().drop_attrs())
        )


def test_the_exact_sampler_and_weights_come_first():
    some = missions(0.5)
    posterior = fit(some, HierarchicalTrust(observation="auto", response="change"), n_draws=50)
    assert posterior.attrs["sampler"] == "exact"
    assert posterior.attrs["observation"] == "gaussian"
    assert "but it measures changes of trust" in posterior.attrs["observation_reason"]
    weighted = fit(some, PooledTrust(observation="auto"), weights=np.full(10, 0.5), n_draws=50)
    assert weighted.attrs["observation_reason"] == "missions have weights"
    change = PooledTrust(observation="auto", response="change")
    assert fit(missions(0.0), change, n_draws=50).attrs["observation"] == "gaussian"


def force_uneven_weights(monkeypatch):
    """Of scores, which Gaussian rates of pooled robots have none of."""
    sample = run.sample_scores

    def uneven(*args):
        found = sample(*args)
        return found._replace(draws=found.draws._replace(khat=0.83))

    monkeypatch.setattr(run, "sample_scores", uneven)


def test_uneven_weights_leave_gaussian_rates_where_nobody_asked_for_others(monkeypatch):
    some = missions(0.5, n=3)
    force_uneven_weights(monkeypatch)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = fit(some, PooledTrust(observation="auto"), n_draws=50, whole=False)
    assert (found.attrs["sampler"], found.attrs["observation"]) == ("exact", "gaussian")
    assert found.attrs["observation_reason"] == (
        "50% of the rates are 0 or 1, but the censored ones' weights are too uneven (k-hat 0.83, "
        "limit 0.7): Gaussian ones instead"
    )
    gaussian = fit(some, PooledTrust(), n_draws=50, whole=False)["posterior"].to_dataset()
    assert found["posterior"].to_dataset().drop_attrs().identical(gaussian.drop_attrs())


def test_uneven_weights_of_a_family_that_was_asked_for_are_refused(monkeypatch):
    force_uneven_weights(monkeypatch)
    model = PooledTrust(observation="censored")
    with pytest.raises(PosteriorError, match=r"weights are too uneven .k-hat 0.83, limit 0.7"):
        fit(missions(0.5, n=3), model, n_draws=50, whole=False, check=False)


def test_priors_of_one_s_own_are_kept():
    own = Priors(x0_sd=0.1)
    model = PooledTrust(own, observation="auto").observing("censored")
    assert model.priors is own
    assert PooledTrust(observation="auto").observing("censored").priors is Priors.default(
        "censored"
    )


def test_a_campaign_plans_for_the_family_of_its_posterior(tmp_path):
    """Over bare ground, many bounds are in sight all the time."""
    terrain = tb.terrain.synthetic_terrain((120.0, 120.0), seed=5)
    workspace = tb.Workspace.from_terrain(terrain, (3, 3), sight="bare")
    model = PooledTrust(observation="auto")
    with tb.Campaign(workspace, (2, 0), (0, 2), model=model, directory=tmp_path / "c") as campaign:
        assert campaign.planner_now().family.name == "gaussian"
        mission = KinematicSimulator(workspace).run(campaign.ask().path, seed=0)
        assert (mission.contact_rate == 1.0).mean() > 0.05
        campaign.tell(mission)
        assert campaign.posterior.attrs["observation"] == "censored"
        assert campaign.planner_now().family.name == "censored"
        plan = campaign.ask()
        result = campaign.result()
        assert result.planner.family.name == "censored"
    with tb.Campaign.load(tmp_path / "c") as again:
        assert again.model == model
        assert again.ask().path == plan.path
        assert again.planner_now().family.name == "censored"


def test_an_unknown_family_is_refused():
    with pytest.raises(tb.TrustboError, match="unknown observation 'normal'; choose one of auto"):
        CoupledTrust(observation="normal")
