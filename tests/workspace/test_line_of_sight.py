"""Posts, routes and line of sight, compared with scalar code and with the simulator."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worlds import Steady

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference import fit
from trustbo.models import PooledTrust
from trustbo.simulation import KinematicSimulator
from trustbo.team import Robot, Team
from trustbo.terrain import example, read_terrain, synthetic_terrain
from trustbo.workspace import Sight, Workspace
from trustbo.workspace.line_of_sight import N_SAMPLES, bound_features, geometry
from trustbo.workspace.moves import MOVES, existing_bounds
from trustbo.workspace.netcdf import workspace_from_tree, workspace_to_tree
from trustbo.workspace.posts import SPACING

A, C, NEXT = (3, 0), (2, 1), (1, 2)


@pytest.fixture(scope="module")
def wooded():
    terrain = synthetic_terrain((160.0, 160.0), seed=5, relief=8.0)
    return Workspace.from_terrain(terrain, (4, 4), Team(n_robots=2), n_posts=1)


def cell_at(workspace, position):
    return workspace.grid.locate(dict(zip(("x", "y"), position, strict=True)))


def bounds_of(workspace):
    """Bounds as (move, row, col), and as pairs of cells."""
    index = np.argwhere(existing_bounds(workspace.passable.values)).tolist()
    pairs = [((r - MOVES[m][0], c - MOVES[m][1]), (r, c)) for m, r, c in index]
    return index, pairs


def clear(ground, eye, target, heights):
    """Whether a straight line clears a ground of pixels of 1 m, by dense steps, rows downwards."""
    share = np.linspace(0.0, 1.0, 4000)[:, None]
    col, row = (eye + share * (target - eye)).T
    i, j = np.clip(np.floor(row), 0, 58).astype(int), np.clip(np.floor(col), 0, 58).astype(int)
    p, q = row - i, col - j
    z = (1 - p) * ((1 - q) * ground[i, j] + q * ground[i, j + 1]) + p * (
        (1 - q) * ground[i + 1, j] + q * ground[i + 1, j + 1]
    )
    ends = z[0] + heights[0], z[-1] + heights[1]
    return bool((z <= ends[0] + share[:, 0] * (ends[1] - ends[0]) + 1e-9).all())


def bumpy(seed):
    ground = np.zeros((60, 60))
    rng = np.random.default_rng(seed)
    for row, col in rng.integers(8, 52, (6, 2)):
        y, x = np.mgrid[:60, :60]
        ground += rng.uniform(0.5, 2.5) * np.exp(-((y - row) ** 2 + (x - col) ** 2) / 18.0)
    return ground


def workspace_on(ground, team, **rules):
    terrain = synthetic_terrain((60.0, 60.0), seed=0)
    terrain["dem"].values[:] = ground
    terrain["dsm"].values[:] = ground
    return Workspace.from_terrain(terrain, (3, 3), team, sight=Sight(0.0), **rules)


def test_line_of_sight_is_what_scalar_code_computes():
    """On level ground with bumps all robots drive at one speed, so both phases last as long."""
    team = Team(robots=(Robot(vertical_fov=1.4),), lead=Robot(vertical_fov=1.4))
    workspace = workspace_on(bumpy(1), team)
    surface, (index, pairs) = workspace.surface, bounds_of(workspace)
    given = geometry(workspace.posts, np.array(index), workspace.passable.values)
    found, _ = bound_features(surface, Sight(0.0), team, given, surface.ground)

    def pixel(xy):
        return np.array([xy[0] - surface.origin[0], surface.origin[1] - xy[1]])

    for b in range(0, len(pairs), 5):
        way, post = given.routes[b], given.posts[b, 0]
        length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))])
        seen = []
        for k in range(N_SAMPLES):
            share = (k + 0.5) / N_SAMPLES
            lead = [np.interp(share * length[-1], length, way[:, axis]) for axis in (0, 1)]
            own = lead + (1 - share) * (post - way[0]) + share * (given.ends[b, k, 0] - way[-1])
            seen.append(clear(surface.ground, pixel(post), pixel(lead), (1.0, 1.0)))
            seen.append(clear(surface.ground, pixel(way[-1]), pixel(own), (1.0, 1.0)))
        # Even times are even lengths up to the slope of the bumps: a sample or two may differ.
        assert found[b, 0] == pytest.approx(np.mean(seen), abs=2.5 / (2 * N_SAMPLES))


def test_a_higher_sensor_sees_no_less_and_changes_its_robot_alone():
    low = Robot(vertical_fov=np.deg2rad(80.0))
    team = Team(robots=(low,) * 3, lead=low)
    workspace = workspace_on(2.0 * bumpy(1), team)
    index = np.array(bounds_of(workspace)[0])
    given = geometry(workspace.posts, index, workspace.passable.values)
    higher = Team(robots=(low, replace(low, sensor_height=3.0), low), lead=low)
    level, raised = (
        bound_features(workspace.surface, Sight(0.0), t, given, workspace.surface.ground)[0]
        for t in (team, higher)
    )
    np.testing.assert_array_equal(level[:, [0, 2]], raised[:, [0, 2]])
    # From 3 m, 80 degrees and the slope leave out what passes within a metre of one's feet.
    gap = [
        np.linalg.norm(w - p, axis=1).min()
        for w, p in zip(given.routes, given.posts[:, 1], strict=True)
    ]
    beside = np.array(gap) > 1.0
    assert beside.mean() > 0.5
    assert (raised[beside, 1] >= level[beside, 1]).all()
    assert (raised[:, 1] > level[:, 1] + 0.05).any()


@pytest.mark.parametrize("name", ["synthetic", "wellington", "tahoe", "topography"])
@pytest.mark.filterwarnings("ignore:.*enters its composite", "ignore:the first component of")
def test_line_of_sight_predicts_the_simulator_without_noise(name, real_terrain):
    """All the difference is T2's own route, and slip."""
    made = synthetic_terrain((500.0, 500.0), resolution=2.0, seed=1)
    terrain = made if name == "synthetic" else read_terrain(*real_terrain(name))
    workspace = Workspace.from_terrain(terrain, (10, 10))
    simulator = KinematicSimulator(workspace)
    index, pairs = bounds_of(workspace)
    rng, expected, simulated = np.random.default_rng(0), [], []
    for b in rng.permutation(len(index))[:60]:
        (m, row, col), (a, c) = index[b], pairs[b]
        ahead = [(c, n) for p, n in pairs if p == c and n != a]
        world, state = simulator.world(), simulator.standing(a, c)
        rng_of_bound = np.random.default_rng(0)
        found = simulator.outcomes(world, state, 1, ahead, rng_of_bound, expected=True)
        if any(drive.status != "ok" for drive, _, _ in found):
            continue
        simulated.append(np.mean([contact.mean() for _, contact, _ in found]))
        expected.append(workspace.awareness.values[:, m, row, col, 2].mean())
    expected, simulated = np.array(expected), np.array(simulated)
    assert np.corrcoef(expected, simulated)[0, 1] > 0.95
    assert abs((expected - simulated).mean()) < 0.02


