"""Campaigns that learn from earlier campaigns, whose missions are data."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from folders import ENDS, numbers, same
from worlds import ModelSimulator, unequal_robots

import trustbo as tb
from trustbo.campaign.folder import MemoryStorage
from trustbo.errors import TrustboError
from trustbo.identity import map_name
from trustbo.models import CoupledTrust, HierarchicalTrust, PlaceEffect, RobotEffect, default_model
from trustbo.workspace import Workspace

OPTIONS = {"sampler": "importance", "fit": {"draws": 60}}
OTHER_ENDS = ((0, 0), (2, 2))


def cells(seed=0, robots=("r1", "r2", "r3"), features=("traversability", "visibility")):
    """A workspace of random awareness, whose robots have names."""
    awareness = np.random.default_rng(seed).uniform(size=(len(robots), 4, 4, 2))
    return Workspace.from_awareness(
        awareness, features=features, team=tb.Team(names=robots, n_robots=len(robots))
    )


class NamedSimulator(ModelSimulator):
    """Gives the robots the names of the workspace's team."""

    def run(self, path, **options):
        return replace(super().run(path, **options), robots=self.workspace.team.names)


def run(workspace, n=2, ends=ENDS, **options):
    simulator = NamedSimulator(workspace)
    return tb.iterate(
        workspace, *ends, n_iterations=n, simulator=simulator, progress=False, **OPTIONS | options
    )


@pytest.fixture(scope="module")
def workspace():
    return cells()


@pytest.fixture(scope="module")
def first(workspace):
    """An earlier campaign of three missions, of which the second fails in its first bound."""
    campaign = tb.Campaign(workspace, *ENDS, **OPTIONS)
    simulator = ModelSimulator(workspace)
    for n in range(3):
        simulator.fail_at = 1 if n == 1 else None
        campaign.tell(simulator.run(campaign.ask().path, seed=n))
    return campaign


@pytest.fixture(scope="module")
def elsewhere():
    return run(cells(seed=1))


@pytest.fixture(scope="module")
def second(workspace, first):
    return run(workspace, ends=OTHER_ENDS, earlier=first)


def test_first_posterior_is_that_of_the_earlier_missions(workspace, first):
    campaign = tb.Campaign(workspace, *OTHER_ENDS, earlier=first, **OPTIONS)
    seed = campaign.state.seed_of("fit")
    expected = tb.fit(
        first.missions, default_model(), workspace=workspace, seed=seed, progress=False,
        sampler="importance", draws=60, latent=False,
    )  # fmt: skip
    for group in ("posterior", "places", "robots"):
        found = campaign.state.posterior[group].to_dataset()
        for name, values in expected[group].data_vars.items():
            np.testing.assert_array_equal(found[name].values, values.values)
    assert campaign.missions == []
    table = campaign.table()
    assert table.index.tolist() == [-3, -2, -1]
    assert set(table["state"]) == {"earlier"}
    expected = first.table()["contact_lost"].tolist()
    np.testing.assert_array_equal(table["contact_lost"], expected)
    assert "3 on this map, 0 elsewhere" in repr(campaign)


def test_every_fit_includes_the_earlier_missions(workspace, first, second):
    assert len(second.missions) == len(second.posteriors) == 2
    assert second.table().index.tolist() == [-3, -2, -1, 1, 2]
    assert second.posterior["latent"]["mission"].values.tolist() == [-3, -2, -1, 0, 1]
    assert second.posterior["robots"]["mission"].values.tolist() == [-3, -2, -1, 0, 1]

    observed = second.posterior["observed_data"].to_dataset()["contact_rate"]
    for label, mission in zip(range(-3, 2), [*first.missions, *second.missions], strict=True):
        rates = observed.sel(mission=label).values[: len(mission.bounds)]
        np.testing.assert_array_equal(rates, mission.contact_rate)


def test_evidence_is_that_of_all_missions_in_one_fit(workspace, first, second):
    together = tb.fit(
        [*first.missions, *second.missions], default_model(), workspace=workspace, seed=9,
        progress=False, sampler="importance", latent=False,
    )  # fmt: skip
    found = second.state.posterior.attrs["log_evidence"]
    assert found == pytest.approx(together.attrs["log_evidence"], abs=0.3)


