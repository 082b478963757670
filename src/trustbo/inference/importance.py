"""Adaptive importance sampling from mixtures of Student-t distributions, for any log density.

It needs no gradient, and samples scores, which are coordinates that are about standard normal a
priori. `sample` runs rounds. Each of them draws points from the current proposal, and from a
defensive proposal, which covers regions that the current one misses. All proposals so far form a
mixture q, and every point has the weight p / q (adaptive multiple importance sampling; Cornuet,
Marin, Mira and Robert 2012). The next proposal is fitted to the weighted points. It has
one component, like a proposal at a mode, until k-hat is bad after round 2 or later; then it has
several. Sampling stops when k-hat and the effective number of points are good.

The weights are Pareto-smoothed (Vehtari, Simpson, Gelman, Yao and Gabry 2024). The mean weight
before smoothing is an estimate of the evidence.
"""

from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np

from trustbo.inference.mixture import MANY, STEPS, STEPS_OF_MANY, Mixture, n_components
from trustbo.inference.modes import LogDensity
from trustbo.inference.weights import GOOD_KHAT, resampled, smoothed

ENOUGH = 500.0
"""Effective number of points at which sampling stops."""
ROUNDS = 8
"""Largest number of rounds by default."""
SIZE = 256
"""Number of points of a round by default."""
_WIDER = 1.1
"""Scale of a proposal relative to the points to which it is fitted."""
_DEFENSIVE = 0.11
"""Share of the defensive proposal in a round by default."""
_FIRST_DEFENSIVE = 0.5
"""The same in the first round, if the first proposal is only that of a mode."""
_EFFICIENCY = 0.6
"""Expected number of effective points per point, used to choose the size of the last rounds."""
_LEAST_ROUND = 4
"""Smallest round, as a divisor of the usual number of points."""
_PER_AXIS = 4.0
"""Number of effective points per dimension that is needed to estimate moments."""
_FLATTENED = 6
"""Largest number of times that uneven weights are replaced by their square roots."""


