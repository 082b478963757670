"""Closed cells and bounds: no path takes them, by enumeration, and nothing else changes."""

from itertools import pairwise

import numpy as np
import pytest
from enumeration import every_path, paths_of, value_of
from worlds import hillside, random_cells

import trustbo as tb
from trustbo.identity import map_name
from trustbo.models import TrustParams
from trustbo.workspace.netcdf import workspace_from_tree, workspace_to_tree

ENDS = (3, 0), (0, 3)
PARAMS = TrustParams(beta0=0.4, beta=np.array([0.5, 0.2]), b=0.1, delta_w=0.02, delta_v=0.05)


def is_open(path, cells, bounds):
    """Whether a path enters none of the cells and takes none of the bounds."""
    taken = {frozenset(ends) for ends in pairwise(path)}
    return not {*path[1:]} & {*cells} and not taken & {frozenset(bound) for bound in bounds}


@pytest.mark.parametrize("seed", range(6))
def test_plans_are_the_best_of_the_paths_that_are_open(seed):
    rng = np.random.default_rng(seed)
    ground = random_cells(2)
    inner = [cell for cell in np.ndindex(4, 4) if cell not in ENDS]
    cells = [inner[k] for k in rng.choice(len(inner), 2, replace=False)]
    bounds = [((3, 0), (2, 1)), ((1, 2), (0, 3)), ((1, 1), (1, 2))][: rng.integers(4)]
    closed = ground.closing(cells, "mud").closing(bounds, "wreck") if bounds else (
        ground.closing(cells, "mud"))  # fmt: skip

    usual = tb.Planner(ground, *ENDS)
    planner = tb.Planner(closed, *ENDS)
    longest = planner.problem.paths.longest
    every = every_path(
        ground.passable_bounds.values, *ENDS, longest, u_turns=usual.problem.paths.turns
    )
    open_paths = [path for path in every if is_open(path, cells, bounds)]
    assert sorted(paths_of(planner)) == sorted(open_paths)

    plan = planner.plan(PARAMS)
    noise = np.hypot(PARAMS.delta_w, PARAMS.delta_v)
    values = [
        value_of(PARAMS, ground, path, "lost_contact", "gaussian", noise) for path in open_paths
    ]
    of_plan = value_of(PARAMS, ground, plan.path, "lost_contact", "gaussian", noise)
    assert of_plan == pytest.approx(max(values), abs=1e-9)
    closed_paths = [path for path in every if path not in open_paths]
    for k in rng.permutation(len(closed_paths))[:20]:
        with pytest.raises(tb.TrustboError, match="closed"):
            planner.evaluate(closed_paths[k], PARAMS)


def test_a_team_can_leave_a_closed_cell_and_not_enter_it():
    ground = random_cells().closing([ENDS[0]])
    assert tb.Planner(ground, *ENDS).plan(PARAMS).path[0] == ENDS[0]
    with pytest.raises(tb.NoPathError, match="closed"):
        tb.Planner(ground, *ENDS[::-1])


def test_without_a_way_the_message_names_the_closings_and_places():
    ground = random_cells().with_places({"ford": (1, 2)})
    river = ground.closing([(k, 2) for k in range(4)], "flood").closing([((3, 1), (2, 1))], "tree")
    with pytest.raises(tb.NoPathError, match=r"ford \(flood\).*2,1 to 3,1 \(tree\)"):
        tb.Planner(river, *ENDS)


@pytest.fixture(scope="module")
def hill():
    return tb.Workspace.from_terrain(hillside(), (3, 3), n_posts=1).with_places({"camp": (2, 0)})


def test_the_ground_remains_the_same(hill):
    closed = hill.closing(["camp", {"x": hill.grid.x[1], "y": hill.grid.y[1]}], "mud")
    assert closed.closed == {((2, 0),): "mud", ((1, 1),): "mud"}
    assert hill.closed == {}
    assert map_name(closed) == map_name(hill)
    assert closed.difficulty is hill.difficulty
    np.testing.assert_array_equal(closed.passable, hill.passable)
    assert closed.closing([(1, 1)], "tree").closed[(1, 1),] == "tree"
    assert "2,0" not in repr(closed).split("closed")[1]
    assert "camp (mud); 1,1 (mud)" in repr(closed)


def test_files_places_threats_and_parts_of_the_team_keep_closings(hill):
    closed = hill.closing([(0, 1), ((1, 1), (2, 0))], "mud")
    again = workspace_from_tree(workspace_to_tree(closed))
    np.testing.assert_array_equal(again.open_bounds, closed.open_bounds)
    others = (
        again, closed.with_places({"hill": (0, 2)}), closed.with_threat(), closed.of_robots(["r2"]),
        hill.of_robots(["r2"]).closing([(0, 1), ((2, 0), (1, 1))], "mud"),
    )  # fmt: skip
    for other in others:
        assert other.closed == closed.closed
    assert others[-1].team.names == ("r2",)
    assert others[-1].whole.closed == closed.closed


@pytest.mark.parametrize(
    ("where", "problem"),
    [
        ([], "where"),
        ((3, 4), "where"),
        (3, "where"),
        ("nowhere", "where"),
        (["nowhere"], r"where\[0\]"),
        ([(9, 9)], r"where\[0\]"),
        ([((0, 0), (0, 2))], "neighbours"),
        ([((0, 0), (0, 0))], "neighbours"),
        ([((0, 0), (0, 1), (0, 2))], r"where\[0\]"),
    ],
)
def test_what_cannot_be_closed_is_refused(where, problem):
    ground = random_cells()
    with pytest.raises(tb.TrustboError, match=problem):
        ground.closing(where)
    with pytest.raises(tb.TrustboError, match="reason"):
        ground.closing([(1, 1)], reason=3)
