"""Latent trust, likelihoods and predicted contact rates given draws of the parameters."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple

import numpy as np
import xarray as xr
from scipy.special import logsumexp
from tqdm import tqdm

from trustbo.inference import ep
from trustbo.inference.density import CHUNK, Density, Outer
from trustbo.inference.engine import inputs, kinds_of, whiten
from trustbo.inference.factor import cholesky
from trustbo.statespace.blocks import LinearPredictor, each, rate_precision

N_PRIOR = 500
"""Number of draws in the group `prior`."""
N_TRAJECTORIES = 200
"""Number of kept draws of latent trust and predicted rates, evenly spaced in the chains."""
_PARTICLES = 4
"""Number of linear predictors drawn for each draw of the coefficients."""


class Given(NamedTuple):
    """Linear predictors of all blocks at some draws, given the parameters and effects."""

    some: np.ndarray  # indices of the draws
    outer: Outer
    predictor: LinearPredictor
    mean: np.ndarray  # of the linear predictors, (draw, block, row)


class Source(ABC):
    """Draws of the parameters and effects of a model, with missions.

    Attributes:
        density: Density of the rates of the missions.
        n_draws: Number of draws.
        observations: Rates and awareness of the missions.
        likelihood: Observation family.
        layout: Layout of the rates in blocks.
        label: Index (block,) of each block on the second axis of a `LinearPredictor`.
        shift: Log ratio (mission,) of the probability of tick counts to the density of rates; NaN
            where ticks are unknown.
    """

    size: ClassVar[int] = CHUNK
    """Number of draws that are evaluated at once."""

    def __init__(self, density: Density, n_draws: int, *, contrasts: bool = True) -> None:
        """Arrange the rates in blocks, which may be contrasts of robots if `contrasts`."""
        self.density = density
        self.n_draws = n_draws
        self.observations = density.observations
        self.likelihood = density.likelihood
        self.layout = density.layout
        self._U = density.U
        if not contrasts and self.layout.rotation is not None:
            self.layout = self.layout._replace(joint=True, rotation=None)
            self._U = self.layout.design(density.columns.U)
        self.label = self.layout.label
        y = self.observations.contact_rate
        self.shift = self.likelihood.log_resolution(y, self.observations.n_ticks).sum((1, 2))

    # --- what classes and functions say differently ---

    @abstractmethod
    def outer(self, some: np.ndarray) -> tuple[Outer, np.ndarray]:
        """Return what the model says at some draws, and their coefficients (draw, column)."""

    @abstractmethod
    def log_prior(self, given: Given) -> dict[str, np.ndarray]:
        """Return the log prior density (draw,) of each parameter by name."""

    @abstractmethod
    def prior(self, posterior: xr.DataTree, rng: np.random.Generator) -> "Source":
        """Return `N_TRAJECTORIES` draws from the prior, evenly spaced in the group `prior`."""

    @property
    def first_equal(self) -> np.ndarray:
        """Index (draw,) of the first draw that equals each draw, which is evaluated only once."""
        return np.arange(self.n_draws)

    # --- what is the same for both ---

    @property
    def of_counts(self) -> bool:
        """Whether log-likelihoods are those of tick counts, comparable between families."""
        return not np.isnan(self.shift).any()

    def given(self, some: np.ndarray) -> Iterator[Given]:
        """Yield the linear predictors of some draws, in chunks."""
        for start in range(0, len(some), self.size):
            index = some[start : start + self.size]
            outer, c = self.outer(index)
            predictor = self.density.predictor(outer, self.layout)

            u = inputs(self._U, len(self.label), c)
            if np.ndim(outer.inputs.drift):
                u = u + self.layout.rows(outer.inputs.drift)
            mean = predictor.mean_given(u, self.label)
            if np.ndim(outer.inputs.offset):
                mean = mean + self.layout.rows(outer.inputs.offset)
            yield Given(index, outer, predictor, mean)

    def draw(self, given: Given, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw trust (draw, block, row) given the rates.

        Also return the log-likelihoods (draw, mission), of tick counts if possible. Unless rates
        are Gaussian, draws are weighted particles.
        """
        draw = draw_exactly if self.density.is_gaussian else draw_particles
        x, log_p = draw(self, given, rng)
        return x, log_p + self.shift if self.of_counts else log_p

    def log_likelihood(self) -> np.ndarray:
        """Compute the log-likelihoods (draw, mission) of `draw` for Gaussian rates."""
        rng = np.random.default_rng(0)  # the draws of trust are not used
        every = self.given(np.arange(self.n_draws))
        return np.concatenate([self.draw(given, rng)[1] for given in every])


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
        rows, log_p = source.draw(given, rng)
        x = source.layout.unstack(rows)
        weight = share[np.searchsorted(first, given.some)]
        mean += np.tensordot(weight, x, 1)
        square += np.tensordot(weight, x**2, 1)
        log_likelihood.append(log_p)
        log_prior.append(source.log_prior(given))

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


def draw_particles(
    source: Any, given: Given, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw trust given rates of any family by weighted particles; see `draw_exactly`.

    EP sites are those of `source.near`.
    """
    predictor = given.predictor
    mean = given.mean
    density = source.density
    sites, _ = source.near.at(density.rates, predictor.noise_sd)
    prior = density.columns.prior(given.outer.theta)
    joint = ep.Joint(density.blocks, predictor, prior, density.rates)

    # Draw particles of the predictor f; for each block, Gumbel noise chooses one by weight.
    drawn = [ep.draw_predictors(joint, mean, sites, rng) for _ in range(_PARTICLES)]
    f, log_w = (np.stack(part) for part in zip(*drawn, strict=True))
    chosen = np.argmax(log_w + rng.gumbel(size=log_w.shape), axis=0)
    f = np.take_along_axis(f, chosen[None, ..., None], axis=0)[0]
    log_p = by_mission(logsumexp(log_w, axis=0) - np.log(_PARTICLES), source)

    if predictor.shared_cov is None:  # the predictor is trust
        return f, log_p

    # Trust given the predictor f = trust + shared noise.
    V = each(predictor.covariance, source.label)
    S = each(predictor.trust_cov, source.label)
    gain = np.swapaxes(np.linalg.solve(V, S), 2, 3)
    x = mean + (gain @ (f - mean)[..., None])[..., 0]
    return x + (root_of(S - gain @ S) @ rng.standard_normal((*x.shape, 1)))[..., 0], log_p


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
