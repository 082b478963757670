"""Policies: from posterior draws to the next plan.

A policy is any callable `policy(key, posterior, planner) -> Plan`; your own may be passed wherever
a name may.
"""

from collections.abc import Callable, Mapping
from functools import cache

import jax
import networkx as nx
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
    """A path drawn uniformly from the admissible ones, whatever was learned."""
    graph, goal, u_turns = planner.graph, planner.goal, planner.u_turns
    to_goal = dict(nx.single_target_shortest_path_length(graph, goal))

    def onward(before: Cell | None, cell: Cell, n_left: int) -> list[Cell]:
        """Where a walk with `n_left` bounds to go may lead next."""
        return [
            other
            for other in graph.successors(cell)
            if to_goal.get(other, np.inf) <= n_left - 1
            and (other == goal) == (n_left == 1)
            and (u_turns or other != before)
        ]

    @cache
    def n_walks(before: Cell | None, cell: Cell, n_left: int) -> int:
        if n_left == 0:
            return 1
        return sum(n_walks(cell, other, n_left - 1) for other in onward(before, cell, n_left))

    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))

    def choose(counts: list[int]) -> int:
        # In floating point only here: the counts themselves are exact.
        shares = np.array([count / sum(counts) for count in counts])
        return int(rng.choice(len(counts), p=shares / shares.sum()))

    lengths = range(planner.shortest, planner.longest + 1)
    n_left = lengths[choose([n_walks(None, planner.start, n) for n in lengths])]
    before, path = None, [planner.start]
    while n_left:
        others = onward(before, path[-1], n_left)
        n_left -= 1
        chosen = others[choose([n_walks(path[-1], other, n_left) for other in others])]
        before = path[-1]
        path.append(chosen)
    return planner.evaluate(path, posterior.mean())


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
