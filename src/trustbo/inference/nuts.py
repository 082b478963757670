"""Sampling with NumPyro's NUTS, on the marginal density or on the full program of a model.

For Gaussian rates, coefficients and signals are integrated out, and NUTS samples only the
hyperparameters, with gradients of the evidence from JAX. The inverse mass matrix is the covariance
of the importance sampler's points in NumPyro's unconstrained coordinates, so warm-up tunes only the
step size. Chains start at points of the importance sampler.

For other families, EP only approximates the evidence, so NUTS samples `model.program`, including
coefficients and signals.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.distributions import biject_to
from numpyro.infer import MCMC, NUTS, init_to_value
from scipy.special import log_ndtr

from trustbo.inference import importance
from trustbo.inference.diagnostics import complaints_of
from trustbo.inference.posterior import Draws, Posterior
from trustbo.models.backend import own_settings
from trustbo.models.scores import NOISES, Scores, of_size

_POINTS = 2000  # resampled points used for the covariance
_TARGET = 0.9
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
    rng = np.random.default_rng([seed, 1])
    points = importance.sample(
        posterior.log_density, posterior.start()[None], rng, defensive=posterior.defensive
    )
    z = points.z[points.resample(_POINTS, rng)]
    with own_settings():
        kernel, starts = _kernel(posterior, z, chains, rng)
        mcmc = MCMC(
            kernel, num_warmup=warmup, num_samples=draws, num_chains=chains,
            chain_method="vectorized", progress_bar=progress,
        )  # fmt: skip
        mcmc.run(jax.random.key(seed), init_params=starts, extra_fields=tuple(_FIELDS))
        fields, samples = (
            {name: np.asarray(v) for name, v in found.items()}
            for found in (mcmc.get_extra_fields(), mcmc.get_samples())
        )
    stats = {ours: fields[theirs] for theirs, ours in _FIELDS.items()}
    values = {name: samples[name] for name in posterior.scores.priors}
    theta = posterior.model.theta(values, posterior.slots.resolution)
    if posterior.exact:
        drawn = Draws(theta, posterior.draw_columns(theta, rng))
    else:
        drawn = Draws(theta, samples["columns"], samples["signal"])
    by_chain = {name: v.reshape(chains, draws, *v.shape[1:]) for name, v in values.items()}
    found, complaints = complaints_of(by_chain, stats["diverging"])
    return drawn, stats | {"lp": -stats["lp"]}, found, complaints


def _kernel(
    posterior: Posterior, z: np.ndarray, chains: int, rng: np.random.Generator
) -> tuple[NUTS, dict[str, jax.Array] | None]:
    """Make the kernel and the chains' starting points from posterior scores (point, score)."""
    values = posterior.scores.values(z)
    if not posterior.exact:
        center = {name: jnp.asarray(np.median(v, axis=0)) for name, v in values.items()}
        strategy = init_to_value(values=center)

        def program() -> None:
            posterior.model.program(posterior.slots)

        return NUTS(program, init_strategy=strategy, target_accept_prob=_TARGET), None
    free = _unconstrained(posterior.scores, z, values)
    flat = np.column_stack([np.asarray(free[name]).reshape(_POINTS, -1) for name in sorted(free)])
    finite = np.flatnonzero(np.isfinite(flat).all(1))
    inverse_mass = np.atleast_2d(np.cov(flat[finite].T)) + 1e-6 * np.eye(flat.shape[1])
    kernel = NUTS(
        marginal_program(posterior), dense_mass=True, adapt_mass_matrix=False,
        inverse_mass_matrix=jnp.asarray(inverse_mass), target_accept_prob=_TARGET,
    )  # fmt: skip
    first = rng.choice(finite, chains, replace=False)
    return kernel, {name: value[first] for name, value in free.items()}


def marginal_program(posterior: Posterior) -> Callable[[], None]:
    """Return a NumPyro program of the hyperparameters, with the evidence as a factor.

    The rates determine the total size of the two noises, but may not distinguish the two.
    Half-normal scores (a_w, a_v) = size (sin(angle), cos(angle)) are independent if size^2 ~
    Exponential(1/2) and the angle is uniform, so size^2 and the angle are sampled.
    """
    priors = posterior.scores.priors
    shape = priors["delta_w"].batch_shape

    def program() -> None:
        values = {
            name: numpyro.sample(name, prior.to_event(len(prior.batch_shape)))
            for name, prior in priors.items()
            if name not in NOISES
        }
        square = numpyro.sample("noise_square", dist.Exponential(0.5).expand(shape).to_event())
        angle = numpyro.sample("noise_angle", dist.Uniform(0.0, 1.0).expand(shape).to_event())
        angle, size = 0.5 * jnp.pi * jnp.asarray(angle), jnp.sqrt(jnp.asarray(square))
        for name, share in zip(NOISES, (jnp.sin(angle), jnp.cos(angle)), strict=True):
            values[name] = numpyro.deterministic(name, of_size(priors[name], size * share, name))
        values = {name: jnp.asarray(value)[None] for name, value in values.items()}
        theta = posterior.model.theta(values, posterior.slots.resolution)
        numpyro.factor("contact_rate", posterior.log_evidence(theta)[0])

    return program


def _unconstrained(
    scores: Scores, z: np.ndarray, values: dict[str, np.ndarray]
) -> dict[str, jax.Array]:
    """Return unconstrained coordinates (point, ...) of the sites of `marginal_program`."""
    sites = {
        name: biject_to(prior.support).inv(jnp.asarray(values[name]))
        for name, prior in scores.priors.items()
        if name not in NOISES
    }
    size, angle = (z[:, scores.at[name]].reshape(values[name].shape) for name in NOISES)
    sites["noise_square"] = jnp.asarray(2.0 * size)  # a logarithm, like the score
    sites["noise_angle"] = jnp.asarray(log_ndtr(angle) - log_ndtr(-angle))
    return sites
