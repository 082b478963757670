"""Difficulty of bounds, from the ways that robots drive."""

import dataclasses
import math

import networkx as nx
import numpy as np
import pytest
from scipy import ndimage
from worlds import random_cells, terrain_of

import trustbo as tb
from trustbo.data import POST_SETS
from trustbo.simulation.replicates import replicated
from trustbo.workspace.difficulty import MEASURES
from trustbo.workspace.moves import END, MOVES, by_option, by_way, options_of
from trustbo.workspace.netcdf import difficulty_to_tree, restore_difficulty

EAST = 4
TILT = MEASURES.index("tilt")
RNG = np.random.default_rng(0)
SINGLE = 1e-7  # rasters are in single precision


def behind_a_wall(gap):
    """Workspace of flat ground with a wall in the middle of column 1, but in some rows."""
    dem = np.zeros((60, 60))
    dem[:, 30] = 30.0
    dem[gap, 30] = 0.0
    terrain, opaque_ground = terrain_of(dem), tb.workspace.Sight(0.0)
    return tb.Workspace.from_terrain(terrain, (3, 3), sight=opaque_ground, n_posts=1)


def test_difficulty_is_that_of_the_largest_tilt_and_the_least_room():
    """A plane of tan 0.3, under limits of tan 1 and tan 0.4; then gaps of two widths."""
    plane, measured = terrain_of(np.zeros((60, 60)) + 0.3 * np.arange(60.0)[:, None]), []
    for limit in (1.0, 0.4):
        robot = tb.Robot(max_slope=float(np.arctan(limit)))
        team = tb.Team(robots=(robot,) * 2, lead=robot)
        workspace = tb.Workspace.from_terrain(plane, (3, 3), team, sight=tb.workspace.Sight(0.0))
        measured.append(workspace.difficulty.whole().values[EAST, 1, 1, EAST])
    for (_, tilt, narrow, tight), limit in zip(measured, (1.0, 0.4), strict=True):
        # Roll along the contour; no robot's way is but straight down, with the whole as pitch.
        np.testing.assert_allclose(tilt, 0.3 / limit, rtol=SINGLE)
        assert narrow == tight == 0.0  # no impassable pixel
    gaps = slice(20, 40), slice(28, 32)
    wide, slim = (behind_a_wall(gap).difficulty.whole().values for gap in gaps)
    assert np.nanmean(slim[..., 2]) > np.nanmean(wide[..., 2])
    # The wall's slope closes a pixel on either side: the way through touches these.
    assert np.nanmax(slim[..., 3]) > 0.0


def test_without_a_terrain_there_is_no_measure():
    difficulty = random_cells().difficulty.whole()
    assert difficulty.values.shape == (8, 4, 4, 9, 0)
    # All next moves of a bound are one unit, also those of the end of a path.
    unit = difficulty.unit[difficulty.unit[..., END] >= 0]
    assert (np.where(unit < 0, 99, unit).min(1) == unit[:, END]).all()


@pytest.fixture(scope="module")
def hilly():
    """Ground on which robots that withstand 8 degrees drive, as they are assumed to do 11."""
    terrain = tb.terrain.synthetic_terrain((150.0, 150.0), resolution=2.0, seed=3, relief=8.0)
    return tb.Workspace.from_terrain(terrain, (5, 5), team_of(11.0), bounds=False)


def team_of(degrees):
    robot = tb.Robot(max_slope=float(np.deg2rad(degrees)))
    return tb.Team(robots=(robot,) * 2, lead=robot)


def test_the_tilt_tells_bounds_and_next_moves_that_fail_from_others(hilly):
    """In the simulator: nearly all pass half a degree below the true limit, and fail above it.

    Slip, and the heading at the start, decide in between.
    """
    simulator = tb.simulation.KinematicSimulator(hilly, team=team_of(8.0))
    passed = replicated(simulator, 0, n_replicates=2, seed=0)["passed"].values
    tilt = hilly.difficulty.whole().values[..., TILT]
    known = np.isfinite(passed)
    assert (known == np.isfinite(tilt)).all()
    degrees = np.rad2deg(np.arctan(tilt[known] * np.tan(np.deg2rad(11.0))))
    below = degrees < 7.5
    above = degrees > 8.5
    assert 0.2 < below.mean() < 0.8
    assert 0.1 < above.mean() < 0.8
    assert passed[known][below].mean() > 0.97
    assert passed[known][above].mean() < 0.03


