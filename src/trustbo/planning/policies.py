"""Policies: from posterior draws to the next plan.

A policy is any callable `policy(key, posterior, planner) -> Plan`, and may be passed in place of a
name. Trust and value of every plan are expectations under the posterior mean, for each policy.
"""

import inspect
from collections.abc import Callable, Mapping

import jax
import numpy as np
from jax import Array

from trustbo.data import Cell
from trustbo.errors import TrustboError, require_choice
from trustbo.models.params import Params
from trustbo.planning.dynamics import Dynamics
from trustbo.planning.path_sampling import path_sampler
from trustbo.planning.plan import Plan
from trustbo.planning.planner import Planner
from trustbo.planning.posterior import choose_draws

Policy = Callable[[Array, Params, Planner], Plan]
"""Function from a random key, draws with leading axis (draw,) and a planner to the next plan."""

N_DRAWS = 200
"""Number of draws under which policies plan to compare paths."""
_TRIES = 1000
"""Number of random paths drawn to find some that respect `max_failure`."""


def greedy(key: Array, posterior: Params, planner: Planner) -> Plan:
    """Best path under the posterior mean of the parameters (the paper's)."""
    return planner.plan(posterior.mean())


def thompson(key: Array, posterior: Params, planner: Planner) -> Plan:
    """Best path under one posterior draw taken at random (probability matching)."""
    index = int(jax.random.randint(key, (), 0, posterior.leading[0], np.int32))
    plan = planner.plan(posterior.draw(index))
    return planner.evaluate(plan.path, posterior.mean())


def optimistic(key: Array, posterior: Params, planner: Planner, *, quantile: float = 0.9) -> Plan:
    """Best path under the upper quantile over draws of each bound's drift u."""
    params, _ = choose_draws(posterior, 1000, seed_of(key))
    dynamics = planner.dynamics(params)
    best = Dynamics(
        dynamics.transition.mean(0),
        np.quantile(dynamics.drift, quantile, axis=0),
        dynamics.start.mean(0),
        dynamics.views,
        dynamics.noise_sd.mean(0),
    )
    return planner.evaluate(planner.best_path(best), posterior.mean())


def ucb(key: Array, posterior: Params, planner: Planner, *, kappa: float = 1.0) -> Plan:
    """Path with the highest mean plus `kappa` sd of its value, of the draws' best paths."""
    drawn = planner.plan_draws(posterior, n_draws=N_DRAWS, seed=seed_of(key))
    values = drawn.values_of(drawn.candidates)
    chosen = int(np.argmax(values.mean(0) + kappa * values.std(0)))
    return planner.evaluate(drawn.candidates[chosen], posterior.mean())


def random(key: Array, posterior: Params, planner: Planner) -> Plan:
    """Path drawn uniformly from the admissible ones, independent of the posterior.

    For `stationary`, which admits simple paths of any length, from those of up to two bounds more
    than the fewest. Under a `max_failure`, from those that respect it; where none of 1000 does,
    the greedy path.

    Raises:
        InfeasibleError: No path respects `max_failure`.
    """
    path = _random_path(planner, np.random.default_rng(seed_of(key)))
    return planner.evaluate(path, posterior.mean()) if path else greedy(key, posterior, planner)


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
        TrustboError: It is neither, or takes other arguments than (key, draws, planner).
    """
    if callable(policy):
        _require_arguments(policy)
        return policy
    if not isinstance(policy, str):
        raise TrustboError(f"policy must be a name or a callable; got {policy!r}.")
    return POLICIES[require_choice("policy", policy, POLICIES)]


def _require_arguments(policy: Policy) -> None:
    try:
        signature = inspect.signature(policy)
    except (TypeError, ValueError):  # of a built-in, not known
        return
    try:
        signature.bind(None, None, None)
    except TypeError as error:
        name = getattr(policy, "__name__", type(policy).__name__)
        raise TrustboError(
            f"a policy is called policy(key, draws, planner); {name}{signature} cannot be: {error}."
        ) from None


def _random_path(planner: Planner, rng: np.random.Generator) -> tuple[Cell, ...] | None:
    """Draw a path that respects `max_failure`, each equally likely; None if `_TRIES` do not."""
    sampler, problem = path_sampler(planner.paths), planner.problem
    tries = (sampler.draw(rng) for _ in range(_TRIES))
    return next((path for path in tries if problem.is_within_risk(path)), None)


def seed_of(key: Array) -> int:
    """Seed for NumPy from a random key."""
    high, low = np.asarray(jax.random.key_data(key)).ravel()[:2].tolist()
    return (high << 32) + low
