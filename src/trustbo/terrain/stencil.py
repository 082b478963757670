"""Attributes of the 3 x 3 window around each pixel, each in one pass of compiled code.

Each kernel takes heights `z`, padded by one pixel all around, (row + 2, col + 2), and fills `out`,
(row, col). Arithmetic is in the precision of the heights: it starts from differences of
neighbours, which are exact in float32 too. A missing height makes all its windows missing.
"""

import numpy as np
from numba import njit

from trustbo.parallel import PART

# Flags for vectorisation, without "nnan", which lets the compiler drop NaN; a division that checks
# for 0 would not vectorise.
_compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "arcp"})
_part = njit(nogil=True, error_model="numpy", fastmath={"contract", "nsz", "arcp"}, **PART)


@_part
def _rises(up, mid, down, j):
    """Horn's (1981) eastward and southward rise over 8 pixels."""
    a, b = mid[j + 2] - mid[j], down[j + 1] - up[j + 1]
    x = (up[j + 2] - up[j]) + (a + a) + (down[j + 2] - down[j])
    y = (down[j] - up[j]) + (b + b) + (down[j + 2] - up[j + 2])
    return x, y


@_compiled
def gradient(z, pixel, out):
    """Rise to the east and to the north per metre, `out` being (2, row, col)."""
    for i in range(out.shape[1]):
        for j in range(out.shape[2]):
            x, y = _rises(z[i], z[i + 1], z[i + 2], j)
            out[0, i, j], out[1, i, j] = 0.125 * x / pixel[1], -0.125 * y / pixel[0]


@_compiled
def slope(z, pixel, out):
    """Slope of the ground, rad, by Horn's (1981) 3 x 3 stencil."""
    one, kx, ky = _as(z, 1.0), _as(z, 0.125 / pixel[1]), _as(z, 0.125 / pixel[0])
    # Cephes' arctangent, without branches, error 2e-8 rad: `hypot` and `atan` do not vectorise,
    # and would take most of the time.
    low, high = _as(z, 0.414213562373095), _as(z, 2.414213562373095)
    quarter, half = _as(z, 0.785398163397448), _as(z, 1.5707963267948966)
    c9, c7 = _as(z, 8.05374449538e-2), _as(z, -0.138776856032)
    c5, c3 = _as(z, 0.199777106478), _as(z, -0.333329491539)
    for i in range(out.shape[0]):
        up, mid, down = z[i], z[i + 1], z[i + 2]
        for j in range(out.shape[1]):
            x, y = _rises(up, mid, down, j)
            x *= kx
            y *= ky
            t = np.sqrt(x * x + y * y)
            numerator = -one if t > high else (t - one if t > low else t)
            denominator = t if t > high else (t + one if t > low else one)
            shift = half if t > high else (quarter if t > low else t - t)
            u = numerator / denominator
            s = u * u
            u += (((c9 * s + c7) * s + c5) * s + c3) * s * u
            out[i, j] = shift + u + (mid[j + 1] - mid[j + 1])


@_compiled
def aspect(z, pixel, out):
    """Direction of the steepest descent, rad clockwise from grid north, [0, 2 pi); NaN where flat.

    An angle: take a function of it, such as its cosine, for a composite.
    """
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            x, y = _rises(z[i], z[i + 1], z[i + 2], j)
            if x == 0.0 and y == 0.0:
                out[i, j] = np.nan
            else:
                angle = np.arctan2(-x / pixel[1], y / pixel[0]) % (2.0 * np.pi)
                out[i, j] = angle + (z[i + 1, j + 1] - z[i + 1, j + 1])


@_compiled
def curvature(z, pixel, out):
    """Minus the Laplacian of the ground, 1/m: positive on ridges, negative in hollows."""
    kx, ky = _as(z, pixel[1] ** -2.0), _as(z, pixel[0] ** -2.0)
    for i in range(out.shape[0]):
        up, mid, down = z[i], z[i + 1], z[i + 2]
        for j in range(out.shape[1]):
            here = mid[j + 1]
            across = (here - mid[j]) + (here - mid[j + 2])
            along = (here - up[j + 1]) + (here - down[j + 1])
            out[i, j] = across * kx + along * ky


@_compiled
def tri(z, pixel, out):
    """Terrain ruggedness index, m: root sum of squared steps to the 8 neighbours (Riley 1999)."""
    for i in range(out.shape[0]):
        up, mid, down = z[i], z[i + 1], z[i + 2]
        for j in range(out.shape[1]):
            here = mid[j + 1]
            a, b, c = up[j] - here, up[j + 1] - here, up[j + 2] - here
            d, e = mid[j] - here, mid[j + 2] - here
            f, g, h = down[j] - here, down[j + 1] - here, down[j + 2] - here
            squares = (a * a + b * b + c * c) + (d * d + e * e) + (f * f + g * g + h * h)
            out[i, j] = np.sqrt(squares)


@_compiled
def tpi(z, pixel, out):
    """Topographic position index, m: height above the mean of 8 neighbours (Wilson et al. 2007)."""
    eighth = _as(z, 0.125)
    for i in range(out.shape[0]):
        up, mid, down = z[i], z[i + 1], z[i + 2]
        for j in range(out.shape[1]):
            here = mid[j + 1]
            above = (here - up[j]) + (here - up[j + 1]) + (here - up[j + 2])
            below = (here - down[j]) + (here - down[j + 1]) + (here - down[j + 2])
            out[i, j] = (above + below + (here - mid[j]) + (here - mid[j + 2])) * eighth


@_compiled
def roughness(z, pixel, out):
    """Highest minus lowest ground in the 3 x 3 window, m (GDAL's; Wilson et al. 2007)."""
    for i in range(out.shape[0]):
        up, mid, down = z[i], z[i + 1], z[i + 2]
        for j in range(out.shape[1]):
            top, bottom = _extremes(up, mid, down, j)
            out[i, j] = (top - bottom) + _missing(up, mid, down, j)


@_compiled
def step_height(z, pixel, out):
    """Largest step up or down to one of the 8 neighbours, m; here a missing one is no step."""
    for i in range(out.shape[0]):
        up, mid, down = z[i], z[i + 1], z[i + 2]
        for j in range(out.shape[1]):
            here = mid[j + 1]
            top, bottom = _extremes(up, mid, down, j)
            out[i, j] = max(top - here, here - bottom)


@_part
def _extremes(up, mid, down, j):
    """Highest and lowest height there is; the centre first, as comparisons with NaN are false."""
    here = mid[j + 1]
    top, bottom = _wider(here, here, up[j])
    top, bottom = _wider(top, bottom, up[j + 1])
    top, bottom = _wider(top, bottom, up[j + 2])
    top, bottom = _wider(top, bottom, mid[j])
    top, bottom = _wider(top, bottom, mid[j + 2])
    top, bottom = _wider(top, bottom, down[j])
    top, bottom = _wider(top, bottom, down[j + 1])
    return _wider(top, bottom, down[j + 2])


@_part
def _wider(top, bottom, v):
    return (v if v > top else top), (v if v < bottom else bottom)


@_compiled
def _missing(up, mid, down, j):
    """0, or NaN where a height of the window is missing."""
    a, b, c = up[j] + up[j + 1] + up[j + 2], mid[j] + mid[j + 2], down[j] + down[j + 1]
    s = a + b + c + down[j + 2]
    return s - s


@_part
def _as(z, number):
    """Number in the precision of the heights: a float64 among float32 would halve the speed."""
    return np.array([number]).astype(z.dtype)[0]
