"""Prior on the probability that a bound fails, as a function of normal scores."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy import special
from scipy.interpolate import PchipInterpolator

from trustbo.errors import TrustboError, require_choice, require_positive, require_tuple
from trustbo.kernels import kernel
from trustbo.parallel import plain
from trustbo.workspace.difficulty import TILT

_compiled = kernel()

REFERENCE = 0.5
"""Difficulty at which the intercept is the logit of the prior mean."""
LIMIT_NAMES = ("margin", "width")
"""Parameters of the robots' slope limit, in degrees."""
FLOOR = 1e-12
"""Smallest alpha and beta of a Beta prior, because the prior mean may round to 0 or 1."""
_LARGEST_LOG = 50.0
"""Largest absolute value of the log width and the log strength."""
_FAR_BELOW = -80.0
"""Number of widths below the slope limit, negative, at which it stops no robot: 1e-35."""
_NOTICED = 1e-18
"""Failure probability that such a limit does not change, because of rounding."""
_FARTHEST = 40.0
"""Largest tabulated quantile of the margin, in sds of the wider normal."""
_N_TABULATED = 4000
"""Number of tabulated quantiles of the margin."""
LIMITS = {
    "measured": (0.0, 3.0),
    "data sheet": (0.4, 3.0),
    "guessed": (0.7, 4.0),
}
"""Probability that a stated slope limit is wrong, and the sd of its error in that case, degrees.

That of a data sheet is calibrated by the first plans of `benchmarks/arrivals.py`.
"""


@dataclass(frozen=True)
class Hazard:
    """Priors on the probability that a bound ends the mission; normal priors are (mean, sd) pairs.

    By default, the stated slope limit has an error with an sd of half a degree with probability .6,
    and with an sd of 3 degrees with probability .4.

    Attributes:
        intercept: Prior on the logit of the mean failure probability at medium difficulty.
        coefficient: Prior on the weight of each difficulty measure. Difficulty is 0 for an easy
            route and 1 at the robots' limit. The tilt of a bound is not a difficulty measure, so it
            has no weight; it is compared with the slope limit instead (`margin`, `log_width`).
        margin: Prior on the number of degrees by which the true slope limit is below the stated
            limit, if the stated limit is approximately correct. All bounds share the margin, so a
            failure on one bound makes failures on equally steep bounds more probable.
        limit: How the slope limit of the team is known: `"measured"` on the robots, from a
            `"data sheet"`, or `"guessed"`. Or the probability that it is wrong and the sd of the
            margin in that case, in degrees; `LIMITS` has those of the words. The prior on the
            margin is a mixture of two normals with the same mean.
        log_width: Prior on the log of the limit's width in degrees, .14 by default. If the tilt
            increases by 4.4 widths, the failure probability increases from .1 to .9. Use a larger
            width if the tilt along the driven curve is less well known.
        log_strength: Prior on the log of the strength s, the number of observations that the prior
            mean of a bound is worth. If every bound fails either always or never, s is small.

    Raises:
        TrustboError: If an sd is not positive, or if the probability in `limit` is outside [0, 1),
            or if `limit` is an unknown word.

    Example:
        >>> measured = tb.hazard.Hazard(limit="measured")
        >>> campaign = tb.Campaign(workspace, (9, 0), (0, 9), hazard=measured)
    """

    intercept: tuple[float, float] = (-7.5, 1.5)
    coefficient: tuple[float, float] = (2.0, 2.0)
    margin: tuple[float, float] = (0.0, 0.5)
    limit: str | tuple[float, float] = "data sheet"
    log_width: tuple[float, float] = (-2.0, 0.5)
    log_strength: tuple[float, float] = (-0.5, 1.0)

    def __post_init__(self) -> None:
        for name in ("intercept", "coefficient", "margin", "log_width", "log_strength"):
            mean, sd = require_tuple(f"Hazard.{name}", getattr(self, name), 2)
            object.__setattr__(self, name, (mean, require_positive(f"sd of {name}", sd)))

        if isinstance(self.limit, str):
            require_choice("Hazard.limit", self.limit, LIMITS)
        else:
            share, sd = require_tuple("Hazard.limit", self.limit, 2)
            share = require_positive("the probability of a wrong limit", share, or_zero=True)
            if share >= 1.0:
                raise TrustboError(
                    f"the probability of a wrong limit must be in [0, 1); got {share!r}."
                )
            sd = require_positive("sd of a wrong limit", sd)
            object.__setattr__(self, "limit", (share, sd))

    @property
    def doubt(self) -> tuple[float, float]:
        """Probability that the stated slope limit is wrong, and the sd in that case, degrees."""
        return LIMITS[self.limit] if isinstance(self.limit, str) else self.limit

    def of_bounds(
        self, difficulty: np.ndarray, measures: Sequence[str], max_slope: float
    ) -> "BoundPrior":
        """Make the prior for bounds with difficulty (bound, measure) and a slope limit in rad."""
        weighted = [m for m, name in enumerate(measures) if name != TILT]
        normals = [self.intercept] + [self.coefficient] * len(weighted)
        steepness = None

        if TILT in measures:
            normals += [self.margin, self.log_width]
            steepness = steepness_of(difficulty[:, list(measures).index(TILT)], max_slope)

        center, scale = np.array([*normals, self.log_strength]).T
        return BoundPrior(center, scale, difficulty[:, weighted] - REFERENCE, steepness, self.doubt)


