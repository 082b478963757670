"""Openness: transmittance along the same fan of rays from every pixel, row by row.

Method: ray marching on a regular grid, vectorised over the rays of one direction. These cross the
lines through pixel centres at the same offsets from their pixel: crossings, neighbours and weights
are computed once, and each step of the rays of a row is a vector operation.

A ray has the height z + t rise at t in [0, 1]. The canopy is the layer from g + crown_base (s - g)
to s over the ground g, s being the surface. With a(t) = height above the layer's lower edge and
b(t) = depth below its top, both taken as linear between two crossings, the ray is inside where both
are positive. State: a and b at the last crossing, the share of the ray inside, and whether the
ground blocks. Invariant: after the crossing at t, the share is that of [0, t], and `through` is 0
exactly if the ray was below the ground at a crossing up to t. So each ray has the transmittance of
`rays.ray_transmittance`, exp(-extinction * length * share) or 0.
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
    box: np.ndarray  # (ray, 4), lowest and highest row offset of the end, column offset likewise

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
            for padded, values in zip((t, counts, neighbour, weight), ray, strict=True):
                padded[k, : len(values)] = values
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


class Optics(NamedTuple):
    """Heights of sensor and targets, and the canopy; float32 numbers."""

    eye: np.float32  # of the sensor above ground, m
    target: np.float32  # of the targets above ground, m
    reach: np.float32  # length of the rays on the map, m
    extinction: np.float32  # of the canopy, 1/m
    crown_base: np.float32  # lower edge of the canopy as a share of its height


class Rays(NamedTuple):
    """State of the rays of one direction from the pixels of a tile, each (pixel,)."""

    z: np.ndarray  # height of the start, m
    rise: np.ndarray  # height of the end above the start, m
    inside: np.ndarray  # share inside the canopy so far; at the end, metres
    through: np.ndarray  # 1, or 0 once the ground blocks
    above: np.ndarray  # a, height above the canopy's lower edge at the last crossing, m
    below: np.ndarray  # b, depth below the canopy's top there, m
    end: np.ndarray  # ground height where the rays end, m
    depth: np.ndarray  # canopy height there, m


class Line(NamedTuple):
    """Heights on both sides of a crossing with a line, and their weights."""

    ground0: np.ndarray  # (pixel,)
    ground1: np.ndarray  # (pixel,)
    surface0: np.ndarray  # (pixel,)
    surface1: np.ndarray  # (pixel,)
    weight0: np.float32
    weight1: np.float32


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

    Arguments are those of `features.openness`, on arrays (row, col). Returns shape (row, col), in
    [0, 1]; rays that end off the raster or without data do not count. NaN where none counts, and in
    other rows than `rows`.
    """
    valid = np.isfinite(ground)
    # From the middle of the heights: float32 is then good to a millimetre on any terrain.
    middle = 0.5 * (ground[valid].min() + ground[valid].max()) if valid.any() else 0.0
    heights = (np.where(valid, a - middle, _NO_DATA) for a in (ground, surface))
    g, s = (np.ascontiguousarray(a, np.float32) for a in heights)
    fan = Fan.around(n_rays, reach, pixel)
    optics = Optics(*map(np.float32, (eye, target, reach, extinction, crown_base)))
    result = np.full(g.shape, np.nan, ground.dtype)
    top, bottom, _ = rows.indices(len(g))

    def work(first: int, last: int) -> None:
        _openness(g, s, fan, optics, result, top + first, top + last)

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
            point = np.array([t * down, t * right])
            point[axis] = math.copysign(line, far)
            is_most = axis == (0 if abs(down) >= abs(right) else 1)
            crossings[round(t, 12)] = (t, point, is_most)
    ordered = [crossings[key] for key in sorted(crossings)]
    t = np.array([crossing[0] for crossing in ordered])
    counts = np.array([crossing[2] for crossing in ordered], bool)
    point = np.array([crossing[1] for crossing in ordered]).reshape(-1, 2)
    low = np.floor(np.round(point, 9))
    fraction = (point - low).max(axis=1, initial=0.0)  # on a line, one of the two is whole
    fraction = np.where(fraction > 1e-9, fraction, 0.0)
    other = np.where((point - low > 1e-9), low + 1, low)
    neighbour = np.stack([low, other], axis=1).astype(int)
    return t, counts, neighbour, np.stack([1.0 - fraction, fraction], axis=1)