def test_next_moves_with_the_same_tilt_are_one_unit(hilly):
    difficulty = hilly.difficulty.whole()
    measures = difficulty.values
    exists = difficulty.unit >= 0
    assert (exists == np.isfinite(measures[..., 1])).all()
    for bound in np.argwhere(exists.any(-1)):
        unit = difficulty.unit[*bound]
        tilt = measures[*bound, :, 1]
        for n in np.flatnonzero(unit >= 0):
            same = np.flatnonzero(tilt == tilt[n])
            assert unit[n] == same[0]
            np.testing.assert_array_equal(measures[*bound, n], measures[*bound, same[0]])
    assert 1.2 < exists.sum() / (difficulty.unit == np.arange(END + 1)).sum() < 8.0


def largest_tilt(surface, robot, route):
    """Largest tangent of pitch or roll of a unicycle that follows a route by pure pursuit."""
    n_steps = max(5, math.ceil(robot.speed * 0.5 / 0.25))  # in half a second
    dt = 0.5 / n_steps
    position = route[0].copy()
    heading = math.atan2(*(route[1] - route[0])[::-1])
    aim = 1
    largest = 0.0
    while True:
        distance = np.linalg.norm(route - position, axis=1)
        while aim < len(route) - 1 and distance[aim] < robot.lookahead:
            aim += 1

        north, east = (route[aim] - position)[::-1]
        error = (math.atan2(north, east) - heading + np.pi) % (2.0 * np.pi) - np.pi
        turn = float(np.clip(error, -robot.turn_rate * dt, robot.turn_rate * dt))
        heading += turn

        row, col = (int(i + 0.5) for i in surface.to_pixel(*position))
        along = np.array([math.cos(heading), math.sin(heading)])
        pitch, roll = (
            abs(surface.gradient[:, row, col] @ v) for v in (along, along[::-1] * [1, -1])
        )
        largest = max(largest, pitch, roll)

        share = max(0.1, 1.0 - 0.9 * math.atan(max(pitch, roll)) / robot.max_slope)
        forward = max(0.0, math.cos(error - turn))
        position = position + robot.speed * share * forward * dt * along
        if aim == len(route) - 1 and np.linalg.norm(route[-1] - position) < 0.5:
            return largest


def fastest(pace, pixel, start, goal):
    """Pixels of the fastest way by networkx, with the rule against cutting corners."""
    graph = nx.Graph()
    for r, c in np.argwhere(np.isfinite(pace)).tolist():
        for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
            i, j = r + dr, c + dc
            if not (0 <= i < pace.shape[0] and 0 <= j < pace.shape[1]):
                continue
            if np.isfinite([pace[i, j], pace[i, c], pace[r, j]]).all():
                length = math.hypot(dr * pixel[0], dc * pixel[1])
                graph.add_edge((r, c), (i, j), weight=0.5 * (pace[r, c] + pace[i, j]) * length)
    return nx.dijkstra_path(graph, start, goal)


def route_of(posts, robot, ends, window):
    """A robot's route between two positions, from the slope and the obstacles of the terrain."""
    surface = posts.surface
    free = ndimage.distance_transform_edt(surface.passable, sampling=surface.pixel)
    pace = 1.0 / np.maximum(0.1, 1.0 - 0.9 * surface.slope / robot.max_slope)
    pace = np.where(free <= max(1.0, *surface.pixel), 4.0 * pace, pace)
    pace = np.where(surface.passable, pace, np.inf)

    top, bottom, left, right = window
    start, goal = ((int(r) - top, int(c) - left) for r, c in (surface.nearest(*p) for p in ends))
    pixels = fastest(pace[top:bottom, left:right], surface.pixel, start, goal)
    route = np.array([surface.centers(r + top, c + left) for r, c in pixels])
    route = np.repeat(route, 2, axis=0) if len(route) == 1 else route
    route[[0, -1]] = ends
    return route


def measures_of(workspace, robot, route):
    """Measures of one route, from their definition."""
    surface = workspace.surface
    row, col = surface.nearest(*route.T)
    away = np.full(surface.passable.shape, np.inf)
    if not surface.passable.all():
        away = ndimage.distance_transform_edt(surface.passable, sampling=surface.pixel)
    beside = (away[row, col] <= 1.001 * max(surface.pixel)).sum() * min(surface.pixel)
    return [
        1.0 - np.nanmean(workspace.pixels["traversability"].values[row, col].astype(float)),
        min(2.0, largest_tilt(surface, robot, route) / math.tan(robot.max_slope)),
        1.0 / (1.0 + away[row, col].min() / 2.0),
        math.log1p(beside) / 3.0,
    ]


