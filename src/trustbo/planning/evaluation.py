"""Trust, value, bands and risk of a given path."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from trustbo.data import Station
from trustbo.models.draws import Draws
from trustbo.planning.objectives import capped
from trustbo.planning.plan import QUANTILES, Plan
from trustbo.planning.problem import Problem
from trustbo.planning.recursion import states_along, trust_recursion


def evaluated(
    problem: Problem,
    path: tuple[Station, ...],
    given: Draws,
    draws: Draws | None,
    x0: ArrayLike | None,
) -> Plan:
    """Return a plan for a path: trust and value are those of `given`, averaged over its draws.

    The bands are quantiles over `draws` or, if None, over the draws of `given`.
    """
    cost = problem.failure_along(path)

    trust, value, values = _value_along(problem, path, given, x0)
    drawn = trust
    if draws is not None:
        drawn, _, values = _value_along(problem, path, draws, x0)

    bands = np.repeat(drawn, len(QUANTILES), axis=0)
    value_band = None
    if len(drawn) > 1:
        bands = np.quantile(drawn, QUANTILES, axis=0)
        low, high = np.quantile(values - cost, (QUANTILES[0], QUANTILES[-1])).tolist()
        value_band = low, high

    return Plan(
        path=path,
        trust=trust.mean(0),
        bands=bands,
        value=value - cost,
        objective=problem.objective.name,
        exact=False,
        limit=np.nan,
        seconds=0.0,
        workspace=problem.paths.workspace,
        risk=None if problem.risk is None else problem.risk.along(path),
        infeasible=not problem.is_within_limit(path),
        value_band=value_band,
        price_of_failure=cost,
    )


def _value_along(
    problem: Problem, path: Sequence[Station], params: Draws, x0: ArrayLike | None
) -> tuple[np.ndarray, float, np.ndarray]:
    """Compute trust (draw, bound, robot), the value of a path, and the value for each draw.

    The values do not include the expected cost of failure.
    """
    x0 = problem.initial_trust(x0)
    z, bounds = problem.along(path)

    by_robot = trust_recursion(params, z, x0, bounds=bounds, by_robot=True)
    trust = states_along(by_robot)
    bound_cost = problem.bound_cost_along(path)
    values = problem.value_along(bound_cost, trust.mean(-1), by_robot)
    if not problem.objective.of_contact:
        value = problem.value_along(bound_cost, trust.mean((0, -1)), by_robot)
        return trust, float(value), values

    # Capping the trust of each draw causes bias, so the value of each draw uses uncapped trust.
    # However, the contact lost on a path cannot be negative.
    team = by_robot if params.by_robot else by_robot.of_team()
    team = capped(problem.objective, team)
    mean = problem.value_along(bound_cost, states_along(team).mean(-1), team).mean()
    return trust, float(mean), np.minimum(values, -bound_cost)
