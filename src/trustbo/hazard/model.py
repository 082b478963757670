"""Hazard model: the probability that a bound ends the mission, inferred from missions.

Bound e, together with its next move and the sets of posts before both moves, fails with probability
p_e ~ Beta(s m_e, s (1 - m_e)). In a bound, next moves and sets with the same steepest route share
one p_e (see `workspace.difficulty`). The prior mean m_e depends on the difficulties of the robots'
routes and on t_e, the number of degrees by which the tilt of the steepest route exceeds the slope
limit:

    1 - m_e = sigma(-logit_e) sigma(-(t_e + margin) / width),
    logit_e = intercept + sum_j coefficient_j (difficulty_ej - 1/2).

The p_e are integrated out, and normal scores of the other parameters are drawn by importance
sampling. While the proposals are being adapted, missions lost at unknown places are treated as
independent. Afterwards, the place of each of these failures is imputed at every point (sequential
imputation; Kong, Liu and Wong 1994), and the weights are corrected for the joint posterior.
"""

import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import xarray as xr
from scipy import special, stats

from trustbo.data import Cell, Mission, require_map
from trustbo.errors import (
    PosteriorError,
    TrustboError,
    require_list,
    require_pair,
    require_whole,
)
from trustbo.hazard.prior import FLOOR, LIMIT_NAMES, BoundPrior, Hazard
from trustbo.hazard.risk import add_lost
from trustbo.hazard.trials import LostMission, Trials
from trustbo.inference import importance
from trustbo.inference.mixture import Mixture
from trustbo.inference.modes import at_modes
from trustbo.inference.weights import MAX_KHAT
from trustbo.parallel import computing
from trustbo.stacking import list_of_missions
from trustbo.workspace import Workspace
from trustbo.workspace.difficulty import TILT
from trustbo.workspace.moves import next_names, way_names

_ROUND = 1024
"""Number of points of importance sampling per round."""
_PRIOR_SCALE = 1.2
"""Scale of the defensive proposal; that of the prior is 1."""
_MORE = 8
"""Factor by which this number and the effective number of points are increased for a second attempt
if the weights are uneven."""
_N_DRAWS = 1000
"""Number of posterior draws."""
_SMALLEST_P = 1e-12
"""Smallest probability of passing that is distinguished from 0."""
_LARGEST_KHAT = 1e3
"""Largest k-hat that is stored, which keeps it finite even if the estimate is infinite."""
_LARGE = 1e8
"""Parameter of a Beta distribution from which log ratios of Gamma functions are expanded."""
_POSITIONS = {"strength": -1, "margin": -3}
"""Positions of two parameters in the normal scores; see `Hazard.of_bounds`."""
_MODES = {"strength": 1.5, "margin": 1.8}
"""Absolute normal scores near which the posterior may have modes, for low and high strength and for
a correct and a wrong limit."""
_MAPS = "move", "row", "col", "next_move"