@_compiled
def _openness(ground, surface, fan, optics, result, first, last):
    n_rows, n_cols = ground.shape
    total, count = np.empty(_TILE, np.float32), np.empty(_TILE, np.float32)
    scratch = np.empty((8, _TILE), np.float32)
    rays = Rays(scratch[0], scratch[1], scratch[2], scratch[3],
                scratch[4], scratch[5], scratch[6], scratch[7])  # fmt: skip
    none = np.float32(_LEAST_NO_DATA)
    for i in range(first, last):
        for tile in range(0, n_cols, _TILE):
            width = min(_TILE, n_cols - tile)
            total[:width] = 0.0
            count[:width] = 0.0
            for k in range(len(fan.n_crossings)):
                if i + fan.box[k, 0] < 0 or i + fan.box[k, 1] > n_rows - 1:
                    continue  # all rays of direction k end off the raster
                # Pixels j .. j + n - 1 of the tile are those whose rays end on the raster.
                j = max(tile, -fan.box[k, 2])
                n = min(tile + width, n_cols - fan.box[k, 3]) - j
                if n > 0:
                    _march(ground, surface, fan, k, optics, i, j, n, rays)
                    _add(rays, n, optics.extinction, total[j - tile :], count[j - tile :])
            for j in range(width):
                has_value = ground[i, tile + j] < none and count[j] > 0.0
                result[i, tile + j] = total[j] / count[j] if has_value else np.nan


@_part
def _march(ground, surface, fan, k, optics, i, j, n, rays):
    """Metres inside the canopy, and whether the ground blocks, for the rays of n pixels."""
    target, crown_base = optics.target, optics.crown_base
    # 1. Bilinear heights of ground and canopy where the rays end.
    rays.end[:n] = 0.0
    rays.depth[:n] = 0.0
    for c in range(4):
        row, col = i + fan.corner[k, c, 0], j + fan.corner[k, c, 1]
        low, top, share = ground[row, col:], surface[row, col:], fan.share[k, c]
        for m in range(n):
            rays.end[m] += share * low[m]
            rays.depth[m] += share * (top[m] - low[m])
    # 2. State at t = 0, in the pixel itself.
    here, over = ground[i, j:], surface[i, j:]
    for m in range(n):
        rays.z[m] = here[m] + optics.eye
        rays.rise[m] = rays.end[m] + target - rays.z[m]
        rays.inside[m] = 0.0
        rays.through[m] = 1.0
        rays.above[m] = optics.eye - crown_base * (over[m] - here[m])
        rays.below[m] = over[m] - here[m] - optics.eye
    # 3. Crossings in order of t. The ground is tested at all; the canopy is integrated over those
    # of the axis with more of them, about one per pixel, since `before`.
    before = np.float32(0.0)
    for c in range(fan.n_crossings[k]):
        t = fan.t[k, c]
        a, b = fan.neighbour[k, c, 0], fan.neighbour[k, c, 1]
        line = Line(ground[i + a[0], j + a[1] :], ground[i + b[0], j + b[1] :],
                    surface[i + a[0], j + a[1] :], surface[i + b[0], j + b[1] :],
                    fan.weight[k, c, 0], fan.weight[k, c, 1])  # fmt: skip
        if not fan.counts[k, c]:
            _block(line, t, n, rays)
            continue
        _step(line, t, t - before, crown_base, n, rays)
        before = t
    # 4. The rest, up to the end; shares of the ray's length become metres.
    for m in range(n):
        a1, b1 = target - crown_base * rays.depth[m], rays.depth[m] - target
        rest = np.float32(1.0) - before
        rays.inside[m] += rest * share_inside(rays.above[m], a1, rays.below[m], b1)
        rays.inside[m] *= np.sqrt(optics.reach * optics.reach + rays.rise[m] * rays.rise[m])


@_part
def _block(line, t, n, rays):
    """Block the rays below the ground at a crossing."""
    for m in range(n):
        ground = line.weight0 * line.ground0[m] + line.weight1 * line.ground1[m]
        passes = rays.z[m] + t * rays.rise[m] >= ground
        rays.through[m] = rays.through[m] if passes else np.float32(0.0)


@_part
def _step(line, t, dt, crown_base, n, rays):
    """Advance all rays to the crossing at t, dt after the last one."""
    for m in range(n):
        g = line.weight0 * line.ground0[m] + line.weight1 * line.ground1[m]
        s = line.weight0 * line.surface0[m] + line.weight1 * line.surface1[m]
        height = rays.z[m] + t * rays.rise[m]
        a1, b1 = height - (g + crown_base * (s - g)), s - height  # a and b at t
        rays.inside[m] += dt * share_inside(rays.above[m], a1, rays.below[m], b1)
        rays.through[m] = np.float32(0.0) if height < g else rays.through[m]
        rays.above[m] = a1
        rays.below[m] = b1


@_part
def _add(rays, n, extinction, total, count):
    """Add the rays that end on data."""
    none = np.float32(_LEAST_NO_DATA)  # missing heights make `rise` huge
    for m in range(n):
        if rays.rise[m] < none:
            total[m] += rays.through[m] * math.exp(-extinction * rays.inside[m])
            count[m] += np.float32(1.0)
