"""A NumPyro function as a trust model: its inputs, its densities and its results for a draw."""

import inspect
import json
from collections.abc import Callable, Collection, Mapping
from difflib import get_close_matches
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpyro import handlers
from numpyro.distributions import (
    Normal,
    biject_to,
)
from numpyro.distributions.distribution import Unit
from numpyro.distributions.transforms import AffineTransform, ExpTransform
from numpyro.infer.util import log_density
from numpyro.primitives import Messenger, sample

from trustbo.display import joined
from trustbo.errors import TrustboError, warn
from trustbo.identity import fingerprint, name_of, record_of
from trustbo.inference.functions.data import NAMES, RATES, Data, FeatureNames, arrays_of
from trustbo.inference.functions.explain import explained
from trustbo.inference.functions.plates import WholePlates
from trustbo.inference.functions.refusals import base_of, require_rates
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
from trustbo.statespace import Inputs, StateSpace

EFFECTS = "effects on the drift"
"""Name of the sum of the effects among the values of `FunctionModel.evaluate`."""
KIND = "function"
"""Value of the entry `class` in the record of a model that is a function."""
_ALIKE = 0.85
"""Similarity (`difflib`) of a parameter to the name of an input from which a warning is issued."""
BATCH = 128
"""Number of draws for which functions are compiled; a larger one is no faster."""
_MOST_TRACED = 16
"""Number of shapes of data whose traces are kept."""


class Found(NamedTuple):
    """Results of a function for one draw of its variables."""

    space: StateSpace
    inputs: Inputs
    log_prior: dict[str, Any]
    """Log prior density of each element of each variable, in the shape of its plates."""
    log_likelihood: Any
    """Log density of each mission's rates, or log probability of its counts, shape (mission,)."""


class Outer(NamedTuple):
    """Results of a function whose effects are to be integrated out, for one draw."""

    log_p: Any
    """Log density of all sites but the contact rates, shape ()."""
    space: StateSpace
    inputs: Inputs
    theta: dict[str, Any]
    """Hyperparameters of the effects; see `models.effects.Theta`."""


class Probe(NamedTuple):
    """Results of all sites of a function for one draw of its variables, for checks."""

    space: StateSpace
    inputs: Inputs
    rates: Any
    """Observed value of the site `contact_rate`, shape (mission, bound, robot)."""
    n_ticks: Any
    """Tick counts of its distribution, of the same shape; None if it has none."""
    values: dict[str, Any]
    """Latent variables."""
    log_p: dict[str, Any]
    """Log density of each sample site, in the shape of its plates."""
    computed: dict[str, Any]
    """Sites of `numpyro.deterministic`."""


