"""Latent trust, likelihoods and predicted contact rates given draws of the parameters."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from tqdm import tqdm

from trustbo.inference.engine import kinds_of, whiten
from trustbo.inference.factor import cholesky
from trustbo.models.families import Family
from trustbo.models.observations import Observations
from trustbo.statespace.blocks import Layout, LinearPredictor, each, rate_precision

N_PRIOR = 500
"""Number of draws in the group `prior`."""
N_TRAJECTORIES = 200
"""Number of kept draws of latent trust and predicted rates, evenly spaced in the chains."""


class Given(NamedTuple):
    """Linear predictors of all blocks at some draws, given the parameters and effects."""

    some: np.ndarray  # indices of the draws
    predictor: LinearPredictor
    mean: np.ndarray  # of the linear predictors, (draw, block, row)
    log_likelihood: Any = None  # (draw, mission), where it is known
    log_prior: Any = None  # (draw,) of each variable by name, where it is known


class Source:
    """Draws of the parameters and effects of a model, with missions.

    Attributes:
        n_draws: Number of draws.
        observations: Rates and awareness of the missions.
        likelihood: Observation family.
        layout: Layout of the rates in blocks.
        label: Index (block,) of each block on the second axis of a `LinearPredictor`.
        shift: Log ratio (mission,) of the probability of tick counts to the density of rates; NaN
            where ticks are unknown.
    """

    def __init__(
        self,
        n_draws: int,
        observations: Observations,
        likelihood: Family,
        layout: Layout,
        label: np.ndarray,
    ) -> None:
        self.n_draws = n_draws
        self.observations = observations
        self.likelihood = likelihood
        self.layout = layout
        self.label = label
        y = observations.contact_rate
        self.shift = likelihood.log_resolution(y, observations.n_ticks).sum((1, 2))

    @property
    def of_counts(self) -> bool:
        """Whether log-likelihoods are those of tick counts, comparable between families."""
        return not np.isnan(self.shift).any()

    @property
    def first_equal(self) -> np.ndarray:
        """Index (draw,) of the first draw that equals each draw, which is evaluated only once."""
        return np.arange(self.n_draws)

    def given(self, some: np.ndarray) -> Iterator[Given]:
        """Yield the linear predictors of some draws, in chunks."""
        raise NotImplementedError

    def draw(
        self, given: Given, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Draw trust (draw, block, row) given the rates.

        Also return the log-likelihoods (draw, mission), of tick counts if possible, and the log
        prior density (draw,) of each parameter by name.
        """
        raise NotImplementedError

    def prior(self, posterior: xr.DataTree, rng: np.random.Generator) -> "Source":
        """Return `N_TRAJECTORIES` draws from the prior, evenly spaced in the group `prior`."""
        raise NotImplementedError


class Latent(NamedTuple):
    """Trust, likelihoods and predictions for given draws."""

    trust: np.ndarray  # (kept draw, mission, bound, robot)
    mean: np.ndarray  # (mission, bound, robot), over all draws
    sd: np.ndarray  # (mission, bound, robot), over all draws
    predicted: np.ndarray  # (kept draw, mission, bound, robot), replicated rates
    log_likelihood: np.ndarray  # (draw, mission)
    log_prior: dict[str, np.ndarray]  # (draw,) by name


