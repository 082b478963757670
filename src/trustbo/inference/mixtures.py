"""Importance sampling from adapted mixtures of Student-t distributions, for any log density.

It needs no gradient, and is used for models that are NumPyro functions. `sample` runs the following
steps twice, with different random numbers:

1. *Search.* Each round draws points from a mixture, and fits the next mixture to the points of the
   last rounds by expectation maximisation (Cappe, Douc, Guillin, Marin and Robert 2008). A point
   has the weight q0 (p / q0)^beta / q, where q0 is the first proposal and q the mixture of the
   proposals of these rounds (Cornuet, Marin, Mira and Robert 2012). beta is as large as leaves
   enough effective points, so mixtures move step by step from the start to the posterior.
   Then, the points that were drawn on the way are compared with the last mixture. If some of them
   have a density that is far above it, and lower densities lie between, they belong to a mode that
   was lost, and another search begins there.
2. *Refinement.* Larger rounds have proposals with wider components, too, and beta = 1. They end
   when k-hat and the effective number of points are good.

If there are several charts, which are coordinates of the same posterior, both steps run in each of
them, and the points of all charts are weighted by the mixture of all proposals. For example, a
posterior of deviations and of their scale may be a funnel that is narrow at one end in one chart,
and at the other end in another chart.

The weights are Pareto-smoothed. k-hat does not see a part of the posterior that no proposal has
reached, such as a second mode. Therefore, the two runs must agree: in the means of all coordinates,
and in the evidence, which is smaller if a part is missing. Otherwise, both are repeated once, with
more points. The points of both runs are returned, weighted by the mixture of all proposals.
"""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from scipy import special

from trustbo.inference.importance import MAX_KHAT, resampled, smoothed, systematic

BATCH = 512
"""Number of points of a round of the search; those of larger rounds are a multiple."""
_N_RUNS = 2
"""Number of independent runs."""
_DEGREES = 6.0
"""Degrees of freedom of the components."""
_MOST_COMPONENTS = 8
_LEAST_COMPONENTS = 2
_COORDINATES = 100
"""Number of coordinates of all components together, which limits their number."""
_WINDOW = 12
"""Number of the last rounds whose points are used in the search."""
_WANTED = 300, 600
"""Effective number of points that the choice of beta leaves; with fewer, modes may be lost. The
second number is that of a second attempt, after two runs that do not agree."""
_STEP = 0.15
"""Part of this number to which a step of beta may reduce it."""
_MOST_STRICT = 10
"""Number of coordinates up to which a step reduces it only after rounds without progress, and up to
which lost modes are searched.

Large steps lose modes, but with more coordinates, small ones take too many rounds.
"""
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
_LARGE = 4 * BATCH
"""Number of points of a round of the refinement."""
_MOST_LARGE = 24
"""Largest number of these rounds."""
_ENOUGH = 1000.0
"""Effective number of points of all charts of a run together at which it ends."""
_WIDER = 1.5
"""Scale of the wide components relative to the others."""
_LOST = np.log(1000.0)
"""Log ratio of the posterior to the mixture from which on a point may be in a lost mode."""
_N_LOST = 8
"""Largest number of such points that are examined."""
_BARRIER = 3.0
"""Smallest difference of log densities that separates a lost mode."""
_SHARES = 0.7, 0.15, 0.15
"""Shares of the fitted mixture, of its wider copy and of the search's last mixture in a proposal of
the refinement. The last one covers modes that a fit has lost."""
_FIRST = 0.8
"""Share of the first proposal that is fitted to the first of several starts."""
_STEPS = 6
"""Steps of expectation maximisation per round of the search; fewer would lose modes."""
_STEPS_OF_MANY = 3
"""The same per round of the refinement with more than `_MOST_STRICT` coordinates, to save time."""
_POINTS_PER_AXIS = 2.0
"""Effective points per coordinate below which a component is dropped."""
_NEGLIGIBLE = 1e-6
"""Weight relative to the largest one below which a point has no effect on a fit."""
_FARTHEST = 1e5
"""Smaller log weights, relative to the largest one, are raised to this distance."""
_RIDGE = 1e-10
"""Variance that is added to all covariances."""
_AT_ONCE = 1024
"""Number of points whose densities are computed at once, in memory that is near the processor."""
_FIRST_LOG_BETA = -20.0
"""Log beta of the first round, at which the density is practically that of the first proposal."""
_BISECTIONS = 20
"""Number of steps of the search for beta."""
_MEANS_AGREE = 0.25
"""Largest difference between the means of two runs, in standard deviations."""
_EVIDENCES_AGREE = 0.1
"""Largest difference of the log evidences of two runs, in addition to four standard errors."""

