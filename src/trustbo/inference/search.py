"""Search for a posterior by a tempered path of densities, where its modes are not enough.

Each round draws points from a mixture, and fits the next mixture to the points of the last rounds
by expectation maximisation (Cappe, Douc, Guillin, Marin and Robert 2008). A point has the weight
q0 (p / q0)^beta / q, where q0 is the first proposal and q the mixture of the proposals of these
rounds (Cornuet, Marin, Mira and Robert 2012). beta is as large as leaves enough effective points,
so mixtures move step by step from the start to the posterior. Then, the points that were drawn on
the way are compared with the last mixture. If some of them have a density that is far above it, and
lower densities lie between, they belong to a mode that was lost, and another search begins there.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import special

from trustbo.inference.importance import Rounds
from trustbo.inference.mixture import MANY, Mixture, n_components
from trustbo.inference.modes import LogDensity

_SIZE = 512
"""Number of points of a round."""
_WINDOW = 12
"""Number of the last rounds whose points are used in the search."""
_STEP = 0.15
"""Part of this number to which a step of beta may reduce it."""
_PATIENT = 5
"""Number of such rounds after which a step may halve it."""
_GAIN = 0.05
"""Smallest gain of log beta, or of the log effective number of points, that counts as progress."""
_STALLED = 30
"""Number of rounds without progress after which a search has failed."""
_MOST_SEARCHED = 100_000
"""Number of points after which a search has failed."""
_RIPE = 3.0
"""A search ends when this multiple of the required effective points is reached at beta = 1, ..."""
_RIPE_ROUNDS = 2
"""... or when so many rounds at beta = 1 bring no progress."""
_LOST = np.log(1000.0)
"""Log ratio of the posterior to the mixture from which on a point may be in a lost mode."""
_N_LOST = 8
"""Largest number of such points that are examined."""
_N_STEPS = 64
"""Number of points on the way from each of them to the last mixture."""
_BARRIER = 3.0
"""Smallest difference of log densities that separates a lost mode."""
_FIRST = 0.8
"""Share of the first proposal that is fitted to the first of several starts."""
_FARTHEST = 1e5
"""Smaller log weights, relative to the largest one, are raised to this distance."""
_FIRST_LOG_BETA = -20.0
"""Log beta of the first round, at which the density is practically that of the first proposal."""
_BISECTIONS = 20
"""Number of steps of the search for beta."""


def search(
    log_density: LogDensity, starts: Sequence[np.ndarray], wanted: float, rng: np.random.Generator
) -> tuple[Mixture, float]:
    """Search for the posterior; return the last mixture, and log beta, which is 0 at the end."""
    found, log_beta, visited = _searched(log_density, starts, wanted, rng)
    if log_beta < 0.0:
        return found, log_beta

    if found.center.shape[1] > MANY:
        return found, log_beta  # the points of a bent posterior would look like other modes

    lost = lost_modes(visited, found, log_density)
    if len(lost):
        scale = np.linalg.cholesky(found.within)
        share = np.full(len(lost), 1.0 / len(lost))
        around = Mixture.even(share, lost, np.repeat(scale[None], len(lost), axis=0))
        start = around.draw(_SIZE, rng)
        other, log_beta, _ = _searched(log_density, [start], wanted, rng)
        found = Mixture.joined([found, other], [0.5, 0.5])
    return found, log_beta


class Visited(NamedTuple):
    """Points of a search, with their log densities, and the log evidence at its end."""

    x: np.ndarray  # (point, coordinate)
    log_p: np.ndarray  # (point,)
    log_evidence: float


def _searched(
    log_density: LogDensity, starts: Sequence[np.ndarray], wanted: float, rng: np.random.Generator
) -> tuple[Mixture, float, Visited]:
    """Search from some starts; see `search`."""
    first = [fitted_to(x, rng) for x in starts]
    n_others = len(first) - 1
    shares = [_FIRST, *[(1.0 - _FIRST) / n_others] * n_others] if n_others else [1.0]
    mixture = Mixture.joined(first, shares)

    origin = mixture
    d = origin.center.shape[1]
    most = n_components(d)
    rounds = Rounds(_WINDOW)
    log_beta = _FIRST_LOG_BETA
    best = -np.inf
    n_idle = 0
    visited = []
    while True:
        rounds.add(mixture, _SIZE, log_density, rng)
        visited.append(rounds.newest)
        if not np.isfinite(rounds.log_p).any():  # there is nothing to fit a mixture to
            return mixture, _FIRST_LOG_BETA, _joined(visited, -np.inf)

        path = _Path(rounds, origin)
        part = _STEP if d > MANY else max(0.5 ** (n_idle // _PATIENT), _STEP)
        log_beta, log_weight = path.next(log_beta, min(wanted, path.n_points / 4), part)
        weight = special.softmax(log_weight)
        if len(mixture.share) < most:
            mixture = Mixture.near(rounds.x, weight, most, rng)
        mixture = mixture.fitted(rounds.x, weight).evened()

        progress = log_beta
        if log_beta == 0.0:
            progress = np.log(path.n_effective(0.0) / wanted)
        n_idle = 0 if progress > best + _GAIN else n_idle + 1
        best = max(best, progress)

        is_ripe = n_idle >= _RIPE_ROUNDS or progress > np.log(_RIPE)
        has_failed = n_idle > _STALLED or len(visited) * _SIZE >= _MOST_SEARCHED
        if (log_beta == 0.0 and is_ripe) or has_failed:
            return mixture, log_beta, _joined(visited, path.log_evidence)


def _joined(parts: Sequence[tuple[np.ndarray, np.ndarray]], log_evidence: float) -> Visited:
    """Join the points of all rounds."""
    x, log_p = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return Visited(x, log_p, log_evidence)


def lost_modes(visited: Visited, found: Mixture, log_density: LogDensity) -> np.ndarray:
    """Return visited points (point, coordinate) in modes that a mixture has lost.

    On the way from each of them to the nearest component, the density is lower at one place. In the
    tails of a mode, it is not.
    """
    ratio = visited.log_p - found.log_density(visited.x) - visited.log_evidence
    outside = np.flatnonzero(ratio > _LOST)
    if not len(outside):
        return visited.x[:0]

    best = outside[np.argsort(-visited.log_p[outside], kind="stable")[:_N_LOST]]
    x = visited.x[best]
    nearest = found.center[found.nearest(x)]

    step = np.linspace(0.0, 1.0, _N_STEPS)[:, None, None]
    way = x + step * (nearest - x)
    log_p = log_density(way.reshape(-1, x.shape[1])).reshape(_N_STEPS, len(x))
    lowest = np.where(np.isfinite(log_p), log_p, -np.inf).min(0)
    return x[lowest < np.minimum(log_p[0], log_p[-1]) - _BARRIER]


class _Path:
    """Densities q0 (p / q0)^beta between the first proposal q0 and the posterior p.

    As the path is fixed, the shares of several modes cannot drift from round to round.
    """

    def __init__(self, rounds: Rounds, origin: Mixture) -> None:
        self._log_origin = origin.log_density(rounds.x)
        self._log_ratio = rounds.log_p - self._log_origin
        self._log_q = rounds.log_q()
        self.n_points = len(self._log_q)

    @property
    def log_evidence(self) -> float:
        """Log of the integral of the posterior."""
        log_weight = self._log_origin + self._log_ratio - self._log_q
        return float(special.logsumexp(log_weight) - np.log(self.n_points))

    def log_weight(self, log_beta: float) -> np.ndarray:
        """Compute the log weights (point,) for a density of the path; the largest is 0."""
        log_weight = self._log_origin + np.exp(log_beta) * self._log_ratio - self._log_q
        return np.maximum(log_weight - log_weight.max(), -_FARTHEST)

    def n_effective(self, log_beta: float) -> float:
        """Compute the effective number of points for a density of the path."""
        return _n_effective(self.log_weight(log_beta))

    def next(self, log_beta: float, wanted: float, part: float) -> tuple[float, np.ndarray]:
        """Choose the next density of the path; return its log beta and the log weights (point,).

        It is the farthest one for which a part of the wanted number of points is effective. All log
        weights are then made smaller until the wanted number is, which takes a part of the step
        from the proposals to this density.
        """
        fewest = part * wanted
        if self.n_effective(0.0) >= fewest:
            log_beta = 0.0
        elif self.n_effective(log_beta) >= fewest:
            log_beta = _last_above(fewest, self.n_effective, log_beta, 0.0)

        log_weight = self.log_weight(log_beta)
        if _n_effective(log_weight) < wanted:
            share = _last_above(wanted, lambda share: _n_effective(share * log_weight), 0.0, 1.0)
            log_weight = share * log_weight
        return log_beta, log_weight


def _last_above(
    wanted: float, function: Callable[[float], float], low: float, high: float
) -> float:
    """Return by bisection where a decreasing function, which begins above `wanted`, crosses it."""
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if function(middle) >= wanted:
            low = middle
        else:
            high = middle
    return low


def _n_effective(log_weight: np.ndarray) -> float:
    """Compute the effective number of points with log weights whose largest is 0."""
    weight = np.exp(log_weight)
    return float(weight.sum() ** 2 / (weight**2).sum())


def fitted_to(x: np.ndarray, rng: np.random.Generator) -> Mixture:
    """Fit a mixture to draws (draw, coordinate)."""
    weight = np.full(len(x), 1.0 / len(x))
    return Mixture.near(x, weight, n_components(x.shape[1]), rng).fitted(x, weight)
