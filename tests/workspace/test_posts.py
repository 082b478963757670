"""Sets of posts: where T2 stands, what it sees, and how paths, files and plans carry the set."""

import json

import numpy as np
import pytest
from worlds import hillside

import trustbo as tb
from trustbo.data import POST_SETS
from trustbo.simulation import KinematicSimulator
from trustbo.workspace import MOVES
from trustbo.workspace.line_of_sight import N_SAMPLES, Geometry, bound_features
from trustbo.workspace.moves import bounds_along, pairs_along, way_names
from trustbo.workspace.posts import SETS

ENDS = (2, 0), (0, 2)
ROUTE = ((2, 0, "far"), (1, 1), (1, 2, "route"), (0, 2))
"""A path with two sets of posts beside the standard one."""


@pytest.fixture(scope="module")
def workspace():
    return tb.Workspace.from_terrain(hillside(), (3, 3))


@pytest.fixture(scope="module")
def result(workspace):
    simulator = KinematicSimulator(workspace)
    return tb.iterate(workspace, *ENDS, simulator=simulator, n_iterations=3, seed=1)


def test_the_standard_set_is_that_of_a_workspace_with_one_set(workspace):
    one = tb.Workspace.from_terrain(hillside(), (3, 3), n_posts=1)
    assert (one.n_posts, one.post_sets) == (1, ("standard",))
    assert workspace.post_sets == POST_SETS == tuple(SETS)
    assert workspace.awareness["move"].values.tolist() == way_names(4)
    np.testing.assert_array_equal(workspace.awareness.values[:, :8], one.awareness.values)
    np.testing.assert_array_equal(
        workspace.awareness.sel(move="ne").values, one.awareness.sel(move="ne").values
    )

    visibility = workspace.awareness.sel(feature="visibility").values
    np.testing.assert_array_equal(visibility[:, 8:16], visibility[:, :8])  # that of the cell
    sight = workspace.awareness.sel(feature="line_of_sight").values
    assert np.nanmax(np.abs(sight[:, 8:16] - sight[:, :8])) > 0.01


@pytest.mark.parametrize("name", POST_SETS)
def test_posts_keep_the_distances_of_their_set(workspace, name):
    posts = workspace.posts
    stop = posts.stop((1, 1))
    places = posts.watching((1, 1, name), (0, 1))
    assert (np.linalg.norm(places - stop, axis=1) <= SETS[name].radius + 1.0).all()

    apart = np.linalg.norm(places[:, None] - places, axis=2) + 1e9 * np.eye(len(places))
    room = name != "far"  # on a hillside of 90 m, posts 20 m apart may be too few
    assert apart.min() >= (SETS[name].gap if room else 2.0) - 1e-9
    np.testing.assert_array_equal(posts.watching((1, 1, name), None), posts.watching((1, 1), None))


@pytest.mark.parametrize("name", POST_SETS)
def test_posts_do_not_coincide_where_all_positions_are_within_the_gap(name):
    workspace = tb.Workspace.from_terrain(hillside(), (3, 3), bounds=False)
    posts = workspace.posts
    stop = posts.stop((1, 1))
    around = stop + np.array([[4.0, 0.0], [0.0, 4.0], [4.0, 4.0]])
    posts._lattice = lambda *_: around

    places = posts.watching((1, 1, name), (0, 1))
    assert len(np.unique(places, axis=0)) == len(around)


