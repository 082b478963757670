"""A NumPyro function as a trust model: its inputs, its sites, and what identifies it in files."""

import ast
import functools
import hashlib
import inspect
import io
import json
import pickle
import re
import textwrap
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from types import CodeType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpyro import handlers
from numpyro.distributions import (
    Distribution,
    ExpandedDistribution,
    Independent,
    MaskedDistribution,
    biject_to,
)
from numpyro.distributions.distribution import Unit
from numpyro.infer.util import log_density
from numpyro.primitives import Messenger, sample

from trustbo.display import joined
from trustbo.errors import TrustboError
from trustbo.inference.functions.data import NAMES, RATES, Data, arrays_of, observations_of
from trustbo.models.backend import own_settings
from trustbo.models.contact_rate import ContactRate
from trustbo.models.model import TrustModel
from trustbo.models.record import model_to_record
from trustbo.statespace import Inputs, StateSpace

KIND = "function"
"""The entry `class` in the record of a model that is a function."""
_HOW = (
    'End it with numpyro.sample("contact_rate", tb.models.ContactRate(drift, beta0, delta_w, '
    "delta_v), obs=contact_rate)."
)
_MOST_KNOWN = 64
"""Number of functions that are remembered, with what was compiled for them."""
_AXES = ("chain", "draw")
"""Names that no variable may have."""
_OF_SHAPES = re.compile("ncompatible shapes|could not be broadcast|not broadcast")
"""Errors of JAX and NumPy about shapes that do not fit each other."""
_MODULE = "$params"
"""Suffix of the site with the initial weights of a neural network in `numpyro.contrib.module`."""
_FROM_REPARAM = ("_decentered", "_base")
"""Suffixes of the latent variable to which a reparametrisation of NumPyro moves the plates."""
_HASH_LENGTH = 16
"""Number of hexadecimal digits of a hash."""


class Site(NamedTuple):
    """Latent variable of a function, or a site of `numpyro.deterministic`."""

    dims: tuple[str, ...]
    """Names of its axes: those of its plates, and `name_dim_0` and so on for others."""
    mission_axis: int | None
    """Axis that runs over missions; None if the variable is common to all missions."""
    shape: tuple[int, ...]
    n_free: int
    """Number of its coordinates in unconstrained space; 0 if it is no latent variable."""


class Found(NamedTuple):
    """What a function computes for one draw of its variables."""

    space: StateSpace
    inputs: Inputs
    log_prior: dict[str, Any]
    """Log prior density of each element of each variable, in the shape of its plates."""
    log_likelihood: Any
    """Log density of each mission's rates, or log probability of its counts, shape (mission,)."""
    of_counts: Any
    """Whether `log_likelihood` is of tick counts if every rate has one."""


