"""Sampling of a NumPyro function with NUTS: one run of each chain, which can be continued.

The data, the starts of the chains, the step size and the mass matrix are arguments of the compiled
functions. A campaign, which fits after each mission, therefore compiles them again only when the
padded data grow.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpyro.infer.hmc import hmc

from trustbo.arrays import evenly_spaced
from trustbo.display import announced, slow_bar
from trustbo.errors import TrustboError
from trustbo.inference.diagnostics import FIELDS
from trustbo.inference.functions.coordinates import Coordinates
from trustbo.inference.functions.data import Data
from trustbo.inference.functions.explain import reason_of
from trustbo.inference.functions.function import FunctionModel
from trustbo.models.backend import own_settings

_CANDIDATES = 16
"""Number of candidates for the start of a chain; the first one with a density is chosen."""
_SMALLEST = 1e-12
"""Standard deviation by which coordinates that are constant are divided."""
_FIRST_STEP = 0.1
"""Initial step size of the warm-up."""
_MOST_DENSE = 50
"""Largest number of coordinates for which the mass matrix is dense."""
_RIDGE = 1e-3
"""Fraction of the variances that is added to the covariance of a start."""
_DEPTH = 7
"""Largest number of doublings of a trajectory, which then has 127 steps."""
_PART = 100
"""Number of draws that are compiled as one loop, after which progress is shown."""


class Start(NamedTuple):
    """Starts of the chains."""

    x: np.ndarray
    """Candidates, shape (chain, candidate, coordinate)."""
    inverse_mass: np.ndarray
    """Inverse mass matrix (coordinate, coordinate), or its diagonal (coordinate,)."""

    @classmethod
    def near(cls, x: np.ndarray, chains: int, seed: int) -> "Start":
        """Return a start from draws x (draw, coordinate) of a similar distribution."""
        rng = np.random.default_rng([seed, 1])

        # Each chain starts in its own part along the main axis, so that modes get chains.
        main = np.linalg.svd((x - x.mean(0)) / np.maximum(x.std(0), _SMALLEST), full_matrices=False)
        parts = np.array_split(np.argsort(main.U[:, 0], kind="stable"), chains)
        chosen = np.stack([x[rng.choice(part, _CANDIDATES)] for part in parts])

        variance = x.var(0)
        mass = variance
        if x.shape[1] <= _MOST_DENSE:
            mass = np.cov(x.T).reshape(x.shape[1], -1) + _RIDGE * np.diag(variance)
        return cls(chosen, mass)


class Samples(NamedTuple):
    """Draws of chains, and statistics of the sampler."""

    x: np.ndarray
    """Coordinates, shape (chain, draw, coordinate)."""
    fields: dict[str, np.ndarray]
    """Statistics (chain, draw) by NumPyro's names."""

    def some(self, draws: int) -> "Samples":
        """Return `draws` evenly spaced draws of each chain."""
        kept = evenly_spaced(self.x.shape[1], draws)
        fields = {name: values[:, kept] for name, values in self.fields.items()}
        return Samples(self.x[:, kept], fields)

    @property
    def points(self) -> np.ndarray:
        """Coordinates of all chains, shape (draw, coordinate)."""
        return self.x.reshape(-1, self.x.shape[2])


