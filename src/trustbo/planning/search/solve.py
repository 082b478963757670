"""Search for the best path: validity of the objective, choice of the engine, upper limits."""

import networkx as nx
import numpy as np
from scipy.special import expit, logit

from trustbo.data import Cell
from trustbo.errors import TrustboError
from trustbo.hazard.risk import Risk
from trustbo.planning.dynamics import Dynamics
from trustbo.planning.objectives import Objective
from trustbo.planning.problem import PlanningProblem
from trustbo.planning.risk import InfeasibleError, RiskRule
from trustbo.planning.search.case import Case
from trustbo.planning.search.compiled import plan_compiled, safest_path
from trustbo.planning.search.graph import Best
from trustbo.planning.search.reference import on_map, plan_networkx, with_costs
from trustbo.planning.tolls import tolls_of
from trustbo.planning.values import entry_cost
from trustbo.workspace.moves import move_indices

ENGINES = ("auto", "networkx", "numba")
EXACT = 1e-12
"""Largest optimality gap, in trust or log probability, of a path that counts as exact."""


def find_paths(problem: PlanningProblem, dynamics: Dynamics, engine: str) -> Best:
    """Find the best path under every draw of `dynamics`, or the only one.

    InfeasibleError: no path respects `max_failure`, unless the rule is to plan the safest.
    """
    require_valid(dynamics, problem.objective)
    case = Case(problem.paths, problem.objective.capped(dynamics).flat(), problem.objective)
    search = plan_networkx if engine == "networkx" else plan_compiled
    risk = problem.risk_table
    if (best := search(case._replace(risk=risk))) is not None:
        return best
    assert risk is not None and problem.risk is not None  # noqa: S101, PT018
    path, limit = safest_path(problem.paths, problem.objective.name, risk.at_mean)
    if problem.rule.infeasible == "refuse":
        raise _infeasible(problem.rule, problem.risk, path)
    # The best of those that are as safe, as rounding tells them apart.
    safest = risk.within(limit + 1e-12 * max(1.0, limit))
    best = search(case._replace(risk=safest))
    assert best is not None  # noqa: S101
    return best


def _infeasible(rule: RiskRule, risk: Risk, path: tuple[Cell, ...]) -> InfeasibleError:
    p_fail, most = 1.0 - risk.survival(path), rule.max_failure or 0.0
    return InfeasibleError(
        f"no admissible path from {path[0]} to {path[-1]} fails with a chance of at most "
        f"max_failure = {most:g}; the least is {p_fail:.4g}, on the path {path}. Raise "
        "max_failure, admit more paths by max_bounds, or plan the safest, infeasible='safest'.",
        path,
        p_fail,
    )


def graph_of(problem: PlanningProblem, dynamics: Dynamics) -> nx.DiGraph:
    """Build the graph of `Planner.graph_of`, `dynamics` without leading axes."""
    paths, values = problem.paths, {}
    require_valid(dynamics, problem.objective._replace(name="stationary"))
    if problem.risk is not None:
        p_fail = problem.risk.p_fail[move_indices(paths.connectivity)]
        with np.errstate(divide="ignore"):
            values["risk"] = -np.log1p(-p_fail)
    values["drift"] = np.tensordot(dynamics.views.mean(0), dynamics.drift, 1)
    tolls = tolls_of(paths, problem.objective)
    if problem.objective.name == "lost_contact":
        values["lost"] = settled_loss(problem.objective, dynamics) + on_map(paths, tolls)
    return with_costs(paths, entry_cost(paths.passable, dynamics), tolls, **values)


def settled_loss(objective: Objective, dynamics: Dynamics) -> np.ndarray:
    """Contact lost in each bound once trust has settled on it, (move, row, col), in bounds.

    The sum along a path is the loss of lost_contact but for the memory of trust: with drifts u and
    beta0 = b, sum_k x_k = sum_k u_k (1 - b^(K - k + 1)) / (1 - b) + terms of x0 and K alone, of
    which this keeps u_k / (1 - b).
    """
    settled = objective.capped(dynamics).steady_state()
    return 1.0 - objective.family.rate_moments(settled, dynamics.noise_sd)[0]


def require_valid(dynamics: Dynamics, objective: Objective) -> None:
    """Refuse dynamics for which an objective is undefined or not planned exactly.

    TrustboError: success, bottleneck or lost_contact with beta0 < 0; stationary with abs(beta0) >=
    1.
    """
    beta0 = np.diagonal(dynamics.transition, axis1=-2, axis2=-1)
    if (objective.has_labels or objective.name == "lost_contact") and (beta0 < 0.0).any():
        raise TrustboError(
            f"objective {objective.name!r} needs beta0 >= 0; got {beta0.min():g}. Use "
            "'terminal' or 'mean'."
        )
    if objective.name == "stationary":
        radius = np.abs(np.linalg.eigvals(dynamics.transition))
        if (radius >= 1.0).any():
            raise TrustboError(
                f"objective 'stationary' needs abs(beta0) < 1; got {radius.max():g}. Use "
                "'terminal' or 'mean'."
            )


def value_limit(objective: str, value: float, gap: float) -> float:
    """Upper limit on the value of every admissible path from a path's value and gap."""
    if gap <= EXACT:
        return value
    if objective == "terminal":
        return float(expit(logit(value) + gap))
    return value * float(np.exp(gap)) if objective == "success" else value + gap
