"""Independent runs of importance sampling that must agree, in one or several charts.

k-hat does not see a part of the posterior that no proposal has reached, such as a second mode.
Therefore, each attempt samples twice, with different random numbers, and the two runs must agree:
in the means of all coordinates, and in the evidence, which is smaller if a part is missing.

1. The first proposals are fitted at the modes that are reached from draws of the prior and, if
   there is one, of the posterior of similar data. Draws in modes that the points have not reached
   are starts of a second sample.
2. If such runs do not suffice or do not agree, the first proposals are those of a tempered search.
3. If these do not agree either, the search is repeated once with more points.

With several charts, there is only the search: two runs from modes have agreed where they both
missed the end of a funnel.

If there are several charts, which are coordinates of the same posterior, each run samples in each
of them, and the points of all charts are weighted by the mixture of all proposals. For example, a
posterior of deviations and of their scale may be a funnel that is narrow at one end in one chart,
and at the other end in another chart. The points of both runs are returned, weighted by the mixture
of all proposals.
"""

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from trustbo.inference import importance
from trustbo.inference.importance import Points, Rounds, Sampled, ratio, sample
from trustbo.inference.mixture import MANY, Mixture, covariance_of
from trustbo.inference.modes import LogDensity, at_modes
from trustbo.inference.search import Visited, lost_modes, search
from trustbo.inference.weights import MAX_KHAT, smoothed

_N_RUNS = 2
"""Number of independent runs."""
_WANTED = 300, 600
"""Effective number of points in a search; with fewer, modes may be lost. The second number is that
of the last attempt."""
_SIZE = 512
"""Number of points of a round that begins at modes."""
_SIZE_OF_MANY = 1024
"""The same for many coordinates, whose fits need more points."""
_ROUNDS = 12
"""Largest number of these rounds."""
_LARGE = 2048
"""Number of points of a round that begins with the proposal of a search."""
_MOST_LARGE = 24
"""Largest number of these rounds."""
_ENOUGH = 2.0 * importance.ENOUGH
"""Effective number of points of all charts of a run together at which it ends. Two runs are
compared, and functions have more coordinates than classes, so more points are needed."""
_LEAST = 500.0
"""The same below which a run has failed."""
_N_SEEN = 384
"""Largest number of draws of the starts whose density each run computes."""
_N_STARTS = 3
"""Number of groups of these draws; modes are searched from the best draw of each group."""
_WIDE = 1.5
"""Scale of the wide proposal relative to the current one."""
_WARY = 0.3
"""Share of the wide proposal and the first one in a round."""
_PRIOR_SCALE = 1.2
"""Scale of the prior in the defensive proposal, in which its scale is about 1."""
_MEANS_AGREE = 0.25
"""Largest difference between the means of two runs, in standard deviations."""
_EVIDENCES_AGREE = 0.1
"""Largest difference of the log evidences of two runs, in addition to four standard errors."""


class Chart(NamedTuple):
    """Coordinates of a posterior, in which the prior is about standard normal."""

    log_density: LogDensity
    """Log density of points in these coordinates, with the constant of the other charts."""
    starts: Sequence[np.ndarray]
    """Points (point, coordinate) at which the posterior may be.

    They are for example draws of a similar posterior, and of the prior. Most of the first proposal
    of a search is that of the first start.
    """
    to_first: Callable[[np.ndarray], np.ndarray]
    """Conversion of points to the coordinates of the first chart."""
    from_first: Callable[[np.ndarray], np.ndarray]
    """Conversion of points from the coordinates of the first chart."""


def sample_charts(charts: Sequence[Chart], seed: int, names: Sequence[str] | None = None) -> Points:
    """Sample a posterior; the caller must check `complaints`.

    Args:
        charts: Coordinates of the posterior. The points of the result are those of the first.
        seed: Random seed.
        names: Name of each coordinate of the first chart, for complaints; by default, its number.
    """
    ways: list[Callable[..., list[Sampled]]] = [
        partial(_from_search, wanted=wanted) for wanted in _WANTED
    ]
    if len(charts) == 1:
        ways.insert(0, _from_modes)
    found = _attempt(charts, ways[0], [seed, 0], names)
    for number, begin in enumerate(ways[1:], 1):
        if found.complaints:
            found = _attempt(charts, begin, [seed, number], names)
    return found


