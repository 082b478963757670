"""NUTS on a trust model, as one compiled program that takes missions and priors as data.

numpyro's functional sampler is called inside a single `jax.jit`, so that the next mission, or
other numbers in the priors, meet the compiled code of the last. The chains start around the
posterior mode with the inverse Hessian there (Laplace) as their dense mass matrix.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax, random
from jax.flatten_util import ravel_pytree
from numpyro import handlers
from numpyro.distributions.transforms import biject_to
from numpyro.infer.hmc import hmc
from numpyro.infer.util import constrain_fn, potential_energy

from trustbo.models.priors import Priors


class NutsSettings(NamedTuple):
    """Length and care of a NUTS run."""

    n_warmup: int = 300
    n_draws: int = 1000
    n_chains: int = 4
    target_accept: float = 0.9


class NutsDraws(NamedTuple):
    """Draws and statistics, each with leading axes (chain, draw)."""

    params: dict[str, Array]
    stats: dict[str, Array]


class _Data(NamedTuple):
    awareness: Array
    priors: Priors
    contact_rate: Array


@partial(jax.jit, static_argnames=("model", "settings"))
def run_nuts(
    model: Callable[..., None],
    settings: NutsSettings,
    key: Array,
    priors: Priors,
    awareness: Array,
    contact_rate: Array,
) -> NutsDraws:
    """Draw from the posterior of a numpyro model of contact rates; call it in a float64 scope."""
    data = _Data(awareness, priors, contact_rate)
    start, constrain, potential = _unconstrained(model, data)
    mode, covariance = _laplace(potential, start)
    scale = jnp.linalg.cholesky(covariance)

    def chain(key: Array):
        key_start, key_run = random.split(key)
        # Overdispersed starts (1.5 Laplace sd), so that R-hat means something.
        z = mode + 1.5 * scale @ random.normal(key_start, mode.shape, mode.dtype)
        init, step = hmc(potential, algo="NUTS")
        state = init(
            z,
            settings.n_warmup,
            step_size=0.5,
            inverse_mass_matrix=covariance,
            dense_mass=True,
            target_accept_prob=settings.target_accept,
            rng_key=key_run,
        )
        state = lax.fori_loop(0, settings.n_warmup, lambda _, s: step(s), state)

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
            return state, (constrain(state.z), stats)

        return lax.scan(advance, state, length=settings.n_draws)[1]

    # One chain after the other: the model is too small for vectorised chains to pay, as these all
    # wait for the longest trajectory among them.
    return NutsDraws(*lax.map(chain, random.split(key, settings.n_chains)))


def _unconstrained(model: Callable[..., None], data: _Data):
    """A start, the way back to parameters, and the potential energy, on a flat real vector."""
    trace = handlers.trace(handlers.seed(model, random.key(0))).get_trace(*data)
    sites = {
        name: site
        for name, site in trace.items()
        if site["type"] == "sample" and not site["is_observed"]
    }
    inverse = {name: biject_to(site["fn"].support) for name, site in sites.items()}
    start = {name: _start(inverse[name], site["fn"]) for name, site in sites.items()}
    flat, unravel = ravel_pytree(start)

    measured = ~jnp.isnan(data.contact_rate)
    n = jnp.maximum(measured.sum(), 1)
    mean_y = jnp.where(measured, data.contact_rate, 0.0).sum() / n
    mean_z = jnp.where(measured[..., None], data.awareness, 0.0).sum((0, 1, 2)) / n

    def to_sites(z: Array) -> dict[str, Array]:
        """Undo the change of variables, of Jacobian 1, that makes the posterior round.

        The data fix delta_w^2 + delta_v^2 well and their ratio badly: the sampler sees the log of
        their root, t, and r = log(delta_w / delta_v), in the places of delta_w and delta_v. They
        fix the level that trust has on average, y = beta0 y + beta . z + b, better than its parts:
        in the place of b the sampler sees b + beta0 mean(y) + beta . mean(z).
        """
        site = unravel(z)
        t, r = site["delta_w"], site["delta_v"]
        beta0, beta = (inverse[name](site[name]) for name in ("beta0", "beta"))
        return site | {
            "delta_w": t + 0.5 * jax.nn.log_sigmoid(2.0 * r),
            "delta_v": t + 0.5 * jax.nn.log_sigmoid(-2.0 * r),
            "b": site["b"] - beta0 * mean_y - beta @ mean_z,
        }

    def constrain(z: Array) -> dict[str, Array]:
        return constrain_fn(model, data, {}, to_sites(z))

    def potential(z: Array) -> Array:
        return potential_energy(model, data, {}, to_sites(z))  # pyright: ignore[reportReturnType]

    return flat, constrain, potential


def _start(transform, prior) -> Array:
    """The prior's mean on the real line, or 0 there if it has none, as a Cauchy has not."""
    z = transform.inv(jnp.broadcast_to(jnp.asarray(prior.mean, dtype=float), prior.shape()))
    return jnp.where(jnp.isfinite(z), z, 0.0)


def _laplace(potential: Callable[[Array], Array], start: Array, n_steps: int = 50):
    """Posterior mode and inverse Hessian there, by Newton's method with a trust-region ridge."""
    gradient, hessian = jax.grad(potential), jax.hessian(potential)

    def step(_, carry):
        z, value, ridge = carry
        eigenvalues, vectors = jnp.linalg.eigh(hessian(z))
        # Away from the mode the Hessian may be indefinite: its absolute value still gives descent.
        rotated = vectors.T @ gradient(z) / (jnp.maximum(jnp.abs(eigenvalues), 1e-6) + ridge)
        proposal = z - vectors @ rotated
        new = potential(proposal)
        better = new < value
        return (
            jnp.where(better, proposal, z),
            jnp.where(better, new, value),
            jnp.where(better, ridge / 4.0, ridge * 8.0 + 1e-6),
        )

    z, _, _ = lax.fori_loop(0, n_steps, step, (start, potential(start), jnp.asarray(1.0)))
    eigenvalues, vectors = jnp.linalg.eigh(hessian(z))
    # Floor: flat directions get the scale of the unconstrained priors, not an infinite one.
    return z, (vectors / jnp.maximum(eigenvalues, 0.1)[None]) @ vectors.T