class BoundPrior(NamedTuple):
    """Beta priors on the failure probabilities of bounds, as functions of normal scores z.

    Each parameter is center + scale z, with two exceptions: the width and the strength are
    exp(center + scale z), and the margin is the quantile of its mixture prior at probability
    Phi(z).
    """

    center: np.ndarray  # (parameter,)
    scale: np.ndarray  # (parameter,)
    difficulty: np.ndarray  # (bound, measure), minus REFERENCE
    steepness: np.ndarray | None  # (bound,), degrees beyond the stated limit; None without a limit
    doubt: tuple[float, float]

    def values(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute the parameters at normal scores (point, parameter).

        Returns:
            Intercept and coefficients (point, 1 + measure), margin and width (point, 2), and
            strength (point,). Without a slope limit, the second array has shape (point, 0).
        """
        values = self.center + self.scale * z
        n = 1 + self.difficulty.shape[1]

        if self.steepness is not None and self.doubt[0] > 0.0:
            off = mixture_quantile(z[:, n], float(self.scale[n]), *self.doubt)
            values[:, n] = self.center[n] + off
        first_log = n if self.steepness is None else n + 1  # the margin is not a log
        logs = np.clip(values[:, first_log:], -_LARGEST_LOG, _LARGEST_LOG)
        values[:, first_log:] = np.exp(logs)

        return values[:, :n], values[:, n:-1], values[:, -1]

    def betas(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute alpha and beta, each (point, bound), at normal scores (point, parameter)."""
        return prior_betas(*self.values(z), self.difficulty, self.steepness)


def prior_betas(
    weights: np.ndarray,
    limit: np.ndarray,
    strength: np.ndarray,
    difficulty: np.ndarray,
    steepness: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute alpha and beta of the Beta prior on each bound, both (point, bound).

    A bound is passed if neither its difficulty nor the slope limit stops the robots. Therefore,
    1 - m is the product of sigma(-logit) and sigma(-(steepness + margin) / width).
    """
    logit = weights[:, :1] + weights[:, 1:] @ difficulty.T
    if steepness is None:
        steepness = np.full(len(difficulty), -np.inf)  # never too steep
        limit = np.ones((len(logit), 2))
    return _betas(logit, plain(steepness), plain(limit), plain(strength))


@_compiled
def _betas(logit, steepness, limit, strength):
    """Compute the result of `prior_betas` from the logits (point, bound)."""
    a = np.empty(logit.shape)
    b = np.empty(logit.shape)
    for i in range(len(logit)):
        for j in range(len(steepness)):
            fails = 1.0 / (1.0 + math.exp(-logit[i, j]))
            passes = 1.0 - fails  # rounds to 0 below 1e-16, where FLOOR applies anyway

            beyond = (steepness[j] + limit[i, 0]) / limit[i, 1]
            if not (beyond < _FAR_BELOW and fails > _NOTICED):  # else the limit changes no digit
                of_limit = 1.0 / (1.0 + math.exp(-beyond))
                fails += passes * of_limit
                passes *= 1.0 - of_limit

            a[i, j] = fails * strength[i] + FLOOR
            b[i, j] = passes * strength[i] + FLOOR
    return a, b


def steepness_of(tilt: np.ndarray, max_slope: float) -> np.ndarray:
    """Convert tilt = tan(slope) / tan(max_slope) to degrees beyond the limit max_slope (rad)."""
    return np.rad2deg(np.arctan(tilt * np.tan(max_slope)) - max_slope)


@np.errstate(under="ignore")  # small weights and tails round to 0
def mixture_quantile(z: np.ndarray, narrow: float, share: float, wide: float) -> np.ndarray:
    """Solve Phi(z) = (1 - share) Phi(x / narrow) + share Phi(x / wide) for x.

    The interpolation error is about 1e-5 times `narrow`. In the far tails, the slope is the larger
    sd.
    """
    curve = _quantile_curve(float(narrow), share, wide)
    end = curve.x[-1]
    within = np.clip(z, -end, end)
    return np.sign(z) * curve(np.abs(within)) + max(narrow, wide) * (z - within)


@cache
def _quantile_curve(narrow: float, share: float, wide: float) -> PchipInterpolator:
    """Tabulate the quantile function for z >= 0; the mixture is symmetric."""
    largest = _FARTHEST * max(narrow, wide)
    x = narrow * np.sinh(np.linspace(0.0, np.arcsinh(largest / narrow), _N_TABULATED))

    # Use the logs of the upper tails, because 1 - F rounds to 0 beyond 38 sds.
    log_narrow = np.log1p(-share) + special.log_ndtr(-x / narrow)
    log_wide = np.log(share) + special.log_ndtr(-x / wide)

    z = -special.ndtri_exp(np.logaddexp(log_narrow, log_wide))
    z[0] = 0.0
    return PchipInterpolator(z, x)
