"""Run campaigns of all methods on all worlds, and store the contact that each mission lost.

    python benchmarks/contact.py --data DIR --out out/contact
    python benchmarks/contact.py --world synthetic-0 --method trustbo --jobs 1

There are two settings. On changing courses, every mission has another start and goal on the same
ground; a world has three sets of such courses, which are drawn by the name of its terrain. On one
course, all missions have the same start and goal; a world has two such courses, its diagonals. A
campaign has 15 missions, which have the same seeds in all methods.

The contact lost is measured by the missions, in bounds: bounds that failed or were not reached are
fully lost. All methods have three sets of posts, and pay the same price of failures, as campaigns
do by default. trustbo has all its defaults. Baselines learn from each mission, and choose the path
that is best under their means or, if `optimistic`, under their upper quantiles.

Each campaign has a file in --out, so a run that was stopped continues where it was, and more
methods or worlds can be added. At the end, the rows of all campaigns are written to --csv, in a
file for each setting and method (see `rows_in`). `benchmarks/tables.py` summarises them.
"""

import warnings
from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from baselines import line_of_sight, residual_process, running_mean
from baselines.paths import PathPolicy
from common import arguments, parsed
from threadpoolctl import threadpool_limits
from world_set import World, available, worlds
from world_set.world import drawn
from worlds_in_parallel import run_worlds

import trustbo as tb
from trustbo.data import Cell
from trustbo.errors import TrustboError
from trustbo.files import write_text
from trustbo.study import lost_in

MISSIONS = 15
APART = 6
"""Smallest number of rows or columns, whichever is larger, between a start and a goal."""
SETTINGS: dict[str, tuple[str, ...]] = {
    "changing": ("0", "1", "2"),
    "one": ("sw-ne", "nw-se"),
}
"""Names of the sets of courses, or of the courses, of each setting."""
METHODS: dict[str, Callable[[], PathPolicy] | None] = {
    "trustbo": None,
    "running mean": running_mean.greedy,
    "running mean, optimistic": running_mean.optimistic,
    "residual process": residual_process.greedy,
    "residual process, optimistic": residual_process.optimistic,
    "line of sight": line_of_sight.LineOfSight,
}
"""Makes the policy of each baseline; None for trustbo."""
REFERENCE = Path(__file__).parent / "reference" / "contact"
_MOST_DRAWS = 100_000
"""Number of courses that are drawn before a world counts as having too few."""
_DECIMALS = 4
_STORED = 3

Course = tuple[Cell, Cell]
"""Start and goal."""


# --- courses ---


def courses_of(world: World, setting: str, which: str, n: int = MISSIONS) -> list[Course]:
    """Return the courses of the missions of a campaign."""
    if setting == "one":
        return [world.ends(which)] * n
    return changing_courses(world, which, n)


def changing_courses(
    world: World, which: str, n: int = MISSIONS, apart: int = APART
) -> list[Course]:
    """Draw the courses of a set, one for each mission.

    Start and goal are at least `apart` rows or columns from each other, and paths lead from one to
    the other for the assumed team on the assumed map, and for the true team on the true map. The
    first courses of a set do not depend on `n`. Worlds on one terrain have the same courses, but
    for those that cannot be driven in one of them.

    Raises TrustboError if the world has too few courses.
    """
    workspaces = world.workspace(), world.true_workspace()
    rows, cols = world.shape
    rng = drawn(world.ground, f"courses {which}")
    found: list[Course] = []
    for _ in range(_MOST_DRAWS):
        if len(found) == n:
            return found

        start, goal = ((int(row), int(col)) for row, col in rng.integers((rows, cols), size=(2, 2)))
        is_far = max(abs(start[0] - goal[0]), abs(start[1] - goal[1])) >= apart
        if is_far and all(has_path(workspace, (start, goal)) for workspace in workspaces):
            found.append((start, goal))
    raise TrustboError(f"world {world.name!r} has too few courses of {apart} cells.")


def has_path(workspace: tb.Workspace, course: Course) -> bool:
    """Return whether a course has admissible paths."""
    try:
        tb.Planner(workspace, *course)
    except TrustboError:
        return False
    return True


# --- campaigns ---


