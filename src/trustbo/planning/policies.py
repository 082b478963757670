"""Policies, which choose the next plan based on posterior draws.

A policy is any callable `policy(rng, params, planner) -> Plan`. A callable can be passed wherever
the name of a policy is accepted. The policies below report the trust and value of their plan for
the posterior mean of the parameters.
"""

from collections.abc import Callable

import numpy as np

from trustbo.errors import require_choice, require_finite, require_kind, require_share
from trustbo.models.draws import Draws
from trustbo.planning.draws import choose_draws
from trustbo.planning.plan import Plan
from trustbo.planning.planner import Planner
from trustbo.planning.recursion import Recursion

Policy = Callable[[np.random.Generator, Draws, Planner], Plan]
"""Function of a random generator, draws with leading axis (draw,) and a planner; returns a plan."""

N_DRAWS = 200
"""Number of draws for which `ucb` finds the best path."""
_N_DRIFTS = 1000  # number of draws whose quantiles `optimistic` computes


def greedy(rng: np.random.Generator, params: Draws, planner: Planner) -> Plan:
    """Plan the best path under the posterior mean of the parameters, as in the paper."""
    _require(rng, params, planner)
    return planner.plan(params.mean())


def thompson(rng: np.random.Generator, params: Draws, planner: Planner) -> Plan:
    """Plan the best path under one random posterior draw (probability matching)."""
    _require(rng, params, planner)
    plan = planner.plan(params.draw(int(rng.integers(params.leading[0]))))
    return planner.evaluate(plan.path, params.mean())


def optimistic(
    rng: np.random.Generator, params: Draws, planner: Planner, *, quantile: float = 0.9
) -> Plan:
    """Plan the best path for optimistic drifts.

    The drift u of each bound is a high quantile over the draws; other parameters are means.
    """
    _require(rng, params, planner)
    require_share("quantile", quantile)

    some = choose_draws(params, _N_DRIFTS, _seed(rng))
    drawn = planner.problem.recursion(some)
    optimistic = Recursion(
        transition=drawn.transition.mean(0),
        drift=np.quantile(drawn.drift, quantile, axis=0),
        start=drawn.start.mean(0),
        noise_sd=drawn.noise_sd.mean(0),
    )
    return planner.evaluate(planner.best_path(optimistic), params.mean())


def ucb(rng: np.random.Generator, params: Draws, planner: Planner, *, kappa: float = 1.0) -> Plan:
    """Choose, among the draws' best paths, that with the largest mean + `kappa` sd of the value."""
    _require(rng, params, planner)
    require_finite("kappa", kappa)

    drawn = planner.plan_draws(params, n_draws=N_DRAWS, seed=_seed(rng))
    values = drawn.values_of(drawn.candidates)
    chosen = int(np.argmax(values.mean(0) + kappa * values.std(0)))
    return planner.evaluate(drawn.candidates[chosen], params.mean())


def random(rng: np.random.Generator, params: Draws, planner: Planner) -> Plan:
    """Plan the best path for random drifts, uniform on [0, 1], without using the posterior."""
    _require(rng, params, planner)

    recursion = Recursion(
        transition=np.zeros((1, 1)),
        drift=rng.uniform(size=(1, *planner.problem.paths.bounds.shape)),
        start=np.zeros(1),
        noise_sd=np.full((), 0.1),  # matters only for censored rates
    )
    return planner.evaluate(planner.best_path(recursion), params.mean())


POLICIES: dict[str, Policy] = {
    "greedy": greedy,
    "optimistic": optimistic,
    "thompson": thompson,
    "ucb": ucb,
    "random": random,
}
"""Policies, keyed by name."""


def resolve_policy(policy: str | Policy) -> Policy:
    """Return the policy with the given name, or a given callable unchanged.

    Raises:
        TrustboError: If `policy` is neither a known name nor a callable.
    """
    return policy if callable(policy) else POLICIES[require_choice("policy", policy, POLICIES)]


def _require(rng: object, params: object, planner: object) -> None:
    """Raise TrustboError unless the arguments of a policy are of the right kinds."""
    require_kind("rng", rng, np.random.Generator, "give numpy.random.default_rng(seed)")
    require_kind("params", params, Draws, "give parameters, such as params_of(posterior)")
    require_kind("planner", planner, Planner, "give a trustbo.planning.Planner")


def _seed(rng: np.random.Generator) -> int:
    """Draw a random seed."""
    return int(rng.integers(2**63))