@computing()
def fit_hazard(
    missions: Iterable[Mission],
    workspace: Workspace,
    hazard: Hazard | None = None,
    *,
    lost: Iterable[LostMission] = (),
    goals: Sequence[Cell | None] | None = None,
    seed: int = 0,
) -> xr.Dataset:
    """Fit the hazard model to missions by importance sampling.

    Only the difficulty of bounds that were attempted is measured.

    Args:
        missions: Measured missions on the map of the workspace; may be empty.
        workspace: Workspace of the missions; its terrain determines the difficulty of bounds.
            Without a terrain, all bounds have the same prior mean.
        hazard: Priors; by default `Hazard()`.
        lost: Failed missions without measurements.
        goals: Last cell of the planned path of each mission, or None where it is not known; by
            default, none is known. Without it, it is unknown whether a path that ends at a bound
            that failed was planned to end there.
        seed: Random seed; the same seed gives the same posterior.

    Returns:
        The group `hazard` of a posterior. The posterior draws are `intercept` (draw), `coefficient`
        (draw, measure), `strength` (draw) and, with a terrain, `margin` and `width` (draw) of the
        slope limit in degrees. `place` (draw, lost) is the number, from 1, of the bound at which
        each mission lost at an unknown place failed. `trials` and `failures` (move, row, col,
        next_move) count known outcomes of a bound that is followed by a given next move or by the
        end of the path; a failure whose next move is unknown, because the robots turned back or the
        log ends, is shared equally by all next moves. With several sets of posts, moves and next
        moves are named "ne" with the standard set, "ne far", ... `is_bound` (move, row, col) says
        which bounds exist. `BoundRisk` computes the failure probabilities of all bounds from this
        group.

    Raises:
        TrustboError: If a mission has no map or is on another map (see `Mission.map`), or if its
            path skips cells or leaves the grid.
        PosteriorError: If the k-hat of the importance weights exceeds 0.7.

    Example:
        >>> hazard = tb.hazard.fit_hazard(missions, workspace)
        >>> np.nanmax(tb.hazard.BoundRisk(hazard, workspace).mean)  # of the most dangerous bound
    """
    started = time.perf_counter()
    hazard = hazard or Hazard()
    missions = list_of_missions(missions)
    require_map("the hazard model", missions)
    for j, mission in enumerate(missions):
        if mission.map:
            raise TrustboError(
                f"mission {j} was driven on the map {mission.map!r}, not in this workspace; leave "
                "it out."
            )

    n_posts = workspace.n_posts
    trials = Trials.from_missions(missions, lost, _goals_of(missions, goals), n_posts)
    difficulty = workspace.difficulty
    shape = difficulty.exists.shape[1:3]
    cells = trials.bounds[:, 1:3]
    outside = ((cells < 0) | (cells >= shape)).any(1)
    if outside.any():
        cell = tuple(cells[outside][0].tolist())
        raise TrustboError(f"a mission enters {cell}, outside the workspace of shape {shape}.")

    trials = trials.with_known_next(difficulty.exists)
    units = trials.of_units(difficulty.units_of(trials.bounds))

    # A bound that the robots drove, but that does not exist on the map, has the largest difficulty.
    measured = difficulty.of(units.bounds[:, :3]).values
    met = np.nan_to_num(measured[np.arange(len(measured)), units.bounds[:, 3]], nan=1.0)
    names = difficulty.measures
    prior = hazard.of_bounds(met, names, workspace.team.max_slope)
    rng = np.random.default_rng(require_whole("seed", seed, 0))
    points, places = sample(prior, units, rng)

    weighted = [name for name in names if name != TILT]
    group = _to_dataset(prior, trials, points, places, weighted, difficulty.exists, seed, n_posts)
    k_hat = float(np.clip(points.k_hat, -1.0, _LARGEST_KHAT))
    group.attrs = {"k_hat": k_hat, "kish": points.kish, "seed": seed}
    group.attrs |= {f"prior_{name}": list(value) for name, value in asdict(hazard).items()}
    group.attrs["seconds"] = time.perf_counter() - started

    if not points.k_hat <= MAX_KHAT:
        reason = f"the hazard posterior has k-hat {points.k_hat:.2f} > {MAX_KHAT:g}."
        raise PosteriorError(reason, group, "Use more informative priors in Hazard(...).")

    return group


def _goals_of(missions: Sequence[Mission], goals: Any) -> list[Cell | None]:
    """Return the goal of each mission; raises TrustboError unless there is one for each."""
    if goals is None:
        return [None] * len(missions)

    remedy = "give a list with one cell (row, col), or None, for each mission"
    given = require_list("goals", goals, remedy=remedy)
    if len(given) != len(missions):
        raise TrustboError(f"goals must have {len(missions)} entries; got {len(given)}. {remedy}.")
    return [None if goal is None else require_pair("a goal", goal) for goal in given]


