"""Scores of predictions: contact rates of a mission, before it is run, against those measured."""

import itertools
from collections.abc import Sequence

import numpy as np
import xarray as xr

from trustbo.data import Mission
from trustbo.errors import TrustboError, require_whole
from trustbo.inference.draws import missions_of, params_of, require_posterior, sites_of
from trustbo.inference.filter import Dynamics
from trustbo.inference.importance import systematic
from trustbo.models.families import Family, family_of
from trustbo.models.slots import require_ticks
from trustbo.models.visited import bounds_of
from trustbo.stacking import MissionBatch, stack_missions
from trustbo.workspace import Workspace
from trustbo.workspace.moves import require_on_grid

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
INTERVALS = {"coverage_50": 0.5, "coverage_90": 0.9}
AMONG = ("all", "seen", "new")
_DIMS = ("mission", "bound", "robot")


def score(
    posterior: xr.DataTree | Sequence[xr.DataTree],
    missions: Sequence[Mission],
    *,
    ahead: int = 1,
    filtered: bool = False,
    workspace: Workspace | None = None,
    seed: int = 0,
) -> xr.Dataset:
    """Score predictions of contact rates along the paths that missions took.

    A prediction is the marginal distribution of each rate before the first bound of its mission:
    over parameter draws and effects of places, with the noises of trust and of rates. With
    `filtered` it is that before the bound itself, the rates of the mission's earlier bounds known:
    parameter draws have the weights, and trust the moments, of `TrustFilter`.

    Args:
        posterior: Posterior, which predicts all `missions`, none of which it was fitted to; or
            those of a campaign, `Result.posteriors`, the j-th fitted to `missions[: j + 1]`.
        missions: Missions to predict; for a campaign, all of its missions in order.
        ahead: Number of missions ahead that the posteriors of a campaign predict: 1, the next.
        filtered: Whether rates are predicted one bound ahead, as of a log that goes on.
        workspace: Workspace of the missions, to fill in awareness that they lack, as for `fit`.
        seed: Seed of the draws that rates are compared with, and of randomised PIT values.

    Returns:
        Dataset over (mission, bound, robot), NaN where no rate was measured, in missions that were
        predicted: `contact_rate`, its `mean`, `quantile` (also over `level`), `pit`, the
        probability integral transform, randomised where rates have point masses, and `log_score`,
        nats, of counts of ticks where every rate has an n_ticks (attribute `log_score_of`), else of
        densities, and probabilities at limits of censored rates. `seen` (mission, bound): whether a
        mission that the posterior was fitted to made the same bound. Over `among`, all bounds,
        those seen and new ones: `coverage_50` and `coverage_90`, the shares of rates in the central
        intervals; `mean_log_score`; `r2`, 1 less the squared errors of the means relative to those
        of the average rate; and the number `n` of rates.

    Raises:
        TrustboError: No posterior of `fit`, or a single one without its missions; not as many
            posteriors as missions, or too few missions for `ahead`; a path that leaves the grid of
            places with effects; or missing ticks.
    """
    require_whole("seed", seed, 0)
    missions = [m if workspace is None else workspace.fill(m) for m in missions]
    pairs = _pairs(posterior, missions, require_whole("ahead", ahead, 1))
    batch = stack_missions([mission for _, mission, _ in pairs], pad=False)
    shape, latest = batch.contact_rate.shape, None
    columns = {name: np.full(shape, np.nan) for name in ("mean", "pit", "log_score")}
    quantile, seen = np.full((*shape, len(QUANTILES)), np.nan), np.zeros(shape[:2], dtype=bool)
    for j, (tree, mission, learned) in enumerate(pairs):
        if tree is not latest:
            latest, predictor = tree, _Predictor(tree)
        k = slice(len(mission.bounds))
        one = MissionBatch(*(a[j, k] for a in batch))
        require_ticks(predictor.family, one.contact_rate, one.n_ticks)  # pyright: ignore[reportPossiblyUnboundVariable]
        rng, y = np.random.default_rng([seed, j]), one.contact_rate
        log_scores, drawn = predictor.predict(mission, one, filtered, rng)  # pyright: ignore[reportPossiblyUnboundVariable]
        columns["mean"][j, k] = np.where(np.isnan(y), np.nan, drawn.mean(0))
        columns["pit"][j, k] = _pit(drawn, y, rng)
        columns["log_score"][j, k] = log_scores
        quantile[j, k] = np.moveaxis(np.quantile(drawn, QUANTILES, axis=0), 0, -1)
        made = {bound for other in learned for bound in _bounds(other) if other.has_map}
        seen[j, k] = [bound in made for bound in _bounds(mission)]
    first = len(missions) - len(pairs)
    return _dataset(batch, columns, quantile, seen, predictor.family, missions[first:], first)  # pyright: ignore[reportPossiblyUnboundVariable]


