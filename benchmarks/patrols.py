"""Compare the contact that methods lose if every mission has another course on the same ground.

    python benchmarks/patrols.py --data DIR --out out/patrols --csv out/patrols.csv
    python benchmarks/patrols.py --method "running mean, priced" --jobs 1 --out out/patrols
    python benchmarks/patrols.py --rows benchmarks/reference/patrols.csv

A campaign of a method has 15 missions in one world, each from another start to another goal. A
world has three sets of such courses, which are drawn by the name of its terrain. Worlds on one
terrain have the same courses unless one of them cannot be driven. Missions have the same seeds in
all methods. The excess of a mission is the expected contact that its path loses, in bounds, minus
that of the best path of the course, by the truth of the world. Bounds that fail or are not reached
count as lost.

All methods pay the same for failures: a failure costs as many bounds as the shortest path of the
course has, times the failure probability by `fit_hazard` on the missions so far. In the methods
named `priced`, this is so from the first mission on. In those named `free first`, failures have no
cost until one has happened. `trustbo, three sets` also has the price from the first mission on, and
plans with three sets of posts, the default of workspaces; all others have the standard set. Truths
are those of the standard set, so three sets are compared by the contact lost as missions measure
it. The baselines do not use a posterior of trust, and none is fitted. The residual process and the
running mean plan with their means.

Each campaign has a file in --out, so a run that was stopped continues where it was. With `--rows`,
no campaign is run, and the tables are those of the means of earlier runs.
"""

import sys
import time
import warnings
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from baselines import line_of_sight, residual_process, running_mean
from baselines.paths import PathPolicy
from common import Table, arguments, parsed, verdict
from groups import GROUPS, KINDS, clustered, grounds_of, interval
from lost import LEAST, lost_in
from threadpoolctl import threadpool_limits
from world_set import World, worlds
from world_set.world import drawn
from worlds_in_parallel import run_worlds

import trustbo as tb
from trustbo.data import POST_SETS, Cell, Mission
from trustbo.errors import PosteriorError, TrustboError
from trustbo.files import write_text
from trustbo.hazard import BoundRisk, fit_hazard
from trustbo.models.draws import Draws
from trustbo.planning import Plan, Planner
from trustbo.planning.policies import POLICIES, choose_plan
from trustbo.simulation import KinematicSimulator, RadioSimulator, Truth
from trustbo.workspace import Workspace

SETS = (0, 1, 2)
MISSIONS = 15
LATE = 8
"""First of the missions of which tables show the mean apart."""
APART = 6
"""Smallest number of rows or columns, whichever is larger, between a start and a goal."""
PLANNER = {"max_bounds": "shortest+4"}
HOPELESS = 0.9
"""Failure probability above which baselines take the safest path, as campaigns of 0.6 did."""
_MOST_DRAWS = 100_000
"""Number of courses that are drawn before a world counts as having too few."""
_DECIMALS = 5

Course = tuple[Cell, Cell]
"""Start and goal."""


@dataclass(frozen=True)
class Priced:
    """Policy of a campaign that pays the price of failures of this benchmark.

    Attributes:
        policy: Name of the policy that chooses the path.
        from_start: Whether failures have a cost before the first one has happened.
        n_posts: Number of sets of posts.
    """

    policy: str
    from_start: bool
    n_posts: int = 1

    def __call__(
        self,
        rng: np.random.Generator,
        params: Draws,
        planner: Planner,
        driven: Sequence[Sequence[Cell]] = (),
    ) -> Plan:
        """Plan the next mission."""
        planner = with_price(planner, self.from_start)
        return choose_plan(POLICIES[self.policy], rng, params, planner, driven)


@dataclass(frozen=True)
class Baseline:
    """Baseline that plans with a planner of each course.

    Attributes:
        make: Makes the policy before the first mission.
        from_start: Whether failures have a cost before the first one has happened.
    """

    make: Callable[[], PathPolicy]
    from_start: bool


