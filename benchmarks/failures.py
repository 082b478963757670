"""Failures: the table of docs/failures.md, in Markdown.

    python benchmarks/failures.py [part ...] --data DIR --out out/failures

Worlds with tight slope limits, named ground:limit:excess. The assumed limit is the true one plus
the excess, in degrees: 0, geometry knows all that it can; above, ways lead over ground that stops
robots; `aged`, the limit is right and the DEM an old one. Each part of a world is kept in a file of
its own in --out; called again, it goes on where it stopped. --csv writes the bins of reliability.

The part `reliability` compares the chance to arrive that a campaign's plan has before missions 1,
2, 5 and 15 with the share of runs of that plan which arrive. It has a file for each campaign:
--jobs processes share the courses. With the source of another version in PYTHONPATH and another
--out, it measures that version; `product` is of 1 - p_fail, all that 0.2 knew.

The part `price` prints the chance to fail by which a plan on wellington is priced: by the product
of means, by strata, and by all draws.
"""

import csv
import json
import multiprocessing
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from common import Table, arguments, parsed, timed
from scipy import sparse

import trustbo as tb
from trustbo.hazard import Hazard, fit_hazard
from trustbo.hazard.exposures import CAUSES
from trustbo.hazard.risk import BoundRisk, Risk
from trustbo.planning.path_sampling import path_sampler
from trustbo.simulation import KinematicSimulator, Truth
from trustbo.study.world import COURSES, World
from trustbo.workspace.moves import bounds_along, moves_along

GROUNDS = (("topography", 18), ("tahoe", 18), ("synthetic-0", 14), ("wellington", 38))
WORLDS = [f"{ground}:{limit}:{excess}" for ground, limit in GROUNDS for excess in (0, 4, 8, "aged")]
LEAST = 100
"""Missions in a bin of predicted chances from which on its reliability counts."""
SAFE = 0.9
"""Share of missions that arrive on a safe path."""
LIMITS = (0.05, 0.1, 0.2)
REFERENCE = Path(__file__).parent / "reference" / "failures_0.3.csv"
"""Reliability by version 0.3, 20 runs of each plan of two campaigns a course."""
ASSUMED = {"0": "the true limit", "4": "4 degrees more", "both": "both"}
"""Names of its excess in the reference."""
ASKED = (1, 2, 5, 15)
"""Missions before which the reliability of the plan is judged."""


def world_of(name, data):
    """World with the assumed slope limit, and the simulator of the true one."""
    ground, limit, excess = name.split(":")
    kind, more = ("aged", 0.0) if excess == "aged" else ("slopes", float(excess))
    assumed, team = (climbing(float(limit) + excess) for excess in (more, 0.0))
    world = World(name, kind, ground, team=assumed, aged=kind == "aged", data=data)
    return world, KinematicSimulator(world.workspace(), terrain=world.true_terrain(), team=team)


def climbing(degrees):
    """Team of robots that stand a slope."""
    robot = tb.Robot(max_slope=float(np.deg2rad(degrees)))
    return tb.Team(robots=(robot,) * 3, lead=robot)


def random_missions(workspace, simulator, ends, n, seed):
    """Missions over random paths of up to four bounds more than the fewest, all equally likely."""
    rng = np.random.default_rng(seed)
    sampler = path_sampler(tb.planning.Planner(workspace, *ends).paths)
    return [simulator.run(sampler.draw(rng), seed=int(rng.integers(2**31))) for _ in range(n)]


def outcomes(missions):
    """Bounds that were begun, (bound, 3), whether each failed, and whether missions arrived."""
    rows = [bounds_along(np.array(m.path[: len(m.bounds) + 1])) for m in missions]
    failed = [bound.status in CAUSES for mission in missions for bound in mission.bounds]
    arrived = np.array([mission.status == "ok" for mission in missions])
    return np.concatenate(rows), np.array(failed), arrived


def p_arrive(p_fail, missions):
    """Chance to arrive over each mission's path, (..., mission), of chances (..., 8, row, col)."""
    shape = p_fail.shape[-3:]
    paths = [bounds_along(np.array(mission.path)) for mission in missions]
    flat = np.concatenate([np.ravel_multi_index(tuple(path.T), shape) for path in paths])
    row = np.repeat(np.arange(len(paths)), [len(path) for path in paths])
    met = sparse.csr_matrix((np.ones(len(row)), (row, flat)), (len(paths), int(np.prod(shape))))
    log = np.log1p(-np.minimum(np.nan_to_num(p_fail), 1.0 - 1e-12)).reshape(-1, np.prod(shape))
    return np.exp(met @ log.T).T.reshape(*p_fail.shape[:-3], -1)


