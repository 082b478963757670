"""Fuzz test of the planner: random problems, compared with an enumeration of all paths.

    python benchmarks/fuzz_plans.py [-n N] [--first I] [--seed S] [--networkx] [--quick]

The problems vary the grid (holes, closed bounds), the awareness (of cells or bounds), the number of
sets of posts, place effects, the model (equal, different or coupled robots), the objective, the
family, costs of bounds, limits on the number of bounds, U-turns, and risks (limits, costs,
components). Numbers are usual, large, tied or 0. The plan must have the best score of all
admissible paths, which `peers.every_path` enumerates without code of the planner. With --networkx,
the plan must also have the value of `peers.networkx_planner`. Problem I of a seed is always the
same.
"""

import sys
from collections import Counter
from dataclasses import replace

import numpy as np
from common import Table, arguments, parsed
from peers import networkx_planner
from peers.every_path import STEPS, TooManyError, World, best_walk, score_along, to_goal
from scipy.special import logit

from trustbo.hazard.components import Components
from trustbo.models import TrustParams
from trustbo.planning import InfeasibleError, Planner
from trustbo.workspace import Workspace
from trustbo.workspace.awareness import labelled_onward
from trustbo.workspace.moves import posts_along

OBJECTIVES, FAMILIES = (
    ("lost_contact", "terminal", "mean"),
    ("gaussian", "censored", "beta_binomial"),
)
_MOST_WALKS = 30_000


def pick(rng, *values):
    return values[rng.integers(len(values))]


def numbers(rng, kind, size=()):
    """Draw random numbers that are usual, large, tied, or mostly 0."""
    x = rng.normal(size=size)
    if kind == "large":
        return x * pick(rng, 30.0, 1000.0)
    if kind == "tied":
        return np.round(2.0 * x) / 4.0
    return np.where(rng.random(size) < 0.6, 0.0, x) if kind == "zeros" else x


def draw_grid(rng):
    """Draw passable cells, closed bounds, the target of each move (move, cell), and the ends."""
    shape = tuple(rng.integers(2, pick(rng, 3, 4, 5, 7), 2).tolist())
    if rng.random() < 0.15:
        shape = (pick(rng, 1, 2), int(rng.integers(3, 9)))
    passable = rng.random(shape) > pick(rng, 0.0, 0.1, 0.25)
    closed = rng.random((8, *shape)) < pick(rng, 0.0, 0.0, 0.0, 0.2)
    if rng.random() < 0.2:  # no diagonal moves
        closed |= (np.abs(STEPS).sum(1) == 2)[:, None, None]
    into = np.full((8, passable.size), -1)
    for m, step in enumerate(STEPS):
        for cell in np.argwhere(passable):
            other = cell + step
            inside = (other >= 0).all() and (other < shape).all()
            if inside and passable[*other] and not closed[m, *other]:
                into[m, np.ravel_multi_index(cell, shape)] = np.ravel_multi_index(other, shape)
    if passable.sum() < 2:
        return draw_grid(rng)
    ends = rng.choice(np.argwhere(passable), 2, replace=False).tolist()
    if (
        to_goal(into, np.ravel_multi_index(ends[1], shape))[np.ravel_multi_index(ends[0], shape)]
        > 99
    ):
        return draw_grid(rng)
    return passable, closed, into, *map(tuple, ends)


def draw_model(rng, z, kind):
    """Draw the parameters of a model; also return drift (state, way, row, col), B0, x0 and sd.

    The last result is what the second feature of each robot adds to each state, (state, robot).
    """
    n, sd = len(z), pick(rng, 0.01, 0.1, 0.4)
    beta0 = float(pick(rng, 0.0, 0.3, 0.7, 0.95, 1.0))
    x0, model = float(numbers(rng, kind)), pick(rng, "pooled", "robots", "coupled")
    b = numbers(rng, kind, n) * 0.5 - pick(rng, 0.0, 0.3)
    if model == "coupled":
        B0 = np.diag(beta0 * rng.uniform(0.6, 1.0, n)) + rng.uniform(0.0, 0.1, (n, n))
        B = numbers(rng, kind, (2, n, n))
        u = np.einsum("mab,bdrcm->adrc", B, z) + b[:, None, None, None]
        noises = {"Delta_w": 0.01 * np.eye(n), "Delta_v": sd**2 * np.eye(n)}
        params = TrustParams(B0=B0, B=B, b=b, **noises, x0_mean=x0)
        return params, u, B0, np.full(n, x0), sd, B[1]
    u, places = np.zeros(z.shape[:-1]), {}
    if rng.random() < 0.3:
        k = pick(rng, 1, n)
        places = {"place": 0.3 * rng.normal(size=(k, *z.shape[2:4]))}
        places["place_bound"] = 0.3 * rng.normal(size=(k, *z.shape[1:4]))
        u = u + places["place"][:, None] + places["place_bound"]
    if model == "robots":
        beta, own = numbers(rng, kind, (n, 2)), beta0 * rng.uniform(0.6, 1.0, n)
        u = u + np.einsum("im,idrcm->idrc", beta, z) + b[:, None, None, None]
        sds = sd * rng.uniform(0.5, 1.0, n)
        params = TrustParams(own, beta, b, np.full(n, 0.1), sds, x0, **places, per_robot=True)
        return params, u, np.diag(own), np.full(n, x0), float(sds.mean()), np.diag(beta[:, 1])
    beta = numbers(rng, kind, 2)
    params = TrustParams(beta0, beta, b[0], 0.1, sd, x0, **places)
    u = (u + z @ beta + b[0]).mean(0, keepdims=True)
    return params, u, np.full((1, 1), beta0), np.full(1, x0), sd, np.full((1, n), beta[1] / n)


