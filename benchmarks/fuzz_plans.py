"""Random planning problems against every path, written out or in a table over all states.

Run: python benchmarks/fuzz_plans.py [-n N] [--first I] [--seed S] [--jobs J] [--checked]
     [--out FILE]

Draws grids, strips and closed bounds, awareness of cells or bounds, effects of places, all models,
objectives and families, tolls on length and on time unseen, limits on bounds from "shortest" to
"shortest+300", risks with limits, costs and strata, and numbers that
are large, tied or 0. The compiled engine's plan, and where it is quick the reference engine's, must
have the best score of all admissible paths (`peers.every_path`, which shares no code with the
engines). Problem I of a seed is always the same. Chunks run in processes: one that crashes is
counted, and the rest goes on. `--checked` compiles all kernels with checks of their indices. With
`--out`, chunks that FILE has are not run again.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import xarray as xr
from common import add_record, arguments, parsed, read_records
from peers.every_path import (
    STEPS,
    TooManyError,
    World,
    along,
    best_of,
    dense_table,
    every_walk,
    is_dense,
    to_goal,
)
from scipy.special import expit

_CHUNK, _TIMEOUT = 250, 1800.0
_MOST_WALKS, _FEW_WALKS = 30_000, 1500
OBJECTIVES = ("lost_contact", "terminal", "mean", "success", "bottleneck", "stationary")
CELL = 20.0


def pick(rng, *values):
    return values[rng.integers(len(values))]


def draw_grid(rng):
    """Shape, passable cells, and two ends of them."""
    while True:
        shape = tuple(rng.integers(2, pick(rng, 3, 4, 5, 7), 2).tolist())
        if rng.random() < 0.15:
            shape = (pick(rng, 1, 2), int(rng.integers(3, 9)))
        passable = rng.random(shape) > pick(rng, 0.0, 0.1, 0.25)
        if passable.sum() >= 2:
            ends = rng.choice(np.argwhere(passable), 2, replace=False)
            return shape, passable, *(tuple(int(i) for i in end) for end in ends)


def moves_into(passable, closed, connectivity):
    """Cell that each move leads to from each, (move, cell); -1 where none or closed."""
    rows, cols = passable.shape
    into = np.full((8, rows * cols), -1)
    for m, (down, right) in enumerate(STEPS.tolist()):
        for i, j in np.argwhere(passable).tolist():
            r, c = i + down, j + right
            inside = 0 <= r < rows and 0 <= c < cols and passable[r, c]
            if inside and not closed[m, r, c] and (connectivity == 8 or 0 in (down, right)):
                into[m, i * cols + j] = r * cols + c
    return into


def numbers(rng, kind, size=()):
    """Random numbers: usual, large, tied, or mostly 0."""
    x = rng.normal(size=size)
    if kind == "large":
        return x * pick(rng, 30.0, 1000.0)
    if kind == "tied":
        return np.round(2.0 * x) / 4.0
    return np.where(rng.random(size) < 0.6, 0.0, x) if kind == "zeros" else x


def draw_model(rng, z, beta0, kind):
    """Parameters of a random model, its drift (robot, move, row, col), B0, x0, and if alike."""
    from trustbo.models import CoupledParams, RobotParams, TrustParams

    n, sd = len(z), pick(rng, 0.0, 0.1, 0.4)
    x0, model = (
        float(numbers(rng, pick(rng, "usual", kind))),
        pick(rng, "pooled", "robots", "coupled"),
    )
    b = numbers(rng, kind, n) * 0.5 - pick(rng, 0.0, 0.3)
    if model == "coupled":
        sd = max(sd, 0.01)
        off = pick(rng, 0.0, 0.1) * rng.normal(size=(n, n)) * (beta0 > 0.0)
        B0 = np.where(np.eye(n, dtype=bool), beta0 * rng.uniform(0.6, 1.0, n), off)
        B = numbers(rng, kind, (2, n, n))
        u = np.einsum("mab,bdrcm->adrc", B, z) + b[:, None, None, None]
        params = CoupledParams(B0, B, b, 0.01 * np.eye(n), sd**2 * np.eye(n), x0)
        return params, u, B0, sd, False
    u, places = np.zeros(z.shape[:-1]), {}
    if rng.random() < 0.3:
        k = pick(rng, 1, n)
        places["place"] = 0.3 * rng.normal(size=(k, *z.shape[2:4]))
        u = u + places["place"][:, None]
        if rng.random() < 0.5:
            places["place_bound"] = 0.3 * rng.normal(size=(k, *z.shape[1:4]))
            u = u + places["place_bound"]
    if model == "robots":
        beta, own = numbers(rng, kind, (n, 2)), beta0 * rng.uniform(0.6, 1.0, n)
        u = u + np.einsum("im,idrcm->idrc", beta, z) + b[:, None, None, None]
        sds = sd * rng.uniform(0.5, 1.0, n)
        params = RobotParams(own, beta, b, np.full(n, 0.1), sds, x0, **places)
        return params, u, np.diag(own), float(sds.mean()), False
    beta = numbers(rng, kind, 2)
    params = TrustParams(beta0, beta, b[0], 0.1, sd, x0, **places)
    return params, u + z @ beta + b[0], beta0 * np.eye(n), sd, True


def draw_limit(rng, case):
    """`max_bounds`, the largest number of bounds, and whether U-turns are allowed."""
    extra = int(rng.integers(0, 5))
    if case.dense and rng.random() < 0.6:
        extra = int(pick(rng, 8, 20, 60, 255, 256, 257, 300, 600))
    walks = rng.random() < (0.7 if case.history else 0.3)
    most = case.shortest + extra
    return (most if walks else f"shortest+{extra}" if extra else "shortest"), most, walks


def draw_risk(rng, case):
    """Chances (move, row, col), draws of them, strata, the rule, and the unit of all risks."""
    shape, draws, unit, options = (8, *case.passable.shape), None, 1e-300, {}
    if case.dense:  # whole multiples of a unit
        unit = pick(rng, 0.01, 0.1)
        p = -np.expm1(-rng.integers(0, 4, shape) * unit)
    else:
        p = np.where(rng.random(shape) < 0.4, rng.uniform(0.0, 0.5, shape), 0.02)
        p = np.where(rng.random(shape) < 0.1, rng.choice([0.0, 1.0, 0.1], shape), p)
        if rng.random() < 0.5:
            draws = np.clip(p + rng.normal(0.0, 0.1, (7, *shape)), 0.0, 1.0)
    if rng.random() < 0.8:
        limit = (rng.integers(0, 30) + 0.5) * unit if case.dense else rng.exponential(0.5)
        options = {"max_failure": float(-np.expm1(-limit)), "infeasible": "safest"}
    if case.objective == "lost_contact" and rng.random() < 0.6:
        options["failure_cost"] = float(pick(rng, 0.0, 0.7, 3.0, 40.0))
    strata = None
    if case.objective == "lost_contact" and not case.dense and rng.random() < 0.5:
        strata = draw_strata(rng, p)
        p = np.minimum(np.tensordot(strata.shares, strata.p_fail, 1), 1.0)
    return p, draws, strata, options, unit


def draw_strata(rng, p):
    """Two to five strata around chances, all of them milder or more severe, or mixed."""
    from trustbo.hazard.strata import Strata

    n = int(rng.integers(2, 6))
    severity = np.sort(rng.lognormal(0.0, pick(rng, 0.3, 1.5), n))[:, None, None, None]
    noise = rng.lognormal(0.0, pick(rng, 0.0, 0.0, 1.0), (n, *p.shape))
    return Strata(np.minimum(p * severity * noise, 1.0), rng.dirichlet(np.full(n, 0.7)))


def resources(p, strata, options):
    """Risks (resource, move, cell) at the mean and of strata; limits; how many to keep."""
    limit = -np.log1p(-options["max_failure"]) if "max_failure" in options else np.inf
    some, limits, needed = p[None], np.array([limit]), 1
    if strata is not None:
        n = len(strata.shares)
        some = np.concatenate([some[:1], strata.p_fail, some[1:]])
        limits, needed = np.concatenate([limits[:1], np.full(n, np.inf), limits[1:]]), needed + n
    with np.errstate(divide="ignore"):
        risk = np.minimum(-np.log1p(-some), 700.0)
    return risk.reshape(len(some), 8, -1), limits, needed


def draw_case(rng):
    """What is planned for, but for parameters and risk; None where the goal is out of reach."""
    case = SimpleNamespace(objective=pick(rng, *OBJECTIVES), dense=rng.random() < 0.4)
    shape, case.passable, case.start, case.goal = draw_grid(rng)
    case.connectivity, case.team = pick(rng, 4, 8), pick(rng, "mean", "min")
    case.n_robots = pick(rng, 1, 2, 3)
    case.closed = rng.random((8, *shape)) < pick(rng, 0.0, 0.0, 0.0, 0.2)
    case.into = moves_into(case.passable, case.closed, case.connectivity)
    case.ends = tuple(cell[0] * shape[1] + cell[1] for cell in (case.start, case.goal))
    case.shortest = int(to_goal(case.into, case.ends[1])[case.ends[0]])
    if case.shortest > 10**5:
        return None
    case.family = "gaussian"
    if case.objective == "lost_contact":
        case.family = pick(rng, "gaussian", "gaussian", "censored", "beta_binomial")
    case.history = case.objective in ("success", "bottleneck") or case.family != "gaussian"
    least = case.team == "min" and case.n_robots > 1
    case.dense &= not least or case.history or case.objective == "stationary"
    case.beta0 = float(pick(rng, 0.0, 0.3, 0.7, 0.95, 0.999, 1.0, 1.2))
    if case.objective == "stationary":
        case.beta0 = min(case.beta0, 0.999)
    elif case.dense and case.history:
        case.beta0 = 0.0
    elif case.objective in ("terminal", "mean") and rng.random() < 0.2:
        case.beta0 = -case.beta0
    case.most, case.longest, case.u_turns = draw_limit(rng, case)
    if case.longest > 30:
        case.beta0 = min(max(case.beta0, -1.0), 1.0)
    case.simple = case.objective == "stationary"
    if case.objective == "stationary":
        case.longest, case.u_turns = int(case.passable.sum()) - 1, True
    case.weight, case.unseen = float(pick(rng, 0.0, 0.0, 0.01, 0.1)), 0.0
    case.shares = rng.random((8, *shape))
    if rng.random() < 0.4:
        case.unseen = float(pick(rng, 0.01, 0.3, 3.0, 30.0))
    if case.objective == "bottleneck" or (case.dense and case.objective == "mean"):
        case.weight = case.unseen = 0.0
    return case


class Problem:
    """A random problem: a planner, parameters, and the same as a `World`, with its best score."""

    def __init__(self, seed, index):
        rng = np.random.default_rng([seed, index])
        while not self._draw(rng):
            pass

    def _draw(self, rng):
        case = draw_case(rng)
        if case is None:
            return False
        shape, n = case.passable.shape, case.n_robots
        self.z = rng.random((n, *(() if rng.random() < 0.3 else (8,)), *shape, 2))
        z = self.z if self.z.ndim == 5 else np.repeat(self.z[:, None], 8, axis=1)
        kind = pick(rng, "usual", "usual", "large", "tied", "zeros")
        self.params, u, B0, sd, alike = draw_model(rng, z, case.beta0, kind)
        if case.objective == "stationary" and np.abs(np.linalg.eigvals(B0)).max() > 0.9995:
            return False
        u, x0 = u.reshape(n, 8, -1), np.full(n, float(self.params.x0_mean))
        if alike and case.team == "mean":
            u, x0, B0 = u.mean(0, keepdims=True), x0[:1], B0[:1, :1]
        if case.objective == "lost_contact" and case.family == "gaussian":
            u, x0 = np.minimum(u, 1.0 - B0.sum(1)[:, None, None]), np.minimum(x0, 1.0)
        self.p, self.draws, self.strata, self.options, unit = None, None, None, {}, 0.0
        shares = np.empty(0)
        risk, limits, needed, cost = np.zeros((0, *u.shape[1:])), np.empty(0), 0, 0.0
        if rng.random() < 0.5:
            self.p, self.draws, self.strata, self.options, unit = draw_risk(rng, case)
            risk, limits, needed = resources(self.p, self.strata, self.options)
            shares = shares if self.strata is None else self.strata.shares
            if case.objective == "lost_contact":
                cost = self.options.get("failure_cost", float(case.shortest))
        tolls = case.weight * CELL * np.hypot(*STEPS.T)[:, None]
        tolls = tolls + case.unseen * case.shares.reshape(8, -1)
        self.case, self.world = case, World(
            case.objective, *case.ends, case.into, tolls, u, B0, x0, case.team == "min",
            case.family, sd, case.longest, case.u_turns, case.simple, risk, limits,
            needed, cost, shares, unit,
        )  # fmt: skip
        return self._solve()

    def _solve(self):
        """Find the best of all walks; False if they are too many."""
        self.n_walks, world = None, self.world
        if self.case.dense:
            assert is_dense(world)
            self.least, self.best = dense_table(world)
            if self.best == -np.inf and self.p is not None:
                limit = np.array([self.least + 0.5 * world.unit])
                self.best = dense_table(world._replace(limits=limit))[1]
            return True
        try:
            walks = every_walk(world, _MOST_WALKS)
        except TooManyError:
            return False
        self.n_walks = len(walks.score)
        self.least, self.best = best_of(walks, world)
        return not np.isnan(self.best)  # rounding does not decide it

    def planner(self, engine):
        """The planner with an engine."""
        from trustbo.planning import Planner
        from trustbo.workspace import Workspace

        case, workspace = self.case, Workspace.from_awareness(self.z, self.case.passable, CELL)
        shares = xr.DataArray(case.shares, dims=("move", "row", "col"))
        vars(workspace)["unseen_bounds"] = shares  # as if computed from a map, and cached
        planner = Planner(
            workspace, case.start, case.goal, case.objective, connectivity=case.connectivity,
            max_bounds=case.most, team=case.team, length_weight=case.weight,
            unseen_cost=case.unseen, engine=engine, observation=case.family,
            **self.options,
        )  # fmt: skip
        if case.closed.any():
            planner = planner.avoiding(case.closed, np.zeros(case.closed.shape))
        if self.p is None:
            return planner
        return planner.with_risk(self.p, self.draws, None, self.strata)

    def engines(self):
        """Engines to compare: the reference where it takes no more than a second."""
        few, short = (
            self.n_walks is not None and self.n_walks <= _FEW_WALKS,
            self.world.longest <= 12,
        )
        if self.world.objective == "stationary" and self.p is not None:
            few = few and short  # the reference keeps walks that revisit, and many risks tell apart
        quick = few or (self.p is None and short and not self.case.history)
        return ("numba", "networkx") if quick else ("numba",)

    def faults(self, engine):
        """What is wrong with an engine's plan, as words; empty if nothing is."""
        world, plan = self.world, self.planner(engine).plan(self.params)
        flat = [row * self.case.passable.shape[1] + col for row, col in plan.path]
        score, sums, admissible = along(world, flat)
        cost = world.failure(sums)
        got, tolerance, faults = score - cost, self.tolerance(), []
        if not admissible:
            faults.append("inadmissible")
        if len(sums):
            slack = 1e-9 * np.maximum(1.0, np.where(world.limits < np.inf, world.limits, 0.0))
            kept = (sums <= world.limits + slack).sum() >= world.needed
            if not kept and (not plan.infeasible or sums[0] > self.least + slack.max()):
                faults.append("risk")
        if got > self.best + tolerance:
            faults.append("better than the best")
        if plan.exact and got < self.best - tolerance:
            faults.append("worse")
        sure = {"terminal": expit, "success": np.exp, "stationary": np.exp}
        to_value = sure.get(world.objective, float)
        if not plan.exact and plan.bound < to_value(self.best) * (1.0 - 1e-9) - tolerance:
            faults.append("bound")
        value = to_value(score) - cost
        if abs(plan.value - value) > 10.0 * tolerance * max(1.0, abs(value)):
            faults.append("value")
        return faults, plan.exact

    def tolerance(self):
        """Rounding of a score: small beside it, and beside the sums that it comes from."""
        world, growth = self.world, float(np.abs(self.world.B0).sum(1).max())
        powers = growth ** np.arange(world.longest + 1.0)
        trust = np.abs(world.x0).max() * powers.max() + np.abs(world.u).max() * powers.sum()
        return 1e-10 * (1.0 + abs(self.best)) + 1e-14 * world.longest * trust


