"""Openness: transmittance along the same fan of rays from every pixel, row by row.

All rays of one direction cross the lines between pixel centres at the same offsets from their
pixel: crossings, neighbours and weights are computed once, and each step of the rays of a row is a
vector operation. Each ray has the transmittance of `rays.ray_transmittance`.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.parallel import PART, over_rows
from trustbo.terrain.rays import share_inside

_NO_DATA, _LEAST_NO_DATA = 1e30, 1e20  # higher than any ray, even with a small weight
_TILE = 1024  # columns at once: their buffers stay in the fastest cache

_compiled = njit(
    cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "arcp", "reassoc"}
)
_part = njit(
    nogil=True, error_model="numpy", fastmath={"contract", "nsz", "arcp", "reassoc"}, **PART
)


class Fan(NamedTuple):
    """Crossings of the rays of each direction with the lines between pixel centres."""

    n_crossings: np.ndarray  # (ray,)
    t: np.ndarray  # (ray, crossing), position on the ray, in (0, 1)
    counts: np.ndarray  # (ray, crossing), whether it measures the canopy
    neighbour: np.ndarray  # (ray, crossing, 2, 2), row and column offset of the two pixels
    weight: np.ndarray  # (ray, crossing, 2), weights of their heights
    corner: np.ndarray  # (ray, 4, 2), offsets of the four pixels around the end
    share: np.ndarray  # (ray, 4), their weights
    reach: np.ndarray  # (ray, 4), lowest and highest row offset of the end, column offset likewise

    @classmethod
    def around(cls, n_rays: int, reach: float, pixel: tuple[float, float]) -> "Fan":
        """Make the fan of `n_rays` evenly spread directions, the first to the east."""
        angle = 2.0 * math.pi / n_rays * np.arange(n_rays)
        # Rounded, so that a ray along the raster's edge does not leave it by a rounding error.
        down = np.round(reach * np.sin(angle) / pixel[0], 9)
        right = np.round(reach * np.cos(angle) / pixel[1], 9)
        rays = [_crossings(r, c) for r, c in zip(down, right, strict=True)]
        most = max(len(ray[0]) for ray in rays)
        t = np.zeros((n_rays, most), np.float32)
        neighbour = np.zeros((n_rays, most, 2, 2), np.int64)
        weight = np.zeros((n_rays, most, 2), np.float32)
        counts = np.zeros((n_rays, most), bool)
        for k, ray in enumerate(rays):
            for whole, part in zip((t, counts, neighbour, weight), ray, strict=True):
                whole[k, : len(part)] = part
        row, col = np.floor(down).astype(int), np.floor(right).astype(int)
        fr, fc = down - row, right - col
        corner = np.stack([[row, col], [row, col + 1], [row + 1, col], [row + 1, col + 1]])
        share = np.stack([(1 - fr) * (1 - fc), (1 - fr) * fc, fr * (1 - fc), fr * fc], axis=1)
        corner = np.moveaxis(corner, 2, 0)
        # A pixel without weight may be off the raster: it must not be read.
        heaviest = corner[np.arange(n_rays), share.argmax(1)]
        corner = np.where(share[..., None] > 1e-9, corner, heaviest[:, None])
        share = np.where(share > 1e-9, share, 0.0).astype(np.float32)
        ends = np.concatenate([corner.min(1)[:, :1], corner.max(1)[:, :1],
                               corner.min(1)[:, 1:], corner.max(1)[:, 1:]], axis=1)  # fmt: skip
        n_crossings = np.array([len(ray[0]) for ray in rays])
        return cls(n_crossings, t, counts, neighbour, weight, corner, share, ends)


def openness(
    ground: np.ndarray,
    surface: np.ndarray,
    pixel: tuple[float, float],
    reach: float,
    eye: float,
    target: float,
    n_rays: int,
    extinction: float,
    crown_base: float,
    rows: slice,
) -> np.ndarray:
    """Mean transmittance from each pixel to points `reach` metres away all around.

    Args:
        ground: DEM, shape (row, col), m.
        surface: DSM, shape (row, col), m.
        pixel: Pixel height and width, m.
        reach: Length of the rays, m.
        eye: Height of the sensor above ground, m.
        target: Height of the targets above ground, m.
        n_rays: Number of directions.
        extinction: Extinction coefficient of the canopy, 1/m.
        crown_base: Height of the canopy's lower edge as a share of its height.
        rows: Rows of pixels to compute; the others are NaN.

    Returns:
        Shape (row, col), in [0, 1]; rays that end off the raster or without data do not count. NaN
        where none counts.
    """
    known = np.isfinite(ground)
    # From the middle of the heights: float32 is then good to a millimetre on any terrain.
    middle = 0.5 * (ground[known].min() + ground[known].max()) if known.any() else 0.0
    heights = (np.where(known, a - middle, _NO_DATA) for a in (ground, surface))
    g, s = (np.ascontiguousarray(a, np.float32) for a in heights)
    fan = Fan.around(n_rays, reach, pixel)
    numbers = np.array([eye, target, reach, extinction, crown_base], np.float32)
    result = np.full(g.shape, np.nan, ground.dtype)
    top, bottom, _ = rows.indices(len(g))

    def work(first: int, last: int) -> None:
        _openness(g, s, fan, numbers, result, top + first, top + last)

    over_rows(work, bottom - top)
    return result


def _crossings(down: float, right: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Crossings of one ray that ends at an offset: fields of `Fan` without the leading axis."""
    crossings: dict[float, tuple[float, np.ndarray, bool]] = {}
    # The axis with more crossings comes last: where two lines meet, its crossing is kept.
    for axis in (1, 0) if abs(down) >= abs(right) else (0, 1):
        far = (down, right)[axis]
        for line in range(1, math.ceil(abs(far))):
            t = line / abs(far)
            place = np.array([t * down, t * right])
            place[axis] = math.copysign(line, far)
            is_most = axis == (0 if abs(down) >= abs(right) else 1)
            crossings[round(t, 12)] = (t, place, is_most)
    ordered = [crossings[key] for key in sorted(crossings)]
    t = np.array([crossing[0] for crossing in ordered])
    counts = np.array([crossing[2] for crossing in ordered], bool)
    place = np.array([crossing[1] for crossing in ordered]).reshape(-1, 2)
    low = np.floor(np.round(place, 9))
    part = (place - low).max(axis=1, initial=0.0)  # on a line, one of the two is whole
    part = np.where(part > 1e-9, part, 0.0)
    other = np.where((place - low > 1e-9), low + 1, low)
    neighbour = np.stack([low, other], axis=1).astype(int)
    return t, counts, neighbour, np.stack([1.0 - part, part], axis=1)


