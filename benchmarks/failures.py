"""Predicted and actual failures of plans: the table of docs/failures.md, in Markdown.

    python benchmarks/failures.py [part ...] --data DIR --out out/failures

The worlds have tight slope limits and are named terrain:limit:excess. The assumed limit is the true
limit plus the excess, in degrees. With an excess of 0, the hazard model has the right limit. With a
larger excess, some bounds that seem passable stop the robots.

The part `reliability` evaluates the plans before missions 1, 2, 3, 5 and 15 of a campaign. It
compares their predicted arrival probability with the fraction of simulated runs that arrive.
`product` is the product of 1 - p_fail over the bounds. Each campaign has a file in --out, so the
script can be resumed. --jobs sets the number of processes.

The part `separation` simulates all bounds with all next moves in the worlds whose slope limit is 2
degrees too high, and prints how well several measures of tilt separate the bounds that fail from
the others.

The part `price` prints the failure probability of plans on wellington, computed from the product of
means, from components, and from all draws.
"""

import dataclasses
import json
import multiprocessing
import warnings
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from pathlib import Path

import numpy as np
from common import Table, arguments, parsed
from world_set import COURSES, World, worlds

import trustbo as tb
from trustbo.hazard import Hazard
from trustbo.hazard.given import GivenRisk
from trustbo.simulation import KinematicSimulator
from trustbo.simulation.replicates import replicated
from trustbo.workspace.difficulty import MEASURES
from trustbo.workspace.moves import END, MOVES, pairs_along

GROUNDS = (("topography", 18), ("tahoe", 18), ("synthetic-0", 14), ("wellington", 38))
WORLDS = [f"{ground}:{limit}:{excess}" for ground, limit in GROUNDS for excess in (0, 2, 4)]
ASKED = (1, 2, 3, 5, 15)
"""Numbers of the missions whose plans are evaluated."""


def world_of(name, data):
    """Make the world with the assumed slope limit, and the simulator with the true limit."""
    ground, limit, excess = name.split(":")
    assumed, team = (climbing(float(limit) + more) for more in (float(excess), 0.0))
    world = World(name, "slopes", ground, team=assumed, data=data)
    simulator = KinematicSimulator(world.workspace(), terrain=world.true_terrain(), team=team)
    return world, simulator


def climbing(degrees):
    """Make a team of robots with this slope limit in degrees."""
    robot = tb.Robot(max_slope=float(np.deg2rad(degrees)))
    return tb.Team(robots=(robot,) * 3, lead=robot)


def judged_plans(world, simulator, course, seed, given):
    """Compute predicted arrival probabilities of plans, and the fraction of runs that arrive."""
    campaign, gathered = tb.Campaign(
        simulator.workspace, *world.ends(course), sampler="importance", seed=seed
    ), []  # fmt: skip
    for number in range(1, max(ASKED) + 1):
        plan = campaign.ask()
        if number in ASKED:
            runs = [simulator.run(plan.path, seed=20_000 + run) for run in range(given.runs)]
            gathered.append(
                {
                    "mission": number,
                    "p_arrive": plan.p_arrive,
                    "product": float(np.prod(1.0 - plan.p_fail)),
                    "arrived": float(np.mean([run.status == "ok" for run in runs])),
                    "k_hat": campaign.hazard.attrs["k_hat"],
                    "seconds": campaign.hazard.attrs["seconds"],
                }
            )
        if number < max(ASKED):
            mission = simulator.run(plan.path, seed=campaign.state.seed_of("mission"))
            campaign.tell(mission, again=True)  # robots may get stuck in the same way twice
    return gathered


def judge_course(name, course, given):
    """Return the evaluated plans of a course, keyed by seed; run campaigns without a file."""
    warnings.simplefilter("ignore")
    folder, gathered, built = Path(given.out) / "reliability", {}, None
    folder.mkdir(parents=True, exist_ok=True)
    for seed in range(given.seeds):
        file = folder / f"{name.replace(':', '_')}_{course}_{seed}.json"
        if not file.exists():
            built = built or world_of(name, given.data)
            rows = judged_plans(*built, course, seed, given)
            file.write_text(json.dumps(rows) + "\n")
        gathered[seed] = json.loads(file.read_text())
    return gathered


def reliability(names, given):
    """Return the evaluated plans of all campaigns, keyed by world and course."""
    tasks = [(name, course) for name in names for course in given.courses]
    if given.jobs == 1:
        return {task: judge_course(*task, given) for task in tasks}
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(given.jobs, mp_context=context) as pool:
        jobs = {task: pool.submit(judge_course, *task, given) for task in tasks}
        return {task: job.result() for task, job in jobs.items()}


