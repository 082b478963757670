"""Policies: from posterior draws to the next plan.

A policy is any callable `policy(rng, params, planner) -> Plan`, and may be passed in place of a
name. For every policy, trust and value of the plan are expectations under the posterior mean.
"""

from collections.abc import Callable, Mapping

import numpy as np

from trustbo.errors import require_choice
from trustbo.models.params import Params
from trustbo.planning.draws import choose_draws
from trustbo.planning.dynamics import Dynamics
from trustbo.planning.plan import Plan
from trustbo.planning.planner import Planner

Policy = Callable[[np.random.Generator, Params, Planner], Plan]
"""Function from a generator, draws with leading axis (draw,) and a planner to the next plan."""

N_DRAWS = 200
"""Number of draws under which `ucb` plans to compare paths."""


def greedy(rng: np.random.Generator, params: Params, planner: Planner) -> Plan:
    """Plan the best path under the posterior mean of the parameters, as in the paper."""
    return planner.plan(params.mean())


def thompson(rng: np.random.Generator, params: Params, planner: Planner) -> Plan:
    """Plan the best path under one random posterior draw (probability matching)."""
    plan = planner.plan(params.draw(int(rng.integers(params.leading[0]))))
    return planner.evaluate(plan.path, params.mean())


def optimistic(
    rng: np.random.Generator, params: Params, planner: Planner, *, quantile: float = 0.9
) -> Plan:
    """Plan the best path under the upper quantile over draws of each bound's drift u."""
    some = choose_draws(params, 1000, _seed(rng))
    transition, drift, start, sd = planner.problem.dynamics(some)
    best = Dynamics(
        transition.mean(0), np.quantile(drift, quantile, axis=0), start.mean(0), sd.mean(0)
    )
    return planner.evaluate(planner.best_path(best), params.mean())


def ucb(rng: np.random.Generator, params: Params, planner: Planner, *, kappa: float = 1.0) -> Plan:
    """Choose the draws' best path with the highest mean plus `kappa` sd of the value."""
    drawn = planner.plan_draws(params, n_draws=N_DRAWS, seed=_seed(rng))
    values = drawn.values_of(drawn.candidates)
    chosen = int(np.argmax(values.mean(0) + kappa * values.std(0)))
    return planner.evaluate(drawn.candidates[chosen], params.mean())


def random(rng: np.random.Generator, params: Params, planner: Planner) -> Plan:
    """Plan the best path under drifts drawn uniformly from [0, 1], ignoring the posterior."""
    drift = rng.uniform(size=(1, *planner.problem.paths.bounds.shape))
    dynamics = Dynamics(np.zeros((1, 1)), drift, np.zeros(1), np.full((), 0.1))
    return planner.evaluate(planner.best_path(dynamics), params.mean())


POLICIES: Mapping[str, Policy] = {
    "greedy": greedy,
    "optimistic": optimistic,
    "thompson": thompson,
    "ucb": ucb,
    "random": random,
}
"""Policies by name."""


def resolve_policy(policy: str | Policy) -> Policy:
    """Return the policy of that name, or the callable itself.

    Raises:
        TrustboError: If it is neither.
    """
    return policy if callable(policy) else POLICIES[require_choice("policy", policy, POLICIES)]


def _seed(rng: np.random.Generator) -> int:
    """Draw a seed."""
    return int(rng.integers(2**63))
