"""Transmittance of rays over a raster, blocked by the ground and attenuated by the canopy.

Heights belong to pixel centres and are bilinear between them. The canopy over the ground g is the
layer from g + crown_base (s - g) to the surface s. A ray with m metres inside it transmits

    exp(-extinction m),

or nothing if it meets the ground or leaves the data. It is followed from square to square between
four pixel centres; within one, heights along a ray are quadratic, so that the metres inside are
exact.
"""

import math

import numpy as np
from numba import njit

from trustbo.parallel import PART, over_rows

_kernel = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "arcp"})
_part = njit(nogil=True, error_model="numpy", fastmath={"contract", "nsz", "arcp"}, **PART)
_BLOCK, _RAYS = 4, 16
"""Side of the squares of pixels that share an openness, and its directions."""


@_part
def bilinear(heights, r, c):
    """Height at a position in pixel coordinates; NaN off the raster, or of NaN."""
    rows, cols = heights.shape
    if not (0.0 <= r <= rows - 1 and 0.0 <= c <= cols - 1):
        return math.nan
    i, j = min(int(r), rows - 2), min(int(c), cols - 2)
    p, q = r - i, c - j
    upper = heights[i, j] if q == 0.0 else (1.0 - q) * heights[i, j] + q * heights[i, j + 1]
    if p == 0.0:  # a neighbour without weight may be missing
        return upper
    lower = heights[i + 1, j]
    lower = lower if q == 0.0 else (1.0 - q) * lower + q * heights[i + 1, j + 1]
    return lower if p == 1.0 else (1.0 - p) * upper + p * lower


@_part
def _quadratic(corners, p0, q0, p1, q1):
    """Coefficients of a bilinear height along the line from (p0, q0) to (p1, q1) of a square."""
    h, right, down, both = corners
    right, down, both = right - h, down - h, both - right - down + h
    dp, dq = p1 - p0, q1 - q0
    first = dp * down + dq * right + both * (p0 * dq + q0 * dp)
    return h + p0 * down + q0 * right + both * p0 * q0, first, both * dp * dq


@_part
def _roots(c0, c1, c2):
    """Roots of c0 + c1 t + c2 t^2 in [0, 1], in order; 0 or 1 for those that are not."""
    square = c1 * c1 - 4.0 * c2 * c0
    if not square > 0.0:
        return 0.0, 0.0
    half = -0.5 * (c1 + math.copysign(math.sqrt(square), c1))
    a, b = half / c2 if c2 != 0.0 else 2.0, c0 / half if half != 0.0 else 2.0
    a, b = min(max(a, 0.0), 1.0), min(max(b, 0.0), 1.0)
    return min(a, b), max(a, b)


@_part
def _share_inside(above, below):
    """Share of [0, 1] in which two quadratics are both positive."""
    (a, b), (u, v) = _roots(*above), _roots(*below)
    first, last, low, high = min(a, u), max(b, v), max(a, u), min(b, v)
    ends = (first, min(low, high), max(low, high), last, 1.0)
    start, inside = 0.0, 0.0
    for end in ends:
        if end == start:
            continue
        t = 0.5 * (start + end)
        is_above = above[0] + t * (above[1] + t * above[2]) > 0.0
        if is_above and below[0] + t * (below[1] + t * below[2]) > 0.0:
            inside += end - start
        start = end
    return inside


@_part
def _least(c0, c1, c2):
    """Least value of c0 + c1 t + c2 t^2 in [0, 1]."""
    least = min(c0, c0 + c1 + c2)
    if c2 > 0.0 and 0.0 < -c1 < 2.0 * c2:
        least = c0 - c1 * c1 / (4.0 * c2)
    return least


@_part
def _next_line(x0, dx, t):
    """Position on the ray, above t, of its next crossing with a line through pixel centres."""
    if dx == 0.0:
        return 1.0
    x = x0 + t * dx
    line = math.floor(x + 1e-9) + 1.0 if dx > 0.0 else math.ceil(x - 1e-9) - 1.0
    return (line - x0) / dx