class FunctionModel:
    """A NumPyro function `model(awareness, contact_rate=None, ...)` as a trust model.

    The distribution at its site `contact_rate` is the state space.

    Attributes:
        function: The function.
        inputs: Names of the inputs that it takes; see `data.NAMES`.
        compiled: Methods that were compiled for draws, by name and features.
        sampler: `nuts.Sampler` of the function, once there is one.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        """Read the names of the function's parameters.

        Raises:
            TrustboError: If a parameter is not an input and has no default, or `awareness` or
                `contact_rate` is not among the parameters.
        """
        self.function = function
        self.name = _name_of(function)
        self.inputs = _inputs_of(function, self.name)
        self.fingerprint = fingerprint(function)
        self.compiled: dict[tuple[str, tuple[str, ...]], Callable[..., Any]] = {}
        self.sampler: Any = None
        self._in_range: set[tuple[str, ...]] = set()  # features that were checked
        self._runs_again = False  # whether it was checked that every run has all sites

    @property
    def family(self) -> str:
        """Name of the observation family of the rates."""
        return "gaussian"

    @property
    def needs_observations(self) -> bool:
        """Whether the function takes all data as one object, which cannot be compiled once."""
        return "observations" in self.inputs

    def __repr__(self) -> str:
        return f"FunctionModel({self.in_short()})"

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"compiled": {}, "sampler": None}  # compiled code cannot be pickled

    def in_short(self) -> str:
        """Return the name of the function."""
        return f"the function {self.name}"

    def record(self) -> dict[str, Any]:
        """Return the name and a hash of the function and of its constants, for files."""
        return {
            "class": KIND,
            "name": self.name,
            "sha256": self.fingerprint,
            "constants": constants_of(self.function),
        }

    @cached_property
    def text(self) -> str:
        """The record as text, the attribute `model_record` of a posterior."""
        return json.dumps(self.record())

    def call(self, data: Data) -> None:
        """Run the function on the inputs that it takes."""
        self.function(**{name: data[name] for name in self.inputs})

    def sites(self, data: Data) -> dict[str, Site]:
        """Return the latent variables of the function by name, without computing anything.

        Raises:
            TrustboError: If the function fails, or has no site `contact_rate` with a `ContactRate`
                of the shape of the missions, or a variable is discrete, or there is none.
        """
        trace, free = self._shapes(data)
        if not free:
            raise TrustboError(f"{self.in_short()} has no latent variable to learn; sample one.")

        self._require_features_in_range(data)
        plates = _plates_of_rates(trace)
        return {name: _site(trace[name], free[name], plates) for name in free}

    def computed_sites(self, data: Data) -> dict[str, Site]:
        """Return the sites of `numpyro.deterministic` by name, without those that have bounds.

        The function runs, without computing anything, on twice as many missions and bounds. An axis
        whose length then changes is that of missions or bounds.
        """
        trace, _ = self._shapes(data)
        names = [name for name, site in trace.items() if site["type"] == "deterministic"]
        if not names:
            return {}

        try:
            more_missions, more_bounds = (self._shapes(_doubled(data, n))[0] for n in (0, 1))
        except TrustboError:  # the function is made for this number of missions and bounds
            more_missions = more_bounds = trace
        plates = _plates_of_rates(trace)
        sites = {}
        for name in names:
            if _axes_that_differ(trace[name], more_bounds[name]):
                continue
            axes = _axes_that_differ(trace[name], more_missions[name])
            sites[name] = _computed_site(trace, name, plates, axes[0] if axes else None)
        return sites

    def _shapes(self, data: Data) -> tuple[dict[str, Any], dict[str, Any]]:
        """Trace the function with abstract values.

        Returns:
            The trace, and the shapes of the latent variables in unconstrained space, by name.
        """
        trace: dict[str, Any] = {}

        def run(key: jax.Array, arrays: dict[str, Any]) -> dict[str, Any]:
            inputs = {**data, **arrays}
            found = handlers.trace(handlers.seed(self.call, key)).get_trace(inputs)
            trace.update(found)
            self._require_rates(found, data)
            self._require_sites_again(found, key, inputs)
            return {
                name: biject_to(found[name]["fn"].support).inv(found[name]["value"])
                for name in _latent(found)
            }

        with own_settings(), _explained(self, data):
            arrays = arrays_of(data)
            if self.needs_observations:  # its arrays must not be abstract
                arrays = {}
            free = jax.eval_shape(run, jax.random.key(0), arrays)
        return trace, free

    def _require_sites_again(self, found: Mapping[str, Any], key: jax.Array, data: Data) -> None:
        """Raise TrustboError if a second run lacks sites of the first one.

        `jax.jit` does not run a function again that it has compiled, so NumPyro misses its sites.
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

        JAX returns the last feature instead of an error. NumPy raises an error, so the function
        runs once with awareness as an array of NumPy. Other errors mean that it needs one of JAX.
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

    def _require_rates(self, trace: Mapping[str, Any], data: Data) -> None:
        """Raise TrustboError unless the site `contact_rate` is the state space of the missions."""
        site = trace.get(RATES)
        if site is None or site["type"] != "sample":
            names = [f"{name!r}" for name, one in trace.items() if one["type"] == "sample"]
            sites = f"only {joined(names)}" if names else "no site at all"
            raise TrustboError(f"{self.in_short()} has no site 'contact_rate', {sites}. {_HOW}")

        rates = self._require_contact_rate(site["fn"])
        if not site["is_observed"]:
            raise TrustboError(
                f"the site 'contact_rate' of {self.in_short()} is not observed; pass "
                "obs=contact_rate."
            )

        shape = np.shape(data[RATES])
        given = (*rates.batch_shape, *rates.event_shape)
        if given != shape:
            remedy = ""
            if given[2] == 1:
                remedy = " Add the axis of the robots: drift + jnp.zeros(awareness.shape[:3])."
            raise TrustboError(
                f"the drift of {self.in_short()} must have the shape (mission, bound, robot) = "
                f"{shape}, as awareness is (mission, bound, robot, feature) = "
                f"{np.shape(data['awareness'])}; got {given}.{remedy}"
            )

        self._require_variables(trace)

    def _require_contact_rate(self, rates: Any) -> ContactRate:
        """Return the distribution of the rates; raises TrustboError unless it is a ContactRate."""
        if isinstance(rates, ContactRate):
            return rates

        where = f"the site 'contact_rate' of {self.in_short()}"
        while isinstance(rates, ExpandedDistribution | Independent | MaskedDistribution):
            rates = rates.base_dist
        if isinstance(rates, ContactRate):
            raise TrustboError(
                f"{where} has a ContactRate that was changed by expand, mask or to_event; give a "
                "drift of the shape (mission, bound, robot), and NaN for rates that are to be left "
                "out."
            )
        raise TrustboError(
            f"{where} has the distribution {type(rates).__name__}; it must be "
            f"tb.models.ContactRate. {_HOW}"
        )

    def _require_variables(self, trace: Mapping[str, Any]) -> None:
        """Raise TrustboError for sites of a kind or a name that a posterior cannot have."""
        for name, one in trace.items():
            free = one["type"] == "sample" and not one["is_observed"]
            named = free or one["type"] == "deterministic"
            if free and one["fn"].support.is_discrete:
                raise TrustboError(
                    f"the site {name!r} of {self.in_short()} is discrete, and NUTS samples "
                    "continuous variables only; sum over its values."
                )
            if named and name in _AXES:
                raise TrustboError(
                    f"the site {name!r} of {self.in_short()} has the name of an axis of "
                    "posteriors; give it another name."
                )
            if one["type"] == "param" and not _has_prior(name, trace):
                raise TrustboError(
                    f"the site {name!r} of {self.in_short()} is a parameter to optimise "
                    "(numpyro.param, flax_module), which NUTS leaves at its initial value; use "
                    "numpyro.sample or random_flax_module."
                )

    # --- functions that are compiled once for each shape of their arguments ---

    def potential(self, z: Mapping[str, Any], data: Data) -> Any:
        """Compute the negative log density at values z of unconstrained space."""
        log_p, _ = log_density(self._at(z), (data,), {}, {})
        return -log_p

    def constrain(self, z: Mapping[str, Any], data: Data) -> dict[str, Any]:
        """Convert values of unconstrained space to values of the variables."""
        trace = handlers.trace(self._at(z)).get_trace(data)
        return {name: trace[name]["value"] for name in z}

    def _at(self, z: Mapping[str, Any]) -> Callable[..., Any]:
        """Return the function with values z of unconstrained space, and a factor for each Jacobian.

        `numpyro.infer.util.potential_energy` does the same with `numpyro.factor`, which fails after
        `import arviz, numpyro.distributions`; see `models.backend`.
        """

        def value_of(site: Mapping[str, Any]) -> Any:
            name = site["name"]
            if site["type"] != "sample" or name not in z:
                return None

            transform = biject_to(site["fn"].support)
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

    def unconstrain(self, values: Mapping[str, Any], data: Data) -> dict[str, Any]:
        """Convert values of the variables to values of unconstrained space."""
        trace = self._trace(values, jax.random.key(0), data)
        return {name: biject_to(trace[name]["fn"].support).inv(v) for name, v in values.items()}

    def prior(self, key: jax.Array, data: Data) -> dict[str, Any]:
        """Draw the variables from the prior."""
        trace = self._trace({}, key, data)
        return {name: trace[name]["value"] for name in _latent(trace)}

    def deterministic(
        self, values: Mapping[str, Any], key: jax.Array, data: Data
    ) -> dict[str, Any]:
        """Compute the sites of `numpyro.deterministic` at given values of the variables."""
        trace = self._trace(values, key, data)
        return {n: site["value"] for n, site in trace.items() if site["type"] == "deterministic"}

    def evaluate(self, values: Mapping[str, Any], key: jax.Array, data: Data) -> Found:
        """Run the function with given values of its variables; others are drawn from the prior."""
        trace = self._trace(values, key, data)
        rates: Any = trace[RATES]["fn"]
        return Found(
            space=rates.space,
            inputs=rates.inputs,
            log_prior={
                name: trace[name]["fn"].log_prob(trace[name]["value"]) for name in _latent(trace)
            },
            log_likelihood=rates.log_prob(trace[RATES]["value"]),
            of_counts=jnp.asarray(rates.n_ticks is not None),
        )

    def form(
        self, values: Mapping[str, Any], key: jax.Array, data: Data
    ) -> tuple[StateSpace, Inputs]:
        """Return the state space and the inputs for given values of the variables."""
        rates: Any = self._trace(values, key, data)[RATES]["fn"]
        return rates.space, rates.inputs

    def _trace(self, values: Mapping[str, Any], key: jax.Array, data: Data) -> dict[str, Any]:
        """Run the function with given values of some sites."""
        given = handlers.substitute(handlers.seed(self.call, key), dict(values))
        return handlers.trace(given).get_trace(data)

    def over_draws(self, method: str, n_draw_axes: int, data: Data) -> Callable[..., Any]:
        """Return a method whose first arguments have an axis (draw,), compiled for these data.

        Args:
            method: Name of a method whose last argument is `data`.
            n_draw_axes: Number of arguments with an axis (draw,).
            data: Inputs.
        """
        axes = (*(0,) * n_draw_axes, None)
        compute = getattr(self, method)
        if self.needs_observations:
            mapped = jax.jit(jax.vmap(lambda *draws: compute(*draws, data)))
            return lambda *draws: self._called(mapped, draws, data)

        features = data["features"]
        known = method, features
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
        """Call a compiled function with the settings and messages of this module."""
        with own_settings(), _explained(self, data):
            return jax.tree.map(np.asarray, compiled(*arguments))


