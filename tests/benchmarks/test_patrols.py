"""The benchmark of changing courses: its courses, its runs that are resumed, and its t tests."""

from dataclasses import replace

import numpy as np
import pandas as pd
import patrols
import pytest
from scipy import stats
from world_set import worlds

import trustbo as tb

APART = 4
METHODS = ("running mean, free first", "line of sight, priced")


@pytest.fixture(scope="module")
def world():
    return replace(worlds()["synthetic-0"], name="synthetic-0-small", shape=(6, 6), cell=40.0)


@pytest.fixture(scope="module")
def truths(tmp_path_factory):
    return tmp_path_factory.mktemp("truths")


@pytest.fixture(scope="module")
def ground(world, truths):
    return patrols.ground_of(world, truths)


def test_courses_are_deterministic_and_can_be_driven(ground):
    drawn = patrols.courses(ground, 0, 8, APART)
    assert patrols.courses(ground, 0, 5, APART) == drawn[:5]
    assert patrols.courses(ground, 1, 8, APART) != drawn

    for start, goal in drawn:
        assert max(abs(start[0] - goal[0]), abs(start[1] - goal[1])) >= APART
        planner = tb.Planner(ground.workspace, start, goal)
        best = ground.truth.best(start, goal)
        assert planner.require_path(best) == best


def test_worlds_on_one_terrain_have_the_same_courses_where_they_can_be_driven(ground):
    drawn = patrols.courses(ground, 0, 8, APART)
    closed = drawn[2][0]
    passable = ground.workspace.passable.copy()
    passable[closed] = False
    fewer = replace(ground, workspace=replace(ground.workspace, passable=passable))

    others = patrols.courses(fewer, 0, 8, APART)
    remain = [course for course in drawn if closed not in course]
    assert others[: len(remain)] == remain
    assert not any(closed in course for course in others)


def test_a_run_that_was_stopped_continues_with_the_same_rows(world, truths, tmp_path):
    def run(folder, methods):
        return patrols.run_world(world, methods, folder, truths, (0, 1), 2, APART)

    assert run(tmp_path / "whole", METHODS) == 4
    assert run(tmp_path / "stopped", METHODS[:1]) == 2
    lost = patrols.file_of(tmp_path / "stopped", world.name, 1, METHODS[0])
    lost.unlink()  # as if it was stopped before this campaign
    assert run(tmp_path / "stopped", METHODS) == 3
    assert run(tmp_path / "stopped", METHODS) == 0

    rows = [patrols.rows_in(tmp_path / name, [world.name]) for name in ("whole", "stopped")]
    pd.testing.assert_frame_equal(*rows)
    assert len(rows[0]) == 8
    assert (rows[0]["excess"] >= -1e-9).all()
    assert rows[0].groupby("mission")["best"].nunique().max() <= 2  # one course for all methods


def test_the_cost_of_a_failure_is_a_shortest_path_and_comes_with_the_first_one(ground):
    course = patrols.courses(ground, 0, 1, APART)[0]
    planner = tb.Planner(ground.workspace, *course)
    shortest = planner.problem.paths.shortest
    path = ground.truth.best(*course)
    mission = ground.simulator.run(path, seed=0)
    statuses = ("ok",) * (len(path) - 2) + ("stuck",)
    failed = replace(mission, bound_status=statuses, status="stuck")

    costs = []
    for missions in ([mission], [failed]):
        hazard = tb.hazard.fit_hazard(missions, ground.workspace)
        informed = planner.with_risk(tb.hazard.BoundRisk(hazard, ground.workspace))
        priced = [patrols.with_price(informed, from_start) for from_start in (False, True)]
        costs.append([one.problem.cost_of_failure for one in priced])
    assert costs == [[0.0, shortest], [shortest, shortest]]


def made(excess):
    """Rows of all worlds in two sets of two missions; `excess(method, world)`."""
    rows = [
        {
            "world": world.name, "kind": world.kind, "case": world.case, "set": which,
            "method": method, "mission": mission, "status": "ok", "p_arrive": 0.9,
            "lost": 0.0, "excess": excess(method, world) + mission,
        }
        for world in worlds().values() for method in ("trustbo, priced", *METHODS)
        for which in (0, 1) for mission in (7, 8)
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_differences_are_t_tests_of_means_by_world_clustered_by_terrain():
    level = dict(zip(("trustbo, priced", *METHODS), (0.1, 0.3, 0.5), strict=True))
    rng = np.random.default_rng(0)
    own = {world.name: rng.normal(0.0, 0.1) for world in worlds().values()}

    def excess(method, world):
        return level[method] + own[world.name] * (method == METHODS[0])

    found = patrols.tests(patrols.of_worlds(patrols.means_of(made(excess))), "trustbo, priced")
    row = found[(found["group"] == "map wrong") & (found["other"] == METHODS[0])].iloc[0]

    # Written out for the worlds of this group: d of each world, sums of residuals by terrain.
    chosen = [world for world in worlds().values() if world.kind in ("aged", "canopy")]
    d = np.array([-0.2 - own[world.name] for world in chosen])
    mean = d.mean()
    of_terrain = {}
    for world, value in zip(chosen, d, strict=True):
        of_terrain[world.ground] = of_terrain.get(world.ground, 0.0) + value - mean
    n_terrains = len(of_terrain)
    squares = sum(residual**2 for residual in of_terrain.values())
    se = (n_terrains / (n_terrains - 1) * squares) ** 0.5 / len(d)
    assert row["n"] == len(chosen)
    assert row["value"] == pytest.approx(mean)
    assert row["p"] == pytest.approx(2.0 * stats.t.sf(abs(mean) / se, n_terrains - 1))
    assert row["better"] == (d < -0.01).sum()
    assert row["worse"] == (d > 0.01).sum()

    best = found[(found["group"] == "map wrong") & found["other"].str.startswith("the best")]
    assert METHODS[0] in best["other"].item()  # .3 on average
    assert best["value"].item() == row["value"]


def test_limits_that_are_too_high_and_too_low_are_groups_of_their_own(capsys):
    means = patrols.means_of(made(lambda method, world: 0.0))
    groups = patrols.groups_of(patrols.of_worlds(means))
    n_low = sum("low-3" in world.case for world in worlds().values())
    assert groups["limit too low"].sum() == n_low
    assert groups["limit too high"].sum() == groups["wrong slope limit"].sum() - n_low

    patrols.report(means)
    assert "limit too low" in capsys.readouterr().out