def _attempt(
    charts: Sequence[Chart],
    begin: Callable[[Sequence[Chart], np.random.Generator], list[Sampled]],
    seed: Sequence[int],
    names: Sequence[str] | None,
) -> Points:
    """Sample in independent runs, unless the first of them already fails."""
    runs: list[_Run] = []
    for k in range(_N_RUNS):
        try:
            parts = begin(charts, np.random.default_rng([*seed, k]))
        except SearchError as failed:
            return failed.points._replace(complaints=(str(failed),))

        runs.append(_Run(charts, parts))
        weight, k_hat, _ = smoothed(runs[-1].log_ratio())
        if k_hat > MAX_KHAT or (weight**2).sum() * _LEAST / len(charts) > 1.0:
            break
    return _pooled(runs, names)


@np.errstate(all="ignore")  # coordinates that are far away overflow
def _from_modes(charts: Sequence[Chart], rng: np.random.Generator) -> list[Sampled]:
    """Sample in the only chart from the modes of the density.

    Points of the starts in modes that no point has reached are starts of a second sample.
    """
    (chart,) = charts
    x, log_p = _some_starts(chart, rng)
    d = x.shape[1]
    groups = np.array_split(np.arange(len(x)), _N_STARTS)
    best = np.array([x[group[log_p[group].argmax()]] for group in groups])
    found = _sample_from(chart, at_modes(chart.log_density, best), rng)
    if d > MANY:
        return [found]  # the points of a bent posterior would look like other modes

    visited = Visited(x, log_p, found.points.log_evidence)
    lost = lost_modes(visited, found.proposal, chart.log_density)
    if len(lost):
        origin = at_modes(chart.log_density, np.concatenate([best, lost]))
        found = _sample_from(chart, origin, rng)
    return [found]


def _sample_from(chart: Chart, origin: Mixture, rng: np.random.Generator) -> Sampled:
    """Sample with a first proposal that is fitted at modes."""
    d = origin.center.shape[1]
    prior = Mixture.single(np.zeros(d), _PRIOR_SCALE * np.eye(d))
    return sample(
        chart.log_density, origin, rng, defensive=_wider_and(prior), enough=_ENOUGH, most=_ROUNDS,
        wary=_WARY, size=_SIZE if d <= MANY else _SIZE_OF_MANY,
    )  # fmt: skip


def _wider_and(other: Mixture) -> Callable[[Mixture], Mixture]:
    """Return the defensive proposal that is a wider copy of the current one, and another one."""
    return lambda current: Mixture.joined([current.scaled(_WIDE), other], [0.5, 0.5])