LogDensity = Callable[[np.ndarray], np.ndarray]
"""Log density (point,) of points (point, coordinate) up to a constant; -inf for zero density.

The number of points is always a multiple of `BATCH`.
"""


class Mixture(NamedTuple):
    """Mixture of multivariate Student-t distributions."""

    share: np.ndarray  # (component,), with sum 1
    center: np.ndarray  # (component, coordinate)
    scale: np.ndarray  # (component, coordinate, coordinate), lower triangular

    @classmethod
    def near(
        cls, x: np.ndarray, weight: np.ndarray, n_components: int, rng: np.random.Generator
    ) -> Self:
        """Return components at points drawn by weight, each with the covariance of all points."""
        chosen = x[rng.choice(len(x), n_components, p=weight)]
        scale = np.linalg.cholesky(_covariance(x, weight))
        share = np.full(n_components, 1.0 / n_components)
        return cls(share, chosen, np.repeat(scale[None], n_components, axis=0))

    @classmethod
    def joined(cls, mixtures: Sequence[Self], shares: Sequence[float]) -> Self:
        """Return the mixture of mixtures with these shares."""
        share = [p * one.share for p, one in zip(shares, mixtures, strict=True)]
        return cls(
            np.concatenate(share),
            np.concatenate([one.center for one in mixtures]),
            np.concatenate([one.scale for one in mixtures]),
        )

    def evened(self) -> Self:
        """Return the mixture with shares half way to equal ones.

        A mode whose components do not fit it yet has too little weight. With its share it would
        lose its points, and soon be lost.
        """
        return self._replace(share=0.5 * (self.share + 1.0 / len(self.share)))

    def wider(self) -> Self:
        """Return the mixture with wider components."""
        return self._replace(scale=_WIDER * self.scale)

    def draw(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw points (n, coordinate)."""
        which = systematic(self.share, n, rng)
        x = rng.standard_normal((n, self.center.shape[1]))
        x /= np.sqrt(rng.chisquare(_DEGREES, n) / _DEGREES)[:, None]
        for k in range(len(self.share)):
            own = which == k
            x[own] = self.center[k] + x[own] @ self.scale[k].T
        return x

    def log_density(self, x: np.ndarray) -> np.ndarray:
        """Compute the log density (point,) of points (point, coordinate)."""
        parts = [x[k : k + _AT_ONCE] for k in range(0, len(x), _AT_ONCE)]
        return np.concatenate([_log_sum(self._log_parts(part)[0]) for part in parts])

    def nearest(self, x: np.ndarray) -> np.ndarray:
        """Return the component (point,) that is most probable at points (point, coordinate)."""
        return self._log_parts(x)[0].argmax(0)

    @property
    def covariance(self) -> np.ndarray:
        """Covariances (component, coordinate, coordinate), up to a common factor."""
        return self.scale @ np.swapaxes(self.scale, 1, 2)

    def _log_parts(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute log (share times density), and squared distances, of shape (component, point)."""
        nu = _DEGREES
        n, d = x.shape
        whitening = np.linalg.inv(self.scale)
        center = (whitening @ self.center[..., None]).reshape(-1, 1)
        white = whitening.reshape(-1, d) @ x.T - center  # (component * coordinate, point)
        white = white.reshape(-1, d, n)
        square = np.einsum("kdn,kdn->kn", white, white)

        constant = special.gammaln(0.5 * (nu + d)) - special.gammaln(0.5 * nu)
        constant -= 0.5 * d * np.log(nu * np.pi)
        log_root = np.log(np.diagonal(self.scale, axis1=1, axis2=2)).sum(1)
        log_part = np.log(self.share) + constant - log_root
        return log_part[:, None] - 0.5 * (nu + d) * np.log1p(square / nu), square

    def fitted(self, x: np.ndarray, weight: np.ndarray, n_steps: int = _STEPS) -> Self:
        """Fit the mixture to points x (point, coordinate) with weights (point,) of sum 1.

        Each step is that of expectation maximisation for Student-t distributions with known degrees
        of freedom (Peel and McLachlan 2000). Components of few points are dropped. The covariances
        of the others are averaged with the mean covariance, which counts as 2 d points.
        """
        relevant = weight > _NEGLIGIBLE * weight.max()
        x = x[relevant]
        weight = weight[relevant] / weight[relevant].sum()

        d = x.shape[1]
        n_effective = 1.0 / (weight**2).sum()
        mixture = self
        for _ in range(n_steps):
            log_part, square = mixture._log_parts(x)
            own = weight * np.exp(log_part - special.logsumexp(log_part, axis=0))
            share = own.sum(1)
            kept = share * n_effective > _POINTS_PER_AXIS * d
            if not kept.any():
                scale = np.linalg.cholesky(_covariance(x, weight))
                return type(self)(np.ones(1), (weight @ x)[None], scale[None])

            own, square, share = own[kept], square[kept], share[kept]
            near = own * (_DEGREES + d) / (_DEGREES + square)
            center = near @ x / near.sum(1)[:, None]
            covariance = np.empty((len(share), d, d))
            for k in range(len(share)):
                away = x - center[k]
                covariance[k] = (away.T * near[k]) @ away / share[k]

            within = np.tensordot(share / share.sum(), covariance, 1) + _RIDGE * np.eye(d)
            from_others = (2.0 * d / (2.0 * d + share * n_effective))[:, None, None]
            covariance = (1.0 - from_others) * covariance + from_others * within
            mixture = type(self)(share / share.sum(), center, np.linalg.cholesky(covariance))
        return mixture


class Sample(NamedTuple):
    """Weighted points of a posterior.

    Attributes:
        x: Points, shape (point, coordinate).
        log_p: Log density of the points, shape (point,).
        weight: Pareto-smoothed weights with sum 1, shape (point,).
        k_hat: Pareto shape of the weights.
        log_evidence: Log of the integral of the density.
        complaints: Reasons why the points do not represent the posterior; empty if they do.
    """

    x: np.ndarray
    log_p: np.ndarray
    weight: np.ndarray
    k_hat: float
    log_evidence: float
    complaints: list[str]

    @property
    def kish(self) -> float:
        """Effective number of points, which is 1 / sum of squared weights."""
        return 1.0 / float((self.weight**2).sum())

    def resample(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw indices of n equally weighted points; see `importance.resampled`."""
        return resampled(self.weight, n, rng)


class _Rounds:
    """Points of the last rounds, weighted by the mixture of the proposals of these rounds."""

    def __init__(self, most: int) -> None:
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
        """Draw n points from a proposal; forget the first round if there are too many."""
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

    def log_q(self) -> np.ndarray:
        """Log density (point,) of the mixture of all proposals."""
        return special.logsumexp(self._log_q, axis=0) - np.log(len(self._log_q))

    def log_weight(self) -> np.ndarray:
        """Log weights (point,) of the points."""
        return _ratio(self.log_p, self.log_q())


class Chart(NamedTuple):
    """Coordinates of a posterior."""

    log_density: LogDensity
    """Log density of points in these coordinates, with the constant of the other charts."""
    starts: Sequence[np.ndarray]
    """Points (point, coordinate) to which the first proposals are fitted.

    They are for example draws of a similar posterior, and of the prior. Most of the first proposal
    is that of the first start.
    """
    to_first: Callable[[np.ndarray], np.ndarray]
    """Conversion of points to the coordinates of the first chart."""
    from_first: Callable[[np.ndarray], np.ndarray]
    """Conversion of points from the coordinates of the first chart."""


def sample(charts: Sequence[Chart], seed: int, names: Sequence[str] | None = None) -> Sample:
    """Sample a posterior; the caller must check `complaints`.

    Args:
        charts: Coordinates of the posterior. The points of the result are those of the first.
        seed: Random seed.
        names: Name of each coordinate of the first chart, for complaints; by default, its number.
    """
    enough = _ENOUGH / len(charts)
    for attempt, wanted in enumerate(_WANTED):
        runs = []
        for k in range(_N_RUNS):
            rng = np.random.default_rng([seed, attempt, k])
            parts = []
            for chart in charts:
                mixture, log_beta = search(chart.log_density, chart.starts, wanted, rng)
                if log_beta < 0.0:
                    return _failed(chart, mixture, log_beta, rng)
                parts.append(_refined(chart.log_density, mixture, enough, rng))

            runs.append(_Run(charts, parts))
            if not _is_good(runs[-1].log_weight(), enough):
                return _pooled(runs, names)

        found = _pooled(runs, names)
        if not found.complaints or wanted == _WANTED[-1]:
            return found
    raise AssertionError("the last attempt returns")


class _Run:
    """Points of an independent run, from proposals in all charts.

    Attributes:
        x: Points (point, coordinate) in each chart.
        log_p: Log density (point,) in each chart.
        proposals: Proposals in each chart.
    """

    def __init__(self, charts: Sequence[Chart], parts: Sequence[_Rounds]) -> None:
        self.proposals = [part.proposals for part in parts]
        self.x = []
        self.log_p = []
        firsts = [chart.to_first(part.x) for chart, part in zip(charts, parts, strict=True)]
        for chart, part in zip(charts, parts, strict=True):
            x = []
            log_p = []
            for first, other in zip(firsts, parts, strict=True):
                x.append(part.x if other is part else chart.from_first(first))
                log_p.append(part.log_p if other is part else chart.log_density(x[-1]))
            self.x.append(np.concatenate(x))
            of_chart = np.concatenate(log_p)
            self.log_p.append(np.where(np.isfinite(of_chart), of_chart, -np.inf))

    def log_q(self, other: "_Run") -> np.ndarray:
        """Log density (point,) of the proposals of this run at the points of another run.

        It refers to the first chart: a density is multiplied by the ratio of volumes, which is that
        of the densities of the posterior.
        """
        parts = []
        for x, log_p, proposals in zip(other.x, other.log_p, self.proposals, strict=True):
            # Points at infinity in this chart are not drawn from its proposals.
            is_inside = np.isfinite(x).all(1) & np.isfinite(log_p) & np.isfinite(other.log_p[0])
            log_volume = np.full(len(x), -np.inf)
            log_volume[is_inside] = other.log_p[0][is_inside] - log_p[is_inside]
            x = np.where(is_inside[:, None], x, 0.0)
            parts += [one.log_density(x) + log_volume for one in proposals]
        return np.logaddexp.reduce(parts, axis=0) - np.log(len(parts))

    @cached_property
    def own_log_q(self) -> np.ndarray:
        """Log density (point,) of the proposals at the points; see `log_q`."""
        return self.log_q(self)

    def log_weight(self) -> np.ndarray:
        """Log weights (point,) of the points."""
        return _ratio(self.log_p[0], self.own_log_q)


def search(
    log_density: LogDensity, starts: Sequence[np.ndarray], wanted: float, rng: np.random.Generator
) -> tuple[Mixture, float]:
    """Search for the posterior; return the last mixture, and log beta, which is 0 at the end."""
    found, log_beta, visited = _searched(log_density, starts, wanted, rng)
    if log_beta < 0.0:
        return found, log_beta

    if found.center.shape[1] > _MOST_STRICT:
        return found, log_beta  # the points of a bent posterior would look like other modes

    lost = lost_modes(visited, found, log_density)
    if len(lost):
        scale = np.linalg.cholesky(np.tensordot(found.share, found.covariance, 1))
        share = np.full(len(lost), 1.0 / len(lost))
        around = Mixture(share, lost, np.repeat(scale[None], len(lost), axis=0))
        start = around.draw(BATCH, rng)
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
    first = [_fitted_to(x, rng) for x in starts]
    n_others = len(first) - 1
    shares = [_FIRST, *[(1.0 - _FIRST) / n_others] * n_others] if n_others else [1.0]
    mixture = Mixture.joined(first, shares)

    origin = mixture
    d = origin.center.shape[1]
    n_components = _n_components(d)
    rounds = _Rounds(_WINDOW)
    log_beta = _FIRST_LOG_BETA
    best = -np.inf
    n_idle = 0
    visited = []
    while True:
        rounds.add(mixture, BATCH, log_density, rng)
        visited.append(rounds.newest)
        if not np.isfinite(rounds.log_p).any():  # there is nothing to fit a mixture to
            return mixture, _FIRST_LOG_BETA, _joined(visited, -np.inf)

        path = _Path(rounds, origin)
        part = _STEP if d > _MOST_STRICT else max(0.5 ** (n_idle // _PATIENT), _STEP)
        log_beta, log_weight = path.next(log_beta, min(wanted, path.n_points / 4), part)
        weight = special.softmax(log_weight)
        if len(mixture.share) < n_components:
            mixture = Mixture.near(rounds.x, weight, n_components, rng)
        mixture = mixture.fitted(rounds.x, weight).evened()

        progress = log_beta
        if log_beta == 0.0:
            progress = np.log(path.n_effective(0.0) / wanted)
        n_idle = 0 if progress > best + _GAIN else n_idle + 1
        best = max(best, progress)

        is_ripe = n_idle >= _RIPE_ROUNDS or progress > np.log(_RIPE)
        has_failed = n_idle > _STALLED or len(visited) * BATCH >= _MOST_SEARCHED
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

    n_steps = BATCH // _N_LOST
    step = np.linspace(0.0, 1.0, n_steps)[:, None, None]
    way = x + step * (nearest - x)
    way = np.concatenate([way, way[:, :1].repeat(_N_LOST - len(x), axis=1)], axis=1)
    log_p = log_density(way.reshape(-1, x.shape[1])).reshape(n_steps, _N_LOST)[:, : len(x)]
    lowest = np.where(np.isfinite(log_p), log_p, -np.inf).min(0)
    return x[lowest < np.minimum(log_p[0], log_p[-1]) - _BARRIER]


class _Path:
    """Densities q0 (p / q0)^beta between the first proposal q0 and the posterior p.

    As the path is fixed, the shares of several modes cannot drift from round to round.
    """

    def __init__(self, rounds: _Rounds, origin: Mixture) -> None:
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


def _log_sum(log_part: np.ndarray) -> np.ndarray:
    """Compute the logarithms of sums over the first axis; at least one part is finite."""
    most = log_part.max(0)
    return np.log(np.exp(log_part - most).sum(0)) + most


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


def _fitted_to(x: np.ndarray, rng: np.random.Generator) -> Mixture:
    """Fit a mixture to draws (draw, coordinate)."""
    weight = np.full(len(x), 1.0 / len(x))
    return Mixture.near(x, weight, _n_components(x.shape[1]), rng).fitted(x, weight)


def _refined(
    log_density: LogDensity, mixture: Mixture, enough: float, rng: np.random.Generator
) -> _Rounds:
    """Draw large rounds from mixtures that are fitted to all points, until enough are effective."""
    found = mixture
    d = found.center.shape[1]
    n_components = _n_components(d)
    n_steps = _STEPS if d <= _MOST_STRICT else _STEPS_OF_MANY
    rounds = _Rounds(_MOST_LARGE)
    while True:
        proposal = Mixture.joined([mixture, mixture.wider(), found], _SHARES)
        rounds.add(proposal, _LARGE, log_density, rng)
        log_weight = rounds.log_weight()
        if _is_good(log_weight, enough) or len(rounds.proposals) == _MOST_LARGE:
            return rounds

        weight, _, _ = smoothed(log_weight)
        if len(mixture.share) < n_components:
            mixture = Mixture.near(rounds.x, weight, n_components, rng)
        mixture = mixture.fitted(rounds.x, weight, n_steps)


def _n_components(d: int) -> int:
    """Return the number of components for d coordinates; each has d (d + 1) / 2 covariances."""
    return int(np.clip(_COORDINATES // d, _LEAST_COMPONENTS, _MOST_COMPONENTS))


def _ratio(log_p: np.ndarray, log_q: np.ndarray) -> np.ndarray:
    """Return log (p / q) (point,), which is -inf where p is 0."""
    return np.where(np.isfinite(log_p), log_p - np.where(np.isfinite(log_q), log_q, 0.0), -np.inf)


def _is_good(log_weight: np.ndarray, enough: float) -> bool:
    """Return whether enough points are effective, and k-hat is good."""
    weight, k_hat, _ = smoothed(log_weight)
    return k_hat <= MAX_KHAT and (weight**2).sum() * enough <= 1.0


def _pooled(runs: Sequence[_Run], names: Sequence[str] | None) -> Sample:
    """Join the points of runs, and list the reasons why they may not represent the posterior."""
    x = np.concatenate([run.x[0] for run in runs])
    log_p = np.concatenate([run.log_p[0] for run in runs])
    log_q = []
    for one in runs:
        of_runs = [one.own_log_q if run is one else one.log_q(run) for run in runs]
        log_q.append(np.concatenate(of_runs) + np.log(len(one.x[0]) / len(x)))
    log_weight = _ratio(log_p, np.logaddexp.reduce(log_q, axis=0))
    weight, k_hat, log_evidence = smoothed(log_weight)
    x = np.where((weight > 0.0)[:, None], x, 0.0)  # points at infinity have no weight
    pooled = Sample(x, log_p, weight, k_hat, log_evidence, [])

    if len(runs) < _N_RUNS:
        complaint = f"k-hat is {k_hat:.2f} (limit {MAX_KHAT}), or too few points are effective"
        return pooled._replace(complaints=[f"{complaint} ({pooled.kish:.0f})"])
    complaints = [] if k_hat <= MAX_KHAT else [f"k-hat is {k_hat:.2f} (limit {MAX_KHAT})"]
    return pooled._replace(complaints=complaints + _disagreements(runs, pooled, names))


def _disagreements(runs: Sequence[_Run], pooled: Sample, names: Sequence[str] | None) -> list[str]:
    """List the quantities in which independent runs differ."""
    means = []
    evidences = []
    errors = []
    for run in runs:
        log_weight = run.log_weight()
        weight, _, log_evidence = smoothed(log_weight)
        means.append(weight @ np.where((weight > 0.0)[:, None], run.x[0], 0.0))
        evidences.append(log_evidence)
        errors.append(np.exp(log_weight - log_evidence).std() / np.sqrt(len(log_weight)))

    covariance = _covariance(pooled.x, pooled.weight)
    apart = np.ptp(means, axis=0) / np.sqrt(np.diag(covariance))
    found = []
    if not apart.max() <= _MEANS_AGREE:
        worst = int(apart.argmax())
        name = f"coordinate {worst}" if names is None else names[worst]
        found.append(
            f"two independent runs differ by {apart.max():.2f} standard deviations of {name} "
            f"(limit {_MEANS_AGREE})"
        )
    gap = float(np.ptp(evidences))
    if not gap <= _EVIDENCES_AGREE + 4.0 * np.hypot(*errors):
        found.append(f"the log evidences of two independent runs differ by {gap:.2f}")
    return found


def _failed(chart: Chart, mixture: Mixture, log_beta: float, rng: np.random.Generator) -> Sample:
    """Return points of a search that has not reached the posterior."""
    rounds = _Rounds(1)
    rounds.add(mixture, BATCH, chart.log_density, rng)
    log_weight = np.exp(log_beta) * rounds.log_weight()
    weight, k_hat, log_evidence = smoothed(log_weight)
    reason = f"the search ended at a power of {np.exp(log_beta):.2f} of the density"
    x = chart.to_first(rounds.x)
    return Sample(x, rounds.log_p, weight, k_hat, log_evidence, [reason])


def _covariance(x: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Compute the covariance (coordinate, coordinate) of points with weights of sum 1."""
    away = x - weight @ x
    return (away.T * weight) @ away + _RIDGE * np.eye(x.shape[1])
