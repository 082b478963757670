"""Contact lost in the first missions after a jammer appears on the path of a campaign.

    python benchmarks/threats.py --data DIR [--quick] [--csv FILE]

A campaign learns for six missions. Then a jammer appears at the middle of its path, and six more
missions are run, of which the first one cannot know it. The methods differ in how they go on:

- place effects: the campaign goes on; it learns effects of places, as without threats.
- contact: after each mission, the place of the threat is inferred from contact alone.
- sightings: the same, and in each mission with the jammer, a robot reports its place, with an error
  of 20 m in each direction.

Missions have the same seeds in all methods. If a new campaign cannot learn from the missions so
far, because its fit is refused, the last one goes on. The contact lost is in bounds per mission.
Intervals are those of a t test clustered by terrain. The column "before" is the probability of a
threat that is inferred before there is one.
"""

import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from common import Table, arguments, parsed
from groups import interval, over_worlds
from world_set import World, available

import trustbo as tb
from trustbo.study import lost_in

METHODS = ("place effects", "contact", "sightings")
BEFORE = 6
"""Number of missions before the jammer appears."""
AFTER = 6
SIGHTED = 20.0
"""Standard deviation of a sighting in each direction, m."""
RADIUS = 0.15
"""Radius of the jammer as a share of the terrain's shorter side."""
STRENGTH = 0.8


def main() -> None:
    parser = arguments(__doc__ or "", data=True, quick="two worlds")
    parser.add_argument("--course", action="append", help="default sw-ne and nw-se")
    parser.add_argument("--csv", type=Path, help="CSV file for the rows")
    given = parsed(parser)

    known = available(given.data).values()
    every = [w for w in known if w.kind in ("right", "aged") and not w.radio]
    rows = []
    for world in every[:2] if given.quick else every:
        for course in given.course or ("sw-ne", "nw-se"):
            rows += rows_of(world, course)
            print(f"{world.name}, {course}", file=sys.stderr, flush=True)
            if given.csv is not None:
                given.csv.parent.mkdir(parents=True, exist_ok=True)
                pd.DataFrame(rows).round(5).to_csv(given.csv, index=False)
    report(pd.DataFrame(rows))


def rows_of(world: World, course: str) -> list[dict[str, object]]:
    """Return a row for each method and each mission with the jammer."""
    plain = world.campaign_workspace()
    workspace = plain.with_threat()
    ends = world.ends(course)

    usual = world.simulator(workspace)
    first = tb.Campaign(workspace, *ends, seed=4)
    for _ in first.run(usual, BEFORE):
        pass
    known = tb.planning.threat_map(first.missions, first.posterior, workspace)
    before = float(known["probability"].sum())
    path = first.recommend().path
    center = workspace.grid.center(path[len(path) // 2][:2])
    size = workspace.grid.shape * np.array([workspace.grid.cell_height, workspace.grid.cell_width])
    jam = tb.simulation.Jam(center, RADIUS * float(size.min()), STRENGTH)

    rows = []
    for method in METHODS:
        rng = np.random.default_rng(0)
        here, campaign = workspace, again(first, workspace, ends)
        done = [*first.missions]
        for k in range(AFTER):
            simulator = world.simulator(here)
            simulator = tb.simulation.KinematicSimulator(
                here,
                terrain=simulator.terrain,
                sight=simulator.sight,
                team=simulator.team,
                events=[*simulator.events, jam],
            )
            mission = simulator.run(campaign.ask().stations, seed=100 + k, mission=BEFORE + k)
            if method == "sightings":
                x, y = np.array(center) + SIGHTED * rng.standard_normal(2)
                sighting = tb.Sighting(float(x), float(y), SIGHTED)
                mission = replace(mission, sightings=(sighting,))
            campaign.tell(mission)
            done.append(mission)
            row = {"world": world.name, "course": course, "method": method, "mission": k}
            rows.append(row | {"lost": lost_in(mission), "before": before})
            if method != "place effects":
                threat = tb.planning.threat_map(done, campaign.posterior, here)
                rows[-1] |= {"probability": float(threat["probability"].sum())}
                rows[-1] |= {"off": off(threat, here, center)}
                with suppress(tb.TrustboError):
                    campaign = again(campaign, plain.with_threat(threat), ends)
                    here = campaign.workspace
    return rows


def again(earlier: tb.Campaign, workspace: tb.Workspace, ends: Any) -> tb.Campaign:
    """Return a campaign that goes on from an earlier one, in a workspace with another threat."""
    return tb.Campaign(workspace, *ends, seed=4, earlier=earlier)


def off(threat: Any, workspace: tb.Workspace, center: tuple[float, float]) -> float:
    """Return the distance of the mean place of a threat from its true place, m."""
    of_cells = threat["probability"].sum("reach")
    share = of_cells / of_cells.sum()
    x, y = (float((share * of_cells[axis]).sum()) for axis in ("x", "y"))
    return float(np.hypot(x - center[0], y - center[1]))


def report(rows: pd.DataFrame) -> None:
    """Print the contact lost by mission, and the differences from place effects."""
    table = Table("contact lost", *[f"mission {k + 1}" for k in range(AFTER)], "2 to 6", first=26)
    known = rows[rows["mission"] > 0]
    for method, of_method in rows.groupby("method", sort=False):
        means = of_method.groupby("mission")["lost"].mean()
        later = known[known["method"] == method]["lost"].mean()
        table.row(method, *(f"{x:.3f}" for x in means), f"{later:.3f}")

    wide = known.pivot_table(index=["world", "course"], columns="method", values="lost")
    less = wide.sub(wide[METHODS[0]], axis=0).groupby("world").mean()
    print("\nminus place effects, missions 2 to 6\n")
    columns = "p", "p(threat)", "before", "off (m)"
    table = Table("method", "difference [95 %]", *columns, first=26)
    for name in METHODS[1:]:
        *ends, p = over_worlds(less[name].to_numpy(), less.index)
        about = rows[rows["method"] == name][["probability", "before", "off"]].mean()
        shares = [f"{about[column]:.2f}" for column in ("probability", "before")]
        table.row(name, interval(*ends), f"{p:.2g}", *shares, f"{about['off']:.0f}")


if __name__ == "__main__":
    main()
