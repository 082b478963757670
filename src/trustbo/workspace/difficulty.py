"""Difficulty of bounds: how near the ways come to what the robots can drive at all.

Each measure is 0 where all ways are easy and about 1 at the team's limit: that of the way which is
worst in it, of the lead and of T2. T2's ways go on to the next cell straight ahead; where no pixel
around is impassable, the lead's stands for them, which spares their search.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from trustbo.data import Cell
from trustbo.workspace.moves import MOVES
from trustbo.workspace.ways import Ways

MEASURES = ("untraversable", "steepness", "narrowness", "tightness")
"""Measures of difficulty, see `bound_difficulty`."""
_ASIDE = 1.5  # m that a robot may leave its route by, in curves
_WIDTH = 2.0  # m of room on either side that count as half narrow
_MOST = 2.0  # a cliff is no worse than twice the limit
_TIGHT = 3.0  # log(1 + m) along impassable ground that count as 1: 19 m


class _Pixels(NamedTuple):
    """Maps of pixels (row, col)."""

    traversability: np.ndarray
    steepness: np.ndarray  # the largest within reach, as a share of the limit
    room: np.ndarray  # distance to the nearest impassable pixel, m


def bound_difficulty(
    ways: Ways, traversability: np.ndarray, exists: np.ndarray, max_slope: float
) -> np.ndarray:
    """Compute the difficulty of bounds that exist, (move, row, col, measure); NaN elsewhere.

    Of a way, `untraversable` is one minus the mean traversability of its pixels; `steepness` the
    tangent of the steepest slope within 1.5 m, as a share of that of `max_slope`, rad;
    `narrowness` 1 / (1 + w / 2 m) with w the least distance to an impassable pixel; `tightness`
    log(1 + l / 1 m) / 3 with l the length of its pixels that touch an impassable one.
    """
    maps = _pixel_maps(ways, traversability, max_slope)
    out = np.full((*exists.shape, len(MEASURES)), np.nan)
    for m, row, col in np.argwhere(exists).tolist():
        (down, right), cell = MOVES[8][m], (row, col)
        ahead = row + down, col + right
        inside = 0 <= ahead[0] < exists.shape[1] and 0 <= ahead[1] < exists.shape[2]
        onward = ahead if inside and exists[m, *ahead] else None
        out[m, row, col] = _of_bound(ways, maps, (row - down, col - right), cell, onward)
    return out


def _of_bound(ways: Ways, maps: _Pixels, a: Cell, c: Cell, onward: Cell | None) -> np.ndarray:
    surface = ways.posts.surface
    high, wide = surface.pixel
    top, bottom, left, right = ways.posts.window(a, c)
    others = []
    if not surface.passable[top:bottom, left:right].all():
        others = ways.closing(a, c, onward)
    worst = np.zeros(len(MEASURES))
    for way in (ways.lead(a, c), *others):
        if way is None:
            continue  # two posts may be in one pixel, and their way of no length
        at = surface.nearest(*way.T)
        easy, steep, room = (values[at] for values in maps)
        easy = easy[np.isfinite(easy)]
        tight = (room <= 1.001 * max(high, wide)).sum() * min(high, wide)
        measures = (
            1.0 - easy.mean() if len(easy) else 0.5,
            steep.max(),
            1.0 / (1.0 + room.min() / _WIDTH),
            np.log1p(tight) / _TIGHT,
        )
        worst = np.maximum(worst, measures)
    return worst


def _pixel_maps(ways: Ways, traversability: np.ndarray, max_slope: float) -> _Pixels:
    surface = ways.posts.surface
    size = [2 * max(1, round(_ASIDE / step)) + 1 for step in surface.pixel]
    steep = np.hypot(*surface.gradient) / np.tan(max_slope)
    steep = np.minimum(ndimage.maximum_filter(steep, size), _MOST)
    room = np.full(steep.shape, np.inf)
    if not surface.passable.all():
        room = np.asarray(ndimage.distance_transform_edt(surface.passable, sampling=surface.pixel))
    return _Pixels(traversability, steep, room)
