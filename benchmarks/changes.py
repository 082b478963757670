"""Changes of worlds: how soon they are named, and how often one is named where there is none.

    python benchmarks/changes.py --data DIR --out out/changes

The default campaign drives 15 missions in worlds that change with the seventh, and in worlds that
do not. After each mission are asked

- `tb.inference.changes`: an alarm is a change more probable than not, of a robot or of an area, by
  a tenth of contact or more;
- the effect of each robot in the mission just driven: a robot is named if it is below -.1 (a tenth
  of contact, where it sees all) with a probability of .95.

A mission meets a change if it takes .1 bounds of contact or more from the path driven, or adds as
much, by the truth of the world before and after. Called again, it goes on where it stopped.
Intervals are 95 % (Wilson), over campaigns or, of false alarms, missions.
"""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from common import Table, arguments, parsed, records_of
from scipy.stats import binomtest

import trustbo as tb
from trustbo.campaign.campaign import Campaign
from trustbo.study import worlds
from trustbo.study.world import COURSES, World

CASES = ("dead-detector", "half-detector", "felled", "grown", "jammer-appears", "jammer-lifted")
STILL = ("right", "aged")
FIRST = 6
"""First mission of the changed world, from 0."""
PROBABLE, SURE, SMALL, MET = 0.5, 0.95, -0.1, 0.1


def main() -> None:
    """Drive what was not driven yet, and print the tables."""
    parser = arguments(__doc__, data=True, out="out/changes", quick="two worlds, 8 missions")
    parser.add_argument("--only", nargs="*", help="names of worlds; all by default")
    parser.add_argument("--courses", nargs="*", default=list(COURSES))
    parser.add_argument("-m", "--missions", type=int, default=15, help="missions, default 15")
    given = parsed(parser)
    usable = [w for w in worlds(given.data).values() if w.is_packaged or given.data is not None]
    chosen = [w for w in usable if w.case in CASES or w.kind in STILL]
    courses, n = given.courses, given.missions
    if given.quick:
        made = [w for w in chosen if w.is_made]
        chosen = [w for w in made if w.name in ("synthetic-0", "synthetic-birch-half-detector")]
        courses, n = courses[:1], 8
    if given.only:
        chosen = [w for w in chosen if w.name in given.only]
    file = given.out / "changes.jsonl"
    show(records_of(file, chosen, courses, n, driven))


def driven(world: World, course: str, n: int) -> dict[str, Any]:
    """What is found after each mission of one campaign, and what the change took from its path."""
    workspace, truth = world.workspace(), world.truth()
    campaign = Campaign(workspace, *world.ends(course), seed=0)
    named = next((e.robot for e in world.true_events() if hasattr(e, "robot")), None)
    missions: list[dict[str, Any]] = []
    for _, mission in campaign.run(world.simulator(workspace), n):
        before, after = (truth.at(m).value(mission.path).lost for m in (0, n - 1))
        started = time.process_time()
        probability = _by_kind(campaign)
        missions.append({
            "met": after - before, "seconds": time.process_time() - started, **probability,
            "robots": _poor(campaign),
        })  # fmt: skip
    return {"world": world.name, "kind": world.kind, "case": world.case, "course": course, "n": n,
            "robot": named, "missions": missions}  # fmt: skip


def _by_kind(campaign: Campaign) -> dict[str, float]:
    """Probability of a change of each kind, by a tenth of contact or more."""
    tree = campaign.posteriors[-1]
    numbers = np.atleast_1d(tree.attrs["missions"]).astype(int)
    learned = [campaign.missions[j] for j in numbers]
    table = tb.inference.changes(tree, learned, campaign.workspace)
    found = table[table["effect"].abs() > -SMALL].groupby("kind")["probability"].sum()
    return {kind: float(found.get(kind, 0.0)) for kind in ("all", "robot", "area")}


def _poor(campaign: Campaign) -> list[str]:
    """Robots that are named in the last mission."""
    effect = campaign.posteriors[-1]["robots"]["robot_effect"].isel(mission=-1)
    share = (effect < SMALL).mean(("chain", "draw")).values
    return [name for name, p in zip(campaign.workspace.team.names, share, strict=True) if p > SURE]


def show(records: Sequence[dict[str, Any]]) -> None:
    """Print what was named, and the false alarms."""
    print("\n**Robots**: named in the mission, of the missions of the changed world\n")
    table = Table("case", "campaigns", "in its first mission", "in all missions", "another robot")
    for case in ("dead-detector", "half-detector"):
        some = [r for r in records if r["case"] == case]
        if not some:
            continue
        right = [[r["robot"] in m["robots"] for m in r["missions"][FIRST:]] for r in some]
        others = [bool(set(m["robots"]) - {r["robot"]}) for r in some for m in r["missions"]]
        table.row(case, len(some), _share([one[0] for one in right]),
                  _share([m for one in right for m in one]), _share(others))  # fmt: skip
    print("\n**Areas**: an alarm within so many missions that meet the change\n")
    table = Table("case", "campaigns that met it", "2", "3", "4", "ever")
    for case in CASES[2:]:
        waits = [_wait(r) for r in records if r["case"] == case]
        met = [wait for wait in waits if wait is not None]
        if met:
            table.row(case, f"{len(met)} of {len(waits)}",
                      *(_share([wait <= k for wait in met]) for k in (2, 3, 4, 99)))  # fmt: skip
    print("\n**False alarms**, of missions before any change\n")
    table = Table("missions", "all robots", "a robot", "an area", "any", "a robot's mission")
    still = [m for r in records for m in r["missions"][: FIRST if r["case"] in CASES else None]
             if r["case"] != "jammer-lifted"]  # fmt: skip
    if still:
        kinds = ("all", "robot", "area")
        table.row(
            len(still),
            *(_share([m[kind] > PROBABLE for m in still]) for kind in kinds),
            _share([sum(m[kind] for kind in kinds) > PROBABLE for m in still]),
            _share([bool(m["robots"]) for m in still]),
        )
    seconds = [r["missions"][-1]["seconds"] for r in records]
    print(f"\nA scan after {records[0]['n']} missions: {np.median(seconds):.2f} processor seconds.")


def _wait(record: dict[str, Any]) -> float | None:
    """Missions that met a change up to the alarm; None where none met it, infinite without one."""
    changed = record["missions"][FIRST:]
    met = np.cumsum([abs(m["met"]) >= MET for m in changed])
    if not met[-1]:
        return None
    alarms = [k for k, m in enumerate(changed) if m["area"] > PROBABLE]
    return float(met[alarms[0]]) if alarms else np.inf


def _share(found: Sequence[bool]) -> str:
    """Share, its interval and the number."""
    k, n = int(np.sum(found)), len(found)
    low, high = binomtest(k, n).proportion_ci(method="wilson")
    return f"{k / n:.3f} [{low:.3f}, {high:.3f}] of {n}"


if __name__ == "__main__":
    main()
