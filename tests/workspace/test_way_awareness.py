"""Awareness of given ways where it is known by hand: level ground, with a wall of canopy."""

import numpy as np
import pytest
from worlds import terrain_of

import trustbo as tb
from trustbo.workspace.way_awareness import awareness_of_ways


def test_half_of_a_road_is_hidden_by_a_wall_at_its_middle():
    """T2 sees the lead before the wall, and the lead sees T2 behind it: half of both phases."""
    height = np.zeros((60, 90))
    height[:, 45:47] = 20.0
    workspace = tb.Workspace.from_terrain(
        terrain_of(np.zeros((60, 90)), height), (2, 3), sight="wall"
    )
    left, bottom, *_ = workspace.grid.bounds
    ways = [
        np.array([[left + 11.0, bottom + 15.0], [left + 81.0, bottom + 15.0]]),  # through it
        np.array([[left + 10.0, bottom + 15.0], [left + 40.0, bottom + 15.0]]),  # before it
        np.array(
            [
                [left + 10.0, bottom + 15.0],
                [left + 25.0, bottom + 40.0],
                [left + 40.0, bottom + 50.0],
            ]
        ),
    ]
    sight = workspace.features.index("line_of_sight")
    found = awareness_of_ways(workspace, ways)
    assert found.shape == (3, 3, len(workspace.features))
    detection = workspace.team.robots[0].detection
    # 16 times in each phase: the wall hides 8, or one more where a time falls in its two metres.
    np.testing.assert_allclose(found[0, :, sight], 0.5 * detection, rtol=0.0, atol=detection / 16)
    np.testing.assert_allclose(found[1:, :, sight], detection, rtol=0.0, atol=1e-12)
    # Level ground is as easy everywhere; other features are those of the cell where a way ends.
    easy = workspace.features.index("traversability")
    np.testing.assert_allclose(found[..., easy], found[0, 0, easy])
    cells = [workspace.grid.cell_at(*way[-1]) for way in ways]
    seen = workspace.features.index("visibility")
    np.testing.assert_array_equal(
        found[..., seen], [workspace.awareness.values[:, r, c, seen] for r, c in cells]
    )


def test_a_road_into_a_cell_without_data_is_refused():
    dem = np.zeros((60, 60))
    dem[:30, 30:] = np.nan
    workspace = tb.Workspace.from_terrain(terrain_of(dem), (2, 2), sight="bare")
    left, bottom, *_ = workspace.grid.bounds
    way = np.array([[left + 10.0, bottom + 10.0], [left + 50.0, bottom + 50.0]])
    with pytest.raises(tb.errors.TrustboError, match=r"in cell \(0, 1\), whose awareness is not"):
        awareness_of_ways(workspace, [way])
