"""A NumPyro function with the missions to which it is fitted."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from trustbo.arrays import joined_draws
from trustbo.data import Mission
from trustbo.inference.columns import Columns
from trustbo.inference.density import Density, Outer
from trustbo.inference.functions.data import arrays_of, data_of
from trustbo.inference.functions.function import FunctionModel, in_batches
from trustbo.inference.functions.sites import Site, safe
from trustbo.models.families import FAMILIES
from trustbo.models.observations import Observations
from trustbo.statespace import Inputs
from trustbo.statespace.blocks import Layout
from trustbo.workspace import Workspace


class FunctionData:
    """A function with missions.

    Attributes:
        model: The function.
        observations: Rates and awareness of the missions, with the data that the effects need.
        data: Inputs of the function, padded.
        sites: Variables of the function by name.
        resolution: Resolution of rates that the function adds to its noise, or 0.
        has_ticks: Whether log-likelihoods are those of tick counts, if all of these are known.
        log_resolution: Log ratio of the probability of the tick counts to the density of the rates,
            if the density is to be that of tick counts; else 0.
        density: Density of the rates, with the effects that the function adds to the drift.
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
        self.has_ticks = rates.n_ticks is not None

        for effect in rates.effects:
            observations = effect.add_data(observations, missions, workspace)
        self.observations = observations
        layout = Layout.of_space(rates.space, observations.contact_rate)
        columns = Columns(rates.effects, observations)
        family = FAMILIES[model.family]
        self.density = Density(columns, layout, family)

        self.log_resolution = 0.0
        of_ticks = family.log_resolution(observations.contact_rate, observations.n_ticks)
        if self.resolution > 0.0 and not np.isnan(of_ticks).any():
            self.log_resolution = float(of_ticks.sum())

    def run(self, method: str, *draws: Any) -> Any:
        """Run a method of the function for draws; see `FunctionModel.over_draws`."""
        return in_batches(self.model.over_draws(method, len(draws), self.data), *draws)

    def unpadded(self, outer: Outer) -> Outer:
        """Return what the function says about the missions, without the padding."""
        shape = self.observations.contact_rate.shape
        inputs = (v[:, : shape[0], : shape[1]].reshape(-1, *shape) for v in outer.inputs)
        space = outer.space.take(np.s_[:, 0])
        return outer._replace(space=space, inputs=Inputs(*inputs))

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
