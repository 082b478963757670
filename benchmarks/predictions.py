"""Predictions one mission ahead by kind of world: the value of each component of the model.

    python benchmarks/predictions.py --data DIR --out out/predictions

Missions of the default campaign are driven in every world on every course; each method predicts
the rates of mission m + 1 on the path it took, given missions 1 to m. Methods: the default model;
`no memory`, the same with beta0 ~ Beta(1, 1000), 0 but for .001 (a point mass has no quantiles,
which the exact sampler needs); `no places`; and methods that predict rates without a state space,
see `Predictor`. Called again, it goes on where it stopped; worlds added later are added to it.
"""

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import numpyro.distributions as dist
import xarray as xr
from common import Table, add_record, arguments, parsed, read_records
from scipy import stats

from trustbo.campaign.campaign import Campaign
from trustbo.data import Cell, Mission, is_line_of_sight
from trustbo.inference import fit, score
from trustbo.inference.score import AMONG, summarize_scores
from trustbo.models import PlaceEffect, PooledTrust, Priors
from trustbo.models.backend import own_settings
from trustbo.study import worlds
from trustbo.study.world import COURSES, World
from trustbo.workspace import Workspace

NAMES = ("contact_rate", "mean", "pit", "log_score", "seen")


class Predictor(Protocol):
    """Method that predicts contact rates, made for a workspace."""

    def predict(
        self, missions: Sequence[Mission], path: Sequence[Cell]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean and sd of the rates of a path given missions, each (bound, robot)."""
        ...


class RunningMean:
    """Running mean of each bound and robot, line of sight as prior, by empirical Bayes.

    Residuals of line of sight are N(shift, sd^2) for each bound, plus noise of each mission; shift
    and both variances by moments.
    """

    def __init__(self, workspace: Workspace) -> None:
        """Take the workspace of the missions, filled in."""
        self._workspace = workspace

    def predict(
        self, missions: Sequence[Mission], path: Sequence[Cell]
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Predictor.predict`."""
        robots, features = missions[0].robots, missions[0].features
        shape = len(path) - 1, len(robots)
        nothing = np.full((*shape, len(features)), np.nan), np.full(shape, np.nan)
        ahead = Mission.from_arrays(path, *nothing, robots=robots, features=features)
        residuals = self._residuals(missions)
        every = np.concatenate([np.array(r) for r in residuals.values()])
        shift, total = every.mean(), max(every.var(), 1e-4)
        repeated = [np.var(r, ddof=1) for r in residuals.values() if len(r) > 1]
        noise = min(max(float(np.mean(repeated)) if repeated else 0.5 * total, 1e-4), total)
        spread = max(total - noise, 1e-4)
        mean = _sight(self._workspace.fill(ahead)) + shift
        var = np.full(shape, spread + noise)
        for k, bound in enumerate(_bounds(ahead)):
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
            for k, bound in enumerate(_bounds(mission)):
                for i in np.flatnonzero(~np.isnan(r[k])):
                    residuals.setdefault((*bound, int(i)), []).append(float(r[k, i]))
        return residuals


PREDICTORS: dict[str, Callable[[Workspace], Predictor]] = {"running mean": RunningMean}


def main():
    parser = arguments(
        __doc__, data=True, out="out/predictions", quick="two small worlds, one course, 4 missions"
    )
    parser.add_argument("--only", nargs="*", help="names of worlds; all by default")
    parser.add_argument("--courses", nargs="*", default=list(COURSES))
    parser.add_argument("-m", "--missions", type=int, default=15, help="missions, default 15")
    given = parsed(parser)
    chosen, file = _chosen(given), given.out / "scores.jsonl"
    courses, n = (given.courses[:1], 4) if given.quick else (given.courses, given.missions)
    done = {(r["world"], r["course"], r["n"]) for r in read_records(file)}
    for world in chosen:
        for course in courses:
            if (world.name, course, n) not in done:
                add_record(file, scored(world, course, n))
                print(f"{world.name}, {course}", flush=True)
    names = {world.name for world in chosen}
    show([r for r in read_records(file)
          if r["n"] == n and r["world"] in names and r["course"] in courses])  # fmt: skip


def scored(world: World, course: str, n: int) -> dict[str, Any]:
    """Scores of every method on the missions of one campaign, rate by rate."""
    workspace = world.workspace()
    campaign = Campaign(workspace, *world.ends(course), seed=0)
    driven = [mission for _, mission in campaign.run(world.simulator(workspace), n)]
    missions = [workspace.fill(mission) for mission in driven]
    methods = {name: _of_model(model, missions, workspace)
               for name, model in _models(missions[0].features).items()}  # fmt: skip
    (first, *_) = methods.values()
    for name, make in PREDICTORS.items():
        methods[name] = _of_predictor(make(workspace), missions, first)
    return {"world": world.name, "kind": world.kind, "course": course, "n": n,
            "methods": {name: _columns(scores) for name, scores in methods.items()}}  # fmt: skip


def show(records: Sequence[dict[str, Any]]) -> None:
    """Print a table for all worlds and one for each kind."""
    kinds = list(dict.fromkeys(r["kind"] for r in records))
    for title, members in [("all kinds", kinds), *((kind, [kind]) for kind in kinds)]:
        mine = [r for r in records if r["kind"] in members]
        print(f"\n{title}: {len({r['world'] for r in mine})} worlds, {len(mine)} campaigns\n")
        table = Table("method", "bounds", "rates", "within 50 %", "within 90 %",
                      "log score, nats", "R2", first=14)  # fmt: skip
        for name in mine[0]["methods"]:
            y, mean, pit, log_score, seen = (
                np.concatenate([np.array(r["methods"][name][column], float) for r in mine])
                for column in NAMES
            )
            for among in AMONG:
                kept = {"all": seen >= 0.0, "seen": seen == 1.0, "new": seen == 0.0}[among]
                one = summarize_scores(y[kept], mean[kept], pit[kept], log_score[kept])
                table.row(name, among, one["n"], f"{one['coverage_50']:.2f}",
                          f"{one['coverage_90']:.2f}", f"{one['mean_log_score']:.3f}",
                          f"{one['r2']:.3f}")  # fmt: skip


def _chosen(given: Any) -> list[World]:
    listed = worlds(given.data)
    if given.only:
        return [listed[name] for name in given.only]
    usable = [w for w in listed.values() if w.is_packaged or given.data is not None]
    if not given.quick:
        return usable
    made = {world.kind: world for world in reversed(usable) if world.is_made}
    return [replace(made[kind], name=f"{made[kind].name}-small", shape=(5, 5), side=200.0)
            for kind in ("right", "aged")]  # fmt: skip


def _models(features: Sequence[str]) -> dict[str, PooledTrust]:
    """Models by name, the default first."""
    with own_settings():
        none = replace(Priors.of(features), beta0=dist.Beta(1.0, 1000.0))
    return {
        "default": PooledTrust(place=PlaceEffect()),
        "no memory": PooledTrust(none, place=PlaceEffect()),
        "no places": PooledTrust(),
    }


def _of_model(model: PooledTrust, missions: Sequence[Mission], workspace: Workspace) -> xr.Dataset:
    """Scores of a model's posteriors after each mission; the last predicts nothing."""
    posteriors: list[xr.DataTree] = []
    for j in range(len(missions) - 1):
        posteriors.append(
            fit(missions[: j + 1], model, "exact", workspace=workspace, whole=False, check=False,
                earlier=posteriors[-1] if posteriors else None, progress=False)
        )  # fmt: skip
    return score(posteriors, missions)


def _of_predictor(
    predictor: Predictor, missions: Sequence[Mission], like: xr.Dataset
) -> xr.Dataset:
    """Scores of normal predictions, of rates as in the scores of a model."""
    scores = like.copy(deep=True)
    for j in scores["mission"].values:
        mission = missions[j]
        y, rows = (
            mission.contact_rate,
            {"mission": j, "bound": np.arange(1, len(mission.bounds) + 1)},
        )
        path = mission.path[: len(mission.bounds) + 1]
        mean, sd = predictor.predict(missions[:j], path)
        log_score = stats.norm.logpdf(y, mean, sd)
        if like.attrs["log_score_of"] == "ticks":
            log_score = log_score - np.log(mission.n_ticks)
        columns = {"mean": mean, "pit": stats.norm.cdf(y, mean, sd), "log_score": log_score}
        for name, values in columns.items():
            scores[name].loc[rows] = np.where(np.isnan(y), np.nan, values)
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


def _bounds(mission: Mission) -> Iterable[tuple[Any, Any]]:
    cells = [tuple(cell) for cell in mission.path[: len(mission.bounds) + 1]]
    return itertools.pairwise(cells)


if __name__ == "__main__":
    main()