def examine(seed, index):
    """Outcome of one problem by name."""
    from trustbo.errors import TrustboError

    problem, outcome = Problem(seed, index), Counter(plans=1)
    outcome["by table" if problem.case.dense else "by walks"] += 1
    outcome["within a risk"] += problem.p is not None
    outcome["in strata"] += problem.strata is not None
    outcome["longest over 250"] += problem.world.longest > 250
    wrong = []
    for engine in problem.engines():
        outcome[engine] += 1
        try:
            faults, exact = problem.faults(engine)
        except TrustboError as error:
            if "partial paths are worth keeping" not in str(error):
                raise
            outcome["refused"] += 1
            continue
        outcome["not exact"] += not exact
        wrong += [f"{engine}: {fault}" for fault in faults]
    return outcome, wrong


def work(seed, first, last):
    """Examine problems, one line of JSON each: its number before, and its outcome after."""
    for index in range(first, last):
        print(json.dumps({"begins": index}), flush=True)
        try:
            outcome, wrong = examine(seed, index)
        except Exception as error:  # whatever it is, the planner is at fault
            outcome, wrong = Counter(plans=1), [f"{type(error).__name__}: {error}"]
        print(json.dumps({"outcome": outcome, "wrong": wrong}), flush=True)


def run_chunk(seed, first, last, environment):
    """Outcome of problems in processes of their own, each until it ends or crashes."""
    outcome, wrong = Counter(), []
    while first < last:
        command = [sys.executable, __file__, "--work", str(seed), str(first), str(last)]
        try:
            process = subprocess.run(
                command, env=environment, capture_output=True, text=True, timeout=_TIMEOUT,
                check=False,
            )  # fmt: skip
            printed, how = process.stdout, f"exit {process.returncode}: {process.stderr[-300:]}"
        except subprocess.TimeoutExpired as late:
            printed, how = (late.stdout or b"").decode(), "timeout"
        lines = [json.loads(line) for line in printed.splitlines() if line.endswith("}")]
        index = first
        for line in lines:
            index = line.get("begins", index)
            if "outcome" in line:
                outcome.update(line["outcome"])
                wrong += [f"{index}: {what}" for what in line["wrong"]]
        if lines and "outcome" in lines[-1] and index == last - 1:
            break
        outcome["crashes"] += 1
        wrong.append(f"{index}: crash, {how}")
        first = index + 1
    return {"outcome": outcome, "wrong": wrong}


