"""A NumPyro function as a trust model: what it computes for draws of its variables."""

import json
from collections.abc import Callable, Collection, Mapping
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpyro import handlers
from numpyro.distributions import Normal, biject_to
from numpyro.distributions.distribution import Unit
from numpyro.distributions.transforms import AffineTransform
from numpyro.infer.util import log_density
from numpyro.primitives import sample

from trustbo.identity import fingerprint, record_of
from trustbo.inference.density import Outer
from trustbo.inference.functions.data import RATES, Data, arrays_of
from trustbo.inference.functions.explain import explained
from trustbo.inference.functions.refusals import base_of
from trustbo.inference.functions.sites import latent_in
from trustbo.inference.functions.traced import TracedFunction
from trustbo.models.backend import own_settings
from trustbo.statespace import Inputs, StateSpace

KIND = "function"
"""Value of the entry `class` in the record of a model that is a function."""
BATCH = 128
"""Number of draws for which functions are compiled; a larger one is no faster."""


class FunctionModel(TracedFunction):
    """A NumPyro function `model(awareness, contact_rate=None, ...)` as a trust model.

    The distribution at its site `contact_rate` is the state space. The function runs in three ways:

    1. With abstract arrays, which computes nothing. This gives names and shapes (`sites`, `free`,
       `noises`, `rates`, `effects`, `computed_sites`), which all other code needs first.
    2. At unconstrained values z of all variables, whose density includes the Jacobians. The
       samplers need `potential`, or `outer` if effects are integrated out, and `constrain` for
       their draws.
    3. At given values of some variables, with the others drawn from the prior (`trace`). The draws
       of the prior, predictions, plans and checks need this. Each method returns a part of the
       trace, because only results that are returned are computed.

    The methods of the last two ways are for one draw, in JAX. `over_draws` compiles one of them for
    an axis of draws.

    Attributes:
        fingerprint: Hash of the function.
        compiled: Functions that were compiled for draws; see `compiled_over_draws`.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        """See `TracedFunction`."""
        super().__init__(function)
        self.fingerprint = fingerprint(function)
        self.compiled: dict[tuple[Any, ...], Callable[..., Any]] = {}

    @property
    def family(self) -> str:
        """Name of the observation family of the rates."""
        return "gaussian"

    def __repr__(self) -> str:
        return f"FunctionModel({self.in_short()})"

    def __getstate__(self) -> dict[str, Any]:
        return super().__getstate__() | {"compiled": {}}  # which cannot be pickled

    def record(self) -> dict[str, Any]:
        """Return the name of the function and what identifies it, for files."""
        return {"class": KIND, "name": self.name, **record_of(self.function)}

    @cached_property
    def text(self) -> str:
        """The record as text, as in the attribute `model_record` of a posterior."""
        return json.dumps(self.record())

    # --- at unconstrained values ---

    def potential(self, z: Mapping[str, Any], data: Data, deviations: Collection[str] = ()) -> Any:
        """Compute the negative log density at unconstrained values z; see `_transform_of`."""
        log_p, _ = log_density(self._at(z, deviations), (data,), {}, {})
        return -log_p

    def outer(self, z: Mapping[str, Any], data: Data, deviations: Collection[str] = ()) -> Outer:
        """Run the function at unconstrained values z, for effects that are to be integrated out."""
        whole = handlers.trace(self._at(z, deviations))
        log_p, _ = log_density(handlers.block(whole, hide=[RATES]), (data,), {}, {})
        rates: Any = whole.trace[RATES]["fn"]
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

    # --- at given values ---

    def trace(self, values: Mapping[str, Any], key: jax.Array, data: Data) -> dict[str, Any]:
        """Run the function with given values of some variables; draw the others from the prior.

        Returns:
            The sites by name, as `numpyro.handlers.trace` returns them.
        """
        given = handlers.substitute(handlers.seed(self.call, key), dict(values))
        return handlers.trace(given).get_trace(data)

    def unconstrain(
        self, values: Mapping[str, Any], data: Data, deviations: Collection[str] = ()
    ) -> dict[str, Any]:
        """Convert values of the variables to unconstrained values; see `_transform_of`."""
        trace = self.trace(values, jax.random.key(0), data)
        return {name: _transform_of(trace[name], deviations).inv(v) for name, v in values.items()}

    def scales(self, key: jax.Array, data: Data) -> dict[str, Any]:
        """Return the means and standard deviations of normal variables, for a draw of the prior."""
        trace = self.trace({}, key, data)
        bases = {name: base_of(trace[name]["fn"]) for name in latent_in(trace)}
        return {name: (b.loc, b.scale) for name, b in bases.items() if isinstance(b, Normal)}

    def prior(self, key: jax.Array, data: Data) -> dict[str, Any]:
        """Draw the variables from the prior."""
        return self.prior_given({}, key, data)

    def prior_given(self, values: Mapping[str, Any], key: jax.Array, data: Data) -> dict[str, Any]:
        """Draw the variables from the prior given the values of some of them."""
        trace = self.trace(values, key, data)
        return {name: trace[name]["value"] for name in latent_in(trace)}

    def deterministic(
        self, values: Mapping[str, Any], key: jax.Array, data: Data
    ) -> dict[str, Any]:
        """Compute the sites of `numpyro.deterministic` at given values of the variables."""
        trace = self.trace(values, key, data)
        return {n: site["value"] for n, site in trace.items() if site["type"] == "deterministic"}

    def evaluate(self, values: Mapping[str, Any], key: jax.Array, data: Data) -> Outer:
        """Run the function with given values of some variables; draw the others from the prior.

        The result contains the log prior density of each element of each variable, in the shape of
        its plates, but no `log_p`.
        """
        trace = self.trace(values, key, data)
        rates: Any = trace[RATES]["fn"]
        log_prior = {
            name: trace[name]["fn"].log_prob(trace[name]["value"]) for name in latent_in(trace)
        }
        zero = jnp.zeros(())
        return Outer(
            zero, rates.space_with_resolution, rates.inputs, rates.theta, log_prior=log_prior
        )

    def space_and_inputs(
        self, values: Mapping[str, Any], key: jax.Array, data: Data
    ) -> tuple[StateSpace, Inputs]:
        """Return the state space, without noise of the resolution, and the inputs."""
        rates: Any = self.trace(values, key, data)[RATES]["fn"]
        return rates.space, rates.inputs

    def theta(self, values: Mapping[str, Any], key: jax.Array, data: Data) -> dict[str, Any]:
        """Return the hyperparameters of the effects; see `models.effects.Theta`."""
        rates: Any = self.trace(values, key, data)[RATES]["fn"]
        return rates.theta

    # --- compiled for draws ---

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
        if self.needs_observations:
            mapped = jax.jit(jax.vmap(lambda *draws: compute(*draws, data)))
            return lambda *draws: self._called(mapped, draws, data)

        features = data["features"]
        known = *key, features
        if known not in self.compiled:

            def of_arrays(*arguments: Any) -> Any:
                *draws, arrays = arguments
                return compute(*draws, {**arrays, "features": features})

            axes = (*(0,) * n_draw_axes, None)
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


def keys_of(n: int, seed: int) -> Any:
    """Return n random keys."""
    with own_settings():
        return jax.random.split(jax.random.key(seed), n)


def _transform_of(site: Mapping[str, Any], deviations: Collection[str]) -> Any:
    """Return the transform from unconstrained values to values of a variable.

    The values of `deviations` are those of normal variables, from their means and in units of their
    standard deviations.
    """
    if site["name"] in deviations:
        base = base_of(site["fn"])
        return AffineTransform(base.loc, base.scale)
    return biject_to(site["fn"].support)
