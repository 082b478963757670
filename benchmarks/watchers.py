"""Predicted contact of robots, and of at least one and two of them, with robots at home.

    python benchmarks/watchers.py --data DIR [--quick]

T2 has four robots. In each of ten missions on different paths, two of them take part, other ones
each time. The default model is fitted to these missions. For new paths and for two, three or four
robots, the tables compare predictions of `Planner.watchers` with the mean of simulated missions:

- rate: contact rates of the robots that take part.
- one, two: shares of ticks with at least one and two watchers.

For each, `off` is the mean absolute difference of the means of paths, and `bias` the mean
difference. `apart` is the former if robots have contact independently, given their rates.
`covered` is the share of true rates of a robot in a bound, the mean of simulated missions, that are
within the 90 % interval of stationary trust; the bounds are those of the ten missions, and the
robots are those that were there, or not. `w` is the estimated dependence of contact.
"""

import itertools
import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
import xarray as xr
from common import Table, arguments, parsed
from world_set import World, worlds

import trustbo as tb
from trustbo.data import Station
from trustbo.planning.given import draws_of
from trustbo.planning.watchers import watchers_along
from trustbo.workspace.moves import MOVE_NAMES, bounds_along

WORLDS = ("synthetic-0", "synthetic-1", "synthetic-0-aged", "synthetic-2-jammer", "wellington",
          "wellington-aged", "tahoe-aged", "synthetic-cedar-jammer-lifted")  # fmt: skip
TEAM = tb.Team(4)
PAIRS = list(itertools.combinations(TEAM.names, 2))
N_MISSIONS = 10
N_PATHS = 12
"""Number of new paths."""
N_REPLICATES = 8
"""Number of simulated missions of which the mean is the truth."""
COURSE = "sw-ne"
BY_SIGHT = tb.models.TrustParams(0.3, np.array([0.2, 0.2, 0.6]), 0.0, 0.1, 0.1)
"""Parameters for the random paths, which are the best ones for random costs of bounds."""


def main() -> None:
    parser = arguments(__doc__ or "", data=True, quick="two worlds", names=WORLDS)
    given = parsed(parser)

    every = worlds(given.data)
    rows = []
    covered = []
    for name in given.names[:2] if given.quick else given.names:
        found, rates = rows_of(replace(every[name], team=TEAM))
        rows += found
        covered += rates
        print(name, file=sys.stderr, flush=True)
    report(pd.DataFrame(rows), pd.DataFrame(covered))


def rows_of(world: World) -> tuple[list[dict[str, object]], list[dict[str, object]]]:
    """Return a row for each new path, and one for each robot in a bound that was driven."""
    workspace = world.workspace()
    ends = world.ends(COURSE)
    paths = paths_of(workspace, ends, N_MISSIONS + N_PATHS)
    driven, new = paths[:N_MISSIONS], paths[N_MISSIONS:]

    order = np.random.default_rng(0).permutation(len(PAIRS))
    going = [PAIRS[order[j % len(PAIRS)]] for j in range(N_MISSIONS)]
    missions = [run(world, workspace, path, pair, j)
                for j, (path, pair) in enumerate(zip(driven, going, strict=True))]  # fmt: skip
    told = [filled(mission, workspace) for mission in missions]
    posterior = tb.fit(told, workspace=workspace, seed=1, latent=False, progress=False)
    dependence = tb.planning.contact_dependence(missions)

    rows = []
    teams = [*PAIRS, *itertools.combinations(TEAM.names, 3), TEAM.names]
    for k, path in enumerate(new):
        names = teams[k % len(teams)]
        true = truth_along(world, workspace, path, names, 1000 + 100 * k)
        planner = tb.Planner(workspace.of_robots(names), *ends)
        known = planner.watchers(path, posterior, missions=missions)
        expected = {
            "rate": known[[f"rate_{name}" for name in names]].to_numpy().mean(),
            "one": known["at_least_one"].mean(),
            "two": known["at_least_two"].mean(),
        }
        draws = draws_of(posterior, planner.workspace).drawn
        apart = watchers_along(planner.problem, path, draws, dependence=0.0, seed=0)
        row: dict[str, object] = {"world": world.name, "robots": len(names), "w": dependence}
        row |= {"apart one": apart["at_least_one"].mean()}
        row |= {"apart two": apart["at_least_two"].mean()}
        for what, value in expected.items():
            row |= {what: value, f"true {what}": true[what]}
        rows.append(row)
    return rows, covered_in(world, workspace, missions, posterior)


def paths_of(
    workspace: tb.Workspace, ends: tuple[Station, Station], n: int
) -> list[tuple[Station, ...]]:
    """Return different paths, which are optimal for random costs of bounds."""
    rng = np.random.default_rng(1)
    found: dict[tuple[Station, ...], None] = {}
    while len(found) < n:
        cost = rng.exponential(2.0, (len(MOVE_NAMES), *workspace.passable.shape))
        found[tb.Planner(workspace, *ends, bound_cost=cost).plan(BY_SIGHT).path] = None
    return list(found)


