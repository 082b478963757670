"""Transmittance of rays over a raster, blocked by the ground and attenuated by the canopy.

Heights are given at pixel centres and interpolated bilinearly between them. The canopy above the
ground g is the layer from g + crown_base (s - g) to the surface s. A ray with m metres inside the
canopy transmits

    exp(-extinction m),

or nothing if it hits the ground or leaves the data. Rays are followed through the squares between
four pixel centres. Within a square, the heights along a ray are quadratic, so m is exact. Because
no point is both below the canopy and above it, the fraction of a ray inside the canopy is the
fraction above the crown base, plus the fraction below the surface, minus 1.
"""

import math

import numpy as np

from trustbo.kernels import kernel, part

_kernel = kernel(fastmath={"contract", "nsz", "arcp"})
_part = part(fastmath={"contract", "nsz", "arcp"})
BLOCK = 4
"""Side of the squares of pixels that share one value of openness."""
_GRAZING = -1e-9  # m; rays that are lower above the ground are blocked
_RAYS = 16  # directions in which openness is computed


@_part
def bilinear(heights, r, c):
    """Interpolate a height in pixel coordinates; NaN off the raster or for NaN coordinates."""
    rows, cols = heights.shape
    if not (0.0 <= r <= rows - 1 and 0.0 <= c <= cols - 1):
        return math.nan

    i = min(int(r), rows - 2)
    j = min(int(c), cols - 2)
    p = r - i
    q = c - j

    upper = heights[i, j] if q == 0.0 else (1.0 - q) * heights[i, j] + q * heights[i, j + 1]
    if p == 0.0:  # a neighbour without weight may be missing
        return upper
    lower = heights[i + 1, j]
    lower = lower if q == 0.0 else (1.0 - q) * lower + q * heights[i + 1, j + 1]
    return lower if p == 1.0 else (1.0 - p) * upper + p * lower


@_part
def _along(raster, i, j, p, q, dp, dq):
    """Compute coefficients of the height on a line in a square from (p, q) to (p + dp, q + dq)."""
    corner = raster[i, j]
    down = raster[i + 1, j] - corner
    right = raster[i, j + 1] - corner
    both = raster[i + 1, j + 1] - raster[i, j + 1] - down

    start = corner + p * down + q * right + p * q * both
    return start, dp * down + dq * right + both * (p * dq + q * dp), both * dp * dq


@_part
def _share_positive(c0, c1, c2):
    """Compute the fraction of [0, 1] in which c0 + c1 t + c2 t^2 is positive."""
    sign = 1.0 if c0 > 0.0 else -1.0
    c0 = sign * c0
    c1 = sign * c1
    c2 = sign * c2
    square = c1 * c1 - 4.0 * c2 * c0
    share = 1.0  # with the sign at 0

    if c0 + c1 + c2 < 0.0:  # one root
        # Numerically stable roots (Press et al. 2007, section 5.6).
        half = -0.5 * (c1 + math.copysign(math.sqrt(square), c1))
        share = c0 / half if c1 < 0.0 else half / c2
    elif square > 0.0 and 0.0 < -c1 < 2.0 * c2:  # two roots
        share = 1.0 - math.sqrt(square) / c2
    return share if sign > 0.0 else 1.0 - share


@_part
def _first_square(x0, dx, n):
    """Find the first of n - 1 squares along an axis, the step to the next, and the crossings.

    Crossings are given by the position of the first one and its distance from the next.
    """
    if dx > 0.0:
        square = min(int(x0), n - 2)
        return square, 1, (square + 1 - x0) / dx, 1.0 / dx

    if dx < 0.0:
        square = max(math.ceil(x0) - 1, 0)
        return square, -1, (square - x0) / dx, -1.0 / dx
    return min(int(x0), n - 2), 0, math.inf, math.inf


