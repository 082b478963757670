"""The posterior of a model class in the normal scores of its hyperparameters."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from trustbo.inference import ep
from trustbo.inference.columns import Columns
from trustbo.inference.density import Coefficients, Density, Outer
from trustbo.inference.ep_density import ByEP
from trustbo.inference.mixture import Mixture
from trustbo.inference.modes import climb
from trustbo.models.effects.effect import Theta
from trustbo.models.model import TrustModel
from trustbo.models.observations import Observations
from trustbo.statespace import Inputs

_BATCH = 128
"""Number of points for which hyperparameters are computed at once."""
_FEW = 15
"""Number of missions with which the search for the mode begins."""
_SIZES = (0.3, 1.0, 1.8, 2.6)
"""Log ratios of the sd of rates to the noises at each start of the search."""
_USUAL_NOISE = 0.2
"""Scale of the default priors of the noises, to which the sd of rates is compared."""
_SPREADS = (1e-2, 3.0)
"""Limits of the ratio of the sd of rates to the usual noise."""
_LARGEST_NOISE = 50.0
"""Largest size of the noises whose density is computed; see `NormalScores`."""
_LEAST_NOISE = 1e-6
"""Smallest size of the noises whose density is computed."""
_WIDER = 1.5
"""Factor on the covariance of the core scores in the defensive proposal."""
_PRIOR_VARIANCE = 1.2
"""Variance of the other scores in the defensive proposal; a priori, it is 1."""


class ClassTarget:
    """Posterior of the scores of a model, whose coefficients are integrated out.

    Attributes:
        model: The model.
        observations: Rates and awareness of the missions.
        scores: Conversion of scores to hyperparameters.
        density: Density of the rates.
        evaluated: Called with the number of points whose density is computed.
    """

    def __init__(self, model: TrustModel, observations: Observations) -> None:
        self.model = model
        self.observations = observations
        self.evaluated: Callable[[int], object] = lambda n: None
        self.scores = model.scores(observations)
        self.n_scores = self.scores.n_scores

        kind = Density if model.likelihood.gaussian else ByEP
        columns = Columns(model.terms, observations)
        self.density: Any = kind(columns, model.layout(observations), model.likelihood)

    @property
    def columns(self) -> Columns:
        """Feature weights and effects, with the rates and awareness of the missions."""
        return self.density.columns

    @property
    def is_gaussian(self) -> bool:
        """Whether rates are Gaussian; otherwise, the density is that of EP."""
        return self.density.is_gaussian

    def theta(self, z: np.ndarray) -> dict[str, Any]:
        """Convert scores (point, score) to hyperparameters for the model's `state_space`."""
        return self.model.theta(self.scores.values(z), self.observations.resolution)

    def outer(self, z: np.ndarray) -> Outer:
        """Return what the model says at scores (point, score)."""
        size = np.exp(z[:, self.scores.noises])
        has_size = ((size > _LEAST_NOISE) & (size < _LARGEST_NOISE)).all(1)
        log_prior = np.where(has_size, self.scores.log_prior(z), -np.inf)
        return self.outer_of(self.theta(z))._replace(log_p=log_prior)

    def outer_of(self, theta: Theta) -> Outer:
        """Return what the model says given hyperparameters (point, ...), without their prior."""
        observations = self.observations
        noise = self.model.noise_scale(theta, observations)
        return Outer(
            log_p=np.zeros(len(theta["inverse_gain"])),
            space=self.model.state_space(theta, observations.n_robots),
            inputs=Inputs(0.0, 0.0, noise),
            theta=theta,
            random=self.model.random_effects(theta, observations),
        )

    def _batches(self, z: np.ndarray) -> Iterator[tuple[slice, Outer]]:
        """Yield slices of the points, and what the model says there."""
        for start in range(0, max(1, len(z)), _BATCH):  # once, also without points
            where = slice(start, start + _BATCH)
            with np.errstate(all="ignore"):  # extreme scores overflow and get zero density
                outer = self.outer(z[where])
            self.evaluated(len(outer.log_p))
            yield where, outer

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Compute the unnormalised log posterior density (point,) of scores (point, score)."""
        return np.concatenate([self.density.log_density(outer) for _, outer in self._batches(z)])

    def visit(
        self, z: np.ndarray, rng: np.random.Generator, sites: ep.Sites | None = None
    ) -> tuple[np.ndarray, Coefficients]:
        """Compute `log_density`, and the coefficients at each point.

        `sites` are those of `sites_at`, if coefficients are to be closer to the posterior.
        """
        parts = []
        for where, outer in self._batches(z):
            options = {} if sites is None else {"sites": sites.of(where)}
            parts.append(self.density.visit(outer, rng, **options))
        log_p, found = zip(*parts, strict=True)
        return np.concatenate(log_p), Coefficients.joined(found)

    def sites_at(self, z: np.ndarray) -> ep.Sites:
        """Find the EP sites at each point (point, score)."""
        parts = [self.density.sites_at(outer) for _, outer in self._batches(z)]
        return ep.Sites(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))

    def log_joint(
        self,
        z: np.ndarray,
        c: np.ndarray,
        rng: np.random.Generator,
        sites: ep.Sites | None = None,
    ) -> np.ndarray:
        """Estimate the log joint density of scores, coefficients and rates; see `ByEP`."""
        parts = []
        for where, outer in self._batches(z):
            here = sites and sites.of(where)
            parts.append(self.density.log_joint(outer, c[where], rng, here))
        return np.concatenate(parts)

    def log_evidence(self, theta: Theta) -> np.ndarray:
        """Compute log p(rates | theta) (point,) given hyperparameters (point, ...)."""
        return self.density.log_evidence(self.outer_of(theta))

    def draw_coefficients(self, theta: Theta, rng: np.random.Generator) -> np.ndarray:
        """Draw the coefficients (point, column) once at each point, given Gaussian rates."""
        return self.density.draw_coefficients(self.outer_of(theta), rng)

    def run_ep(self, theta: Theta) -> None:
        """Find the EP sites at the mean of theta, which determine those at other points."""
        center = {name: values.mean(0, keepdims=True) for name, values in theta.items()}
        self.density.run_ep(self.outer_of(center))

    def without(self, mission: int) -> "ClassTarget":
        """Return the posterior without the data of one mission."""
        other = ClassTarget(self.model, self.observations.without([mission]))
        if not self.is_gaussian:
            kept = ~np.isnan(other.density.rates.y)
            sites = (np.where(kept, site, 0.0) for site in self.density.sites)
            other.density.sites = ep.Sites(*sites)
        return other

    def start(self) -> np.ndarray:
        """Return a starting point for the search for the mode or, with EP, the mode itself.

        With many missions, the starting point is the mode given the first few missions, for which
        the density is cheaper to compute.
        """
        few = self.observations.first(_FEW)
        if self.observations.n_missions >= 2 * _FEW and not np.isnan(few.contact_rate).all():
            of_few = ClassTarget(self.model, few)
            best = climb(of_few.log_density, of_few.start())
        else:
            best = self._best_of_four_starts()

        if not self.is_gaussian:
            # The approximate density is most accurate near the theta of `run_ep`.
            self.run_ep(self.theta(best[None]))
            best = climb(self.log_density, best)
            self.run_ep(self.theta(best[None]))
        return best

    def _best_of_four_starts(self) -> np.ndarray:
        """Return the best of four points, at which the noises have different sizes."""
        starts = np.zeros((len(_SIZES), self.n_scores))
        unit = self.model.likelihood.line_of_sight[0]
        ratio = unit * np.nanstd(self.observations.contact_rate) / _USUAL_NOISE
        spread = np.log(np.clip(ratio, *_SPREADS))
        starts[:, self.scores.noises] = spread - np.array(_SIZES)[:, None]

        self.run_ep(self.theta(starts[1:2]))  # the sites of the second start suit all four
        return starts[self.log_density(starts).argmax()]

    def defensive(self, proposal: Mixture) -> Mixture:
        """Widen a proposal for beta0, noises and sizes; keep other scores near the prior."""
        core = self.scores.core
        others = np.setdiff1d(np.arange(self.n_scores), core)

        center = proposal.mean
        center[others] = 0.0

        cov = _WIDER * proposal.total
        cov[others] = 0.0
        cov[:, others] = 0.0
        cov[others, others] = _PRIOR_VARIANCE
        return Mixture.single(center, np.linalg.cholesky(cov))
