"""Ask and tell: whatever runs the missions."""

import json
from dataclasses import replace

import numpy as np
import pytest
from worlds import ModelSimulator, random_cells

from trustbo import (
    Campaign,
    Mission,
    NoPathError,
    ShapeError,
    TrustboError,
    Workspace,
)
from trustbo.inference import fit, sample_prior
from trustbo.models import CoupledTrust, HierarchicalTrust, PooledTrust
from trustbo.models.record import model_to_record
from trustbo.planning import policies
from trustbo.study.methods import MODELS, model_of

ENDS = ((3, 0), (0, 3))


@pytest.fixture(scope="module")
def workspace():
    return random_cells()


def test_ask_is_the_same_until_told(workspace):
    campaign = Campaign(workspace, *ENDS, sampler="exact", policy="thompson")
    plan = campaign.ask()
    assert campaign.ask() is plan
    assert campaign.posterior is None
    mission = ModelSimulator(workspace).run(plan.path, seed=0)
    posterior = campaign.tell(mission)
    assert campaign.posterior is campaign.posterior
    np.testing.assert_array_equal(campaign.posterior["posterior"]["b"], posterior["posterior"]["b"])
    assert campaign.missions[0].path == plan.path
    assert [entry.plan for entry in campaign.state.entries] == [plan]
    assert campaign.ask() is not plan


def test_the_first_plan_is_from_one_draw_of_the_prior_or_from_its_mean(workspace):
    first = [Campaign(workspace, *ENDS, initial="prior_draw", seed=s).belief for s in range(2)]
    assert np.shape(first[0].beta) == (1, 2)
    assert first[0].beta0[0] != first[1].beta0[0]
    mean = Campaign(workspace, *ENDS).belief
    assert mean.beta0.tolist() == [0.5]
    assert mean.beta.tolist() == [[0.0, 0.0]]


def test_fits_and_studies_have_the_default_model_of_campaigns(workspace):
    campaign = Campaign(workspace, *ENDS)
    path = [(3, 0), (2, 1), (1, 2), (0, 3)]
    missions = [ModelSimulator(workspace).run(path, seed=0)]
    posterior = fit(missions, draws=50, whole=False, check=False, progress=False)
    record = model_to_record(campaign.model)
    assert record["place"] is not None
    assert json.loads(posterior.attrs["model_record"]) == record
    assert model_to_record(model_of(MODELS["robots"])) == record


def test_the_posterior_is_that_of_all_missions_so_far(workspace):
    campaign = Campaign(workspace, *ENDS, model=PooledTrust(), sampler="exact")
    simulator = ModelSimulator(workspace)
    for j in range(2):
        seed = campaign.seed_of("fit")
        campaign.tell(simulator.run(campaign.ask().path, seed=j))
    again = fit(campaign.missions, PooledTrust(), sampler="exact", seed=seed)
    np.testing.assert_array_equal(
        again["posterior"]["beta"].values, campaign.posterior["posterior"]["beta"].values
    )


def test_unmeasured_awareness_comes_from_the_map(workspace):
    campaign = Campaign(workspace, *ENDS, sampler="exact")
    campaign.tell(ModelSimulator(workspace, blind=True).run(campaign.ask().path, seed=0))
    cell = campaign.missions[0].bounds[0].cell
    np.testing.assert_array_equal(
        campaign.missions[0].awareness[0], workspace.awareness.values[:, *cell]
    )


def test_missions_are_learned_from_with_the_awareness_of_the_map(workspace):
    # Awareness is measured lower than the map has it, everywhere: plans go by the map, and must
    # predict what was measured on the path.
    lower = Workspace.from_awareness(0.5 * workspace.awareness.values)
    simulator = ModelSimulator(lower)
    blind, told = (Campaign(workspace, *ENDS, sampler="exact", seed=1) for _ in range(2))
    for j in range(4):
        mission = simulator.run(told.ask().path, seed=j)
        told.tell(mission)
        unmeasured = [
            replace(b, awareness=np.full_like(b.awareness, np.nan)) for b in mission.bounds
        ]
        blind.tell(replace(mission, bounds=tuple(unmeasured)))
    np.testing.assert_array_equal(
        told.missions[3].awareness, workspace.along(told.missions[3].path)
    )
    assert told.posterior["posterior"].equals(blind.posterior["posterior"])
    assert told.recommend().value == blind.recommend().value
    np.testing.assert_array_equal(told.state.measured[3].awareness, mission.awareness)


def test_another_team_s_mission_is_refused(workspace):
    campaign = Campaign(workspace, *ENDS)
    mission = Mission.from_arrays([(3, 0), (2, 1)], np.full((1, 2, 2), 0.5), np.full((1, 2), 0.5))
    with pytest.raises(ShapeError, match=r"the mission has robots \('r1', 'r2'\), not"):
        campaign.tell(mission)
    assert campaign.missions == []


def test_a_mission_off_the_grid_is_refused(workspace):
    campaign = Campaign(workspace, *ENDS, sampler="exact")
    z = np.full((1, 3, 2), np.nan)
    mission = Mission.from_arrays([(3, 0), (50, 50)], z, np.full((1, 3), 0.5))
    with pytest.raises(TrustboError, match=r"path enters \(50, 50\), outside the grid of 4 rows"):
        campaign.tell(mission)
    with pytest.raises(TrustboError, match="tell takes one Mission at a time; got int"):
        campaign.tell(7)


