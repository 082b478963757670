"""Base class of observation families: rates given linear predictors, and the reverse.

The linear predictor f is trust plus noise shared between rates. To add a family, start from
`censored` (moments in closed form) or `beta_binomial` (moments by quadrature), and add it to
`families.FAMILIES`.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.random import Generator

Array = Any
"""A NumPy array; `log_prob` also accepts JAX arrays."""
Moments = Any
"""Arrays of the log mass, the mean and the variance."""
Drawn = tuple[Array, Array]
"""Draws of the linear predictor, and their log weights."""
Near = tuple[Array, Array] | None
"""Mean and variance of a normal distribution near that of the draws, if known."""


@dataclass(frozen=True)
class Family(ABC):
    """Base class of observation families.

    All methods take arrays that broadcast: rates y, tick counts N, and the noise sd (delta_v). In
    `_match` and `_draw`, no rate is NaN and all arrays have the same shape.
    """

    name: ClassVar[str]
    """Name of the family, as given in the argument `family`."""
    gaussian: ClassVar[bool] = False
    """Whether rates are the linear predictor plus normal noise, which allows exact integration."""
    needs_ticks: ClassVar[bool] = False
    """Whether every measured rate needs a tick count."""
    adds_noise: ClassVar[bool] = True
    """Whether a rate is the linear predictor plus noise with sd delta_v. In that case, the tick
    resolution adds to this noise, which may be correlated between robots."""
    expected_rate: ClassVar[str] = "identity"
    """Form of `mean_rate` in compiled planning: `"identity"` (trust itself), `"logistic"`, or
    `"clipped"` (a normal variable with sd delta_v, clipped to [0, 1])."""
    line_of_sight: ClassVar[tuple[float, float]] = 1.0, 0.0
    """Slope and zero in trust = slope (sight - zero), which converts line of sight to trust."""

    @abstractmethod
    def sample(self, trust: Array, sd: Array, N: Array, rng: Generator) -> Array:
        """Draw rates given the linear predictor."""

    @abstractmethod
    def log_prob(self, y: Array, N: Array, trust: Array, sd: Array) -> Array:
        """Compute the log density or probability of measured rates given the linear predictor."""

    @abstractmethod
    def _match(self, y: Array, N: Array, m: Array, v: Array, sd: Array) -> Moments:
        """Compute log mass, mean and variance of N(f; m, v) times the likelihood of a rate."""

    @abstractmethod
    def _draw(
        self, y: Array, N: Array, m: Array, v: Array, sd: Array, rng: Generator, near: Near
    ) -> Drawn:
        """Draw f from N(f; m, v) times the likelihood of a rate; return f and a log weight.

        The mean weight is the mass of the product. If draws are exact, the weights are constant.
        """

    def mean_rate(self, trust: Array, sd: Array) -> Array:
        """Compute the mean rate given trust, for planning."""
        return trust

    def is_density(self, y: Array) -> Array:
        """Return a mask of the rates whose likelihood is a density, not a probability."""
        return np.zeros(y.shape, dtype=bool)

    def priors(self) -> dict[str, Any]:
        """Return the default priors that differ from those of `Priors()`, by name."""
        return {}

    def moment_match(self, y: Array, N: Array, m: Array, v: Array, sd: Array) -> Moments:
        """Compute the moments as in `_match`; where y is NaN, they are 0, m and v."""
        seen, arrays = _measured(y, N, m, v, sd)
        one, mean, var = self._match(*arrays)
        return np.where(seen, one, 0.0), np.where(seen, mean, m), np.where(seen, var, v)

    def draw(
        self,
        y: Array,
        N: Array,
        m: Array,
        v: Array,
        sd: Array,
        rng: Generator,
        near: Near = None,
    ) -> Drawn:
        """Draw predictors given rates as in `_draw`; the draws are arbitrary where y is NaN."""
        _, (y, N, m, v, sd) = _measured(y, N, m, v, sd)
        return self._draw(y, N, m, v, sd, rng, near)

    def log_resolution(self, y: Array, N: Array) -> Array:
        """Compute the log ratio of a tick count's probability to the density of its rate.

        One tick has the width 1/N. The result, in the shape of `y`, is 0 for unmeasured rates and
        for rates with a probability, and NaN where the tick count is unknown.
        """
        is_density = ~np.isnan(y) & self.is_density(y)
        return np.where(is_density, -np.log(np.where(is_density, N, 1.0)), 0.0)


def _measured(y: Array, N: Array, *others: Array) -> tuple[Array, list[Array]]:
    """Return a mask of the measured rates, and the arrays with placeholders elsewhere."""
    y, N, *others = np.broadcast_arrays(y, N, *others)  # pyright: ignore[reportAssignmentType]
    seen = ~np.isnan(y)
    return seen, [np.where(seen, y, 0.5), np.where(N > 0.0, N, 1.0), *others]
