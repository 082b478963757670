"""Draws of a NumPyro function, from which its trust and predictions follow."""

from collections.abc import Callable, Mapping
from typing import Any, Self

import numpy as np
import xarray as xr

from trustbo.arrays import evenly_spaced
from trustbo.inference.density import Outer, at
from trustbo.inference.functions.function import BATCH, keys_of
from trustbo.inference.functions.missions import FunctionData
from trustbo.inference.functions.sites import safe
from trustbo.inference.latent import N_PRIOR, N_TRAJECTORIES, Given, Source
from trustbo.inference.stored import values_of
from trustbo.models.effects.effect import Theta

OF_PRIOR = 2
"""Offset of the seed of the draws in the group `prior`."""
_LEAST_NOISE = 1e-6
"""Smallest standard deviation of a rate's own noise with which trust is drawn."""


class OfFunction(Source):
    """Draws of a function, with missions."""

    size = BATCH

    def __init__(
        self,
        known: FunctionData,
        values: Mapping[str, np.ndarray],
        keys: Any,
        coefficients: Callable[[np.ndarray, Theta], np.ndarray],
    ) -> None:
        """See `Source`.

        Args:
            known: The function with the missions.
            values: Draws (draw, ...) of its variables.
            keys: Random key of each draw, for variables that are not among the values.
            coefficients: Returns the coefficients of the effects at some draws, by index, given
                their hyperparameters.
        """
        super().__init__(known.density, len(keys))
        self.known = known
        self._values = values
        self._keys = keys
        self._coefficients = coefficients
        if not known.has_ticks:
            self.shift = np.full(len(self.shift), np.nan)

    @classmethod
    def stored(cls, known: FunctionData, posterior: xr.DataTree) -> Self:
        """Read all draws of a posterior."""
        columns = known.density.columns
        groups = {effect.group: values_of(posterior, effect) for effect in columns.effects}

        def coefficients(some: np.ndarray, theta: Theta) -> np.ndarray:
            return columns.coefficients({g: at(v, some) for g, v in groups.items()}, theta)

        values = known.stored(posterior, "posterior")
        keys = keys_of(len(next(iter(values.values()))), posterior.attrs["seed"])
        return cls(known, values, keys, coefficients)

    def outer(self, some: np.ndarray) -> tuple[Outer, np.ndarray]:
        """See `Source.outer`."""
        found = self.known.run("evaluate", at(self._values, some), self._keys[some])
        outer = self.known.unpadded(found)
        space = outer.space
        space = space._replace(noise_sd=np.maximum(space.noise_sd, _LEAST_NOISE))
        c = np.zeros((len(some), 0))
        if self.density.columns.effects:
            c = self._coefficients(some, outer.theta)
        return outer._replace(space=space), c

    def log_prior(self, given: Given) -> dict[str, np.ndarray]:
        """See `Source.log_prior`; densities are summed over the elements of a variable."""
        found = {}
        for name, values in given.outer.log_prior.items():
            own = self.known.without_padding(values, self.known.sites[name])
            found[safe(name)] = own.reshape(len(own), -1).sum(1)
        return found

    def prior(self, posterior: xr.DataTree, rng: np.random.Generator) -> "OfFunction":
        """See `Source.prior`."""
        known = self.known
        seed = posterior.attrs["seed"] + OF_PRIOR
        if "prior" in posterior.children:
            values = known.stored(posterior, "prior")
        else:  # the user has dropped it
            values = known.run("prior", keys_of(N_PRIOR, seed))

        n_draws = len(next(iter(values.values())))
        some = at(values, evenly_spaced(n_draws, N_TRAJECTORIES))
        columns = known.density.columns
        keys = keys_of(min(n_draws, N_TRAJECTORIES), seed)
        return OfFunction(known, some, keys, lambda _, theta: columns.prior(theta).draw(rng))
