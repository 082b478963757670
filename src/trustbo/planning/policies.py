"""Policies: from posterior draws to the next plan.

A policy is any callable `policy(key, posterior, planner) -> Plan`; your own may be passed wherever
a name may.
"""

from collections.abc import Callable, Mapping

import jax
import numpy as np
from jax import Array

from trustbo.data import Cell
from trustbo.errors import TrustboError, require_choice
from trustbo.models import TrustParams
from trustbo.planning.planner import Plan, Planner

Policy = Callable[[Array, TrustParams, Planner], Plan]
"""Chooses the next plan, given a random key, draws with leading axis (draw,), and the planner."""


def greedy(key: Array, posterior: TrustParams, planner: Planner) -> Plan:
    """Best path under the posterior mean of the parameters (the paper's)."""
    return planner.plan(posterior.mean())


def thompson(key: Array, posterior: TrustParams, planner: Planner) -> Plan:
    """Best path under one posterior draw taken at random (probability matching)."""
    n_draws = len(np.asarray(posterior.beta0))
    return planner.plan(posterior.draw(int(jax.random.randint(key, (), 0, n_draws))))


def random(key: Array, posterior: TrustParams, planner: Planner) -> Plan:
    """A path drawn uniformly from the admissible ones, whatever was learned.

    For `stationary`, which admits simple paths of any length, from those of up to two bounds more
    than the fewest.

    Raises:
        TrustboError: Walks must not enter a cell twice, and of 10 000 drawn every one did.
    """
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    ways = _count_ways(planner)
    for _ in range(10_000):
        path = _draw_walk(planner, ways, rng)
        # Kept only if simple where it must be: what is kept is still uniform.
        if planner.revisit or len(set(path)) == len(path):
            return planner.evaluate(path, posterior.mean())
    raise TrustboError(
        f"no path without revisits among 10 000 walks of up to {planner.longest} bounds; "
        "lower max_bounds."
    )


_Ways = list[dict[tuple[Cell | None, Cell], int]]


def _count_ways(planner: Planner) -> _Ways:
    """ways[n][before, cell]: walks of n more bounds to the goal, exact in Python's integers.

    `before` is the cell that the last bound left, or None where walks may turn straight back.
    """
    graph, goal = planner.graph, planner.goal
    ways: _Ways = [{(b, goal): 1 for b in _befores(planner, goal)}]
    for _ in range(planner.longest):
        fewer, now = ways[-1], {}
        for cell in graph:
            if cell == goal:
                continue  # a path ends when it first gets there
            for before in _befores(planner, cell):
                others = (o for o in graph.successors(cell) if before is None or o != before)
                left = None if planner.u_turns else cell
                if n_ways := sum(fewer.get((left, other), 0) for other in others):
                    now[before, cell] = n_ways
        ways.append(now)
    return ways


def _befores(planner: Planner, cell: Cell) -> list[Cell | None]:
    return [None] if planner.u_turns else [None, *planner.graph.predecessors(cell)]


def _draw_walk(planner: Planner, ways: _Ways, rng: np.random.Generator) -> list[Cell]:
    lengths = range(planner.shortest, planner.longest + 1)
    n_left = lengths[_choose(rng, [ways[n].get((None, planner.start), 0) for n in lengths])]
    before, path = None, [planner.start]
    for n in range(n_left - 1, -1, -1):
        here = path[-1]
        left = None if planner.u_turns else here
        others = [o for o in planner.graph.successors(here) if before is None or o != before]
        path.append(others[_choose(rng, [ways[n].get((left, other), 0) for other in others])])
        before = left
    return path


def _choose(rng: np.random.Generator, counts: list[int]) -> int:
    # In floating point only here: the counts themselves are exact.
    shares = np.array([count / sum(counts) for count in counts])
    return int(rng.choice(len(counts), p=shares / shares.sum()))


POLICIES: Mapping[str, Policy] = {"greedy": greedy, "thompson": thompson, "random": random}
"""The policies by name."""


def resolve_policy(policy: str | Policy) -> Policy:
    """The policy of that name, or the callable itself.

    Raises:
        TrustboError: Neither a known name nor callable.
    """
    if callable(policy):
        return policy
    if not isinstance(policy, str):
        raise TrustboError(f"policy must be a name or a callable; got {policy!r}.")
    return POLICIES[require_choice("policy", policy, POLICIES)]
