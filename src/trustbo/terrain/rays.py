"""Transmittance of rays over a raster, blocked by the ground and attenuated by the canopy.

Heights belong to pixel centres. A ray runs between two points given in pixel coordinates (row, col)
and height. It is blocked if it lies below the blocking surface where it crosses a line through a
row or a column of pixel centres; heights are interpolated linearly along such lines. Metres inside
the canopy are integrated over the crossings with rows or with columns, whichever are more, about
one per pixel: heights are taken as linear between two of them.
"""

import math

import numpy as np
from numba import njit

from trustbo.parallel import PART

# A division that checks for 0 takes as long as the rest.
_compiled = njit(
    cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "arcp", "reassoc"}
)
_part = njit(
    nogil=True, error_model="numpy", fastmath={"contract", "nsz", "arcp", "reassoc"}, **PART
)
# Passing arrays to a function, which counts references, takes as long as ten crossings.
_inlined = njit(cache=True, inline="always", nogil=True, error_model="numpy")
_CHUNK = 32

BARE, WALL, TRANSMITTANCE = 0, 1, 2
"""Modes of sight: the ground blocks; the surface blocks; the ground blocks, canopy attenuates."""


@_inlined
def ray_transmittance(ground, surface, pixel, start, end, mode, extinction, crown_base, work):
    """Share of a beam from `start` to `end` that passes the canopy, 0 if the ray is blocked.

    DEM `ground` and DSM `surface` (row, col), m; pixel height and width, m; both ends as row, col
    (fractions of pixels, centres at integers) and height, m; mode BARE, WALL or TRANSMITTANCE;
    extinction of the canopy, 1/m; `crown_base`, the canopy's lower edge as a share of its height;
    `work_space()`, reused by the next ray.

    Returns exp(-extinction * metres inside the canopy layer), or 0 where the ray is blocked, leaves
    the raster or crosses a pixel without data.
    """
    r0, c0, z0 = start
    r1, c1, z1 = end
    n_rows, n_cols = ground.shape
    # Not the reverse comparison: it is false for NaN.
    if not (r0 >= 0.0 and r1 >= 0.0 and c0 >= 0.0 and c1 >= 0.0):
        return 0.0
    if not (max(r0, r1) <= n_rows - 1 and max(c0, c1) <= n_cols - 1):
        return 0.0
    dz = z1 - z0
    rows = (n_cols, 1, r0, r1 - r0, c0, c1 - c0)  # strides across and along, and the ray there
    cols = (1, n_cols, c0, c1 - c0, r0, r1 - r0)
    most, fewest = (rows, cols) if abs(r1 - r0) >= abs(c1 - c0) else (cols, rows)
    blocking = surface.reshape(-1) if mode == WALL else ground.reshape(-1)
    if _is_blocked(blocking, fewest, z0, dz):
        return 0.0
    if mode != TRANSMITTANCE:
        return 0.0 if _is_blocked(blocking, most, z0, dz) else 1.0
    g0, s0 = _heights(ground, surface, r0, c0)
    g1, s1 = _heights(ground, surface, r1, c1)
    # Heights above the crowns' lower edge, and below their top, at either end.
    start = (z0 - (g0 + crown_base * (s0 - g0)), s0 - z0)
    end = (z1 - (g1 + crown_base * (s1 - g1)), s1 - z1)
    inside = _share_in_canopy(
        blocking, surface.reshape(-1), most, z0, dz, crown_base, start, end, work
    )
    if not inside >= 0.0:
        return 0.0
    length = math.sqrt(((r1 - r0) * pixel[0]) ** 2 + ((c1 - c0) * pixel[1]) ** 2 + dz**2)
    return math.exp(-extinction * inside * length)


@_compiled
def work_space():
    """Allocate the work array of a ray."""
    return np.empty((4, _CHUNK + 1))


@_part
def _crossings(x0, dx):
    """First line that x0 + t dx meets, its t, step to the next line, its t, and number of lines."""
    if dx == 0.0:
        return 0, 0.0, 0, 0.0, 0
    way = 1 if dx > 0.0 else -1
    line = math.floor(x0) + 1 if dx > 0.0 else math.ceil(x0) - 1
    t, step = (line - x0) / dx, way / dx
    # Not the end point: the target stands on the ground.
    return line, t, way, step, max(0, math.ceil((1.0 - t) / step - 1e-9))