@_compiled
def _openness(ground, surface, fan, numbers, result, first, last):
    n_rows, n_cols = ground.shape
    total, count = np.empty(_TILE, np.float32), np.empty(_TILE, np.float32)
    work = np.empty((8, _TILE), np.float32)
    none = np.float32(_LEAST_NO_DATA)
    for i in range(first, last):
        for tile in range(0, n_cols, _TILE):
            width = min(_TILE, n_cols - tile)
            total[:width] = 0.0
            count[:width] = 0.0
            for k in range(len(fan.n_crossings)):
                if i + fan.reach[k, 0] < 0 or i + fan.reach[k, 1] > n_rows - 1:
                    continue
                j = max(tile, -fan.reach[k, 2])
                n = min(tile + width, n_cols - fan.reach[k, 3]) - j
                if n > 0:
                    _march(ground, surface, fan, k, numbers, i, j, n, work)
                    _add(work, n, numbers[3], total[j - tile :], count[j - tile :])
            for j in range(width):
                known = ground[i, tile + j] < none and count[j] > 0.0
                result[i, tile + j] = total[j] / count[j] if known else np.nan


@_part
def _march(ground, surface, fan, k, numbers, i, j, n, work):
    """Metres inside the canopy, and whether the ground blocks, for the rays of n pixels."""
    eye, target, reach, crown_base = numbers[0], numbers[1], numbers[2], numbers[4]
    z, rise, inside, through, above, below = work[0], work[1], work[2], work[3], work[4], work[5]
    end, depth = work[6], work[7]  # ground and canopy height where the rays end
    end[:n] = 0.0
    depth[:n] = 0.0
    for c in range(4):
        row, col = i + fan.corner[k, c, 0], j + fan.corner[k, c, 1]
        low, top, share = ground[row, col:], surface[row, col:], fan.share[k, c]
        for m in range(n):
            end[m] += share * low[m]
            depth[m] += share * (top[m] - low[m])
    here, over = ground[i, j:], surface[i, j:]
    for m in range(n):
        z[m] = here[m] + eye
        rise[m] = end[m] + target - z[m]
        inside[m] = 0.0
        through[m] = 1.0
        above[m] = eye - crown_base * (over[m] - here[m])
        below[m] = over[m] - here[m] - eye
    before = np.float32(0.0)
    for c in range(fan.n_crossings[k]):
        t = fan.t[k, c]
        a, b = fan.neighbour[k, c, 0], fan.neighbour[k, c, 1]
        if not fan.counts[k, c]:
            _block(ground[i + a[0], j + a[1] :], ground[i + b[0], j + b[1] :],
                   fan.weight[k, c, 0], fan.weight[k, c, 1], t, n, z, rise, through)  # fmt: skip
            continue
        _step(ground[i + a[0], j + a[1] :], ground[i + b[0], j + b[1] :],
              surface[i + a[0], j + a[1] :], surface[i + b[0], j + b[1] :],
              fan.weight[k, c, 0], fan.weight[k, c, 1], t, t - before, crown_base, n,
              z, rise, inside, through, above, below)  # fmt: skip
        before = t
    for m in range(n):
        a1, b1 = target - crown_base * depth[m], depth[m] - target
        inside[m] += (np.float32(1.0) - before) * share_inside(above[m], a1, below[m], b1)
        inside[m] *= np.sqrt(reach * reach + rise[m] * rise[m])


@_part
def _block(g0, g1, w0, w1, t, n, z, rise, through):
    """Block the rays below the ground at a crossing."""
    for m in range(n):
        passes = z[m] + t * rise[m] >= w0 * g0[m] + w1 * g1[m]
        through[m] = through[m] if passes else np.float32(0.0)


@_part
def _step(g0, g1, s0, s1, w0, w1, t, dt, crown_base, n, z, rise, inside, through, above, below):
    """Advance all rays to their next crossing."""
    for m in range(n):
        g = w0 * g0[m] + w1 * g1[m]
        s = w0 * s0[m] + w1 * s1[m]
        height = z[m] + t * rise[m]
        a1, b1 = height - (g + crown_base * (s - g)), s - height
        inside[m] += dt * share_inside(above[m], a1, below[m], b1)
        through[m] = np.float32(0.0) if height < g else through[m]
        above[m] = a1
        below[m] = b1


@_part
def _add(work, n, extinction, total, count):
    """Add the rays that end on data."""
    rise, inside, through = work[1], work[2], work[3]
    none = np.float32(_LEAST_NO_DATA)
    for m in range(n):
        if rise[m] < none:
            total[m] += through[m] * math.exp(-extinction * inside[m])
            count[m] += np.float32(1.0)