class _explained:  # noqa: N801
    """Context in which an error in a user's function says which function failed."""

    def __init__(self, model: FunctionModel, data: Data) -> None:
        self.model = model
        self.data = data

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        who = self.model.in_short()
        if isinstance(error, TrustboError):
            if who not in str(error):
                raise TrustboError(f"{who}: {error}") from error
        elif isinstance(error, Exception):
            text = (str(error).strip().splitlines() or [""])[0]
            remedy = ""
            if isinstance(error, NotImplementedError):
                remedy = " Give variables proper priors, from which NumPyro can draw."
            if _OF_SHAPES.search(text):
                remedy = (
                    f" Awareness has the shape (mission, bound, robot, feature) = "
                    f"{np.shape(self.data['awareness'])}, and the drift must be (mission, bound, "
                    "robot). Use a variable of a mission as variable[:, None, None], and one of a "
                    "robot as it is."
                )
            raise TrustboError(
                f"{who} failed with {type(error).__name__}: {text}{remedy}"
            ) from error


_KNOWN: OrderedDict[str, FunctionModel] = OrderedDict()
"""Models of functions by fingerprint, the last used one last."""


def as_model(function: Callable[..., Any] | FunctionModel) -> FunctionModel:
    """Return the model of a function, the same one for the same function.

    Raises TrustboError if the function cannot be a model; see `FunctionModel`.
    """
    if isinstance(function, FunctionModel):
        return function

    model = FunctionModel(function)
    known = _KNOWN.get(model.fingerprint)
    if known is not None and known.function == function:
        model = known

    _KNOWN[model.fingerprint] = model
    _KNOWN.move_to_end(model.fingerprint)
    if len(_KNOWN) > _MOST_KNOWN:
        _KNOWN.popitem(last=False)
    return model


