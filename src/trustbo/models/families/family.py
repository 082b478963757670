"""The protocol of a family of observations: rates given a signal, and a signal given rates.

A signal f is trust plus noise shared between rates. To add a family, write a subclass of `Family`
and list it in `families/__init__`; `moments` has functions for its methods.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.random import Generator

Array = Any
"""An array of NumPy; in `log_prob` also of JAX."""
Moments = Any
"""Log mass, mean and variance, each an array."""
Drawn = tuple[Array, Array]
"""Draws of the signal, and their log weights."""


@dataclass(frozen=True)
class Family(ABC):
    """A family of observations.

    Arguments of all methods are arrays that broadcast: rates y, their numbers of ticks N, and sd,
    the observation noise delta_v. `_match` and `_draw` receive measured rates of equal shape.
    """

    name: ClassVar[str]
    """Name of the family in arguments."""
    gaussian: ClassVar[bool] = False
    """Whether rates are the signal plus normal noise, which allows exact integration."""
    needs_ticks: ClassVar[bool] = False
    """Whether each measured rate needs its number of ticks."""
    adds_noise: ClassVar[bool] = True
    """Whether a rate is the signal plus noise of sd delta_v, to which the resolution of its ticks
    adds, and which may be correlated between robots."""
    expected_rate: ClassVar[str] = "identity"
    """Form of `mean_rate` in compiled planning: `"identity"` (trust itself), `"logistic"`, or
    `"clipped"` (of a normal with sd delta_v, cut to [0, 1])."""
    line_of_sight: ClassVar[tuple[float, float]] = 1.0, 0.0
    """Slope and zero of the map from line of sight to trust: trust = slope (sight - zero)."""

    @abstractmethod
    def sample(self, trust: Array, sd: Array, N: Array, rng: Generator) -> Array:
        """Draw rates given the signal."""

    @abstractmethod
    def log_prob(self, y: Array, N: Array, trust: Array, sd: Array) -> Array:
        """Compute the log density or probability of measured rates given the signal."""

    @abstractmethod
    def _match(self, y: Array, N: Array, m: Array, v: Array, sd: Array) -> Moments:
        """Compute log mass, mean and variance of N(f; m, v) times the term of a rate."""

    @abstractmethod
    def _draw(self, y: Array, N: Array, m: Array, v: Array, sd: Array, rng: Generator) -> Drawn:
        """Draw the signal from N(f; m, v) times the term of a rate; returns its log weight too.

        The mean weight is the mass; weights are constant if the draw is exact.
        """

    def mean_rate(self, trust: Array, sd: Array) -> Array:
        """Compute the mean of a rate given trust, for planning."""
        return trust

    def is_density(self, y: Array) -> Array:
        """Return a mask of the rates with a density, being the signal plus normal noise."""
        return np.zeros(y.shape, dtype=bool)

    def priors(self) -> dict[str, Any]:
        """Return the default priors that differ from those of `Priors()`, by name."""
        return {}

    def match(self, y: Array, N: Array, m: Array, v: Array, sd: Array) -> Moments:
        """Compute moments of N(f; m, v) times the term of a rate; 0, m and v where y is NaN."""
        seen, arrays = _measured(y, N, m, v, sd)
        one, mean, var = self._match(*arrays)
        return np.where(seen, one, 0.0), np.where(seen, mean, m), np.where(seen, var, v)

    def draw(self, y: Array, N: Array, m: Array, v: Array, sd: Array, rng: Generator) -> Drawn:
        """Draw signals given measured rates, see `_draw`; arbitrary where y is NaN."""
        _, (y, N, m, v, sd) = _measured(y, N, m, v, sd)
        return self._draw(y, N, m, v, sd, rng)

    def log_resolution(self, y: Array, N: Array) -> Array:
        """Compute the log ratio of a count's probability to the density of its rate.

        One tick has width 1/N. The result has the shape of `y`, and is 0 where not measured or
        where the rate itself has a probability, NaN where the number of ticks is unknown.
        """
        is_density = ~np.isnan(y) & self.is_density(y)
        return np.where(is_density, -np.log(np.where(is_density, N, 1.0)), 0.0)


def _measured(y: Array, N: Array, *others: Array) -> tuple[Array, list[Array]]:
    """Return a mask of the measured rates, and arrays with placeholders for other rates."""
    y, N, *others = np.broadcast_arrays(y, N, *others)  # pyright: ignore[reportAssignmentType]
    seen = ~np.isnan(y)
    return seen, [np.where(seen, y, 0.5), np.where(N > 0.0, N, 1.0), *others]
