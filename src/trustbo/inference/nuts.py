"""Sampling with NumPyro's NUTS, on the marginal density or on the full program of a model.

For Gaussian rates, coefficients and linear predictors are integrated out, and NUTS samples only the
scores of the hyperparameters, with gradients of the evidence from JAX (see `gradient`). Their
posterior is skewed. Below the score at which a standard deviation is too small to matter, the
density falls as slowly as the prior; above it, the density falls as fast as the likelihood. A step
size that suits one side leads to divergences on the other. NUTS therefore samples `Whitened`
coordinates, which are fitted to the points of the importance sampler and are nearly independent and
standard normal. Warm-up tunes only the step size, and chains start at points of the importance
sampler. The coordinates change the speed of NUTS, but not the distribution that it samples.

For other families, EP only approximates the evidence, so NUTS samples `model.program`, including
coefficients and linear predictors.
"""

from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from numpyro.infer import MCMC, NUTS, init_to_value
from numpyro.infer.util import ParamInfo
from scipy import optimize

from trustbo.display import shows_bars
from trustbo.inference import importance
from trustbo.inference.density import Density, JointDraws
from trustbo.inference.diagnostics import FIELDS, complaints_of, statistics_of
from trustbo.models.backend import own_settings
from trustbo.statespace.matrices import namespace
from trustbo.streams import stream

_POINTS = 2000
"""Number of resampled points to which the coordinates are fitted."""
_WARMUP_OF_STEP = 150
"""Number of warm-up draws if only the step size is tuned."""
_WARMUP_OF_MASS = 300
"""Number of warm-up draws if the mass matrix is also tuned."""
_ACCEPT = 0.65
"""Target of the acceptance probability in whitened coordinates."""
_ACCEPT_OF_PROGRAM = 0.9
"""Target of the acceptance probability of the full program."""
_DEPTH = 2
"""Largest number of doublings of a trajectory, which then has 3 steps."""
_FIRST_STEP = 0.8
"""Initial step size of the warm-up, in sds; three steps cross the posterior."""
_RIDGE = 1e-6
"""Number added to the covariance of the points."""
_SHRINK = 0.01
"""Penalty on the shape of a marginal, in nats per point."""
_SLOPE_STEP = 1e-4
"""Step of the finite differences at the starts of the chains."""


class Whitened(NamedTuple):
    """Coordinates in which points are nearly independent and standard normal.

    A score is location + scale sinh((arcsinh(y) + skew) / weight), where y = center + root x. The
    transform of Jones and Pewsey (2009, Biometrika 96) makes skewed marginals with light or heavy
    tails normal. The coordinates x are uncorrelated.
    """

    location: np.ndarray  # (score,)
    scale: np.ndarray  # (score,), like the next three
    skew: np.ndarray
    weight: np.ndarray
    center: np.ndarray
    root: np.ndarray  # (score, score), lower triangular

    @classmethod
    def from_scores(cls, z: np.ndarray) -> Self:
        """Fit the coordinates to scores z (point, score) by maximum likelihood."""
        shapes = [_marginal(one) for one in z.T]
        location, log_scale, skew, log_weight = np.transpose(shapes)
        marginals = location, np.exp(log_scale), skew, np.exp(log_weight)

        d = z.shape[1]
        y = cls(*marginals, np.zeros(d), np.eye(d)).whiten(z)
        covariance = np.cov(y.T).reshape(d, d) + _RIDGE * np.eye(d)
        return cls(*marginals, y.mean(0), np.linalg.cholesky(covariance))

    def whiten(self, z: np.ndarray) -> np.ndarray:
        """Convert scores z (point, score) to coordinates x (point, score)."""
        u = (z - self.location) / self.scale
        t = self.weight * np.arcsinh(u) - self.skew
        return np.linalg.solve(self.root, (np.sinh(t) - self.center).T).T

    def scores(self, x: Any) -> tuple[Any, Any]:
        """Convert coordinates x (point, score) to scores, in NumPy or JAX.

        Also returns the log determinants (point,) of the Jacobian, up to a constant.
        """
        xp = namespace(x)
        y = self.center + x @ self.root.T
        t = (xp.arcsinh(y) + self.skew) / self.weight
        log_jacobian = (xp.log(xp.cosh(t)) - 0.5 * xp.log1p(y**2)).sum(-1)
        return self.location + self.scale * xp.sinh(t), log_jacobian