def model_of_record(
    record: Mapping[str, Any], given: Callable[..., Any] | FunctionModel | None = None
) -> FunctionModel:
    """Return the model with a record, which must be given or have been used in this process.

    Raises:
        TrustboError: If the function is not known, or another one is given.
    """
    if given is not None:
        model = as_model(given)
        if model.record() != dict(record):
            raise TrustboError(
                f"the posterior is of the function {record['name']!r} with the hash "
                f"{record['sha256']}, not of {model.name!r} with the hash {model.fingerprint}"
                f"{_difference(model, record)}. Give the same function, with the same constants, "
                "or fit again."
            )
        return model

    model = _KNOWN.get(record["sha256"])
    if model is None:
        raise TrustboError(
            f"the posterior is of the NumPyro function {record['name']!r}, which is not stored; "
            "give it with model=."
        )
    return model


def _difference(model: FunctionModel, record: Mapping[str, Any]) -> str:
    """Say which constants of a function are others than in a record, or that the code is."""
    if model.name != record["name"]:
        return ""

    own = model.record()["constants"]
    stored = record.get("constants", {})
    names = sorted(name for name in {**own, **stored} if own.get(name) != stored.get(name))
    if not names:
        return ", whose code or use of functools.partial differs"
    is_are = "constant" if len(names) == 1 else "constants"
    return f", whose {is_are} {joined(names)} differ{'s' if len(names) == 1 else ''}"


