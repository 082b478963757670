"""Importance sampling of the posterior of a model class, with its coefficients."""

from typing import Any, NamedTuple

import numpy as np
from scipy.special import logsumexp

from trustbo.inference import ep
from trustbo.inference.class_target import ClassTarget
from trustbo.inference.density import Coefficients, JointDraws
from trustbo.inference.importance import ROUNDS, SIZE, Points, Sampled, sample
from trustbo.inference.mixture import Mixture
from trustbo.inference.modes import LogDensity, at_modes, climb_on, fit_mode
from trustbo.inference.weights import MAX_KHAT

_NEGLIGIBLE = 0.01
"""Weight of a point, relative to the mean weight, below which EP is not corrected there."""
_LAST_SIZE = 1024
"""Points per round of the last attempt, if rates are Gaussian."""
_MORE_ROUNDS = 12
"""Largest number of rounds of the last attempt, as some curved posteriors need more than usual, and
of attempts from a first proposal that is given, which may have to move."""
_FEW = 125.0
"""Effective number of points below which points from a given proposal that was far away may still
be on their way to the posterior."""
_CORRECTIONS = 4
"""Number of draws of the coefficients by which EP is corrected at each point in the last attempt,
if rates are not Gaussian."""
_MISSED = np.log(1000.0)
"""Log ratio of the posterior to the points' proposal above which points miss a mode."""
_MANY_SCORES = 13
"""Smallest number of scores for which a round has four times as many points."""


def by_importance(
    target: ClassTarget, n: int, seed: int, first: Mixture | None = None
) -> tuple[JointDraws, dict[str, np.ndarray], dict[str, Any]]:
    """Take n draws by importance sampling; return the draws, statistics (draw,) and a summary.

    `first` is the first proposal. By default, or if its weights are uneven, the first proposal is
    found by a search for the mode. If these weights are uneven as well, there are more rounds,
    which are larger. Unless rates are Gaussian, EP is corrected at each point instead of drawing
    larger rounds.
    """
    rng = np.random.default_rng(seed)
    last_size = _LAST_SIZE if target.is_gaussian else SIZE
    attempts = [(SIZE, None), (last_size, None)]
    if first and _is_possible(target, first):
        attempts = [(SIZE, first), *attempts]
    was_elsewhere = False
    while True:
        size, proposal = attempts.pop(0)
        if target.n_scores >= _MANY_SCORES:
            size = 4 * size

        is_last = not attempts
        may_be_elsewhere = proposal is not None and not was_elsewhere
        found = _draws(target, n, size, rng, proposal, is_last, may_be_elsewhere)
        if isinstance(found, Elsewhere):
            was_elsewhere = True
            if found.both is not None:
                attempts = [(SIZE, found.both), *attempts]
            continue

        drawn, log_p, summary = found
        if summary["k_hat"] <= MAX_KHAT or is_last:
            return drawn, {"lp": log_p}, summary


def _is_possible(target: ClassTarget, first: Mixture) -> bool:
    """Return whether a first proposal is finite and has a positive density at its center.

    Unless rates are Gaussian, EP is run there; if the proposal is not possible, EP forgets it.
    """
    with np.errstate(all="ignore"):  # extreme scores overflow
        if not all(np.isfinite(array**2).all() for array in first):
            return False

        center = first.mean[None]
        target.run_ep(target.theta(center))
    if np.isfinite(target.log_density(center)[0]):
        return True

    target.density.reset_ep()
    return False


class Elsewhere(NamedTuple):
    """Result of an attempt whose points may not represent the posterior."""

    both: Mixture | None = None
    """Proposal of the points and of a mode that they missed, if there is one."""


def _elsewhere(target: ClassTarget, found: Sampled) -> Elsewhere | None:
    """Return whether points whose first proposal was far away do not represent the posterior.

    They may be on the way to it, with too few effective points when the rounds end, or may have
    missed a mode that the search for the mode finds, or a ridge where this search ends. Unless
    rates are Gaussian, their density is that of EP near the first proposal, which is not accurate
    elsewhere.
    """
    if not target.is_gaussian:
        target.density.reset_ep()
        return Elsewhere()
    points = found.points
    if points.k_hat > MAX_KHAT:
        return None  # the search follows in any case
    if points.kish < _FEW:
        return Elsewhere()

    mode = climb_on(target.log_density, target.start())
    if not misses(found, target.log_density, mode):
        return None
    parts = [found.proposal, fit_mode(target.log_density, mode)]
    return Elsewhere(Mixture.joined(parts, np.full(len(parts), 1.0 / len(parts))))


def misses(found: Sampled, log_density: LogDensity, mode: np.ndarray) -> bool:
    """Return whether the density at a mode (score,) is far above that of the points."""
    log_p = log_density(mode[None]) - found.points.log_evidence
    return bool(log_p[0] - found.proposal.log_density(mode[None])[0] > _MISSED)