def test_posts_by_the_way_are_on_safe_ground_apart_linked_and_not_in_the_way(wooded):
    ground = wooded.posts
    slope = np.arctan(np.hypot(*ground.surface.gradient))
    for a, c in bounds_of(wooded)[1]:
        posts = ground.watching(a, c)
        gap = np.linalg.norm(ground.lead_line(a, c)[:, None] - posts, axis=-1)
        assert gap.min() >= SPACING
        assert (np.linalg.norm(posts - ground.stop(a), axis=1) <= 26.0).all()
        assert np.linalg.norm(posts[0] - posts[1]) >= 3.0  # 4 m, by whole pixels
        pixels = ground.surface.nearest(*posts.T)
        assert (slope[pixels] <= 0.7 * wooded.team.max_slope).all()
        assert all(way is not None for way in wooded.posts.bound_routes(a, c, None))
    assert any(cell_at(wooded, post) != a for a, c in bounds_of(wooded)[1]
               for post in wooded.posts.watching(a, c))  # fmt: skip


def test_stops_stay_in_their_cell(wooded):
    for row, col in np.argwhere(wooded.passable.values).tolist():
        assert cell_at(wooded, wooded.posts.stop((row, col))) == (row, col)


def test_equal_robots_keep_their_sides(wooded):
    ground = wooded.posts
    for a, c in bounds_of(wooded)[1]:
        east, north = ground.stop(c) - ground.stop(a)
        to_right = wooded.posts.watching(a, c) @ np.array([north, -east])
        assert to_right[0] <= to_right[1]


