"""Compare what a campaign says before and after a few missions with the truth of worlds.

    python benchmarks/first_plan.py [band] [width] [regret] [--data DIR] [--set] [--out DIR]

- band: coverage of the 90 % band of the first plan's value, before any mission, by kind of world.
- width: width of this band on the example hillside, with narrower priors and without effects.
- regret: coverage of `tb.RegretBound(eps=0.05, delta=0.1)` in campaigns of 15 missions. The table
  shows how often the rule stops a campaign, and how often the true regret of the recommended path
  is then at most 5 %.

Worlds and courses are those of `benchmarks/worlds.py`. Truths and finished campaigns are kept in
--out.
"""

import json
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpyro.distributions as dist
from common import Table, arguments, parsed
from world_set import COURSES, worlds
from worlds import SET, SET_COURSES

import trustbo as tb
from trustbo.models import PlaceEffect, PooledTrust, Priors, RobotEffect

MAX_BOUNDS = "shortest+4"
MISSIONS = 15
SCALES = (1.0, 0.5, 0.1)
"""Factors of the prior standard deviations in `width`."""


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


def band(scenes: dict[str, Any], given: Any) -> None:
    """Print how often the band of the first plan contains the true value, by kind of world."""
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


def width(scenes: dict[str, Any], given: Any) -> None:
    """Print the width of the first plan's band for several priors and effects."""
    workspace = tb.Workspace.from_terrain(tb.terrain.example(), (10, 10), tb.Team())
    priors = Priors.from_features(workspace.features)
    every = (PlaceEffect(), RobotEffect())
    effects_of = {
        "places and robots": every,
        "places": every[:1],
        "robots": every[1:],
        "none": (),
    }

    table = Table("effects", *(f"width, sds of weights x {scale:g}" for scale in SCALES))
    for name, effects in effects_of.items():
        widths = []
        for scale in SCALES:
            model = PooledTrust(scaled(priors, scale), effects=effects)
            low, high = tb.Campaign(workspace, (9, 0), (0, 9), model=model).ask().value_band
            widths.append(f"{high - low:.1f}")
        table.row(name, *widths)


def scaled(priors: Priors, scale: float) -> Priors:
    """Multiply the prior standard deviations of the weights and of the intercept by a factor."""
    normals = {
        name: dist.Normal(getattr(priors, name).loc, scale * getattr(priors, name).scale)
        for name in ("beta", "b")
    }
    return replace(priors, **normals)


def regret(scenes: dict[str, Any], given: Any) -> None:
    """Print how often `RegretBound` stops, and the true regret of what is then recommended.

    Each campaign has a file in --out, so the script can be resumed. The order of the campaigns is
    random, so those of a run that was interrupted are a random sample (`--finished`).
    """
    folder = given.out / "regret"
    folder.mkdir(parents=True, exist_ok=True)
    names = list(scenes)
    rows = []
    for k in np.random.default_rng(0).permutation(len(names)):
        file = folder / f"{'~'.join(names[k])}.json"
        if not file.exists():
            if given.finished:
                continue
            file.write_text(json.dumps(stopped_campaign(scenes[names[k]]())) + "\n")
        rows.append({"kind": names[k][0], **json.loads(file.read_text())})

    table = Table(
        "kind", "courses", "stopped", "true regret <= 5 %", "median regret, %", "mean missions"
    )
    for kind in [*dict.fromkeys(name[0] for name in names), "all"]:
        chosen = [row for row in rows if kind in (row["kind"], "all")]
        if chosen:
            table.row(kind, *figures_of(chosen))


def stopped_campaign(scene: Any) -> dict[str, Any]:
    """Run a campaign until the rule stops it, and compute the true regret."""
    rule = tb.RegretBound(eps=0.05, delta=0.1)
    campaign = campaign_of(scene)
    for _ in campaign.run(scene.simulator, MISSIONS, stop=rule):
        pass

    n = len(campaign.missions)
    return {
        "stopped": (campaign.state.stop_reason or "").startswith("regret_bound"),
        "missions": n,
        "regret": scene.truth.at(n).regret(campaign.path, MAX_BOUNDS),
    }


def figures_of(rows: list[dict[str, Any]]) -> list[str]:
    """Format the figures of some campaigns; regrets are those of campaigns that were stopped."""
    stopped = [row for row in rows if row["stopped"]]
    if not stopped:
        return [str(len(rows)), "0", "-", "-", "-"]

    regrets = np.array([row["regret"] for row in stopped])
    missions = np.mean([row["missions"] for row in stopped])
    return [
        str(len(rows)),
        str(len(stopped)),
        f"{np.mean(regrets <= 5.0):.2f}",
        f"{np.median(regrets):.2f}",
        f"{missions:.1f}",
    ]


PARTS = {"band": band, "width": width, "regret": regret}

if __name__ == "__main__":
    parser = arguments(__doc__, names=PARTS, data=True, out="out/first_plan")
    parser.add_argument("--set", action="store_true", help="smaller set: 17 worlds x 2 courses")
    parser.add_argument("--finished", action="store_true", help="print only finished campaigns")
    given = parsed(parser)
    scenes = scenes_of(given)
    for name in given.names:
        print(name, flush=True)
        PARTS[name](scenes, given)
