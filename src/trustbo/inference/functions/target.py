"""The posterior of a NumPyro function in the coordinates in which it is sampled."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from trustbo.inference.density import Outer
from trustbo.inference.functions.coordinates import Coordinates
from trustbo.inference.functions.data import Data
from trustbo.inference.functions.function import FunctionModel, in_batches, keys_of
from trustbo.inference.functions.missions import FunctionData
from trustbo.inference.functions.sites import Site
from trustbo.inference.nuts import Compiled, compiled_with, in_jax

_QUANTILES = 0.16, 0.84
"""Quantiles of the prior at -1 and 1, one standard deviation from the mean of a normal prior."""
_LEAST_SPREAD = 1e-9
"""Smallest spread of a coordinate."""


class Target:
    """Posterior of a function given data, in some coordinates.

    Attributes:
        model: The function.
        data: Its inputs.
        sites: Its variables by name.
        coordinates: The coordinates.
        integrated: The function with its missions, if it has effects, which are integrated out by
            `Density` in NumPy; None if JAX computes the whole density.
    """

    def __init__(
        self,
        model: FunctionModel,
        data: Data,
        sites: Mapping[str, Site],
        coordinates: Coordinates,
        integrated: FunctionData | None = None,
    ) -> None:
        self.model = model
        self.data = data
        self.sites = sites
        self.coordinates = coordinates
        self.integrated = integrated

    def log_density(self, x: np.ndarray) -> np.ndarray:
        """Compute the log density (point,) of points (point, coordinate)."""
        if self.integrated is None:
            return self._in_batches("log density", self.traced, x)
        return self._with_evidence(self.outer(x))

    def outer(self, x: np.ndarray) -> Outer:
        """Return what the function says at points, including the padding."""
        return self._in_batches("outer", self._outer, x)

    def traced(self, x: Any, data: Data) -> Any:
        """Compute the log density, up to a constant, at coordinates (coordinate,) in JAX."""
        if self.integrated is not None:
            return in_jax(self._outer, self._with_evidence)(x, data)

        z = self.coordinates.unconstrained(x)
        log_jacobian = self.coordinates.log_jacobian(x)
        return log_jacobian - self.model.potential(z, data, self.coordinates.deviations)

    def _outer(self, x: Any, data: Data) -> Outer:
        """Return what the function says at coordinates (coordinate,), in JAX."""
        z = self.coordinates.unconstrained(x)
        found = self.model.outer(z, data, self.coordinates.deviations)
        return found._replace(log_p=found.log_p + self.coordinates.log_jacobian(x))

    def _with_evidence(self, outer: Outer) -> np.ndarray:
        """Compute the log density (point,), with the effects integrated out."""
        known: Any = self.integrated
        return known.density.log_density(known.unpadded(outer)) + known.log_resolution

    def draw_effects(
        self, x: np.ndarray, rng: np.random.Generator
    ) -> dict[str, dict[str, np.ndarray]] | None:
        """Draw the effects of the function, if it has any, at points (draw, coordinate)."""
        if self.integrated is None:
            return None
        outer = self.integrated.unpadded(self.outer(x))
        density = self.integrated.density
        return density.columns.to_variables(density.draw_coefficients(outer, rng), outer.theta)

    def points(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Convert values (draw, ...) of the variables to coordinates (draw, coordinate)."""

        def one(values: Mapping[str, Any], data: Data) -> Any:
            free = self.model.unconstrain(values, data, self.coordinates.deviations)
            return self.coordinates.of(free)

        return self._in_batches("points", one, dict(values))

    def values(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Convert coordinates (draw, coordinate) to values (draw, ...) of the variables."""

        def one(x: Any, data: Data) -> Any:
            free = self.coordinates.unconstrained(x)
            return self.model.constrain(free, data, self.coordinates.deviations)

        return self._in_batches("values", one, x)

    def _in_batches(self, name: str, compute: Callable[..., Any], draws: Any) -> Any:
        """Compute a function of draws, whose arrays have the axis (draw,); see `in_batches`."""
        return in_batches(self.compiled((name,), compute, 1), draws)

    def compiled(
        self, key: tuple[Any, ...], compute: Callable[..., Any], n_draw_axes: int
    ) -> Callable[..., Any]:
        """Return a function of draws, compiled for these data; see `compiled_over_draws`."""
        key = *key, self.coordinates.key
        return self.model.compiled_over_draws(key, compute, n_draw_axes, self.data)

    @property
    def compiled_for_nuts(self) -> Compiled:
        """Compiles functions of chains; again for each fit if NumPy computes a part of them."""
        if self.integrated is None:
            return self.compiled
        return lambda _, compute, n: compiled_with(compute, n, self.data)

    def finite_points(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return `points`, without draws that have infinite coordinates."""
        x = self.points(values)
        return x[np.isfinite(x).all(1)]


def targets_of(
    model: FunctionModel,
    data: Data,
    sites: Mapping[str, Site],
    integrated: FunctionData | None = None,
) -> list[Target]:
    """Return the posterior in all coordinates in which it is sampled.

    If means or standard deviations of normal variables are variables, too, the first coordinates
    are deviations, and the second ones are not (centred and non-centred parametrisations;
    Papaspiliopoulos, Roberts and Skold 2007). Deviations suit few data.
    """
    scales = model.over_draws("scales", 1, data)(keys_of(2, 0))
    moving = [
        name
        for name, pair in scales.items()
        if any(not np.array_equal(one[0], one[1]) for one in pair)
    ]
    free = model.free(data)
    noises = model.noises(data)
    return [
        Target(model, data, sites, Coordinates(free, noises, deviations), integrated)
        for deviations in ((moving, ()) if moving else ((),))
    ]


class Scaled:
    """A target in coordinates in which the prior has about the mean 0 and the scale 1."""

    def __init__(self, target: Target, prior: Mapping[str, np.ndarray], bar: Any) -> None:
        """Take middle and spread from draws of the prior; `bar` counts points."""
        low, high = np.quantile(target.finite_points(prior), _QUANTILES, axis=0)
        self.target = target
        self.bar = bar
        self.middle = 0.5 * (low + high)
        self.spread = 0.5 * (high - low) + _LEAST_SPREAD
        self.log_volume = np.log(self.spread).sum()

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Compute the log density (point,) of points (point, coordinate)."""
        self.bar.update(len(z))
        return self.target.log_density(self.unscaled(z)) + self.log_volume

    def unscaled(self, z: np.ndarray) -> np.ndarray:
        """Convert points to the coordinates of the target."""
        return self.middle + self.spread * z

    def points(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Convert values (draw, ...) of the variables to points (draw, coordinate)."""
        return (self.target.points(values) - self.middle) / self.spread

    def values(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """Convert points (draw, coordinate) to values (draw, ...) of the variables."""
        return self.target.values(self.unscaled(z))
