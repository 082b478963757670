"""NUTS on a trust model, as compiled programs that take missions and priors as data.

numpyro's functional sampler is called inside `jax.jit`, so that the next mission, or other numbers
in the priors, meet the compiled code of the last. The chains start around posterior modes, in
coordinates that the Hessian there makes standard normal (Laplace). Between a few draws and the next
the control is back in Python: for a bar, an estimate of the time, and Ctrl-C. A callback from
compiled code would keep the program out of JAX's cache on disk.
"""

import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax, random
from numpyro.infer.hmc import HMCState, hmc
from numpyro.infer.util import ParamInfo

from trustbo.inference.samplers.modes import Modes, find_modes
from trustbo.inference.samplers.reparam import Frame, Reparametrisation, reparametrise
from trustbo.inference.samplers.settings import NutsSettings
from trustbo.inference.samplers.target import NutsData, innovations_shape
from trustbo.inference.samplers.watching import SILENT, Watch
from trustbo.models.backend import own_settings
from trustbo.models.model import TrustModel
from trustbo.parallel import n_cores

_DRAWS_PER_UNKNOWN = 10  # of the warm-up, to learn a covariance from
_FIRST, _MOST = 1, 100
"""Draws between two readings of the clock: the first, and the largest."""
_SECONDS = 0.5
"""Target time between two readings of the clock, s."""


class NutsDraws(NamedTuple):
    """Draws and statistics, each with leading axes (chain, draw)."""

    params: dict[str, Array]
    stats: dict[str, np.ndarray]
    innovations: np.ndarray | None
    """Innovations of latent trust, (chain, draw, bound, mission, robot), if it was sampled."""
    linearisation: Array | None
    """Linearisation point, of families that have one."""
    theta: Array
    """Draws in the coordinates of the modes, (chain, draw, unknown)."""
    modes: Modes
    params_at_modes: dict[str, Array]


class Density(Protocol):
    """A log posterior density."""

    def potential(self, site: dict[str, Array]) -> Array:
        """Minus the log density of sites, `theta` among them."""
        ...


class Chain(NamedTuple):
    """Coordinates of a chain, standard normal around its mode; or of all, (chain, ...)."""

    mode: Array  # (unknown,)
    scale: Array  # (unknown, unknown)

    def theta(self, x: Array) -> Array:
        """Unknowns at standard coordinates."""
        return self.mode + self.scale @ x


class _Start(NamedTuple):
    """All chains before their first draw."""

    frame: Frame
    modes: Modes
    chains: Chain
    states: HMCState
    effect_keys: Array  # (chain,)


def run_nuts(
    settings: NutsSettings,
    key: Array,
    model: TrustModel,
    data: NutsData,
    *,
    complete: bool = False,
    watch: Watch = SILENT,
) -> NutsDraws:
    """Draw from a model's posterior; call it in a float64 scope.

    Args:
        settings: Length and adaptation settings of the run.
        key: Random key.
        model: Trust model; its priors are data, all else about it is compiled in.
        data: Missions.
        complete: Whether no rate is missing before the last of a mission.
        watch: Observer of the progress; the draws do not depend on it.
    """
    with watch.running(settings) as seen:
        length_free = settings._replace(draws=0)  # its programs serve any number of draws
        start = _begin(length_free, key, model, data, complete=complete)
        advance = partial(_advance, length_free._replace(n_chains=0), model, data, start.frame)
        of_chain = [
            jax.tree.map(lambda a, i=i: a[i], (start.chains, start.states))
            for i in range(settings.n_chains)
        ]
        go_on = [partial(advance, chain, complete=complete) for chain, _ in of_chain]
        z, stats = run_chains(settings, go_on, [state for _, state in of_chain], seen)
        finish = partial(_finish, length_free, model, data, complete=complete)
        theta, params, at_modes = finish(start, z["theta"])
    kept = z.get("innovations"), start.frame.linearisation
    return NutsDraws(params, stats, *kept, theta, start.modes, at_modes)