def print_reliability(gathered):
    """Print means by mission and excess, with 95 % bootstrap intervals over worlds and courses."""
    rng, judged = np.random.default_rng(0), []
    for (name, _), campaigns in gathered.items():
        rows = np.array(
            [
                [[row[k] for k in ("p_arrive", "product", "arrived")] for row in one]
                for one in campaigns.values()
            ]
        )
        p, product, arrived = np.moveaxis(rows, -1, 0)  # each (seed, mission)
        brier = (p - arrived) ** 2 + arrived * (1.0 - arrived)
        means = np.stack([p, product, arrived, p - arrived, brier]).mean(1)
        judged.append((name.split(":")[2], means))
    print()
    head = "excess", "mission", "predicted", "product", "arrived", "predicted - arrived", "Brier"
    table = Table(*head)
    for excess in dict.fromkeys(which for which, _ in judged):
        own = np.array([means for which, means in judged if which == excess])
        if not len(own):
            continue
        again = own[rng.integers(len(own), size=(2000, len(own)))].mean(1)
        low, high = np.quantile(again, [0.025, 0.975], axis=0)
        for k, mission in enumerate(ASKED):
            cells = [
                f"{own.mean(0)[i, k]:.3f} ({low[i, k]:.3f} to {high[i, k]:.3f})" for i in range(5)
            ]
            table.row(excess, mission, *cells)
    rows = [row for seeds in gathered.values() for one in seeds.values() for row in one]
    k_hat, seconds = (max(row[name] for row in rows) for name in ("k_hat", "seconds"))
    refused = np.mean([row["k_hat"] > 0.7 for row in rows])
    print(f"\nlargest k-hat {k_hat:.2f}, refused {refused:.1%}; slowest fit {seconds:.2f} s")


PRIORS = {
    "N(1, 4²)": Hazard(margin=(1.0, 4.0), doubt=(0.0, 4.0)),
    "N(0, .5²), N(0, 4²)": Hazard(),
}
"""Priors of the margin: the prior of version 0.3, and the default."""


