"""Failures: reliability of the chance to arrive, Brier skill, and arrivals of campaigns.

    python benchmarks/failures.py --data ../shared/data [quick] [--worlds synthetic-0:14:4 ...]

Kinematic worlds with tight slope limits, named ground:limit:excess. The assumed limit is the true
one plus the excess, in degrees: 0, geometry knows all that it can; above, ways lead over ground
that stops robots. Random missions are drawn from all admissible paths of the first course.
"""

import argparse
import time
import warnings

import numpy as np

import trustbo as tb
from trustbo.models import CAUSES, BoundRisk, fit_hazard
from trustbo.planning.path_sampling import path_sampler
from trustbo.simulation import KinematicSimulator
from trustbo.study.world import COURSES, World
from trustbo.workspace.moves import moves_along

WORLDS = [
    f"{ground}:{limit}:{excess}"
    for ground, limit in (
        ("topography", 18),
        ("tahoe", 18),
        ("synthetic-0", 14),
        ("wellington", 38),
    )
    for excess in (0, 4, 8)
]
LEAST = 100
"""Missions in a bin of predicted chances from which on its reliability counts."""


def team_of(limit):
    robot = tb.Robot(max_slope=float(np.deg2rad(limit)))
    return tb.Team(robots=(robot,) * 3, lead=robot)


def world_of(name, data):
    """World with the assumed slope limit, and the simulator of the true one."""
    ground, limit, excess = name.split(":")
    world = World(name, "slopes", ground, max_slope=float(limit) + float(excess), data=data)
    workspace = world.workspace()
    return world, KinematicSimulator(workspace, team=team_of(float(limit)))


def random_missions(workspace, simulator, ends, n, seed):
    """Missions over random paths of up to four bounds more than the fewest, all equally likely."""
    rng = np.random.default_rng(seed)
    sampler = path_sampler(tb.planning.Planner(workspace, *ends).paths)
    return [simulator.run(sampler.draw(rng), seed=int(rng.integers(2**31))) for _ in range(n)]


def outcomes(missions):
    """Bounds that were begun, (bound, 3), whether each failed, and whether missions arrived."""
    rows, failed = [], []
    for mission in missions:
        path = mission.path[: len(mission.bounds) + 1]
        rows.append(np.column_stack([moves_along(path), np.array(path)[1:]]))
        failed += [bound.status in CAUSES for bound in mission.bounds]
    arrived = np.array([mission.status == "ok" for mission in missions])
    return np.concatenate(rows), np.array(failed), arrived


def p_arrive(risk, missions, n_draws=500):
    chances = risk.draw(n_draws, seed=1)
    paths = [np.column_stack([moves_along(m.path), np.array(m.path)[1:]]) for m in missions]
    return np.array([(1.0 - chances[:, *path.T]).prod(1).mean() for path in paths])


def skill(predicted, happened):
    """Brier skill over the rate of the missions that are judged."""
    base = np.mean((happened - happened.mean()) ** 2)
    return 1.0 - np.mean((happened - predicted) ** 2) / base if base > 0.0 else np.nan


def reliability(predicted, arrived):
    """Rows (bin, missions, predicted, arrived) and the largest error of a bin that counts."""
    rows, worst = [], 0.0
    which = np.minimum((10 * predicted).astype(int), 9)
    for b in range(10):
        own = which == b
        if own.any():
            rows.append((b, int(own.sum()), predicted[own].mean(), arrived[own].mean()))
            if own.sum() >= LEAST:
                worst = max(worst, abs(rows[-1][2] - rows[-1][3]))
    return rows, worst


