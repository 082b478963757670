"""Ask and tell: what a campaign plans, learns, excludes and refuses."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from worlds import ModelSimulator, hillside, random_cells

import trustbo as tb
from trustbo.data import Mission
from trustbo.inference import fit
from trustbo.models import CoupledTrust, HierarchicalTrust, PooledTrust
from trustbo.models.record import model_to_record

ENDS = ((3, 0), (0, 3))
DIAGONAL = ((3, 0), (2, 1), (1, 2), (0, 3))


@pytest.fixture(scope="module")
def workspace():
    return random_cells()


def begin(workspace, **options):
    usual = {"model": PooledTrust(), "sampler": "importance", "objective": "mean"}
    return tb.Campaign(workspace, *ENDS, **usual | options)


def rates(workspace, path, seed=0, **options):
    return ModelSimulator(workspace, blind=True, **options).run(path, seed=seed)


def states(campaign):
    return campaign.table()["state"].tolist()


def refuse(*args, **kwargs):
    raise tb.PosteriorError("R-hat of beta0 is 1.5.")


@pytest.mark.filterwarnings("ignore:the refit without mission")  # of so few missions
@pytest.mark.filterwarnings("ignore:Estimated shape parameter")
def test_floating_point_errors_of_users_are_not_raised_by_the_library():
    workspace = tb.Workspace.from_terrain(hillside(), (3, 3))
    robots = tb.simulation.KinematicSimulator(workspace)
    with np.errstate(all="raise"):
        campaign = tb.Campaign(workspace, (2, 0), (0, 2), planner={"max_failure": 0.5})
        for n in range(2):
            campaign.tell(robots.run(campaign.ask().path, seed=n, mission=n))
        campaign.fail("stuck", where=campaign.ask().path[1])
        campaign.ask()
        campaign.maps()
        tb.check(campaign.posterior)
        for model in (CoupledTrust(), PooledTrust(family="censored")):
            posterior = fit(campaign.missions, model, workspace=workspace, draws=100)
        tb.inference.loo(posterior)
        follow = tb.inference.TrustFilter(posterior)
        follow.predict(campaign.missions[0].awareness[:, :, : len(workspace.features)])
        follow.update(campaign.missions[0].awareness[0], [0.0, 1.0, np.nan])


def test_ask_returns_the_same_plan_until_a_mission_is_told(workspace):
    campaign = begin(workspace, policy="thompson")
    plan = campaign.ask()
    assert campaign.ask() is plan
    assert campaign.state.last is None
    posterior = campaign.tell(rates(workspace, plan.path))
    np.testing.assert_array_equal(campaign.posterior["posterior"]["b"], posterior["posterior"]["b"])
    assert campaign.posterior is campaign.posterior
    assert campaign.missions[0].path == plan.path
    assert campaign.ask() is not plan


def test_first_plan_is_from_the_mean_of_the_prior_or_from_one_draw(workspace):
    first = [begin(workspace, initial="prior_draw", seed=s).belief for s in range(2)]
    assert np.shape(first[0].beta) == (1, 2)
    assert first[0].beta0[0] != first[1].beta0[0]
    mean = begin(workspace).belief
    np.testing.assert_allclose(mean.beta0, [0.5])
    np.testing.assert_allclose(mean.beta, [[0.0, 0.0]])


def test_default_model_is_that_of_fit(workspace):
    record = model_to_record(tb.Campaign(workspace, *ENDS).model)
    assert record == model_to_record(tb.models.default_model())
    assert [effect["kind"] for effect in record["effects"]] == ["PlaceEffect", "RobotEffect"]


def test_posterior_is_that_of_all_missions_with_the_awareness_of_the_map(workspace):
    """What robots measure is half of what the map has; plans go by the map."""
    lower = tb.Workspace.from_awareness(0.5 * workspace.awareness.values)
    campaign = begin(workspace, fit={"draws": 300})
    for j in range(2):
        seed, before = campaign.state.seed_of("fit"), campaign.state.posterior
        campaign.tell(ModelSimulator(lower).run(campaign.ask().path, seed=j))
    expected = [replace(m, awareness=workspace.along(m.path)) for m in campaign.missions]
    again = fit(expected, PooledTrust(), seed=seed, draws=300, start=before)
    for group in ("posterior", "log_likelihood"):
        for name, values in again[group].data_vars.items():
            np.testing.assert_array_equal(values, campaign.posterior[group][name])
    measured = campaign.state.entries[0].measured.awareness[0]
    np.testing.assert_array_equal(measured, 0.5 * campaign.missions[0].awareness[0])


def test_options_of_planner_and_fit_are_passed_on(workspace):
    campaign = begin(workspace, fit={"draws": 60, "chains": 2}, planner={"max_bounds": 5})
    assert campaign.planner.max_bounds == 5
    sizes = campaign.tell(rates(workspace, campaign.ask().path))["posterior"].sizes
    assert (sizes["chain"], sizes["draw"]) == (1, 120)
    with pytest.raises(TypeError, match="drws"):
        begin(workspace, fit={"drws": 3})
    for option in ("sampler", "seed", "earlier"):  # arguments of the campaign
        with pytest.raises(tb.TrustboError, match=f"{option}.*fit="):
            begin(workspace, fit={option: None})
    with pytest.raises(tb.TrustboError, match=r"objective.*planner="):
        begin(workspace, planner={"objective": "mean"})
    with pytest.raises(tb.TrustboError, match="itself"):
        begin(workspace, fit={"start": None})
    with pytest.raises(TypeError, match="max_bound"):
        begin(workspace, planner={"max_bound": 3})


@pytest.mark.parametrize("model", [HierarchicalTrust(), CoupledTrust()])
def test_every_model_plans_with_bands(model):
    campaign = tb.Campaign(random_cells(2), *ENDS, model=model, objective="terminal")
    plan = campaign.ask()
    assert plan.trust.shape[1] == 2
    assert plan.bands.shape == (4, *plan.trust.shape)


def test_recommendation_is_greedy_whatever_the_policy(workspace):
    campaign = begin(workspace, policy="random")
    campaign.tell(rates(workspace, campaign.ask().path))
    assert campaign.recommend().path == campaign.planner.plan(campaign.belief.mean()).path


def test_custom_policy_is_called_and_checked(workspace):
    def leaps(rng, draws, planner):
        return replace(planner.plan(draws.mean()), path=((3, 0), (1, 1), (0, 3)))

    def diagonal(rng, draws, planner):
        return planner.evaluate(DIAGONAL, draws.mean())

    assert begin(workspace, policy=diagonal).ask().path == DIAGONAL
    with pytest.raises(tb.TrustboError, match="leaps"):
        begin(workspace, policy=leaps).ask()
    with pytest.raises(tb.TrustboError, match="policy"):
        begin(workspace, policy=lambda rng, draws, planner: DIAGONAL).ask()


@pytest.mark.parametrize("policy", ["thompson", "random"])
def test_jax_flags_of_the_caller_do_not_change_a_campaign(workspace, policy):
    def paths(*flags):
        campaign = begin(workspace, policy=policy, seed=3, fit={"draws": 100})
        for j, x64 in enumerate(flags):
            with jax.enable_x64(x64), jax.threefry_partitionable(not x64):
                campaign.tell(rates(workspace, campaign.ask().path, seed=j))
        return [entry.plan.path for entry in campaign.state.entries]

    assert paths(False, False, False) == paths(True, True, True)


# --- missions that are refused, wait, or are excluded ---


@pytest.mark.parametrize(
    "path",
    [
        [(3, 0), (1, 2), (0, 3)],  # with a jump
        [(3, 0), (2, 1), (9, 9)],  # off the grid
    ],
)
def test_mission_on_an_impossible_path_is_refused_and_not_recorded(workspace, tmp_path, path):
    n = len(path) - 1
    mission = Mission.from_arrays(path, np.full((n, 3, 2), 0.5), np.full((n, 3), 0.7))
    with begin(workspace, directory=tmp_path) as campaign:
        with pytest.raises(tb.TrustboError):
            campaign.tell(mission)
        assert campaign.missions == []
        assert not (tmp_path / "missions").exists()


def test_mission_of_another_team_is_refused(workspace):
    campaign = begin(workspace)
    other = Mission.from_arrays(DIAGONAL[:2], np.full((1, 2, 2), 0.5), np.full((1, 2), 0.5))
    with pytest.raises(tb.TrustboError, match="robots"):
        campaign.tell(other)
    with pytest.raises(tb.TrustboError, match="mission"):
        campaign.tell([rates(workspace, DIAGONAL)])
    assert campaign.missions == []


def test_other_paths_and_cut_missions_are_learned_from(workspace):
    campaign = begin(workspace, fit={"draws": 100})
    campaign.suggest(DIAGONAL)
    assert campaign.ask().path == DIAGONAL
    other = ((3, 0), (2, 0), (1, 1), (0, 2), (0, 3))
    assert campaign.tell(rates(workspace, other)) is not None
    part = Mission.from_arrays(DIAGONAL[:3], np.full((2, 3, 2), 0.5), np.eye(3)[:2], status="stuck")
    assert campaign.tell(part) is not None
    assert campaign.missions[0].path == other


def test_robots_and_features_are_put_in_the_order_of_the_workspace(workspace):
    z, y = np.random.default_rng(0).uniform(size=(3, 3, 2)), np.eye(3) * 0.3 + 0.5
    order, names = [2, 0, 1], ["traversability", "visibility"]
    told = [
        Mission.from_arrays(DIAGONAL, z, y),
        Mission.from_arrays(
            DIAGONAL, z[:, order][..., ::-1], y[:, order], features=names[::-1],
            robots=["r3", "r1", "r2"],
        ),
    ]  # fmt: skip
    found = []
    for mission in told:
        campaign = begin(workspace, fit={"draws": 100})
        campaign.tell(mission)
        found.append(campaign.missions[0])
    for name in ("awareness", "contact_rate"):
        np.testing.assert_array_equal(*(getattr(mission, name) for mission in found))


def test_refused_posterior_leaves_a_mission_told_until_the_next_is_learned(workspace, monkeypatch):
    campaign = begin(workspace)
    with monkeypatch.context() as patch:
        patch.setattr("trustbo.campaign.learning.fit", lambda *args, **kwargs: refuse())
        with pytest.warns(UserWarning, match="mission 1"):
            assert campaign.tell(rates(workspace, campaign.ask().path)) is None
    assert states(campaign) == ["told"]
    assert "R-hat" in campaign.table()["reason"][1]
    np.testing.assert_array_equal(campaign.belief.beta, begin(workspace).belief.beta)
    with pytest.raises(tb.TrustboError, match="posterior"):
        _ = campaign.posterior
    campaign.tell(rates(workspace, campaign.ask().path, seed=1))
    assert states(campaign) == ["learned", "learned"]
    assert campaign.posteriors[0] is None
    assert campaign.posterior["constant_data"].sizes["mission"] == 2


def test_defect_of_a_fit_costs_no_mission(workspace, monkeypatch):
    def break_down(*args, **kwargs):
        raise np.linalg.LinAlgError("Singular matrix")

    campaign = begin(workspace)
    monkeypatch.setattr("trustbo.campaign.learning.fit", break_down)
    with pytest.warns(UserWarning, match="LinAlgError"):
        campaign.tell(rates(workspace, campaign.ask().path))
    assert states(campaign) == ["told"]


def test_mission_that_measured_nothing_or_left_the_map_is_excluded():
    awareness = np.random.default_rng(0).uniform(size=(3, 4, 4, 2))
    awareness[:, 2, 1] = np.nan
    workspace = tb.Workspace.from_awareness(awareness)
    campaign = begin(workspace, fit={"draws": 100})
    detour = ((3, 0), (2, 0), (1, 1), (0, 2), (0, 3))
    nothing = Mission.from_arrays(detour, np.full((4, 3, 2), np.nan), np.full((4, 3), np.nan))
    unknown = Mission.from_arrays(DIAGONAL, np.full((3, 3, 2), np.nan), np.full((3, 3), 0.5))
    for mission in (nothing, unknown):
        with pytest.warns(UserWarning, match="excluded"):
            assert campaign.tell(mission) is None
    campaign.tell(rates(workspace, detour))
    assert states(campaign) == ["excluded", "excluded", "learned"]
    assert campaign.posterior["constant_data"]["mission"].values.tolist() == [2]


def test_a_mission_that_is_told_twice_is_refused(workspace):
    campaign = begin(workspace, fit={"draws": 100})
    mission = rates(workspace, DIAGONAL)
    campaign.tell(mission)
    with pytest.raises(tb.TrustboError, match="again=True"):
        campaign.tell(mission)
    assert len(campaign.missions) == 1


def test_excluded_mission_is_forgotten_until_it_is_told_again(workspace):
    campaign = begin(workspace, seed=1, fit={"draws": 300})
    missions = [rates(workspace, DIAGONAL, seed=j, fail_at=2) for j in range(3)]
    for mission in missions:
        campaign.tell(mission)
    assert campaign.hazard["failures"].values.sum() == 3
    before = campaign.posterior
    posterior = campaign.exclude(2, "the lidar was covered")
    seed = campaign.state.seed_of("exclude")
    assert states(campaign) == ["learned", "excluded", "learned"]
    assert campaign.table()["reason"][2] == "the lidar was covered"
    assert campaign.hazard["failures"].values.sum() == 2
    assert campaign.posterior["constant_data"]["mission"].values.tolist() == [0, 2]
    rest = [campaign.missions[j] for j in (0, 2)]
    again = fit(rest, PooledTrust(), seed=seed, draws=300, start=before)
    np.testing.assert_array_equal(again["posterior"]["beta"], posterior["posterior"]["beta"])
    wrong = (2, "again", "lidar was covered"), (4, "again", "there are 3"), (1, " ", "empty")
    for n, reason, named in (*wrong, (1, None, "None")):
        with pytest.raises(tb.TrustboError, match=named):
            campaign.exclude(n, reason)
    campaign.tell(missions[1])
    assert campaign.posterior["constant_data"].sizes["mission"] == 3
    for n in (1, 3, 4):
        last = campaign.exclude(n, "wrong field")
    assert last is None
    assert campaign.state.last is None


def test_bounds_that_were_not_run_lose_all_contact_whatever_path_a_mission_has(workspace):
    campaign = begin(workspace)
    path = campaign.ask().path
    told = rates(workspace, path, fail_at=2)
    campaign.tell(told)
    campaign.suggest(path)
    campaign.tell(replace(told, path=path[: len(told.bounds) + 1]))
    lost = campaign.table()["contact_lost"].tolist()
    assert lost[0] == lost[1] == pytest.approx(len(path) - 1 - told.contact_rate.mean(1).sum())


def test_a_mission_that_arrived_elsewhere_is_on_the_course_that_it_drove(workspace):
    campaign = begin(workspace)
    campaign.suggest(DIAGONAL)
    unknown = np.full((2, 3, 2), np.nan)
    short = Mission.from_arrays(DIAGONAL[:3], unknown, np.full((2, 3), 0.8))
    with pytest.warns(UserWarning, match="as planned"):
        campaign.tell(short)
    assert campaign.state.entries[0].course.ends == (DIAGONAL[0], DIAGONAL[2])

    campaign.suggest(DIAGONAL)
    campaign.tell(replace(short, status="aborted"))
    campaign.suggest(DIAGONAL)
    campaign.tell(replace(short, path=DIAGONAL, status="timeout"))
    assert campaign.table()["contact_lost"].tolist() == pytest.approx([0.4, 1.4, 1.4])


def test_contact_lost_is_a_sum_over_bounds_even_if_rates_are_missing(workspace):
    campaign = begin(workspace)
    campaign.suggest(DIAGONAL)
    y = np.array([[1.0, np.nan, np.nan], [0.4, 0.5, np.nan], [0.2, 0.3, 0.1]])
    unknown = np.full((3, 3, 2), np.nan)
    campaign.tell(Mission.from_arrays(DIAGONAL, unknown, y))

    y[1] = np.nan  # counts as the mean of the others
    campaign.suggest(DIAGONAL)
    campaign.tell(Mission.from_arrays(DIAGONAL, unknown, y))

    table = campaign.table()
    assert table["contact_lost"].tolist() == pytest.approx([0.0 + 0.55 + 0.8, 1.5 * (0.0 + 0.8)])
    assert table["n_unmeasured"].tolist() == [0, 1]


def test_contact_lost_without_gaps_is_that_of_the_mean_rate_to_the_last_digit(workspace):
    campaign = begin(workspace)
    told = rates(workspace, campaign.ask().path)
    campaign.tell(told)
    n = len(told.bounds)
    [lost] = campaign.table()["contact_lost"]
    assert lost == n - n * float(np.nanmean(told.contact_rate))


def test_a_failure_without_rates_counts_until_a_user_excludes_it(workspace):
    campaign = begin(workspace)
    told = rates(workspace, DIAGONAL, fail_at=2)
    told = replace(told, contact_rate=np.full(told.contact_rate.shape, np.nan))
    with pytest.warns(UserWarning, match="excluded"):
        campaign.tell(told)
    with pytest.raises(tb.TrustboError, match="recorded already"):
        campaign.tell(told)
    assert campaign.hazard["failures"].values.sum() == 1
    campaign.exclude(1, "no rates")
    assert campaign.hazard["failures"].values.sum() == 0


def test_bad_arguments_are_refused_at_once(workspace):
    for options, said in (
        ({"policy": "bold"}, "policy"),
        ({"objective": "best"}, "objective"),
        ({"sampler": "gibbs"}, "sampler"),
        ({"initial": "zero"}, "initial"),
        ({"model": "pooled"}, "model"),
        ({"hazard": 0.1}, "hazard"),
        ({"seed": -1}, "seed"),
        ({"fit": {"draws": -1}}, "draws"),
        ({"fit": {"chains": "5"}}, "chains"),
        ({"fit": {"warmup": 2.5}}, "warmup"),
        ({"planner": {"max_failure": 2.0}}, "max_failure"),
    ):
        with pytest.raises(tb.TrustboError, match=said):
            begin(workspace, **options)
    walls = np.ones((4, 4), bool)
    walls[2] = False
    with pytest.raises(tb.NoPathError):
        begin(tb.Workspace.from_awareness(workspace.awareness.values, walls))
    with pytest.raises(tb.TrustboError, match="mission"):
        _ = begin(workspace).history
