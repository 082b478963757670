"""Difficulty of bounds: how near the way comes to what the robots can drive at all.

Each measure is 0 where the way is easy and about 1 at the team's limit. They are those of the
lead's way, the fastest route from waypoint to waypoint, and of the pixels that a robot which cuts
its corners may touch.
"""

import numpy as np
from scipy import ndimage

from trustbo.workspace.moves import MOVES
from trustbo.workspace.ways import Ways

MEASURES = ("untraversable", "steepness", "step", "narrowness")
"""Measures of difficulty, see `bound_difficulty`."""
_ASIDE = 1.5  # m that a robot may leave its route by, in curves
_WIDTH = 2.0  # m of room on either side that count as half narrow
_MOST = 2.0  # a cliff is no worse than twice the limit


def bound_difficulty(
    ways: Ways, traversability: np.ndarray, exists: np.ndarray, max_slope: float
) -> np.ndarray:
    """Compute the difficulty of bounds that exist, (move, row, col, measure); NaN elsewhere.

    `untraversable`: one minus the mean traversability of the way's pixels. `steepness`: tangent of
    the steepest slope within reach of the way, as a share of that of `max_slope`, rad. `step`:
    largest difference in height between neighbouring pixels there, as a share of that of a slope
    at the limit. `narrowness`: 1 / (1 + w / 2 m), w the least distance to an impassable pixel.

    A bound and its reverse have the same difficulty.
    """
    surface = ways.posts.surface
    maps = _pixel_maps(ways, traversability, max_slope)
    out = np.full((*exists.shape, len(MEASURES)), np.nan)
    n_moves = len(MOVES[8])
    for m, (down, right) in enumerate(MOVES[8][: n_moves // 2]):
        for row, col in np.argwhere(exists[m]).tolist():
            left = row - down, col - right
            way = ways.lead(left, (row, col))
            if way is None:
                continue
            at = surface.nearest(*way.T)
            easy, steep, step, room = (values[at] for values in maps)
            easy = easy[np.isfinite(easy)]
            out[m, row, col] = (
                1.0 - easy.mean() if len(easy) else 0.5,
                steep.max(),
                step.max(),
                1.0 / (1.0 + room.min() / _WIDTH),
            )
            out[n_moves - 1 - m, *left] = out[m, row, col]
    return np.where(exists[..., None], out, np.nan)


def _pixel_maps(ways: Ways, traversability: np.ndarray, max_slope: float) -> tuple[np.ndarray, ...]:
    """Traversability, steepness and step within reach, and room, of pixels (row, col)."""
    surface = ways.posts.surface
    limit, pixel = np.tan(max_slope), surface.pixel
    size = [2 * max(1, round(_ASIDE / step)) + 1 for step in pixel]
    steep = np.hypot(*surface.gradient) / limit
    ground = np.where(np.isfinite(surface.ground), surface.ground, np.nan)
    step = np.zeros_like(steep)
    for axis in (0, 1):
        rise = np.abs(np.diff(ground, axis=axis)) / (limit * pixel[axis])
        rise = np.nan_to_num(rise)
        before = [(0, 1) if a == axis else (0, 0) for a in (0, 1)]
        after = [(1, 0) if a == axis else (0, 0) for a in (0, 1)]
        step = np.maximum(step, np.maximum(np.pad(rise, before), np.pad(rise, after)))
    room = ndimage.distance_transform_edt(np.pad(surface.passable, 1), sampling=pixel)
    within = [ndimage.maximum_filter(values, size) for values in (steep, step)]
    return (
        traversability,
        *(np.minimum(values, _MOST) for values in within),
        np.asarray(room)[1:-1, 1:-1],
    )
