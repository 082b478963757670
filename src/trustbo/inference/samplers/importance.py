"""Importance sampling of a few scores of hyperparameters, all else drawn given them.

A target integrates out coefficients, effects and trust: exactly where rates are Gaussian
(`evidence.gaussian`), by expectation propagation where they are not (`evidence.sites`). Three to
ten scores are left (`scores`). They are drawn in rounds:

1. A first proposal: a Student-t density with the moments of an earlier posterior, or else around
   the mode that Newton's searches find.
2. Rounds of 256 points, or more in ten dimensions, give the mean and covariance of the next
   proposal, until their effective number is fair. Half of the points are drawn from the target's
   defensive proposal: it covers regions that moments miss, such as a second mode far out, or a
   noise's thin tail to 0.
3. Points of the last rounds and 128 to 4096 more are pooled, the mixture of all their proposals
   being the density that weights are relative to, and the weights Pareto-smoothed. These more are
   of a Student-t that is skewed as the points are: posteriors of scales reach far towards 0. Where
   k-hat or the effective number shows weights uneven, further ones follow, of a new fit to all.
4. Systematic resampling makes points equally weighted. The target draws the coefficients at each;
   where its density was EP's, with weights that average to the ratio of posterior to EP density, by
   which the draws are resampled once more. Uneven ones are drawn again after more sweeps of EP.

Invariant: weights are target over proposal density for any proposals, and unbiased ones in 4 leave
the posterior exact (importance sampling squared). Their means' product is the evidence.
"""

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from trustbo.inference.samplers.convergence import GOOD_KHAT, MAX_KHAT
from trustbo.inference.samplers.exact import ExactDraws
from trustbo.inference.samplers.student import Proposal, Student, log_mixture
from trustbo.inference.samplers.watching import SILENT, Watch
from trustbo.inference.samplers.weights import smoothed_weights, systematic
from trustbo.parallel import one_blas_thread

_MAX_ROUNDS, _MAX_FINAL = 4, 3
_MAX_LAST = 20  # rounds of the last proposal where weights would be refused after fewer
_FAIR, _LOST = 0.1, 10.0  # effective number of a round's points: share of them; too few to go on
_ENOUGH, _ROUND = 200.0, 512  # effective number of points; points that make a round of the last
_RIDGE = 1e-3
_MANY, _PER_AXIS = 12, 4.0  # axes; effective points for each that moments are taken of
_MORE, _MORE_LAST = 3, 24  # times that uneven draws are added to; that refused ones are
_FEWEST = 100  # draws whose weights are smoothed
_HOPELESS = 1.0  # k-hat of weights without a mean, which further draws do not cure
_EVEN = 0.9  # effective share of draws from which on no weight exceeds 1 % of 1000: no tail


class UnevenWeightsError(Exception):
    """The exact sampler's weights are too uneven, or leave out a mode."""