def is_of_function(record: Mapping[str, Any]) -> bool:
    """Return whether a record is of a model that is a function."""
    return record["class"] == KIND


def _inputs_of(function: Callable[..., Any], name: str) -> tuple[str, ...]:
    """Return the names of a function's inputs; raises TrustboError if they are wrong."""
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
    return takes


def _latent(trace: Mapping[str, Any]) -> list[str]:
    """Return the names of the latent variables in a trace."""
    return [
        name for name, site in trace.items() if site["type"] == "sample" and not site["is_observed"]
    ]


def _has_prior(name: str, trace: Mapping[str, Any]) -> bool:
    """Return whether a parameter holds the initial weights of a network whose weights are sampled.

    This is the case for `numpyro.contrib.module.random_flax_module` and its like.
    """
    network = name.removesuffix(_MODULE)
    return network != name and any(one.startswith(f"{network}/") for one in _latent(trace))


def _site(site: Mapping[str, Any], free: Any, plates: set[str]) -> Site:
    """Describe a latent variable; `plates` are those of the contact rates."""
    shape = np.shape(site["value"])
    n_batch = len(shape) - len(site["fn"].event_shape)
    axes = _axes_of_plates(shape, n_batch, site["cond_indep_stack"])
    dims, mission_axis = _dims(site["name"], shape, axes, plates)
    return Site(dims, mission_axis, shape, int(np.prod(np.shape(free))))


def _computed_site(
    trace: Mapping[str, Any], name: str, plates: set[str], mission_axis: int | None
) -> Site:
    """Describe a site of `numpyro.deterministic`; `mission_axis` is that of all missions, if known.

    NumPyro does not know how many of its axes belong to an event. The fewest for which the plates
    have the right sizes are assumed.
    """
    shape = np.shape(trace[name]["value"])
    stacks = [trace.get(f"{name}{suffix}", {}) for suffix in ("", *_FROM_REPARAM)]
    stack = next((s["cond_indep_stack"] for s in stacks if s.get("cond_indep_stack")), [])

    axes: dict[int, str] = {}
    for n_event in range(len(shape)):
        axes = _axes_of_plates(shape, len(shape) - n_event, stack)
        if len(axes) == len(stack):
            break
    dims, _ = _dims(name, shape, axes, plates)
    if mission_axis is not None:
        dims = (*dims[:mission_axis], "mission", *dims[mission_axis + 1 :])
    return Site(dims, mission_axis, shape, 0)


