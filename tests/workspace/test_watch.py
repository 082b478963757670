"""The watch table: what would be seen from posts, beside the line of sight of bounds."""

from itertools import pairwise

import numpy as np
import pytest

from trustbo import Team, Workspace
from trustbo.errors import TrustboError
from trustbo.terrain import synthetic_terrain
from trustbo.workspace import Sight
from trustbo.workspace.line_of_sight import Geometry, phases
from trustbo.workspace.watch import N_POSTS

PATH = (3, 0), (2, 1), (1, 2), (0, 3)


@pytest.fixture(scope="module")
def wooded():
    terrain = synthetic_terrain((160.0, 160.0), seed=5, relief=8.0)
    return Workspace.from_terrain(terrain, (4, 4), Team(n_robots=2))


def test_the_first_posts_are_the_rule_s_and_all_are_apart(wooded):
    posts, _ = wooded.watch.along(PATH)
    for here, (a, c) in zip(posts, pairwise(PATH), strict=False):
        np.testing.assert_array_equal(here[:2], wooded.posts(a, c))
        assert len(here) == N_POSTS
        gaps = np.linalg.norm(here[:, None] - here, axis=-1)[np.triu_indices(N_POSTS, 1)]
        assert gaps.min() >= 3.0  # 4 m, by whole pixels
    np.testing.assert_array_equal(posts[-1], wooded.ground.posts.watching(PATH[-1], None))


def test_a_watch_is_the_line_of_sight_of_every_pair_of_posts(wooded):
    """From the samples of one pair at a time, on the bound's way."""
    (a, c), b = PATH[:2], PATH[2]
    watch, table = wooded.watch.watch(a, c, b), wooded.watch
    ground, posts, after = wooded.ground.posts, table.posts(a, c), table.posts(c, b)
    for j, k in ((0, 0), (3, 1), (4, 4)):
        starts = np.repeat(posts[None, j, None], 2, axis=1)
        ends = np.broadcast_to(after[k], (1, 16, 2, 2))
        line, stops = [ground.lead_way(a, c)], ground.stop(c)[None]
        given = Geometry(line, starts, ends, stops)
        seen = phases(ground.surface, wooded.sight, wooded.team, given, doubt=True)
        np.testing.assert_allclose(watch.watched[:, j], seen.watched.mean(-1)[0])
        np.testing.assert_allclose(watch.closing[:, j, k], seen.closing.mean(-1)[0])
        np.testing.assert_allclose(watch.waiting[:, k], seen.waiting.mean(-1)[0])
        np.testing.assert_allclose(watch.times[:, j, k], seen.times[0])


def test_sight_along_a_path_is_its_line_of_sight_but_for_turns(wooded):
    along = wooded.watch.seen_along(PATH).line_of_sight()
    known = wooded.along(PATH)[..., -1]  # the mean over where a path may go on to
    assert np.abs(along - known).max() < 0.1
    assert abs((along - known).mean()) < 0.03


def test_a_bound_with_one_way_on_is_unseen_as_its_path_is():
    """A corridor of cells: the next bound, and with it T2's way, is known."""
    terrain = synthetic_terrain((50.0, 200.0), seed=3, relief=12.0)
    corridor = Workspace.from_terrain(terrain, (1, 4), Team(n_robots=2), sight=Sight(np.inf, 0.0))
    shares = corridor.unseen_bounds
    assert shares.dims == ("move", "row", "col")
    for move, path in (("e", range(4)), ("w", range(3, -1, -1))):
        path = tuple((0, col) for col in path)
        seen = corridor.watch.seen_along(path)
        entered = [col for _, col in path[1:]]
        np.testing.assert_allclose(shares.sel(move=move, row=0)[entered], seen.unseen(), rtol=1e-12)
    assert 0.05 < float(shares.max()) <= 1.0
    assert int(shares.notnull().sum()) == 6
    assert Workspace.from_awareness(np.full((1, 2, 2, 1), 0.5)).unseen_bounds is None


def test_an_overwatch_map_has_what_is_seen_from_each_post(wooded):
    a, c = PATH[:2]
    seen = wooded.overwatch_map((a, c))
    assert seen.dims == ("y", "x")
    assert seen.rio.crs == wooded.terrain.rio.crs
    assert np.nanmin(seen) >= 0.0
    assert np.nanmax(seen) <= 1.0
    watched = wooded.watch.seen_along(PATH).watched.mean(-1)[0, 0]
    x, y = wooded.posts(a, c)[0]
    here = seen.sel(x=x, y=y, method="nearest")
    assert abs(float(here["x"] - x)) <= 1.0  # points are 2 m apart
    assert float(here) == pytest.approx(watched, abs=0.1)
    assert seen.sel(x=x, y=y, method="nearest") >= np.nanquantile(seen, 0.6)  # a good post


def test_a_closed_cell_s_pixels_have_no_value():
    terrain = synthetic_terrain((160.0, 160.0), seed=5, relief=8.0)
    terrain["dem"].values[60:70, 30:50] += np.linspace(0.0, 40.0, 10)[:, None]  # a cliff
    workspace = Workspace.from_terrain(terrain, (4, 4))
    seen = workspace.overwatch_map(((2, 1), (1, 1)))
    rows, cols = workspace.surface.nearest(*np.meshgrid(seen["x"], seen["y"]))
    np.testing.assert_array_equal(np.isnan(seen), ~workspace.surface.passable[rows, cols])
    assert np.isnan(seen).any()


def test_what_cannot_be_watched_is_refused_or_none(wooded):
    with pytest.raises(TrustboError, match="neighbour"):
        wooded.overwatch_map(((3, 0), (0, 3)))
    with pytest.raises(TrustboError, match="unknown robot 'r9'; choose one of r1"):
        wooded.overwatch_map(PATH[:2], robot="r9")
    flat = Workspace.from_awareness(np.full((2, 4, 4, 1), 0.5))
    assert flat.watch is None
    assert flat.overwatch_map(PATH[:2]) is None