def run_chains(
    settings: NutsSettings,
    go_on: Sequence[Callable[[HMCState, int], Any]],
    states: Sequence[HMCState],
    seen: Watch,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Draws of z and statistics, each (chain, draw, ...), warm-up left out.

    Chains advance by as many draws each, on all cores. Vectorised, each step would take as long as
    the longest trajectory of all.
    """
    pieces, done, total, n = [], 0, settings.warmup + settings.draws, _FIRST

    def advance(step: Callable[[HMCState, int], Any], state: HMCState) -> tuple[HMCState, Any]:
        with own_settings():  # of each thread
            state, drawn = jax.block_until_ready(step(state, n))
        return state, jax.tree.map(lambda a: np.asarray(a)[:n], drawn)

    jax.block_until_ready(go_on[0](states[0], 0))  # compiled before the clock starts
    seen.compiled()
    with ThreadPoolExecutor(n_cores()) as pool:
        while done < total:
            started, n = time.perf_counter(), min(n, total - done)
            states, drawn = zip(*pool.map(advance, go_on, states), strict=True)
            pieces.append(jax.tree.map(lambda *a: np.stack(a), *drawn))
            seconds, done = time.perf_counter() - started, done + n
            seen.advanced(seconds, pieces[-1][1])
            n = min(max(int(n * _SECONDS / max(seconds, 1e-6)), 1), 2 * n, _MOST)
    return jax.tree.map(lambda *a: np.concatenate(a, axis=1)[:, settings.warmup :], *pieces)


@partial(jax.jit, static_argnames=("settings", "complete"))
def _begin(
    settings: NutsSettings, key: Array, model: TrustModel, data: NutsData, *, complete: bool
) -> _Start:
    """Find the modes, and start the chains around them."""
    target = _target(settings, model, data, None, complete=complete)
    joint, shape = not model.family.integrates_out, innovations_shape(data)
    zeros = {"innovations": jnp.zeros(shape)} if joint else {}

    def log_density(theta: Array) -> Array:
        return -target.potential({"theta": theta, **zeros})

    modes = find_modes(target.profile, log_density, target.starts, target.longest)
    chains = Chain(*modes.spread(settings.n_chains))

    def begin(inputs: tuple[Array, Chain]) -> tuple[HMCState, Array]:
        key, chain = inputs
        key_start, key_innovations, key_run = random.split(key, 3)
        # Overdispersed starts (1.5 Laplace sd), so that R-hat means something.
        z = {"theta": 1.5 * random.normal(key_start, chain.mode.shape, chain.mode.dtype)}
        if joint:
            z["innovations"] = random.normal(key_innovations, shape, chain.mode.dtype)
        state, _ = kernel(settings, target, chain, z, key_run)
        return state, random.fold_in(key, 3)

    states, effect_keys = lax.map(begin, (random.split(key, settings.n_chains), chains))
    return _Start(target.frame, modes, chains, states, effect_keys)


@partial(jax.jit, static_argnames=("settings", "complete"))
def _advance(
    settings: NutsSettings,
    model: TrustModel,
    data: NutsData,
    frame: Frame,
    chain: Chain,
    state: HMCState,
    n: int,
    *,
    complete: bool,
) -> tuple[HMCState, tuple[dict[str, Array], dict[str, Array]]]:
    """State after n more draws; and these, with their statistics, as the first of `_MOST` rows."""
    target = _target(settings, model, data, frame, complete=complete)
    return step_on(settings, target, chain, state, n)


def step_on(
    settings: NutsSettings,
    target: Density | Reparametrisation,
    chain: Chain,
    state: HMCState,
    n: Array | int,
    *,
    adapt: bool = True,
) -> tuple[HMCState, tuple[dict[str, Array], dict[str, Array]]]:
    """See `_advance`, of any density; `adapt` as in `kernel`."""
    info = ParamInfo(state.z, state.potential_energy, state.z_grad)  # costs no gradient
    _, step = kernel(settings, target, chain, info, state.rng_key, adapt=adapt)

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

    def advance(i, carry):
        state, kept = carry
        state = step(state)
        return state, jax.tree.map(lambda a, x: a.at[i].set(x), kept, row(state))

    kept = jax.tree.map(lambda x: jnp.zeros((_MOST, *x.shape), x.dtype), row(state))
    # Warm-up and draws in one loop: its body, which takes long to compile, is there once.
    return lax.fori_loop(0, n, advance, (state, kept))


@partial(jax.jit, static_argnames=("settings", "complete"))
def _finish(
    settings: NutsSettings,
    model: TrustModel,
    data: NutsData,
    start: _Start,
    x: np.ndarray,
    *,
    complete: bool,
) -> tuple[Array, dict[str, Array], dict[str, Array]]:
    """Draws in the coordinates of the modes, as parameters, and the parameters at the modes."""
    target = _target(settings, model, data, start.frame, complete=complete)

    def finish(inputs: tuple[Chain, Array, Array]) -> tuple[Array, dict[str, Array]]:
        chain, x, key = inputs
        theta = jax.vmap(chain.theta)(x)
        params = jax.vmap(target.constrain)(theta)
        if data.places is not None and model.family.integrates_out:
            keys = random.split(key, len(theta))
            params |= lax.map(lambda arguments: target.draw_effects(*arguments), (theta, keys))
        return theta, params

    theta, params = lax.map(finish, (start.chains, jnp.asarray(x), start.effect_keys))
    return theta, params, jax.vmap(target.constrain)(start.modes.mode)


def _target(
    settings: NutsSettings,
    model: TrustModel,
    data: NutsData,
    frame: Frame | None,
    *,
    complete: bool,
) -> Reparametrisation:
    care = {"complete": complete, "collapse": settings.collapse}
    return reparametrise(model, data, frame=frame, **care)


def kernel(
    settings: NutsSettings,
    target: Density | Reparametrisation,
    chain: Chain,
    z: dict[str, Array] | ParamInfo,
    key: Array,
    *,
    adapt: bool = True,
) -> tuple[HMCState, Callable[[HMCState], HMCState]]:
    """State of numpyro's NUTS at z, and its step from any state.

    `adapt`: whether warm-up learns a metric, if it is long enough.
    """

    # NUTS sees standard normal coordinates. With many unknowns it leaves them so: a covariance
    # learnt from the few hundred draws of a warm-up is then worse than Laplace's.
    def potential(z: dict[str, Array]) -> Array:
        return target.potential(z | {"theta": chain.theta(z["theta"])})

    sites = z.z if isinstance(z, ParamInfo) else z
    n_unknowns, joint = len(sites["theta"]), "innovations" in sites
    enough = _DRAWS_PER_UNKNOWN * n_unknowns <= settings.warmup
    # Innovations are close to standard normal by construction: their mass starts as the identity.
    mass = {("theta",): jnp.eye(n_unknowns)}
    if joint:
        mass[("innovations",)] = jnp.ones(math.prod(sites["innovations"].shape))
    init, step = hmc(potential, algo="NUTS")
    state = init(
        z,
        settings.warmup,
        step_size=0.5,
        inverse_mass_matrix=mass,
        dense_mass=[("theta",)],  # pyright: ignore[reportArgumentType]
        target_accept_prob=settings.target_accept,
        adapt_mass_matrix=joint or (adapt and enough),
        max_tree_depth=settings.max_tree_depth,
        rng_key=key,
    )
    return state, step