class Points(NamedTuple):
    """Weighted points of a posterior."""

    x: np.ndarray
    """Points, shape (point, coordinate)."""
    log_p: np.ndarray
    """Log density of the points, shape (point,)."""
    log_ratio: np.ndarray
    """Log density relative to the mixture of all proposals, shape (point,)."""
    weight: np.ndarray
    """Pareto-smoothed weights with sum 1, shape (point,)."""
    k_hat: float
    """Pareto shape of the weights, which is good below 0.5 and bad above 0.7."""
    log_evidence: float
    """Log of the integral of the density."""
    complaints: tuple[str, ...] = ()
    """Reasons why the points do not represent the posterior, where independent runs were made."""

    @classmethod
    def weighted(cls, x: np.ndarray, log_p: np.ndarray, log_ratio: np.ndarray) -> Self:
        """Smooth the importance weights of points; see the attributes."""
        return cls(x, log_p, log_ratio, *smoothed(log_ratio))

    @property
    def kish(self) -> float:
        """Effective number of points, which is 1 / sum of squared weights."""
        return 1.0 / float((self.weight**2).sum())

    @property
    def _n_for_moments(self) -> float:
        """Effective number of points that is needed to estimate moments."""
        return _PER_AXIS * self.x.shape[1]

    @property
    def is_enough_for_moments(self) -> bool:
        """Whether enough points are effective to estimate moments."""
        return self.kish >= self._n_for_moments

    @property
    def flattened(self) -> np.ndarray:
        """Weights (point,) or, if few points dominate, roots of these weights."""
        weight = self.weight
        for _ in range(_FLATTENED):
            if (weight**2).sum() * self._n_for_moments <= 1.0:
                break
            weight = np.sqrt(weight) / np.sqrt(weight).sum()
        return weight

    def resample(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw indices of `n` equally weighted points; see `weights.resampled`."""
        return resampled(self.weight, n, rng)


class Sampled(NamedTuple):
    """Result of `sample`."""

    points: Points
    proposals: Mixture
    """Mixture of all proposals, with shares of their numbers of points."""
    proposal: Mixture
    """One component that is fitted to the points."""
    is_far: bool
    """Whether too few points of the first round were effective to estimate moments. A first
    proposal that is given is then far from the posterior."""


class Rounds:
    """Points of rounds, weighted by the mixture of the proposals of these rounds."""

    def __init__(self, most: int | None = None) -> None:
        """Begin without points; only those of the last `most` rounds are kept."""
        self.most = most
        self.proposals: list[Mixture] = []
        self._x: list[np.ndarray] = []
        self._log_p: list[np.ndarray] = []
        self._log_q: list[np.ndarray] = []  # of all points, for each proposal

    @property
    def x(self) -> np.ndarray:
        """Points (point, coordinate)."""
        return np.concatenate(self._x)

    @property
    def log_p(self) -> np.ndarray:
        """Log density (point,) of the points."""
        return np.concatenate(self._log_p)

    @property
    def newest(self) -> tuple[np.ndarray, np.ndarray]:
        """Points of the last round, and their log densities."""
        return self._x[-1], self._log_p[-1]

    def add(self, proposal: Mixture, n: int, density: LogDensity, rng: np.random.Generator) -> None:
        """Draw n points from a proposal, a power of 2; forget the first round if there are many."""
        if len(self._x) == self.most:
            n_first = len(self._x[0])
            for values in (self._x, self._log_p, self._log_q, self.proposals):
                values.pop(0)
            self._log_q = [log_q[n_first:] for log_q in self._log_q]

        new = proposal.draw(n, rng)
        log_p = density(new)
        self._x.append(new)
        self._log_p.append(np.where(np.isfinite(log_p), log_p, -np.inf))

        pairs = zip(self._log_q, self.proposals, strict=True)
        self._log_q = [np.append(log_q, one.log_density(new)) for log_q, one in pairs]
        self._log_q.append(proposal.log_density(self.x))
        self.proposals.append(proposal)

    @property
    def _shares(self) -> np.ndarray:
        """Share (proposal,) of the points of each proposal."""
        sizes = np.array([len(x) for x in self._x], float)
        return sizes / sizes.sum()

    def log_q(self) -> np.ndarray:
        """Log density (point,) of the mixture of all proposals."""
        log_share = np.log(self._shares)
        return np.logaddexp.reduce(np.array(self._log_q) + log_share[:, None], axis=0)

    @property
    def mixture(self) -> Mixture:
        """Mixture of all proposals."""
        return Mixture.joined(self.proposals, self._shares)

    @property
    def points(self) -> Points:
        """The weighted points."""
        return Points.weighted(self.x, self.log_p, ratio(self.log_p, self.log_q()))


def sample(
    log_density: LogDensity,
    origin: Mixture,
    rng: np.random.Generator,
    *,
    defensive: Callable[[Mixture], Mixture],
    is_known: bool = False,
    size: int = SIZE,
    enough: float = ENOUGH,
    most: int = ROUNDS,
    good: float = GOOD_KHAT,
    wary: float = _DEFENSIVE,
    visit: LogDensity | None = None,
) -> Sampled:
    """Sample a posterior of scores; the caller must check `k_hat`.

    Args:
        log_density: Log posterior density of scores.
        origin: First proposal, such as that of `modes.at_modes`.
        rng: Random number generator.
        defensive: Function that returns a proposal for regions that the current one may miss.
        is_known: Whether the first proposal is that of a posterior, rather than of modes.
        size: Number of points per round, a power of 2.
        enough: Effective number of points at which sampling stops if k-hat is good.
        good: Largest k-hat that is good.
        most: Maximum number of rounds.
        wary: Share of the defensive proposal in a round.
        visit: Log density of the drawn points, in the order of `Points.x`, for callers that record
            something with each point; by default `log_density`.
    """
    d = origin.center.shape[1]
    n_steps = STEPS if d <= MANY else STEPS_OF_MANY
    visit = visit or log_density
    rounds = Rounds()
    n = size
    one = origin if len(origin.share) == 1 else None  # fitted to all points
    many = None if one else origin  # components of the fit by expectation maximisation
    uneven = False
    is_far = False
    while True:
        own = [mixture for mixture in (one, many) if mixture]
        current = Mixture.joined(own, np.full(len(own), 1.0 / len(own)))
        is_first = not rounds.proposals
        share = _FIRST_DEFENSIVE if is_first and not is_known else wary
        parts = [current.scaled(_WIDER), defensive(current)]
        rounds.add(Mixture.joined(parts, [1.0 - share, share]), n, visit, rng)

        n_rounds = len(rounds.proposals)
        points = rounds.points
        is_far = is_far or (is_first and not points.is_enough_for_moments)
        is_good = points.k_hat < good
        if (is_good and points.kish > enough and n_rounds > 1) or n_rounds == most:
            return Sampled(points, rounds.mixture, fitted_near(points, origin), is_far)

        uneven = uneven or (not is_good and n_rounds > 1)
        if one:
            one = fitted_near(points, origin)
        if (many or uneven) and np.isfinite(points.log_ratio).any():
            if not many or (uneven and len(many.share) < n_components(d)):
                many = Mixture.near(points.x, points.flattened, n_components(d), rng)
            many = many.fitted(points.x, points.flattened, n_steps)
        missing = max(enough - points.kish, 1.0) / _EFFICIENCY
        least = size if uneven else size // _LEAST_ROUND
        n = int(np.clip(2 ** np.ceil(np.log2(missing)), least, size))


def fitted_near(points: Points, origin: Mixture) -> Mixture:
    """Fit one component to points; it stays near the first proposal if few points are effective.

    If no point has a positive density, there is nothing to fit, and it is the first proposal.
    """
    if not np.isfinite(points.log_ratio).any():
        return origin
    return Mixture.of_points(points.x, points.flattened, origin)


def ratio(log_p: np.ndarray, log_q: np.ndarray) -> np.ndarray:
    """Return log (p / q) (point,), which is -inf where p is 0."""
    return np.where(np.isfinite(log_p), log_p - np.where(np.isfinite(log_q), log_q, 0.0), -np.inf)