METHODS: dict[str, Priced | Baseline] = {
    "trustbo, free first": Priced("greedy", from_start=False),
    "trustbo, priced": Priced("greedy", from_start=True),
    "trustbo, explore": Priced("explore", from_start=True),
    "trustbo, three sets": Priced("greedy", from_start=True, n_posts=3),
    "running mean, free first": Baseline(running_mean.greedy, from_start=False),
    "running mean, priced": Baseline(running_mean.greedy, from_start=True),
    "residual process, free first": Baseline(residual_process.ResidualProcess, from_start=False),
    "residual process, priced": Baseline(residual_process.ResidualProcess, from_start=True),
    "line of sight, free first": Baseline(line_of_sight.LineOfSight, from_start=False),
    "line of sight, priced": Baseline(line_of_sight.LineOfSight, from_start=True),
}
BASELINES = tuple(name for name, method in METHODS.items() if isinstance(method, Baseline))
OURS = tuple(name for name, method in METHODS.items() if isinstance(method, Priced))
PAIRS = (
    ("explore minus greedy: excess in bounds per mission", "excess",
     ("trustbo, explore", "trustbo, priced")),
    ("three sets of posts minus one: contact lost in bounds per mission, as measured", "lost",
     ("trustbo, three sets", "trustbo, priced")),
)  # fmt: skip
"""Titles, quantities and pairs of methods that are compared with each other."""
RIGHT = "all but wrong slope limits"
"""Group for which the target is stated."""
TARGET, LEVEL, WORSE = -0.04, 0.02, 0.01
"""Largest difference from the best baseline, its p-value, and largest difference in a group."""


# --- campaigns ---


@dataclass(frozen=True, eq=False)
class Ground:
    """World in which campaigns run, with one set of posts, and its truth."""

    world: World
    workspace: Workspace
    simulator: KinematicSimulator | RadioSimulator
    truth: Truth

    @cached_property
    def with_sets(self) -> tuple[Workspace, KinematicSimulator | RadioSimulator]:
        """Workspace and simulator of the world with three sets of posts."""
        workspace = self.world.workspace(n_posts=len(POST_SETS))
        return workspace, self.world.simulator(workspace)

    def of(self, method: "Priced | Baseline") -> tuple[Workspace, Any]:
        """Return the workspace and the simulator of a method."""
        if isinstance(method, Priced) and method.n_posts > 1:
            return self.with_sets
        return self.workspace, self.simulator


def ground_of(world: World, truths: Path | None) -> Ground:
    """Make the workspace, simulator and truth of a world; `truths` is the folder of truths."""
    workspace = world.workspace(n_posts=1)
    simulator = world.simulator(workspace)
    truth = Truth.from_simulator(simulator, folder=truths)
    return Ground(world, workspace, simulator, truth)


def courses(ground: Ground, which: int, n: int = MISSIONS, apart: int = APART) -> list[Course]:
    """Draw the courses of a set, one for each mission.

    Start and goal are at least `apart` rows or columns from each other. In the assumed workspace,
    both are passable, and a path leads from one to the other. In the truth, a best path exists. The
    first courses of a set do not depend on `n`.

    Raises TrustboError if the world has too few courses.
    """
    rows, cols = ground.workspace.passable.shape
    rng = drawn(ground.world.ground, f"courses {which}")
    found: list[Course] = []
    for _ in range(_MOST_DRAWS):
        if len(found) == n:
            return found

        start, goal = ((int(row), int(col)) for row, col in rng.integers((rows, cols), size=(2, 2)))
        is_far = max(abs(start[0] - goal[0]), abs(start[1] - goal[1])) >= apart
        if is_far and _is_drivable(ground, (start, goal), len(found)):
            found.append((start, goal))
    raise TrustboError(f"world {ground.world.name!r} has too few courses of {apart} cells.")


def _is_drivable(ground: Ground, course: Course, mission: int) -> bool:
    """Return whether a course has admissible paths, and a best one of known contact."""
    try:
        Planner(ground.workspace, *course, **PLANNER)
        truth = ground.truth.at(mission)
        return bool(np.isfinite(truth.lost_or_failed(_best(truth, course))))
    except TrustboError:
        return False


def _best(truth: Truth, course: Course) -> tuple[Cell, ...]:
    """Return the path that loses least, with failures."""
    return truth.best(*course, max_bounds=PLANNER["max_bounds"], failures=True)


def with_price(planner: Planner, from_start: bool) -> Planner:
    """Make a failure cost the bounds of a shortest path; if not `from_start`, after the first."""
    risk = planner.problem.risk
    has_failures = isinstance(risk, BoundRisk) and bool(risk.failures.any())
    shortest = planner.problem.paths.shortest
    return planner.with_failure_cost(float(shortest) if from_start or has_failures else 0.0)


def seed_of(which: int, mission: int) -> int:
    """Return the seed with which a mission is simulated, counted from 0, in all methods."""
    return int(np.random.SeedSequence([which, mission]).generate_state(1)[0])