def skill(predicted, happened):
    """Brier skill over the rate of what is judged."""
    base = np.mean((happened - happened.mean()) ** 2)
    return float(1.0 - np.mean((happened - predicted) ** 2) / base) if base > 0.0 else np.nan


def learn(world, simulator, given):
    """Random missions: skill by bound, and reliability by bin, after 15 and 60 of them."""
    workspace, gathered = simulator.workspace, {"failed": [], "15": [], "60": [], "bins": {}}
    n_unseen, n_sets = given.unseen // len(given.courses), 1 if given.quick else 3
    bins = {n: np.zeros((2, 10, 3)) for n in (15, 60)}  # (mean of draws or chances, bin, sum)
    for c, course in enumerate(given.courses):
        ends = world.ends(course)
        unseen = random_missions(workspace, simulator, ends, n_unseen, seed=1000 + c)
        bounds, failed, arrived = outcomes(unseen)
        gathered["failed"].append(1.0 - float(arrived.mean()))
        for j in range(n_sets):
            seen = random_missions(workspace, simulator, ends, 60, seed=100 * c + j)
            for n in (15, 60):
                risk = BoundRisk.of(fit_hazard(seen[:n], workspace), workspace)
                gathered[str(n)].append((c, skill(risk.mean[*bounds.T], failed)))
                drawn = p_arrive(risk.draw(200, seed=1), unseen).mean(0)
                for i, chance in enumerate((drawn, p_arrive(risk.mean, unseen))):
                    which = np.minimum((10.0 * chance).astype(int), 9)
                    for k, values in enumerate((np.ones(n_unseen), chance, arrived)):
                        bins[n][i, :, k] += np.bincount(which, values, minlength=10) / n_sets
    return gathered | {"bins": {str(n): bins[n].tolist() for n in bins}}


def safe_paths(world, simulator, given):
    """Share of 100 missions that arrive on the safest path, by course and by its class."""
    truth, gathered = Truth.of(simulator, standard_error=0.05), {}
    data = truth.bounds.data
    fails = np.clip(1.0 - data["outcome"].sel(status="ok").values, 0.0, 1.0 - 1e-9)
    # The best path by this contact has the least sum of -log(1 - p).
    contact = np.broadcast_to(1.0 + np.log1p(-fails), data["contact"].shape)
    table = replace(truth.bounds, data=data.assign(contact=data["contact"].copy(data=contact)))
    for course in given.courses:
        ends, shares = world.ends(course), []
        for most in ("shortest+4", "shortest+12"):
            planner = tb.planning.Planner(simulator.workspace, *ends, max_bounds=most)
            path = table.best(planner.paths, "lost_contact")
            runs = [simulator.run(path, seed=seed) for seed in range(100)]
            shares.append(float(np.mean([run.status == "ok" for run in runs])))
        gathered[course] = shares
    return gathered


def one_campaign(world, simulator, course, n_missions, options, n_after=0):
    """Outcomes of a campaign, of its later plans, and of runs of its next plan."""
    campaign = tb.Campaign(
        simulator.workspace, *world.ends(course), sampler="exact", **options
    )  # fmt: skip
    ok, again, stopped, seconds = [], [], set(), []
    for _ in range(n_missions):
        plan = campaign.ask()
        bounds = set(zip(plan.path[:-1], plan.path[1:], strict=True))
        if stopped:
            again.append(bool(bounds & stopped))
        mission = simulator.run(plan.path, seed=campaign.seed_of("mission"))
        campaign.tell(mission)
        seconds.append(campaign.hazard.attrs["seconds"])
        ok.append(mission.status == "ok")
        if not ok[-1]:
            k = len(mission.bounds)
            stopped.add((plan.path[k - 1], plan.path[k]))
    gathered = {"ok": ok, "again": again, "seconds": max(seconds)}
    if n_after:
        plan = campaign.ask()
        runs = [simulator.run(plan.path, seed=10_000 + seed) for seed in range(n_after)]
        failed = float(np.mean([run.status != "ok" for run in runs]))
        gathered |= {"p_arrive": plan.p_arrive, "failed": failed}
    return gathered


def campaigns(world, simulator, given):
    """Campaigns with the defaults, or with the options given."""
    options = {} if given.policy is None else {"policy": given.policy}
    return {
        course: one_campaign(world, simulator, course, given.missions, options)
        for course in given.courses
    }


def limits(world, simulator, given):
    """Failures of the plan after 8 missions under each `max_failure`."""
    return {
        str(most): {
            course: one_campaign(world, simulator, course, 8, {"max_failure": most}, given.after)
            for course in given.courses
        }
        for most in LIMITS
    }