class Chains:
    """Chains of NUTS for a function and its data.

    Args:
        model: The function.
        coordinates: Its coordinates for these data.
        data: Inputs.
        warmup: Number of draws per chain that tune the kernel and are discarded.
        accept: Target of the acceptance probability.
        seed: Random seed.
        progress: Whether to show a progress bar, after 1.5 seconds.
    """

    def __init__(
        self,
        model: FunctionModel,
        coordinates: Coordinates,
        data: Data,
        *,
        warmup: int,
        accept: float,
        seed: int,
        progress: bool,
    ) -> None:
        self.model = model
        self.coordinates = coordinates
        self.data = data
        self.warmup = warmup
        self.accept = accept
        self.seed = seed
        self.progress = progress
        self._state: Any = None

    def run(self, start: Start, draws: int) -> Samples:
        """Start the chains; return the draws after the warm-up.

        Raises:
            TrustboError: If no candidate has a finite density, or a gradient is not finite.
        """
        n_chains = len(start.x)
        mass = np.broadcast_to(start.inverse_mass, (n_chains, *start.inverse_mass.shape))
        with own_settings(), announced("Compiling the model for NUTS (about 20 s at first use)."):
            keys = jax.random.key_data(jax.random.split(jax.random.key(self.seed), n_chains))
            begin = self._compiled("begin", self._begin, 3)
            self._state, has_density, has_slope = begin(np.asarray(keys), start.x, mass)

        if not np.all(has_density):
            raise TrustboError(
                f"{self.model.in_short()} has no finite density at the starts of the chains. Check "
                "that delta_w and delta_v are positive and that the drift is finite, also where an "
                "input such as duration or n_ticks is NaN (jnp.nan_to_num)."
            )
        if not np.all(has_slope):
            raise TrustboError(
                f"{self.model.in_short()} has a gradient that is not finite at the starts of the "
                "chains; check square roots, norms and powers of 0 and inverses of singular "
                "matrices, also in branches of jnp.where that are not used."
            )
        self._advance(self.warmup, "NUTS, warm-up")
        return self.proceed(draws)

    def proceed(self, draws: int) -> Samples:
        """Continue the chains; return the next draws."""
        return self._advance(draws, "NUTS")

    def _advance(self, draws: int, title: str) -> Samples:
        """Take draws in parts."""
        parts = []
        sizes = [_PART] * (draws // _PART) + [draws % _PART] * (draws % _PART > 0)
        with slow_bar(title, " draws", self.progress, total=draws) as bar:
            for n in sizes:
                advance = self._compiled(f"advance by {n}", partial(self._advanced, n=n), 1)
                self._state, x, fields = advance(self._state)
                parts.append(Samples(x, fields))
                bar.update(n)
        return joined_samples(parts)

    def _compiled(
        self, name: str, compute: Callable[..., Any], n_chain_axes: int
    ) -> Callable[..., Any]:
        """Return a function of states of chains, compiled for these data."""
        key = (name, self.coordinates.key, self.warmup, self.accept)
        return self.model.compiled_over_draws(key, compute, n_chain_axes, self.data)

    def _kernel(self, x: Any, mass: Any, key: Any, data: Data) -> tuple[Any, Callable[..., Any]]:
        """Return the state of a chain at x, and the function that moves a state."""
        begin, move = hmc(
            potential_fn=lambda x: -log_density_of(self.model, self.coordinates, x, data),
            algo="NUTS",
        )
        state = begin(
            x,
            num_warmup=self.warmup,
            step_size=_FIRST_STEP,
            inverse_mass_matrix=mass,
            dense_mass=self.coordinates.n <= _MOST_DENSE,
            target_accept_prob=self.accept,
            max_tree_depth=_DEPTH,
            rng_key=key,
        )
        return state, move

    def _begin(self, key: Any, candidates: Any, mass: Any, data: Data) -> tuple[Any, Any, Any]:
        """Start a chain at the first candidate that has a density.

        With the largest density instead, all chains would start at the same mode.
        """
        density = lax.map(
            lambda x: log_density_of(self.model, self.coordinates, x, data), candidates
        )
        chosen = jnp.argmax(jnp.isfinite(density))
        state, _ = self._kernel(candidates[chosen], mass, key, data)
        return state, jnp.isfinite(density[chosen]), jnp.isfinite(state.z_grad).all()

    def _advanced(self, state: Any, data: Data, *, n: int) -> tuple[Any, Any, Any]:
        """Take n draws of a chain; return its state, coordinates and statistics."""
        # NumPyro's kernel is made with its first state, which is not computed if it is not used.
        mass = jnp.eye(self.coordinates.n)
        if self.coordinates.n > _MOST_DENSE:
            mass = jnp.ones(self.coordinates.n)
        _, move = self._kernel(state.z, mass, state.rng_key, data)

        def one(state: Any, _: None) -> Any:
            state = move(state, (), {})
            return state, (state.z, {name: getattr(state, name) for name in FIELDS})

        last, (x, fields) = lax.scan(one, state, None, length=n)
        return last, x, fields


def log_density_of(model: FunctionModel, coordinates: Coordinates, x: Any, data: Data) -> Any:
    """Compute the log posterior density, up to a constant, at coordinates (coordinate,) in JAX."""
    z = coordinates.unconstrained(x)
    return coordinates.log_jacobian(x) - model.potential(z, data, coordinates.deviations)


def require_gradient(model: FunctionModel, coordinates: Coordinates, data: Data) -> None:
    """Raise TrustboError if JAX cannot differentiate the density of a function.

    The gradient is traced without computing anything.
    """

    def slope(x: Any) -> Any:
        return jax.grad(lambda x: log_density_of(model, coordinates, x, data))(x)

    try:
        with own_settings():
            jax.eval_shape(slope, np.zeros(coordinates.n))
    except TrustboError:
        raise
    except Exception as error:
        reason = reason_of(error).rstrip(".")
        raise TrustboError(
            f"{model.in_short()} has no gradient, which NUTS needs: {reason}. Use jax.lax.scan for "
            "loops, or jax.lax.fori_loop with constant bounds, and define the gradient of "
            "callbacks with jax.custom_jvp or jax.custom_vjp."
        ) from error


def joined_samples(runs: Sequence[Samples]) -> Samples:
    """Join draws that follow each other, chain by chain."""
    fields = {name: np.concatenate([run.fields[name] for run in runs], axis=1) for name in FIELDS}
    return Samples(np.concatenate([run.x for run in runs], axis=1), fields)
