"""NUTS on a trust model, as one compiled program that takes missions and priors as data.

numpyro's functional sampler is called inside a single `jax.jit`, so that the next mission, or
other numbers in the priors, meet the compiled code of the last. The chains start around posterior
modes, in coordinates that the Hessian there makes standard normal (Laplace).
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
from jax import Array, lax, random
from numpyro.infer.hmc import hmc

from trustbo.errors import require_whole
from trustbo.models.model import TrustModel
from trustbo.models.samplers.modes import Modes, find_modes
from trustbo.models.samplers.reparam import reparametrise
from trustbo.models.samplers.target import NutsData, innovations_shape

_DRAWS_PER_UNKNOWN = 10  # of the warm-up, to learn a covariance from


class NutsSettings(NamedTuple):
    """Length and care of a NUTS run."""

    n_warmup: int = 300
    n_draws: int = 1000
    n_chains: int = 4
    target_accept: float = 0.9
    collapse: bool = False
    """Collapse the pooled model's weights and intercept: slower, but no funnel for few data."""

    def checked(self) -> Self:
        """Return the settings with numbers that are whole; TrustboError if one is not."""
        return self._replace(
            n_warmup=require_whole("n_warmup", self.n_warmup, 0),
            n_draws=require_whole("n_draws", self.n_draws, 1),
            n_chains=require_whole("n_chains", self.n_chains, 1),
        )


class NutsDraws(NamedTuple):
    """Draws and statistics, each with leading axes (chain, draw)."""

    params: dict[str, Array]
    stats: dict[str, Array]
    innovations: Array | None
    """Innovations of latent trust, (chain, draw, bound, mission, robot), if it was sampled."""
    linearisation: Array | None
    """Linearisation point, of families that have one."""
    theta: Array
    """Draws in the coordinates of the modes, (chain, draw, unknown)."""
    modes: Modes
    params_at_modes: dict[str, Array]


@partial(jax.jit, static_argnames=("settings", "complete"))
def run_nuts(
    settings: NutsSettings,
    key: Array,
    model: TrustModel,
    data: NutsData,
    *,
    complete: bool = False,
) -> NutsDraws:
    """Draw from a model's posterior; call it in a float64 scope.

    Args:
        settings: Length and care of the run.
        key: Random key.
        model: Trust model; its priors are data, all else about it is compiled in.
        data: Missions.
        complete: Whether no rate is missing before the last of a mission.
    """
    target = reparametrise(model, data, complete=complete, collapse=settings.collapse)
    joint, shape = not model.family.integrates_out, innovations_shape(data)
    zeros = {"innovations": jnp.zeros(shape)} if joint else {}

    def log_density(theta: Array) -> Array:
        return -target.potential({"theta": theta, **zeros})

    modes = find_modes(target.profile, log_density, target.starts, target.longest)
    n_unknowns = target.starts.shape[1]

    # Innovations are close to standard normal by construction: their mass starts as the identity.
    mass = {("theta",): jnp.eye(n_unknowns)}
    if joint:
        mass[("innovations",)] = jnp.ones(math.prod(shape))

    adapt = joint or _DRAWS_PER_UNKNOWN * n_unknowns <= settings.n_warmup

    def chain(inputs: tuple[Array, Array, Array]):
        key, mode, scale = inputs

        # NUTS sees standard normal coordinates. With many unknowns it leaves them so: a covariance
        # learnt from the few hundred draws of a warm-up is then worse than Laplace's.
        def theta_of(x: Array) -> Array:
            return mode + scale @ x

        def potential(z: dict[str, Array]) -> Array:
            return target.potential(z | {"theta": theta_of(z["theta"])})

        key_start, key_innovations, key_run = random.split(key, 3)
        key_effects = random.fold_in(key, 3)
        # Overdispersed starts (1.5 Laplace sd), so that R-hat means something.
        z = {"theta": 1.5 * random.normal(key_start, mode.shape, mode.dtype)}
        if joint:
            z["innovations"] = random.normal(key_innovations, shape, mode.dtype)
        z, stats = _run_chain(settings, potential, z, mass, adapt, key_run)
        theta = jax.vmap(theta_of)(z["theta"])
        params = jax.vmap(target.constrain)(theta)
        if data.places is not None and not joint:
            keys = random.split(key_effects, settings.n_draws)
            params["place_unit"] = lax.map(lambda of: target.draw_effects(*of), (theta, keys))
        return params, stats, z.get("innovations"), theta

    # One chain after the other: vectorised chains would all wait for the longest trajectory.
    keys = random.split(key, settings.n_chains)
    params, stats, drawn, theta = lax.map(chain, (keys, *modes.spread(settings.n_chains)))
    at_modes = jax.vmap(target.constrain)(modes.mode)
    return NutsDraws(params, stats, drawn, target.linearisation, theta, modes, at_modes)


def _run_chain(
    settings: NutsSettings,
    potential: Callable[[dict[str, Array]], Array],
    z: dict[str, Array],
    mass: dict[tuple[str], Array],
    adapt: bool,
    key: Array,
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Draws of z and statistics of one chain, warm-up left out."""
    init, step = hmc(potential, algo="NUTS")
    state = init(
        z,
        settings.n_warmup,
        step_size=0.5,
        inverse_mass_matrix=mass,
        dense_mass=[("theta",)],  # pyright: ignore[reportArgumentType]
        target_accept_prob=settings.target_accept,
        adapt_mass_matrix=adapt,
        rng_key=key,
    )

    def advance(state, _):
        state = step(state)
        stats = {
            "lp": -state.potential_energy,
            "energy": state.energy,
            "diverging": state.diverging,
            "n_steps": state.num_steps,
            "acceptance_rate": state.accept_prob,
            "step_size": state.adapt_state.step_size,
        }
        return state, (state.z, stats)

    # Warm-up and draws in one loop: its body, which takes long to compile, is there once.
    _, kept = lax.scan(advance, state, length=settings.n_warmup + settings.n_draws)
    return jax.tree.map(lambda a: a[settings.n_warmup :], kept)
