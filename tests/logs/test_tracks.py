"""Logs of poses and detections as missions, and tables in other units."""

import numpy as np
import pandas as pd
import pytest

import trustbo as tb
from trustbo.data import NOWHERE
from trustbo.errors import TrustboError
from trustbo.logs import Tracks, missions_of

POSES = {"t": [0.0, 4.0, 8.0, 0.0, 4.0, 8.0], "robot": [*"aaabbb"], "x": [0.0, 4.0, 8.0] * 2,
         "y": [0.0] * 3 + [3.0] * 3, "heading": [0.0] * 6}  # fmt: skip
SEEN = {"t": [0.5, 0.7, 6.2], "watcher": [*"aab"], "seen": [*"bba"]}


def features_of(tracks, watcher, lead):
    """Features near, ahead and clear of one robot at each tick, (feature, tick)."""
    (one,) = missions_of(tracks, 1.0, lead=lead)
    return one.awareness[:, one.robots.index(watcher)].T


def test_geometry_is_that_of_the_plane():
    poses = {"t": [0.0, 10.0] * 3, "robot": [*"aabbcc"], "x": [0, 0, 4, 4, 2, 2],
             "y": [0, 0, 0, 0, -2, 8], "heading": [0, 0, 0, 0, 0, 1.0]}  # fmt: skip
    with pytest.warns(UserWarning, match="no detection names c"):
        tracks = Tracks(poses, SEEN, landmarks=[[0.0, 5.0, 0.2]], robot_radius=0.3, max_gap=10.0)
    near, ahead, clear = features_of(tracks, "a", "b")
    np.testing.assert_array_equal(ahead, features_of(tracks, "b", "a")[1] == 0.0)  # b faces east
    # c, at (2, t - 2), hides b from a where it is within .3 m of their line: never at t = k + .5.
    assert clear.all()
    away = np.hypot(2.0, np.arange(10) - 1.5)  # of a and of b from c
    usual = np.median([*away, *away, *[4.0] * 10])
    np.testing.assert_allclose(near, usual / (usual + 4.0))
    np.testing.assert_allclose(features_of(tracks, "a", "c")[0], usual / (usual + away))
    (one,) = missions_of(tracks, 1.0, lead="b")
    np.testing.assert_array_equal(one.contact_rate[:, 0], [1.0] + [0.0] * 9)
    hidden = Tracks(POSES, SEEN, landmarks=[[2.0, 1.5, 0.6]])
    assert features_of(hidden, "a", "b")[2].tolist() == [1, 0, 0, 1, 1, 1, 1, 1]
    crossing = poses | {"y": [0.0] * 4 + [-2.5, 7.5]}
    with pytest.warns(UserWarning, match="no detection names c"):
        hidden = Tracks(crossing, SEEN, robot_radius=0.3, max_gap=10.0)
    assert features_of(hidden, "a", "b")[2].tolist() == [1.0] * 2 + [0.0] + [1.0] * 7


def test_windows_are_bounds_and_rates_are_shares_of_their_ticks():
    (one,) = missions_of(Tracks(POSES, SEEN), 4.0, lead="a")
    assert one.robots == ("a", "b")
    assert {bound.cell for bound in one.bounds} == {NOWHERE}
    np.testing.assert_array_equal(one.contact_rate, [[np.nan, 0.0], [np.nan, 0.25]])
    np.testing.assert_array_equal(one.n_ticks[:, 1], [4.0, 4.0])
    np.testing.assert_allclose(one.awareness[:, 1], [[0.5, 0.0, 1.0]] * 2)
    assert [bound.t0 for bound in one.bounds] == [0.0, 4.0]
    made = missions_of(Tracks(POSES, SEEN), 2.0)
    assert np.isnan([made[0].contact_rate[:, 0], made[1].contact_rate[:, 1]]).all()
    with pytest.raises(TrustboError, match="robot"):
        missions_of(Tracks(POSES, SEEN), lead="c")


def test_crossings_of_the_lead_are_bounds_of_a_map():
    workspace = tb.Workspace.from_awareness(np.full((2, 2, 4, 2), 0.5), cell_size=2.0)
    poses = POSES | {"y": [1.0] * 3 + [3.0] * 3}
    (one,) = missions_of(Tracks(poses, SEEN), lead="a", workspace=workspace)
    assert one.path == ((1, 0), (1, 1), (1, 2), (1, 3))
    np.testing.assert_array_equal(one.contact_rate[:, 1], [0.0, 0.0, 0.5])


@pytest.mark.parametrize(
    ("poses", "seen"),
    [
        ({"x": [0, 1, np.nan, 2, 3, 4]}, {}),
        ({"t": [0, 1, 1, 0, 1, 2]}, {}),
        ({"heading": [0, np.nan, 0, 0, 0, 0]}, {}),
        ({"robot": ["a"] * 6}, {}),
        ({"robot": ["a"] * 5 + ["b"]}, {}),
        ({}, {"seen": ["c", "d", "e"]}),
        ({}, {"seen": ["B", "b", "a"]}),
        ({}, {"t": [1e9] * 3}),
        ({"t": [0, 1e6, 2e6] * 2}, {}),
        ({"heading": [0.0, 90.0, 350.0, 0.0, 0.0, 0.0]}, {}),
        ({"x": [2e-5, 3e-5, 4e-5] * 2, "y": [0.0] * 6}, {}),
        ({"t": [0, 4e5, 5e5] * 2, "heading": [np.nan] * 6}, {}),
    ],
)
def test_tables_in_other_units_or_names_are_refused_in_one_line(poses, seen):
    with pytest.raises(TrustboError) as caught:
        Tracks(pd.DataFrame(POSES | poses), SEEN | seen)
    assert "\n" not in str(caught.value)