@_part
def transmittance(ground, surface, pixel, start, end, extinction, crown_base):
    """Share of a beam from `start` to `end`, each row, col and height (m), that passes.

    0 where the ground blocks, off the raster, and where a pixel beside the ray has no data.
    """
    (r0, c0, z0), (r1, c1, z1) = start, end
    rows, cols = ground.shape
    # Not the reverse comparison: it is false for NaN.
    if not (r0 >= 0.0 and r1 >= 0.0 and r0 <= rows - 1 and r1 <= rows - 1):
        return 0.0
    if not (c0 >= 0.0 and c1 >= 0.0 and c0 <= cols - 1 and c1 <= cols - 1):
        return 0.0
    dr, dc, dz = r1 - r0, c1 - c0, z1 - z0
    inside, t = 0.0, 0.0
    while t < 1.0:
        then = min(1.0, _next_line(r0, dr, t), _next_line(c0, dc, t))
        middle = 0.5 * (t + then)
        i = min(int(r0 + middle * dr), rows - 2)
        j = min(int(c0 + middle * dc), cols - 2)
        tops = surface[i, j], surface[i, j + 1], surface[i + 1, j], surface[i + 1, j + 1]
        z = z0 + t * dz
        if not min(z, z0 + then * dz) > max(max(tops[0], tops[1]), max(tops[2], tops[3])):
            lows = ground[i, j], ground[i, j + 1], ground[i + 1, j], ground[i + 1, j + 1]
            way = (r0 + t * dr - i, c0 + t * dc - j, r0 + then * dr - i, c0 + then * dc - j)
            g, s = _quadratic(lows, *way), _quadratic(tops, *way)
            rise = (then - t) * dz
            if not _least(z - g[0], rise - g[1], -g[2]) >= -1e-9:
                return 0.0
            base = crown_base
            above = (
                z - g[0] - base * (s[0] - g[0]),
                rise - g[1] - base * (s[1] - g[1]),
                -g[2] - base * (s[2] - g[2]),
            )
            inside += (then - t) * _share_inside(above, (s[0] - z, s[1] - rise, s[2]))
        t = then
    if inside == 0.0:  # also where the extinction is infinite
        return 1.0
    return math.exp(
        -extinction * inside * math.sqrt((dr * pixel[0]) ** 2 + (dc * pixel[1]) ** 2 + dz**2)
    )


@_kernel
def transmittances(ground, surface, pixel, ends, extinction, crown_base):
    """Transmittance of rays (ray, 6): row, col and height of both ends; 0 where one is NaN."""
    out = np.zeros(len(ends))
    for i in range(len(ends)):
        start, end = (ends[i, 0], ends[i, 1], ends[i, 2]), (ends[i, 3], ends[i, 4], ends[i, 5])
        if not (math.isnan(start[2]) or math.isnan(end[2])):
            out[i] = transmittance(ground, surface, pixel, start, end, extinction, crown_base)
    return out


def openness(
    ground: np.ndarray,
    surface: np.ndarray,
    pixel: tuple[float, float],
    reach: float,
    heights: tuple[float, float],
    canopy: tuple[float, float] = (0.1, 0.3),
) -> np.ndarray:
    """Mean transmittance to 16 points `reach` metres away all around, (row, col), in [0, 1].

    Computed in the middle of squares of 4 x 4 pixels, all of which get its value. Eye and target
    have `heights` above ground; the canopy has an extinction (1/m) and a crown base. Rays that end
    off the data do not count; NaN where none does, and without ground.
    """
    rows, cols = ground.shape
    coarse = np.empty((-(-rows // _BLOCK), -(-cols // _BLOCK)))

    def work(first: int, last: int) -> None:
        _openness(ground, surface, pixel, reach, heights, canopy, coarse, first, last)

    over_rows(work, len(coarse))
    whole = coarse.repeat(_BLOCK, axis=0).repeat(_BLOCK, axis=1)[:rows, :cols]
    return np.where(np.isfinite(ground), whole, np.nan)


@_kernel
def _openness(ground, surface, pixel, reach, heights, canopy, coarse, first, last):
    middle = 0.5 * (_BLOCK - 1)
    for i in range(first, last):
        for j in range(coarse.shape[1]):
            r = min(_BLOCK * i + middle, ground.shape[0] - 1.0)
            c = min(_BLOCK * j + middle, ground.shape[1] - 1.0)
            z, total, n = bilinear(ground, r, c), 0.0, 0
            for k in range(_RAYS):
                angle = 2.0 * math.pi * k / _RAYS
                r1 = r - reach * math.sin(angle) / pixel[0]
                c1 = c + reach * math.cos(angle) / pixel[1]
                z1 = bilinear(ground, r1, c1)
                if math.isfinite(z + z1):
                    ends = (r, c, z + heights[0]), (r1, c1, z1 + heights[1])
                    total += transmittance(ground, surface, pixel, *ends, *canopy)
                    n += 1
            coarse[i, j] = total / n if n > 0 else math.nan
