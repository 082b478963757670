"""Policies, which choose the next plan based on posterior draws.

A policy is any callable `policy(rng, params, planner) -> Plan`. You can pass a callable wherever
the name of a policy is accepted. A policy with a parameter `driven` also receives the paths of all
missions, in order. The policies below report the trust and value of their plans at the posterior
mean of the parameters.
"""

import inspect
from collections.abc import Callable, Sequence

import numpy as np

from trustbo.data import Station, require_path
from trustbo.errors import (
    require_choice,
    require_finite,
    require_kind,
    require_share,
)
from trustbo.models.draws import Draws
from trustbo.planning.drawn_paths import DrawnPaths, choose_draws
from trustbo.planning.plan import Plan
from trustbo.planning.planner import Planner
from trustbo.planning.recursion import Recursion

__all__ = ["explore", "greedy", "optimistic", "random", "thompson", "ucb"]

Policy = Callable[..., Plan]
"""Function of a random generator, draws with leading axis (draw,) and a planner; returns a plan."""

N_DRAWS = 200
"""Number of draws for which `ucb` and `explore` find the best path."""
_N_REPEATED = 2
"""Number of missions on the same path after which `explore` may leave it."""
_N_DRIFTS = 1000  # number of draws whose quantiles `optimistic` computes


def greedy(rng: np.random.Generator, params: Draws, planner: Planner) -> Plan:
    """Plan the best path under the posterior mean of the parameters, as in the paper.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> plan = tb.planning.policies.greedy(rng, params, planner)
    """
    _require(rng, params, planner)
    return planner.plan(params.mean())


def thompson(rng: np.random.Generator, params: Draws, planner: Planner) -> Plan:
    """Plan the best path under one random posterior draw (probability matching).

    Example:
        >>> rng = np.random.default_rng(0)
        >>> plan = tb.planning.policies.thompson(rng, params, planner)
    """
    _require(rng, params, planner)
    plan = planner.plan(params.draw(int(rng.integers(params.n_draws))))
    return planner.evaluate(plan.stations, params.mean())


def optimistic(
    rng: np.random.Generator, params: Draws, planner: Planner, *, quantile: float = 0.9
) -> Plan:
    """Plan the best path for optimistic drifts.

    The drift u of each bound is a high quantile over the draws; other parameters are posterior
    means.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> plan = tb.planning.policies.optimistic(rng, params, planner, quantile=0.95)
    """
    _require(rng, params, planner)
    require_share("quantile", quantile)

    some = choose_draws(params, _N_DRIFTS, _seed(rng))
    drawn = planner.problem.searched(some)
    optimistic = drawn._replace(
        transition=drawn.transition.mean(0, keepdims=True),
        drift=np.quantile(drawn.drift, quantile, axis=0, keepdims=True),
        start=drawn.start.mean(0, keepdims=True),
        noise_sd=drawn.noise_sd.mean(0, keepdims=True),
    )
    return planner.evaluate(planner.best_path(optimistic), params.mean())


def ucb(rng: np.random.Generator, params: Draws, planner: Planner, *, kappa: float = 1.0) -> Plan:
    """Choose the path with the largest mean + `kappa` sd of the value from the draws' best paths.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> plan = tb.planning.policies.ucb(rng, params, planner, kappa=2.0)
    """
    _require(rng, params, planner)
    require_finite("kappa", kappa)

    drawn = planner.plan_draws(params, n_draws=N_DRAWS, seed=_seed(rng))
    return planner.evaluate(_most_promising(drawn, kappa), params.mean())


def explore(
    rng: np.random.Generator,
    params: Draws,
    planner: Planner,
    *,
    driven: Sequence[Sequence[Station]] = (),
    regret: float = 0.02,
    doubt: float = 0.1,
) -> Plan:
    """Plan like `greedy`, or like `ucb` if the plan repeats itself although it may not be the best.

    A greedy campaign may repeat a path for ever and never learn that another one is better. The
    path is therefore chosen as in `ucb` if both of the last two missions took the best path under
    the posterior mean, and if its relative regret exceeds `regret` with a probability above
    `doubt`.

    Args:
        rng: Random generator.
        params: Posterior draws, with leading axis (draw,).
        planner: Planner of the paths.
        driven: Paths of all missions, in order.
        regret: Acceptable regret of the plan, as a fraction; see `DrawnPaths.relative_regret`.
        doubt: Acceptable probability of a larger regret.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> driven = [mission.path for mission in missions]
        >>> plan = tb.planning.policies.explore(rng, params, planner, driven=driven)
    """
    plan = greedy(rng, params, planner)
    require_share("regret", regret)
    require_share("doubt", doubt)

    last = [require_path("a path in driven", path) for path in driven[-_N_REPEATED:]]
    if last != [plan.path] * _N_REPEATED:
        return plan

    drawn = planner.plan_draws(params, n_draws=N_DRAWS, seed=_seed(rng))
    if np.mean(drawn.relative_regret(plan.stations) > regret) <= doubt:
        return plan
    return planner.evaluate(_most_promising(drawn, kappa=1.0), params.mean())


def random(rng: np.random.Generator, params: Draws, planner: Planner) -> Plan:
    """Plan the best path for random drifts; ignore the posterior.

    Drifts are uniform on [0, 1] and not carried over. For the objective `"terminal"`, which would
    then be about the last bound alone, they are uniform on [-1/2, 1/2] and add up along the path.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> plan = tb.planning.policies.random(rng, params, planner)
    """
    _require(rng, params, planner)

    paths = planner.problem.paths
    shape = paths.bounds.shape if paths.workspace.n_posts == 1 else paths.pairs.shape[:1]
    at_goal = planner.problem.objective.name == "terminal"
    recursion = Recursion(
        transition=np.full((1, 1, 1), float(at_goal)),
        drift=rng.uniform(size=(1, 1, *shape)) - 0.5 * at_goal,
        start=np.zeros((1, 1)),
        noise_sd=np.full(1, 0.1),  # matters only for censored rates
        likelihood=params.likelihood,
    )
    return planner.evaluate(planner.best_path(recursion), params.mean())


POLICIES: dict[str, Policy] = {
    "explore": explore,
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


def choose_plan(
    policy: Policy,
    rng: np.random.Generator,
    params: Draws,
    planner: Planner,
    driven: Sequence[Sequence[Station]],
) -> Plan:
    """Call a policy, and pass it the paths of all missions if it has a parameter `driven`."""
    if "driven" in inspect.signature(policy).parameters:
        return policy(rng, params, planner, driven=driven)
    return policy(rng, params, planner)


def _most_promising(drawn: DrawnPaths, kappa: float) -> tuple[Station, ...]:
    """Return the candidate with the largest mean + `kappa` sd of its value over the draws."""
    values = drawn.values_of(drawn.candidates)
    chosen = int(np.argmax(values.mean(0) + kappa * values.std(0)))
    return drawn.candidates[chosen]


def _require(rng: object, params: object, planner: object) -> None:
    """Raise TrustboError unless the arguments of a policy are of the right kinds."""
    require_kind("rng", rng, np.random.Generator, "give numpy.random.default_rng(seed)")
    require_kind("params", params, Draws, "give parameters, such as params_of(posterior)")
    require_kind("planner", planner, Planner, "give a trustbo.planning.Planner")


def _seed(rng: np.random.Generator) -> int:
    """Draw a random seed."""
    return int(rng.integers(2**63))