class FunctionModel:
    """A NumPyro function `model(awareness, contact_rate=None, ...)` as a trust model.

    The distribution at its site `contact_rate` is the state space.

    Attributes:
        function: The function.
        inputs: Names of the inputs that it takes; see `data.NAMES`.
        compiled: Functions that were compiled for draws; see `compiled_over_draws`.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        """Read the names of the function's parameters.

        Raises:
            TrustboError: If a parameter is not an input and has no default, or if the parameters
                lack `awareness` or `contact_rate`.
        """
        self.function = function
        self.name = name_of(function)
        self.inputs = _inputs_of(function, self.name)
        self.fingerprint = fingerprint(function)
        self.compiled: dict[tuple[Any, ...], Callable[..., Any]] = {}
        self._in_range: set[tuple[str, ...]] = set()  # feature names that were checked
        self._traced: dict[Any, tuple[dict[str, Any], dict[str, Any]]] = {}  # see `_shapes`
        self._runs_again = False  # whether a check has found all sites in a second run

    @property
    def family(self) -> str:
        """Name of the observation family of the rates."""
        return "gaussian"

    @property
    def needs_observations(self) -> bool:
        """Whether the function takes all data as one object, and is recompiled for new data."""
        return "observations" in self.inputs

    def __repr__(self) -> str:
        return f"FunctionModel({self.in_short()})"

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"compiled": {}, "_traced": {}}  # which cannot be pickled

    def in_short(self) -> str:
        """Return the name of the function."""
        return f"the function {self.name}"

    def record(self) -> dict[str, Any]:
        """Return the name of the function and what identifies it, for files."""
        return {"class": KIND, "name": self.name, **record_of(self.function)}

    @cached_property
    def text(self) -> str:
        """The record as text, as in the attribute `model_record` of a posterior."""
        return json.dumps(self.record())

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
        trace, free = self._shapes(data)
        if not free:
            raise TrustboError(f"{self.in_short()} has no latent variable to learn; sample one.")

        self._require_features_in_range(data)
        plates = plates_of_rates(trace)
        with explained(self.in_short(), data):
            return {name: site_of(trace[name], free[name], plates) for name in free}

    def free(self, data: Data) -> dict[str, np.ndarray]:
        """Return zeros of the shape of each latent variable in unconstrained space, by name."""
        _, free = self._shapes(data)
        return {name: np.zeros(np.shape(free[name])) for name in sorted(free)}

    def noises(self, data: Data) -> tuple[str, str] | None:
        """Return the names of the variables that are delta_w and delta_v themselves, if they are.

        Both must be positive and have the same shape, without an axis of missions.
        """
        trace, free = self._shapes(data)
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
        trace, _ = self._shapes(data)
        return trace[RATES]["fn"]

    def effects(self, data: Data) -> tuple[Effect, ...]:
        """Return the effects that the function adds to the drift."""
        return self.rates(data).effects

    def computed_sites(self, data: Data) -> dict[str, Site]:
        """Return the sites of `numpyro.deterministic` by name, except those with an axis of bounds.

        The function is traced, without computing anything, on twice as many missions, bounds,
        robots and features. An axis whose length changes is an axis of these.
        """
        trace, _ = self._shapes(data)
        names = [name for name, site in trace.items() if site["type"] == "deterministic"]
        if not names:
            return {}

        more_missions, more_bounds, more_robots, more_features = (
            self._trace_of_more(trace, data, axis) for axis in range(4)
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

    def _trace_of_more(self, trace: dict[str, Any], data: Data, axis: int) -> dict[str, Any]:
        """Trace the function on data doubled along an axis; see `doubled`.

        Return the given trace of the data if the function accepts only their size.
        """
        try:
            more, _ = self._shapes(doubled(data, axis))
        except TrustboError:
            return trace

        is_same = all(
            name in more and np.ndim(more[name]["value"]) == np.ndim(site["value"])
            for name, site in trace.items()
            if site["type"] == "deterministic"
        )
        return more if is_same else trace

    def _shapes(self, data: Data) -> tuple[dict[str, Any], dict[str, Any]]:
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

    # --- functions that are compiled once for each shape of their arguments ---

    def potential(self, z: Mapping[str, Any], data: Data, deviations: Collection[str] = ()) -> Any:
        """Compute the negative log density at unconstrained values z; see `_transform_of`."""
        log_p, _ = log_density(self._at(z, deviations), (data,), {}, {})
        return -log_p

    def outer(self, z: Mapping[str, Any], data: Data, deviations: Collection[str] = ()) -> Outer:
        """Run the function at unconstrained values z, for effects that are to be integrated out."""
        without_rates = _WithoutRates(self._at(z, deviations))
        log_p, _ = log_density(without_rates, (data,), {}, {})
        rates = without_rates.rates
        return Outer(log_p, rates.space_with_resolution, rates.inputs, rates.theta)

    def constrain(
        self, z: Mapping[str, Any], data: Data, deviations: Collection[str] = ()
    ) -> dict[str, Any]:
        """Convert unconstrained values to values of the variables; see `_transform_of`."""
        trace = handlers.trace(self._at(z, deviations)).get_trace(data)
        return {name: trace[name]["value"] for name in z}

    def _at(self, z: Mapping[str, Any], deviations: Collection[str]) -> Callable[..., Any]:
        """Return the function with unconstrained values z, and with a factor for each Jacobian.

        `numpyro.infer.util.potential_energy` does the same with `numpyro.factor`, which fails after
        `import arviz, numpyro.distributions`; see `models.backend`.
        """

        def value_of(site: Mapping[str, Any]) -> Any:
            name = site["name"]
            if site["type"] != "sample" or name not in z:
                return None

            transform = _transform_of(site, deviations)
            x = z[name]
            n_more = transform.codomain.event_dim - transform.domain.event_dim
            step = site["infer"].get("_scan_current_index")  # within numpyro.contrib's scan
            if step is not None and jnp.ndim(x) > len(site["fn"].shape()) - n_more:
                x = x[step]

            value = transform(x)
            log_det = transform.log_abs_det_jacobian(x, value)
            n_event = jnp.ndim(log_det) - jnp.ndim(value) + len(site["fn"].event_shape)
            log_det = log_det.sum(range(-n_event, 0))
            factor = Unit(log_det)
            infer = {"is_auxiliary": True}
            sample(f"_{name}_log_det", factor, obs=factor.sample(jax.random.key(0)), infer=infer)
            return value

        return handlers.substitute(handlers.seed(self.call, 0), substitute_fn=value_of)

    def unconstrain(
        self, values: Mapping[str, Any], data: Data, deviations: Collection[str] = ()
    ) -> dict[str, Any]:
        """Convert values of the variables to unconstrained values; see `_transform_of`."""
        trace = self._trace(values, jax.random.key(0), data)
        return {name: _transform_of(trace[name], deviations).inv(v) for name, v in values.items()}

    def scales(self, key: jax.Array, data: Data) -> dict[str, Any]:
        """Return the means and standard deviations of normal variables, for a draw of the prior."""
        trace = self._trace({}, key, data)
        bases = {name: base_of(trace[name]["fn"]) for name in latent_in(trace)}
        return {name: (b.loc, b.scale) for name, b in bases.items() if isinstance(b, Normal)}

    def prior(self, key: jax.Array, data: Data) -> dict[str, Any]:
        """Draw the variables from the prior."""
        return self.prior_given({}, key, data)

    def prior_given(self, values: Mapping[str, Any], key: jax.Array, data: Data) -> dict[str, Any]:
        """Draw the variables from the prior given the values of some of them."""
        trace = self._trace(values, key, data)
        return {name: trace[name]["value"] for name in latent_in(trace)}

    def deterministic(
        self, values: Mapping[str, Any], key: jax.Array, data: Data
    ) -> dict[str, Any]:
        """Compute the sites of `numpyro.deterministic` at given values of the variables."""
        trace = self._trace(values, key, data)
        return {n: site["value"] for n, site in trace.items() if site["type"] == "deterministic"}

    def evaluate(self, values: Mapping[str, Any], key: jax.Array, data: Data) -> Found:
        """Run the function with given values of some variables; draw the others from the prior.

        `EFFECTS` is the sum (mission, bound, robot) of the effects on the drift, if there are any.
        """
        values = dict(values)
        effects = values.pop(EFFECTS, None)
        trace = self._trace(values, key, data)
        rates: Any = trace[RATES]["fn"]
        if effects is not None:
            rates = rates.given(effects)
        return Found(
            space=rates.space_with_resolution,
            inputs=rates.inputs,
            log_prior={
                name: trace[name]["fn"].log_prob(trace[name]["value"]) for name in latent_in(trace)
            },
            log_likelihood=rates.log_prob(trace[RATES]["value"]),
        )

    def probe(self, values: Mapping[str, Any], key: jax.Array, data: Data) -> Probe:
        """Run the function like `evaluate`, and return the results of all sites."""
        trace = self._trace(values, key, data)
        rates: Any = trace[RATES]["fn"]
        if rates.effects:  # these are not of the function itself
            trace[RATES]["fn"] = rates.given(np.zeros(rates.shape()))
        drawn = {name: site for name, site in trace.items() if site["type"] == "sample"}
        log_p = {name: site["fn"].log_prob(site["value"]) for name, site in drawn.items()}
        for name, site in drawn.items():
            if site["scale"] is not None:
                log_p[name] = site["scale"] * log_p[name]

        return Probe(
            space=rates.space_with_resolution,
            inputs=rates.inputs,
            rates=trace[RATES]["value"],
            n_ticks=rates.n_ticks,
            values={name: trace[name]["value"] for name in latent_in(trace)},
            log_p=log_p,
            computed={n: s["value"] for n, s in trace.items() if s["type"] == "deterministic"},
        )

    def space_and_inputs(
        self, values: Mapping[str, Any], key: jax.Array, data: Data
    ) -> tuple[StateSpace, Inputs]:
        """Return the state space, without noise of the resolution, and the inputs."""
        rates: Any = self._trace(values, key, data)[RATES]["fn"]
        return rates.space, rates.inputs

    def theta(self, values: Mapping[str, Any], key: jax.Array, data: Data) -> dict[str, Any]:
        """Return the hyperparameters of the effects; see `models.effects.Theta`."""
        rates: Any = self._trace(values, key, data)[RATES]["fn"]
        return rates.theta

    def _trace(self, values: Mapping[str, Any], key: jax.Array, data: Data) -> dict[str, Any]:
        """Run the function with given values of some sites."""
        given = handlers.substitute(handlers.seed(self.call, key), dict(values))
        return handlers.trace(given).get_trace(data)

    def over_draws(self, method: str, n_draw_axes: int, data: Data) -> Callable[..., Any]:
        """Return a method compiled for these data, with an axis (draw,) in its first arguments.

        Args:
            method: Name of a method whose last argument is `data`.
            n_draw_axes: Number of arguments with an axis (draw,).
            data: Inputs.
        """
        return self.compiled_over_draws((method,), getattr(self, method), n_draw_axes, data)

    def compiled_over_draws(
        self, key: tuple[Any, ...], compute: Callable[..., Any], n_draw_axes: int, data: Data
    ) -> Callable[..., Any]:
        """Return a function of draws and data, compiled for these data; see `over_draws`.

        Args:
            key: What tells the function from others; it is compiled once for each key.
            compute: Function whose last argument is `data`.
            n_draw_axes: Number of arguments with an axis (draw,).
            data: Inputs.
        """
        axes = (*(0,) * n_draw_axes, None)
        if self.needs_observations:
            mapped = jax.jit(jax.vmap(lambda *draws: compute(*draws, data)))
            return lambda *draws: self._called(mapped, draws, data)

        features = data["features"]
        known = *key, features
        if known not in self.compiled:

            def of_arrays(*arguments: Any) -> Any:
                *draws, arrays = arguments
                return compute(*draws, {**arrays, "features": features})

            self.compiled[known] = jax.jit(jax.vmap(of_arrays, in_axes=axes))
        mapped = self.compiled[known]
        needed = (*self.inputs, RATES)
        arrays = {n: np.asarray(v) for n, v in arrays_of(data).items() if n in needed}
        return lambda *draws: self._called(mapped, (*draws, arrays), data)

    def _called(self, compiled: Callable[..., Any], arguments: tuple[Any, ...], data: Data) -> Any:
        """Call a compiled function with the settings and error messages of this module."""
        with own_settings(), explained(self.in_short(), data):
            return jax.tree.map(np.asarray, compiled(*arguments))


def in_batches(compiled: Callable[..., Any], *draws: Any, size: int = BATCH) -> Any:
    """Call a compiled function for some draws at a time, and concatenate the results.

    It is compiled for one number of draws, because a call with fewer ones repeats some of them.

    Args:
        compiled: Function of draws, as from `FunctionModel.over_draws`.
        draws: Its arguments, whose arrays have the axis (draw,).
        size: Number of draws in a call.
    """
    n = len(jax.tree.leaves(draws)[0])
    repeated = np.resize(np.arange(n), n + -n % size)
    parts = [
        compiled(*jax.tree.map(lambda a, some=some: a[some], draws))
        for some in repeated.reshape(-1, size)
    ]
    return jax.tree.map(lambda *arrays: np.concatenate(arrays)[:n], *parts)


class _WithoutRates(Messenger):
    """Handler that takes the distribution of the rates, and leaves a density of 1 in its place."""

    rates: ContactRate

    def process_message(self, msg: dict[str, Any]) -> None:
        """Replace the distribution at the site `contact_rate`."""
        if msg["type"] == "sample" and msg["name"] == RATES:
            self.rates = msg["fn"]
            msg["fn"] = Unit(jnp.zeros(self.rates.batch_shape))
            msg["value"] = jnp.zeros((*self.rates.batch_shape, 0))


def _transform_of(site: Mapping[str, Any], deviations: Collection[str]) -> Any:
    """Return the transform from unconstrained values to values of a variable.

    The values of `deviations` are those of normal variables, from their means and in units of their
    standard deviations.
    """
    if site["name"] in deviations:
        base = base_of(site["fn"])
        return AffineTransform(base.loc, base.scale)
    return biject_to(site["fn"].support)


def _inputs_of(function: Callable[..., Any], name: str) -> tuple[str, ...]:
    """Return the names of a function's inputs; raise TrustboError if they are wrong."""
    inner: Any = function
    while isinstance(inner, Messenger):  # such as `handlers.reparam`
        inner = inner.fn
    parameters = inspect.signature(inner).parameters
    takes = tuple(one for one in parameters if one in NAMES)
    if "observations" not in takes:
        for needed in ("awareness", RATES):
            if needed not in takes:
                raise TrustboError(
                    f"the function {name} must have the parameters awareness and contact_rate; "
                    f"got {name}({', '.join(parameters)}). Other inputs are "
                    f"{joined([one for one in NAMES if one not in ('awareness', RATES)])}."
                )

    unknown = [
        one.name
        for one in parameters.values()
        if one.name not in NAMES
        and one.default is one.empty
        and one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)
    ]
    if unknown:
        raise TrustboError(
            f"the parameter {unknown[0]!r} of the function {name} is not an input of a model; the "
            f"inputs are {joined(list(NAMES))}. Give it a default, or use functools.partial."
        )

    others = [one for one in NAMES if one not in takes]
    for parameter in parameters:
        alike = [] if parameter in takes else get_close_matches(parameter, others, 1, _ALIKE)
        if alike:
            warn(
                f"the parameter {parameter!r} of the function {name} is not an input of a model "
                f"and keeps its default; rename it if the input {alike[0]!r} is meant."
            )
    return takes