def _some_starts(chart: Chart, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return points (point, coordinate) of all starts in random order, and their log densities."""
    n_each = _N_SEEN // len(chart.starts)
    parts = [x[rng.choice(len(x), min(n_each, len(x)), replace=False)] for x in chart.starts]
    x = rng.permutation(np.concatenate(parts))
    log_p = chart.log_density(x)
    return x, np.where(np.isfinite(log_p), log_p, -np.inf)


def _from_search(charts: Sequence[Chart], rng: np.random.Generator, wanted: float) -> list[Sampled]:
    """Sample in each chart from a tempered search."""
    enough = _ENOUGH / len(charts)
    return [_searched(chart, chart.starts, wanted, rng, enough) for chart in charts]


def _searched(
    chart: Chart,
    starts: Sequence[np.ndarray],
    wanted: float,
    rng: np.random.Generator,
    enough: float,
) -> Sampled:
    """Sample in a chart from a tempered search; raise SearchError if this fails."""
    mixture, log_beta = search(chart.log_density, starts, wanted, rng)
    if log_beta < 0.0:
        raise SearchError(chart, mixture, log_beta, rng)
    return sample(
        chart.log_density, mixture, rng, defensive=_wider_and(mixture), is_known=True, size=_LARGE,
        enough=enough, most=_MOST_LARGE, good=MAX_KHAT,
        wary=_WARY,
    )  # fmt: skip


class SearchError(Exception):
    """A search that has not reached the posterior, with the points where it ended."""

    def __init__(
        self, chart: Chart, mixture: Mixture, log_beta: float, rng: np.random.Generator
    ) -> None:
        rounds = Rounds()
        rounds.add(mixture, _SIZE, chart.log_density, rng)
        log_ratio = np.exp(log_beta) * rounds.points.log_ratio
        self.points = Points.weighted(chart.to_first(rounds.x), rounds.log_p, log_ratio)
        super().__init__(f"the search ended at a power of {np.exp(log_beta):.2f} of the density")


class _Run:
    """Points of an independent run, from proposals in all charts.

    Attributes:
        x: Points (point, coordinate) in each chart.
        log_p: Log density (point,) in each chart.
        proposals: Mixture of all proposals in each chart, whose shares are those of the points.
    """

    def __init__(self, charts: Sequence[Chart], parts: Sequence[Sampled]) -> None:
        own = [part.points for part in parts]
        n = sum(len(points.x) for points in own)
        self.proposals = [part.proposals for part in parts]
        self.log_share = [np.log(len(points.x) / n) for points in own]
        self.x = []
        self.log_p = []
        firsts = [chart.to_first(points.x) for chart, points in zip(charts, own, strict=True)]
        for chart, points in zip(charts, own, strict=True):
            x = []
            log_p = []
            for first, other in zip(firsts, own, strict=True):
                x.append(points.x if other is points else chart.from_first(first))
                log_p.append(points.log_p if other is points else chart.log_density(x[-1]))
            self.x.append(np.concatenate(x))
            of_chart = np.concatenate(log_p)
            self.log_p.append(np.where(np.isfinite(of_chart), of_chart, -np.inf))

    def log_q(self, other: "_Run") -> np.ndarray:
        """Log density (point,) of the proposals of this run at the points of another run.

        It refers to the first chart: a density is multiplied by the ratio of volumes, which is that
        of the densities of the posterior.
        """
        parts = []
        charts = zip(other.x, other.log_p, self.proposals, self.log_share, strict=True)
        for x, log_p, proposals, log_share in charts:
            # Points at infinity in this chart are not drawn from its proposals.
            is_inside = np.isfinite(x).all(1) & np.isfinite(log_p) & np.isfinite(other.log_p[0])
            log_volume = np.full(len(x), -np.inf)
            log_volume[is_inside] = other.log_p[0][is_inside] - log_p[is_inside]
            x = np.where(is_inside[:, None], x, 0.0)
            parts.append(proposals.log_density(x) + log_volume + log_share)
        return np.logaddexp.reduce(parts, axis=0)

    @cached_property
    def own_log_q(self) -> np.ndarray:
        """Log density (point,) of the proposals at the points; see `log_q`."""
        return self.log_q(self)

    def log_ratio(self) -> np.ndarray:
        """Log density (point,) relative to the proposals."""
        return ratio(self.log_p[0], self.own_log_q)


def _pooled(runs: Sequence[_Run], names: Sequence[str] | None) -> Points:
    """Join the points of runs, and list the reasons why they may not represent the posterior."""
    x = np.concatenate([run.x[0] for run in runs])
    log_p = np.concatenate([run.log_p[0] for run in runs])
    log_q = []
    for one in runs:
        of_runs = [one.own_log_q if run is one else one.log_q(run) for run in runs]
        log_q.append(np.concatenate(of_runs) + np.log(len(one.x[0]) / len(x)))
    log_ratio = ratio(log_p, np.logaddexp.reduce(log_q, axis=0))
    pooled = Points.weighted(x, log_p, log_ratio)
    pooled = pooled._replace(x=np.where((pooled.weight > 0.0)[:, None], x, 0.0))  # not infinite

    uneven = f"k-hat is {pooled.k_hat:.2f} (limit {MAX_KHAT})"
    if len(runs) < _N_RUNS:
        few = f"{uneven}, or too few points are effective ({pooled.kish:.0f})"
        return pooled._replace(complaints=(few,))
    reasons = [] if pooled.k_hat <= MAX_KHAT else [uneven]
    return pooled._replace(complaints=(*reasons, *_disagreements(runs, pooled, names)))


def _disagreements(runs: Sequence[_Run], pooled: Points, names: Sequence[str] | None) -> list[str]:
    """List the quantities in which independent runs differ."""
    means = []
    evidences = []
    errors = []
    for run in runs:
        log_ratio = run.log_ratio()
        weight, _, log_evidence = smoothed(log_ratio)
        means.append(weight @ np.where((weight > 0.0)[:, None], run.x[0], 0.0))
        evidences.append(log_evidence)
        errors.append(np.exp(log_ratio - log_evidence).std() / np.sqrt(len(log_ratio)))

    covariance = covariance_of(pooled.x, pooled.weight)
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