def judged_plans(world, simulator, course, seed, given):
    """Chance to arrive of a campaign's plans, and the share of runs of each that arrive."""
    campaign, gathered = tb.Campaign(
        simulator.workspace, *world.ends(course), sampler="exact", seed=seed
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
            mission = simulator.run(plan.path, seed=campaign.seed_of("mission"))
            campaign.tell(mission)
    return gathered


def judge_course(name, course, given):
    """Campaigns of a course, those that the folder lacks run now, by seed."""
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
    """Judged plans of all campaigns, by world and course."""
    tasks = [(name, course) for name in names for course in given.courses]
    if given.jobs == 1:
        return {task: judge_course(*task, given) for task in tasks}
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(given.jobs, mp_context=context) as pool:
        jobs = {task: pool.submit(judge_course, *task, given) for task in tasks}
        return {task: job.result() for task, job in jobs.items()}


PARTS = {"safe": safe_paths, "campaigns": campaigns, "learn": learn, "limits": limits}


def measure(name, given):
    """Results of a world by part, those that the folder lacks found now."""
    file = Path(given.out) / f"{name.replace(':', '_')}.json"
    kept = json.loads(file.read_text()) if file.exists() else {}
    if missing := [part for part in given.parts if part not in kept]:
        world, simulator = world_of(name, given.data)
        for part in missing:
            seconds, kept[part] = timed(lambda p=part: PARTS[p](world, simulator, given))
            print(f"{name} {part}: {seconds:.0f} s", flush=True)
            file.write_text(json.dumps(kept) + "\n")
    return kept


def shown(values):
    return f"{np.mean(values):.2f}" if len(values) else "-"


def print_campaigns(results):
    print()
    table = Table(
        "world", "safe path", "first 3", "all 15", "last 5", "entered again", "slowest fit, s"
    )
    whole = []
    for name, gathered in results.items():
        safe = gathered.get("safe", {course: (1.0, 1.0) for course in gathered["campaigns"]})
        kept = [c for c in gathered["campaigns"] if safe[c][0] >= SAFE]
        far = sum(safe[c][1] >= SAFE for c in safe) - len(kept)
        runs = [gathered["campaigns"][c] for c in kept]
        ok = np.array([run["ok"] for run in runs]).reshape(len(runs), -1)
        again = [entered for run in runs for entered in run["again"]]
        whole += [(ok, again)] if kept else []
        longer = f" (+{far})" if far else ""
        parts = [shown(part.ravel()) for part in (ok[:, :3], ok, ok[:, -5:])]
        slowest = max(run["seconds"] for run in gathered["campaigns"].values())
        safe_of = f"{len(kept)} of {len(safe)}{longer}"
        table.row(name, safe_of, *parts, shown(again), f"{slowest:.2f}")
    ok = np.concatenate([ok for ok, _ in whole])
    again = [entered for _, part in whole for entered in part]
    parts = [shown(part.ravel()) for part in (ok[:, :3], ok, ok[:, -5:])]
    table.row("all", len(ok), *parts, shown(again), "")


def print_learning(results, file):
    print()
    head = "world", "missions fail", "skill after 15", "after 60", "error after 15", "after 60"
    table = Table(*head)
    lines, total = ["world,missions,bin,n,predicted,arrived"], {}
    for name, gathered in results.items():
        learnt = gathered["learn"]
        often = [c for c, share in enumerate(learnt["failed"]) if share > 0.2]
        # No skill is defined on a course all of whose missions fail at the first bound.
        cells = [shown([s for c, s in learnt[n] if c in often and s == s]) for n in ("15", "60")]
        for n in ("15", "60"):
            bins = np.array(learnt["bins"][n])
            total[n] = total.get(n, 0.0) + bins
            cells.append(f"{error_of(bins[0]):.2f}")
            for b, (count, predicted, arrived) in enumerate(bins[0]):
                if count > 0.0:
                    shares = f"{predicted / count:.4f},{arrived / count:.4f}"
                    lines.append(f"{name},{n},{b},{count:.0f},{shares}")
        table.row(name, f"{np.mean(learnt['failed']):.2f}", *cells)
    for i, what in enumerate(("mean over draws", "at the posterior mean")):
        errors = [f"{error_of(bins[i]):.2f}" for bins in total.values()]
        table.row(f"all, {what}", "", "", "", *errors)
    if file is not None:
        Path(file).write_text("\n".join(lines) + "\n")


def error_of(bins):
    """Largest difference of the shares predicted and observed in a bin with enough missions."""
    n, predicted, arrived = bins[bins[:, 0] >= LEAST].T
    return float(np.max(np.abs(predicted - arrived) / n, initial=0.0))


def print_limits(results):
    print()
    head = "max_failure", "plans within it", "predicted failures", "realised", "others: realised"
    table = Table(*head)
    for most in LIMITS:
        runs = [run for r in results.values() for run in r["limits"][str(most)].values()]
        held = [run for run in runs if 1.0 - run["p_arrive"] <= most + 1e-9]
        other = [run["failed"] for run in runs if run not in held]
        cells = shown([1.0 - r["p_arrive"] for r in held]), shown([r["failed"] for r in held])
        table.row(most, f"{len(held)} of {len(runs)}", *cells, shown(other))


def print_reliability(gathered):
    """Means by mission and excess; intervals, 95 %, are bootstraps over courses of worlds.

    Those of version 0.3 are of all four grounds and courses, whichever were run now.
    """
    with REFERENCE.open(newline="") as stream:
        before = {(r["assumed"], int(r["before mission"])): r for r in csv.DictReader(stream)}
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
    old = "predicted", "arrive", "difference", "Brier"
    table = Table(*head, *(f"{name}, 0.3" for name in old))
    for excess in ("0", "4", "both"):
        own = np.array([means for which, means in judged if excess in (which, "both")])
        if not len(own):
            continue
        again = own[rng.integers(len(own), size=(2000, len(own)))].mean(1)
        low, high = np.quantile(again, [0.025, 0.975], axis=0)
        for k, mission in enumerate(ASKED):
            cells = [
                f"{own.mean(0)[i, k]:.3f} ({low[i, k]:.3f} to {high[i, k]:.3f})" for i in range(5)
            ]
            of_old = before[ASSUMED[excess], mission]
            table.row(excess, mission, *cells, *(of_old[name] for name in old))
    rows = [row for seeds in gathered.values() for one in seeds.values() for row in one]
    k_hat, seconds = (max(row[name] for row in rows) for name in ("k_hat", "seconds"))
    refused = np.mean([row["k_hat"] > 0.7 for row in rows])
    print(f"\nlargest k-hat {k_hat:.2f}, refused {refused:.1%}; slowest fit {seconds:.2f} s")


PRIORS = {
    "N(1, 4²)": Hazard(margin=(1.0, 4.0), doubt=(0.0, 4.0)),
    "N(0, .5²), N(0, 4²)": Hazard(),
}
"""Priors of the margin: that of version 0.3, and the default."""


def print_price():
    """Chance to fail of plans before any mission and after one failure, by three roads."""
    table = Table("prior of the margin", "course", "plan", "product", "five strata", "draws")
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
    """Chance that a path fails: product of means, strata, and mean over 20 000 draws."""
    joint = [Risk(risk.mean, strata=strata).priced(path) for strata in (None, risk.strata())]
    rows, cols = np.array(path[1:]).T
    drawn = risk.draw(20_000, seed=1)[:, moves_along(path), rows, cols]
    return [f"{p:.3f}" for p in (*joint, 1.0 - np.prod(1.0 - drawn, axis=1).mean())]


def main():
    parser = arguments(
        __doc__, names=[*PARTS, "reliability", "price"], data=True, seeds=3, out="out/failures",
        quick="one course and few missions of each world",
    )  # fmt: skip
    parser.add_argument("--csv", help="file of the bins of reliability")
    parser.add_argument("--worlds", nargs="*", default=WORLDS)
    parser.add_argument("--courses", nargs="*", default=COURSES, choices=COURSES)
    parser.add_argument("--unseen", type=int, default=5000)
    parser.add_argument("--missions", type=int, default=15)
    parser.add_argument("--after", type=int, default=200)
    parser.add_argument("--policy")
    parser.add_argument("--runs", type=int, default=50, help="runs of a plan, reliability")
    parser.add_argument("--jobs", type=int, default=1, help="processes, reliability")
    given = parsed(parser)
    warnings.simplefilter("ignore")
    if given.quick:
        given.out, given.unseen, given.courses = f"{given.out}-quick", 300, given.courses[:1]
        given.seeds, given.runs = 1, 10
    Path(given.out).mkdir(parents=True, exist_ok=True)
    names = [n for n in given.worlds if given.data or n.startswith("synthetic")]
    if "price" in given.names:
        print_price()
    if "reliability" in given.names:
        print_reliability(reliability([n for n in names if n.split(":")[2] in ("0", "4")], given))
    given.parts = [part for part in given.names if part in PARTS]
    results = {name: measure(name, given) for name in names}
    if "campaigns" in given.parts:
        print_campaigns(results)
    if "learn" in given.parts:
        print_learning(results, given.csv)
    if "limits" in given.parts:
        print_limits(results)


if __name__ == "__main__":
    main()