def _marginal(z: np.ndarray) -> np.ndarray:
    """Fit location, log scale, skew and log weight of `Whitened` to values z (point,)."""

    def cost(shape: np.ndarray) -> float:
        location, log_scale, skew, log_weight = shape
        u = (z - location) / np.exp(log_scale)
        t = np.exp(log_weight) * np.arcsinh(u) - skew
        log_slope = log_weight - log_scale + np.log(np.cosh(t)) - 0.5 * np.log1p(u**2)
        return np.mean(0.5 * np.sinh(t) ** 2 - log_slope) + _SHRINK * (skew**2 + log_weight**2)

    start = [z.mean(), np.log(z.std() + _RIDGE), 0.0, 0.0]
    with np.errstate(all="ignore"):  # the search may try extreme shapes
        return optimize.minimize(cost, start, method="BFGS").x


def sample_by_nuts(
    density: Density,
    *,
    chains: int,
    draws: int,
    warmup: int | None,
    seed: int,
    progress: bool = True,
) -> tuple[JointDraws, dict[str, np.ndarray], dict[str, Any], list[str]]:
    """Sample a posterior with NumPyro's NUTS in vectorised chains.

    Args:
        density: Density of a model given missions.
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
    if warmup is None:
        warmup = _WARMUP_OF_STEP if density.exact else _WARMUP_OF_MASS

    rng = stream(seed, "nuts")
    points = importance.sample(
        density.log_density, density.start()[None], rng, defensive=density.defensive
    )
    z = points.z[points.resample(_POINTS, rng)]
    coordinates = Whitened.from_scores(z)

    with own_settings():
        if density.exact:
            kernel = _marginal_kernel(density, coordinates)
            starts = _starts(density, coordinates, rng.choice(z, chains, replace=False))
            if chains == 1:  # NumPyro expects no axis for chains
                starts = jax.tree.map(lambda values: values[0], starts)
        else:
            kernel = _full_kernel(density, z)
            starts = None

        mcmc = MCMC(
            kernel, num_warmup=warmup, num_samples=draws, num_chains=chains,
            chain_method="vectorized", progress_bar=progress and shows_bars(),
        )  # fmt: skip
        mcmc.run(jax.random.key(seed), init_params=starts, extra_fields=FIELDS)

        fields = {name: np.asarray(v) for name, v in mcmc.get_extra_fields().items()}
        samples: Any = jax.tree.map(np.asarray, mcmc.get_samples())

    stats = statistics_of(fields)
    resolution = density.observations.resolution
    if density.exact:
        z, log_jacobian = coordinates.scores(samples)
        stats["lp"] = stats["lp"] - log_jacobian
        values = density.scores.values(z)
        theta = density.model.theta(values, resolution)
        drawn = JointDraws(theta, density.draw_coefficients(theta, rng))
    else:
        values = {name: samples[name] for name in density.scores.priors}
        theta = density.model.theta(values, resolution)
        drawn = JointDraws(theta, samples["coefficients"])

    by_chain = {name: v.reshape(chains, draws, *v.shape[1:]) for name, v in values.items()}
    found, complaints = complaints_of(by_chain, stats["diverging"])
    return drawn, stats, found, complaints


def _marginal_kernel(density: Density, coordinates: Whitened) -> NUTS:
    """Make the kernel for scores in whitened coordinates."""

    def potential(x: jax.Array) -> jax.Array:
        z, log_jacobian = coordinates.scores(x[None])
        return -(density.log_density(z) + log_jacobian)[0]

    return NUTS(
        potential_fn=potential, adapt_mass_matrix=False, target_accept_prob=_ACCEPT,
        step_size=_FIRST_STEP, max_tree_depth=_DEPTH,
    )  # fmt: skip


def _starts(density: Density, coordinates: Whitened, z: np.ndarray) -> ParamInfo:
    """Return the states at which chains start, with scores z (chain, score).

    NumPy computes the first potentials and slopes, so JAX compiles the gradient only once.
    """
    x = coordinates.whiten(z)
    n, d = x.shape
    steps = _SLOPE_STEP * np.vstack([np.zeros((1, d)), np.eye(d), -np.eye(d)])

    at, log_jacobian = coordinates.scores((x[:, None] + steps).reshape(-1, d))
    potential = -(density.log_density(at) + log_jacobian).reshape(n, -1)
    slope = (potential[:, 1 : d + 1] - potential[:, d + 1 :]) / (2.0 * _SLOPE_STEP)
    return ParamInfo(*map(jnp.asarray, (x, potential[:, 0], slope)))


def _full_kernel(density: Density, z: np.ndarray) -> NUTS:
    """Make the kernel for the model's program; chains start at the median of the scores z."""
    values = density.scores.values(z)
    center = {name: jnp.asarray(np.median(v, axis=0)) for name, v in values.items()}

    def program() -> None:
        density.model.program(density.observations)

    return NUTS(
        program, init_strategy=init_to_value(values=center), target_accept_prob=_ACCEPT_OF_PROGRAM
    )