def averaged(worst, tilt):
    """Means over the next moves with the same tilt."""
    return np.array([worst[tilt == t].mean(0) for t in tilt])


def test_difficulty_is_that_of_routes_by_networkx_and_of_a_plain_drive():
    """On rough ground with holes, where no two ways are equally fast, for unequal robots."""
    dem = np.cumsum(RNG.normal(0.0, 0.15, (36, 36)), axis=0) + RNG.normal(0.0, 0.02, (36, 36))
    dem[10:13, 20:24] = dem[25, 5:8] = np.nan
    limits = np.deg2rad([50.0, 60.0])
    team = tb.Team(robots=(tb.Robot(max_slope=limits[0]), tb.Robot(max_slope=limits[1], speed=1.0)))
    workspace = tb.Workspace.from_terrain(terrain_of(dem), (3, 3), team, bounds=False)
    posts = workspace.posts
    robots = team.lead, *team.robots
    measured = workspace.difficulty.whole().values

    chosen = np.argwhere(workspace.difficulty.exists.any(-1))[::7]
    assert len(chosen) > 4
    for move, row, col in chosen.tolist():
        a, c = (row - MOVES[move][0], col - MOVES[move][1]), (row, col)
        nexts = np.flatnonzero(workspace.difficulty.exists[move, row, col])
        worst = []
        for n in nexts.tolist():
            onward = None if n == END else (row + MOVES[n][0], col + MOVES[n][1])
            starts = posts.stop(a), *posts.watching(a, c)
            goals = posts.stop(c), *posts.watching(c, onward)
            window = posts.window(a, c)
            of_robots = [
                measures_of(workspace, robot, route_of(posts, robot, ends, window))
                for robot, *ends in zip(robots, starts, goals, strict=True)
            ]
            worst.append(np.max(of_robots, axis=0))
        expected = averaged(np.array(worst), np.round(np.array(worst)[:, TILT], 9))
        np.testing.assert_allclose(measured[move, row, col, nexts], expected, atol=SINGLE)


@pytest.mark.parametrize("gap", [slice(0, 0), slice(20, 40), slice(28, 32)])
def test_of_equally_fast_ways_the_one_that_robots_drive_is_measured(gap):
    """On flat ground, nearly every way has many equals, which pass obstacles at other distances."""
    workspace = behind_a_wall(gap)
    posts = workspace.posts
    robots = posts.team.lead, *posts.team.robots
    exists = workspace.difficulty.exists
    measured = workspace.difficulty.whole()
    for move, row, col, n in np.argwhere(exists)[::13].tolist():
        unit = measured.unit[move, row, col]
        members = np.flatnonzero(unit == unit[n])
        worst = []
        for member in members.tolist():
            onward = None if member == END else (row + MOVES[member][0], col + MOVES[member][1])
            a = row - MOVES[move][0], col - MOVES[move][1]
            routes = posts.bound_routes(a, (row, col), onward)
            pairs = zip(robots, routes, strict=True)
            worst.append(np.max([measures_of(workspace, *pair) for pair in pairs], axis=0))
        expected = np.mean(worst, axis=0)
        np.testing.assert_allclose(measured.values[move, row, col, n], expected, atol=1e-9)


def test_only_bounds_that_are_asked_for_are_measured():
    workspace = behind_a_wall(slice(20, 40))
    whole = workspace.difficulty.whole()
    assert workspace.difficulty.is_whole

    again = behind_a_wall(slice(20, 40)).difficulty
    bounds = np.argwhere(again.exists.any(-1))[[5, 0, 5]]
    some = again.of(bounds)
    np.testing.assert_array_equal(some.values, whole.values[*bounds.T])
    np.testing.assert_array_equal(some.unit, whole.unit[*bounds.T])
    assert not again.is_whole
    np.testing.assert_array_equal(again.whole().values, whole.values)


@pytest.fixture(scope="module")
def with_sets():
    """Hilly ground with three sets of posts."""
    terrain = tb.terrain.synthetic_terrain((150.0, 150.0), resolution=2.0, seed=3, relief=8.0)
    return tb.Workspace.from_terrain(terrain, (4, 4), team_of(11.0), n_posts=3)