def learn(name, world, simulator, n_unseen):
    """Brier skill after 15 and 60 missions, and reliability after 15."""
    workspace, ends = simulator.workspace, world.ends(COURSES[0])
    unseen = random_missions(workspace, simulator, ends, n_unseen, seed=0)
    bounds, failed, arrived = outcomes(unseen)
    seen, row, shown = random_missions(workspace, simulator, ends, 60, seed=1), [], None
    for n in (0, 15, 60):
        group = fit_hazard(seen[:n], workspace)
        risk = BoundRisk.of(group, workspace)
        chance = p_arrive(risk, unseen)
        rows, worst = reliability(chance, arrived)
        shown = rows if n == 15 else shown
        by_bound = skill(risk.mean[*bounds.T], failed)
        row += [by_bound, skill(chance, arrived), worst, group.attrs["seconds"]]
    cells = " | ".join(f"{value:.2f}" for value in row)
    print(f"| {name} | {1.0 - arrived.mean():.2f} | {failed.mean():.3f} | {cells} |", flush=True)
    return shown


def campaigns(name, world, simulator, courses, n_missions, options):
    """Share of missions that arrive, and of later plans over a bound that stopped a robot."""
    workspace, arrived, again, seconds = simulator.workspace, [], [], []
    for course in courses:
        stopped, ok = set(), []
        campaign = tb.Campaign(workspace, *world.ends(course), sampler="exact", **options)
        for _ in range(n_missions):
            plan = campaign.ask()
            bounds = set(zip(plan.path[:-1], plan.path[1:], strict=True))
            if stopped:
                again.append(bool(bounds & stopped))
            mission = simulator.run(plan.path, seed=campaign.seed_of("mission"))
            campaign.tell(mission, again=True)
            seconds.append(campaign.hazard.attrs["seconds"])
            ok.append(mission.status == "ok")
            if not ok[-1]:
                k = len(mission.bounds)
                stopped.add((plan.path[k - 1], plan.path[k]))
        arrived.append(ok)
    ok = np.array(arrived)
    entered = f"{np.mean(again):.2f}" if again else "none stopped"
    share = " | ".join(f"{part.mean():.2f}" for part in (ok[:, :3], ok, ok[:, -5:]))
    print(f"| {name} | {share} | {entered} | {np.max(seconds):.2f} |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("quick", nargs="?", choices=["quick"])
    parser.add_argument("--data")
    parser.add_argument("--worlds", nargs="*", default=WORLDS)
    parser.add_argument("--unseen", type=int, default=5000)
    parser.add_argument("--missions", type=int, default=15)
    parser.add_argument("--policy")
    parser.add_argument("--max-failure", type=float)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    options = {} if given.policy is None else {"policy": given.policy}
    if given.max_failure is not None:
        options["max_failure"] = given.max_failure
    names = [n for n in given.worlds if given.data or n.startswith("synthetic")]
    n_unseen, courses = (300, COURSES[:1]) if given.quick else (given.unseen, COURSES)
    made = {name: world_of(name, given.data) for name in names}
    print(
        "random missions; after 0, 15 and 60: skill by bound, by mission, error of reliability, s"
    )
    print("\n| world | missions fail | bounds fail |" + " skill | mission | error | s |" * 3)
    print("|---|" + "---:|" * 14)
    tables = {}
    for name, (world, simulator) in made.items():
        tables[name] = learn(name, world, simulator, n_unseen)
    print("\nreliability after 15 missions: missions, predicted and observed share that arrives\n")
    for name, rows in tables.items():
        cells = "; ".join(f"{n}: {p:.2f} {a:.2f}" for _, n, p, a in rows)
        print(f"- {name}: {cells}")
    print("\ncampaigns: share that arrives, first 3, all, last 5; later plans over a bound that")
    print("stopped a robot; slowest fit of the hazard, s\n")
    print("| world | first 3 | all | last 5 | entered again | s |\n|---|---:|---:|---:|---:|---:|")
    started = time.perf_counter()
    for name, (world, simulator) in made.items():
        campaigns(name, world, simulator, courses, given.missions, options)
    print(f"\n{time.perf_counter() - started:.0f} s of campaigns")


if __name__ == "__main__":
    main()