def print_price():
    """Print the failure probability of plans before any mission and after one failure."""
    table = Table("prior of the margin", "course", "plan", "product", "five components", "draws")
    workspace = tb.Workspace.from_terrain(tb.terrain.example(), (10, 10), tb.Team())
    courses = {"sw-ne": ((9, 0), (0, 9)), "nw-se": ((0, 0), (9, 9))}
    for (prior, hazard), (course, ends) in product(PRIORS.items(), courses.items()):
        campaign = tb.Campaign(workspace, *ends, hazard=hazard)
        path = campaign.ask().path
        table.row(prior, course, "first", *chances(campaign.risk, path))
        campaign.fail("stuck", where=path[len(path) // 2])
        path = campaign.ask().path
        table.row(prior, course, "after one failure", *chances(campaign.risk, path))


def chances(risk, path):
    """Compute the failure probability of a path from means, components, and 20 000 draws."""
    risks = GivenRisk(risk.mean), GivenRisk(risk.mean, components=risk.components())
    joint = [one.failure(path) for one in risks]
    drawn = risk.draw(20_000, seed=1)[:, *pairs_along(path, 1).T]
    return [f"{p:.3f}" for p in (*joint, 1.0 - np.prod(1.0 - drawn, axis=1).mean())]


LOOKAHEADS = (0.5, 3.0)
"""True look-aheads, m, of robots for which 1.5 m is assumed."""


def print_separation(given):
    """Print the area under the ROC curve of the predicted tilt as a sign of failure, by world.

    The tilt is that of the route, as in version 0.4, or that of the driven curve, and that of the
    true next move, or that of the next move in the same direction. An area of .5 means that it says
    nothing about failures.
    """
    chosen = [w for w in worlds(given.data).values() if w.case == "limit-2"]
    chosen = [world for world in chosen if given.data or world.is_packaged]
    columns = ["route, straight on", "route", "curve, straight on", "curve"]
    others = [f"curve, {ahead:g} m" for ahead in LOOKAHEADS]
    table = Table("world", "passed", *columns, *others)
    areas = []
    for world in chosen[: 1 if given.quick else None]:
        simulator = world.simulator(world.workspace())
        passed = share_passed(simulator)
        curve = simulator.workspace.difficulty.whole().values[..., MEASURES.index("tilt")]
        route = route_tilts(simulator.workspace, np.isfinite(passed))
        of_world = [
            area_under(tilt, passed)
            for tilt in (straight_on(route), route, straight_on(curve), curve)
        ]
        for ahead in LOOKAHEADS:
            team = world.team
            robot = dataclasses.replace(team.lead, lookahead=ahead)
            other = dataclasses.replace(team, lead=robot, robots=(robot,) * team.n_robots)
            simulator = dataclasses.replace(world, team=other).simulator(simulator.workspace)
            of_world.append(area_under(curve, share_passed(simulator)))
        areas.append(of_world)
        table.row(world.name, f"{np.nanmean(passed):.3f}", *(f"{a:.3f}" for a in of_world))
    table.row("mean", "", *(f"{a:.3f}" for a in np.mean(areas, axis=0)))


def share_passed(simulator, n=4):
    """Simulate all bounds; return the share that passed, (move, row, col, next_move)."""
    return replicated(simulator, 0, n, seed=5)["passed"].values


def straight_on(tilt):
    """Give all next moves of a bound the tilt of the one in the same direction, or of the end."""
    same = np.stack([tilt[m, ..., m] for m in range(len(MOVES))])
    same = np.where(np.isfinite(same), same, tilt[..., END])
    return np.broadcast_to(same[..., None], tilt.shape)


def route_tilts(workspace, exists):
    """Compute the largest tilt on the robots' routes, averaged over 1 m, as in version 0.4."""
    posts = workspace.posts
    tilts, known = np.full(exists.shape, np.nan), {}
    for m, row, col, after in np.argwhere(exists).tolist():
        cell, left = (row, col), (row - MOVES[m][0], col - MOVES[m][1])
        ahead = None if after == END else (row + MOVES[after][0], col + MOVES[after][1])
        worst = 0.0
        for route in posts.bound_routes(left, cell, ahead):
            key = route.tobytes()
            if key not in known:
                known[key] = route_tilt(posts.surface, route)
            worst = max(worst, known[key])
        tilts[m, row, col, after] = worst
    return tilts


def route_tilt(surface, route, step=0.25, ahead=1.5, n=4):
    """Largest tangent of pitch or roll on one route, if the robot faces a point 1.5 m ahead."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(route, axis=0).T))])
    s = np.arange(0.0, along[-1] + 1e-9, step)
    here, there = (
        np.stack([np.interp(at, along, axis) for axis in route.T]) for at in (s, s + ahead)
    )
    heading = np.arctan2(*(there - here)[::-1])
    east, north = np.cos(heading), np.sin(heading)
    gx, gy = surface.gradient[:, *surface.nearest(*here)]
    tilt = np.maximum(np.abs(gx * east + gy * north), np.abs(gy * east - gx * north))
    n = min(n, len(tilt))
    return np.convolve(tilt, np.full(n, 1.0 / n), mode="valid").max()


def area_under(tilt, passed):
    """Probability that a bound that failed has a larger tilt than one that passed."""
    known = np.isfinite(tilt) & np.isfinite(passed)
    values, index = np.unique(tilt[known], return_inverse=True)
    share = passed[known]
    fails, passes = (np.bincount(index, w, len(values)) for w in (1.0 - share, share))
    below = np.cumsum(passes) - 0.5 * passes
    return float(fails @ below / (fails.sum() * passes.sum()))


def main():
    parser = arguments(
        __doc__, names=["reliability", "separation", "price"], data=True, seeds=3,
        out="out/failures",
        quick="one course, one seed and ten runs per plan",
    )  # fmt: skip
    parser.add_argument("--worlds", nargs="*", default=WORLDS)
    parser.add_argument("--courses", nargs="*", default=COURSES, choices=COURSES)
    parser.add_argument("--runs", type=int, default=50, help="runs per plan (part reliability)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (part reliability)")
    given = parsed(parser)
    warnings.simplefilter("ignore")
    if given.quick:
        given.out, given.courses = f"{given.out}-quick", given.courses[:1]
        given.seeds, given.runs = 1, 10
    Path(given.out).mkdir(parents=True, exist_ok=True)
    names = [n for n in given.worlds if given.data or n.startswith("synthetic")]
    if "price" in given.names:
        print_price()
    if "separation" in given.names:
        print_separation(given)
    if "reliability" in given.names:
        print_reliability(reliability(names, given))


if __name__ == "__main__":
    main()
