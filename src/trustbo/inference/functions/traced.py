"""The variables of a NumPyro function and its other sites, found without computing anything."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from numpyro import handlers
from numpyro.distributions import biject_to
from numpyro.distributions.transforms import ExpTransform

from trustbo.display import joined
from trustbo.errors import TrustboError
from trustbo.identity import name_of
from trustbo.inference.functions.data import RATES, Data, FeatureNames, arrays_of
from trustbo.inference.functions.explain import explained
from trustbo.inference.functions.plates import WholePlates
from trustbo.inference.functions.refusals import require_rates
from trustbo.inference.functions.signature import inputs_of
from trustbo.inference.functions.sites import (
    Site,
    axes_that_differ,
    computed_site,
    doubled,
    latent_in,
    plates_of_rates,
    site_of,
)
from trustbo.models.backend import own_settings
from trustbo.models.contact_rate import ContactRate
from trustbo.models.effects.effect import Effect
from trustbo.models.scores import NOISES

_MOST_TRACED = 16
"""Number of shapes of data whose traces are kept."""


class TracedFunction:
    """A NumPyro function `model(awareness, contact_rate=None, ...)`, with its sites.

    The function is traced by JAX with abstract arrays, which have shapes but no values.

    Attributes:
        function: The function.
        name: Its name.
        inputs: Names of the inputs that it takes; see `data.NAMES`.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        """Read the names of the function's parameters.

        Raises:
            TrustboError: If a parameter is not an input and has no default, or if the parameters
                lack `awareness` or `contact_rate`.
        """
        self.function = function
        self.name = name_of(function)
        self.inputs = inputs_of(function, self.name)
        self._traced: dict[Any, tuple[dict[str, Any], dict[str, Any]]] = {}  # see `_abstract`
        self._in_range: set[tuple[str, ...]] = set()  # feature names that were checked
        self._runs_again = False  # whether a check has found all sites in a second run

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_traced": {}}  # which cannot be pickled

    @property
    def needs_observations(self) -> bool:
        """Whether the function takes all data as one object, and is recompiled for new data."""
        return "observations" in self.inputs

    def in_short(self) -> str:
        """Return the name of the function."""
        return f"the function {self.name}"

    def call(self, data: Data) -> None:
        """Run the function on the inputs that it takes."""
        inputs = {name: data[name] for name in self.inputs}
        if "features" in inputs:
            inputs["features"] = FeatureNames(inputs["features"])
        self.function(**inputs)

    def sites(self, data: Data) -> dict[str, Site]:
        """Return the latent variables of the function by name, without computing anything.

        Raises:
            TrustboError: If the function fails; if it has no site `contact_rate` with a
                `ContactRate` in the shape of the missions; if a variable is discrete; or if there
                are no variables.
        """
        trace, free = self._abstract(data)
        if not free:
            raise TrustboError(f"{self.in_short()} has no latent variable to learn; sample one.")

        self._require_features_in_range(data)
        plates = plates_of_rates(trace)
        with explained(self.in_short(), data):
            return {name: site_of(trace[name], free[name], plates) for name in free}

    def free(self, data: Data) -> dict[str, np.ndarray]:
        """Return zeros of the shape of each latent variable in unconstrained space, by name."""
        _, free = self._abstract(data)
        return {name: np.zeros(np.shape(free[name])) for name in sorted(free)}

    def noises(self, data: Data) -> tuple[str, str] | None:
        """Return the names of the variables that are delta_w and delta_v themselves, if they are.

        Both must be positive and have the same shape, without an axis of missions.
        """
        trace, free = self._abstract(data)
        names = []
        for noise in trace[RATES]["fn"].noises:
            names += [name for name in free if trace[name]["value"] is noise]
        if len(names) < len(NOISES) or np.shape(free[names[0]]) != np.shape(free[names[1]]):
            return None

        sites = [site_of(trace[name], free[name], plates_of_rates(trace)) for name in names]
        maps = [biject_to(trace[name]["fn"].support) for name in names]
        is_plain = all(site.mission_axis is None for site in sites)
        is_plain = is_plain and all(isinstance(one, ExpTransform) for one in maps)
        return (names[0], names[1]) if is_plain else None

    def rates(self, data: Data) -> ContactRate:
        """Return the distribution of the rates; its arrays have shapes, but no values."""
        trace, _ = self._abstract(data)
        return trace[RATES]["fn"]

    def effects(self, data: Data) -> tuple[Effect, ...]:
        """Return the effects that the function adds to the drift."""
        return self.rates(data).effects

    def computed_sites(self, data: Data) -> dict[str, Site]:
        """Return the sites of `numpyro.deterministic` by name, except those with an axis of bounds.

        The function is traced, without computing anything, on twice as many missions, bounds,
        robots and features. An axis whose length changes is an axis of these.
        """
        trace, _ = self._abstract(data)
        names = [name for name, site in trace.items() if site["type"] == "deterministic"]
        if not names:
            return {}

        more_missions, more_bounds, more_robots, more_features = (
            self._abstract_of_more(trace, data, axis) for axis in range(4)
        )
        traces = (trace, more_missions, more_robots, more_features)
        plates = plates_of_rates(trace)
        sites = {}
        for name in names:
            if axes_that_differ(trace[name], more_bounds[name]):
                continue
            axes = axes_that_differ(trace[name], more_missions[name])
            sites[name] = computed_site(traces, name, plates, axes[0] if axes else None)
        return sites

    def _abstract_of_more(self, trace: dict[str, Any], data: Data, axis: int) -> dict[str, Any]:
        """Trace the function on data doubled along an axis; see `doubled`.

        Return the given trace of the data if the function accepts only their size.
        """
        try:
            more, _ = self._abstract(doubled(data, axis))
        except TrustboError:
            return trace

        is_same = all(
            name in more and np.ndim(more[name]["value"]) == np.ndim(site["value"])
            for name, site in trace.items()
            if site["type"] == "deterministic"
        )
        return more if is_same else trace

    def _abstract(self, data: Data) -> tuple[dict[str, Any], dict[str, Any]]:
        """Trace the function with abstract values, once for each shape of the data.

        Returns:
            The trace, and the shapes of the latent variables in unconstrained space, by name.
        """
        shapes = tuple((name, np.shape(values)) for name, values in arrays_of(data).items())
        key = (data["features"], shapes)
        if key in self._traced:
            return self._traced[key]

        trace: dict[str, Any] = {}

        def run(key: jax.Array, arrays: dict[str, Any]) -> dict[str, Any]:
            inputs = {**data, **arrays}
            whole = WholePlates(self.call, owner=self.in_short())
            found = handlers.trace(handlers.seed(whole, key)).get_trace(inputs)
            trace.update(found)
            require_rates(self.in_short(), found, data)
            self._require_sites_again(found, key, inputs)
            return {
                name: biject_to(found[name]["fn"].support).inv(found[name]["value"])
                for name in latent_in(found)
            }

        with own_settings(), explained(self.in_short(), data):
            arrays = arrays_of(data)
            if self.needs_observations:  # its arrays must not be abstract
                arrays = {}
            free = jax.eval_shape(run, jax.random.key(0), arrays)
        if not self.needs_observations:  # else the trace depends on more than shapes
            if len(self._traced) == _MOST_TRACED:
                self._traced.clear()
            self._traced[key] = trace, free
        return trace, free

    def _require_sites_again(self, found: Mapping[str, Any], key: jax.Array, data: Data) -> None:
        """Raise TrustboError if a second run lacks sites of the first one.

        `jax.jit` does not run a compiled function again, so NumPyro does not see its sites.
        """
        if self._runs_again:
            return

        again = handlers.trace(handlers.seed(self.call, key)).get_trace(data)
        lost = [name for name in found if name not in again]
        if lost:
            raise TrustboError(
                f"{self.in_short()} has the site {lost[0]!r} in its first run only; remove jax.jit "
                "from functions that call numpyro.sample. The model is compiled as a whole."
            )
        self._runs_again = True

    def _require_features_in_range(self, data: Data) -> None:
        """Raise TrustboError if the function reads a feature that awareness does not have.

        For an index out of range, JAX returns the last feature, but NumPy raises an error.
        Therefore, the function is run once with awareness as a NumPy array. Any other error means
        that the function needs a JAX array.
        """
        features = data["features"]
        if features in self._in_range:
            return
        self._in_range.add(features)
        n_features = np.shape(data["awareness"])[-1]
        of_features = f"is out of bounds for axis 3 with size {n_features}"

        def run(key: jax.Array) -> None:
            handlers.seed(self.call, key)({**data, "awareness": np.asarray(data["awareness"])})

        try:
            with own_settings():
                jax.eval_shape(run, jax.random.key(0))
        except IndexError as error:
            if of_features not in str(error):
                return
            places = [f"{name} ({m})" for m, name in enumerate(features)]
            self._in_range.discard(features)
            raise TrustboError(
                f"{self.in_short()} reads a feature that awareness does not have: {error}. The "
                f"features are {joined(places)}; a function that takes the input features can "
                "use awareness[..., features.index(name)]."
            ) from error
        except Exception:
            return
