"""Verdicts of criticise: is a planted fault named, and is none where there is none?

Run: python benchmarks/criticism.py [part ...] [-n 100] [--seeds 10] [--quick] [--out DIR]

Two parts; each goes on where its files in out/criticism, by default, end.

`drawn`: -n data sets of each fault of a pooled truth: a synthetic workspace of 10 x 10 cells, 3
robots with awareness of their own, 15 missions of 11 bounds between two corners, rates clipped to
[0, 1], which is rare. PooledTrust() is fitted by the exact sampler.

`simulated`: --seeds campaigns of the kinematic simulator of each case, four times as many healthy
ones: 9 missions over random paths through 8 x 8 cells of synthetic terrains, the maps of every
other one out of date; PooledTrust with effects of places and robots. The healthy ones named
`optimistic` have a campaign's paths. Posteriors are kept, and judged again at each call.

Columns: share of data sets with a verdict, and with the right one: the planted cause, and of
simulated ones with its robot and missions too; with 95 % intervals of Wilson; median seconds
of criticise; and all verdicts.
"""

import json
import re
from collections import Counter
from dataclasses import replace

import numpy as np
import xarray as xr
from common import Table, add_record, arguments, parsed, read_records, timed
from scipy import ndimage
from scipy.stats import binomtest

import trustbo as tb
from trustbo import Mission
from trustbo.criticism import criticise
from trustbo.inference import fit
from trustbo.models import PlaceEffect, PooledTrust, RobotEffect
from trustbo.models.place import matern
from trustbo.planning.policies import random_path
from trustbo.simulation import Degradation, Dust, KinematicSimulator
from trustbo.study.world import COURSES, World

SHAPE, N_MISSIONS, N_ROBOTS = (10, 10), 15, 3
FEATURES = ("traversability", "visibility", "line_of_sight")
FAULTS = {
    "none": "none",
    "place": "place",
    "robot": "robot in a mission",
    "weights of a robot": "robot in a mission",
    "saturation": "curvature",
    "turning point": "curvature",
    "wrong sign": "prior",
    "correlated robots": "correlation",
    "correlated bounds": "correlation",
}
"""Name that criticise should find for each fault."""
BENDS = {
    "saturation": lambda sight: np.minimum(1.5 * sight, 0.75),
    "turning point": lambda sight: 1.0 - np.abs(2.0 * sight - 1.0),
}
"""Responses to line of sight that are not its multiples."""


def awareness_maps(rng):
    """Smooth fields in [0, 1] that robots share in part, (robot, row, col, feature)."""
    own, shared = (rng.standard_normal((n, *SHAPE, len(FEATURES))) for n in (N_ROBOTS, 1))
    field = ndimage.gaussian_filter(shared + 0.7 * own, (0, 1.0, 1.0, 0))
    ranks = field.reshape(N_ROBOTS, -1, len(FEATURES)).argsort(1).argsort(1)
    return (ranks / (SHAPE[0] * SHAPE[1] - 1)).reshape(field.shape)


def draw_path(rng):
    moves = np.array([(-1, 1)] * 7 + [(-1, 0)] * 2 + [(0, 1)] * 2)
    return [(9, 0), *map(tuple, np.array([9, 0]) + np.cumsum(rng.permutation(moves), axis=0))]