def test_the_change_by_the_next_way_is_that_of_the_line_of_sight(workspace):
    """Against `bound_features`, which closes up to one set of posts, for random pairs of bounds."""
    posts = workspace.posts
    pairs = np.argwhere(np.isfinite(workspace.onward.values).all(0))
    some = pairs[np.random.default_rng(0).permutation(len(pairs))[:300]]
    given = {"routes": [], "posts": [], "ends": [], "stops": []}
    for way, row, col, after in some.tolist():
        (down, right), (i, j) = MOVES[way % 8], MOVES[after % 8]
        a, c, b = (row - down, col - right), (row, col), (row + i, col + j)
        given["routes"].append(posts.lead_line(a, c))
        given["posts"].append(posts.watching((*a, POST_SETS[way // 8]), c))
        end = posts.watching((*c, POST_SETS[after // 8]), b)
        given["ends"].append(np.repeat(end[None], N_SAMPLES, axis=0))
        given["stops"].append(posts.stop(c))

    geometry = Geometry(given["routes"], *map(np.array, (given[k] for k in list(given)[1:])))
    everywhere = np.ones(posts.surface.ground.shape)
    exact, _ = bound_features(posts.surface, posts.sight, posts.team, geometry, everywhere)
    sight = workspace.of_pairs(some)[..., -1].T
    usual = workspace.awareness.values[:, *some[:, :3].T, -1].T
    off = exact - sight
    assert np.sqrt(np.mean(off**2)) < 0.6 * np.sqrt(np.mean((exact - usual) ** 2))
    assert abs(off.mean()) < 0.005


def test_ways_are_moves_with_a_set_of_posts():
    np.testing.assert_array_equal(bounds_along(ROUTE), [[2 + 8, 1, 1], [4, 1, 2], [1 + 16, 0, 2]])
    expected = [[2 + 8, 1, 1, 4], [4, 1, 2, 1 + 16], [1 + 16, 0, 2, 24]]
    np.testing.assert_array_equal(pairs_along(ROUTE, 3), expected)


def test_a_mission_measures_the_awareness_of_its_posts(workspace):
    simulator = KinematicSimulator(workspace)
    mission = simulator.run(ROUTE, seed=3)
    assert mission.stations == ROUTE
    assert mission.path == ((2, 0), (1, 1), (1, 2), (0, 2))
    assert mission.post_sets == ("far", "standard", "route")
    named = simulator.run(mission.path, seed=3, post_sets=mission.post_sets)
    assert named.has_same_data(mission)
    assert [bound.cell for bound in mission.bounds] == [(1, 1), (1, 2), (0, 2)]
    of_path = workspace.awareness.values[:, [10, 4, 17], [1, 1, 0], [1, 2, 2]]
    of_path[:, :2, -1] += workspace.onward.values[:, [10, 4], [1, 1], [1, 2], [4, 17]]
    expected = np.swapaxes(np.clip(of_path, 0.0, 1.0), 0, 1)
    np.testing.assert_allclose(mission.awareness, expected, rtol=0.0, atol=1e-12)

    first = mission.bounds[0].poses[0, 1:, :2]
    off = np.linalg.norm(first - workspace.posts.watching((2, 0, "far"), (1, 1)), axis=1)
    assert off.max() < 3.0
    plain = simulator.run(mission.path, seed=3)
    assert plain.post_sets == ()
    assert not np.array_equal(plain.bounds[0].poses[0], mission.bounds[0].poses[0])


def test_a_campaign_chooses_sets_and_its_files_keep_them(workspace, result, tmp_path):
    plan = result.plan()
    assert all(len(cell) == 2 for one in (plan, *result.missions) for cell in one.path)
    assert len({name for mission in result.missions for name in mission.post_sets}) > 1
    assert (result.table()["state"] == "learned").all()
    np.testing.assert_array_equal(plan.posts[0], workspace.posts.watching(*plan.stations[:2]))
    assert plan.to_frame()["posts"].isin([*POST_SETS, ""]).all()
    assert result.history["posts"].values.max() > 0

    read = tb.logs.read_table(tb.logs.to_frame(result.missions))
    assert [one.stations for one in read] == [one.stations for one in result.missions]
    tb.logs.write_missions(tmp_path / "log.nc", result.missions)
    stored = tb.logs.read_missions(tmp_path / "log.nc")
    assert all(a.has_same_data(b) for a, b in zip(stored, result.missions, strict=True))

    tb.export.write_geojson(tmp_path / "plan.geojson", plan)
    features = json.loads((tmp_path / "plan.geojson").read_text())["features"]
    names = [f["properties"]["posts"] for f in features if "robot" in f["properties"]
             and "posts" in f["properties"]]  # fmt: skip
    assert len(names) == 3 * (len(plan.path) - 1)
    assert set(names) == {(*cell, POST_SETS[0])[2] for cell in plan.stations[:-1]}


def test_a_stored_campaign_with_sets_resumes_as_if_it_had_not_stopped(workspace, result, tmp_path):
    simulator = KinematicSimulator(workspace)
    folder = tmp_path / "campaign"
    tb.iterate(workspace, *ENDS, simulator=simulator, n_iterations=2, seed=1, directory=folder)
    again = tb.resume(folder, n_iterations=3, simulator=simulator)
    assert again.workspace.n_posts == 3
    assert again.workspace.onward.identical(workspace.onward)
    paths = [mission.stations for mission in result.missions]
    assert [mission.stations for mission in again.missions] == paths
    assert again.plan().stations == result.plan().stations


class Cells:
    """Simulator that knows cells only, as a user's may."""

    def __init__(self, workspace):
        self.inner = KinematicSimulator(workspace)

    def run(self, path, *, seed, mission=0):
        cells = [(row, col) for row, col in path]
        return self.inner.run(cells, seed=seed, mission=mission)


class Sets(Cells):
    """Simulator that also reads the sets of posts."""

    def run(self, path, *, seed, mission=0, post_sets=()):
        self.asked = post_sets
        return self.inner.run(path, seed=seed, mission=mission, post_sets=post_sets)


def test_a_simulator_gets_sets_if_it_reads_them_and_otherwise_cells(workspace, result):
    options = {"n_iterations": 1, "seed": 1}
    cells, sets = Cells(workspace), Sets(workspace)
    with pytest.warns(UserWarning, match="n_posts=1"):
        plain = tb.iterate(workspace, *ENDS, simulator=cells, **options)
    [mission] = plain.missions
    assert mission.post_sets == ()  # the standard posts, whatever was planned
    assert plain.table()["posts"].tolist() == [" ".join(result.missions[0].post_sets)]

    named = tb.iterate(workspace, *ENDS, simulator=sets, **options)
    assert sets.asked == named.missions[0].post_sets == result.missions[0].post_sets != ()


def test_names_of_sets_are_one_for_each_bound():
    z, rates = np.full((2, 3, 2), np.nan), np.full((2, 3), 0.5)
    path = [(2, 0), (1, 0), (0, 1)]
    mission = tb.Mission.from_arrays(path, z, rates, post_sets=("standard", "far"))
    assert mission.stations == ((2, 0), (1, 0, "far"), (0, 1))
    assert tb.Mission.from_arrays(mission.stations, z, rates).has_same_data(mission)
    assert tb.Mission.from_arrays(path, z, rates, post_sets=["standard"] * 2).post_sets == ()
    with pytest.raises(tb.TrustboError, match="post_sets must be 2 names, one for each bound"):
        tb.Mission.from_arrays(path, z, rates, post_sets=["far"])
    with pytest.raises(tb.TrustboError, match=r"unknown post_sets\[1\] 'near'"):
        tb.Mission.from_arrays(path, z, rates, post_sets=["far", "near"])


def test_a_mission_whose_first_bound_has_other_posts_is_learned(workspace):
    campaign = tb.Campaign(workspace, *ENDS)
    campaign.tell(KinematicSimulator(workspace).run(ROUTE, seed=3))
    assert campaign.table()["state"].tolist() == ["learned"]
    assert "bound_move" in campaign.posterior["places"].coords


def test_a_path_gets_the_sets_at_whose_posts_the_robots_stood(workspace):
    mission = KinematicSimulator(workspace).run(ROUTE, seed=3)
    stood = np.stack([bound.poses[0, 1:, :2] for bound in mission.bounds])
    cells = mission.path
    assert workspace.post_sets_of(cells, stood) == mission.post_sets
    unknown = np.full(stood.shape, np.nan)
    assert workspace.post_sets_of(cells, unknown) == ("standard", "standard", "standard")

    stood[1] += 100.0
    with pytest.raises(tb.TrustboError, match=r"stood 1[0-9]{2} m from its post .* cell \(1, 1\)"):
        workspace.post_sets_of(cells, stood)
    with pytest.raises(tb.TrustboError, match=r"\(bound, robot, 2\) = \(3, 3, 2\); got"):
        workspace.post_sets_of(cells, stood[0])
    with pytest.raises(tb.TrustboError, match="made from a terrain"):
        tb.Workspace.from_awareness(np.ones((3, 3, 3, 1))).post_sets_of(cells, stood)


def test_trust_is_that_of_the_posts_asked_for(workspace, result):
    usual = result.trust("r1", (1, 1), move="ne")
    far = result.trust("r1", (1, 1), move="ne", posts="far")
    assert float(np.abs(usual.mean() - far.mean())) > 1e-4
    with pytest.raises(tb.TrustboError, match="unknown posts 'near'; choose one of standard, far"):
        result.trust("r1", (1, 1), posts="near")


def test_a_team_that_follows_a_plan_and_turns_off_has_the_standard_posts(workspace, result):
    campaign = tb.Campaign(workspace, *ENDS)
    plan = campaign.ask()
    follower = tb.Follower(campaign)
    follower.begin(t=0.0, cell=plan.path[1])
    assert (follower.path, follower.post_sets) == (plan.path, plan.post_sets)
    follower.tick(1.0, [True, True, False])
    follower.end(t=10.0, status="stuck")
    assert follower.to_mission().post_sets == plan.post_sets
    rest = follower.replan(blocked=[plan.path[:2]])
    assert rest.start == plan.start


@pytest.mark.parametrize(
    ("path", "problem"),
    [
        ([(2, 0, "near"), (1, 1)], "unknown the posts of path.0. 'near'; choose one of standard"),
        ([(2, 0, 1), (1, 1)], "two whole numbers"),
        ([(2, 0, "far", 1), (1, 1)], "two whole numbers"),
    ],
)
def test_unknown_sets_are_refused(workspace, path, problem):
    with pytest.raises(tb.TrustboError, match=problem):
        KinematicSimulator(workspace).run(path, seed=0)


def test_sets_that_a_workspace_does_not_offer_are_refused():
    two = tb.Workspace.from_terrain(hillside(), (3, 3), n_posts=2)
    with pytest.raises(tb.TrustboError, match=r"posts of path\[2\] 'route'; choose one of"):
        two.along(ROUTE)
    with pytest.raises(tb.TrustboError, match="n_posts must be at most 3"):
        tb.Workspace.from_terrain(hillside(), (3, 3), n_posts=5)
    with pytest.raises(tb.TrustboError, match="n_posts > 1 needs line of sight"):
        tb.Workspace.from_terrain(hillside(), (3, 3), n_posts=2, bounds=False)


def test_a_posterior_scores_sets_of_the_workspace_that_no_mission_used(workspace):
    simulator = KinematicSimulator(workspace)
    path = [(2, 0), (2, 1), (2, 2), (1, 2)]
    driven = [simulator.run(path, post_sets=["far"] * 3, seed=seed) for seed in range(2)]
    other = [simulator.run(path, post_sets=["route"] * 3, seed=2)]
    known = tb.fit(driven, workspace=workspace)
    assert np.isfinite(tb.inference.score(known, other)["log_score"].values).all()
    with pytest.raises(tb.TrustboError, match="the posts 'route'"):
        tb.inference.score(tb.fit(driven), other)


def test_no_other_set_of_a_bound_makes_the_plan_better(workspace, result):
    table = result.compare_posts()
    n_bounds = len(result.plan().path) - 1
    assert table.index.get_level_values("bound").unique().tolist() == [*range(1, n_bounds + 1)]
    assert (table["chosen"].groupby("bound").sum() == 1).all()
    best = table.groupby("bound")["value"].max()
    np.testing.assert_allclose(
        table.query("chosen")["value"].droplevel(1), best, rtol=0, atol=1e-12
    )

    stations = result.plan().stations
    other = [(*stations[0][:2], "far"), *stations[1:]]
    expected = result.planner.evaluate(other, result.belief.mean())
    assert table.loc[(1, "far"), "value"] == pytest.approx(expected.value)
    assert table.loc[(1, "far"), "trust"] == pytest.approx(expected.trust[0].mean())


def test_a_graph_has_an_edge_for_each_set(workspace, result):
    graph = result.planner.graph(result.posterior)
    assert graph.is_multigraph()
    assert set(graph[2, 0][1, 1]) == set(POST_SETS)
    least = min(edge["lost"] for edge in graph[2, 0][1, 1].values())
    assert least < graph[2, 0][1, 1]["standard"]["lost"] + 1e-12


def test_the_explorer_shows_the_posts_of_plans_and_missions(result):
    html = result.explore().html
    other = {*result.plan().post_sets} - {POST_SETS[0]}
    assert other
    assert all(f"{name} posts" in html for name in other)


def test_nav2_files_lead_to_the_posts_of_the_plan_and_cost_the_best_set(result, tmp_path):
    tb.export.write_nav2(tmp_path, result)
    plan = result.plan()
    frame = tb.export.Frame(result.workspace.grid.corner)
    for i, robot in enumerate(result.workspace.team.names):
        poses = json.loads((tmp_path / f"waypoints_{robot}.yaml").read_text())["poses"]
        places = [[pose["pose"]["position"][axis] for axis in "xy"] for pose in poses]
        found = frame.to_crs(places)[: len(plan.posts)]
        np.testing.assert_allclose(found, plan.posts[:, i], atol=1e-6)

    n_cols = result.workspace.grid.shape[1]
    features = json.loads((tmp_path / "route_graph.geojson").read_text())["features"]
    edges = [f["properties"] for f in features if "startid" in f["properties"]]
    costs = {(edge["startid"], edge["endid"]): edge["cost"] for edge in edges}
    assert len(costs) == len(edges)
    a, c = plan.path[:2]
    graph, price = result.planner.graph(result.posterior), result.planner.problem.cost_of_failure
    p_fail = np.nanmean(result.risk.mean[bounds_along([a, c])[0][0] :: len(MOVES), *c], axis=-1)
    losses = [graph[a][c][name]["lost"] for name in POST_SETS]
    least = min(lost + price * p for lost, p in zip(losses, p_fail, strict=True))
    assert costs[a[0] * n_cols + a[1], c[0] * n_cols + c[1]] == pytest.approx(least)
