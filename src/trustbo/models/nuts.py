"""NUTS on a trust model, as one compiled program that takes missions and priors as data.

numpyro's functional sampler is called inside a single `jax.jit`, so that the next mission, or
other numbers in the priors, meet the compiled code of the last. The chains start around the
posterior mode, in coordinates that its Hessian makes standard normal (Laplace).
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax, random
from numpyro.infer.hmc import hmc

from trustbo.models.geometry import NutsData, inverse_hessian, newton, noise_shape, round_target
from trustbo.models.model import TrustModel

_DRAWS_PER_UNKNOWN = 10  # of the warm-up, to learn a covariance from


class NutsSettings(NamedTuple):
    """Length and care of a NUTS run."""

    n_warmup: int = 300
    n_draws: int = 1000
    n_chains: int = 4
    target_accept: float = 0.9
    collapse: bool = False
    """Take the pooled model's weights and intercept out: slower, but no funnel for few data."""


class NutsDraws(NamedTuple):
    """Draws and statistics, each with leading axes (chain, draw)."""

    params: dict[str, Array]
    stats: dict[str, Array]
    noise: Array | None
    """What latent trust is made of, (chain, draw, bound, mission, robot), if it was sampled."""
    pilot: Array | None
    """What it is made with, of counts."""


@partial(jax.jit, static_argnames=("settings", "shared", "joint"))
def run_nuts(
    settings: NutsSettings,
    key: Array,
    model: TrustModel,
    data: NutsData,
    *,
    shared: bool = False,
    joint: bool = False,
) -> NutsDraws:
    """Draw from a model's posterior; call it in a float64 scope.

    Args:
        settings: How long.
        key: Random key.
        model: Its priors are data; anything else about it is compiled in.
        data: The missions.
        shared: No rate is missing before the last of a mission.
        joint: Sample the noise that latent trust is made of.
    """
    target = round_target(model, data, shared=shared, joint=joint, collapse=settings.collapse)
    noise = {"noise": jnp.zeros(noise_shape(data))} if joint else {}
    mode, hessian = newton(target.profile, target.start)
    scale = jnp.linalg.cholesky(inverse_hessian(hessian))

    # NUTS sees standard normal coordinates. With many unknowns it leaves them so: a covariance
    # learnt from the few hundred draws of a warm-up is then worse than Laplace's.
    def theta_of(x: Array) -> Array:
        return mode + scale @ x

    def potential(z: dict[str, Array]) -> Array:
        return target.potential(z | {"theta": theta_of(z["theta"])})

    # Noise is close to standard normal by construction: its mass matrix starts as the identity.
    mass = {("theta",): jnp.eye(len(mode))}
    if joint:
        mass[("noise",)] = jnp.ones(noise["noise"].size)

    def chain(key: Array):
        key_start, key_noise, key_run = random.split(key, 3)
        # Overdispersed starts (1.5 Laplace sd), so that R-hat means something.
        z = {"theta": 1.5 * random.normal(key_start, mode.shape, mode.dtype)}
        if joint:
            z["noise"] = random.normal(key_noise, noise["noise"].shape, mode.dtype)
        init, step = hmc(potential, algo="NUTS")
        state = init(
            z,
            settings.n_warmup,
            step_size=0.5,
            inverse_mass_matrix=mass,
            dense_mass=[("theta",)],  # pyright: ignore[reportArgumentType]
            target_accept_prob=settings.target_accept,
            adapt_mass_matrix=joint or _DRAWS_PER_UNKNOWN * len(mode) <= settings.n_warmup,
            rng_key=key_run,
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
        z, stats = jax.tree.map(lambda a: a[settings.n_warmup :], kept)
        return jax.vmap(lambda x: target.constrain(theta_of(x)))(z["theta"]), stats, z.get("noise")

    # One chain after the other: vectorised chains would all wait for the longest trajectory.
    params, stats, drawn = lax.map(chain, random.split(key, settings.n_chains))
    return NutsDraws(params, stats, drawn, target.pilot)
