"""Predictions one mission ahead by kind of world: the value of each component of the model.

    python benchmarks/predictions.py --data DIR --out out/predictions
    python benchmarks/predictions.py paths --only tahoe-aged tahoe-rain --data DIR

Missions of the default campaign are driven in every world; after missions 1, 2, 4, 8 and 12, each
method predicts the rates of the next one on the path it took. Methods: the default model; the same
without one of its parts (`no memory`: beta0 ~ Beta(1, 1000), 0 but for .001, for a point mass has
no quantiles, which the exact sampler needs); and those that predict rates without a state space,
see `Predictor`. Part `paths` holds the 90 % band of the contact lost on the path that the default
campaign would recommend against the truth of the next mission. Called again, it goes on where it
stopped; worlds and courses added later are added to it. Intervals are 95 %, by a bootstrap over
worlds and courses.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import numpyro.distributions as dist
import xarray as xr
from baselines import residual_process
from common import Table, arguments, parsed, records_of
from scipy import stats

from trustbo.campaign.campaign import Campaign
from trustbo.data import Cell, Mission, is_line_of_sight
from trustbo.inference import fit, score
from trustbo.inference.score import AMONG
from trustbo.models import PlaceEffect, PooledTrust, Priors, RobotEffect
from trustbo.models.backend import own_settings
from trustbo.planning import Planner
from trustbo.study import worlds
from trustbo.study.world import COURSES, World
from trustbo.workspace.moves import bounds_along

AFTER = (1, 2, 4, 8, 12)
"""Numbers of missions after which the next is predicted."""
NAMES = ("contact_rate", "mean", "pit", "log_score", "seen")


class Predictor(Protocol):
    """Method that predicts contact rates."""

    def predict(self, missions: Sequence[Mission], ahead: Mission) -> tuple[np.ndarray, np.ndarray]:
        """Mean and sd of the rates of the next mission, whose own are not read; (bound, robot)."""
        ...


class RunningMean:
    """Running mean of each bound and robot, line of sight as prior, by empirical Bayes.

    Residuals of line of sight are N(shift, sd^2) for each bound, plus noise of each mission; shift
    and both variances by moments.
    """

    def predict(self, missions: Sequence[Mission], ahead: Mission) -> tuple[np.ndarray, np.ndarray]:
        """See `Predictor.predict`."""
        shape = ahead.contact_rate.shape
        residuals = self._residuals(missions)
        every = np.concatenate([np.array(r) for r in residuals.values()])
        shift, total = every.mean(), max(every.var(), 1e-4)
        repeated = [np.var(r, ddof=1) for r in residuals.values() if len(r) > 1]
        noise = min(max(float(np.mean(repeated)) if repeated else 0.5 * total, 1e-4), total)
        spread = max(total - noise, 1e-4)
        mean = _sight(ahead) + shift
        var = np.full(shape, spread + noise)
        for k, bound in enumerate(_bounds(ahead).tolist()):
            for i in range(shape[1]):
                if (r := residuals.get((*bound, i))) is not None:
                    gain = spread / (spread + noise / len(r))
                    mean[k, i] += gain * (np.mean(r) - shift)
                    var[k, i] = spread * (1.0 - gain) + noise
        return mean, np.sqrt(var)

    def _residuals(self, missions: Sequence[Mission]) -> dict[Any, list[float]]:
        """Residuals of line of sight by bound and robot."""
        residuals: dict[Any, list[float]] = {}
        for mission in missions:
            r = mission.contact_rate - _sight(mission)
            for k, bound in enumerate(_bounds(mission).tolist()):
                for i in np.flatnonzero(~np.isnan(r[k])):
                    residuals.setdefault((*bound, int(i)), []).append(float(r[k, i]))
        return residuals


class ResidualProcess:
    """Gaussian process over bounds of the error of line of sight, mean over robots.

    Robots vary about it by the variance that they had in the bounds driven.
    """

    def predict(self, missions: Sequence[Mission], ahead: Mission) -> tuple[np.ndarray, np.ndarray]:
        """See `Predictor.predict`."""
        errors = np.concatenate([mission.contact_rate - _sight(mission) for mission in missions])
        measured = ~np.isnan(errors).all(1)
        errors = errors[measured]
        team = np.nanmean(errors, axis=1)
        free = max((~np.isnan(errors)).sum() - len(team), 1)
        among = np.nansum((errors - team[:, None]) ** 2) / free
        bounds = np.concatenate([_bounds(mission) for mission in missions])[measured]
        process = residual_process.fitted(bounds, team)
        mean, sd = process.predict(residual_process.places(_bounds(ahead)), return_std=True)
        sight = _sight(ahead)
        return sight + mean[:, None], np.broadcast_to(
            np.hypot(sd, among**0.5)[:, None], sight.shape
        )


PREDICTORS: dict[str, Callable[[], Predictor]] = {
    "running mean": RunningMean,
    "residual process": ResidualProcess,
}


def main():
    parser = arguments(
        __doc__, names=PARTS, data=True, out="out/predictions",
        quick="two small worlds, one course, 4 missions",
    )  # fmt: skip
    parser.add_argument("--only", nargs="*", help="names of worlds; all by default")
    parser.add_argument("--courses", nargs="*", default=list(COURSES))
    parser.add_argument("-m", "--missions", type=int, default=13, help="missions, default 13")
    given = parsed(parser)
    chosen = _chosen(given)
    courses, n = (given.courses[:1], 4) if given.quick else (given.courses, given.missions)
    for name in given.names:
        measure, show = PARTS[name]
        show(records_of(given.out / f"{name}.jsonl", chosen, courses, n, measure))


def scored(world: World, course: str, n: int) -> dict[str, Any]:
    """Scores of every method on some missions of one campaign, rate by rate."""
    workspace = world.workspace()
    missions = [workspace.fill(mission) for _, mission in _driven(world, course, n)]
    methods: dict[str, dict[str, list[float]]] = {}
    for m in AFTER:
        if m >= n:
            break
        learned, ahead = missions[:m], missions[m]
        scores = {
            name: score(fit(learned, model, sampler="importance", workspace=workspace, check=False,
                            progress=False), [ahead])
            for name, model in _models(ahead.features).items()
        }  # fmt: skip
        like = scores["default"]
        for name, make in PREDICTORS.items():
            scores[name] = _of_normal(*make().predict(learned, ahead), ahead, like)
        for name, one in scores.items():
            columns = methods.setdefault(name, {column: [] for column in NAMES})
            for column, values_of in _columns(one).items():
                columns[column] += values_of
    return {"world": world.name, "kind": world.kind, "course": course, "n": n, "methods": methods}


def banded(world: World, course: str, n: int) -> dict[str, Any]:
    """Bands of the contact lost on recommended paths in one campaign, and the truth: `values`."""
    truth, values = world.truth(), []
    for m, (campaign, _) in enumerate(_driven(world, course, n), start=1):
        if m in AFTER and m < n:
            low, high, path = _band(campaign)
            values.append([low, high, truth.at(m).lost(path)])
    return {"world": world.name, "kind": world.kind, "course": course, "n": n, "values": values}


def _driven(world: World, course: str, n: int) -> Iterator[tuple[Campaign, Mission]]:
    """The default campaign after each of its missions, and the mission."""
    workspace = world.workspace()
    campaign = Campaign(workspace, *world.ends(course), seed=0)
    for _, mission in campaign.run(world.simulator(workspace), n):
        yield campaign, mission


def show_scores(records: Sequence[dict[str, Any]]) -> None:
    """Print a table of all worlds, by bounds seen and new, and one by kind."""
    print(f"\n{len({r['world'] for r in records})} worlds, {len(records)} campaigns\n")
    table = Table("method", "bounds", "rates", "within 50 %", "within 90 %", "log score, nats",
                  "default's more", "R2", first=16)  # fmt: skip
    for among in AMONG:
        sums = _by_method(records, among)
        for name, one in sums.items():
            cells = [interval(one, share) for share in (_within_50, _within_90, _log_score)]
            more = "" if name == "default" else _more(sums, name)
            table.row(name, among, f"{one[:, 0].sum():.0f}", *cells, more, interval(one, _r2))
    others = list(records[0]["methods"])[1:]
    print("\nThe default by kind, and its log score less that of others\n")
    table = Table("kind", "worlds", "within 50 %", "within 90 %", *others)
    for title, mine in _by_kind(records):
        sums = _by_method(mine, "all")
        shares = [interval(sums["default"], share) for share in (_within_50, _within_90)]
        more = [_more(sums, name) for name in others]
        table.row(title, len({r["world"] for r in mine}), *shares, *more)


def show_paths(records: Sequence[dict[str, Any]]) -> None:
    """Print the share of the bands that hold the truth, by kind of world."""
    print("\nThe contact lost on the recommended path, within its 90 % band\n")
    table = Table("kind", "worlds", "campaigns", "paths", "path within 90 %")
    for title, mine in _by_kind(records):
        paths = np.array([[len(v), sum(low <= lost <= high for low, high, lost in v)]
                          for v in (r["values"] for r in mine)], float)  # fmt: skip
        table.row(title, len({r["world"] for r in mine}), len(mine), f"{paths[:, 0].sum():.0f}",
                  interval(paths, lambda s: s[1] / s[0]))  # fmt: skip


PARTS = {"scores": (scored, show_scores), "paths": (banded, show_paths)}


def _by_kind(records: Sequence[dict[str, Any]]) -> list[tuple[str, list[dict[str, Any]]]]:
    """All records, and those of each kind of world."""
    kinds = list(dict.fromkeys(r["kind"] for r in records))
    return [("all", list(records)), *((k, [r for r in records if r["kind"] == k]) for k in kinds)]


def _by_method(records: Sequence[dict[str, Any]], among: str) -> dict[str, np.ndarray]:
    """Sums of each campaign (campaign, sum), by method; see `_sums`."""
    return {
        name: np.array([_sums(r["methods"][name], among) for r in records])
        for name in records[0]["methods"]
    }


def _more(sums: dict[str, np.ndarray], name: str) -> str:
    """Log score of the default less that of another method."""
    both = np.hstack([sums["default"], sums[name]])
    return interval(both, lambda b: _log_score(b[:7]) - _log_score(b[7:]))


def interval(sums: np.ndarray, figure: Callable[[np.ndarray], float], n: int = 1000) -> str:
    """Figure of the sums of all campaigns (campaign, sum), and its 95 % interval by a bootstrap."""
    if not sums[:, 0].sum():
        return ""
    rows = np.random.default_rng(0).integers(len(sums), size=(n, len(sums)))
    with np.errstate(all="ignore"):
        drawn = [figure(one) for one in sums[rows].sum(1)]
    low, high = np.nanquantile(drawn, (0.025, 0.975))
    return f"{figure(sums.sum(0)):.2f} [{low:.2f}, {high:.2f}]"


def _sums(columns: dict[str, list[float]], among: str) -> np.ndarray:
    """Sums over the rates of a campaign, see `_within_50` to `_r2`."""
    y, mean, pit, log_score, seen = (np.array(columns[name], float) for name in NAMES)
    kept = {"all": seen >= 0.0, "seen": seen == 1.0, "new": seen == 0.0}[among]
    y, mean, pit, log_score = y[kept], mean[kept], pit[kept], log_score[kept]
    off = np.abs(pit - 0.5)
    return np.array([len(y), (off <= 0.25).sum(), (off <= 0.45).sum(), log_score.sum(),
                     ((y - mean) ** 2).sum(), y.sum(), (y**2).sum()])  # fmt: skip


def _within_50(sums: np.ndarray) -> float:
    return sums[1] / sums[0]


def _within_90(sums: np.ndarray) -> float:
    return sums[2] / sums[0]


def _log_score(sums: np.ndarray) -> float:
    return sums[3] / sums[0]


def _r2(sums: np.ndarray) -> float:
    return 1.0 - sums[4] / (sums[6] - sums[5] ** 2 / sums[0])


def _chosen(given: Any) -> list[World]:
    listed = worlds(given.data)
    if given.only:
        return [listed[name] for name in given.only]
    usable = [w for w in listed.values() if w.is_packaged or given.data is not None]
    if not given.quick:
        return usable
    made = {world.kind: world for world in reversed(usable) if world.is_made}
    return [replace(made[kind], name=f"{made[kind].name}-small", shape=(5, 5), cell=40.0)
            for kind in ("right", "aged")]  # fmt: skip


def _models(features: Sequence[str]) -> dict[str, PooledTrust]:
    """Models by name, the default first."""
    with own_settings():
        none = replace(Priors.of(features), beta0=dist.Beta(1.0, 1000.0))
    return {
        "default": PooledTrust(effects=(PlaceEffect(), RobotEffect())),
        "no memory": PooledTrust(none, effects=(PlaceEffect(), RobotEffect())),
        "no robots": PooledTrust(effects=(PlaceEffect(),)),
        "no places": PooledTrust(effects=(RobotEffect(),)),
        "neither": PooledTrust(),
    }


def _band(campaign: Campaign) -> tuple[float, float, Sequence[Cell]]:
    """Ends of the 90 % band of contact lost on the path that would be recommended, and the path."""
    path = campaign.recommend().path
    observation = campaign.model.observation
    planner = Planner(campaign.workspace, path[0], path[-1], family=observation)
    low, high = planner.evaluate(path, campaign.posterior).value_band
    return -high, -low, path


def _of_normal(mean: np.ndarray, sd: np.ndarray, ahead: Mission, like: xr.Dataset) -> xr.Dataset:
    """Scores of normal predictions of a mission, of rates as in the scores of a model."""
    scores, y = like.copy(deep=True), ahead.contact_rate
    log_score = stats.norm.logpdf(y, mean, sd)
    if like.attrs["log_score_of"] == "ticks":
        log_score = log_score - np.log(ahead.n_ticks)
    columns = {"mean": mean, "pit": stats.norm.cdf(y, mean, sd), "log_score": log_score}
    for name, values in columns.items():
        scores[name].values[0] = np.where(np.isnan(y), np.nan, values)
    return scores


def _columns(scores: xr.Dataset) -> dict[str, list[float]]:
    """Columns of `NAMES`, one number a rate."""
    y = scores["contact_rate"]
    kept = np.isfinite(y.values)
    return {
        name: scores[name].broadcast_like(y).transpose(*y.dims).values[kept].astype(float)
        .round(5).tolist()
        for name in NAMES
    }  # fmt: skip


def _sight(mission: Mission) -> np.ndarray:
    """Line of sight of each bound and robot."""
    index = [i for i, name in enumerate(mission.features) if is_line_of_sight(name)]
    return mission.awareness[..., index].mean(-1)


def _bounds(mission: Mission) -> np.ndarray:
    """Move, row and column of the bounds run, (bound, 3)."""
    return bounds_along(mission.path)[: len(mission.bounds)]


if __name__ == "__main__":
    main()
