"""What robots are to do, drawn bound by bound."""

import itertools

import numpy as np
import pytest
from matplotlib.collections import QuadMesh

import trustbo as tb


@pytest.fixture(scope="module")
def plan(result):
    return result.plan


def lines_of(ax):
    return [np.column_stack(line.get_data()) for line in ax.lines]


def assert_drawn(ax, points):
    assert any(line.shape == points.shape and np.allclose(line, points) for line in lines_of(ax))


def test_a_panel_has_the_posts_sight_lines_and_ways_of_its_bound(result, plan):
    whole, *panels = tb.plots.plan_map(plan)
    assert whole.get_title() == f"path of {len(plan.path) - 1} bounds"
    assert len(panels) == len(plan.path) - 1
    corner = np.array(result.workspace.grid.corner)
    bounds = zip(panels, itertools.pairwise(plan.path), strict=True)
    for k, (ax, (a, c)) in enumerate(bounds, start=1):
        assert ax.get_title() == f"bound {k}: {a[0]},{a[1]} to {c[0]},{c[1]}"
        ahead = plan.path[k + 1] if k + 1 < len(plan.path) else None
        for way in result.workspace.ways(a, c, ahead):
            assert_drawn(ax, way - corner)
        stop = result.workspace.ground.posts.stop(c)
        for post in result.workspace.posts(a, c):
            assert_drawn(ax, np.array([post]) - corner)
            assert_drawn(ax, np.array([post, stop]) - corner)
        (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
        for x, y in np.concatenate(lines_of(ax)[:-1]):  # the last is the scale
            assert left < x < right
            assert bottom < y < top
    labels = [text.get_text() for text in whole.figure.legends[0].get_texts()]
    assert labels[:2] == ["lead: stops, way", "r1: post, way"]


def test_some_bounds_and_what_cannot_be_drawn(plan):
    assert len(tb.plots.plan_map(plan, bounds=[2], n_columns=1)) == 2
    with pytest.raises(tb.TrustboError, match=r"bounds must be some of 1\.\.\d; got \[0\]"):
        tb.plots.plan_map(plan, bounds=[0])
    bare = tb.Workspace.from_awareness(np.full((1, 2, 2, 2), 0.5))
    params = tb.models.TrustParams(0.5, np.array([0.3, 0.3]), 0.1, 0.1, 0.1, 0.5, 0.5)
    flat = tb.planning.Planner(bare, (0, 0), (1, 1)).plan(params)
    with pytest.raises(tb.TrustboError, match=r"made with Workspace\.from_terrain of a terrain"):
        tb.plots.plan_map(flat)


def test_overwatch_colours_are_the_map_s(plan):
    whole, panel = tb.plots.plan_map(plan, bounds=[2], overwatch="r1")
    (mesh,) = [c for c in panel.collections if isinstance(c, QuadMesh)]
    bound = plan.path[1], plan.path[2]
    expected = plan.workspace.overwatch_map(bound, robot="r1").values
    np.testing.assert_array_equal(np.ma.filled(mesh.get_array(), np.nan), expected)
    assert not [c for c in whole.collections if isinstance(c, QuadMesh)]
    with pytest.raises(tb.TrustboError, match="unknown robot 'r9'; choose one of r1"):
        tb.plots.plan_map(plan, bounds=[2], overwatch="r9")
