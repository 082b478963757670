"""Scores of predictions: contact rates of a mission, before it is run, against those measured."""

import itertools
from collections.abc import Sequence

import numpy as np
import xarray as xr

from trustbo.data import Mission
from trustbo.errors import TrustboError, require_whole
from trustbo.inference.draws import params_of
from trustbo.inference.evidence.live import Rates, live_filter
from trustbo.inference.posterior_groups import Conditional
from trustbo.inference.posterior_tree import missions_of, require_posterior
from trustbo.inference.samplers.weights import systematic
from trustbo.models.families import Family
from trustbo.models.params import Params
from trustbo.models.place import bounds_of
from trustbo.models.state_space.generate import draw_missions
from trustbo.models.ticks import require_ticks
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
    shape = batch.contact_rate.shape
    columns = {name: np.full(shape, np.nan) for name in ("mean", "pit", "log_score")}
    quantile, seen = np.full((*shape, len(QUANTILES)), np.nan), np.zeros(shape[:2], dtype=bool)
    latest, params = pairs[0][0], params_of(pairs[0][0], day=True).flat()
    for j, (tree, mission, learned) in enumerate(pairs):
        if tree is not latest:
            latest, params = tree, params_of(tree, day=True).flat()
        conditional = Conditional.of(tree)
        one = MissionBatch(*(a[j : j + 1, : len(mission.bounds)] for a in batch))
        require_ticks(conditional.family, one)
        rng = np.random.default_rng([seed, j])
        there = _on_path(params, mission)
        k = slice(len(mission.bounds))
        y = one.contact_rate[0]
        log_scores, drawn = _bound_by_bound(conditional, params, mission, one, filtered, rng)
        if drawn is None:
            drawn = draw_missions(conditional.family, there, one.awareness,
                                  one.n_ticks, rng).contact_rate[:, 0]  # fmt: skip
        columns["mean"][j, k] = np.where(np.isnan(y), np.nan, drawn.mean(0))
        columns["pit"][j, k] = _pit(drawn, y, rng)
        columns["log_score"][j, k] = log_scores
        quantile[j, k] = np.moveaxis(np.quantile(drawn, QUANTILES, axis=0), 0, -1)
        made = {bound for other in learned for bound in _bounds(other) if other.has_map}
        seen[j, k] = [bound in made for bound in _bounds(mission)]
    first = len(missions) - len(pairs)
    family = Conditional.of(latest).family
    return _dataset(batch, columns, quantile, seen, family, missions[first:], first)


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


def _on_path(params: Params, mission: Mission) -> Params:
    """Parameters of one mission; TrustboError: its path leaves the grid of places."""
    if not params.places:
        return params
    for effects in params.places.values():
        require_on_grid(mission.path, effects.shape[-2:])
    return params.on(bounds_of([mission]))


def _pit(drawn: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Randomised PIT of rates (bound, robot) among draws (draw, bound, robot)."""
    below, equal = (drawn < y).sum(0), (drawn == y).sum(0)
    pit = (below + rng.random(y.shape) * (equal + 1.0)) / (len(drawn) + 1.0)
    return np.where(np.isnan(y), np.nan, pit)


def _bound_by_bound(
    conditional: Conditional,
    params: Params,
    mission: Mission,
    batch: MissionBatch,
    filtered: bool,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray | None]:
    """Log density of each rate (bound, robot) averaged over draws, nats, and draws of the rates.

    With `filtered` draws are weighted by the rates before, and rates (draw, bound, robot) are drawn
    given these; otherwise nothing of the mission is measured, and rates are not drawn.
    """
    z, y, ticks = (a[0] for a in batch)
    family, n_robots = conditional.family, y.shape[1]
    core = live_filter(params, n_robots)
    effects = [0.0] * len(y)
    if params.places:
        effects = np.moveaxis(params.of_places(bounds_of([mission])[0]), -2, 0)
    (mean, var), log_scores = core.start(), np.full(y.shape, np.nan)
    log_weight, drawn = np.full(len(mean), -np.log(len(mean))), []
    for k, effect in enumerate(effects):
        for i in np.flatnonzero(~np.isnan(y[k])):
            alone = Rates(family, np.where(np.arange(n_robots) == i, y[k], np.nan), ticks[k])
            density = core.update(mean, var, z[k], alone, effect)[2]
            log_scores[k, i] = np.logaddexp.reduce(density + log_weight)
        if not filtered:
            mean, var = core.predict(mean, var, z[k], effect)
            continue
        x = core.draw(rng, mean, var)
        rates = core.roll(rng, family, x, z[k], effect, ticks[k])[1]
        drawn.append(rates[systematic(np.exp(log_weight), len(log_weight), rng)])
        mean, var, gained = core.update(mean, var, z[k], Rates(family, y[k], ticks[k]), effect)
        log_weight = log_weight + gained
        log_weight -= np.logaddexp.reduce(log_weight)
    log_scores += family.log_constant
    return log_scores, np.stack(drawn, axis=1) if filtered else None


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
    groups = {"all": made, "seen": made & seen, "new": made & ~seen}
    names = ("mean", "pit", "log_score")
    rows = [
        summarize_scores(*(np.where(mask[..., None], a, np.nan)
                           for a in (y, *(columns[name] for name in names))))
        for mask in (groups[name] for name in AMONG)
    ]  # fmt: skip
    variables = {"contact_rate": (_DIMS, y), "quantile": ((*_DIMS, "level"), quantile)}
    variables |= {name: (_DIMS, values) for name, values in columns.items()}
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