class _Predictor:
    """Predictions of missions by one posterior."""

    def __init__(self, posterior: xr.DataTree) -> None:
        self._params = params_of(posterior, day=True).flat()
        n_robots = posterior.attrs["n_robots"]
        self.family = family_of(posterior.attrs["observation"])
        delta_s = sites_of(posterior).get("delta_s")
        self._dynamics = Dynamics(self._params, self.family, n_robots, delta_s)

    def predict(
        self, mission: Mission, batch: MissionBatch, filtered: bool, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Log density of each rate (bound, robot), and draws of rates (draw, bound, robot).

        With `filtered` draws are weighted by the rates before, and rates are drawn given these.
        """
        dynamics, (z, y, ticks) = self._dynamics, batch
        n = len(self._params.b)
        log_weight, log_scores, drawn = np.full(n, -np.log(n)), np.full(y.shape, np.nan), []
        beliefs = dynamics.start()
        x = dynamics.draw(beliefs, rng)
        for k, effect in enumerate(self._effects(mission)):
            if filtered:
                x = dynamics.draw(beliefs, rng)
            x, rates = dynamics.roll(x, z[k], ticks[k], rng, effect)
            beliefs = dynamics.predict(beliefs, z[k], effect)
            density = dynamics.log_densities(beliefs, y[k], ticks[k])
            one = np.logaddexp.reduce(density + log_weight[:, None], axis=0)
            log_scores[k] = np.where(np.isnan(y[k]), np.nan, one)
            if filtered:
                rates = rates[systematic(np.exp(log_weight), n, rng)]
                beliefs, gained = dynamics.update(beliefs, y[k], ticks[k])
                log_weight = log_weight + gained
                log_weight -= np.logaddexp.reduce(log_weight)
            drawn.append(rates)
        return log_scores, np.stack(drawn, axis=1)

    def _effects(self, mission: Mission) -> Sequence[np.ndarray | float]:
        """Effect of each bound's place; TrustboError: the path leaves the grid of places."""
        if not self._params.places:
            return [0.0] * len(mission.bounds)
        for effects in self._params.places.values():
            require_on_grid(mission.path, effects.shape[-2:])
        return list(np.moveaxis(self._params.of_places(bounds_of([mission])[0]), -2, 0))


def summarize_scores(
    contact_rate: np.ndarray, mean: np.ndarray, pit: np.ndarray, log_score: np.ndarray
) -> dict[str, float]:
    """Coverage, mean log score, R2 and number of some rates, NaN where not measured."""
    kept = np.isfinite(contact_rate) & np.isfinite(pit)
    y, n = contact_rate[kept], int(kept.sum())
    if not n:
        return dict.fromkeys((*INTERVALS, "mean_log_score", "r2"), np.nan) | {"n": 0}
    spread = ((y - y.mean()) ** 2).sum()
    within = {
        name: float((np.abs(pit[kept] - 0.5) <= 0.5 * share).mean())
        for name, share in INTERVALS.items()
    }
    r2 = 1.0 - ((y - mean[kept]) ** 2).sum() / spread if spread > 0.0 else np.nan
    log_scores = float(log_score[kept].mean())
    return within | {"mean_log_score": log_scores, "r2": float(r2), "n": n}


def _pairs(
    posterior: xr.DataTree | Sequence[xr.DataTree], missions: Sequence[Mission], ahead: int
) -> list[tuple[xr.DataTree, Mission, Sequence[Mission]]]:
    """Posterior, mission to predict, and missions that the posterior was fitted to."""
    if not missions:
        raise TrustboError("score needs missions to predict; got none.")
    if isinstance(posterior, xr.DataTree) or not isinstance(posterior, Sequence):
        tree = require_posterior("score", posterior)
        if "constant_data" not in tree.children:
            raise TrustboError(
                "this posterior holds parameters alone: give all of a campaign's, such as "
                "score(result.posteriors, result.missions)."
            )
        if ahead != 1:
            raise TrustboError(
                f"ahead={ahead} is of posteriors of a campaign; one posterior predicts the "
                "missions given."
            )
        learned = missions_of(tree)
        return [(tree, mission, learned) for mission in missions]
    trees = [require_posterior("score", tree) for tree in posterior]
    if not len(missions) - ahead <= len(trees) <= len(missions):
        raise TrustboError(
            f"{len(trees)} posteriors and {len(missions)} missions: give one posterior after each "
            "mission, as Result.posteriors."
        )
    if len(missions) <= ahead:
        raise TrustboError(
            f"{len(missions)} missions leave none to predict {ahead} ahead; give more missions."
        )
    return [
        (trees[j - ahead], missions[j], missions[: j - ahead + 1])
        for j in range(ahead, len(missions))
    ]


def _pit(drawn: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Randomised PIT of rates (bound, robot) among draws (draw, bound, robot)."""
    below, equal = (drawn < y).sum(0), (drawn == y).sum(0)
    pit = (below + rng.random(y.shape) * (equal + 1.0)) / (len(drawn) + 1.0)
    return np.where(np.isnan(y), np.nan, pit)


def _bounds(mission: Mission) -> list[tuple[tuple[int, ...], ...]]:
    """Directed bounds that a mission made."""
    if not mission.has_map:
        return [()] * len(mission.bounds)
    cells = [tuple(cell) for cell in mission.path[: len(mission.bounds) + 1]]
    return [*itertools.pairwise(cells)]


def _dataset(
    batch: MissionBatch,
    columns: dict[str, np.ndarray],
    quantile: np.ndarray,
    seen: np.ndarray,
    family: Family,
    missions: Sequence[Mission],
    first: int,
) -> xr.Dataset:
    """Scores and their summaries by name."""
    y, attrs = batch.contact_rate, {"log_score_of": "contact_rate"}
    shift = family.log_resolution(y, batch.n_ticks)
    if not np.isnan(shift).any():
        columns["log_score"] = columns["log_score"] + shift
        attrs["log_score_of"] = "ticks"
    quantile[np.isnan(y)] = np.nan
    made = np.arange(y.shape[1]) < np.array([len(m.bounds) for m in missions])[:, None]
    values = [y, *(columns[name] for name in ("mean", "pit", "log_score"))]
    rows = [
        summarize_scores(*(np.where(group[..., None], a, np.nan) for a in values))
        for group in (made, made & seen, made & ~seen)
    ]
    variables = {"contact_rate": (_DIMS, y), "quantile": ((*_DIMS, "level"), quantile)}
    variables |= {name: (_DIMS, column) for name, column in columns.items()}
    variables |= {"seen": (("mission", "bound"), seen)}
    variables |= {name: (("among",), [row[name] for row in rows]) for name in rows[0]}
    coords = {
        "mission": np.arange(first, first + len(y)),
        "bound": np.arange(1, y.shape[1] + 1),
        "robot": list(missions[0].robots),
        "level": list(QUANTILES),
        "among": list(AMONG),
    }
    return xr.Dataset(variables, coords, attrs)