def campaign_of(ground: Ground, which: int, name: str, on: Sequence[Course]) -> pd.DataFrame:
    """Run a campaign of a method on the courses `on` of a set; return a row for each mission."""
    method = METHODS[name]
    _, simulator = ground.of(method)
    begin = _trustbo if isinstance(method, Priced) else _baseline
    proposals = begin(ground, which, method)
    next(proposals)

    rows = []
    for k, course in enumerate(on):
        path, p_arrive = proposals.send(course)
        mission = simulator.run(path, seed=seed_of(which, k), mission=k)
        proposals.send(mission)

        truth = ground.truth.at(k)
        best = truth.lost_or_failed(_best(truth, course))
        is_known = not mission.post_sets  # the truth is that of the standard set
        rows.append({
            "world": ground.world.name, "kind": ground.world.kind, "case": ground.world.case,
            "set": which, "method": name, "mission": k + 1,
            "lost": lost_in(mission), "status": mission.status,
            "excess": truth.lost_or_failed(path) - best if is_known else np.nan,
            "best": best, "p_arrive": p_arrive,
        })  # fmt: skip
    return pd.DataFrame(rows).round(_DECIMALS)


def _trustbo(ground: Ground, which: int, method: Priced) -> Iterator:
    """Run a campaign of trustbo: send a course to get its path, then the mission on this path."""
    workspace, _ = ground.of(method)
    campaign = tb.Campaign(workspace, policy=method, planner=PLANNER, seed=which, progress=False)
    course = yield
    while True:
        plan = _asked(campaign, course)
        mission = yield plan.stations, plan.p_arrive
        campaign.tell(mission, again=True)  # robots may get stuck in the same way twice
        course = yield


def _asked(campaign: tb.Campaign, course: Course) -> Plan:
    """Ask a campaign for a plan of a course."""
    return campaign.ask(start=course[0], goal=course[1])


def _baseline(ground: Ground, which: int, method: Baseline) -> Iterator:
    """Run a campaign of a baseline: send a course to get its path, then the mission on it."""
    policy = method.make()
    missions: list[Mission] = []
    hazard = fit_hazard([], ground.workspace)
    course = yield
    while True:
        risk = BoundRisk(hazard, ground.workspace)
        planner = Planner(ground.workspace, *course, **PLANNER).with_risk(risk)
        planner = with_price(planner, method.from_start)
        path = policy.best(planner)
        if planner.problem.cost_of_failure and risk.failure(path) > HOPELESS:
            path, _ = planner.problem.safest()

        mission = yield path, risk.along(path).p_arrive
        missions.append(mission)
        policy.learn(None, mission)  # pyright: ignore[reportArgumentType] (used by no baseline)
        try:
            hazard = fit_hazard(missions, ground.workspace, seed=seed_of(which, len(missions)))
        except PosteriorError:  # the previous hazard remains, as in a campaign
            pass
        course = yield


# --- runs ---


def file_of(folder: Path, world: str, which: int, method: str) -> Path:
    """Return the file of the rows of a campaign."""
    return folder / world / f"{which} {method}.csv".replace(", ", "-").replace(" ", "_")


def run_world(
    world: World,
    methods: Sequence[str],
    folder: Path,
    truths: Path | None,
    sets: Sequence[int] = SETS,
    n_missions: int = MISSIONS,
    apart: int = APART,
) -> int:
    """Run the campaigns of a world that have no file yet; return how many."""
    files = {(which, name): file_of(folder, world.name, which, name)
             for which in sets for name in methods}  # fmt: skip
    missing = {key: file for key, file in files.items() if not file.exists()}
    if not missing:
        return 0

    with warnings.catch_warnings(), threadpool_limits(1):
        warnings.simplefilter("ignore")  # of risk, and of bounds without contact
        ground = ground_of(world, truths)
        on = {which: courses(ground, which, n_missions, apart) for which, _ in missing}
        for (which, name), file in missing.items():
            began = time.process_time()
            rows = campaign_of(ground, which, name, on[which])
            file.parent.mkdir(parents=True, exist_ok=True)
            write_text(file, rows.to_csv(index=False))
            seconds = time.process_time() - began
            print(f"  {world.name}, {which}, {name}: {seconds:.1f} s", file=sys.stderr, flush=True)
    return len(missing)


def rows_in(folder: Path, names: Sequence[str]) -> pd.DataFrame:
    """Read the rows of all campaigns in a folder, in the order of worlds, sets and methods."""
    order = {method: k for k, method in enumerate(METHODS)}
    tables = []
    for name in names:
        for file in sorted((folder / name).glob("*.csv")):
            tables.append(pd.read_csv(file))
    rows = pd.concat(tables, ignore_index=True)
    rank = rows.assign(world=rows["world"].map(list(names).index), method=rows["method"].map(order))
    rank = rank.sort_values(["world", "set", "method", "mission"], kind="stable")
    return rows.loc[rank.index].reset_index(drop=True)


