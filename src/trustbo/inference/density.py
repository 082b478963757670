"""The posterior density of a model for samplers, and draws of coefficients."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from scipy import special

from trustbo.inference import ep
from trustbo.inference.columns import Columns
from trustbo.inference.engine import Blocks, Fit, Prior, coefficients_of, evidence, expected
from trustbo.inference.mixture import Mixture
from trustbo.inference.modes import climb
from trustbo.models.effects.effect import Theta
from trustbo.models.model import TrustModel
from trustbo.models.observations import Observations
from trustbo.statespace.blocks import LinearPredictor, rate_precision

_CHUNK = 32
"""Largest number of points evaluated at once."""
_LEAST_CHUNK = 8
"""Smallest number of points evaluated at once, for which vector instructions still pay."""
_NUMBERS = 12_000_000
"""Largest number of precision entries of the points evaluated at once."""
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
_SWEEPS = 1
"""Number of EP sweeps at each point for an evidence, beginning with the sites at the mode."""
_LAST_SWEEPS = 2
"""The same, for coefficients where those of the sites at the mode give uneven weights."""
_SETTLED = 12
"""Largest number of EP sweeps that find the sites at the mode."""
_STEADY = 1e-3
"""Relative change of the sites in a sweep below which the sweeps end."""
_DAMPING = 0.7
"""Damping of the EP sweeps that find the sites at the mode."""
_DEVIATIONS = 4
"""Number of draws of the coefficients that are kept at each visited point."""
_LEAST_DEGREES = 8.0
"""Smallest number of degrees of freedom of a proposal of coefficients."""
_SQUARED = 3.0
"""Squared number of columns per degree of freedom of a proposal of coefficients."""
_WIDER = 1.5
"""Factor on the covariance of the core scores in the defensive proposal."""
_PRIOR_VARIANCE = 1.2
"""Variance of the other scores in the defensive proposal; a priori, it is 1."""


class JointDraws(NamedTuple):
    """Draws of hyperparameters and coefficients."""

    theta: dict[str, np.ndarray]  # (draw, ...)
    c: np.ndarray  # (draw, column)

    def at(self, index: np.ndarray) -> Self:
        """Select draws by index."""
        return self._replace(theta=at(self.theta, index), c=self.c[index])


class Coefficients(NamedTuple):
    """Normal distributions of the coefficients at points, represented by draws."""

    mean: np.ndarray  # (point, column)
    deviation: np.ndarray  # (point, deviation, column), independent draws minus the mean
    gram: np.ndarray  # (point, deviation, deviation), products of the whitened deviations
    log_det: np.ndarray  # (point,), of the factor of the precision

    @classmethod
    def empty(cls, n_points: int, n_columns: int) -> Self:
        """Make room for the distributions at n points."""
        k = _DEVIATIONS
        shapes = (n_columns,), (k, n_columns), (k, k), ()
        return cls(*(np.zeros((n_points, *shape)) for shape in shapes))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Join the distributions of several groups of points."""
        return cls(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))

    def draw(self, index: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draw coefficients (draw, column) at the points with the given index (draw,).

        A combination of independent deviations with a random unit vector has the same normal
        distribution as each deviation, so a point can be drawn any number of times.
        """
        return self._combined(index, self._directions(len(index), rng))

    def propose(self, index: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw coefficients from Student-t distributions; also return log densities (draw,).

        These distributions have the means and precisions of the normal distributions. The fewer
        columns, the heavier their tails, which cover the errors of EP.
        """
        p = self.mean.shape[1]
        nu = max(_LEAST_DEGREES, p**2 / _SQUARED)
        unit = self._directions(len(index), rng)
        unit /= np.sqrt(rng.chisquare(nu, (len(index), 1)) / nu)

        square = np.einsum("ni,nij,nj->n", unit, self.gram[index], unit)
        log_q = special.gammaln(0.5 * (nu + p)) - special.gammaln(0.5 * nu)
        log_q = log_q - 0.5 * p * np.log(nu * np.pi) + self.log_det[index]
        log_q = log_q - 0.5 * (nu + p) * np.log1p(square / nu)
        return self._combined(index, unit), log_q

    def _directions(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw random unit vectors (draw, deviation)."""
        unit = rng.standard_normal((n, self.deviation.shape[1]))
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        return unit

    def _combined(self, index: np.ndarray, factors: np.ndarray) -> np.ndarray:
        """Add the sums of the deviations times factors (draw, deviation) to the means."""
        drawn = self.mean[index]
        for point in np.unique(index):
            here = index == point
            drawn[here] += factors[here] @ self.deviation[point]
        return drawn


class Density:
    """Posterior density of a model's scores, and draws of its coefficients given the scores."""

    def __init__(self, model: TrustModel, observations: Observations) -> None:
        """Prepare the design matrix and blocks of a model for the observations."""
        self.model = model
        self.observations = observations
        self.evaluated: Callable[[int], object] = lambda n: None  # called with the number of points
        self.layout = model.layout(observations)
        self.scores = model.scores(observations)
        self.n_scores = self.scores.n_scores

        self.columns = Columns(model.terms, observations)
        self.prior = self.columns.prior
        self.is_gaussian = model.likelihood.gaussian

        # Which columns depend on each other a priori, and which blocks have equal noise, does not
        # depend on theta, so any will do.
        y = self.layout.rows(observations.contact_rate)
        predictor, prior = self._at(self.theta(np.zeros((1, self.n_scores))))
        U = self.layout.design(self.columns.U)
        self.blocks = Blocks.from_rows(
            y, U, self.layout.label, predictor.noise_sd[0], prior=prior, apart=not self.is_gaussian
        )
        if not self.is_gaussian:
            self.rates = ep.Rates(model.likelihood, y, self.layout.rows(observations.n_ticks))
            self.reset_ep()

    @property
    def _n_at_once(self) -> int:
        """Number of points evaluated at once, which limits the memory for their matrices."""
        return int(np.clip(_NUMBERS // self.blocks.order.size, _LEAST_CHUNK, _CHUNK))

    def without(self, mission: int) -> "Density":
        """Return the density without the data of one mission."""
        other = Density(self.model, self.observations.without([mission]))
        if not self.is_gaussian:
            kept = ~np.isnan(other.rates.y)
            other.sites = ep.Sites(*(np.where(kept, site, 0.0) for site in self.sites))
        return other

    def theta(self, z: np.ndarray) -> dict[str, Any]:
        """Convert scores (point, score) to hyperparameters for the model's `linear_predictor`."""
        return self.model.theta(self.scores.values(z), self.observations.resolution)

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Compute the unnormalised log posterior density (point,) of scores (point, score).

        Unless rates are Gaussian, the density is that of EP near the theta of `run_ep`, in the
        approximation of `ep.nearby`.
        """
        log_p = np.full(len(z), -np.inf)
        with np.errstate(all="ignore"):  # extreme scores overflow and get zero density
            theta, log_prior, some = self.possible(z)
            for where, chunk in chunks(theta, self._n_at_once):
                fit, _ = self._fit(chunk)
                log_p[some[where]] = fit.log_p
            log_p[some] += log_prior
        return np.where(np.isfinite(log_p), log_p, -np.inf)

    def visit(
        self, z: np.ndarray, rng: np.random.Generator, sites: ep.Sites | None = None
    ) -> tuple[np.ndarray, Coefficients]:
        """Compute the log density of `log_density` and the coefficients at each point.

        With the sites of `run_ep_at`, the coefficients are closer to the posterior; the log density
        is then that of rates equal to the sites.
        """
        log_p = np.full(len(z), -np.inf)
        found = Coefficients.empty(len(z), self.columns.n)

        with np.errstate(all="ignore"):  # extreme scores overflow and get zero density
            theta, log_prior, some = self.possible(z)
            for where, chunk in chunks(theta, self._n_at_once):
                fit, prior = self._fit(chunk, sites and sites.of(some[where]))
                log_p[some[where]] = fit.log_p
                parts = coefficients_of(prior, fit, _DEVIATIONS, rng)
                for values, part in zip(found, (*parts, fit.F.log_det), strict=True):
                    values[some[where]] = part
            log_p[some] += log_prior

        return np.where(np.isfinite(log_p), log_p, -np.inf), found

    def possible(self, z: np.ndarray) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
        """Return hyperparameters, log priors and indices where the density may be positive."""
        theta = self.theta(z)
        log_prior = self.scores.log_prior(z)
        size = np.exp(z[:, self.scores.noises])
        flat = [np.asarray(values).reshape(len(z), -1) for values in theta.values()]

        possible = np.isfinite(np.column_stack([*flat, log_prior])).all(1)
        possible &= ((size > _LEAST_NOISE) & (size < _LARGEST_NOISE)).all(1)
        possible &= (theta["inverse_gain"].reshape(len(z), -1) != 0.0).all(1)

        some = np.flatnonzero(possible)
        return at(theta, some), log_prior[some], some

    def log_evidence(self, theta: Theta) -> np.ndarray:
        """Compute log p(rates | theta) at each point, with EP if rates are not Gaussian."""
        log_p = np.empty(len(theta["inverse_gain"]))
        for where, chunk in chunks(theta, self._n_at_once):
            if self.is_gaussian:
                fit, _ = self._fit(chunk)
                log_p[where] = fit.log_p
            else:
                joint = self._joint(chunk)
                sites = ep.swept(joint, self.sites, _SWEEPS)
                log_p[where] = ep.log_evidence(joint, sites)
        return log_p

    def reset_ep(self) -> None:
        """Forget the EP sites, so that results do not depend on earlier computations."""
        if not self.is_gaussian:
            self.sites = ep.first_sites(self.rates)

    def run_ep(self, theta: Theta) -> None:
        """Find the EP sites at the mean of theta, which determine those at other points."""
        if not self.is_gaussian:
            center = {name: values.mean(0, keepdims=True) for name, values in theta.items()}
            joint = self._joint(center)
            for _ in range(_SETTLED):
                before = self.sites
                self.sites = ep.swept(joint, before, 1, _DAMPING)
                if self.sites.close_to(before, _STEADY):
                    break
            self.near = ep.Nearby.from_sites(joint, self.sites)

    def run_ep_at(self, z: np.ndarray) -> ep.Sites:
        """Find the EP sites at each point (point, score); they are 0 where the density is 0."""
        shape = (len(z), *self.rates.y.shape)
        found = ep.Sites(np.zeros(shape), np.zeros(shape))
        with np.errstate(all="ignore"):  # as in `log_density`
            theta, _, some = self.possible(z)
            for where, chunk in chunks(theta, self._n_at_once):
                sites = ep.swept(self._joint(chunk), self.sites, _LAST_SWEEPS)
                for values, part in zip(found, sites, strict=True):
                    values[some[where]] = part
        return found

    def start(self) -> np.ndarray:
        """Return a starting point for the search for the mode or, with EP, the mode itself.

        With many missions, the starting point is the mode given the first few missions, for which
        the density is cheaper to compute.
        """
        few = self.observations.first(_FEW)
        if self.observations.n_missions >= 2 * _FEW and not np.isnan(few.contact_rate).all():
            of_few = Density(self.model, few)
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

    def log_joint(
        self,
        z: np.ndarray,
        c: np.ndarray,
        rng: np.random.Generator,
        sites: ep.Sites | None = None,
    ) -> np.ndarray:
        """Estimate the log joint density (draw,) of scores, coefficients and rates.

        The linear predictors are drawn and weighted, so that the mean of the estimated densities is
        exact.

        Args:
            z: Normal scores (draw, score).
            c: Coefficients (draw, column).
            rng: Random number generator.
            sites: EP sites at each draw, by default those near the theta of `run_ep`. The better
                they are, the more even are the weights.
        """
        theta = self.theta(z)
        log_p = self.scores.log_prior(z)
        for where, chunk in chunks(theta):
            joint = self._joint(chunk)
            at = expected(self.blocks, joint.predictor, c[where])
            if sites is None:
                here, _ = self.near.at(self.rates, joint.predictor.noise_sd)
            else:
                here = sites.of(where)
            _, log_block = ep.draw_predictors(joint, at, here, rng)
            log_p[where] += joint.prior.log_density(c[where]) + log_block.sum(1)
        return log_p

    def draw_coefficients(self, theta: Theta, rng: np.random.Generator) -> np.ndarray:
        """Draw the coefficients (point, column) once at each point, given Gaussian rates."""
        drawn = []
        for _, chunk in chunks(theta):
            fit, prior = self._fit(chunk)
            mean, deviation, _ = coefficients_of(prior, fit, 1, rng)
            drawn.append(mean + deviation[:, 0])
        return np.concatenate(drawn)

    def _fit(self, theta: Theta, sites: ep.Sites | None = None) -> tuple[Fit, Prior]:
        """Compute the evidence at each theta, as in `visit`; also return the prior."""
        if not self.is_gaussian:
            joint = self._joint(theta)
            if sites is None:
                fit = ep.nearby(joint, self.near)
            else:
                fit = evidence(self.blocks, joint.predictor, joint.prior, sites.lam, sites.y)
            return fit, joint.prior

        predictor, prior = self.given(theta)
        return evidence(self.blocks, predictor, prior, self.rate_precision(predictor)), prior

    def given(self, theta: Theta) -> tuple[LinearPredictor, Prior]:
        """Return the distribution of the linear predictors and the prior at each theta."""
        self.evaluated(len(theta["inverse_gain"]))
        return self._at(theta)

    def _at(self, theta: Theta) -> tuple[LinearPredictor, Prior]:
        """See `given`."""
        predictor = self.model.linear_predictor(theta, self.observations, self.layout)
        return predictor, self.prior(theta)

    def rate_precision(self, predictor: LinearPredictor) -> Any:
        """Return the precisions (point, kind, row) of Gaussian rates, 0 where not measured.

        Here, the noise of a measured rate enters: its sd is `delta_v`, to which `TrustModel.theta`
        adds the resolution of the rate, times `TrustModel.noise_scale`.
        """
        return rate_precision(self.blocks.seen, predictor.noise_sd, self.blocks.first)

    def _joint(self, theta: Theta) -> ep.Joint:
        """Return the blocks, linear predictors, prior and observations for EP at each theta."""
        return ep.Joint(self.blocks, *self.given(theta), self.rates)


def at(theta: Mapping[str, Any], index: Any) -> dict[str, Any]:
    """Select the hyperparameters at the given points."""
    return {name: values[index] for name, values in theta.items()}


def chunks(theta: Mapping[str, Any], size: int = _CHUNK) -> Iterator[tuple[slice, dict[str, Any]]]:
    """Yield the slice and the hyperparameters of each chunk of points."""
    for start in range(0, len(theta["inverse_gain"]), size):
        where = slice(start, start + size)
        yield where, at(theta, where)