def test_failures_on_the_same_map_are_used(workspace, first, second):
    assert first.risk.failures.sum() == 1.0
    assert second.risk.failures.sum() == 1.0
    other = tb.Campaign(cells(seed=2), *ENDS, earlier=first, **OPTIONS)
    assert other.risk.failures.sum() == 0.0


def test_missions_given_up_on_the_same_map_are_used(workspace):
    campaign = run(workspace)
    plan = campaign.ask()
    campaign.fail("stuck", where=plan.path[1])
    after = tb.Campaign(workspace, *ENDS, earlier=campaign, **OPTIONS)
    assert after.risk.failures.sum() == 1.0


def test_places_on_another_terrain_say_nothing_about_places_here(first):
    campaign = tb.Campaign(cells(seed=2), *ENDS, earlier=first, **OPTIONS)
    assert {mission.map for mission in campaign.state.earlier.missions} == {
        map_name(first.workspace)
    }
    group = campaign.state.posterior["places"].to_dataset()
    assert (group["cell_map"] == 1).all()

    # Without places here, the expected effect is 0 everywhere, and the weights are not.
    mean = campaign.belief.mean()
    np.testing.assert_allclose(mean.place, 0.0, atol=1e-12)
    np.testing.assert_allclose(mean.place_bound, 0.0, atol=1e-12)
    weights = [
        tree["posterior"]["beta"].values
        for tree in (first.state.posterior, campaign.state.posterior)
    ]
    np.testing.assert_allclose(weights[0].mean((0, 1)), weights[1].mean((0, 1)), atol=0.15)


def test_maps_are_recognised_by_content(workspace, first, elsewhere, tmp_path):
    copy = cells()
    assert copy is not workspace
    both = run(cells(seed=1), earlier=[first, elsewhere])
    both.save(tmp_path / "both")

    # A chain of campaigns, of which the last is where the first was.
    again = tb.load_result(tmp_path / "both")
    last = tb.Campaign(copy, *ENDS, earlier=again, **OPTIONS)
    there = map_name(elsewhere.workspace)
    assert [mission.map for mission in last.state.earlier.missions] == 3 * [""] + 4 * [there]


def test_terrain_is_recognised_after_it_was_read_from_a_file(tmp_path):
    workspace = unequal_robots()
    campaign = tb.Campaign(workspace, (2, 0), (0, 3), directory=tmp_path / "run")
    name = map_name(workspace)
    campaign.close()
    assert map_name(tb.Campaign.load(tmp_path / "run").workspace) == name
    assert map_name(replace(workspace, team=tb.Team(2))) == name
    assert map_name(replace(workspace, terrain=workspace.terrain + 1.0)) != name


def test_campaign_resumes_identically_without_the_earlier_one(workspace, first, tmp_path):
    whole = run(workspace, 2, OTHER_ENDS, earlier=first, directory=tmp_path / "whole")
    run(workspace, 1, OTHER_ENDS, earlier=first, directory=tmp_path / "part")
    resumed = tb.resume(
        tmp_path / "part", simulator=NamedSimulator(workspace), n_iterations=2, progress=False
    )
    expected = numbers(whole)
    same(resumed, expected)
    same(tb.load_result(tmp_path / "whole"), expected)
    assert len(resumed.state.earlier.missions) == 3
    assert resumed.state.earlier.lost == ()
    assert "earlier.nc" in (tmp_path / "whole" / "campaign.json").read_text()


def test_loaded_campaign_plans_as_before_its_first_mission(workspace, first, tmp_path):
    with tb.Campaign(workspace, *OTHER_ENDS, earlier=first, directory=tmp_path, **OPTIONS) as one:
        path = one.recommend().path
        trust = one.trust_map.values
    with tb.Campaign.load(tmp_path) as again:
        assert again.recommend().path == path
        np.testing.assert_array_equal(again.trust_map.values, trust)
        assert again.risk.failures.sum() == 1.0


def test_damaged_earlier_missions_are_found(workspace, first, tmp_path):
    tb.Campaign(workspace, *OTHER_ENDS, earlier=first, directory=tmp_path, **OPTIONS).close()
    content = (tmp_path / "earlier.nc").read_bytes()
    (tmp_path / "earlier.nc").write_bytes(content[:-1] + b"?")
    with pytest.raises(TrustboError, match=r"earlier\.nc"):
        tb.Campaign.load(tmp_path)