def test_routes_lead_from_post_to_post(wooded):
    posts = wooded.posts
    lead, *closing = posts.bound_routes(A, C, NEXT)
    np.testing.assert_array_equal(lead[[0, -1]], [posts.stop(A), posts.stop(C)])
    ends = posts.watching(A, C), posts.watching(C, NEXT)
    for route, start, end in zip(closing, *ends, strict=True):
        np.testing.assert_array_equal(route[[0, -1]], [start, end])
    at_goal = posts.bound_routes(A, C, None)[1]
    np.testing.assert_array_equal(at_goal[-1], posts.watching(C, None)[0])


@pytest.mark.filterwarnings("ignore:the loading of")
@pytest.mark.parametrize("name", ["synthetic", "wellington"])
def test_stops_and_posts_are_the_stored_ones(name):
    """Pixels of the stop of each cell and of T2's posts for each neighbour and for the goal."""
    terrain = example() if name == "wellington" else synthetic_terrain(seed=0)
    posts = Workspace.from_terrain(terrain, (10, 10)).posts
    stored = np.load(Path(__file__).parent / "posts.npz")
    cells = list(np.ndindex(10, 10))

    def around(cell):
        near = [(cell[0] + down, cell[1] + right) for down, right in MOVES]
        return [c for c in near if c in cells]

    found = [posts.watching(a, c) for a in cells for c in [*around(a), None]]
    for kind, places in (("stops", [posts.stop(cell) for cell in cells]), ("posts", found)):
        pixels = np.stack(posts.surface.nearest(*np.moveaxis(places, -1, 0)), axis=-1)
        same = (pixels == stored[f"{name}_{kind}"]).all(-1)
        assert same.mean() > 0.99  # a tie may fall otherwise on another processor


@pytest.mark.parametrize(("slip", "tolerance"), [(False, 1.0), (True, 1.5)])
def test_what_is_planned_is_what_is_driven(wooded, slip, tolerance, monkeypatch):
    """Within a pixel of 1 m, and .5 m more with slip."""
    simulator, path = KinematicSimulator(wooded), [A, C, NEXT, (0, 3)]
    if not slip:
        of_simulator = "trustbo.simulation.kinematic.np.random.default_rng"
        monkeypatch.setattr(of_simulator, lambda *_: Steady())
    mission = simulator.run(path, seed=0)
    for k, bound in enumerate(mission.bounds):
        ahead = path[k + 2] if k + 2 < len(path) else None
        for i, way in enumerate(wooded.posts.bound_routes(path[k], path[k + 1], ahead)):
            fine = np.concatenate([np.linspace(p, q, 20) for p, q in itertools.pairwise(way)])
            track = bound.poses[:, i, :2]
            gap = np.linalg.norm(track[:, None] - fine, axis=-1).min(1)
            assert gap.max() <= tolerance


def test_robots_differ():
    terrain = synthetic_terrain((160.0, 160.0), seed=5, relief=8.0)
    blind = Robot(lidar_range=15.0)
    workspace = Workspace.from_terrain(terrain, (4, 4), Team(robots=(Robot(), blind)))
    seen = workspace.awareness.sel(feature="line_of_sight")
    known = np.isfinite(seen.values[0])
    assert (seen.values[1][known] < seen.values[0][known] + 1e-12).mean() > 0.9
    assert seen.values[1][known].mean() < seen.values[0][known].mean() - 0.1


def test_a_workspace_of_bounds_survives_a_file(wooded):
    again = workspace_from_tree(workspace_to_tree(wooded))
    np.testing.assert_array_equal(again.awareness, wooded.awareness)
    assert again.sight == wooded.sight
    np.testing.assert_array_equal(again.posts.watching(A, C), wooded.posts.watching(A, C))


def test_the_paper_s_setting_has_maps_of_cells_alone(wooded):
    paper = Workspace.from_terrain(wooded.terrain, (4, 4), wooded.team, bounds=False)
    assert paper.features == ("traversability", "visibility")
    assert list(paper.composites["visibility"].signs) == [
        "canopy_height",
        "canopy_cover",
        "openness",
    ]
    assert paper.posts is not None