def _axes_of_plates(shape: tuple[int, ...], n_batch: int, stack: Sequence[Any]) -> dict[int, str]:
    """Return the names of plates by the axis of an array that has the size of the plate."""
    axes = {n_batch + frame.dim: frame for frame in stack}  # `dim` counts from the last axis
    return {
        axis: frame.name
        for axis, frame in axes.items()
        if 0 <= axis < n_batch and shape[axis] == frame.size
    }


def _dims(
    name: str, shape: tuple[int, ...], axes: Mapping[int, str], plates: set[str]
) -> tuple[tuple[str, ...], int | None]:
    """Return the names of the axes of a variable, and the axis that runs over missions."""
    dims = [axes.get(axis, f"{name}_dim_{axis}") for axis in range(len(shape))]
    mission_axis = None
    for axis, plate in axes.items():
        if plate in plates:
            dims[axis] = "mission"
            mission_axis = axis
    return tuple(dims), mission_axis


def _plates_of_rates(trace: Mapping[str, Any]) -> set[str]:
    """Return the names of the plates of the contact rates, which are plates of missions."""
    return {frame.name for frame in trace[RATES]["cond_indep_stack"]}


def _doubled(data: Data, axis: int) -> dict[str, Any]:
    """Return inputs with twice as many missions (axis 0) or bounds (axis 1)."""
    arrays = {name: np.concatenate([v, v], axis) for name, v in arrays_of(data).items()}
    more = {**data, **arrays}
    if "observations" in data:
        more["observations"] = observations_of(more)
    return more