def latent_of(source: Source, kept: np.ndarray, rng: np.random.Generator, bar: tqdm) -> Latent:
    """Compute trust, likelihoods and predictions for all draws.

    Args:
        source: Draws of a model and the missions.
        kept: Indices of the draws whose trust and predicted rates are kept, in order.
        rng: Random number generator.
        bar: Progress bar that counts draws.
    """
    first, place = np.unique(source.first_equal, return_inverse=True)
    share = np.bincount(place) / source.n_draws
    shown = first[np.unique(place[kept])]

    mean = np.zeros(source.observations.contact_rate.shape)
    square = np.zeros(mean.shape)
    trust = []
    predicted = []
    log_likelihood = []
    log_prior = []
    for given in source.given(first):
        rows, log_p, of_prior = source.draw(given, rng)
        x = source.layout.unstack(rows)
        weight = share[np.searchsorted(first, given.some)]
        mean += np.tensordot(weight, x, 1)
        square += np.tensordot(weight, x**2, 1)
        log_likelihood.append(log_p)
        log_prior.append(of_prior)

        is_shown = np.isin(given.some, shown)
        trust.append(x[is_shown])
        predicted.append(_rates(source, given, is_shown, rng))
        bar.update(len(x))

    of_kept = np.searchsorted(shown, first[place[kept]])
    return Latent(
        trust=np.concatenate(trust)[of_kept],
        mean=mean,
        sd=np.sqrt(np.maximum(square - mean**2, 0.0)),
        predicted=np.concatenate(predicted)[of_kept],
        log_likelihood=np.concatenate(log_likelihood)[place],
        log_prior={n: np.concatenate([part[n] for part in log_prior])[place] for n in log_prior[0]},
    )


def replicate(source: Source, rng: np.random.Generator) -> np.ndarray:
    """Draw replicated rates (draw, mission, bound, robot) of the missions."""
    every = source.given(np.arange(source.n_draws))
    return np.concatenate([_rates(source, given, slice(None), rng) for given in every])


def draw_exactly(
    source: Source, given: Given, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw trust given Gaussian rates; return trust and log-likelihoods (draw, mission)."""
    predictor = given.predictor
    y = source.layout.rows(source.observations.contact_rate)
    kind, first, seen = kinds_of(y, source.label, predictor.noise_sd[0])
    label = source.label[first]
    S = each(predictor.trust_cov, label)
    W, log_sites = whiten(label, predictor, rate_precision(seen, predictor.noise_sd, first))
    off = np.where(np.isnan(y), 0.0, y) - given.mean
    w = (W[:, kind] @ off[..., None])[..., 0]

    # The normal distribution of trust given the rates; its gain is S (V + 1 / lam)^-1 = S W' W.
    gain = S @ (np.swapaxes(W, 2, 3) @ W)
    root = root_of(S - gain @ S)[:, kind]
    x = given.mean + (gain[:, kind] @ off[..., None])[..., 0]
    x += (root @ rng.standard_normal((*x.shape, 1)))[..., 0]
    return x, by_mission(log_sites[:, kind] - 0.5 * (w**2).sum(2), source)


def by_mission(of_blocks: np.ndarray, source: Source) -> np.ndarray:
    """Sum values (draw, block) over the blocks of each mission."""
    return of_blocks.reshape(len(of_blocks), source.observations.n_missions, -1).sum(2)


def root_of(covariance: np.ndarray) -> np.ndarray:
    """Compute Cholesky factors of covariances (..., row, row) that may be nearly singular."""
    n = covariance.shape[-1]
    even = 0.5 * (covariance + np.swapaxes(covariance, -1, -2))
    scale = np.trace(even, axis1=-2, axis2=-1)[..., None, None] / n
    return cholesky(even + (1e-10 * scale + 1e-20) * np.eye(n))


def _rates(
    source: Source, given: Given, index: np.ndarray | slice, rng: np.random.Generator
) -> np.ndarray:
    """Draw replicated rates (draw, mission, bound, robot) for some of the given draws."""
    predictor = given.predictor.take(index)
    mean = given.mean[index]
    root = each(root_of(predictor.covariance), source.label)
    f = mean + (root @ rng.standard_normal((*mean.shape, 1)))[..., 0]
    sd = np.broadcast_to(predictor.noise_sd, f.shape)

    unstack = source.layout.unstack
    n_ticks = source.observations.n_ticks
    return source.likelihood.sample(unstack(f), unstack(sd), n_ticks, rng)
