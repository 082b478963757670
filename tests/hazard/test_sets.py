"""Failures with several sets of posts: counted, learned, priced and stored by set."""

import numpy as np
import pytest
import xarray as xr

import trustbo as tb
from trustbo.data import POST_SETS
from trustbo.errors import TrustboError
from trustbo.hazard.model import fit_hazard
from trustbo.hazard.risk import BoundRisk
from trustbo.hazard.trials import UNKNOWN, LostMission, Trials
from trustbo.models import TrustParams
from trustbo.simulation import ModelSimulator
from trustbo.workspace.difficulty import MEASURES
from trustbo.workspace.moves import MOVES, by_option, next_names, pairs_along, way_names

EAST, SOUTH = 4, 6
FAR, ROUTE = 8, 16
PARAMS = TrustParams(0.5, [0.2, 0.3], 0.1, 0.05, 0.1)
RNG = np.random.default_rng(0)


def cells(n_posts=3):
    z = np.random.default_rng(1).uniform(size=(2, 8 * n_posts, 4, 4, 2))
    return tb.Workspace.from_awareness(z)


def mission(path, status="ok", n_bounds=None):
    n = len(path) - 1 if n_bounds is None else n_bounds
    rates = np.full((n, 2), 0.5)
    return tb.Mission.from_arrays(path, np.full((n, 2, 2), 0.5), rates, status=status)


@pytest.fixture(scope="module")
def hilly():
    """Ground of which some bounds are near the limit of 11 degrees."""
    robot = tb.Robot(max_slope=np.deg2rad(11.0))
    terrain = tb.terrain.synthetic_terrain((150.0, 150.0), resolution=2.0, seed=3, relief=8.0)
    team = tb.Team(robots=(robot,), lead=robot)
    return tb.Workspace.from_terrain(terrain, (5, 5), team, n_posts=3)


def path_of(way, row, col, after):
    """Path of a bound and the next one, with their sets of posts."""
    down, right = MOVES[way % 8]
    a = row - down, col - right, POST_SETS[way // 8]
    if after == 24:
        return a, (row, col)
    down, right = MOVES[after % 8]
    return a, (row, col, POST_SETS[after // 8]), (row + down, col + right)


# --- what is counted ---


def test_trials_are_those_of_the_sets_that_watched():
    path = ((0, 0, "far"), (0, 1), (0, 2, "route"), (1, 2))
    counted = Trials.from_missions([mission(path)], [LostMission(path, (0, 2))], n_posts=3)
    assert counted.bounds.tolist() == [
        [EAST, 0, 2, SOUTH + ROUTE],
        [SOUTH + ROUTE, 1, 2, 24],
        [EAST + FAR, 0, 1, EAST],
    ][::1] or counted.bounds.tolist() == sorted(counted.bounds.tolist())
    by_bound = dict(zip(map(tuple, counted.bounds.tolist()), counted.failed, strict=True))
    assert by_bound == {
        (EAST + FAR, 0, 1, EAST): 0.0,
        (EAST, 0, 2, SOUTH + ROUTE): 1.0,
        (SOUTH + ROUTE, 1, 2, 24): 0.0,
    }