@_part
def transmittance(ground, surface, pixel, start, end, extinction, crown_base):
    """Compute the transmittance of a ray from `start` to `end`, each (row, col, height in m).

    The result is 0 if the ground blocks the ray, or if the ray leaves the raster or crosses missing
    data.
    """
    r0, c0, z0 = start
    r1, c1, z1 = end
    rows, cols = ground.shape

    # With `not`, NaN is rejected too: all comparisons with it are false.
    if not (r0 >= 0.0 and r1 >= 0.0 and r0 <= rows - 1 and r1 <= rows - 1):
        return 0.0
    if not (c0 >= 0.0 and c1 >= 0.0 and c0 <= cols - 1 and c1 <= cols - 1):
        return 0.0

    dr = r1 - r0
    dc = c1 - c0
    dz = z1 - z0

    i, down, next_row, rows_apart = _first_square(r0, dr, rows)
    j, right, next_col, cols_apart = _first_square(c0, dc, cols)

    inside = 0.0
    t = 0.0
    while t < 1.0:
        then = min(next_row, next_col, 1.0)
        z = z0 + t * dz
        rise = (then - t) * dz

        upper = max(surface[i, j], surface[i, j + 1])
        lower = max(surface[i + 1, j], surface[i + 1, j + 1])

        if not min(z, z + rise) > max(upper, lower):
            line = r0 + t * dr - i, c0 + t * dc - j, (then - t) * dr, (then - t) * dc
            g = _along(ground, i, j, *line)
            s = _along(surface, i, j, *line)

            # Coefficients of the ray's height above the ground.
            a0 = z - g[0]
            a1 = rise - g[1]
            a2 = -g[2]
            dip = a1 * a1 / (4.0 * a2) if a2 > 0.0 and 0.0 < -a1 < 2.0 * a2 else 0.0
            if not min(a0 - dip, a0 + a1 + a2) >= _GRAZING:
                return 0.0

            # Coefficients of the height of the canopy.
            h0 = s[0] - g[0]
            h1 = s[1] - g[1]
            h2 = s[2] - g[2]
            above = _share_positive(
                a0 - crown_base * h0, a1 - crown_base * h1, a2 - crown_base * h2
            )
            below = _share_positive(h0 - a0, h1 - a1, h2 - a2)
            inside += (then - t) * max(above + below - 1.0, 0.0)

        # Go on to the square beyond the nearer crossing (Amanatides and Woo 1987).
        if next_row <= next_col:
            i = min(max(i + down, 0), rows - 2)
            next_row = next_row + rows_apart
        else:
            j = min(max(j + right, 0), cols - 2)
            next_col = next_col + cols_apart

        t = then

    if inside == 0.0:  # also where the extinction is infinite
        return 1.0

    length = math.sqrt((dr * pixel[0]) ** 2 + (dc * pixel[1]) ** 2 + dz**2)
    return math.exp(-extinction * inside * length)


@_kernel
def transmittances(ground, surface, pixel, ends, extinction, crown_base):
    """Compute transmittances of rays (ray, 6): row, col, height of both ends; 0 if any is NaN."""
    out = np.zeros(len(ends))
    for i in range(len(ends)):
        start = ends[i, 0], ends[i, 1], ends[i, 2]
        end = ends[i, 3], ends[i, 4], ends[i, 5]
        if not (math.isnan(start[2]) or math.isnan(end[2])):
            out[i] = transmittance(ground, surface, pixel, start, end, extinction, crown_base)

    return out


@_kernel
def openness(ground, surface, pixel, reach, heights, canopy, coarse, first, last):
    """Compute the mean transmittance to 16 points on a circle of radius `reach` metres.

    The result is written to `coarse`, with one value for each square of BLOCK x BLOCK pixels, for
    the rows of squares from `first` to `last`. `heights` are those of eye and target above ground;
    `canopy` is the extinction (1/m) and the crown base. Rays that end outside the data are ignored.
    """
    middle = 0.5 * (BLOCK - 1)
    for i in range(first, last):
        for j in range(coarse.shape[1]):
            r = min(BLOCK * i + middle, ground.shape[0] - 1.0)
            c = min(BLOCK * j + middle, ground.shape[1] - 1.0)

            z = bilinear(ground, r, c)
            total = 0.0
            n = 0
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
