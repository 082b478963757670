"""Sampling of a NumPyro function with NUTS, compiled once for each shape of data.

The data, the starts of the chains, the step size and the mass matrix are arguments of the compiled
function. A campaign, which fits after each mission, therefore compiles it again only when the
padded data grow. Chains start from draws of the previous posterior, if there is one.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from numpyro.infer.hmc import hmc

from trustbo.display import announced, refreshing, slow_bar
from trustbo.errors import TrustboError
from trustbo.inference.diagnostics import FIELDS
from trustbo.inference.functions.data import Data, arrays_of
from trustbo.inference.functions.explain import explained, reason_of
from trustbo.inference.functions.function import FunctionModel
from trustbo.inference.functions.sites import Site
from trustbo.models.backend import own_settings

_CANDIDATES = 16
"""Number of candidates for the start of a chain; the one with the largest density is chosen."""
_RADIUS = 2.0
"""Candidates are uniform in (-2, 2) in unconstrained space, as in Stan and NumPyro."""
_FIRST_STEP = 0.1
"""Initial step size of the warm-up if there is no previous posterior."""
_MOST_DENSE = 50
"""Largest number of coordinates for which the mass matrix is dense."""
_RIDGE = 1e-3
"""Fraction of the variances that is added to the covariance of a previous posterior."""
_DEPTH = 7
"""Largest number of doublings of a trajectory, which then has 127 steps."""


class Start(NamedTuple):
    """Starts of the chains."""

    x: np.ndarray
    """Candidates, shape (chain, candidate, coordinate)."""
    step_size: float
    inverse_mass: np.ndarray
    """Inverse mass matrix (coordinate, coordinate), or its diagonal (coordinate,)."""


class Samples(NamedTuple):
    """Draws of a chain in unconstrained space, and statistics of the sampler."""

    z: dict[str, np.ndarray]
    """Values (chain, draw, ...) of the variables in unconstrained space."""
    fields: dict[str, np.ndarray]
    """Statistics (chain, draw) by NumPyro's names."""
    step_size: float
    """Mean step size after warm-up."""

    def some(self, draws: int) -> "Samples":
        """Return `draws` evenly spaced draws of each chain."""
        n = self.fields["diverging"].shape[1]
        kept = np.linspace(0, n - 1, min(draws, n)).astype(int)
        return Samples(
            {name: values[:, kept] for name, values in self.z.items()},
            {name: values[:, kept] for name, values in self.fields.items()},
            self.step_size,
        )


