"""Campaigns whose model is a NumPyro function."""

import shutil

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import trustbo as tb
from trustbo.models import ContactRate, PooledTrust, TrustParams
from trustbo.report import write_report

FEATURES = ("traversability", "line_of_sight")
START, GOAL = (4, 0), (0, 4)


def saturating(awareness, contact_rate=None):
    """Trust that saturates with line of sight, with known noises."""
    level = numpyro.sample("level", dist.Normal(0.1, 0.2))
    most = numpyro.sample("most", dist.HalfNormal(0.5))
    drift = level + most * (1.0 - jnp.exp(-4.0 * awareness[..., 1]))
    with numpyro.plate("mission", len(drift)):
        rates = ContactRate(drift, 0.4, 0.03, 0.04)
        numpyro.sample("contact_rate", rates, obs=contact_rate)


def other(awareness, contact_rate=None):
    level = numpyro.sample("level", dist.Normal(0.1, 0.2))
    rates = ContactRate(level + awareness[..., 0], 0.4, 0.03, 0.04)
    numpyro.sample("contact_rate", rates, obs=contact_rate)


@pytest.fixture(scope="module")
def workspace():
    awareness = np.random.default_rng(0).uniform(size=(3, 5, 5, 2))
    return tb.Workspace.from_awareness(awareness, features=FEATURES)


@pytest.fixture(scope="module")
def simulator(workspace):
    """The drift of `saturating` with level 0.1 and most 0.4, as effects of bounds."""
    z = workspace.awareness.fillna(0.0).values
    drift = 0.1 + 0.4 * (1.0 - np.exp(-4.0 * z[..., 1]))
    truth = TrustParams(0.4, np.zeros(2), 0.0, 0.03, 0.04, place_bound=drift)
    return tb.simulation.ModelSimulator(workspace, truth)


def run(workspace, simulator, n, directory=None):
    return tb.iterate(
        workspace, START, GOAL, model=saturating, policy="thompson", simulator=simulator,
        n_iterations=n, directory=directory, fit={"draws": 300}, progress=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(workspace, simulator, tmp_path_factory):
    directory = tmp_path_factory.mktemp("campaign") / "run"
    run(workspace, simulator, 2, directory)
    return directory


@pytest.fixture(scope="module")
def result(folder):
    return tb.load_result(folder, model=saturating)


def test_a_campaign_learns_the_variables_of_the_function(result):
    draws = result.posterior["posterior"]
    assert result.table()["state"].tolist() == ["learned"] * 2
    for name, truth in {"level": 0.1, "most": 0.4}.items():
        assert abs(float(draws[name].mean()) - truth) < 4.0 * float(draws[name].std())


def test_everything_that_reads_a_campaign_accepts_it(result, folder, workspace, tmp_path):
    assert "the function saturating" in repr(result)
    assert result.path[0] == START
    assert result.path[-1] == GOAL
    assert result.plan().value_band is not None
    assert set(result.maps().data_vars) >= {"trust_mean", "trust_sd", "path_probability"}
    assert len(result.explore().html) > 1000
    assert tb.check(result.posteriors, result.missions).verdict
    scores = tb.inference.score(result.posteriors, result.missions)
    assert np.isfinite(float(scores["mean_log_score"]))

    with tb.Campaign.load(folder, model=saturating) as campaign:
        assert 0.0 <= tb.RegretBound().probability(campaign, 2) <= 1.0
        follower = tb.Follower(campaign)
        assert np.isfinite(follower.ahead().rate).all()
    result.save(tmp_path / "copy")
    assert tb.load_result(tmp_path / "copy", model=saturating).path == result.path

    write_report(tmp_path / "report.html", result)
    assert "the function saturating" in (tmp_path / "report.html").read_text()
    tb.export.export_result(result, tmp_path / "gis", ["csv", "nav2"])
    assert any((tmp_path / "gis").iterdir())


def test_a_resumed_campaign_is_bit_identical(folder, workspace, simulator, tmp_path):
    stopped = tmp_path / "stopped"
    run(workspace, simulator, 1, stopped)
    resumed = tb.resume(
        stopped, simulator=simulator, model=saturating, n_iterations=2, progress=False
    )
    whole = tb.load_result(folder, model=saturating)
    for a, b in zip(resumed.posteriors, whole.posteriors, strict=True):
        assert a["posterior"].to_dataset().identical(b["posterior"].to_dataset())
    assert resumed.path == whole.path
    assert [m.path for m in resumed.missions] == [m.path for m in whole.missions]


def test_a_campaign_continues_only_with_its_function(folder, simulator, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    (copy / "campaign.lock").unlink(missing_ok=True)
    for model, message in ((other, "not of 'other'"), (PooledTrust(), "is the function")):
        with pytest.raises(tb.TrustboError, match=message):
            tb.Campaign.load(copy, model=model)


def test_a_function_plans_before_the_first_mission(workspace):
    for policy in tb.planning.POLICIES:
        campaign = tb.Campaign(workspace, START, GOAL, model=saturating, policy=policy)
        path = campaign.ask().path
        assert (path[0], path[-1]) == (START, GOAL)
    drawn = tb.Campaign(workspace, START, GOAL, model=saturating, initial="prior_draw")
    assert drawn.ask().path[0] == START