def test_campaign_that_is_replaced_leaves_no_earlier_missions(workspace, first, tmp_path):
    tb.Campaign(workspace, *OTHER_ENDS, earlier=first, directory=tmp_path, **OPTIONS).close()
    tb.Campaign(workspace, *ENDS, directory=tmp_path, overwrite=True, **OPTIONS).close()
    assert not (tmp_path / "earlier.nc").exists()
    assert not (tmp_path / "posteriors" / "0000.nc").exists()
    with tb.Campaign.load(tmp_path) as campaign:
        assert campaign.state.posterior is None


def test_saved_result_has_the_earlier_missions(second, tmp_path):
    second.save(tmp_path)
    again = tb.load_result(tmp_path)
    same(second, again)
    assert again.posterior["latent"].equals(second.posterior["latent"])


def test_excluding_all_missions_leaves_the_earlier_posterior(workspace, first):
    campaign = run(workspace, 1, OTHER_ENDS, earlier=first)
    before = campaign.state.initial
    with pytest.raises(TrustboError, match="mission -1 is of an earlier campaign; correct it ther"):
        campaign.exclude(-1, "the lidar was covered")
    campaign.exclude(1, "the lidar was covered")
    assert campaign.state.last is before


def test_robots_are_matched_by_name(first):
    """The new team lacks r3 and has a new robot; its other robots are in another order."""
    there = cells(seed=2, robots=("new", "r2", "r1"))
    campaign = run(there, earlier=first)
    assert campaign.state.earlier.missions[0].robots == ("new", "r2", "r1", "r3")
    rates = campaign.state.earlier.missions[0].contact_rate
    measured = first.missions[0].contact_rate
    np.testing.assert_array_equal(rates[:, 1:], measured[:, [1, 0, 2]])
    assert np.isnan(rates[:, 0]).all()

    assert campaign.belief.n_robots in (None, 3)
    assert campaign.trust()["robot"].values.tolist() == ["new", "r2", "r1"]
    assert campaign.posterior["robots"]["robot"].values.tolist() == ["new", "r2", "r1", "r3"]
    scores = tb.inference.score(campaign.posteriors, campaign.missions)
    assert scores["robot"].values.tolist() == ["new", "r2", "r1"]


def test_an_unknown_robot_informs_shared_parameters(first):
    """Only its rates are measured, and yet the weights are learned."""
    there = cells(seed=2, robots=("new", "r2"))
    one = run(cells(robots=("r3", "r2")), 3)
    blind = [replace(entry, mission=only(entry.mission, "r3")) for entry in one.state.entries]
    result = tb.campaign.Result(one.workspace, replace(one.state, entries=blind), one.learner)
    for model in (default_model(), HierarchicalTrust(effects=(PlaceEffect(), RobotEffect()))):
        campaign = tb.Campaign(there, *ENDS, earlier=result, model=model, **OPTIONS)
        prior = tb.Campaign(there, *ENDS, model=model, **OPTIONS).draw_prior(500)
        assert campaign.belief.beta.std() < prior.beta.std()
        assert campaign.trust().sizes["robot"] == 2


def only(mission, robot):
    """A mission in which only one robot's rates are measured."""
    others = np.array([name != robot for name in mission.robots])
    return replace(mission, contact_rate=np.where(others, np.nan, mission.contact_rate))


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"robots": ("x", "y", "z")}, "robots"),
        ({"features": ("traversability", "moisture")}, "features"),
    ],
)
def test_campaigns_that_cannot_be_matched_are_refused(first, options, match):
    with pytest.raises(TrustboError, match=match):
        tb.Campaign(cells(seed=2, **options), *ENDS, earlier=first, **OPTIONS)


@pytest.mark.parametrize("earlier", [3, "folder", [None]])
def test_earlier_must_be_results(workspace, earlier):
    with pytest.raises(TrustboError, match="earlier"):
        tb.Campaign(workspace, *ENDS, earlier=earlier)


def test_campaign_without_missions_is_refused(workspace):
    with pytest.raises(TrustboError, match="no mission"):
        tb.Campaign(workspace, *ENDS, earlier=tb.Campaign(workspace, *ENDS))


