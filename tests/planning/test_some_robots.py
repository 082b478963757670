"""Robots that stay at home: the others keep their posts and their values, bit for bit."""

import json

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from every_model import FEATURES, GRID, KINDS, draws_of
from missions import walking_missions
from worlds import hillside

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.identity import map_name
from trustbo.inference import TrustFilter, params_of
from trustbo.inference.learner import learner_of, next_mission_of
from trustbo.models import (
    ContactRate,
    CoupledTrust,
    HierarchicalTrust,
    PlaceEffect,
    PooledTrust,
    RobotEffect,
    TrustParams,
)
from trustbo.planning import Planner
from trustbo.planning.plan import plan_from_record, plan_to_record
from trustbo.workspace.netcdf import workspace_from_tree, workspace_to_tree

ENDS = (4, 0), (0, 4)
GOING = ["r1", "r3"]
ROWS = [0, 2]  # of the robots that go
PATH = ((4, 0), (3, 1), (2, 2), (1, 3), (0, 4))
EFFECTS = PlaceEffect(), RobotEffect()


def observed(drift, beta0, delta_v, contact_rate, **options):
    with numpyro.plate("mission", len(drift)):
        rates = ContactRate(drift, beta0, 0.1, delta_v, **options)
        numpyro.sample("contact_rate", rates, obs=contact_rate)


def of_each_robot(awareness, contact_rate=None):
    """Weights, memory and noise of each robot, with effects of places and robots."""
    with numpyro.plate("robot", awareness.shape[2]):
        beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
        most = numpyro.sample("most", dist.HalfNormal(0.5))
        delta_v = numpyro.sample("delta_v", dist.HalfNormal(0.1))
    effects = [effect.sample() for effect in EFFECTS]
    drift = most * (1.0 - jnp.exp(-2.0 * awareness[..., 1]))
    observed(drift, beta0, delta_v, contact_rate, effects=effects)


def with_shared_noise(awareness, contact_rate=None):
    """Noise that all robots share, and a weight of each robot."""
    weight = numpyro.sample("weight", dist.HalfNormal(0.5).expand([3]).to_event(1))
    delta_s = numpyro.sample("delta_s", dist.HalfNormal(0.1))
    observed(weight * awareness[..., 0], 0.4, 0.1, contact_rate, delta_s=delta_s)


def of_the_best(awareness, contact_rate=None):
    """Trust in each robot that depends on the best of them."""
    weight = numpyro.sample("weight", dist.HalfNormal(0.5))
    best = awareness[..., 0].max(-1, keepdims=True)
    observed(weight * best + 0.0 * awareness[..., 0], 0.4, 0.1, contact_rate)


MODELS = {
    "pooled": PooledTrust(effects=EFFECTS),
    "places": PooledTrust(effects=(PlaceEffect(),), memory="deviation", shared_noise=True),
    "hierarchical": HierarchicalTrust(effects=EFFECTS),
    "function": of_each_robot,
    "function with shared noise": with_shared_noise,
}


@pytest.fixture(scope="module")
def workspace():
    z = np.random.default_rng(3).uniform(size=(3, 8, 5, 5, 2))
    return tb.Workspace.from_awareness(z, cell_size=20.0)


@pytest.fixture(scope="module")
def missions():
    return walking_missions(0)


@pytest.fixture(scope="module", params=MODELS)
def posterior(request, workspace, missions):
    options = {"draws": 50, "seed": 0, "latent": False, "progress": False}
    return tb.fit(missions, MODELS[request.param], workspace=workspace, **options)


def assert_rows(found, whole, axis):
    """An array of the robots that go has the rows of the whole, or is shared by all robots."""
    rows = whole if whole.shape[axis] == 1 else np.take(whole, ROWS, axis)
    np.testing.assert_array_equal(found, rows)


def test_draws_of_some_robots_are_those_of_the_team_without_the_others(posterior, workspace):
    some = workspace.of_robots(GOING)
    for found, whole in zip(
        next_mission_of(posterior, some), next_mission_of(posterior, workspace), strict=True
    ):
        assert found.robots == ("r1", "r3")
        selected = whole.in_order(GOING, workspace.features)
        for draws in (found, selected):
            inputs = whole.inputs(workspace.awareness.values)
            assert_rows(draws.inputs(some.awareness.values), inputs, 1)

            [form, of_team] = draws.state_space(2), whole.state_space(3)
            assert_rows(np.diagonal(form.over_robots(2), axis1=1, axis2=2),
                        np.diagonal(of_team.over_robots(3), axis1=1, axis2=2), 1)  # fmt: skip


