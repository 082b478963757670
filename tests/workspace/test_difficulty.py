"""Difficulty of bounds, from the ways that robots drive."""

import numpy as np
import pytest
from worlds import random_cells, terrain_of

import trustbo as tb
from trustbo.simulation.replicates import replicated
from trustbo.workspace.difficulty import MEASURES, difficulty_of
from trustbo.workspace.moves import END


def behind_a_wall(gap):
    """Workspace of flat ground with a wall in the middle of column 1, but in some rows."""
    dem = np.zeros((60, 60))
    dem[:, 30] = 30.0
    dem[gap, 30] = 0.0
    return tb.Workspace.from_terrain(terrain_of(dem), (3, 3), sight=tb.workspace.Sight(0.0))


def test_difficulty_is_that_of_the_largest_tilt_and_the_least_room():
    """A plane of tan 0.3, under limits of tan 1 and tan 0.4; then gaps of two widths."""
    plane, measured = terrain_of(np.zeros((60, 60)) + 0.3 * np.arange(60.0)[:, None]), []
    for limit in (1.0, 0.4):
        robot = tb.Robot(max_slope=float(np.arctan(limit)))
        team = tb.Team(robots=(robot,) * 2, lead=robot)
        workspace = tb.Workspace.from_terrain(plane, (3, 3), team, sight=tb.workspace.Sight(0.0))
        measured.append(difficulty_of(workspace).measures.sel(move="e", next_move="e").values[1, 1])
    for (_, tilt, narrow, tight), limit in zip(measured, (1.0, 0.4), strict=True):
        # Roll along the contour; no robot's way is but straight down, with the whole as pitch.
        np.testing.assert_allclose(tilt, 0.3 / limit, rtol=1e-10)
        assert narrow == tight == 0.0  # no impassable pixel
    gaps = slice(20, 40), slice(28, 32)
    wide, slim = (difficulty_of(behind_a_wall(gap)).measures for gap in gaps)
    assert wide["measure"].values.tolist() == list(MEASURES)
    assert np.nanmean(slim[..., 2]) > np.nanmean(wide[..., 2])
    # The wall's slope closes a pixel on either side: the way through touches these.
    assert np.nanmax(slim[..., 3]) > 0.0


def test_without_a_terrain_there_is_no_measure():
    difficulty = difficulty_of(random_cells())
    assert difficulty.measures.shape == (8, 4, 4, 9, 0)
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
    tilt = difficulty_of(hilly).measures.sel(measure="tilt").values
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
    difficulty = difficulty_of(hilly)
    measures = difficulty.measures.values
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
