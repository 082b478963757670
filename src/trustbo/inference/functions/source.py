"""A function with missions, and the trust and predictions of its draws."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Self

import numpy as np
import xarray as xr

from trustbo.arrays import evenly_spaced, joined_draws
from trustbo.data import Mission
from trustbo.inference.density import at, chunks
from trustbo.inference.functions.data import RATES, arrays_of, data_of
from trustbo.inference.functions.effects import AddedEffects, layout_of
from trustbo.inference.functions.function import EFFECTS, Found, FunctionModel
from trustbo.inference.functions.sampling import keys_of
from trustbo.inference.functions.sites import Site, safe
from trustbo.inference.latent import N_PRIOR, N_TRAJECTORIES, Given, Source, draw_exactly
from trustbo.inference.stored import values_of
from trustbo.models.effects.effect import Theta
from trustbo.models.families import FAMILIES
from trustbo.models.observations import Observations
from trustbo.statespace import Inputs
from trustbo.statespace.blocks import LinearPredictor
from trustbo.workspace import Workspace

OF_PRIOR = 2
"""Offset of the seed of the draws in the group `prior`."""
_SIZE = 100
"""Number of draws evaluated at once."""
_LEAST_NOISE = 1e-6
"""Smallest standard deviation of a rate's own noise with which trust is drawn."""


class FunctionData:
    """A function with missions.

    Attributes:
        model: The function.
        observations: Rates and awareness of the missions, with the data that the effects need.
        data: Inputs of the function, padded.
        sites: Variables of the function by name.
        resolution: Resolution of rates that the function adds to its noise, or 0.
        effects: Effects that the function adds to the drift; there may be none.
    """

    def __init__(
        self,
        model: FunctionModel,
        missions: Sequence[Mission],
        workspace: Workspace | None = None,
    ) -> None:
        """Trace the function, without computing anything."""
        observations = Observations.from_missions(missions)
        data = data_of(missions, observations, moves="bound" in model.inputs)
        if model.needs_observations:  # data that it takes as a single object are not padded
            n_missions, n_bounds = observations.contact_rate.shape[:2]
            data |= {name: v[:n_missions, :n_bounds] for name, v in arrays_of(data).items()}
            data["observations"] = observations

        self.model = model
        self.data = data
        self.sites = model.sites(data)
        rates = model.rates(data)
        self.resolution = observations.resolution if rates.adds_resolution else 0.0
        self.effects = AddedEffects(
            rates.effects,
            observations,
            missions,
            workspace,
            of_counts=self.resolution > 0.0,
        )
        self.observations = self.effects.observations

    def run(self, method: str, *draws: Any) -> Any:
        """Run a method of the function for draws; see `FunctionModel.over_draws`."""
        return self.model.over_draws(method, len(draws), self.data)(*draws)

    def without_padding(self, values: np.ndarray, site: Site) -> np.ndarray:
        """Drop the missions of the padding from values (draw, ...) of a site."""
        if site.mission_axis is None:
            return values
        return values.take(range(self.observations.n_missions), axis=1 + site.mission_axis)

    def stored(self, posterior: xr.DataTree, group: str) -> dict[str, np.ndarray]:
        """Return draws (draw, ...) of the variables; values are arbitrary for padded missions."""
        draws = posterior[group].to_dataset()
        axes = json.loads(posterior["posterior"].attrs.get("dims", "{}"))
        values = {}
        for name, site in self.sites.items():
            array = joined_draws(draws[safe(name)], axes.get(safe(name), (...,)))
            if site.mission_axis is not None:
                axis = 1 + site.mission_axis
                n_missing = site.shape[site.mission_axis] - array.shape[axis]
                last = array.take([-1] * n_missing, axis=axis)
                array = np.concatenate([array, last], axis=axis)
            values[name] = array
        return values

    def with_effects(
        self,
        values: Mapping[str, np.ndarray],
        keys: Any,
        coefficients: Callable[[Theta], np.ndarray],
    ) -> dict[str, np.ndarray]:
        """Return values (draw, ...) with the sum of the effects on the drift, if there are any.

        `coefficients` returns those of the effects, given the hyperparameters of the draws.
        """
        if not self.effects.effects:
            return dict(values)

        c = coefficients(self.run("theta", values, keys))
        drift = (self.effects.U @ c.T).T.reshape(len(c), *self.observations.contact_rate.shape)
        shape = len(c), *self.data[RATES].shape
        missing = [(0, n - own) for n, own in zip(shape, drift.shape, strict=True)]
        return {**values, EFFECTS: np.pad(drift, missing)}


