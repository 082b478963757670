"""Contact lost by the rule of posts and stops, under the simulators of all worlds.

    python benchmarks/posts.py --data DIR --out out/posts

For each world, course and rule, the first plan of the default campaign is driven 16 times, as
mission 7, when worlds that change have changed. Lost is the contact lost on it, in bounds; unseen
the share of the time in which nobody sees anybody. Saved is the contact that a rule saves of that
lost by the default posts and stops. Called again, it goes on where it stopped. Intervals are 95 %,
bootstrap over worlds.
"""

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from common import Table, arguments, parsed, records_of

from trustbo.campaign.campaign import Campaign
from trustbo.data import Mission
from trustbo.study import worlds
from trustbo.study.world import COURSES, World

RULES: dict[str, dict[str, Any]] = {
    "default": {},
    "posts": {"posts": "way"},
    "posts and stops": {"posts": "way", "stops": "sight"},
}
FIRST = "default"
N, MISSION = 16, 7


def main() -> None:
    """Drive what was not driven yet, and print the tables."""
    parser = arguments(__doc__, data=True, out="out/posts", quick="three worlds, one course")
    parser.add_argument("--only", nargs="*", help="names of worlds; all by default")
    parser.add_argument("--courses", nargs="*", default=list(COURSES))
    given = parsed(parser)
    usable = [w for w in worlds(given.data).values() if w.is_packaged or given.data is not None]
    courses = given.courses[:1] if given.quick else given.courses
    names = ("synthetic-0", "wellington", "wellington-aged") if given.quick else given.only
    chosen = [w for w in usable if not names or w.name in names]
    show(records_of(given.out / "posts.jsonl", chosen, courses, N, judged))


def judged(world: World, course: str, n: int) -> dict[str, Any]:
    """Means over missions on the first plan of each rule."""
    rules = {}
    for rule, options in RULES.items():
        workspace = world.workspace(**options)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of cells that have no room
            campaign = Campaign(
                workspace, *world.ends(course), connectivity=world.connectivity, seed=0
            )
        path = campaign.recommend().path
        missions = world.simulator(workspace).run_batch(path, range(n), mission=MISSION)
        rules[rule] = summed(missions)
    return {"world": world.name, "kind": world.kind, "course": course, "n": n, "rules": rules}


def summed(missions: Sequence[Mission]) -> dict[str, float]:
    """Contact lost (bounds), seconds, unseen share, of missions that arrived; share that did."""
    arrived = [m for m in missions if m.status == "ok"]
    if not arrived:
        return {"lost": np.nan, "duration": np.nan, "unseen": np.nan, "arrive": 0.0}
    lost = [sum(1.0 - float(b.contact_rate.mean()) for b in m.bounds) for m in arrived]
    duration = [sum(float(b.duration[0]) for b in m.bounds) for m in arrived]
    unseen = [1.0 - np.mean(np.concatenate([b.contact.any(1) for b in m.bounds])) for m in arrived]
    return {
        "lost": float(np.mean(lost)), "duration": float(np.mean(duration)),
        "unseen": float(np.mean(unseen)), "arrive": len(arrived) / len(missions),
    }  # fmt: skip


def show(records: Sequence[dict[str, Any]]) -> None:
    """Print a row for each rule, and the contact saved by kind of world and world by world."""
    names = [rule for rule in RULES if rule != FIRST]
    table = Table(
        "rule", "lost", "saved, %", "median world", "duration", "unseen", "arrive", first=16
    )
    for rule in RULES:
        saved = {w: _saved(some, rule) for w, some in _by(records, "world").items()}
        ratio = np.nanmedian(
            [_of(r, rule, "duration") / _of(r, FIRST, "duration") for r in records]
        )
        table.row(
            rule, f"{np.nanmean([_of(r, rule, 'lost') for r in records]):.3f}",
            _interval(records, rule), f"{np.nanmedian(list(saved.values())):.0f}", f"{ratio:.2f}",
            f"{np.nanmean([_of(r, rule, 'unseen') for r in records]):.4f}",
            f"{np.mean([_of(r, rule, 'arrive') for r in records]):.3f}",
        )  # fmt: skip
    print("\nSaved, %, by kind of world; and the arrivals\n")
    table = Table("kind", "worlds", *names, "arrive, default", *names, first=16)
    for kind, some in _by(records, "kind").items():
        table.row(
            kind, len(_by(some, "world")), *(_interval(some, rule) for rule in names),
            *(f"{np.mean([_of(r, rule, 'arrive') for r in some]):.3f}" for rule in RULES),
        )  # fmt: skip
    print("\nWorst worlds: contact lost, bounds\n")
    table = Table("world", *RULES, "saved, %", first=28)
    rule = names[-1]
    by_world = sorted(_by(records, "world").items(), key=lambda pair: _saved(pair[1], rule))
    for world, some in by_world[:8]:
        lost = [f"{np.nanmean([_of(r, name, 'lost') for r in some]):.3f}" for name in RULES]
        table.row(world, *lost, f"{_saved(some, rule):.0f}")


def _by(records: Sequence[dict[str, Any]], key: str) -> dict[str, list[dict[str, Any]]]:
    return {
        name: [r for r in records if r[key] == name]
        for name in dict.fromkeys(r[key] for r in records)
    }


def _of(record: dict[str, Any], rule: str, what: str) -> float:
    return record["rules"][rule][what]


def _saved(records: Sequence[dict[str, Any]], rule: str) -> float:
    """Contact saved of that lost by the default, in all courses, %."""
    lost = np.array([[_of(r, name, "lost") for name in (FIRST, rule)] for r in records])
    both = lost[np.isfinite(lost).all(1)].sum(0)
    return float(100.0 * (1.0 - both[1] / both[0]))


def _interval(records: Sequence[dict[str, Any]], rule: str) -> str:
    by_world = list(_by(records, "world").values())
    rng = np.random.default_rng(0)
    draws = [
        _saved(
            [r for i in rng.integers(len(by_world), size=len(by_world)) for r in by_world[i]], rule
        )
        for _ in range(500)
    ]
    low, high = np.percentile(draws, [2.5, 97.5])
    return f"{_saved(records, rule):.0f} [{low:.0f}, {high:.0f}]"


if __name__ == "__main__":
    main()
