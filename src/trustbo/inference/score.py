"""Scores of contact rates that were predicted before a mission."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.data import Mission
from trustbo.errors import TrustboError, require_whole
from trustbo.inference.filter import TrustFilter
from trustbo.inference.order import as_fitted, in_order_of
from trustbo.inference.reports import QUANTILES
from trustbo.models.observations import Observations, require_ticks
from trustbo.parallel import computing
from trustbo.stacking import fill, list_of_missions, require_same_team
from trustbo.statespace import kalman
from trustbo.streams import stream
from trustbo.workspace import Workspace

INTERVALS = {"coverage_50": 0.5, "coverage_90": 0.9}
"""Share of rates that the central interval of each summary should contain."""


class Posteriors(list[xr.DataTree | None]):
    """Posteriors after each mission of a campaign, together with the missions.

    Attributes:
        missions: All missions of the campaign, in order.
        initial: Posterior before the first mission, given those of earlier campaigns; None if
            there are none.
    """

    def __init__(
        self,
        posteriors: Iterable[xr.DataTree | None],
        missions: Iterable[Mission],
        initial: xr.DataTree | None = None,
    ) -> None:
        """Store the missions and the posteriors, which are None where there was none yet."""
        super().__init__(posteriors)
        self.missions = list_of_missions(missions)
        self.initial = initial

    def __repr__(self) -> str:
        n_learned = sum(tree is not None for tree in self)
        return f"<{n_learned} posteriors after {len(self)} missions; the last is [-1]>"


@computing()
def score(
    posterior: xr.DataTree | Sequence[xr.DataTree | None],
    missions: Iterable[Mission] | None = None,
    *,
    workspace: Workspace | None = None,
    seed: int = 0,
) -> xr.Dataset:
    """Score predicted contact rates along the paths of missions.

    A prediction is the marginal distribution of a rate before the mission starts. It is averaged
    over parameter draws and place effects, and includes process and observation noise.

    Args:
        posterior: Posterior that predicts all `missions` and was not fitted to any of them; or all
            posteriors of a campaign (`Result.posteriors`), each of which predicts the next mission.
        missions: Missions to predict. For a campaign, these are all missions in order, which
            `Result.posteriors` contains. Missions without an earlier posterior and missions that
            the campaign excluded are left out.
        workspace: Workspace of the missions, used to fill in missing awareness as in `fit`.
        seed: Random seed for predictive draws and randomised PIT values.

    Returns:
        Dataset over (mission, bound, robot) for the predicted missions, with NaN where no rate was
        measured. The variables are `contact_rate`, the predicted `mean` and `quantile` (also over
        `level`), `pit` (the probability integral transform, randomised at point masses), and
        `log_score` in nats. Log scores apply to tick counts if every rate has n_ticks, otherwise to
        rates (see the attribute `log_score_of`). Summaries over all `n` rates are the shares
        `coverage_50` and `coverage_90` of rates in central intervals, `mean_log_score`, and `r2` of
        the predicted means.

    Raises:
        TrustboError: If a posterior is not from `fit`; the numbers of posteriors and missions do
            not match; there is no mission to predict; a path leaves the grid of place effects; or
            tick counts are missing.

    Example:
        >>> scores = tb.inference.score(result.posteriors)  # of each mission, given those before it
        >>> float(scores["coverage_90"])
    """
    require_whole("seed", seed, 0)
    if missions is None and isinstance(posterior, Posteriors):
        missions = posterior.missions
    missions, known = fill(() if missions is None else missions, workspace)

    trees, indices = predictions("score", posterior, missions, known)
    if not trees:
        raise TrustboError(
            f"score needs a mission that an earlier posterior predicts; none of {len(missions)} "
            "missions has one. Run more missions."
        )

    missions = require_same_team(missions[j] for j in indices)
    observations = Observations.from_missions(missions)
    y = observations.contact_rate
    robots = missions[0].robots  # the same for all missions, as are the features
    features = missions[0].features
    trust = _follow(in_order_of(trees[0], robots, features))

    parts = []
    for j, (tree, mission) in enumerate(zip(trees, missions, strict=True)):
        if j > 0 and tree is not trees[j - 1]:
            trust = _follow(in_order_of(tree, robots, features))
        require_ticks(trust.likelihood, y, observations.n_ticks)
        parts.append(_scored(trust, mission, stream(seed, "score", j)))

    # Short missions are padded with NaN.
    scores: Any = xr.concat(parts, pd.Index(indices, name="mission"), join="outer")

    # Scores of tick counts are comparable between families. They are NaN where ticks are unknown.
    scores.attrs["log_score_of"] = "contact_rate"
    shift = trust.likelihood.log_resolution(y, observations.n_ticks)
    if not np.isnan(shift).any():
        scores["log_score"] += shift
        scores.attrs["log_score_of"] = "ticks"

    columns = {name: scores[name].values for name in ("mean", "pit", "log_score")}
    return scores.assign(_summary(y, **columns))


def _follow(posterior: xr.DataTree) -> TrustFilter:
    """Make a filter from all draws of a posterior."""
    sizes = posterior["posterior"].sizes
    return TrustFilter(posterior, max_draws=sizes["chain"] * sizes["draw"])


def _scored(trust: TrustFilter, mission: Mission, rng: np.random.Generator) -> xr.Dataset:
    """Return the variables of `score` (bound, robot) for one mission, without those of ticks."""
    z = mission.awareness
    y = mission.contact_rate
    counts = trust.space.grouped(mission.n_ticks)
    path = mission.stations[: len(z) + 1] if trust.params.grid_shape and mission.path else None

    log_score = np.empty(y.shape)
    drawn = []
    for k, (belief, rates) in enumerate(trust.ahead(trust.inputs(z, path), counts, rng)):
        of_rates = kalman.marginal_log_densities(
            trust.space, belief, trust.space.grouped(y[k]), counts[k], trust.likelihood
        )

        # Log of the mean density over the draws of the parameters.
        log_score[k] = np.logaddexp.reduce(of_rates, axis=0) - np.log(len(rates))
        drawn.append(rates)
    drawn = np.stack(drawn, axis=1)

    dims = ("bound", "robot")
    quantile = np.moveaxis(np.quantile(drawn, QUANTILES, axis=0), 0, -1)
    variables = {
        "contact_rate": (dims, y),
        "quantile": ((*dims, "level"), quantile),
        "mean": (dims, drawn.mean(0)),
        "pit": (dims, _pit(drawn, y, rng)),
        "log_score": (dims, log_score),
    }
    coords = {
        "bound": np.arange(1, len(y) + 1),
        "robot": list(mission.robots),
        "level": list(QUANTILES),
    }
    is_measured = xr.DataArray(~np.isnan(y), dims=dims)
    return xr.Dataset(variables, coords).where(is_measured)


def _summary(
    contact_rate: np.ndarray, mean: np.ndarray, pit: np.ndarray, log_score: np.ndarray
) -> dict[str, float]:
    """Compute the coverage, the mean log score, R2 and the number of measured rates."""
    is_measured = np.isfinite(contact_rate)
    n = int(is_measured.sum())
    if n == 0:
        return dict.fromkeys((*INTERVALS, "mean_log_score", "r2"), np.nan) | {"n": 0}

    # A rate is in the central interval if its PIT is as close to 0.5.
    within = {
        name: float((np.abs(pit[is_measured] - 0.5) <= 0.5 * share).mean())
        for name, share in INTERVALS.items()
    }
    mean_log_score = float(log_score[is_measured].mean())

    y = contact_rate[is_measured]
    spread = ((y - y.mean()) ** 2).sum()
    r2 = np.nan
    if spread > 0.0:
        r2 = float(1.0 - ((y - mean[is_measured]) ** 2).sum() / spread)
    return within | {"mean_log_score": mean_log_score, "r2": r2, "n": n}


def predictions(
    who: str,
    posterior: xr.DataTree | Sequence[xr.DataTree | None],
    missions: Sequence[Mission],
    known: Sequence[int] | None = None,
) -> tuple[list[xr.DataTree], list[int]]:
    """Pair each mission that can be predicted with the posterior that predicts it.

    One posterior predicts all missions. In a campaign, each posterior predicts the next mission.
    Missions without an earlier posterior are left out. Missions to which the last posterior was not
    fitted, according to its attribute `missions`, were excluded from the campaign and are also left
    out.

    Args:
        who: Name of the public function, for messages.
        posterior: Posterior, or the posteriors after each mission, with None where there was none
            yet.
        missions: All missions, in order.
        known: Indices of the missions whose awareness is known; by default, all.

    Returns:
        Posteriors and the indices of the missions that they predict. Both lists have the same
        length, which may be 0.

    Raises:
        TrustboError: If a posterior is not from `fit`, there is none yet, there are no missions, or
            the numbers of posteriors and missions do not match.
    """
    if not missions:
        raise TrustboError(f"{who} needs missions to predict; got none.")
    if known is None:
        known = range(len(missions))

    if isinstance(posterior, xr.DataTree) or not isinstance(posterior, Sequence):
        return [as_fitted(who, posterior)] * len(known), list(known)

    last = last_posterior(who, posterior)
    if not len(missions) - 1 <= len(posterior) <= len(missions):
        raise TrustboError(
            f"got {len(posterior)} posteriors and {len(missions)} missions; give the posterior "
            "after each mission, as in Result.posteriors."
        )

    used = np.intersect1d(known, last.attrs.get("missions", known))
    pairs = [
        (as_fitted(who, tree), j)
        for j, tree in enumerate(posterior[: len(missions) - 1], start=1)
        if tree is not None and j in used
    ]
    return [tree for tree, _ in pairs], [j for _, j in pairs]


def last_posterior(who: str, posteriors: Sequence[xr.DataTree | None]) -> xr.DataTree:
    """Return the last posterior of a campaign; raise TrustboError if there is none yet."""
    initial = posteriors.initial if isinstance(posteriors, Posteriors) else None
    trees = [tree for tree in (initial, *posteriors) if tree is not None]
    if not trees:
        raise TrustboError(
            f"{who} needs a posterior, but nothing has been learned yet; run a mission with "
            "measured contact rates first."
        )
    return as_fitted(who, trees[-1])


def _pit(drawn: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Compute the randomised PIT of rates (bound, robot) among draws (draw, bound, robot).

    `loo_pit` of ArviZ is for rates to which a model was fitted, and can be 0 or 1 (see `by_rate`).
    """
    below = (drawn < y).sum(0)
    equal = (drawn == y).sum(0)

    # The rank of y among the draws; ties are broken at random.
    return (below + rng.random(y.shape) * (equal + 1.0)) / (len(drawn) + 1.0)
