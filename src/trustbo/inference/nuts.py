"""Chains of NumPyro's NUTS: one run of each chain, which can be continued.

`Chains` samples any log density that has a gradient in JAX. `sample_by_nuts` samples the posterior
of a model class. For Gaussian rates, coefficients and linear predictors are integrated out, and
NUTS samples only the scores of the hyperparameters, with differences of the density as slopes.
Chains start at points of the importance sampler, whose covariance is the mass matrix, so warm-up
tunes only the step size. For other families, EP only approximates the evidence, so NUTS samples
`model.program`, including coefficients and linear predictors.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from numpyro.infer import init_to_value
from numpyro.infer.hmc import hmc
from numpyro.infer.util import initialize_model

from trustbo.arrays import evenly_spaced
from trustbo.display import announced, slow_bar
from trustbo.errors import TrustboError
from trustbo.inference import importance
from trustbo.inference.class_target import ClassTarget
from trustbo.inference.density import JointDraws
from trustbo.inference.diagnostics import FIELDS, complaints_of, statistics_of
from trustbo.inference.modes import at_modes
from trustbo.models.backend import own_settings
from trustbo.streams import stream

MOST_DENSE = 50
"""Largest number of coordinates for which the mass matrix is dense."""
_STEP = 1e-5
"""Step of the differences in slopes, in scores."""
_CANDIDATES = 16
"""Number of candidates for the start of a chain; the first one with a density is chosen."""
_SMALLEST = 1e-12
"""Standard deviation by which coordinates that are constant are divided."""
_RIDGE = 1e-3
"""Fraction of the variances that is added to the covariance of a start."""
_PART = 50
"""Number of draws that are compiled as one loop, after which progress is shown."""
_POINTS = 2000
"""Number of points of the importance sampler from which NUTS of a model class starts."""


class Tuning(NamedTuple):
    """Settings of NUTS."""

    warmup: int
    """Number of draws per chain that tune the kernel and are discarded."""
    accept: float
    """Target of the acceptance probability."""
    depth: int = 7
    """Largest number of doublings of a trajectory, which then has 127 steps."""
    first_step: float = 0.1
    """Step size at the beginning of the warm-up."""
    of_mass: bool = True
    """Whether the warm-up also tunes the mass matrix."""


_OF_SCORES = Tuning(warmup=150, accept=0.75, depth=2, first_step=0.8, of_mass=False)
"""Settings for scores; three steps of 0.8 standard deviations cross the posterior."""
_SHORT_STEPS = _OF_SCORES._replace(accept=0.9, depth=3)
"""Settings for scores if the usual ones fail a check."""
_OF_PROGRAM = Tuning(warmup=300, accept=0.9, depth=10)
"""Settings for the full program of a model."""


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
        if x.shape[1] <= MOST_DENSE:
            mass = np.cov(x.T).reshape(x.shape[1], -1) + _RIDGE * np.diag(variance)
        return cls(chosen, mass)


class Samples(NamedTuple):
    """Draws of chains, and statistics of the sampler."""

    x: np.ndarray
    """Coordinates, shape (chain, draw, coordinate)."""
    fields: dict[str, np.ndarray]
    """Statistics (chain, draw) by NumPyro's names."""

    @classmethod
    def joined(cls, runs: Sequence["Samples"]) -> "Samples":
        """Join draws that follow each other, chain by chain."""
        fields = {name: np.concatenate([one.fields[name] for one in runs], 1) for name in FIELDS}
        return cls(np.concatenate([one.x for one in runs], axis=1), fields)

    def some(self, draws: int) -> "Samples":
        """Return `draws` evenly spaced draws of each chain."""
        kept = evenly_spaced(self.x.shape[1], draws)
        fields = {name: values[:, kept] for name, values in self.fields.items()}
        return Samples(self.x[:, kept], fields)

    @property
    def points(self) -> np.ndarray:
        """Coordinates of all chains, shape (draw, coordinate)."""
        return self.x.reshape(-1, self.x.shape[2])


LogDensity = Callable[[Any, Any], Any]
"""Log density, up to a constant, of coordinates (coordinate,) and data in JAX."""
Compiled = Callable[[tuple[Any, ...], Callable[..., Any], int], Callable[..., Any]]
"""Compiles a function, given what tells it from others, for arguments of which the first ones have
the axis (chain,), and the last one is the data; the compiled function takes the first ones."""


def compiled_with(compute: Callable[..., Any], n_chain_axes: int, data: Any) -> Callable[..., Any]:
    """Compile a function for these data only; see `Compiled`."""
    mapped = jax.jit(jax.vmap(lambda *of_chain: compute(*of_chain, data)))

    def call(*of_chains: Any) -> Any:
        with own_settings():
            return jax.tree.map(np.asarray, mapped(*of_chains))

    return call


