"""Hazard of bounds: the chance that a bound ends the mission, learned from missions.

Bound e, from one cell to the next, fails with chance p_e ~ Beta(s m_e, s (1 - m_e)). Its prior mean
follows from how difficult the way is, and how steep, t_e degrees beyond the assumed slope limit,

    1 - m_e = sigma(-logit_e) sigma(-(t_e + margin) / width),
    logit_e = intercept + sum_j coefficient_j (difficulty_ej - 1/2),

where the margin, by which the true limit is below the assumed one, is not known. Its prior believes
the assumed limit, with some doubt. A bound that was never tried is judged by others like it, and
one that was tried mostly by what happened there, the less strength s, the more. Derivation:
docs/failures.md.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.data import Mission
from trustbo.errors import (
    PosteriorError,
    TrustboError,
    require_not_negative,
    require_positive,
    require_whole,
)
from trustbo.hazard.difficulty import difficulty_of
from trustbo.hazard.exposures import CAUSES, Exposures, LostMission
from trustbo.hazard.risk import BoundRisk
from trustbo.hazard.sampler import (
    LIMIT,
    LIMIT_NAMES,
    TILT,
    BetaPriors,
    Points,
    sample,
    steepness_of,
)
from trustbo.inference.samplers.weights import systematic
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVE_NAMES

REFERENCE = 0.5
"""Difficulty at which the intercept is the logit of the prior mean."""


@dataclass(frozen=True)
class Hazard:
    """Priors of the chance that a bound ends the mission; normal ones are (mean, sd).

    The prior of the margin is a mixture of two normals with the same mean. By default the stated
    slope limit is right to half a degree with probability .9, and off by some 4 degrees with .1.

    Attributes:
        intercept: Prior of the logit of the mean chance at medium difficulty.
        coefficient: Prior of the weight of each measure of difficulty, from easy (0) to the robots'
            limit (1), but for the tilt.
        margin: Prior of the degrees by which the team's true slope limit is below the assumed one.
            Bounds share it: a failure on one raises the chance of all that are as steep. This is
            the part of the prior for a limit that is right as stated.
        doubt: Probability that the stated limit is wrong, and the sd of the margin then, degrees.
            With a probability of 0 the prior is `margin` alone, as for a limit that was measured.
        log_width: Prior of the log of the width of the limit in degrees: the chance to fail rises
            from .1 to .9 within 4.4 widths of tilt.
        log_strength: Prior of the log of the strength s: the prior mean in units of observations,
            few where bounds fail always or never.
        cause: Concentration of the Dirichlet over the causes of failure, for each.

    Raises:
        TrustboError: An sd or a concentration that is not positive, or a share outside [0, 1).
    """

    intercept: tuple[float, float] = (-7.5, 1.5)
    coefficient: tuple[float, float] = (2.0, 2.0)
    margin: tuple[float, float] = (0.0, 0.5)
    doubt: tuple[float, float] = (0.1, 4.0)
    log_width: tuple[float, float] = (0.0, 0.5)
    log_strength: tuple[float, float] = (-0.5, 1.0)
    cause: float = 0.2

    def __post_init__(self) -> None:
        for name in _NORMALS:
            mean, sd = getattr(self, name)
            value = float(mean), require_positive(f"sd of {name}", sd)
            object.__setattr__(self, name, value)
        share, sd = self.doubt
        doubt = require_not_negative("share of doubt", share), require_positive("sd of doubt", sd)
        if doubt[0] >= 1.0:
            raise TrustboError(f"share of doubt must be in [0, 1); got {share!r}.")
        object.__setattr__(self, "doubt", doubt)
        require_positive("cause", self.cause)

    def beta_priors(
        self, difficulty: np.ndarray, measures: Sequence[str], max_slope: float
    ) -> BetaPriors:
        """Prior of the bounds' chances given difficulties (bound, measure) and their names.

        The tilt is judged by the limit, `max_slope` in rad less the margin, the other measures by
        weights.
        """
        has_weight = np.array([name != TILT for name in measures], dtype=bool)
        weights, limit, steepness = [self.coefficient] * int(has_weight.sum()), [], None
        if TILT in measures:
            limit = [self.margin, self.log_width]
            steepness = steepness_of(difficulty[:, list(measures).index(TILT)], max_slope)
        center, scale = np.array([self.intercept, *weights, *limit, self.log_strength]).T
        is_log = np.array([*[False] * (1 + len(weights)), *[False, True][: len(limit)], True])
        difficulty = difficulty[:, has_weight] - REFERENCE
        return BetaPriors(center, scale, is_log, difficulty, steepness, self.doubt)

    def prior(self, workspace: Workspace, *, seed: int = 0, n_draws: int = 1000) -> BoundRisk:
        """Risk of the bounds of a workspace before any mission."""
        return BoundRisk.of(fit_hazard([], workspace, self, seed=seed, n_draws=n_draws), workspace)


def fit_hazard(
    missions: Sequence[Mission],
    workspace: Workspace,
    hazard: Hazard | None = None,
    *,
    lost: Sequence[LostMission] = (),
    weights: ArrayLike | None = None,
    lost_weights: ArrayLike | None = None,
    seed: int = 0,
    n_draws: int = 1000,
    check: bool = True,
) -> xr.Dataset:
    """Learn the chance to fail of every bound, by importance sampling in NumPy.

    Bounds completed are exposures survived, the last bound of a mission that failed is one that
    failed; an aborted bound counts for nothing. Where a lost mission failed is imputed with the
    hyperparameters: draws are of the joint posterior.

    Args:
        missions: Missions as measured, none needed.
        workspace: Workspace of their paths, whose terrain gives the difficulty of bounds; without
            one, the mean has an intercept only.
        hazard: Priors; by default `Hazard()`.
        lost: Missions that failed and did not report.
        weights: Weight of each mission, shape (mission,); 1 by default.
        lost_weights: Weight of each lost mission, shape (lost,); 1 by default.
        seed: Seed; the same seed gives the same posterior.
        n_draws: Number of draws.
        check: Refuse a posterior with k-hat > 0.7; `False` returns it unchecked.

    Returns:
        The group `hazard` of a posterior: `intercept` (draw), `coefficient` (draw, measure),
        `margin` and `width` of the slope limit (draw), in degrees, where there is a terrain,
        `strength` (draw), and `place` (draw, lost), the bound from 1 at which each mission lost
        somewhere unknown failed; `p_fail` and `p_fail_sd` (move, row, col), posterior mean and sd
        of the chance to fail, NaN where there is no bound; `exposures` and `failures` (move, row,
        col), counts of the known ones; `failures_by_cause` (cause). `BoundRisk.of` draws from it.

    Raises:
        TrustboError: A mission's path jumps or leaves the grid, or an unknown cause.
        PosteriorError: k-hat is beyond its limit.
    """
    started, hazard = time.perf_counter(), Hazard() if hazard is None else hazard
    n_draws, seed = require_whole("n_draws", n_draws, 1), require_whole("seed", seed, 0)
    exposures = Exposures.of(missions, lost, weights, lost_weights)
    difficulty, names = difficulty_of(workspace).values, measures_of(workspace)
    _require_on_grid(exposures, difficulty.shape[1:3])
    met = difficulty[*exposures.bounds.T]
    # A driven bound that does not exist on the map: largest difficulty.
    betas = hazard.beta_priors(np.nan_to_num(met, nan=1.0), names, workspace.team.max_slope)
    points = sample(betas, exposures, seed)
    group = _dataset(hazard, betas, exposures, points, workspace, n_draws, seed)
    risk = BoundRisk.of(group, workspace)
    dims = ("move", "row", "col")
    group = group.assign(p_fail=(dims, risk.mean), p_fail_sd=(dims, risk.sd))
    group.attrs["seconds"] = time.perf_counter() - started
    if check and not points.k_hat <= LIMIT:
        raise PosteriorError(
            f"hazard refused: k-hat = {points.k_hat:.2f} > {LIMIT:g}.",
            group,
            "Give firmer priors, Hazard(...), or pass check=False to have it as it is.",
        )
    return group


def _require_on_grid(exposures: Exposures, shape: tuple[int, ...]) -> None:
    cells = exposures.bounds[:, 1:]
    if (off := ((cells < 0) | (cells >= shape)).any(1)).any():
        cell = tuple(cells[np.argmax(off)].tolist())
        raise TrustboError(f"a mission enters {cell}, outside the grid of {shape} rows and cols.")


def measures_of(workspace: Workspace) -> list[str]:
    """Names of the measures of difficulty of a workspace, none without a terrain."""
    return [str(name) for name in difficulty_of(workspace)["measure"].values]


def _dataset(
    hazard: Hazard,
    betas: BetaPriors,
    exposures: Exposures,
    points: Points,
    workspace: Workspace,
    n_draws: int,
    seed: int,
) -> xr.Dataset:
    """The group without the maps of chances."""
    rng = np.random.default_rng([seed, 2])
    chosen = rng.permutation(systematic(points.weights, n_draws, rng))
    weights, limit, strength = betas.split(betas.values(points.z[chosen]))
    degrees = {"units": "degrees"}  # absent without a limit
    of_limit = {n: ("draw", v, degrees) for n, v in zip(LIMIT_NAMES, limit.T, strict=False)}
    shape = difficulty_of(workspace).shape[:3]
    n, failed = np.zeros(shape), np.zeros(shape)
    n[*exposures.bounds.T], failed[*exposures.bounds.T] = exposures.n, exposures.failed
    longest = max((len(path) for path in exposures.lost), default=0)
    lost = np.full((len(exposures.lost), longest, 3), -1)
    for j, path in enumerate(exposures.lost):
        lost[j, : len(path)] = exposures.bounds[path]
    maps = ("move", "row", "col")
    return xr.Dataset(
        {
            "intercept": ("draw", weights[:, 0]),
            "coefficient": (("draw", "measure"), weights[:, 1:]),
            **of_limit,
            "strength": ("draw", strength),
            "place": (("draw", "lost"), points.places[chosen] + 1),
            "lost_bound": (("lost", "bound", "axis"), lost),
            "lost_weight": ("lost", exposures.lost_weights),
            "exposures": (maps, n),
            "failures": (maps, failed),
            "failures_by_cause": ("cause", exposures.causes),
        },
        {
            "draw": np.arange(n_draws),
            "measure": [name for name in measures_of(workspace) if name != TILT],
            "cause": list(CAUSES),
            "axis": list(maps),
            "move": list(MOVE_NAMES),
        },
        {
            "k_hat": points.k_hat if np.isfinite(points.k_hat) else float(np.sign(points.k_hat)),
            "kish": float(1.0 / (points.weights**2).sum()),
            "seed": seed,
            "reference": REFERENCE,
            "cause_concentration": hazard.cause,
            **{f"prior_{n}": list(getattr(hazard, n)) for n in (*_NORMALS, "doubt")},
        },
    )


_NORMALS = ("intercept", "coefficient", "margin", "log_width", "log_strength")
