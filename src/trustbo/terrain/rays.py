"""Rays over a raster: does the ground block them, and how much canopy do they cross?

Heights belong to pixel centres. A ray runs between two points given in pixel coordinates (row, col)
and height, and is examined wherever it crosses a line through a row or a column of pixel centres,
where heights are interpolated linearly along that line. Between two crossings everything is taken
to change linearly, so the length inside the canopy layer is exact for that piecewise surface.
"""

import math

import numpy as np
from numba import njit

BARE, WALL, TRANSMITTANCE = 0, 1, 2
"""What blocks sight: the ground; the surface, canopy included; or the ground, and canopy partly."""


@njit(cache=True)
def ray_transmittance(ground, surface, pixel, start, end, mode, extinction, crown_base):
    """Share of a beam that passes from `start` to `end`.

    Args:
        ground: DEM, shape (row, col), m.
        surface: DSM, shape (row, col), m.
        pixel: Pixel height and width, m.
        start: Row, col (fractions of pixels, centres at integers) and height in m.
        end: Likewise.
        mode: BARE, WALL or TRANSMITTANCE.
        extinction: Extinction coefficient of the canopy, 1/m.
        crown_base: Height of the canopy's lower edge as a share of its height.

    Returns:
        exp(-extinction * metres inside the canopy layer), or 0 where the ray is blocked, leaves the
        raster or crosses a pixel without data.
    """
    r0, c0, z0 = start
    r1, c1, z1 = end
    n_rows, n_cols = ground.shape
    if min(r0, r1) < 0.0 or min(c0, c1) < 0.0:
        return 0.0
    if max(r0, r1) > n_rows - 1 or max(c0, c1) > n_cols - 1:
        return 0.0
    dr, dc, dz = r1 - r0, c1 - c0, z1 - z0
    length = math.sqrt((dr * pixel[0]) ** 2 + (dc * pixel[1]) ** 2 + dz**2)
    # Parameters t in [0, 1] of the next crossing of a row line and of a column line.
    t_row, step_row = _first_crossing(r0, dr)
    t_col, step_col = _first_crossing(c0, dc)
    inside = 0.0
    t_before, above_before, below_before, first = 0.0, 0.0, 0.0, True
    while True:
        t = min(t_row, t_col, 1.0)
        last = t >= 1.0
        r, c, z = r0 + t * dr, c0 + t * dc, z0 + t * dz
        g, s = _heights(ground, surface, r, c)
        if not g == g:  # no data
            return 0.0
        # At the far end, the target itself stands on the ground.
        if not last and z < (s if mode == WALL else g):
            return 0.0
        if mode == TRANSMITTANCE:
            above = z - (g + crown_base * (s - g))
            below = s - z
            if not first:
                share = _share_inside(above_before, above, below_before, below)
                inside += share * (t - t_before) * length
                if extinction * inside > 20.0:
                    return 0.0
            elif t > 0.0:
                g0, s0 = _heights(ground, surface, r0, c0)
                share = _share_inside(z0 - (g0 + crown_base * (s0 - g0)), above, s0 - z0, below)
                inside += share * t * length
            t_before, above_before, below_before, first = t, above, below, False
        if last:
            return math.exp(-extinction * inside) if mode == TRANSMITTANCE else 1.0
        if t_row <= t:
            t_row += step_row
        if t_col <= t:
            t_col += step_col


@njit(cache=True)
def _first_crossing(x, dx):
    """Parameter of the first integer that x + t dx meets for t > 0, and the step between them."""
    if dx > 0.0:
        return (math.floor(x) + 1.0 - x) / dx, 1.0 / dx
    if dx < 0.0:
        return (math.ceil(x) - 1.0 - x) / dx, -1.0 / dx
    return math.inf, math.inf


@njit(cache=True)
def _heights(ground, surface, r, c):
    """Bilinear heights of ground and surface; on a grid line this is linear along the line."""
    i = min(int(r), ground.shape[0] - 2)
    j = min(int(c), ground.shape[1] - 2)
    fr, fc = r - i, c - j
    a, b, d, e = (1 - fr) * (1 - fc), (1 - fr) * fc, fr * (1 - fc), fr * fc
    # A weight of zero must not pick up a neighbour's NaN.
    g, s = 0.0, 0.0
    for w, k, m in ((a, i, j), (b, i, j + 1), (d, i + 1, j), (e, i + 1, j + 1)):
        if w > 1e-9:
            g += w * ground[k, m]
            s += w * surface[k, m]
    return g, s


@njit(cache=True)
def _share_inside(a0, a1, b0, b1):
    """Share of [0, 1] on which both linear functions a0..a1 and b0..b1 are positive."""
    low, high = 0.0, 1.0
    for x0, x1 in ((a0, a1), (b0, b1)):
        if x0 <= 0.0 and x1 <= 0.0:
            return 0.0
        if x0 < 0.0:
            low = max(low, -x0 / (x1 - x0))
        elif x1 < 0.0:
            high = min(high, x0 / (x0 - x1))
    return max(0.0, high - low)


@njit(cache=True)
def openness(ground, surface, pixel, reach, eye, target, n_rays, extinction, crown_base):
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

    Returns:
        Shape (row, col), in [0, 1]; rays whose end is off the raster or without data do not count.
        NaN where none counts.
    """
    n_rows, n_cols = ground.shape
    angle = 2.0 * math.pi / n_rays * np.arange(n_rays)
    # Rounded, so that a ray along the raster's edge does not leave it by a rounding error.
    down = np.round(reach * np.sin(angle) / pixel[0], 9)
    right = np.round(reach * np.cos(angle) / pixel[1], 9)
    result = np.full(ground.shape, np.nan)
    for i in range(n_rows):
        for j in range(n_cols):
            if not ground[i, j] == ground[i, j]:
                continue
            total, count = 0.0, 0
            for k in range(n_rays):
                r, c = i + down[k], j + right[k]
                if r < 0.0 or c < 0.0 or r > n_rows - 1 or c > n_cols - 1:
                    continue
                g, _ = _heights(ground, surface, r, c)
                if not g == g:
                    continue
                total += ray_transmittance(
                    ground,
                    surface,
                    pixel,
                    (float(i), float(j), ground[i, j] + eye),
                    (r, c, g + target),
                    TRANSMITTANCE,
                    extinction,
                    crown_base,
                )
                count += 1
            if count:
                result[i, j] = total / count
    return result


@njit(cache=True)
def ground_height(ground, r, c):
    """Bilinear ground height at a position in pixel coordinates; NaN off the raster."""
    if r < 0.0 or c < 0.0 or r > ground.shape[0] - 1 or c > ground.shape[1] - 1:
        return math.nan
    return _heights(ground, ground, r, c)[0]