class Sampler:
    """NUTS for a function, compiled for each number of draws and each shape of data."""

    def __init__(self, model: FunctionModel) -> None:
        self.model = model
        self._compiled: dict[Any, Callable[..., Any]] = {}
        self._has_gradient = False  # whether it was checked

    @property
    def n_compiled(self) -> int:
        """Number of compilations so far."""
        return sum(run._cache_size() for run in self._compiled.values())  # pyright: ignore[reportFunctionMemberAccess]

    def require_gradient(self, data: Data, sites: Mapping[str, Site]) -> None:
        """Raise TrustboError if JAX cannot differentiate the density of the function.

        The gradient is traced, once for each function, without computing anything.
        """
        if self._has_gradient:
            return

        def slope(z: dict[str, Any], arrays: Data) -> Any:
            return jax.grad(self.model.potential)(z, self._inputs(data, arrays))

        try:
            with own_settings():
                jax.eval_shape(slope, free_shapes(self.model, sites, data), self._arrays(data))
        except TrustboError:
            raise
        except Exception as error:
            reason = reason_of(error).rstrip(".")
            raise TrustboError(
                f"{self.model.in_short()} has no gradient, which NUTS needs: {reason}. Use "
                "jax.lax.scan for loops, or jax.lax.fori_loop with constant bounds, and define the "
                "gradient of callbacks with jax.custom_jvp or jax.custom_vjp."
            ) from error
        self._has_gradient = True

    def _arrays(self, data: Data) -> dict[str, Any]:
        """Return the inputs that are arguments of compiled functions."""
        if self.model.needs_observations:
            return {}
        given = arrays_of(data)
        return {n: jnp.asarray(v) for n, v in given.items() if n in self.model.inputs}

    def _inputs(self, data: Data, arrays: Data) -> Data:
        """Return all inputs, given those that are arguments of a compiled function."""
        return data if self.model.needs_observations else {**arrays, "features": data["features"]}

    def sample(
        self,
        data: Data,
        sites: Mapping[str, Site],
        start: Start,
        warmup: int,
        draws: int,
        *,
        accept: float,
        seed: int,
        progress: bool,
        title: str = "NUTS",
    ) -> Samples:
        """Sample from the posterior.

        Args:
            data: Padded data.
            sites: Variables of the function for these data.
            start: Starts of the chains, initial step size and mass matrix.
            warmup: Number of draws per chain that tune the kernel and are discarded.
            draws: Number of draws per chain.
            accept: Target of the acceptance probability.
            seed: Random seed.
            progress: Whether to show the elapsed seconds, after 2 seconds.
            title: Text to show before the elapsed seconds.

        Raises:
            TrustboError: If no candidate has a finite density.
        """
        with (
            own_settings(),
            announced("Compiling the model and sampling (about 30 s at first use)."),
            slow_bar(title, " s", progress) as bar,
            refreshing(bar, step=1),
        ):
            free = free_shapes(self.model, sites, data)
            unravel = ravel_pytree(free)[1]
            run = self._run_of(free, unravel, warmup, draws, data)

            arrays = self._arrays(data)
            keys = jax.random.split(jax.random.key(seed), len(start.x))
            with explained(self.model.in_short(), data):
                found = run(keys, start.x, start.step_size, start.inverse_mass, accept, arrays)
                x, fields, step_size, has_slope = jax.tree.map(np.asarray, found)
            z = jax.tree.map(np.asarray, jax.vmap(jax.vmap(unravel))(x))

        if not np.isfinite(fields["potential_energy"]).all():
            raise TrustboError(
                f"{self.model.in_short()} has no finite density at the starts of the chains. Check "
                "that delta_w and delta_v are positive and that the drift is finite, also where an "
                "input such as duration or n_ticks is NaN (jnp.nan_to_num)."
            )
        if not has_slope.all():
            raise TrustboError(
                f"{self.model.in_short()} has a gradient that is not finite at the starts of the "
                "chains; check square roots, norms and powers of 0 and inverses of singular "
                "matrices, also in branches of jnp.where that are not used."
            )
        return Samples(z, fields, float(step_size.mean()))

    def _run_of(
        self,
        free: Mapping[str, Any],
        unravel: Callable[..., Any],
        warmup: int,
        draws: int,
        data: Data,
    ) -> Callable[..., Any]:
        """Return the compiled function that runs the chains."""
        shapes = tuple((name, np.shape(values)) for name, values in free.items())
        fixed = id(data["observations"]) if self.model.needs_observations else None
        features = data["features"]
        known = (shapes, warmup, draws, features, fixed)
        if known in self._compiled:
            return self._compiled[known]

        n = sum(int(np.prod(shape)) for _, shape in shapes)

        def potential_of(arrays: Data) -> Callable[[Any], Any]:
            given = self._inputs(data, arrays)
            return lambda x: self.model.potential(unravel(x), given)

        def chain(
            key: Any, candidates: Any, step_size: Any, mass: Any, accept: Any, arrays: Any
        ) -> Any:
            density = lax.map(potential_of(arrays), candidates)
            chosen = jnp.argmin(jnp.where(jnp.isfinite(density), density, jnp.inf))

            begin, move = hmc(potential_fn_gen=potential_of, algo="NUTS")
            state = begin(
                candidates[chosen],
                num_warmup=warmup,
                step_size=step_size,
                inverse_mass_matrix=mass,
                dense_mass=n <= _MOST_DENSE,
                target_accept_prob=accept,
                max_tree_depth=_DEPTH,
                model_args=(arrays,),
                rng_key=key,
            )
            has_slope = jnp.isfinite(state.z_grad).all()

            def one(state: Any, _: None) -> Any:
                state = move(state, (arrays,), {})
                return state, (state.z, {name: getattr(state, name) for name in FIELDS})

            last, (x, fields) = lax.scan(one, state, None, length=warmup + draws)
            kept = {name: values[warmup:] for name, values in fields.items()}
            return x[warmup:], kept, last.adapt_state.step_size, has_slope

        run = jax.jit(jax.vmap(chain, in_axes=(0, 0, None, None, None, None)))
        if fixed is not None:  # drop the code that was compiled for the data of earlier fits
            for key in [key for key in self._compiled if key[-1] != fixed]:
                self._compiled.pop(key, None)
        self._compiled[known] = run
        return run


def free_shapes(model: FunctionModel, sites: Mapping[str, Site], data: Data) -> dict[str, Any]:
    """Return zeros of the shape of each variable in unconstrained space."""

    def run(key: jax.Array) -> dict[str, Any]:
        values = model.prior(key, data)
        return model.unconstrain({name: values[name] for name in sites}, data)

    shapes = jax.eval_shape(run, jax.random.key(0))
    return {name: np.zeros(shapes[name].shape) for name in sorted(sites)}


def coordinates_of(z: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return values (chain, draw, ...) in unconstrained space as an array (point, coordinate)."""
    parts = [np.reshape(z[name], (z[name].shape[0] * z[name].shape[1], -1)) for name in sorted(z)]
    return np.concatenate(parts, axis=1)


def joined_samples(runs: Sequence[Samples]) -> Samples:
    """Join the draws of runs, chain by chain."""
    names = runs[0].z
    fields = runs[0].fields
    return Samples(
        {name: np.concatenate([run.z[name] for run in runs], axis=1) for name in names},
        {name: np.concatenate([run.fields[name] for run in runs], axis=1) for name in fields},
        runs[-1].step_size,
    )


def cold_start(n: int, chains: int, seed: int) -> Start:
    """Return a start without a previous posterior, for n coordinates."""
    rng = np.random.default_rng([seed, 1])
    x = rng.uniform(-_RADIUS, _RADIUS, (chains, _CANDIDATES, n))
    mass = np.eye(n) if n <= _MOST_DENSE else np.ones(n)
    return Start(x, _FIRST_STEP, mass)


def warm_start(x: np.ndarray, step_size: float, chains: int, seed: int) -> Start:
    """Return a start from draws x (draw, coordinate) of a previous posterior."""
    rng = np.random.default_rng([seed, 1])
    chosen = x[rng.integers(len(x), size=(chains, _CANDIDATES))]

    variance = x.var(0)
    mass = variance
    if x.shape[1] <= _MOST_DENSE:
        mass = np.cov(x.T).reshape(x.shape[1], -1) + _RIDGE * np.diag(variance)
    return Start(chosen, step_size, mass)
