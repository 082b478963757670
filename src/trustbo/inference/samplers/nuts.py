"""NUTS on any log posterior density, as compiled programs that take the density as data.

numpyro's functional sampler is called inside `jax.jit`, so that the next mission, or other numbers
in the priors, meet the compiled code of the last. A chain samples coordinates that a mean and a
covariance make about standard normal. Between a few draws and the next the control is back in
Python: for a bar, an estimate of the time, and Ctrl-C. A callback from compiled code would keep the
program out of JAX's cache on disk.
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, ClassVar, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax, random
from numpyro.infer.hmc import HMCState, hmc
from numpyro.infer.util import ParamInfo

from trustbo.inference.samplers.settings import NutsSettings
from trustbo.inference.samplers.watching import Watch
from trustbo.models.backend import own_settings
from trustbo.parallel import n_cores

_DRAWS_PER_UNKNOWN = 10  # of the warm-up, to learn a covariance from
_FIRST, _MOST = 1, 100
"""Draws between two readings of the clock: the first, and the largest."""
_SECONDS = 0.5
"""Target time between two readings of the clock, s."""


class Density(Protocol):
    """A log posterior density, a pytree."""

    learns: ClassVar[bool]
    """Whether warm-up learns a metric, if it is long enough; else that of `Chain` is good."""

    def potential(self, site: dict[str, Array]) -> Array:
        """Minus the log density of the sites, `theta`."""
        ...


class Chain(NamedTuple):
    """Coordinates of a chain, about standard normal."""

    center: Array  # (unknown,)
    scale: Array  # (unknown, unknown)

    def theta(self, x: Array) -> Array:
        """Unknowns at coordinates."""
        return self.center + self.scale @ x


def run_nuts(
    settings: NutsSettings,
    seed: int,
    density: Density,
    chain: Chain,
    starts: Sequence[dict[str, Any] | ParamInfo],
    watch: Watch,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Draws of the coordinates and statistics, each (chain, draw, ...); in a float64 scope.

    Chains advance by as many draws each, on all cores. Vectorised, each step would take as long as
    the longest trajectory of all.

    Args:
        settings: Length and adaptation settings of the run.
        seed: Seed; the same seed gives the same draws.
        density: Density of the unknowns.
        chain: Coordinates that are sampled.
        starts: Coordinates at which each chain starts, perhaps with their slope.
        watch: Observer of the progress; the draws do not depend on it.
    """
    length_free = settings._replace(draws=0, n_chains=0)  # its programs serve any number of draws
    keys = random.split(random.key(seed), len(starts))
    density, chain = jax.device_put((density, chain))  # once, not for each call
    with watch.running(settings) as seen:
        states = [
            begin(length_free, density, chain, start, key)
            for start, key in zip(starts, keys, strict=True)
        ]
        go_on = partial(advance, length_free, density, chain)
        return _run_chains(settings, go_on, states, seen)


def _run_chains(
    settings: NutsSettings,
    go_on: Callable[[HMCState, int], Any],
    states: Sequence[HMCState],
    seen: Watch,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Draws of z and statistics, each (chain, draw, ...), warm-up left out."""
    pieces, done, total, n = [], 0, settings.warmup + settings.draws, _FIRST

    def step(state: HMCState) -> tuple[HMCState, Any]:
        with own_settings():  # of each thread
            state, drawn = jax.block_until_ready(go_on(state, n))
        return state, jax.tree.map(lambda a: np.asarray(a)[:n], drawn)

    jax.block_until_ready(go_on(states[0], 0))  # compiled before the clock starts
    seen.compiled()
    with ThreadPoolExecutor(n_cores()) as pool:
        while done < total:
            started, n = time.perf_counter(), min(n, total - done)
            states, drawn = zip(*pool.map(step, states), strict=True)
            pieces.append(jax.tree.map(lambda *a: np.stack(a), *drawn))
            seconds, done = time.perf_counter() - started, done + n
            seen.advanced(seconds, pieces[-1][1])
            n = min(max(int(n * _SECONDS / max(seconds, 1e-6)), 1), 2 * n, _MOST)
    return jax.tree.map(lambda *a: np.concatenate(a, axis=1)[:, settings.warmup :], *pieces)


@partial(jax.jit, static_argnames="settings")
def begin(
    settings: NutsSettings,
    density: Density,
    chain: Chain,
    start: dict[str, Array] | ParamInfo,
    key: Array,
) -> HMCState:
    """State of a chain before its first draw."""
    return _kernel(settings, density, chain, start, key)[0]


@partial(jax.jit, static_argnames="settings")
def advance(
    settings: NutsSettings, density: Density, chain: Chain, state: HMCState, n: Array | int
) -> tuple[HMCState, tuple[dict[str, Array], dict[str, Array]]]:
    """State after n more draws; and these, with their statistics, as the first of `_MOST` rows."""
    info = ParamInfo(state.z, state.potential_energy, state.z_grad)  # costs no gradient
    _, step = _kernel(settings, density, chain, info, state.rng_key)

    def row(state: HMCState) -> tuple[dict[str, Array], dict[str, Array]]:
        stats = {
            "lp": -state.potential_energy,
            "energy": state.energy,
            "diverging": state.diverging,
            "n_steps": state.num_steps,
            "acceptance_rate": state.accept_prob,
            "step_size": state.adapt_state.step_size,
        }
        return state.z, stats

    def one(i, carry):
        state, kept = carry
        state = step(state)
        return state, jax.tree.map(lambda a, x: a.at[i].set(x), kept, row(state))

    kept = jax.tree.map(lambda x: jnp.zeros((_MOST, *x.shape), x.dtype), row(state))
    # Warm-up and draws in one loop: its body, which takes long to compile, is there once.
    return lax.fori_loop(0, n, one, (state, kept))


def _kernel(
    settings: NutsSettings,
    density: Density,
    chain: Chain,
    z: dict[str, Array] | ParamInfo,
    key: Array,
) -> tuple[HMCState, Callable[[HMCState], HMCState]]:
    """State of numpyro's NUTS at z, and its step from any state."""

    # NUTS sees standard normal coordinates. With many unknowns it leaves them so: a covariance
    # learnt from the few hundred draws of a warm-up is then worse than Laplace's.
    def potential(z: dict[str, Array]) -> Array:
        return density.potential(z | {"theta": chain.theta(z["theta"])})

    sites = z.z if isinstance(z, ParamInfo) else z
    n_unknowns = len(sites["theta"])
    enough = _DRAWS_PER_UNKNOWN * n_unknowns <= settings.warmup
    init, step = hmc(potential, algo="NUTS")
    state = init(
        z,
        settings.warmup,
        step_size=0.5,
        inverse_mass_matrix={("theta",): jnp.eye(n_unknowns)},
        dense_mass=[("theta",)],  # pyright: ignore[reportArgumentType]
        target_accept_prob=settings.target_accept,
        adapt_mass_matrix=density.learns and enough,
        max_tree_depth=settings.max_tree_depth,
        rng_key=key,
    )
    return state, step
