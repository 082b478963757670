"""Sampling with NumPyro's NUTS, on the marginal density or on the full program of a model.

For Gaussian rates, coefficients and signals are integrated out, and NUTS samples only the scores of
the hyperparameters, with gradients of the evidence from JAX. The scores are whitened by the
covariance of the importance sampler's points, so warm-up tunes only the step size. Chains start at
points of the importance sampler.

For other families, EP only approximates the evidence, so NUTS samples `model.program`, including
coefficients and signals.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpyro.infer import MCMC, NUTS, init_to_value

from trustbo.inference import importance
from trustbo.inference.diagnostics import complaints_of
from trustbo.inference.posterior import Draws, Posterior
from trustbo.models.backend import own_settings
from trustbo.streams import stream

_POINTS = 2000  # resampled points from which the covariance is estimated
_FIELDS = {
    "num_steps": "n_steps",
    "diverging": "diverging",
    "accept_prob": "acceptance_rate",
    "energy": "energy",
    "potential_energy": "lp",
}
"""ArviZ names of NumPyro's sampling statistics."""


def sample_by_nuts(
    posterior: Posterior, *, chains: int, draws: int, warmup: int, seed: int, progress: bool = True
) -> tuple[Draws, dict[str, np.ndarray], dict[str, Any], list[str]]:
    """Sample a posterior with NumPyro's NUTS in vectorised chains.

    Args:
        posterior: Posterior of a model given missions.
        chains: Number of chains.
        draws: Number of draws per chain.
        warmup: Number of warm-up draws per chain.
        seed: Random seed.
        progress: Whether to show a progress bar.

    Returns:
        Draws with chains joined, statistics (draw,) by name, diagnostics and a list of failed
        checks.
    """
    rng = stream(seed, "nuts")
    points = importance.sample(
        posterior.log_density, posterior.start()[None], rng, defensive=posterior.defensive
    )
    z = points.z[points.resample(_POINTS, rng)]
    center = z.mean(0)
    scale = np.linalg.cholesky(np.cov(z.T).reshape(2 * center.shape) + 1e-6 * np.eye(len(center)))
    with own_settings():
        if posterior.exact:
            kernel = _marginal_kernel(posterior, center, scale)
            first = np.linalg.solve(scale, (rng.choice(z, chains, replace=False) - center).T).T
            starts = jnp.asarray(first if chains > 1 else first[0])  # one chain has no axis
        else:
            kernel, starts = _full_kernel(posterior, z), None
        mcmc = MCMC(
            kernel, num_warmup=warmup, num_samples=draws, num_chains=chains,
            chain_method="vectorized", progress_bar=progress,
        )  # fmt: skip
        mcmc.run(jax.random.key(seed), init_params=starts, extra_fields=tuple(_FIELDS))
        fields = {name: np.asarray(v) for name, v in mcmc.get_extra_fields().items()}
        samples: Any = jax.tree.map(np.asarray, mcmc.get_samples())
    stats = {ours: fields[theirs] for theirs, ours in _FIELDS.items()}
    if posterior.exact:
        values = posterior.scores.values(center + samples @ scale.T)
    else:
        values = {name: samples[name] for name in posterior.scores.priors}
    theta = posterior.model.theta(values, posterior.slots.resolution)
    if posterior.exact:
        drawn = Draws(theta, posterior.draw_columns(theta, rng))
    else:
        drawn = Draws(theta, samples["columns"], samples["signal"])
    by_chain = {name: v.reshape(chains, draws, *v.shape[1:]) for name, v in values.items()}
    found, complaints = complaints_of(by_chain, stats["diverging"])
    return drawn, stats | {"lp": -stats["lp"]}, found, complaints


def _marginal_kernel(posterior: Posterior, center: np.ndarray, scale: np.ndarray) -> NUTS:
    """Make the kernel for scores that are whitened by a mean and a Cholesky factor."""

    @jax.jit  # NumPyro also calls this function outside of compiled code
    def potential(white: jax.Array) -> jax.Array:
        z = center + scale @ white
        return -posterior.log_density(z[None])[0]

    return NUTS(potential_fn=potential, adapt_mass_matrix=False)


def _full_kernel(posterior: Posterior, z: np.ndarray) -> NUTS:
    """Make the kernel for the model's program; chains start at the median of the scores z."""
    values = posterior.scores.values(z)
    center = {name: jnp.asarray(np.median(v, axis=0)) for name, v in values.items()}

    def program() -> None:
        posterior.model.program(posterior.slots)

    return NUTS(program, init_strategy=init_to_value(values=center), target_accept_prob=0.9)