def test_a_policy_of_one_s_own(workspace):
    def along_the_diagonal(key, posterior, planner):
        return planner.evaluate([(3, 0), (2, 1), (1, 2), (0, 3)], posterior.mean())

    campaign = Campaign(workspace, *ENDS, sampler="exact", policy=along_the_diagonal)
    assert campaign.ask().path == ((3, 0), (2, 1), (1, 2), (0, 3))
    assert campaign.settings["policy"] == "along_the_diagonal"


def test_a_policy_that_gives_no_plan_is_refused(workspace):
    campaign = Campaign(workspace, *ENDS, policy=lambda key, posterior, planner: [(3, 0)])
    with pytest.raises(TrustboError, match=r"'<lambda>' must return a Plan; got \[\(3, 0\)\]"):
        campaign.ask()


def test_a_policy_that_returns_a_broken_path_is_named_with_the_cell(workspace):
    def leaps(key, posterior, planner):
        plan = planner.plan(posterior.mean())
        return replace(plan, path=((3, 0), (1, 1), (0, 3)))

    campaign = Campaign(workspace, *ENDS, policy=leaps)
    with pytest.raises(
        TrustboError, match=r"policy 'leaps': the path is broken: .* from \(3, 0\) to \(1, 1\)"
    ):
        campaign.ask()


def test_recommending_is_greedy_whatever_the_policy(workspace):
    campaign = Campaign(workspace, *ENDS, sampler="exact", policy="random")
    campaign.tell(ModelSimulator(workspace).run(campaign.ask().path, seed=0))
    best = policies.greedy(None, campaign.belief, campaign.planner)
    assert campaign.recommend().path == best.path


def test_bad_names_and_ends_are_refused_at_once(workspace):
    for options, message in (
        ({"policy": "bold"}, "unknown policy 'bold'; choose one of greedy, optimistic"),
        ({"objective": "best"}, "unknown objective 'best'"),
        ({"sampler": "gibbs"}, "unknown sampler 'gibbs'; choose one of auto, exact, nuts"),
        ({"initial": "zero"}, "unknown initial 'zero'; choose one of prior_mean, prior_draw"),
    ):
        with pytest.raises(TrustboError, match=message):
            Campaign(workspace, *ENDS, **options)
    walls = np.ones((4, 4), bool)
    walls[2] = False
    closed = Workspace.from_awareness(workspace.awareness.values, walls)
    with pytest.raises(NoPathError, match="no path from"):
        Campaign(closed, *ENDS)


def test_what_cannot_be_planned_or_updated_with_is_refused_at_once(workspace):
    with pytest.raises(TrustboError, match="model must be a trust model"):
        Campaign(workspace, *ENDS, model="pooled")
    with pytest.raises(TrustboError, match="unknown option 'update'"):
        Campaign(workspace, *ENDS, update="refit")


def test_a_campaign_with_censored_rates(workspace):
    model = PooledTrust(observation="censored")
    campaign = Campaign(workspace, *ENDS, model=model, policy="greedy")
    campaign.tell(ModelSimulator(workspace).run(campaign.ask().path, seed=0))
    assert campaign.posterior.attrs["sampler"] == "exact"
    assert campaign.ask().exact


@pytest.mark.parametrize("initial", ["prior_draw", "prior_mean"])
@pytest.mark.parametrize("model", [HierarchicalTrust(), CoupledTrust()])
def test_every_model_can_be_planned_with(model, initial):
    workspace = random_cells(2)
    campaign = Campaign(
        workspace, *ENDS, model=model, objective="terminal", team="min", initial=initial
    )
    plan = campaign.ask()
    assert plan.trust.shape[1] == 2
    assert plan.value == pytest.approx(1.0 / (1.0 + np.exp(-plan.trust[-1].min())))


def test_plans_carry_bands_over_the_draws_they_are_made_from(workspace):
    campaign = Campaign(workspace, *ENDS, model=HierarchicalTrust())
    campaign.learner.belief = sample_prior(campaign.model, 2, 50, seed=0, n_robots=3)
    plan = campaign.ask()
    assert plan.bands.shape == (4, *plan.trust.shape)
    assert (plan.bands[-1] > plan.bands[0]).all()


def test_settings_of_draws_are_options_and_go_to_every_fit(workspace):
    sampling = {"draws": 60, "n_chains": 2}
    campaign = Campaign(workspace, *ENDS, model=PooledTrust(), sampler="exact", **sampling)
    campaign.tell(ModelSimulator(workspace).run(campaign.ask().path, seed=0))
    sizes = campaign.posterior["posterior"].sizes
    assert (sizes["chain"], sizes["draw"]) == (2, 60)
    expected = 'target_accept, max_tree_depth are for NUTS, and the sampler is "exact"'
    with pytest.raises(TrustboError, match=expected):
        Campaign(workspace, *ENDS, target_accept=0.95, max_tree_depth=8)
    Campaign(workspace, *ENDS, sampler="nuts", target_accept=0.95)
    with pytest.raises(TrustboError, match="unknown option 'warm_up'; did you mean warmup"):
        Campaign(workspace, *ENDS, warm_up=3)
    with pytest.raises(TrustboError, match=r"warmup must be a .* from 0 on; got -1"):
        Campaign(workspace, *ENDS, sampler="nuts", warmup=-1)