def campaign_of(
    world: World, setting: str, which: str, method: str, n: int = MISSIONS
) -> dict[str, Any]:
    """Run a campaign; return its row (see `rows_in`)."""
    make = METHODS[method]
    policy = None if make is None else make()
    options = {} if policy is None else {"policy": policy, "model": tb.models.PooledTrust()}
    courses = courses_of(world, setting, which, n)
    workspace = world.campaign_workspace()
    simulator = world.simulator(workspace)
    campaign = tb.Campaign(workspace, seed=0, progress=False, **options)

    row: dict[str, Any] = {
        "world": world.name, "kind": world.kind, "case": world.case, "ground": world.ground,
        "courses": which, "method": method,
    }  # fmt: skip
    predicted = {}
    status = []
    for k, (start, goal) in enumerate(courses):
        plan = campaign.ask(start=start, goal=goal)
        mission = simulator.run(plan.stations, seed=seed_of(which, k), mission=k)
        campaign.tell(mission, again=True)  # robots may get stuck in the same way twice
        if policy is not None:
            policy.learn(campaign, mission)

        row[f"lost_{k + 1}"] = round(lost_in(mission), _DECIMALS)
        predicted[f"p_{k + 1}"] = round(plan.p_arrive, _DECIMALS)
        status.append("." if mission.status == "ok" else mission.status[0])
    return {**row, **predicted, "status": "".join(status)}


def seed_of(which: str, mission: int) -> int:
    """Return the seed with which a mission is simulated, counted from 0, in all methods."""
    return int(drawn(which, f"mission {mission}").integers(2**31))


# --- runs ---


def file_of(folder: Path, world: str, setting: str, which: str, method: str) -> Path:
    """Return the file of the row of a campaign."""
    return folder / world / file_name(setting, which, method)


def file_name(*parts: str) -> str:
    """Return the name of a CSV file of rows, without spaces and commas."""
    return f"{' '.join(parts)}.csv".replace(", ", "-").replace(" ", "_")


def run_world(
    world: World,
    methods: Sequence[str],
    folder: Path,
    settings: Sequence[str] = tuple(SETTINGS),
    n_missions: int = MISSIONS,
) -> int:
    """Run the campaigns of a world that have no file yet; return how many."""
    missing = [
        (setting, which, method)
        for setting in settings
        for which in SETTINGS[setting]
        for method in methods
        if not file_of(folder, world.name, setting, which, method).exists()
    ]
    with warnings.catch_warnings(), threadpool_limits(1):
        warnings.simplefilter("ignore")  # of risk, and of bounds without contact
        for campaign in missing:
            row = campaign_of(world, *campaign, n_missions)
            file = file_of(folder, world.name, *campaign)
            file.parent.mkdir(parents=True, exist_ok=True)
            write_text(file, pd.DataFrame([row]).to_csv(index=False))
    return len(missing)


def rows_in(folder: Path, setting: str, method: str, names: Sequence[str]) -> pd.DataFrame:
    """Read the rows of a setting and method, in the order of worlds and courses.

    The columns are world, kind, case, ground (the terrain), courses (the set or the course) and
    method; the contact lost in each mission, lost_1 to lost_15, in bounds; the predicted arrival of
    each plan, p_1 to p_15; and `status` with one sign for each mission: a dot if it arrived,
    otherwise the first letter of its status.
    """
    files = [
        file_of(folder, name, setting, which, method)
        for name in names
        for which in SETTINGS[setting]
    ]
    tables = [pd.read_csv(file) for file in files if file.exists()]
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def run(given: Namespace) -> None:
    """Run the campaigns that the arguments of the command line ask for, and store all rows."""
    some = list(available(given.data).values())
    if given.world:
        some = [world for world in some if world.name in given.world]
    n_missions = MISSIONS
    if given.quick:
        some = some[:3]
        n_missions = 2
        given.out = Path(f"{given.out}-quick")  # its campaigns are shorter

    methods = given.method or tuple(METHODS)
    shared = methods, given.out, given.setting or tuple(SETTINGS), n_missions
    errors = run_worlds(run_world, some, given.jobs, *shared)

    if given.csv is not None:
        write_rows(given.out, given.csv, list(worlds()))
    if errors:
        raise SystemExit("\n".join(["campaigns are missing:", *errors]))


def write_rows(folder: Path, csv: Path, names: Sequence[str]) -> None:
    """Write the rows of each setting and method that has any to a file."""
    for setting in SETTINGS:
        for method in METHODS:
            rows = rows_in(folder, setting, method, names)
            if len(rows):
                csv.mkdir(parents=True, exist_ok=True)
                write_text(
                    csv / file_name(setting, method), rows.round(_STORED).to_csv(index=False)
                )


def main() -> None:
    parser = arguments(
        __doc__ or "", data=True, out="out/contact", quick="three worlds, 2 missions"
    )
    parser.add_argument("--method", action="append", choices=METHODS, help="default all")
    parser.add_argument("--world", action="append", help="name of a world, default all")
    parser.add_argument("--setting", action="append", choices=SETTINGS, help="default both")
    parser.add_argument("--jobs", type=int, default=-1, help="processes, default one per core")
    parser.add_argument("--csv", type=Path, help="folder for the rows of all campaigns")
    run(parsed(parser))


if __name__ == "__main__":
    main()