def run(given: Namespace) -> pd.DataFrame:
    """Run the campaigns that the arguments of the command line ask for; return all rows."""
    every = worlds(given.data)
    some = [w for w in every.values() if given.data or w.is_packaged]
    if given.world:
        some = [world for world in some if world.name in given.world]
    sets, n_missions = given.set or SETS, given.missions
    if given.quick:
        some, sets, n_missions = some[:3], sets[:1], 2
        given.out = Path(f"{given.out}-quick")  # its campaigns are shorter

    shared = given.method or tuple(METHODS), given.out, given.truths, sets, n_missions
    errors = run_worlds(run_world, some, given.jobs, *shared)
    if errors:
        raise SystemExit("\n".join(["campaigns are missing:", *errors]))
    return rows_in(given.out, [world.name for world in some])


# --- tables ---


def groups_of(rows: pd.DataFrame) -> dict[str, pd.Series]:
    """Return for each group and kind which rows belong to it; limits too high and low apart."""
    is_limit, is_low = rows["kind"] == "limit", rows["case"].str.contains("low")
    groups = {name: rows["kind"].isin(kinds) for name, kinds in GROUPS.items()}
    groups |= {"limit too high": is_limit & ~is_low, "limit too low": is_limit & is_low}
    groups |= {kind: rows["kind"] == kind for kind in KINDS[:-1]}
    return {name: chosen for name, chosen in groups.items() if chosen.any()}


def means_of(rows: pd.DataFrame) -> pd.DataFrame:
    """Average the rows of missions by world and method.

    Only sets and missions that all methods have are used. The columns are world, kind, case,
    method, `excess`, `late_excess` (missions from `LATE` on), `lost` and `arrives` of all missions,
    and `first_arrives` and `first_predicted` of the first ones.
    """
    n_methods = rows["method"].nunique()
    of_mission = rows.groupby(["world", "case", "set", "mission"])["method"]
    rows = rows[of_mission.transform("nunique") == n_methods]
    rows = rows.assign(arrives=(rows["status"] == "ok").astype(float))

    by = ["world", "kind", "case", "method"]
    means = rows.groupby(by, sort=False)[["excess", "lost", "arrives"]].mean()
    late, first = rows[rows["mission"] >= LATE], rows[rows["mission"] == 1]
    of_first = first.groupby(by, sort=False)[["arrives", "p_arrive"]].mean()
    means["late_excess"] = late.groupby(by, sort=False)["excess"].mean()
    means[["first_arrives", "first_predicted"]] = of_first
    return means.reset_index()


def of_worlds(means: pd.DataFrame, quantity: str = "excess") -> pd.DataFrame:
    """Tabulate a quantity of `means_of` by world, with a column for each method."""
    wide = means.pivot_table(quantity, ["world", "kind", "case"], "method", sort=False).dropna()
    return wide[[name for name in METHODS if name in wide]].reset_index()


def tests(excess: pd.DataFrame, ours: str) -> pd.DataFrame:
    """Test the difference of a method from each baseline, and from the best one of each group.

    Args:
        excess: Table of `of_worlds`.
        ours: The method.

    Returns:
        Table with columns group, n (worlds), other, `value`, `low`, `high` and `p` of `clustered`,
        by terrain, and the numbers of worlds in which the method is `better` and `worse` by more
        than .01 bounds.
    """
    others = [name for name in BASELINES if name in excess]
    table = []
    for group, chosen in groups_of(excess).items():
        some = excess[chosen]
        best = some[others].mean().idxmin()
        for other, name in [*((o, o) for o in others), (best, f"the best ({best})")]:
            less = (some[ours] - some[other]).to_numpy()
            found = clustered(less, grounds_of(some["world"]))
            counts = int((less < -WORSE).sum()), int((less > WORSE).sum())
            table.append([group, len(some), name, *found, *counts])
    head = ["group", "n", "other", "value", "low", "high", "p", "better", "worse"]
    return pd.DataFrame(table, columns=head)