class Chains:
    """Chains of NUTS for a log density.

    The starts of the chains, the step size and the mass matrix are arguments of the compiled
    functions. A campaign, which fits after each mission, therefore compiles those of a NumPyro
    function again only when the padded data grow.

    Args:
        log_density: The log density.
        compiled: Compiles functions of chains.
        tuning: Settings.
        who: The model, for messages.
        seed: Random seed.
        progress: Whether to show a progress bar, after 1.5 seconds.
    """

    def __init__(
        self,
        log_density: LogDensity,
        compiled: Compiled,
        tuning: Tuning,
        *,
        who: str,
        seed: int,
        progress: bool,
    ) -> None:
        self.log_density = log_density
        self.tuning = tuning
        self.who = who
        self.seed = seed
        self.progress = progress
        self._compile = compiled
        self._compiled: dict[str, Callable[..., Any]] = {}
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
            begin = self._of_chains("begin", self._begin, 3)
            self._state, has_density, has_slope = begin(np.asarray(keys), start.x, mass)

        if not np.all(has_density):
            raise TrustboError(
                f"{self.who} has no finite density at the starts of the chains. Check "
                "that delta_w and delta_v are positive and that the drift is finite, also where an "
                "input such as duration or n_ticks is NaN (jnp.nan_to_num)."
            )
        if not np.all(has_slope):
            raise TrustboError(
                f"{self.who} has a gradient that is not finite at the starts of the "
                "chains; check square roots, norms and powers of 0 and inverses of singular "
                "matrices, also in branches of jnp.where that are not used."
            )
        self._advance(self.tuning.warmup, "NUTS, warm-up")
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
                advance = self._of_chains(f"advance by {n}", partial(self._advanced, n=n), 1)
                self._state, x, fields = advance(self._state)
                parts.append(Samples(x, fields))
                bar.update(n)
        return Samples.joined(parts)

    def _of_chains(
        self, name: str, compute: Callable[..., Any], n_chain_axes: int
    ) -> Callable[..., Any]:
        """Return a function of states of chains, compiled for these data."""
        if name not in self._compiled:
            key = name, self.tuning
            self._compiled[name] = self._compile(key, compute, n_chain_axes)
        return self._compiled[name]

    def _kernel(self, x: Any, mass: Any, key: Any, data: Any) -> tuple[Any, Callable[..., Any]]:
        """Return the state of a chain at x, and the function that moves a state."""
        begin, move = hmc(potential_fn=lambda x: -self.log_density(x, data), algo="NUTS")
        state = begin(
            x,
            num_warmup=self.tuning.warmup,
            step_size=self.tuning.first_step,
            inverse_mass_matrix=mass,
            dense_mass=mass.ndim == 2,
            adapt_mass_matrix=self.tuning.of_mass,
            target_accept_prob=self.tuning.accept,
            max_tree_depth=self.tuning.depth,
            rng_key=key,
        )
        return state, move

    def _begin(self, key: Any, candidates: Any, mass: Any, data: Any) -> tuple[Any, Any, Any]:
        """Start a chain at the first candidate that has a density.

        With the largest density instead, all chains would start at the same mode.
        """
        density = lax.map(lambda x: self.log_density(x, data), candidates)
        chosen = jnp.argmax(jnp.isfinite(density))
        state, _ = self._kernel(candidates[chosen], mass, key, data)
        return state, jnp.isfinite(density[chosen]), jnp.isfinite(state.z_grad).all()

    def _advanced(self, state: Any, data: Any, *, n: int) -> tuple[Any, Any, Any]:
        """Take n draws of a chain; return its state, coordinates and statistics."""
        # NumPyro's kernel is made with its first state, which is not computed if it is not used.
        mass = state.adapt_state.inverse_mass_matrix
        _, move = self._kernel(state.z, mass, state.rng_key, data)

        def one(state: Any, _: None) -> Any:
            state = move(state, (), {})
            return state, (state.z, {name: getattr(state, name) for name in FIELDS})

        last, (x, fields) = lax.scan(one, state, None, length=n)
        return last, x, fields


def sample_by_nuts(
    target: ClassTarget,
    *,
    chains: int,
    draws: int,
    warmup: int | None,
    seed: int,
    progress: bool = True,
) -> tuple[JointDraws, dict[str, np.ndarray], dict[str, Any], list[str]]:
    """Sample the posterior of a model class.

    Args:
        target: Posterior of a model given missions.
        chains: Number of chains.
        draws: Number of draws per chain.
        warmup: Number of warm-up draws per chain. The default is 150 for Gaussian rates, for which
            only the step size is tuned, and 300 otherwise.
        seed: Random seed.
        progress: Whether to show a progress bar.

    Returns:
        Draws with chains joined, statistics (draw,) by name, diagnostics and a list of failed
        checks.
    """
    rng = stream(seed, "nuts")
    origin = at_modes(target.log_density, target.start()[None])
    points = importance.sample(target.log_density, origin, rng, defensive=target.defensive).points
    z = points.x[points.resample(_POINTS, rng)]

    tunings = [_OF_SCORES, _SHORT_STEPS] if target.is_gaussian else [_OF_PROGRAM]
    if warmup is not None:
        tunings = [tuning._replace(warmup=warmup) for tuning in tunings]
    if target.is_gaussian:
        log_density = in_jax(lambda z, _: z, target.log_density)
        start = Start.near(z, chains, seed)
        constrain = target.scores.values
    else:
        log_density, start, constrain = _program(target, z, chains, seed)

    who = type(target.model).__name__
    while True:
        tuning = tunings.pop(0)
        sampler = Chains(
            log_density, lambda _, compute, n: compiled_with(compute, n, None), tuning,
            who=who, seed=seed, progress=progress,
        )  # fmt: skip
        samples = sampler.run(start, draws)
        found = constrain(samples.points)
        values = {name: found[name] for name in target.scores.priors}
        by_chain = {name: v.reshape(chains, draws, *v.shape[1:]) for name, v in values.items()}
        summary, complaints = complaints_of(by_chain, samples.fields["diverging"])
        if not complaints or not tunings:
            break

    theta = target.model.theta(values, target.observations.resolution)
    c = target.draw_coefficients(theta, rng) if target.is_gaussian else found["coefficients"]
    statistics = statistics_of({n: v.reshape(-1) for n, v in samples.fields.items()})
    return JointDraws(theta, c), statistics, summary, complaints


