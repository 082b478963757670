"""Latent trust, likelihoods and predicted contact rates given draws of the parameters."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from trustbo.inference import ep
from trustbo.inference.density import Density, JointDraws, chunks
from trustbo.inference.engine import expected, whiten
from trustbo.inference.factor import cholesky
from trustbo.models.effects.effect import Theta
from trustbo.statespace.blocks import LinearPredictor, each

_PARTICLES = 4
"""Number of linear predictors drawn for each draw of the coefficients."""


class Latent(NamedTuple):
    """Trust, likelihoods and predictions for given draws."""

    trust: np.ndarray  # (kept draw, mission, bound, robot)
    mean: np.ndarray  # (mission, bound, robot), over all draws
    sd: np.ndarray  # (mission, bound, robot), over all draws
    log_likelihood: np.ndarray  # (draw, mission)
    predicted: np.ndarray  # (kept draw, mission, bound, robot), replicated rates


def latent_of(
    density: Density, draws: JointDraws, kept: np.ndarray, rng: np.random.Generator
) -> Latent:
    """Compute trust, likelihoods and predictions for given draws.

    Args:
        density: Density of the model given missions.
        draws: Draws of hyperparameters and coefficients.
        kept: Indices of the draws whose trust and predicted rates are kept.
        rng: Random number generator.
    """
    rows = [v.reshape(len(draws.c), -1) for v in draws.theta.values()]
    _, some, index = np.unique(  # EP draws may repeat, so each distinct draw is evaluated once
        np.column_stack([*rows, draws.c]), axis=0, return_index=True, return_inverse=True
    )
    index = index.ravel()
    draws = draws.at(some)
    share = np.bincount(index, minlength=len(some)) / len(index)
    shown, place = np.unique(index[kept], return_inverse=True)

    shape = density.observations.contact_rate.shape
    mean = np.zeros(shape)
    square = np.zeros(shape)
    log_likelihood = np.empty((len(some), shape[0]))
    trust = np.empty((len(shown), *shape))
    predicted = np.empty((len(shown), *shape))

    draw_trust = _exact_trust if density.exact else _ep_trust
    for where, theta, predictor, expected_predictor in predictors(density, draws):
        x, log_p = draw_trust(density, theta, predictor, expected_predictor, rng)
        x = density.layout.unstack(x)
        mean += np.einsum("n,nmbr->mbr", share[where], x)
        square += np.einsum("n,nmbr->mbr", share[where], x**2)
        log_likelihood[where] = log_p.reshape(len(log_p), shape[0], -1).sum(2)

        first, last = np.searchsorted(shown, (where.start, where.start + len(x)))
        here = shown[first:last] - where.start
        trust[first:last] = x[here]
        predicted[first:last] = _rates(density, predictor, expected_predictor, rng)[here]

    sd = np.sqrt(np.maximum(square - mean**2, 0.0))
    return Latent(trust[place], mean, sd, log_likelihood[index], predicted[place])


def replicate(density: Density, draws: JointDraws, rng: np.random.Generator) -> np.ndarray:
    """Draw replicated rates (draw, mission, bound, robot) of the missions."""
    rates = np.empty((len(draws.c), *density.observations.contact_rate.shape))
    for i, _, predictor, mean in predictors(density, draws):
        rates[i] = _rates(density, predictor, mean, rng)
    return rates


def predictors(
    density: Density, draws: JointDraws
) -> Iterator[tuple[slice, Theta, LinearPredictor, np.ndarray]]:
    """Yield the slice, theta, linear predictors and their means for each chunk of draws."""
    for where, theta in chunks(draws.theta):
        density.evaluated(len(theta["inverse_gain"]))
        predictor = density.model.linear_predictor(theta, density.observations, density.layout)
        yield where, theta, predictor, expected(density.blocks, predictor, draws.c[where])


def _exact_trust(
    density: Density,
    theta: Theta,
    predictor: LinearPredictor,
    mean: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw trust given Gaussian rates; return trust and log-likelihoods (draw, block)."""
    b = density.blocks
    S = each(predictor.trust_cov, b.label)
    W, log_sites = whiten(b, predictor, density.site_precision(predictor))
    off = b.y - mean
    w = (W[:, b.kind] @ off[..., None])[..., 0]

    # The normal distribution of trust given the rates; its gain is S (V + 1 / lam)^-1 = S W' W.
    gain = S @ (np.swapaxes(W, 2, 3) @ W)
    root = _root(S - gain @ S)[:, b.kind]
    x = mean + (gain[:, b.kind] @ off[..., None])[..., 0]
    x += (root @ rng.standard_normal((*x.shape, 1)))[..., 0]
    return x, log_sites[:, b.kind] - 0.5 * (w**2).sum(2)


def _ep_trust(
    density: Density,
    theta: Theta,
    predictor: LinearPredictor,
    mean: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw trust given non-Gaussian rates by weighted particles; see `_exact_trust`."""
    joint = ep.Joint(density.blocks, predictor, density.prior(theta), density.rates)
    sites, _ = density.near.at(density.rates, predictor.noise_sd)

    # Draw particles of the predictor f; for each block, Gumbel noise chooses one by weight.
    drawn = [ep.draw_predictors(joint, mean, sites, rng) for _ in range(_PARTICLES)]
    f, log_w = (np.stack(part) for part in zip(*drawn, strict=True))
    chosen = np.argmax(log_w + rng.gumbel(size=log_w.shape), axis=0)
    f = np.take_along_axis(f, chosen[None, ..., None], axis=0)[0]
    log_p = logsumexp(log_w, axis=0) - np.log(_PARTICLES)

    if predictor.shared_cov is None:  # the predictor is trust
        return f, log_p

    # Trust given the predictor f = trust + shared noise.
    V = each(predictor.covariance, density.blocks.label)
    S = each(predictor.trust_cov, density.blocks.label)
    gain = np.swapaxes(np.linalg.solve(V, S), 2, 3)
    x = mean + (gain @ (f - mean)[..., None])[..., 0]
    return x + (_root(S - gain @ S) @ rng.standard_normal((*x.shape, 1)))[..., 0], log_p


def _rates(
    density: Density, predictor: LinearPredictor, mean: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Draw replicated rates (draw, mission, bound, robot) given the mean linear predictors."""
    root = each(_root(predictor.covariance), density.blocks.label[density.blocks.kind])
    f = density.layout.unstack(mean + (root @ rng.standard_normal((*mean.shape, 1)))[..., 0])
    sd = density.layout.unstack(np.broadcast_to(predictor.noise_sd, mean.shape))
    return density.model.likelihood.sample(f, sd, density.observations.n_ticks, rng)


def _root(covariance: np.ndarray) -> np.ndarray:
    """Compute Cholesky factors of covariances (..., row, row) that may be nearly singular."""
    n = covariance.shape[-1]
    even = 0.5 * (covariance + np.swapaxes(covariance, -1, -2))
    scale = np.trace(even, axis1=-2, axis2=-1)[..., None, None] / n
    return cholesky(even + (1e-10 * scale + 1e-20) * np.eye(n))
