"""Verdict on robots from their effects in missions: which robot, and since when.

An effect d of a robot in a mission is a share of its line of sight (`RobotEffect`): an alarm is its
size, P(|d| > .1) > .95 on one side, not a p-value. A robot is named in all missions, from one on,
or on single days.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.display.card import joined

SIZE = 0.1  # effect from which on a plan may change, in units of stationary trust
SURE = 0.95
_MOST = 0.6  # share of missions from the first that stands out on
_BEFORE = 2  # missions before a start


def effects_of_robots(posterior: xr.DataTree) -> pd.DataFrame:
    """Row of each mission and robot: effect, sd, p_worse, p_better and whether it `stands_out`.

    Empty where the model has no effects of robots.
    """
    head = ["mission", "robot", "effect", "sd", "p_worse", "p_better", "stands_out"]
    if "robots" not in posterior.children:
        return pd.DataFrame(columns=head)
    d = posterior["robots"]["robot_effect"].transpose("chain", "draw", "mission", "robot")
    draws = d.values.reshape(-1, *d.shape[2:])
    mission, robot = np.indices(d.shape[2:]).reshape(2, -1)
    columns = draws.mean(0), draws.std(0), (draws < -SIZE).mean(0), (draws > SIZE).mean(0)
    table = pd.DataFrame(dict(zip(head[2:6], (c.ravel() for c in columns), strict=True)))
    table.insert(0, "robot", d["robot"].values[robot])
    table.insert(0, "mission", d["mission"].values[mission])
    table["stands_out"] = table[["p_worse", "p_better"]].max(axis=1) > SURE
    return table


def finding_on_robots(table: pd.DataFrame) -> tuple[str, float, str]:
    """Robot that stands out most, its largest effect, and a sentence on all that do."""
    chosen = table[table["stands_out"]]
    if chosen.empty:
        return "", float("nan"), "no robot stands out in a mission."
    effects: dict[str, np.ndarray] = {
        str(name): np.asarray(rows["effect"]) for name, rows in chosen.groupby("robot")
    }
    robots, stands_out = np.asarray(table["robot"]), np.asarray(table["stands_out"], dtype=bool)
    missions = np.asarray(table["mission"])
    names = sorted(effects, key=lambda name: -np.abs(effects[name]).sum())
    sentences = []
    for name in names:
        here = robots == name
        mean = float(effects[name].mean())
        size = f"{abs(mean):.2f} {'less' if mean < 0.0 else 'more'} contact in full sight"
        when = _when(missions[here & stands_out].tolist(), missions[here].tolist())
        sentences.append(f"{name} has {size} than the team's line of sight says, {when}")
    first = effects[names[0]]
    return names[0], float(first[np.abs(first).argmax()]), f"{'; '.join(sentences)}."


def _when(these: Sequence[int], missions: Sequence[int]) -> str:
    """Time of some of a robot's missions, counted from 0.

    Some missions show too little to stand out: three, and most of those from the first on, the last
    among them, are enough. Two are, where they are all.
    """
    left = [j for j in missions if j >= these[0]]
    most = len(these) > 2 and len(these) >= _MOST * len(left) and these[-1] == left[-1]
    if most or (len(these) > 1 and len(these) == len(left)):
        early = len(missions) - len(left) < _BEFORE
        return "in all missions" if early else f"from mission {these[0]} on"
    return f"in mission{'s' if len(these) > 1 else ''} {joined([str(j) for j in these])}"
