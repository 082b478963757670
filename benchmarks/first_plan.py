"""Compare what a campaign says before and after a few missions with the truth of worlds.

    python benchmarks/first_plan.py [band] [regret] [--data DIR] [--set] [--out DIR]

- band: coverage of the 90 % band of the first plan's value, before any mission, by kind of world.
- regret: coverage of `tb.RegretBound(eps=0.05, delta=0.1)` in campaigns of 15 missions. The table
  shows how often the rule stops a campaign, and how often the true regret of the recommended path
  is then at most 5 %.

Worlds and courses are those of `benchmarks/worlds.py`. Truths are kept in --out.
"""

from functools import partial
from typing import Any

import numpy as np
from common import Table, arguments, parsed
from worlds import SET, SET_COURSES

import trustbo as tb
from trustbo.study import worlds
from trustbo.study.world import COURSES

MAX_BOUNDS = "shortest+4"
MISSIONS = 15


def scenes_of(given: Any) -> dict[str, Any]:
    """Return the scenes by (kind, world, course)."""
    courses = SET_COURSES if given.set else COURSES[: len(SET_COURSES)]
    return {
        (world.kind, world.name, course): partial(
            world.scene, course, given.out / "truths", MAX_BOUNDS
        )
        for world in worlds(given.data).values()
        if (given.data or world.is_packaged) and (not given.set or world.name in SET)
        for course in courses
    }


def campaign_of(scene: Any) -> tb.Campaign:
    return tb.Campaign(scene.workspace, scene.start, scene.goal, **scene.options)


def band(scenes: dict[str, Any]) -> None:
    found: dict[str, list[tuple[float, float, float, float]]] = {}
    for (kind, _, _), make in scenes.items():
        scene = make()
        plan = campaign_of(scene).ask()
        low, high = plan.value_band
        lost = -scene.truth.at(0).lost(plan.path)
        found.setdefault(kind, []).append((low <= lost <= high, high - low, plan.value, lost))

    table = Table("kind", "courses", "band covers the truth", "width", "predicted", "true")
    for kind, rows in found.items():
        of_kind = np.array(rows)
        table.row(kind, len(rows), *(f"{x:.2f}" for x in of_kind.mean(0)))
    every = np.array([row for rows in found.values() for row in rows])
    table.row("all", len(every), *(f"{x:.2f}" for x in every.mean(0)))


def regret(scenes: dict[str, Any]) -> None:
    rule = tb.RegretBound(eps=0.05, delta=0.1)
    stopped = []
    for make in scenes.values():
        scene = make()
        campaign = campaign_of(scene)
        for _ in campaign.run(scene.simulator, MISSIONS, stop=rule):
            pass
        if not campaign.state.stop_reason.startswith("regret_bound"):
            stopped.append((False, np.nan, np.nan))
            continue
        n = len(campaign.missions)
        truth = scene.truth.at(n)
        stopped.append((True, truth.regret(campaign.path, MAX_BOUNDS), n))

    every = np.array(stopped, dtype=float)
    some = every[every[:, 0] == 1.0]
    table = Table("courses", "stopped", "true regret <= 5 %", "median regret, %", "mean missions")
    table.row(
        len(every),
        len(some),
        f"{np.mean(some[:, 1] <= 5.0):.2f}" if len(some) else "-",
        f"{np.median(some[:, 1]):.2f}" if len(some) else "-",
        f"{some[:, 2].mean():.1f}" if len(some) else "-",
    )


PARTS = {"band": band, "regret": regret}

if __name__ == "__main__":
    parser = arguments(__doc__, names=PARTS, data=True, out="out/first_plan")
    parser.add_argument("--set", action="store_true", help="smaller set: 17 worlds x 2 courses")
    given = parsed(parser)
    scenes = scenes_of(given)
    for name in given.names:
        print(name, flush=True)
        PARTS[name](scenes)
