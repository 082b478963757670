"""Policies: from posterior draws to the next plan.

A policy is any callable `policy(key, posterior, planner) -> Plan`; your own may be passed wherever
a name may. Whatever a path was chosen by, what its plan expects is expected under the posterior
mean. Where the awareness is uncertain, the planner holds a map for each draw, and the i-th
draw of the parameters goes with the i-th of these.
"""

from collections.abc import Callable, Mapping

import jax
import numpy as np
from jax import Array

from trustbo.errors import TrustboError, require_choice
from trustbo.models.params import Params
from trustbo.planning.dynamics import Dynamics
from trustbo.planning.information import information_gain
from trustbo.planning.plan import Plan
from trustbo.planning.planner import Planner
from trustbo.planning.posterior import choose
from trustbo.planning.walks import walks_of

Policy = Callable[[Array, Params, Planner], Plan]
"""Chooses the next plan, given a random key, draws with leading axis (draw,), and the planner."""

N_DRAWS = 200
"""Draws that the policies which compare paths plan under."""


def greedy(key: Array, posterior: Params, planner: Planner) -> Plan:
    """Best path under the posterior mean of the parameters (the paper's)."""
    return planner.plan(posterior.mean())


def thompson(key: Array, posterior: Params, planner: Planner) -> Plan:
    """Best path under one posterior draw taken at random (probability matching)."""
    index = int(jax.random.randint(key, (), 0, posterior.leading[0]))
    plan = planner.of_draw(index).plan(posterior.draw(index))
    return planner.evaluate(plan.path, posterior.mean())


def optimistic(key: Array, posterior: Params, planner: Planner, *, quantile: float = 0.9) -> Plan:
    """Best path if each cell adds the upper quantile over draws of what it may add to trust."""
    params, chosen = choose(posterior, 1000, _seed(key))
    moves = planner.dynamics(params, draws=chosen)
    best = Dynamics(
        moves.transition.mean(0),
        np.quantile(moves.drift, quantile, axis=0),
        moves.start.mean(0),
        moves.views,
    )
    return planner.evaluate(planner.best_path(best), posterior.mean())


def ucb(key: Array, posterior: Params, planner: Planner, *, kappa: float = 1.0) -> Plan:
    """The path with the highest mean plus `kappa` sd of its value over draws."""
    return _best_candidate(
        key, posterior, planner, lambda values: values.mean(0) + kappa * values.std(0)
    )


def ei(key: Array, posterior: Params, planner: Planner) -> Plan:
    """The path expected to improve most on the one that is best on average.

    E[max(0, value - incumbent's value)] over draws, both under the same draw; the incumbent itself
    is taken where nothing is expected to improve on it.
    """

    def improvement(values: np.ndarray) -> np.ndarray:
        incumbent = values[:, [np.argmax(values.mean(0))]]
        return np.maximum(0.0, values - incumbent).mean(0) + 1e-12 * values.mean(0)

    return _best_candidate(key, posterior, planner, improvement)


def cvar(key: Array, posterior: Params, planner: Planner, *, alpha: float = 0.2) -> Plan:
    """The path with the best mean over its worst share `alpha` of draws (risk-averse)."""

    def tail(values: np.ndarray) -> np.ndarray:
        n_worst = max(1, round(alpha * len(values)))
        return np.sort(values, axis=0)[:n_worst].mean(0)

    return _best_candidate(key, posterior, planner, tail)


def information(key: Array, posterior: Params, planner: Planner, *, n_random: int = 50) -> Plan:
    """The path that most reduces the entropy of the parameters (see `information_gain`).

    Of the draws' best paths and some drawn at random.
    """
    drawn = planner.plan_draws(posterior, n_draws=N_DRAWS, seed=_seed(key))
    rng = np.random.default_rng(_seed(key))
    paths = list(drawn.candidates) + [walks_of(planner.course).draw(rng) for _ in range(n_random)]
    params, _ = choose(posterior, N_DRAWS, _seed(key))
    gains = information_gain(params, planner.mean_awareness, paths)
    return planner.evaluate(paths[int(np.argmax(gains))], posterior.mean())


def epsilon_greedy(
    key: Array, posterior: Params, planner: Planner, *, epsilon: float = 0.1
) -> Plan:
    """Greedy; but, with probability `epsilon`, a random path."""
    chance, other = jax.random.split(key)
    explores = float(jax.random.uniform(chance)) < epsilon
    return (random if explores else greedy)(other, posterior, planner)


def random(key: Array, posterior: Params, planner: Planner) -> Plan:
    """A path drawn uniformly from the admissible ones, whatever was learned.

    For `stationary`, which admits simple paths of any length, from those of up to two bounds more
    than the fewest.

    Raises:
        TrustboError: Walks must not enter a cell twice, and of 10 000 drawn every one did.
    """
    path = walks_of(planner.course).draw(np.random.default_rng(_seed(key)))
    return planner.evaluate(path, posterior.mean())


POLICIES: Mapping[str, Policy] = {
    "greedy": greedy,
    "optimistic": optimistic,
    "thompson": thompson,
    "information": information,
    "ucb": ucb,
    "ei": ei,
    "epsilon_greedy": epsilon_greedy,
    "cvar": cvar,
    "random": random,
}
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


def _best_candidate(
    key: Array,
    posterior: Params,
    planner: Planner,
    score: Callable[[np.ndarray], np.ndarray],
) -> Plan:
    """Of the paths that are best under some draw, the one whose values (draw, path) score best."""
    drawn = planner.plan_draws(posterior, n_draws=N_DRAWS, seed=_seed(key))
    chosen = int(np.argmax(score(drawn.values_of(drawn.candidates))))
    return planner.evaluate(drawn.candidates[chosen], posterior.mean())


def _seed(key: Array) -> int:
    high, low = np.asarray(jax.random.key_data(key)).ravel()[:2].tolist()
    return (high << 32) + low