class ScoreTarget(ABC):
    """Posterior of scores, with everything else drawn given them."""

    compiles = False
    """Whether the first density takes seconds to compile."""
    n_scores: int
    n_pilot: int
    """Number of points of a round, half of them defensive."""
    n_final: int
    """Number of points of each last proposal."""
    widths: tuple[float, float]
    """Scale of the proposals in units of the points' covariance: in rounds, and of the last."""
    n_corrected: int | None = None
    """Maximum number of draws to weight where the density is approximate."""

    @abstractmethod
    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Log posterior density of scores (point, score), perhaps approximate; shape (point,)."""

    def takes(self, start: Student) -> bool:
        """Whether the proposal of an earlier posterior, such as of as many scores, is the first."""
        return len(start.center) == self.n_scores

    @abstractmethod
    def first(self) -> Student:
        """Gaussian fit at the best mode."""

    def recentre(self, z: np.ndarray) -> np.ndarray:
        """Re-expand an approximate density around a point (score,); it in new coordinates."""
        return z

    def sharpen(self) -> bool:
        """Make an approximate density more accurate, at more cost; whether it could."""
        return False

    @abstractmethod
    def defensive(self, proposal: Student) -> Proposal:
        """Defensive proposal for regions that the given one may miss."""

    @abstractmethod
    def draw(
        self, z: np.ndarray, log_p: np.ndarray, chosen: np.ndarray, rng: np.random.Generator
    ) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
        """Parameters at the points of sorted indices, by name, each (draw, ...).

        With them the log weight of each draw, where the density is approximate: its exponential
        averages to the ratio of the posterior density to the approximate one, `log_p`.
        """


class ScoreDraws(NamedTuple):
    """Draws of parameters, and the proposal that the next fit starts from."""

    draws: ExactDraws
    proposal: Student


class Points(NamedTuple):
    """Weighted points of all proposals so far."""

    z: np.ndarray
    log_p: np.ndarray
    log_w: np.ndarray  # smoothed and normalised
    khat: float
    log_evidence: float

    @property
    def kish(self) -> float:
        """Effective number of points."""
        return _kish(self.log_w)


def sample_scores(
    target: ScoreTarget,
    n_draws: int,
    seed: int,
    start: Student | None = None,
    watch: Watch = SILENT,
) -> ScoreDraws:
    """Draw from the posterior of a target; the same seed and start give the same draws.

    Args:
        target: Posterior of the scores.
        n_draws: Number of equally weighted draws.
        seed: Seed.
        start: Proposal of an earlier posterior to begin with.
        watch: Observer of the stages.
    """
    if start is not None and not target.takes(start):  # of another team, or of other effects
        start = None
    # Matrices are small: a second BLAS thread costs more than it brings.
    with one_blas_thread():
        points, proposal = weighted_points(target, seed, start, watch)
        watch.stage("exact sampler draws")
        rng = np.random.default_rng(seed)
        n = n_draws
        if target.n_corrected is not None:
            n = min(max(n_draws, _FEWEST), target.n_corrected)
        drawn = None
        if points.khat < MAX_KHAT or not target.sharpen():
            drawn = _draw(target, points, n, rng)
        if drawn is None:
            return sample_scores(target, n_draws, seed, proposal, watch)
        chosen, params, smoothing = drawn
    khat, kish, log_evidence = points.khat, points.kish, points.log_evidence
    kept = np.arange(n)
    if smoothing is not None:
        smoothed, worst, log_mean = smoothing
        inner, log_evidence = _kish(smoothed), log_evidence + log_mean
        khat = max(khat, worst) if inner < _EVEN * len(chosen) else khat
        kish = 1.0 / (1.0 / kish + 1.0 / inner)
        kept = systematic(np.exp(smoothed), n_draws, rng)
    order = kept[rng.permutation(n_draws)]
    return ScoreDraws(
        ExactDraws(
            {name: values[order] for name, values in params.items()},
            points.log_w[chosen][order],
            points.log_p[chosen][order],
            khat,
            kish,
            log_evidence,
        ),
        proposal,
    )


def _draw(
    target: ScoreTarget, points: Points, n: int, rng: np.random.Generator
) -> tuple[np.ndarray, dict[str, np.ndarray], tuple[np.ndarray, float, float] | None] | None:
    """Indices of resampled points, parameters there, and their smoothed weights.

    Where n weights are uneven more are drawn, as k-hat of few weights is noisy; None where an
    approximate density was sharpened instead, as more did not help.
    """
    chosen = np.sort(systematic(np.exp(points.log_w), n, rng))
    params, log_weight = target.draw(points.z, points.log_p, chosen, rng)
    if log_weight is None:
        return chosen, params, None
    smoothing = smoothed_weights(log_weight)
    for k in range(_MORE_LAST):
        enough = smoothing[1] < (GOOD_KHAT if k < _MORE else MAX_KHAT)
        if enough or _kish(smoothing[0]) > _EVEN * len(chosen):
            break
        if k == _MORE and target.sharpen():
            return None
        if k >= _MORE and smoothing[1] > _HOPELESS:
            break
        more = np.sort(systematic(np.exp(points.log_w), n, rng))
        others, added = target.draw(points.z, points.log_p, more, rng)
        chosen, log_weight = np.append(chosen, more), np.append(log_weight, added)  # pyright: ignore
        params = {name: np.concatenate([values, others[name]]) for name, values in params.items()}
        smoothing = smoothed_weights(log_weight)
    return chosen, params, smoothing


def _kish(log_w: np.ndarray) -> float:
    """Effective number of points of normalised weights."""
    return float(np.exp(-np.logaddexp.reduce(2.0 * log_w)))


def weighted_points(
    target: ScoreTarget, seed: int, start: Student | None, watch: Watch
) -> tuple[Points, Student]:
    """Weighted points, and the Student-t with their moments."""
    cloud = _Cloud(target)
    proposal, warm = start, start is not None
    if proposal is None:
        proposal = target.first()
    else:
        target.recentre(proposal.center)
    for k in range(1, _MAX_ROUNDS + 1):
        watch.stage(f"exact sampler weighs points, round {k} of {_MAX_ROUNDS} at most")
        cloud.add(proposal.widened(target.widths[0]), target.n_pilot // 2, seed + k)
        cloud.add(target.defensive(proposal), target.n_pilot // 2, seed + k)
        points = cloud.points()
        proposal = _fitted(points)
        if points.kish > _FAIR * target.n_pilot:
            break
        if k == 1 and not warm:  # a proposal by curvature is only a start
            cloud = _Cloud(target)
        elif k == 2 and points.kish < _LOST and warm:  # the posterior has moved far from the start
            cloud, proposal, warm = _Cloud(target), target.first(), False
    points = _weigh_last(target, cloud, seed + 77, watch)
    return points, Student.of(points.z, points.log_w, 1e-9)


def _weigh_last(target: ScoreTarget, cloud: "_Cloud", seed: int, watch: Watch) -> Points:
    """Add points of skewed proposals, each fitted to all before, until weights are even."""
    watch.stage("exact sampler weighs the last points")
    points, per_round = cloud.points(), max(1, _ROUND // target.n_final)
    for k in range(_MAX_LAST * per_round):
        proposal = _fitted(points, skewed=True)
        cloud.add(proposal.widened(target.widths[1]), target.n_final, seed + k)
        points = cloud.points()
        if k + 1 >= _MAX_FINAL * per_round:
            enough = points.khat < MAX_KHAT
        else:
            enough = points.khat < GOOD_KHAT and points.kish > _ENOUGH
        if enough:
            break
        uneven = f"k-hat is {points.khat:.2f}, Kish size {points.kish:.0f}"
        watch.stage(f"exact sampler weighs more points, as {uneven}")
    return points


def _fitted(points: Points, *, skewed: bool = False) -> Student:
    """Student-t with the moments of weighted points, the third ones too if `skewed`.

    With many axes those of few effective points are far too narrow in some direction: weights are
    then raised to a power below 1, which leaves the moments between the proposals' and the
    posterior's.
    """
    log_w, n_axes = points.log_w, points.z.shape[1]
    while n_axes > _MANY and _kish(log_w) < _PER_AXIS * n_axes:
        log_w = 0.75 * log_w
        log_w = log_w - np.logaddexp.reduce(log_w)
    fit = Student.of(points.z, log_w, _RIDGE)
    return fit.skewed(points.z, log_w) if skewed else fit


class _Cloud:
    """Points of several proposals."""

    def __init__(self, target: ScoreTarget) -> None:
        self._target = target
        self._drawn: list[tuple[Proposal, np.ndarray, np.ndarray]] = []

    def add(self, proposal: Proposal, n: int, seed: int) -> None:
        z = proposal.draw(n, seed)
        self._drawn.append((proposal, z, self._target.log_density(z)))

    def points(self) -> Points:
        proposals, parts, log_p = zip(*self._drawn, strict=True)
        z, log_p = np.concatenate(parts), np.concatenate(log_p)
        raw = log_p - log_mixture(proposals, [len(drawn) for drawn in parts], z)
        if not np.isfinite(raw).any():
            return Points(z, log_p, np.full(len(z), -np.log(len(z))), np.inf, -np.inf)
        return Points(z, log_p, *smoothed_weights(raw))