@np.errstate(all="ignore")  # scores of points that are far away overflow
def _draws(
    target: ClassTarget,
    n: int,
    size: int,
    rng: np.random.Generator,
    first: Mixture | None,
    is_last: bool,
    may_be_elsewhere: bool,
) -> tuple[JointDraws, np.ndarray, dict[str, Any]] | Elsewhere:
    """Take n draws, beginning with the proposal `first` or with a search for the mode.

    If `first` may be elsewhere, and was so far away that the points may not represent the
    posterior, the result is `Elsewhere`.

    Unless rates are Gaussian, the density of EP is corrected at the points in the end. In the last
    attempt, EP is run and corrected at each visited point instead, so that later proposals are
    fitted to the corrected density.
    """
    if first is None:
        origin = at_modes(target.log_density, target.start()[None])
    else:
        origin = first

    way: _Exact | _CorrectedAtOnce | _CorrectedAfterwards
    if target.is_gaussian:
        way = _Exact(target, rng)
    else:
        way = (_CorrectedAtOnce if is_last else _CorrectedAfterwards)(target, rng)

    found = sample(
        target.log_density, origin, rng,
        is_known=first is not None, size=size,
        most=_MORE_ROUNDS if is_last or first is not None else ROUNDS,
        defensive=target.defensive, visit=way.visit,
    )  # fmt: skip
    if may_be_elsewhere and found.is_far:
        elsewhere = _elsewhere(target, found)
        if elsewhere is not None:
            return elsewhere

    points, chosen, c = way.draw(found.points, n)
    summary = {name: getattr(points, name) for name in ("k_hat", "kish", "log_evidence")}
    drawn = JointDraws(target.theta(points.x[chosen]), c)
    return drawn, points.log_p[chosen], summary | {"proposal": found.proposal.text}


class _Exact:
    """Visits of points with Gaussian rates, whose density and coefficients are exact."""

    def __init__(self, target: ClassTarget, rng: np.random.Generator) -> None:
        self.target = target
        self.rng = rng
        self.visited: list[Coefficients] = []

    def visit(self, z: np.ndarray) -> np.ndarray:
        """Return the log density (point,) of points, and keep their coefficients."""
        log_p, coefficients = self.target.visit(z, self.rng)
        self.visited.append(coefficients)
        return log_p

    def draw(self, points: Points, n: int) -> tuple[Points, np.ndarray, np.ndarray]:
        """Return the points, the indices of n draws among them, and coefficients of the draws."""
        chosen = points.resample(n, self.rng)
        return points, chosen, Coefficients.joined(self.visited).draw(chosen, self.rng)


class _CorrectedAfterwards(_Exact):
    """Visits of points with the density of EP, which is corrected at all points in the end."""

    def draw(self, points: Points, n: int) -> tuple[Points, np.ndarray, np.ndarray]:
        """See `_Exact.draw`; the points have corrected weights."""
        coefficients = Coefficients.joined(self.visited)
        points, c = _corrected(self.target, points, coefficients, self.rng)
        chosen = points.resample(n, self.rng)
        return points, chosen, c[chosen]


class _CorrectedAtOnce(_Exact):
    """Visits of points at which EP is run and corrected, so that proposals follow the result."""

    def __init__(self, target: ClassTarget, rng: np.random.Generator) -> None:
        super().__init__(target, rng)
        self.drawn: list[np.ndarray] = []

    def visit(self, z: np.ndarray) -> np.ndarray:
        """See `_Exact.visit`; here, coefficients are drawn."""
        sites = self.target.sites_at(z)
        log_p, coefficients = self.target.visit(z, self.rng, sites)
        some = np.flatnonzero(np.isfinite(log_p))
        correction, c = _correction(
            self.target, z, coefficients, some, self.rng, _CORRECTIONS, sites
        )
        log_p[some] = correction
        self.drawn.append(c)
        return log_p

    def draw(self, points: Points, n: int) -> tuple[Points, np.ndarray, np.ndarray]:
        """See `_Exact.draw`."""
        chosen = points.resample(n, self.rng)
        return points, chosen, np.concatenate(self.drawn)[chosen]


def _corrected(
    target: ClassTarget, points: Points, coefficients: Coefficients, rng: np.random.Generator
) -> tuple[Points, np.ndarray]:
    """Draw coefficients (point, column) at all points, and correct the weights for errors of EP."""
    some = np.flatnonzero(points.weight * len(points.x) > _NEGLIGIBLE)
    log_p, c = _correction(target, points.x, coefficients, some, rng)

    log_ratio = points.log_ratio.copy()
    log_ratio[some] += log_p - points.log_p[some]
    return Points.weighted(points.x, points.log_p, log_ratio), c


def _correction(
    target: ClassTarget,
    z: np.ndarray,
    coefficients: Coefficients,
    some: np.ndarray,
    rng: np.random.Generator,
    n: int = 1,
    sites: ep.Sites | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the log density of `some` points (some,) with n draws of the coefficients of each.

    The mean of the estimated densities is exact; see `ByEP.log_joint` for `sites`. Also return
    one of the draws at each point (point, column), chosen by its weight; at other points, any draw.
    """
    proposed = [coefficients.propose(np.arange(len(z)), rng) for _ in range(n)]
    here = sites and sites.of(some)
    log_p = np.array([target.log_joint(z[some], c[some], rng, here) - q[some] for c, q in proposed])
    c = proposed[0][0]
    if n > 1:
        largest = (log_p + rng.gumbel(size=log_p.shape)).argmax(0)  # with probabilities by weight
        c[some] = np.array([c for c, _ in proposed])[largest, some]
    return logsumexp(log_p, axis=0) - np.log(n), c
