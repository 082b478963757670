"""Contact lost and time unseen on first plans, under the simulators of worlds.

    python benchmarks/posts.py --data DIR --out out/posts

Plans are driven 16 times, as mission 7, when worlds that change have changed. Lost is the contact
lost, in bounds; unseen the share of the time in which nobody sees anybody. Called again, it goes
on where it stopped.

`cover`: by `unseen_cost`, of the first plan and of that after eight missions of the default
campaign, in the worlds of wellington; with the share unseen by the map, which is paid.

`robots`: contact lost of robots that differ (r1 has its lidar on a mast of 3 m, r3 one that finds
60 % within 40 m), given to the posts of the path by the plan, or not; 95 % intervals.
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from common import Table, arguments, parsed, records_of

from trustbo import iterate
from trustbo.campaign.campaign import Campaign
from trustbo.data import Cell, Mission
from trustbo.inference import params_of
from trustbo.study import worlds
from trustbo.study.world import COURSES, World
from trustbo.team import Robot, Team
from trustbo.workspace.moves import bounds_along

N, MISSION = 16, 7
PARTS = "cover", "robots"
UNLIKE = Team(robots=(Robot(sensor_height=3.0), Robot(), Robot(detection=0.6, lidar_range=40.0)))
KINDS = "right", "aged"
COSTS = 0.0, 1.0, 3.0, 10.0
PLACE = "wellington"


def main() -> None:
    """Drive what was not driven yet, and print the tables."""
    parser = arguments(
        __doc__, data=True, names=PARTS, out="out/posts", quick="three worlds, one course"
    )
    parser.add_argument("--only", nargs="*", help="names of worlds; all by default")
    parser.add_argument("--courses", nargs="*", default=list(COURSES))
    given = parsed(parser)
    usable = [w for w in worlds(given.data).values() if w.is_packaged or given.data is not None]
    courses = given.courses[:1] if given.quick else given.courses
    names = ("synthetic-0", "wellington", "wellington-aged") if given.quick else given.only
    chosen = [w for w in usable if not names or w.name in names]
    if "cover" in given.names:
        here = [w for w in chosen if w.name.startswith(PLACE)]
        show_cover(records_of(given.out / "cover.jsonl", here, courses, N, covered))
    if "robots" in given.names:
        show_robots([w for w in chosen if w.kind in KINDS], courses)


def covered(world: World, course: str, n: int) -> dict[str, Any]:
    """Means over missions on the first plan, and on that after eight, by cost of time unseen."""
    workspace, driven_on, by_cost = world.workspace(), {}, {}
    simulator, ends = world.simulator(workspace), world.ends(course)
    options: dict[str, Any] = {"connectivity": world.connectivity, "seed": 0}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of safest plans, and bounds avoided
        result = iterate(
            workspace, *ends, simulator=simulator, n_iterations=MISSION + 1, progress=False,
            **options,
        )  # fmt: skip
        for cost in COSTS:
            first = Campaign(workspace, *ends, unseen_cost=cost, **options).recommend()
            learned = replace(result, settings=result.settings | {"unseen_cost": cost}).planner
            last = learned.plan(params_of(result.posterior).mean())
            for stage, plan in (("first plan", first), ("after 8 missions", last)):
                if plan.path not in driven_on:
                    driven_on[plan.path] = summed(driven(simulator, plan.path, n))
                shares = workspace.unseen_bounds.values[tuple(bounds_along(plan.path).T)]
                known = {"map": float(shares.mean()), "bounds": len(shares), "path": plan.path}
                by_cost[f"{stage}, {cost:g}"] = driven_on[plan.path] | known
    return {"world": world.name, "kind": world.kind, "course": course, "n": n, "rules": by_cost}


def show_cover(records: Sequence[dict[str, Any]]) -> None:
    """Print a row for each cost of the time unseen, of first plans and of those that learned."""
    print("\nBy the cost of a bound in which nobody sees anybody\n")
    table = Table(
        "unseen_cost", "unseen, %", "contact lost, bounds", "by the map, %", "bounds", "duration",
        "arrive", "paths changed", first=22,
    )  # fmt: skip
    for rule in records[0]["rules"]:
        free = f"{rule.split(', ')[0]}, 0"
        mean = {
            what: np.nanmean([_of(r, rule, what) for r in records])
            for what in ("unseen", "lost", "map", "bounds", "arrive")
        }
        longer = [_of(r, rule, "duration") / _of(r, free, "duration") for r in records]
        changed = np.mean([_of(r, rule, "path") != _of(r, free, "path") for r in records])
        table.row(
            rule, f"{100.0 * mean['unseen']:.2f}", f"{mean['lost']:.3f}",
            f"{100.0 * mean['map']:.2f}", f"{mean['bounds']:.2f}", f"{np.nanmean(longer):.2f}",
            f"{mean['arrive']:.3f}", f"{changed:.0%}",
        )  # fmt: skip


def show_robots(chosen: Sequence[World], courses: Sequence[str]) -> None:
    """Print a row for each world: contact lost by robots that differ, assigned or not."""
    print(
        "\nRobots that differ: contact lost, bounds; ends of the 95 % interval of what is saved\n"
    )
    table = Table("world", "by rule", "assigned", "saved, %", first=28)
    for world in chosen:
        lost = np.array([_lost_by_unlike(world, course) for course in courses]).mean(0)
        drawn = np.random.default_rng(0).choice(lost, (4000, len(lost))).mean(1)
        low, high = np.quantile(100.0 * (1.0 - drawn[:, 1] / drawn[:, 0]), (0.025, 0.975))
        rule, own = lost.mean(0)
        text = f"{100.0 * (1.0 - own / rule):.1f} [{low:.1f}, {high:.1f}]"
        table.row(world.name, f"{rule:.3f}", f"{own:.3f}", text)


def _lost_by_unlike(world: World, course: str) -> np.ndarray:
    """Contact lost of each mission on the first plan, (mission, (by rule, assigned))."""
    world = replace(world, team=UNLIKE, assumed_team=None)
    workspace = world.workspace()
    campaign = Campaign(workspace, *world.ends(course), connectivity=world.connectivity, seed=0)
    plan, simulator = campaign.recommend(), world.simulator(workspace)
    runs = [simulator.run_batch(way, range(N), mission=MISSION) for way in (plan.path, plan)]
    return np.array([
        [sum(1.0 - float(b.contact_rate.mean()) for b in m.bounds) for m in pair]
        for pair in zip(*runs, strict=True)
    ])  # fmt: skip


def driven(simulator: Any, path: Sequence[Cell], n: int) -> list[Mission]:
    """Missions over a path; one by one where the simulator has no `run_batch`."""
    if hasattr(simulator, "run_batch"):
        return list(simulator.run_batch(path, range(n), mission=MISSION))
    return [simulator.run(path, seed=seed) for seed in range(n)]


def summed(missions: Sequence[Mission]) -> dict[str, float]:
    """Contact lost (bounds), seconds, unseen share, of missions that arrived; share that did."""
    arrived = [m for m in missions if m.status == "ok"]
    if not arrived:
        return {"lost": np.nan, "duration": np.nan, "unseen": np.nan, "arrive": 0.0}
    lost = [sum(1.0 - float(b.contact_rate.mean()) for b in m.bounds) for m in arrived]
    duration = [sum(float(b.duration[0]) for b in m.bounds) for m in arrived]
    unseen = [
        1.0 - np.mean(np.concatenate([b.contact.any(1) for b in m.bounds]))
        for m in arrived
        if all(b.contact is not None for b in m.bounds)
    ] or [np.nan]  # no lidar, no ticks
    return {
        "lost": float(np.mean(lost)), "duration": float(np.mean(duration)),
        "unseen": float(np.mean(unseen)), "arrive": len(arrived) / len(missions),
    }  # fmt: skip


def _of(record: dict[str, Any], rule: str, what: str) -> float:
    return record["rules"][rule][what]


if __name__ == "__main__":
    main()