def draw_missions(fault, rng):
    """Missions of a truth with a fault."""
    maps, beta0 = awareness_maps(rng), rng.uniform(0.3, 0.6)
    slopes = np.array([*rng.uniform(-0.02, 0.12, 2), rng.uniform(0.5, 0.8)])
    if fault == "wrong sign":
        slopes[2] *= -1.0
    level = 0.5 - 0.5 * slopes.sum()
    dw, dv = rng.uniform(0.03, 0.07, 2)
    rows, cols = (each.ravel() for each in np.indices(SHAPE))
    K = matern(np.hypot(np.subtract.outer(rows, rows), np.subtract.outer(cols, cols)), 2.0)
    cells = 0.06 * np.linalg.cholesky(K + 1e-9 * np.eye(len(K))) @ rng.standard_normal(len(K))
    bounds = 0.06 * rng.standard_normal((3, 3, *SHAPE))
    odd, side = rng.integers(N_ROBOTS), rng.choice([-1.0, 1.0])
    missions = []
    for _ in range(N_MISSIONS):
        path = draw_path(rng)
        z = np.array([maps[:, r, c] for r, c in path[1:]])
        response = z @ slopes + level
        if fault in BENDS:
            response = response + slopes[2] * (BENDS[fault](z[..., 2]) - z[..., 2])
        if fault == "weights of a robot":  # as of a poor detector
            response[:, odd] *= 0.7
        drift = (1.0 - beta0) * response
        if fault == "robot":
            drift[:, odd] += side * 0.06
        x, rates = 0.5 + 0.15 * rng.standard_normal(N_ROBOTS), []
        v = rng.standard_normal(N_ROBOTS)
        for k in range(len(z)):
            (r0, c0), (r1, c1) = path[k], path[k + 1]
            w, shock = rng.standard_normal(N_ROBOTS), rng.standard_normal(2)
            new = rng.standard_normal(N_ROBOTS)
            v = 0.8 * v + 0.6 * new if fault == "correlated bounds" else new
            noise = v
            if fault == "correlated robots":
                w, noise = (np.sqrt(0.5) * (a + s) for a, s in zip((w, v), shock, strict=True))
            x = beta0 * x + drift[k] + dw * w
            if fault == "place":
                x = x + cells[r1 * SHAPE[1] + c1] + bounds[r1 - r0, c1 - c0, r1, c1]
            rates.append(x + dv * noise)
        rates = np.clip(rates, 0.0, 1.0)
        missions.append(Mission.from_arrays(path, z, rates, features=FEATURES))
    return missions


N_SIMULATED, START = 9, 5
"""Missions of a simulated campaign, and the one from which on a fault lasts."""
MODEL = PooledTrust(effects=[PlaceEffect(), RobotEffect()])
CASES = {
    "healthy": lambda robot: (),
    "optimistic": lambda robot: (),
    "robot dead": lambda robot: (Degradation(robot, 0.0, START),),
    "robot poor": lambda robot: (Degradation(robot, 0.6),),
    "two bad days": lambda robot: tuple(Degradation(robot, 0.3, j, j) for j in (2, 6)),
    "dust": lambda robot: (Dust(0.5, START),),
    "sign": lambda robot: (),
}
"""Events of each case, given a robot's name."""
SEEDS = {"healthy": lambda n: range(4 * n), "optimistic": lambda n: range(40, 40 + n)}
"""Seeds of cases other than range(n)."""


def simulated(case, seed):
    """Posterior of a simulated campaign, with the robot of its fault."""
    world = World("", "", f"synthetic-{seed % 5}", aged=seed % 2 == 1, shape=(8, 8))
    ws, ends, rng = (
        world.workspace(),
        world.ends(COURSES[seed % 4]),
        np.random.default_rng([seed, 1]),
    )
    robot = f"r{1 + rng.integers(3)}"
    planner = tb.planning.Planner(ws, *ends)
    paths = [random_path(rng, planner) for _ in range(N_SIMULATED)]
    sim = KinematicSimulator(
        ws, terrain=world.true_terrain(), sight=world.sight, team=world.team,
        events=CASES[case](robot),
    )  # fmt: skip
    if case == "optimistic":
        campaign = tb.Campaign(ws, *ends, policy=case, model=MODEL, seed=seed)
        *_, _ = campaign.run(sim, n_iterations=N_SIMULATED)
        missions = campaign.missions
    else:
        seeds = [int(rng.integers(2**31)) for _ in paths]
        runs = zip(paths, seeds, strict=True)
        missions = [sim.run(path, seed=s, mission=j) for j, (path, s) in enumerate(runs)]
    missions = [ws.fill(mission) for mission in missions]
    if case == "sign":
        missions = [turned(mission) for mission in missions]
    posterior = fit(missions, MODEL, draws=250, check=False, whole=False, seed=seed)
    posterior.attrs["planted"] = json.dumps([case, seed, robot])
    return posterior