class OfFunction(Source):
    """Draws of a function, with missions."""

    def __init__(self, known: FunctionData, values: Mapping[str, np.ndarray], keys: Any) -> None:
        """Arrange the rates in blocks.

        Args:
            known: The function with the missions.
            values: Draws (draw, ...) of its variables, and of the sum of its effects.
            keys: Random key of each draw, for variables that are not among the values.
        """
        rates = known.model.rates(known.data)
        layout = layout_of(rates.space, known.observations.contact_rate)
        super().__init__(len(keys), known.observations, FAMILIES["gaussian"], *layout)
        self.known = known
        self._values = values
        self._keys = keys
        if rates.n_ticks is None:
            self.shift = np.full(len(self.shift), np.nan)

    @classmethod
    def stored(cls, known: FunctionData, posterior: xr.DataTree) -> Self:
        """Read all draws of a posterior."""
        effects = known.effects
        groups = {effect.group: values_of(posterior, effect) for effect in effects.effects}
        values = known.stored(posterior, "posterior")
        keys = keys_of(len(next(iter(values.values()))), posterior.attrs["seed"])
        whole = known.with_effects(values, keys, lambda t: effects.coefficients(groups, t))
        return cls(known, whole, keys)

    def given(self, some: np.ndarray) -> Iterator[Given]:
        """See `Source.given`."""
        n_missions, n_bounds, n_robots = self.observations.contact_rate.shape
        for start in range(0, len(some), _SIZE):
            index = some[start : start + _SIZE]
            found: Found = self.known.run("evaluate", at(self._values, index), self._keys[index])
            space = found.space.take(np.s_[:, 0])
            space = space._replace(noise_sd=np.maximum(space.noise_sd, _LEAST_NOISE))
            shape = len(index), n_missions, n_bounds, n_robots
            given = Inputs(*(v[:, :n_missions, :n_bounds].reshape(shape) for v in found.inputs))
            predictor = LinearPredictor.from_space(space, self.layout, noise=given.noise)
            drift = self.layout.rows(given.drift)
            offset = self.layout.rows(given.offset)
            yield Given(
                some=index,
                predictor=predictor,
                mean=predictor.mean_given(drift, self.label) + offset,
                log_likelihood=found.log_likelihood[:, :n_missions],
                log_prior={safe(n): self._log_prior(n, v) for n, v in found.log_prior.items()},
            )

    def _log_prior(self, name: str, values: np.ndarray) -> np.ndarray:
        """Sum the log prior densities of the elements of a variable, shape (draw,)."""
        own = self.known.without_padding(values, self.known.sites[name])
        return own.reshape(len(own), -1).sum(1)

    def draw(
        self, given: Given, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """See `Source.draw`."""
        x, _ = draw_exactly(self, given, rng)
        return x, given.log_likelihood, given.log_prior

    def prior(self, posterior: xr.DataTree, rng: np.random.Generator) -> "OfFunction":
        """See `Source.prior`."""
        known = self.known
        if "prior" in posterior.children:
            values = known.stored(posterior, "prior")
        else:  # the user has dropped it
            values = known.run("prior", keys_of(N_PRIOR, posterior.attrs["seed"] + OF_PRIOR))

        n_draws = len(next(iter(values.values())))
        some = at(values, evenly_spaced(n_draws, N_TRAJECTORIES))
        keys = keys_of(min(n_draws, N_TRAJECTORIES), posterior.attrs["seed"] + OF_PRIOR)

        def drawn(theta: Theta) -> np.ndarray:
            parts = [known.effects.prior(chunk).draw(rng) for _, chunk in chunks(theta)]
            return np.concatenate(parts)

        return OfFunction(known, known.with_effects(some, keys, drawn), keys)