def run(
    world: World, workspace: tb.Workspace, path: Sequence[Station], names: Sequence[str], seed: int
) -> tb.Mission:
    """Simulate a mission in which some robots take part."""
    there = replace(world, team=world.team.of_robots(names))
    return there.simulator(workspace.of_robots(names)).run(path, seed=seed)


def filled(mission: tb.Mission, workspace: tb.Workspace) -> tb.Mission:
    """Return a mission of all robots, with the awareness that the map predicts for each of them."""
    whole = mission.with_robots(workspace.team.names)
    return whole.with_awareness(workspace.along(mission.driven))


def truth_along(
    world: World, workspace: tb.Workspace, path: Sequence[Station], names: Sequence[str], seed: int
) -> dict[str, float]:
    """Return the mean rate and the shares of ticks with at least one and two watchers."""
    found = {"rate": [], "one": [], "two": []}
    for mission in replicates(world, workspace, path, names, seed):
        of_bounds = [values.sum(1) for values in mission.contact if values is not None]
        found["rate"].append(mission.contact_rate.mean())
        found["one"].append(np.mean([(n >= 1).mean() for n in of_bounds]))
        found["two"].append(np.mean([(n >= 2).mean() for n in of_bounds]))
    return {what: float(np.mean(values)) for what, values in found.items()}


def replicates(
    world: World, workspace: tb.Workspace, path: Sequence[Station], names: Sequence[str], seed: int
) -> list[tb.Mission]:
    """Simulate a path several times; missions that failed are left out unless all failed."""
    every = [run(world, workspace, path, names, seed + k) for k in range(N_REPLICATES)]
    return [mission for mission in every if mission.status == "ok"] or every


def covered_in(
    world: World, workspace: tb.Workspace, missions: Sequence[tb.Mission], posterior: xr.DataTree
) -> list[dict[str, object]]:
    """Return, for each robot in each bound that was driven, whether its true rate is covered."""
    planner = tb.Planner(workspace, *world.ends(COURSE))
    maps = [planner.trust(posterior, move=move, as_rate=True) for move in MOVE_NAMES]
    intervals = [np.quantile(of_move, [0.05, 0.95], axis=0) for of_move in maps]

    true: dict[tuple[int, ...], list[np.ndarray]] = {}
    was_there: dict[tuple[int, ...], set[str]] = {}
    for j, mission in enumerate(missions):
        bounds = [tuple(bound) for bound in bounds_along(mission.driven).tolist()]
        for bound in bounds:
            was_there.setdefault(bound, set()).update(mission.robots)
        for again in replicates(world, workspace, mission.driven, TEAM.names, 5000 + 100 * j):
            for bound, rates in zip(bounds, again.contact_rate, strict=False):
                true.setdefault(bound, []).append(rates)

    rows = []
    for (move, row, col), rates in true.items():
        mean = np.mean(rates, axis=0)
        for i, name in enumerate(TEAM.names):
            low, high = intervals[move][:, i, row, col]
            rows.append(
                {
                    "world": world.name,
                    "robot": name,
                    "was there": name in was_there[move, row, col],
                    "covered": low - 1e-9 <= mean[i] <= high + 1e-9,
                    "width": high - low,
                }
            )
    return rows


def report(rows: pd.DataFrame, covered: pd.DataFrame) -> None:
    """Print how far predictions are off in each world, and the coverage of intervals."""
    of_shares = "true", "off", "bias", "apart"
    columns = [f"{what} rate" for what in of_shares[:3]]
    columns += [f"{what} {name}" for name in ("one", "two") for what in of_shares]
    for kind in ("world", "robots"):
        table = Table(kind, "w", *columns, first=30, name=f"watchers_by_{kind}")
        for label, group in [*rows.groupby(kind, sort=False), ("all", rows)]:
            table.row(label, f"{group['w'].mean():.2f}", *errors_of(group))
        print()

    table = Table("world", "covered", "r1", "r2", "r3", "r4", "was there", "was not", first=30,
                  name="watchers_covered")  # fmt: skip
    for world, of_world in [*covered.groupby("world", sort=False), ("all", covered)]:
        by_robot = of_world.groupby("robot")["covered"].mean()
        by_there = of_world.groupby("was there")["covered"].mean()
        shares = [of_world["covered"].mean(), *by_robot, by_there.get(True), by_there.get(False)]
        table.row(world, *(f"{share:.2f}" for share in shares))


def errors_of(rows: pd.DataFrame) -> list[str]:
    """Return, as texts, the true means, and how far predictions are off."""
    texts = []
    for name in ("rate", "one", "two"):
        true = rows[f"true {name}"]
        off = rows[name] - true
        texts += [f"{true.mean():.3f}", f"{off.abs().mean():.3f}", f"{off.mean():+.3f}"]
        if name != "rate":
            texts.append(f"{(rows[f'apart {name}'] - true).abs().mean():.3f}")
    return texts


if __name__ == "__main__":
    main()