def _axes_that_differ(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[int]:
    """Return the axes in which the values of two sites differ in length."""
    shapes = zip(np.shape(one["value"]), np.shape(other["value"]), strict=True)
    return [axis for axis, (n, m) in enumerate(shapes) if n != m]


def _name_of(function: Any) -> str:
    """Return the name of a function, also of one in `functools.partial` or a handler."""
    if isinstance(function, functools.partial) and not hasattr(function, "__name__"):
        return _name_of(function.func)
    if isinstance(function, Messenger) and function.fn is not None:
        return _name_of(function.fn)
    return getattr(function, "__name__", type(function).__name__)


# --- what identifies a function ---


def fingerprint(function: Callable[..., Any]) -> str:
    """Return a hash of a function: its code, without comments, and the values that it refers to.

    Values are defaults, variables of enclosing functions, and global variables. Modules, classes,
    and functions of other modules are identified by their names alone.
    """
    parts: list[str] = []
    _describe(function, parts, {})
    text = "\n".join(parts)
    return hashlib.sha256(text.encode()).hexdigest()[:_HASH_LENGTH]


def constants_of(function: Callable[..., Any]) -> dict[str, str]:
    """Return a short hash of each value that a function refers to, by name; see `fingerprint`.

    These are arguments of `functools.partial`, defaults, variables of enclosing functions, and
    global variables, also of functions of the same module that are called.
    """
    found: dict[str, str] = {}
    _add_constants(function, found, set())
    return found


def _add_constants(function: Any, found: dict[str, str], seen: set[int]) -> None:
    """Add the values that a function refers to; `seen` has the identities of earlier functions."""
    if id(function) in seen:
        return
    seen.add(id(function))

    values: dict[str, Any] = {}
    inner: list[Any] = []
    if isinstance(function, functools.partial):
        given = {f"argument {n}": value for n, value in enumerate(function.args)}
        values = {**given, **function.keywords}
        inner = [function.func]
    elif isinstance(function, Messenger):
        inner = [function.fn]
    elif inspect.ismethod(function):
        values = {"self": function.__self__}
        inner = [function.__func__]
    elif inspect.isfunction(function):
        values = _values_of(function)
    elif _is_wrapper(function):
        inner = [function.__wrapped__]

    for name, value in values.items():
        if inspect.isroutine(value) or _is_wrapper(value) or isinstance(value, functools.partial):
            inner.append(value)
            continue
        parts: list[str] = []
        _describe(value, parts, {})
        found.setdefault(name, hashlib.sha256("\n".join(parts).encode()).hexdigest()[:8])
    for one in inner:
        _add_constants(one, found, seen)


def _values_of(function: Any) -> dict[str, Any]:
    """Return the defaults, variables of enclosing functions and globals of a function by name."""
    parameters = inspect.signature(function, follow_wrapped=False).parameters.values()
    values = {one.name: one.default for one in parameters if one.default is not one.empty}
    code = function.__code__
    cells = function.__closure__ or ()
    values |= {n: _content(cell) for n, cell in zip(code.co_freevars, cells, strict=True)}
    names = sorted(_names_in(code) & set(function.__globals__))
    values |= {name: function.__globals__[name] for name in names if _is_own(function, name)}
    return values


def _describe(value: Any, parts: list[str], seen: dict[int, int]) -> None:
    """Add texts to `parts` that tell a value from others; `seen` numbers the functions so far."""
    if isinstance(value, TrustModel):
        parts.append(json.dumps(model_to_record(value), sort_keys=True))
    elif inspect.ismethod(value):
        _describe(value.__self__, parts, seen)
        _describe(value.__func__, parts, seen)
    elif inspect.isfunction(value):
        _describe_function(value, parts, seen)
    elif isinstance(value, functools.partial):
        for one in (value.func, value.args, value.keywords):
            _describe(one, parts, seen)
    elif isinstance(value, np.ndarray | jax.Array):
        is_key = isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key)
        array = np.asarray(jax.random.key_data(value) if is_key else value)
        parts.append(f"{array.dtype} {array.shape} {hashlib.sha256(array.tobytes()).hexdigest()}")
    elif isinstance(value, list | tuple | dict):
        _describe_items(value, parts, seen)
    elif _is_wrapper(value) or isinstance(value, Distribution | Messenger):
        _describe_object(value, parts, seen)
    else:
        _describe_other(value, parts, seen)


def _describe_items(value: Any, parts: list[str], seen: dict[int, int]) -> None:
    """Describe the items of a list, a tuple or a dict."""
    parts.append(f"{type(value).__name__} {len(value)}")
    if isinstance(value, dict):
        parts.extend(map(str, value))
        value = value.values()
    for one in value:
        _describe(one, parts, seen)


def _describe_function(
    function: Callable[..., Any], parts: list[str], seen: dict[int, int]
) -> None:
    """Describe the code of a function and the values that it refers to."""
    if id(function) in seen:  # a recursive function, or one that is used twice
        parts.append(f"function {seen[id(function)]}")
        return

    seen[id(function)] = len(seen)
    parts.append(_code_of(function))
    defaults = function.__defaults__ or ()
    by_keyword = function.__kwdefaults__ or {}
    enclosed = [_content(cell) for cell in function.__closure__ or ()]
    for one in (*defaults, *by_keyword.values(), *enclosed):
        _describe(one, parts, seen)
    for name in sorted(_names_in(function.__code__)):
        _describe_global(function, name, parts, seen)


def _names_in(code: CodeType) -> set[str]:
    """Return the names of globals and attributes in a code, including its inner functions."""
    inner = [_names_in(one) for one in code.co_consts if isinstance(one, CodeType)]
    return {*code.co_names}.union(*inner)