def sample(
    prior: BoundPrior, trials: Trials, rng: np.random.Generator
) -> tuple[importance.Points, np.ndarray]:
    """Draw weighted points and, for each point, the bound at which each lost mission failed."""
    n = trials.n
    failed = trials.failed
    paths = trials.lost
    counts, kind = np.unique(n, return_inverse=True)
    times = np.bincount(kind, minlength=len(counts))
    bad = failed > 0.0

    def log_any_fails(alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
        """Compute the log probability that all lost missions fail, as if they were independent."""
        if not paths:
            return np.zeros(len(alpha))
        a = alpha + failed
        b = beta + n - failed

        p_fail = np.minimum(a / (a + b), 1.0 - _SMALLEST_P)
        passed = np.log1p(-p_fail)
        return np.sum([np.log(-np.expm1(passed[:, path].sum(1))) for path in paths], axis=0)

    def log_density(z: np.ndarray) -> np.ndarray:
        alpha, beta = prior.betas(z)
        _, _, strength = prior.values(z)
        strength = strength[:, None] + 2.0 * FLOOR  # alpha + beta

        # Beta-binomial probability of the counts, with p_e integrated out.
        total = stats.norm.logpdf(z).sum(1) + log_any_fails(alpha, beta)
        total += _log_rising(beta, n - failed).sum(1)
        total += _log_rising(alpha[:, bad], failed[bad]).sum(1)

        return total - _log_rising(strength, counts) @ times

    origin = at_modes(log_density, _starts(prior))
    for more in (1, _MORE):
        size = more * _ROUND
        enough = more * importance.ENOUGH
        found = importance.sample(
            log_density, origin, rng, size=size, enough=enough, defensive=_wider_prior
        )
        points = found.points
        places = np.zeros((len(points.x), len(paths)), int)

        if paths:
            alpha, beta = prior.betas(points.x)
            # Sequential imputation (Kong, Liu and Wong 1994) corrects for dependent failures.
            places, log_fail = impute(alpha + failed, beta + n - failed, paths, rng)
            ratio = points.log_ratio + log_fail - log_any_fails(alpha, beta)
            points = importance.Points.weighted(points.x, points.log_p, ratio)

        if points.k_hat <= MAX_KHAT:
            break
    return points, places


def _wider_prior(current: Mixture) -> Mixture:
    """Return a proposal for regions that the current one may miss."""
    d = current.center.shape[1]
    return Mixture.single(np.zeros(d), _PRIOR_SCALE * np.eye(d))


def _starts(prior: BoundPrior) -> np.ndarray:
    """Return the prior mean and points near possible modes as normal scores, (start, parameter)."""
    names = ["strength"]
    if prior.steepness is not None:
        names.append("margin")

    center = np.zeros(len(prior.center))
    starts = [center]
    for name in names:
        for score in (-_MODES[name], _MODES[name]):
            start = center.copy()
            start[_POSITIONS[name]] = score
            starts.append(start)
    return np.array(starts)


def _log_rising(x: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Compute the log of Gamma(x + k) / Gamma(x)."""
    exact = special.gammaln(x + k) - special.gammaln(x)
    if x.max(initial=0.0) < _LARGE:
        return exact

    # The difference of two large numbers has rounding errors; this expansion has an error of the
    # order of k^3 / x^2 (Abramowitz and Stegun 1964, 6.1.47).
    expanded = k * np.log(x) + 0.5 * k * (k - 1.0) / x
    return np.where(x < _LARGE, exact, expanded)


def impute(
    a: np.ndarray, b: np.ndarray, paths: Sequence[np.ndarray], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the bounds at which lost missions failed, one mission after another.

    Args:
        a: Alpha of each bound's Beta distribution without the lost missions, shape (point, bound).
        b: Beta of the same distributions, shape (point, bound).
        paths: Bound indices of each lost mission.
        rng: Random number generator.

    Returns:
        Places (point, mission), as indices into the paths, and log weights (point,). The mean of
        the weights is the probability that all missions fail.
    """
    a = a.copy()
    b = b.copy()
    uniform = rng.random((len(a), len(paths)))
    places = np.zeros(uniform.shape, int)
    log_weight = np.zeros(len(a))
    for j, path in enumerate(paths):
        # Probability that the mission passes all bounds before k and fails at k.
        survived = np.ones(len(a))
        within = np.empty((len(a), len(path)))
        done = b.copy()
        for k, e in enumerate(path):
            fails = a[:, e] / (a[:, e] + done[:, e])
            within[:, k] = survived * fails
            survived = survived * (1.0 - fails)
            done[:, e] += 1.0  # a path may include a bound twice

        favour = _lookahead(path, paths[j + 1 :], a, b)
        cumulative = (within * favour).cumsum(1)
        total = cumulative[:, -1]

        places[:, j] = (cumulative < uniform[:, j, None] * total[:, None]).sum(1)
        # The weight is the probability of a failure, relative to the favour of the place drawn.
        drawn = np.take_along_axis(favour, places[:, j, None], axis=1)[:, 0]
        log_weight += np.log(total / drawn)

        add_lost(path, places[:, j], a, b)

    return places, log_weight


def _lookahead(
    path: np.ndarray, later: Sequence[np.ndarray], a: np.ndarray, b: np.ndarray
) -> np.ndarray:
    """Compute the factor by which a failure at each bound makes later failures more probable.

    The factor has shape (point, bound). Without it, the few points that attribute several failures
    to one bound would have large weights.
    """
    favour = np.ones((len(a), len(path)))
    for other in later:
        chance = a[:, other] / (a[:, other] + b[:, other])
        arrives = (1.0 - chance).prod(1)
        for k, e in enumerate(path):
            if e in other:
                ratio = (a[:, e] + b[:, e]) / (a[:, e] + b[:, e] + 1.0)
                favour[:, k] *= (1.0 - arrives * ratio) / np.maximum(1.0 - arrives, _SMALLEST_P)
    return favour


def _to_dataset(
    prior: BoundPrior,
    trials: Trials,
    points: importance.Points,
    places: np.ndarray,
    measures: Sequence[str],
    exists: np.ndarray,
    seed: int,
    n_posts: int,
) -> xr.Dataset:
    """Make the group `hazard` without attributes.

    `measures` are the names of the measures that have weights, and `exists` says which bounds
    exist, shape (way, row, col, next_way).
    """
    rng = np.random.default_rng([seed, 2])
    chosen = rng.permutation(points.resample(_N_DRAWS, rng))
    weights, limit, strength = prior.values(points.x[chosen])

    degrees = {"units": "degrees"}
    of_limit = {
        name: ("draw", values, degrees)
        for name, values in zip(LIMIT_NAMES, limit.T, strict=False)  # empty without a limit
    }

    n = np.zeros(exists.shape)
    failed = np.zeros(exists.shape)
    n[*trials.bounds.T] = trials.n
    failed[*trials.bounds.T] = trials.failed

    longest = max((len(path) for path in trials.lost), default=0)
    lost = np.full((len(trials.lost), longest, len(_MAPS)), -1)
    for j, path in enumerate(trials.lost):
        lost[j, : len(path)] = trials.bounds[path]

    return xr.Dataset(
        {
            "intercept": ("draw", weights[:, 0]),
            "coefficient": (("draw", "measure"), weights[:, 1:]),
            **of_limit,
            "strength": ("draw", strength),
            "place": (("draw", "lost"), places[chosen] + 1),
            "lost_bound": (("lost", "bound", "axis"), lost),
            "trials": (_MAPS, n),
            "failures": (_MAPS, failed),
            "is_bound": (_MAPS[:-1], exists.any(-1)),
        },
        {
            "draw": np.arange(_N_DRAWS),
            "measure": list(measures),
            "axis": list(_MAPS),
            "move": way_names(n_posts),
            "next_move": next_names(n_posts),
        },
    )