def test_difficulty_with_sets_is_that_of_the_routes_from_set_to_set(with_sets):
    """By `bound_routes`, which the simulator drives; averaged over routes of the same tilt."""
    posts = with_sets.posts
    robots = posts.team.lead, *posts.team.robots
    difficulty = with_sets.difficulty
    exists = difficulty.exists
    measured = difficulty.whole()

    for move, row, col in np.argwhere(exists[:8].any(-1))[::17].tolist():
        left = row - MOVES[move][0], col - MOVES[move][1]
        pairs = [
            (way, n)
            for way in range(move, 24, 8)
            for n in np.flatnonzero(exists[way, row, col]).tolist()
        ]
        worst = []
        for way, n in pairs:
            ahead, after = None, 0
            if n < 24:
                after, onward = divmod(n, 8)
                ahead = row + MOVES[onward][0], col + MOVES[onward][1]
            a, c = (*left, POST_SETS[way // 8]), (row, col, POST_SETS[after])
            routes = zip(robots, posts.bound_routes(a, c, ahead), strict=True)
            worst.append(np.max([measures_of(with_sets, *one) for one in routes], axis=0))

        tilt = np.round(np.array(worst)[:, TILT], 9)
        where = tuple(np.array([(way, row, col, n) for way, n in pairs]).T)
        expected = averaged(np.array(worst), tilt)
        np.testing.assert_allclose(measured.values[where], expected, atol=1e-6)
        options = [way // 8 * 25 + n for way, n in pairs]
        first = [options[tilt.tolist().index(t)] for t in tilt]
        np.testing.assert_array_equal(measured.unit[where], first)


def test_sets_share_units_and_differ_in_others(with_sets):
    measured = with_sets.difficulty.whole()
    unit = by_option(measured.unit)
    of_standard = unit[..., :25].max(-1)
    far = unit[..., 25:50]
    assert (far >= 25).any()  # steeper than all routes of the standard set
    assert ((far >= 0) & (far < 25)).any()
    assert of_standard.max() < 25
    tilt = measured.values[..., TILT]
    assert np.nanmean(tilt[8:16]) > np.nanmean(tilt[:8])


def test_difficulty_with_sets_is_stored(with_sets):
    tree = difficulty_to_tree(with_sets.difficulty)
    dims = "move", "row", "col", "next_move"
    assert tree["unit"].dims == dims
    assert tree["difficulty"].dims == (*dims, "measure")
    assert tree["next_move"].values.tolist() == [*with_sets.awareness["move"].values, "end"]

    again = dataclasses.replace(with_sets)
    assert not again.difficulty.is_whole
    restore_difficulty(again, tree)
    assert again.difficulty.is_whole
    bounds = np.argwhere(with_sets.passable_bounds.values)
    for a, b in zip(again.difficulty.of(bounds), with_sets.difficulty.of(bounds), strict=True):
        np.testing.assert_array_equal(a, b)


def test_maps_by_way_and_by_option_have_the_same_values():
    maps = RNG.random((2, 24, 3, 4, 25))
    by_bound = by_option(maps)
    np.testing.assert_array_equal(by_way(by_bound, 3), maps)
    pairs = np.column_stack([RNG.integers(n, size=50) for n in maps.shape[1:]])
    np.testing.assert_array_equal(by_bound[:, *options_of(pairs, 3).T], maps[:, *pairs.T])
    np.testing.assert_array_equal(by_option(maps[:, :8, ..., :9]), maps[:, :8, ..., :9])


def test_the_tilt_tells_which_sets_robots_reach(with_sets):
    """In the simulator, for bounds from one set to another, as above for the standard one."""
    simulator = tb.simulation.KinematicSimulator(with_sets, team=team_of(8.0))
    tilt = with_sets.difficulty.whole().values[..., TILT]
    degrees = np.rad2deg(np.arctan(tilt * np.tan(np.deg2rad(11.0))))
    clear = np.argwhere(np.abs(degrees - 8.0) > 0.5)
    others = clear[(clear[:, 0] >= 8) & (clear[:, 3] < 24)]

    chosen = np.random.default_rng(0).choice(others, 100, replace=False)
    passed = []
    for seed, (way, row, col, after) in enumerate(chosen.tolist()):
        before, to = MOVES[way % 8], MOVES[after % 8]
        a = row - before[0], col - before[1], POST_SETS[way // 8]
        c = row, col, POST_SETS[after // 8]
        mission = simulator.run([a, c, (row + to[0], col + to[1])], seed=seed)
        passed.append(mission.statuses[0] == "ok")

    is_below = degrees[tuple(chosen.T)] < 8.0
    assert 0.1 < is_below.mean() < 0.9
    assert np.mean(np.array(passed) == is_below) > 0.95