def draw_risk(rng, of_posts, shape, n_posts, of_contact):
    """Draw failure probabilities, components or None, and planner options.

    The probabilities have shape (move, row, col), or (move, row, col, next_move) in half of the
    problems, which then depend on the next move. In three quarters of the problems with several
    sets of posts, the moves are ways, and so are four fifths of the next moves.
    """
    by_next = rng.random() < 0.5
    if n_posts > 1 and of_posts.random() < 0.75:
        shape = (8 * n_posts, *shape[1:])
        by_next = pick(of_posts, by_next, True)
    if by_next:
        shape = (*shape, 8 * n_posts + 1 if shape[0] > 8 and of_posts.random() < 0.8 else 9)
    p = np.where(rng.random(shape) < 0.4, rng.uniform(0.0, 0.5, shape), 0.02)
    p = np.where(rng.random(shape) < 0.1, rng.choice([0.0, 1.0, 0.1], shape), p)
    components, options = None, {}
    if rng.random() < 0.6:
        options["max_failure"] = float(-np.expm1(-rng.exponential(0.5)))
    if of_contact and rng.random() < 0.6:
        options["failure_cost"] = float(pick(rng, 0.0, 0.7, 3.0, 40.0))
    if rng.random() < 0.6:
        n = int(rng.integers(2, 6))
        severity = np.sort(rng.lognormal(0.0, pick(rng, 0.3, 1.5), n))
        severity = severity.reshape(n, *[1] * len(shape))
        noise = rng.lognormal(0.0, pick(rng, 0.0, 0.0, 1.0), (n, *shape))
        components = Components(
            np.minimum(p * severity * noise, 1.0), rng.dirichlet(np.full(n, 0.7))
        )
        p = np.minimum(np.tensordot(components.weights, components.p_fail, 1), 1.0)
    return p, components, options


def risks_of(p, components, n_posts):
    """Return risks (sum, way, cell, next way) of each component, or of the mean, and shares."""
    some, share = (p[None], np.ones(1)) if components is None else components
    with np.errstate(divide="ignore"):
        risk = np.minimum(-np.log1p(-some), 700.0)
    if p.ndim == 3:
        risk = np.repeat(risk[..., None], 9, axis=-1)
    if risk.shape[1] == 8:
        risk = np.concatenate([risk] * n_posts, axis=1)
    if risk.shape[-1] == 9:
        risk = np.concatenate([risk[..., :-1]] * n_posts + [risk[..., -1:]], axis=-1)
    return risk.reshape(len(some), 8 * n_posts, -1, 8 * n_posts + 1), share