def test_trust_in_some_robots_is_that_in_the_team_without_the_others(posterior, workspace):
    planners = [Planner(w, *ENDS, "terminal") for w in (workspace.of_robots(GOING), workspace)]
    found, whole = (planner.trust(posterior) for planner in planners)
    np.testing.assert_array_equal(found, whole.sel(robot=GOING))
    for expected in (False, True):
        found, whole = (planner.robot_maps(posterior, expected=expected) for planner in planners)
        np.testing.assert_array_equal(found["trust_mean"], whole["trust_mean"].sel(robot=GOING))

    found, whole = (planner.trust_map(posterior, per_robot=True) for planner in planners)
    np.testing.assert_array_equal(found, whole.isel(robot=ROWS))
    assert planners[0].maps(posterior, n_draws=5)["trust_mean"].notnull().any()

    found, whole = (planner.evaluate(PATH, posterior) for planner in planners)
    np.testing.assert_array_equal(found.trust, whole.trust[:, ROWS])
    np.testing.assert_array_equal(found.bands, whole.bands[..., ROWS])
    assert planners[0].plan(posterior).robots == ("r1", "r3")


def test_a_filter_follows_some_robots_as_if_the_others_were_not_measured(posterior, workspace):
    some = workspace.of_robots(GOING)
    alone, team = (TrustFilter(posterior, workspace=w) for w in (some, workspace))
    z = workspace.along(PATH)
    for k in range(2):
        bound = PATH[k], PATH[k + 1]
        found = alone.update(some.along(PATH)[k], [0.3, 0.8], bound)
        whole = team.update(z[k], [0.3, np.nan, 0.8], bound)
        np.testing.assert_allclose(found.mean, whole.mean[ROWS], rtol=1e-10)
        np.testing.assert_allclose(found.sd, whole.sd[ROWS], rtol=1e-8)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if "coupled" not in kind])
def test_parameters_of_every_kind_keep_their_values(kind):
    given = draws_of(kind)
    names = {"robots": ("r1", "r2", "r3"), "features": FEATURES}
    draws = given.replace(**names)
    found = draws.in_order(GOING, FEATURES)
    z = np.random.default_rng(1).uniform(size=(3, 8, *GRID, 2))
    assert_rows(found.inputs(z[ROWS]), draws.inputs(z), 1)
    again = found.in_order(GOING[::-1], FEATURES).in_order(GOING, FEATURES)
    np.testing.assert_array_equal(again.inputs(z[ROWS]), found.inputs(z[ROWS]))


def test_robots_that_influence_each_other_cannot_stay_at_home(workspace, missions):
    draws = draws_of("coupled").replace(robots=("r1", "r2", "r3"), features=FEATURES)
    with pytest.raises(TrustboError, match="CoupledTrust"):
        draws.in_order(GOING, FEATURES)

    some = workspace.of_robots(GOING)
    options = {"draws": 50, "seed": 0, "latent": False, "progress": False}
    for model in (CoupledTrust(), of_the_best):
        posterior = tb.fit(missions, model, **options)
        with pytest.raises(TrustboError, match="depends on"):
            Planner(some, *ENDS, "terminal").plan(posterior)


def test_a_posterior_without_a_robot_that_goes_is_refused(workspace, missions):
    model = HierarchicalTrust(effects=(RobotEffect(),))
    less = [mission.of_robots(["r1", "r2"]) for mission in missions]
    posterior = tb.fit(less, model, draws=50, seed=0, latent=False, progress=False)
    with pytest.raises(TrustboError, match="robots"):
        params_of(posterior, workspace.of_robots(GOING))

    known = params_of(posterior, workspace.of_robots(["r2"]), next_mission=True)
    whole = params_of(posterior, next_mission=True)
    np.testing.assert_array_equal(known.beta, whole.beta[:, [1]])


def test_prior_draws_of_some_robots_are_those_of_the_team(workspace):
    learner = learner_of(HierarchicalTrust(), workspace)
    some = workspace.of_robots(GOING)
    calls = {"prior_draws": (20, 0), "first_mission": (20, 0), "prior_mean": ()}
    for name, options in calls.items():
        found, whole = (getattr(learner, name)(*options, w) for w in (some, workspace))
        found, whole = (d.drawn if name == "first_mission" else d for d in (found, whole))
        np.testing.assert_array_equal(found.beta0, whole.beta0[:, ROWS])


@pytest.fixture(scope="module")
def ground():
    team = tb.Team(robots=[tb.Robot(), tb.Robot(speed=1.0), tb.Robot()])
    return tb.Workspace.from_terrain(hillside(90.0, 120.0), (3, 4), team, n_posts=2)