def test_without_a_terrain_there_are_no_posts():
    workspace = Workspace.from_awareness(np.full((1, 3, 3, 2), 0.5))
    assert workspace.posts is None


def test_missing_awareness_of_a_mission_is_filled(wooded):
    measured = np.stack([np.full((2, 2), 0.4), np.full((2, 2), 0.3), np.full((2, 2), np.nan)], -1)
    names = wooded.features
    mission = Mission.from_arrays([A, C, NEXT], measured, np.full((2, 2), 0.5), features=names)
    filled = wooded.fill(mission)
    expected = wooded.awareness.sel(move="ne", feature="line_of_sight")
    np.testing.assert_array_equal(filled.awareness[0, :, 2], expected.sel(row=2, col=1))
    np.testing.assert_array_equal(filled.awareness[..., :2], mission.awareness[..., :2])
    np.testing.assert_array_equal(wooded.along(mission.path)[..., 2], filled.awareness[..., 2])


def test_arrays_with_a_place_for_line_of_sight_are_those_of_the_workspace(wooded):
    z, y = np.full((2, 2, 3), 0.4), np.full((2, 2), 0.6)
    z[..., 2] = np.nan
    mission = Mission.from_arrays([A, C, NEXT], z, y)
    assert mission.features[2] == "z3"
    filled = wooded.fill(mission)
    assert filled.features == wooded.features
    np.testing.assert_array_equal(filled.awareness[..., 2], wooded.along([A, C, NEXT])[..., 2])
    np.testing.assert_array_equal(filled.awareness[..., :2], z[..., :2])
    own = Mission.from_arrays([A, C, NEXT], np.nan_to_num(z), y, features=("mud", "fog", "sand"))
    with pytest.raises(TrustboError, match=r"has features \('mud', 'fog', 'sand'\)"):
        wooded.in_order(own)


def test_a_fit_on_a_workspace_fills_the_line_of_sight(wooded):
    rng = np.random.default_rng(1)
    short = [
        Mission.from_arrays([A, C, NEXT], rng.uniform(size=(2, 2, 2)), rng.uniform(size=(2, 2)))
        for _ in range(3)
    ]
    posterior = fit(short, PooledTrust(), workspace=wooded, seed=1)
    assert posterior["posterior"]["feature"].values.tolist() == list(wooded.features)
    whole = fit([wooded.fill(mission) for mission in short], PooledTrust(), seed=1)
    np.testing.assert_array_equal(
        posterior["posterior"]["beta"].values, whole["posterior"]["beta"].values
    )


def test_a_feature_of_cells_has_another_name(wooded):
    features = {"line_of_sight": ["slope"]}
    with pytest.raises(TrustboError, match="line_of_sight"):
        Workspace.from_terrain(wooded.terrain, (4, 4), features=features)


def test_a_cell_without_room_is_impassable_and_the_others_are_as_before():
    """The cell (2, 2) is a plateau except for a pixel, which alone is linked to the rest."""
    terrain = synthetic_terrain((60.0, 60.0), resolution=2.0, seed=0, relief=1.0)
    heights = np.zeros(terrain["dem"].shape)
    heights[20:, 20:] = 20.0
    heights[20:22, 20:22] = 0.0
    terrain["dem"] = terrain["dem"].copy(data=heights)
    terrain["dsm"] = terrain["dem"]

    with pytest.warns(UserWarning, match=r"cell \(2, 2\) has 1 passable pixel,"):
        workspace = Workspace.from_terrain(terrain, (3, 3), Team(n_robots=3))
    passable = workspace.passable.values
    assert not passable[2, 2]
    assert passable.sum() == 8
    assert np.isnan(workspace.awareness.values[:, :, 2, 2]).all()
    with pytest.raises(TrustboError, match="too few"):
        workspace.locate((2, 2))


def test_no_room_to_stand_is_named():
    terrain = synthetic_terrain((12.0, 12.0), resolution=2.0, seed=0)
    with pytest.raises(
        TrustboError, match=r"cell \(0, 0\) has 2 passable pixels, on which robot 'r2'"
    ):
        Workspace.from_terrain(terrain, (3, 3), Team(n_robots=6))