def _describe_global(
    function: Callable[..., Any], name: str, parts: list[str], seen: dict[int, int]
) -> None:
    """Describe a global variable that a function refers to; see `fingerprint`."""
    if name not in function.__globals__ or not _is_own(function, name):
        return

    value = function.__globals__[name]
    if not _is_function(value):
        parts.append(name)
    _describe(value, parts, seen)


def _is_own(function: Any, name: str) -> bool:
    """Return whether a global is a value, or a function of the same module as `function`."""
    value = function.__globals__[name]
    if inspect.ismodule(value) or inspect.isclass(value):
        return False
    return not _is_function(value) or getattr(value, "__module__", None) == function.__module__


def _is_function(value: Any) -> bool:
    """Return whether a value is a function, or wraps one."""
    return inspect.isroutine(value) or _is_wrapper(value)


def _is_wrapper(value: Any) -> bool:
    """Return whether a value wraps a function, such as `jax.jit`."""
    return not isinstance(value, type) and callable(getattr(value, "__wrapped__", None))


def _describe_object(value: Any, parts: list[str], seen: dict[int, int]) -> None:
    """Describe an object by its class and attributes, and by the function that it wraps."""
    parts.append(_kind_of(value))
    if _is_wrapper(value):
        _describe(value.__wrapped__, parts, seen)
    attributes = vars(value) if hasattr(value, "__dict__") else {}
    _describe({n: v for n, v in attributes.items() if not n.startswith("__")}, parts, seen)


def _describe_other(value: Any, parts: list[str], seen: dict[int, int]) -> None:
    """Describe a value that can be pickled; others are told apart by their kinds only.

    Pickle refers to the class of an object by name, so the code of `__call__` is added.
    """
    content = io.BytesIO()
    try:  # the text must be the same in other processes
        _Pickler(content, protocol=4).dump(value)
        parts.append(hashlib.sha256(content.getvalue()).hexdigest())
    except Exception:
        parts.append(_kind_of(value))

    call = getattr(type(value), "__call__", None)  # noqa: B004
    if inspect.isfunction(call):
        _describe(call, parts, seen)


class _Pickler(pickle.Pickler):
    """Pickler that stores sets in the order of their items' texts.

    The order of texts in a set differs between processes.
    """

    def persistent_id(self, value: Any) -> Any:
        """Return what stands for a set; None for other values."""
        return _sorted_texts(value) if isinstance(value, set | frozenset) else None


def _sorted_texts(items: set[Any] | frozenset[Any]) -> list[str]:
    """Return the texts of the items of a set, sorted; see `_describe`."""
    texts = []
    for one in items:
        parts: list[str] = []
        _describe(one, parts, {})
        texts.append("\n".join(parts))
    return sorted(texts)


def _code_of(function: Callable[..., Any]) -> str:
    """Return the code of a function without comments, or its byte code if there is no source.

    Lambdas have no source of their own, because several can be in one line.
    """
    if function.__name__ == "<lambda>":
        return _byte_code_of(function.__code__)
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    except (OSError, TypeError, SyntaxError):
        return _byte_code_of(function.__code__)
    return ast.unparse(tree)


def _byte_code_of(code: CodeType) -> str:
    """Return a byte code as text, the same in other processes."""
    constants = [_constant(one) for one in code.co_consts]
    return f"{code.co_code.hex()} {constants} {code.co_names!r}"


def _constant(value: Any) -> str:
    """Return a constant of a byte code as text, the same in other processes."""
    if isinstance(value, CodeType):
        return _byte_code_of(value)
    if isinstance(value, tuple):
        return f"({', '.join(map(_constant, value))})"
    if isinstance(value, frozenset):
        return f"{{{', '.join(sorted(map(_constant, value)))}}}"
    return repr(value)


def _content(cell: Any) -> Any:
    """Return the value of a variable of an enclosing function, or None if it is not set."""
    try:
        return cell.cell_contents
    except ValueError:
        return None


def _kind_of(value: Any) -> str:
    """Return the module and name of the class of a value."""
    return f"{type(value).__module__}.{type(value).__qualname__}"