def in_jax(
    prepare: Callable[[Any, Any], Any], log_density: Callable[[Any], np.ndarray]
) -> LogDensity:
    """Return a log density in JAX, up to a constant, part of which NumPy computes.

    Its gradient is that of differences; NUTS samples the exact density for any approximation of it.
    Where the density is 0, or its gradient is not finite, both are those of density 0.

    Numbers are passed as pairs of integers: callbacks run in threads of JAX without the setting of
    `own_settings`, in which JAX would round them to single precision.

    Args:
        prepare: Computes arrays for coordinates (coordinate,) and data, in JAX.
        log_density: Computes the log density (point,) for the same arrays with the axis (point,),
            in NumPy; JAX must not be used here, where it may wait for itself.
    """

    def of_data(x: Any, data: Any) -> Any:
        def found(x: Any) -> tuple[Any, Any]:
            steps = _STEP * jnp.vstack([jnp.zeros(len(x)), jnp.eye(len(x))])
            arrays = jax.vmap(lambda x: prepare(x, data))(x + steps)
            n_axes = [jnp.ndim(array) for array in jax.tree.leaves(arrays)]

            def on_bits(bits: Any) -> np.ndarray:
                leaves, form = jax.tree.flatten(bits)
                of_chains = [np.asarray(leaf).view(np.float64)[..., 0] for leaf in leaves]
                more = of_chains[0].ndim - n_axes[0]  # axes that `jax.vmap` has added
                shape = of_chains[0].shape[: more + 1]
                flat = [array.reshape(-1, *array.shape[more + 1 :]) for array in of_chains]
                log_p = log_density(jax.tree.unflatten(form, flat))
                return log_p.reshape(*shape, 1).view(np.uint32)

            bits = jax.pure_callback(
                on_bits,
                jax.ShapeDtypeStruct((len(x) + 1, 2), np.uint32),
                jax.tree.map(lambda array: lax.bitcast_convert_type(array, np.uint32), arrays),
                vmap_method="broadcast_all",
            )
            log_p = lax.bitcast_convert_type(bits, np.float64)
            slopes = (log_p[1:] - log_p[0]) / _STEP
            is_finite = jnp.isfinite(log_p).all()
            return jnp.where(is_finite, log_p[0], -jnp.inf), jnp.where(is_finite, slopes, 0.0)

        with_slopes = jax.custom_vjp(lambda x: found(x)[0])
        with_slopes.defvjp(found, lambda slopes, slope: (slope * slopes,))
        return with_slopes(x)

    return of_data


def _program(
    target: ClassTarget, z: np.ndarray, chains: int, seed: int
) -> tuple[LogDensity, Start, Callable[[np.ndarray], dict[str, np.ndarray]]]:
    """Prepare the model's program for `Chains`.

    Returns:
        The log density in unconstrained coordinates, a start at the median of scores z (point,
        score), and the conversion of coordinates (draw, coordinate) to values (draw, ...) of sites.
    """

    def program() -> None:
        target.model.program(target.observations)

    with own_settings():
        values = target.scores.values(z)
        center = {name: jnp.asarray(np.median(v, axis=0)) for name, v in values.items()}
        keys = jax.random.split(jax.random.key(seed), chains)
        found = initialize_model(keys, program, init_strategy=init_to_value(values=center))
        of_chains: Any = found.param_info.z
        x = np.asarray(jax.vmap(lambda free: ravel_pytree(free)[0])(of_chains))
        unravel = ravel_pytree(jax.tree.map(lambda v: v[0], of_chains))[1]

    def constrain(x: np.ndarray) -> dict[str, np.ndarray]:
        with own_settings():
            of_sites = jax.vmap(lambda one: found.postprocess_fn(unravel(one)))(x)
            return jax.tree.map(np.asarray, of_sites)

    def log_density(x: Any, data: None) -> Any:
        return -found.potential_fn(unravel(x))

    return log_density, Start(x[:, None], np.ones(x.shape[1])), constrain
