"""Mixture of two normals as a function of a standard-normal coordinate.

A prior (1 - share) N(0, narrow^2) + share N(0, wide^2) becomes that of x(z) with z ~ N(0, 1) and

    x(z) = F^-1(Phi(z)),    F(x) = (1 - share) Phi(x / narrow) + share Phi(x / wide),

which rises in z: samplers keep their standard-normal coordinates for any prior.
"""

from functools import cache

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.special import log_ndtr, ndtri_exp

_KNOTS = 2000
_TAIL = 40.0  # of the wide normal's sd; beyond, x(z) is taken for linear


def mixture_quantile(z: np.ndarray, narrow: float, share: float, wide: float) -> np.ndarray:
    """Quantile x(z) of the mixture with mean 0, of any shape; see the head of this file.

    Between knots x(z) is a cubic with the exact slopes dx/dz = phi(z) / F'(x), right to 1e-6 of
    `narrow`. In the tails it is linear with the sd of the wider normal for its slope.
    """
    curve = _curve(narrow, share, wide)
    end, slope = curve.x[-1], max(narrow, wide)
    within = np.clip(z, -end, end)
    return np.sign(z) * curve(np.abs(within)) + slope * (z - within)


@cache
def _curve(narrow: float, share: float, wide: float) -> CubicHermiteSpline:
    """Cubic x(z) for z >= 0: the mixture is symmetric."""
    largest = _TAIL * max(narrow, wide)
    # Knots dense around the narrow normal and ever wider apart in the tail.
    x = narrow * np.sinh(np.linspace(0.0, np.arcsinh(largest / narrow), _KNOTS))
    logs = np.log1p(-share), np.log(share)
    # Upper tails, by logs: 1 - F rounds to 0 from 38 sd on.
    z = -ndtri_exp(np.logaddexp(logs[0] + log_ndtr(-x / narrow), logs[1] + log_ndtr(-x / wide)))
    z[0] = 0.0
    densities = (
        log_share - 0.5 * (x / sd) ** 2 - np.log(sd)
        for log_share, sd in zip(logs, (narrow, wide), strict=True)
    )
    slope = np.exp(-0.5 * z**2 - np.logaddexp(*densities))
    return CubicHermiteSpline(z, x, slope)