def environment_of(checked):
    """Environment of the processes; checked kernels have a cache of their own."""
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    if checked and environment.get("NUMBA_BOUNDSCHECK") != "1":
        cache = Path(tempfile.gettempdir()) / f"trustbo-checked-{os.getuid()}"
        environment |= {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(cache)}
    return environment


def main():
    words = arguments(__doc__, n=1000, quick="100 problems")
    for name in ("--first", "--seed"):
        words.add_argument(name, type=int, default=0)
    words.add_argument("--jobs", type=int, default=1)
    words.add_argument("--checked", action="store_true")
    words.add_argument("--out", type=Path)
    words.add_argument("--work", nargs=3, type=int, help=argparse.SUPPRESS)
    given = parsed(words)
    if given.quick:
        given.n = 100
    if given.work:
        work(*given.work)
        return 0
    kept = read_records(given.out) if given.out else []
    done = {tuple(record["chunk"]): record for record in kept}
    environment, end = environment_of(given.checked), given.first + given.n
    chunks = [(given.seed, i, min(i + _CHUNK, end)) for i in range(given.first, end, _CHUNK)]
    total, wrong = Counter(), []

    def run(chunk):
        key = *chunk, int(given.checked)
        return key, done.get(key) or run_chunk(*chunk, environment)

    with ThreadPoolExecutor(given.jobs) as pool:
        for i, (key, results) in enumerate(pool.map(run, chunks)):
            if given.out and key not in done:
                add_record(given.out, {"chunk": key, **results})
            total.update(results["outcome"])
            wrong += results["wrong"]
            for line in results["wrong"]:
                print("WRONG", line)
            print(f"{i + 1}/{len(chunks)}", ", ".join(f"{v} {k}" for k, v in total.items()))
            sys.stdout.flush()
    print(f"{total['plans']} problems, {len(wrong)} wrong, {total['crashes']} crashes")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