def draw_problem(rng):
    """Draw a problem, as a planner with parameters and as a `World`."""
    passable, closed, into, start, goal = draw_grid(rng)
    shape, n = passable.shape, pick(rng, 1, 2, 3)
    z = rng.random((n, *(() if rng.random() < 0.3 else (8,)), *shape, 2))
    of_posts = rng.spawn(1)[0]  # does not change the numbers of other problems
    n_posts = pick(of_posts, 1, 1, 2, 3) if z.ndim == 5 else 1
    if n_posts > 1:
        others = of_posts.random((n, 8 * (n_posts - 1), *shape, 2))
        z = np.concatenate([z, np.round(others * 4.0) / 4.0], axis=1)
    by_bound = z if z.ndim == 5 else np.repeat(z[:, None], 8, axis=1)
    objective, family = pick(rng, *OBJECTIVES), pick(rng, *FAMILIES)
    params, u, B0, x0, sd, of_sight = draw_model(
        rng, by_bound, pick(rng, "usual", "usual", "large", "tied", "zeros")
    )
    params = params.replace(family=family)
    u = np.repeat(u[..., None], 8 * n_posts + 1, axis=-1)
    workspace = Workspace.from_awareness(z, passable)
    if n_posts > 1:  # line of sight, the second feature, depends on the next way
        names = "traversability", "line_of_sight"
        workspace = Workspace.from_awareness(z, passable, features=names)
        change = 0.3 * of_posts.normal(size=(n, 8 * n_posts, *shape, 8 * n_posts))
        onward = labelled_onward(change, workspace.awareness)
        workspace = replace(workspace, onward=onward)
        known = z[..., None, 1]
        u[..., :-1] += np.tensordot(of_sight, np.clip(known + change, 0.0, 1.0) - known, 1)
    u = u.reshape(len(u), 8 * n_posts, -1, 8 * n_posts + 1)
    if objective == "lost_contact" and family == "gaussian":  # no bound gains contact
        u, x0 = np.minimum(u, 1.0 - B0.sum(1)[:, None, None, None]), np.minimum(x0, 1.0)
    ends = [int(np.ravel_multi_index(cell, shape)) for cell in (start, goal)]
    shortest, extra = int(to_goal(into, ends[1])[ends[0]]), int(rng.integers(0, 5))
    turns = rng.random() < 0.4
    bound_cost = np.where(rng.random() < 0.5, 0.0, rng.exponential(0.1, (8, *shape)))
    p, components, options = (
        (None, None, {})
        if rng.random() < 0.4
        else draw_risk(rng, of_posts, (8, *shape), n_posts, objective == "lost_contact")
    )
    planner = Planner(
        workspace, start, goal, objective,
        bound_cost=bound_cost,
        max_bounds=shortest + extra if turns else f"shortest+{extra}", **options,
    )  # fmt: skip
    if closed.any():
        planner = planner.avoiding(closed, np.zeros(closed.shape))
    n_ways = 8 * n_posts
    risk, share, failure = np.zeros((1, n_ways, passable.size, n_ways + 1)), np.ones(1), np.zeros(1)
    if p is not None:
        planner = planner.with_risk(p, None, components)
        cost = options.get("failure_cost", float(shortest)) if objective == "lost_contact" else 0.0
        risk, share = risks_of(p, components, n_posts)
        failure = cost * share
    limit = options.get("max_failure", np.inf)
    return planner, params, World(
        objective, *ends, np.tile(into, (n_posts, 1)), bound_cost.reshape(8, -1), u, B0, x0,
        family, sd, shortest + extra, turns, risk, failure, share, limit,
    )  # fmt: skip


def faults(planner, params, world, best):
    """Return what is wrong with a plan, given the best score, and whether the plan is exact."""
    try:
        plan = planner.plan(params)
    except InfeasibleError as error:
        return ["refused"] if best > -np.inf else [], error.path is not None
    scale = max(1.0, abs(best))
    shape = planner.workspace.grid.shape
    posts = [*posts_along(plan.stations), 0]
    cells = (int(np.ravel_multi_index(cell, shape)) for cell in plan.path)
    flat = [*zip(cells, posts, strict=True)]
    score, wrong = score_along(world, flat), []
    if plan.exact and score < best - 1e-9 * scale:
        wrong.append(f"score {score:.12g}, best {best:.12g}")
    value = score if world.objective != "terminal" else None
    if value is not None and abs(plan.value - value) > 1e-8 * scale:
        wrong.append(f"value {plan.value:.12g}, score {value:.12g}")
    if value is None and abs(score) < 15.0 and abs(logit(plan.value) - score) > 1e-6 * scale:
        wrong.append(f"value {plan.value:.12g}, score {score:.12g}")
    if not plan.exact and value is not None and plan.limit < best - 1e-9 * scale:
        wrong.append(f"limit {plan.limit:.12g}, best {best:.12g}")
    return wrong, plan.exact


def problem_of(seed, index, most=_MOST_WALKS):
    """Draw a problem that can be enumerated, and compute the score of its best walk."""
    rng = np.random.default_rng([seed, index])
    while True:
        planner, params, world = draw_problem(rng)
        try:
            best, _ = best_walk(world, most)
        except TooManyError:
            continue
        if not np.isnan(best):
            return planner, params, world, best


def main():
    words = arguments(__doc__, n=1000, quick="only 200 problems")
    for name in ("--first", "--seed"):
        words.add_argument(name, type=int, default=0)
    words.add_argument("--networkx", action="store_true")
    given = parsed(words)
    n, outcome = 200 if given.quick else given.n, Counter()
    for index in range(given.first, given.first + n):
        most = 2000 if given.networkx else _MOST_WALKS
        planner, params, world, best = problem_of(given.seed, index, most)
        wrong, exact = faults(planner, params, world, best)
        is_peers = planner.workspace.onward is None
        if given.networkx and is_peers and not wrong and best > -np.inf:
            ours, theirs = planner.plan(params), networkx_planner.plan(planner, params)
            if abs(ours.value - theirs.value) > 1e-9 * max(1.0, abs(theirs.value)):
                wrong.append(f"value {ours.value:.12g}, networkx {theirs.value:.12g}")
        outcome.update(
            problems=1, wrong=len(wrong) > 0, infeasible=int(best == -np.inf), inexact=not exact
        )
        outcome[world.objective, world.family] += 1
        outcome["with sets of posts"] += planner.workspace.n_posts > 1
        for what in wrong:
            print(f"WRONG {index}: {what}", flush=True)
    counts = {name: count for name, count in outcome.items() if isinstance(name, str)}
    Table(*counts, name="plans_exact").row(*counts.values())
    return 1 if outcome["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
