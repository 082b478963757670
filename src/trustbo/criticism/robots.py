"""Findings on robots: which one, and in which missions.

They are read from a model with effects of places and robots (`RobotEffect`), fitted here where the
posterior is of another. A finding is a size in contact, never a p-value: a robot stands out in a
mission where P(|d| > .1) > .95 on one side, d its effect, a share of line of sight, less the median
of all.
"""

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.criticism.departures import Departure
from trustbo.criticism.joint_normal import Data
from trustbo.data import Mission
from trustbo.display import joined
from trustbo.inference.fit import fit
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.effects.robot import RobotEffect
from trustbo.models.families import FAMILIES
from trustbo.models.place import has_places
from trustbo.models.pooled import PooledTrust

SIZE = 0.1  # effect from which on a plan may change, in units of stationary trust
SURE = 0.95

Finding = tuple[tuple[str, float, str], Departure | None]
"""Label, effect and sentence, and the departure; without a fault "" and None."""


def with_robots(posterior: xr.DataTree, missions: Sequence[Mission]) -> xr.DataTree:
    """Return a posterior with effects of robots: the given one if it has them.

    Of its family of observations, or of Gaussian rates where the sampler would take minutes.
    """
    if "robots" in posterior.children:
        return posterior
    record = posterior.attrs.get("place", "none")
    place = PlaceEffect() if record == "none" else PlaceEffect(**json.loads(record))
    if not has_places(missions):
        place = None
    seed = int(posterior.attrs["seed"])
    model = PooledTrust(
        effects=(RobotEffect(),), place=place,
        observation=posterior.attrs["observation"],
    )  # fmt: skip
    if model.why_not_exact:
        model = replace(model, observation="gaussian", priors=None)
    return fit(missions, model, seed=seed, draws=250, check=False, whole=False)


def effects_of_robots(posterior: xr.DataTree) -> pd.DataFrame:
    """Row of each mission and robot: effect, sd, p_worse, p_better and whether it `stands_out`.

    Effects are in contact, less their median over all rows, as the weight of line of sight fits
    their level.
    """
    d = posterior["robots"]["robot_effect"].transpose("chain", "draw", "mission", "robot")
    draws = d.values.reshape(-1, *d.shape[2:])
    draws = draws - np.median(draws, axis=(1, 2), keepdims=True)
    draws = draws / FAMILIES[posterior.attrs["observation"]].line_of_sight[0]
    mission, robot = np.indices(d.shape[2:]).reshape(2, -1)
    where = {"mission": d["mission"].values[mission], "robot": d["robot"].values[robot]}
    head = ["effect", "sd", "p_worse", "p_better"]
    columns = draws.mean(0), draws.std(0), (draws < -SIZE).mean(0), (draws > SIZE).mean(0)
    table = pd.DataFrame(where | dict(zip(head, (c.ravel() for c in columns), strict=True)))
    return table.assign(stands_out=table[["p_worse", "p_better"]].max(axis=1) > SURE)


def finding_on_robots(table: pd.DataFrame, data: Data) -> Finding:
    """Find the robots that stand out most; the sentence is on all that do."""
    n = data.n_robots
    names, missions = table["robot"].to_numpy()[:n], table["mission"].to_numpy()[::n]
    effect, worse, better, stands_out = (
        table[name].to_numpy().reshape(-1, n)
        for name in ("effect", "p_worse", "p_better", "stands_out")
    )
    alike: dict[tuple[str, str], list[int]] = {}
    for i in np.flatnonzero(stands_out.any(0)).tolist():
        less = effect[stands_out[:, i], i].mean() < 0.0
        when = _when(missions, stands_out[:, i], (worse if less else better)[:, i])
        alike.setdefault(("less" if less else "more", when), []).append(i)
    if not alike:
        return ("", float(np.abs(effect).max()), "no robot stands out in a mission."), None
    size, labels, sentences = np.abs(effect) * stands_out, [], []
    for key in sorted(alike, key=lambda key: -size[:, alike[key]].sum()):
        some, (side, when) = alike[key], key
        label = "all robots" if len(some) == n > 1 else joined([str(names[i]) for i in some])
        mean = size[:, some].sum() / stands_out[:, some].sum()
        have = "has" if len(some) == 1 else "have"
        labels.append(label)
        sentences.append(f"{label} {have} {mean:.2f} {side} contact in full sight, {when}")
    first = alike[min(alike, key=lambda key: -size[:, alike[key]].sum())]
    most = effect[:, first].flat[size[:, first].argmax()]
    mission, _, robot = data.slots.T
    odd = (stands_out[mission, robot] * data.line_of_sight)[:, None] * (robot[:, None] == range(n))
    sentence = f"{'; '.join(sentences)}, than the team has most often."
    return (labels[0], float(most), sentence), Departure("robot", {labels[0]: odd})


def _when(missions: np.ndarray, stands_out: np.ndarray, p: np.ndarray) -> str:
    """Text of the missions, counted from 0, in which a robot stands out.

    In all, if it is more probable than not in each; from one on, if it is since, and all since
    stand out, two at least, or three do. Others are days.
    """
    healthy = np.flatnonzero(p <= 0.5)
    start = healthy[-1] + 1 if len(healthy) else 0
    if start == 0:
        return "in all missions"
    if stands_out[start:].sum() < min(max(len(p) - start, 2), 3):
        start = len(p)
    days = [str(j) for j in missions[:start][stands_out[:start]]]
    words = [f"in mission{'s' if len(days) > 1 else ''} {joined(days)}"] if days else []
    if start < len(p):
        words.append(f"from mission {missions[start:][stands_out[start:]][0]} on")
    return joined(words)