def test_refused_campaign_writes_nothing(first, tmp_path):
    there = cells(seed=2, robots=("x", "y", "z"))
    with pytest.raises(TrustboError, match="robots"):
        tb.iterate(there, *ENDS, earlier=first, directory=tmp_path / "run", progress=False)
    assert not (tmp_path / "run").exists()


def test_robots_that_influence_each_other_must_be_the_same(workspace, first):
    there = cells(seed=2, robots=("r1", "r2"))
    with pytest.raises(TrustboError, match="CoupledTrust"):
        tb.Campaign(there, *ENDS, earlier=first, model=CoupledTrust(), **OPTIONS)
    other = cells(seed=2, robots=("r3", "r1", "r2"))
    campaign = tb.Campaign(other, *ENDS, earlier=first, model=CoupledTrust(), fit={"check": False})
    assert isinstance(campaign.storage, MemoryStorage)
    assert campaign.state.initial is not None


def rising(awareness, contact_rate=None):
    level = numpyro.sample("level", dist.Normal(0.1, 0.2))
    most = numpyro.sample("most", dist.HalfNormal(0.5))
    rates = tb.models.ContactRate(level + most * awareness[..., 0], 0.4, 0.05, 0.05)
    numpyro.sample("contact_rate", rates, obs=contact_rate)


def of_cells(awareness, cell, contact_rate=None):
    level = numpyro.sample("level", dist.Normal(0.1, 0.2).expand((16,)).to_event(1))
    drift = jnp.zeros(awareness.shape[:3]) + level[4 * cell[..., :1] + cell[..., 1:]]
    rates = tb.models.ContactRate(drift, 0.4, 0.05, 0.05)
    numpyro.sample("contact_rate", rates, obs=contact_rate)


def test_function_learns_from_earlier_missions(first):
    there = cells(seed=2, robots=("r2", "r3", "r1"))
    campaign = tb.Campaign(there, *ENDS, earlier=first, model=rising, fit={"draws": 200})
    draws = campaign.state.posterior["posterior"]["most"].values
    alone = tb.fit(first.missions, rising, draws=200, progress=False, latent=False)
    expected = alone["posterior"]["most"].values
    assert draws.mean() == pytest.approx(expected.mean(), abs=0.3 * expected.std())


def test_function_of_places_is_refused_on_another_map(first):
    with pytest.raises(TrustboError, match="cell"):
        tb.Campaign(cells(seed=2), *ENDS, earlier=first, model=of_cells)


def test_function_with_other_robots_is_refused(first):
    with pytest.raises(TrustboError, match="rising"):
        tb.Campaign(cells(seed=2, robots=("r1", "r2")), *ENDS, earlier=first, model=rising)


def test_missions_that_several_results_contain_are_used_once(workspace, first, tmp_path):
    first.save(tmp_path / "first")
    ours = tb.Campaign(workspace, *ENDS, earlier=first, **OPTIONS)
    theirs = tb.Campaign(workspace, *ENDS, earlier=tb.load_result(tmp_path / "first"), **OPTIONS)
    simulator = ModelSimulator(workspace)
    for seed, campaign in enumerate((ours, theirs), start=10):
        campaign.ask()
        campaign.fail("stuck")
        campaign.tell(simulator.run(campaign.ask().path, seed=seed))

    n = len(first.missions)
    for earlier in ([ours, theirs], [first, ours, theirs], [ours, first, theirs, ours]):
        found = tb.Campaign(workspace, *OTHER_ENDS, earlier=earlier, **OPTIONS).state.earlier
        assert len(found.missions) == n + 2
        assert len(found.lost) == 2  # one of each, although they are equal

    wider = cells(robots=("r1", "r2", "r3", "r4"))
    found = tb.Campaign(wider, *OTHER_ENDS, earlier=[ours, theirs, first], **OPTIONS).state.earlier
    assert len(found.missions) == n + 2


def test_equal_missions_of_different_campaigns_are_all_used(workspace):
    """Such as those of a simulator without noise."""
    campaigns = [tb.Campaign(workspace, *ENDS, **OPTIONS) for _ in range(2)]
    for campaign in campaigns:
        campaign.tell(ModelSimulator(workspace).run(campaign.ask().path, seed=0))
    found = tb.Campaign(workspace, *OTHER_ENDS, earlier=campaigns, **OPTIONS).state.earlier
    assert len(found.missions) == 2