def report(means: pd.DataFrame) -> None:
    """Print all tables."""
    whole = {"all missions": "excess", f"missions from {LATE} on": "late_excess"}
    whole = {when: name for when, name in whole.items() if means[name].notna().any()}
    for when, name in whole.items():
        print(f"\n**Excess, {when}**: bounds per mission, with failures\n")
        print_means(of_worlds(means, name))

    present = set(means["method"])
    for ours in OURS:
        if ours not in present or not present & set(BASELINES):
            continue
        for when, name in whole.items():
            print(f"\n**{ours}, minus baselines, {when}** [95 %, t test by terrain]\n")
            found = tests(of_worlds(means, name), ours)
            print_tests(found)
            print_targets(found)

    titles = {
        "First missions that arrive": "first_arrives",
        "Predicted arrival of first missions": "first_predicted",
        "Missions that arrive": "arrives",
    }
    for title, name in titles.items():
        print(f"\n**{title}**\n")
        print_means(of_worlds(means, name), 2)

    for title, quantity, pair in PAIRS:
        if present.issuperset(pair):
            print(f"\n**{title}**\n")
            print_pair(of_worlds(means[means["method"].isin(pair)], quantity), *pair)


def print_means(table: pd.DataFrame, places: int = 3) -> None:
    """Print the means of a table of `of_worlds` by group and kind."""
    methods = [name for name in METHODS if name in table]
    printed = Table("group (worlds)", *methods)
    for group, chosen in groups_of(table).items():
        means = [f"{mean:z.{places}f}" for mean in table[chosen][methods].mean()]
        printed.row(f"{group} ({chosen.sum()})", *means)


def print_tests(found: pd.DataFrame) -> None:
    """Print the table of `tests`."""
    printed = Table("group (worlds)", "baseline", "difference [95 %]", "p", "better", "worse")
    for _, row in found.iterrows():
        what = f"{row['group']} ({row['n']})"
        counts = row["better"], row["worse"]
        printed.row(what, row["other"], interval(row, 3), f"{row['p']:.2g}", *counts)


def print_targets(found: pd.DataFrame) -> None:
    """Print whether the targets are met, by the table of `tests`."""
    best = found[found["other"].str.startswith("the best")].set_index("group")
    if RIGHT in best.index:
        value, p = best.loc[RIGHT, ["value", "p"]]
        met = verdict(value <= TARGET and p < LEVEL)
        print(
            f"\nAt most {TARGET} from the best baseline, p < {LEVEL}: {met} ({value:.3f}, {p:.2g})"
        )

    of_groups = best[best.index.isin(GROUPS)]
    worse = of_groups.index[of_groups["value"] > WORSE].tolist()
    print(f"No group worse by more than {WORSE}: {verdict(not worse)} {', '.join(worse)}")


def print_pair(table: pd.DataFrame, ours: str, other: str) -> None:
    """Print the mean differences of two methods by group and kind, for a table of `of_worlds`.

    The ratio is that of the geometric means over worlds.
    """
    printed = Table("group (worlds)", "difference [95 %]", "p", "ratio [95 %]", "p of ratio")
    for group, chosen in groups_of(table).items():
        some = table[chosen]
        where = grounds_of(some["world"])
        less = (some[ours] - some[other]).to_numpy()
        ratio = np.log((some[ours] + LEAST) / (some[other] + LEAST)).to_numpy()

        texts = []
        for values, scale in ((less, np.positive), (ratio, np.exp)):
            *ends, p = clustered(values, where)
            row = pd.Series(dict(zip(("value", "low", "high"), scale(ends), strict=True)))
            texts += [interval(row, 3), f"{p:.2g}"]
        printed.row(f"{group} ({len(some)})", *texts)


def main() -> None:
    parser = arguments(
        __doc__ or "", data=True, out="out/patrols", quick="three worlds, 2 missions"
    )
    parser.add_argument("--method", action="append", choices=METHODS, help="default all")
    parser.add_argument("--world", action="append", help="name of a world, default all")
    parser.add_argument("--set", action="append", type=int, help="set of courses, default 0, 1, 2")
    parser.add_argument("--missions", type=int, default=MISSIONS, help=f"default {MISSIONS}")
    parser.add_argument("--truths", type=Path, default=Path("out/truths"), help="folder of truths")
    parser.add_argument("--jobs", type=int, default=-1, help="processes, default one per core")
    parser.add_argument("--csv", type=Path, help="CSV file for the means by world")
    parser.add_argument("--rows", type=Path, action="append", help="CSV file with means")
    given = parsed(parser)

    if given.rows:
        means = pd.concat([pd.read_csv(file) for file in given.rows], ignore_index=True)
    else:
        means = means_of(run(given))
    if given.csv is not None:
        write_text(given.csv, means.round(_DECIMALS).to_csv(index=False))
    report(means)


if __name__ == "__main__":
    main()