def turned(mission):
    """Mission whose line of sight is reported as that of no sight."""
    sight = np.array([name == "line_of_sight" for name in mission.features])
    turn = lambda bound: np.where(sight, 1.0 - bound.awareness, bound.awareness)  # noqa: E731
    bounds = tuple(replace(bound, awareness=turn(bound)) for bound in mission.bounds)
    return replace(mission, bounds=bounds)


def is_right(case, robot, verdict):
    """Whether a verdict names the cause, and whether it does with its missions."""
    cause, detail = {
        "robot dead": (f"robot in a mission: {robot} has .* less", f"from mission {START} on"),
        "robot poor": (f"robot in a mission: {robot} has .* less", "in all missions"),
        "two bad days": (f"robot in a mission: {robot} has .* less", "in missions 2 and 6"),
        "dust": ("robot in a mission: all robots have .* less", f"from mission {START} on"),
        "sign": ("prior: line_of_sight has the wrong sign", ""),
    }.get(case, ("no fault", ""))
    right = re.match(cause, verdict) is not None
    return right, right and detail in verdict


def judge_simulated(given):
    """Make the campaigns that are not in the folder yet, and judge all."""
    n = 1 if given.quick else given.seeds
    head = "case", "campaigns", "a verdict", "right cause", "right in full", "seconds", "verdicts"
    table = Table(*head, first=12)
    for case in CASES:
        outcomes = []
        for seed in SEEDS.get(case, lambda n: range(n))(n):
            file = given.out / f"{case}-{seed}.nc"
            if not file.exists():
                file.parent.mkdir(parents=True, exist_ok=True)
                simulated(case, seed).to_netcdf(file)
            posterior = xr.open_datatree(file).load()
            seconds, criticism = timed(lambda dt=posterior: criticise(dt, compare=False))
            _, _, robot = json.loads(posterior.attrs["planted"])
            right = is_right(case, robot, criticism.verdict)
            outcomes.append((criticism.fault, *right, seconds))
        faults, cause, whole, seconds = zip(*outcomes, strict=True)
        shares = (wilson(np.array(x)) for x in (np.array(faults) != "none", cause, whole))
        names = dict(Counter(faults).most_common())
        table.row(case, len(faults), *shares, f"{np.median(seconds):.1f}", names)


def judge_drawn(given):
    """Judge the data sets that are not in the file yet, and print the shares."""
    n, file = 5 if given.quick else given.n, given.out / "drawn.jsonl"
    done = {(fault, seed): rest for fault, seed, *rest in read_records(file)}
    table = Table("fault", "a verdict", "right cause", "seconds", "verdicts", first=18)
    for fault, right in FAULTS.items():
        for seed in range(n):
            if (fault, seed) not in done:
                # 0 was of a fault that is no longer planted; the other data sets stay.
                rng = np.random.default_rng([1 + sorted(FAULTS).index(fault), seed])
                posterior = fit(draw_missions(fault, rng), PooledTrust(), "exact", whole=False)
                seconds, criticism = timed(lambda dt=posterior: criticise(dt, compare=False))
                done[fault, seed] = criticism.fault, seconds
                add_record(file, (fault, seed, criticism.fault, seconds))
        faults = np.array([done[fault, seed][0] for seed in range(n)])
        seconds = np.median([done[fault, seed][1] for seed in range(n)])
        shares = wilson(faults != "none"), wilson(faults == right)
        table.row(fault, *shares, f"{seconds:.1f}", dict(Counter(faults.tolist()).most_common()))


def wilson(happened):
    """Share, and its 95 % interval."""
    k, n = int(happened.sum()), len(happened)
    low, high = binomtest(k, n).proportion_ci(method="wilson")
    return f"{k / n:.2f} [{low:.2f}, {high:.2f}]"


PARTS = {"simulated": judge_simulated, "drawn": judge_drawn}


def main():
    given = parsed(
        arguments(
            __doc__, n=100, seeds=10, out="out/criticism", names=PARTS,
            quick="one campaign of each case, four healthy ones, and 5 data sets of each fault",
        )
    )  # fmt: skip
    for name in given.names:
        print(f"\n{name}, kept in {given.out}\n")
        PARTS[name](given)


if __name__ == "__main__":
    main()