@_compiled
def _is_blocked(heights, axis, z0, dz):
    """Whether a ray lies below heights on one of the lines of an axis; missing ones block."""
    across, along, x0, dx, y0, dy = axis
    line, t, way, step, n = _crossings(x0, dx)
    base, jump = line * across, way * across
    for _ in range(n):
        y = y0 + t * dy
        j = int(y)
        part = y - j
        here = np.uint64(base + j * along)
        # A neighbour without weight is not read: there may be none.
        beside = here + np.uint64(along if part > 1e-9 else 0)
        h = heights[here] + part * (heights[beside] - heights[here])
        z = z0 + t * dz
        if not z >= h and not (part > 1.0 - 1e-9 and z >= heights[beside]):
            return True
        t += step
        base += jump
    return False


@_compiled
def _share_in_canopy(ground, surface, axis, z0, dz, crown_base, start, end, work):
    """Share of the ray inside the canopy, by its crossings along an axis; -1 if blocked.

    Lines are taken in chunks: first their heights, then vector operations on whole vectors, as a
    remainder would take as long; surplus lines do not count.
    """
    across, along, x0, dx, y0, dy = axis
    line, t0, way, step, n = _crossings(x0, dx)
    base, jump = line * across, way * across
    g, s, above, below = work[0], work[1], work[2], work[3]
    above[0], below[0] = start
    before, inside = 0.0, 0.0
    for first in range(0, n, _CHUNK):
        m = min(_CHUNK, n - first)
        full = (m + 15) & -16
        t, pixels = t0 + first * step, base + first * jump
        for k in range(m):
            y = y0 + t * dy
            j = int(y)
            part = y - j
            here = np.uint64(pixels + j * along)
            # A neighbour without weight is not read: there may be none.
            beside = here + np.uint64(along if part > 1e-9 else 0)
            here = beside if part > 1.0 - 1e-9 else here
            g[k] = ground[here] + part * (ground[beside] - ground[here])
            if not z0 + t * dz >= g[k]:
                return -1.0
            s[k] = surface[here] + part * (surface[beside] - surface[here])
            t += step
            pixels += jump
        for k in range(full):
            z = z0 + (t0 + (first + k) * step) * dz
            above[k + 1] = z - (g[k] + crown_base * (s[k] - g[k]))
            below[k + 1] = s[k] - z
        if first == 0 and m > 0:
            inside += share_inside(above[0], above[1], below[0], below[1]) * t0
        total = 0.0
        for k in range(full):
            share = share_inside(above[k], above[k + 1], below[k], below[k + 1])
            total += share if (first + k > 0) & (k < m) else 0.0
        inside += total * step
        above[0], below[0] = above[m], below[m]
        before = t0 + (first + m - 1) * step
    return inside + share_inside(above[0], end[0], below[0], end[1]) * (1.0 - before)


@_compiled
def _heights(ground, surface, r, c):
    """Bilinear heights of ground and surface; a neighbour without weight is not read."""
    i = min(int(r), ground.shape[0] - 2)
    j = min(int(c), ground.shape[1] - 2)
    fr, fc = r - i, c - j
    # Positions within rounding of a line are on it.
    fr = 0.0 if fr < 1e-9 else fr
    fc = 0.0 if fc < 1e-9 else fc
    i, fr = (i + 1, 0.0) if fr > 1.0 - 1e-9 else (i, fr)
    j, fc = (j + 1, 0.0) if fc > 1.0 - 1e-9 else (j, fc)
    k, m = i + (fr > 0.0), j + (fc > 0.0)
    a, b, d, e = (1 - fr) * (1 - fc), (1 - fr) * fc, fr * (1 - fc), fr * fc
    g = a * ground[i, j] + b * ground[i, m] + d * ground[k, j] + e * ground[k, m]
    s = a * surface[i, j] + b * surface[i, m] + d * surface[k, j] + e * surface[k, m]
    return g, s


@_compiled
def share_inside(a0, a1, b0, b1):
    """Share of an interval on which both a0..a1 and b0..b1 are positive, without branches."""
    zero = a0 - a0  # in their precision
    one = zero + np.float32(1.0)
    ta, tb = a0 / (a0 - a1), b0 / (b0 - b1)
    low_a = (ta if a1 > zero else one) if a0 <= zero else zero
    low_b = (tb if b1 > zero else one) if b0 <= zero else zero
    high_a = (ta if a0 > zero else zero) if a1 < zero else one
    high_b = (tb if b0 > zero else zero) if b1 < zero else one
    low = low_a if low_a > low_b else low_b
    high = high_a if high_a < high_b else high_b
    return high - low if high > low else zero


@_compiled
def ground_height(ground, r, c):
    """Bilinear ground height at a position in pixel coordinates; NaN off the raster, or of NaN."""
    if not (0.0 <= r <= ground.shape[0] - 1 and 0.0 <= c <= ground.shape[1] - 1):
        return math.nan
    return _heights(ground, ground, r, c)[0]