def test_robots_that_go_keep_their_posts_and_routes(ground):
    some = ground.of_robots(["r3", "r2"])
    a, c, b = (2, 0, "far"), (1, 1), (0, 2)
    np.testing.assert_array_equal(some.posts.watching(a, c), ground.posts.watching(a, c)[1:])
    np.testing.assert_array_equal(some.posts.stop(c), ground.posts.stop(c))
    lead, _, *others = ground.posts.bound_routes(a, c, b)
    for found, route in zip(some.posts.bound_routes(a, c, b), [lead, *others], strict=True):
        np.testing.assert_array_equal(found, route)

    path = (2, 0), (1, 1), (0, 2)
    np.testing.assert_array_equal(some.along(path), ground.along(path)[:, 1:])
    assert some.difficulty is ground.difficulty
    assert some.passable_bounds is ground.passable_bounds
    assert map_name(some) == map_name(ground)


def test_posts_do_not_depend_on_who_asks_first():
    terrain = hillside(90.0, 120.0)
    team = tb.Team(robots=[tb.Robot(target_height=2.0), tb.Robot(), tb.Robot()])
    first, second = (tb.Workspace.from_terrain(terrain, (3, 4), team) for _ in range(2))
    some = first.of_robots(["r3"])
    for cell in ((2, 0), (1, 1), (0, 3)):
        found = some.posts.watching(cell, None)
        np.testing.assert_array_equal(found, second.posts.watching(cell, None)[[2]])
        np.testing.assert_array_equal(some.posts.stop(cell), second.posts.stop(cell))


def test_the_same_names_in_any_order_are_the_same_workspace(workspace):
    some = workspace.of_robots(["r3", "r1"])
    assert some is workspace.of_robots(("r1", "r3"))
    assert some.team.names == ("r1", "r3")
    assert some.whole is workspace
    assert workspace.of_robots(["r3", "r2", "r1"]) is workspace
    assert some.of_robots(["r3"]).whole is workspace


@pytest.mark.parametrize("names", [[], ["r1", "r1"], ["r9"], ["lead"], "r1"])
def test_wrong_names_of_robots_are_refused(workspace, missions, names):
    for of_robots in (workspace.of_robots, missions[0].of_robots, workspace.team.of_robots):
        with pytest.raises(TrustboError, match="robots"):
            of_robots(names)


def test_a_threat_is_known_to_robots_that_go(workspace):
    some = workspace.of_robots(GOING).with_threat()
    assert some.features == workspace.with_threat().features
    assert some.whole.features == some.features


def test_a_mission_of_some_robots_has_their_measurements_only(missions):
    mission = missions[0]
    n_bounds = len(mission.contact_rate)
    rng = np.random.default_rng(0)
    poses = tuple(rng.normal(size=(4, 4, 3)) for _ in range(n_bounds))
    contact = tuple(rng.random((4, 3)) < 0.5 for _ in range(n_bounds))
    given = tb.Mission(**{**vars_of(mission), "poses": poses, "contact": contact})

    some = given.of_robots(["r3", "r1"])
    assert some.robots == ("r1", "r3")
    assert (some.path, some.status, some.starts) == (given.path, given.status, given.starts)
    for name in ("awareness", "contact_rate", "duration", "n_ticks"):
        np.testing.assert_array_equal(getattr(some, name), getattr(given, name)[:, ROWS])
    for k in range(n_bounds):
        np.testing.assert_array_equal(some.poses[k], poses[k][:, [0, 1, 3]])
        np.testing.assert_array_equal(some.contact[k], contact[k][:, ROWS])
    assert given.of_robots(given.robots) is given


def vars_of(mission):
    """Arguments that make a mission."""
    return {name: getattr(mission, name) for name in mission.__dataclass_fields__}


def test_a_record_of_a_plan_knows_who_goes(ground):
    some = ground.of_robots(["r1", "r3"])
    params = TrustParams(0.5, np.array([0.1, 0.1, 0.4]), 0.1, 0.1, 0.1, 0.5, 0.5)
    plan = Planner(some, (2, 0), (0, 3)).plan(params)
    record = json.loads(json.dumps(plan_to_record(plan)))
    restored = plan_from_record(record, ground)
    assert restored.workspace is some
    assert restored.robots == ("r1", "r3")
    np.testing.assert_array_equal(restored.posts, plan.posts)
    assert "trust_r2" not in restored.to_frame()

    del record["robots"]
    assert plan_from_record(record, ground).workspace is ground


def test_a_stored_workspace_knows_who_goes(ground):
    some = ground.of_robots(["r1", "r3"])
    restored = workspace_from_tree(workspace_to_tree(some))
    assert restored.team == some.team
    assert restored.whole.team == ground.team
    np.testing.assert_array_equal(restored.awareness, some.awareness)
    np.testing.assert_array_equal(
        restored.posts.watching((1, 1), None), some.posts.watching((1, 1), None)
    )
