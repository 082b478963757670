"""Values of given paths under given dynamics, and the plan of a given path."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from trustbo.data import Cell
from trustbo.models.params import Params
from trustbo.planning.dynamics import Dynamics, as_map, roll, trust_dynamics
from trustbo.planning.objectives import OBJECTIVES, Objective, PathTrust, softplus
from trustbo.planning.plan import QUANTILES, Plan
from trustbo.planning.problem import PlanningProblem
from trustbo.planning.tolls import toll_along, unseen_along

Path = Sequence[Cell] | np.ndarray
"""Cells, start first; or an array of them, shape (cell, 2)."""


def path_trust(
    along: Dynamics, objective: Objective, toll: float, *, cap: bool = True
) -> PathTrust:
    """Trust on the path whose bounds `along` has, and what `SCORES` and `OBJECTIVES` need of it.

    Args:
        along: Recursion of expected trust on the path, see `Dynamics.along`.
        objective: Objective of the values.
        toll: Toll of the path, see `tolls`.
        cap: False to keep trust above 1 for `lost_contact`, see `Objective.capped`.
    """
    along = objective.capped(along) if cap else along
    trust = (roll(along) @ along.views.T).min(-1)
    steady_state = lost = np.full(trust.shape, np.nan)
    if objective.name == "stationary":
        steady_state = along.steady_state()[..., 0, 0, :]
    if objective.name == "lost_contact":
        lost = objective.contact_lost(trust, along.noise_sd)
    return PathTrust(trust, steady_state, toll, lost)


def entry_cost(passable: np.ndarray, dynamics: Dynamics) -> np.ndarray:
    """Cost of each bound for `stationary`, shape (..., move, row, col); inf where there is none."""
    trust = dynamics.steady_state()
    possible = passable & ~np.isnan(trust)
    return np.where(possible, softplus(-np.where(possible, trust, 0.0)), np.inf)


class Value(NamedTuple):
    """Value of a path, without its risk."""

    draws: np.ndarray
    """Expected trust under every draw, (draw, bound, robot)."""
    value: float
    values: np.ndarray
    """Value under every draw, (draw,)."""
    success_index: float


def value_along(
    params: Params,
    awareness: np.ndarray,
    objective: Objective,
    team: str,
    toll: float,
    x0: ArrayLike | None = None,
) -> Value:
    """Compute the value of a path from the parameters and awareness of its bounds.

    Awareness (bound, robot, feature), or with a leading axis (draw,).
    """
    z = as_map(awareness)
    draws = roll(trust_dynamics(params, z, "min", x0))
    draws = draws.reshape(-1, *draws.shape[-2:])
    value_of, trust = OBJECTIVES[objective.name], draws.mean(0)
    of_team, teams = (t.mean(-1) if team == "mean" else t.min(-1) for t in (trust, draws))
    if objective.name in ("stationary", "lost_contact"):
        dynamics = trust_dynamics(params, z, team, x0)
        value = value_of(path_trust(dynamics, objective, toll)).mean()
        # Trust capped draw by draw is biased, so that the band is of trust as it is; but no path
        # loses less than nothing.
        values = value_of(path_trust(dynamics, objective, toll, cap=False))
        if objective.name == "lost_contact":
            values = np.minimum(values, -toll)
    else:
        values, value = (value_of(PathTrust(t, t, toll)) for t in (teams, of_team))
    index = float(np.exp(-softplus(-of_team).sum()))
    return Value(draws, float(value), np.atleast_1d(values), index)


def evaluate(
    problem: PlanningProblem,
    path: tuple[Cell, ...],
    params: Params,
    x0: ArrayLike | None = None,
) -> Plan:
    """Evaluate a path that is not checked; see `Planner.evaluate`."""
    flat, grid = np.fromiter(itertools.chain.from_iterable(path), int), problem.workspace.grid
    cells = flat.reshape(-1, 2)
    rows, cols = cells.T
    z, along = problem.awareness_along(cells), params.along(cells)
    paid = problem.paths, problem.objective, cells
    kind = problem.objective, problem.team
    found = value_along(along, z, *kind, toll_along(*paid), x0)
    cost, draws = problem.cost_of_failure(cells), found.draws
    risk = None if problem.risk is None else problem.risk.along(cells)
    return Plan(
        path=path,
        positions=np.stack([grid.x[cols], grid.y[rows]], axis=1),
        length=problem.paths.length_of(cells),
        trust=draws.mean(0),
        bands=bands_of(draws),
        value=found.value - cost,
        success_index=found.success_index,
        objective=problem.objective.name,
        exact=False,
        bound=np.nan,
        revisits=len(path) - len(set(path)),
        engine="given",
        seconds=0.0,
        workspace=problem.workspace,
        risk=risk,
        infeasible=risk is not None and not problem.is_within_risk(cells),
        value_band=_value_band(found.values - cost),
        unseen_toll=unseen_along(*paid),
    )


def bands_of(trust: np.ndarray) -> np.ndarray:
    """Quantiles over draws (draw, bound, robot); one draw is repeated for every quantile."""
    if len(trust) == 1:
        return np.repeat(trust, len(QUANTILES), axis=0)
    return np.quantile(trust, QUANTILES, axis=0)


def _value_band(values: np.ndarray) -> tuple[float, float] | None:
    """Ends of the 90 % band of values over draws; None for one draw."""
    if len(values) == 1:
        return None
    low, high = np.quantile(values, (QUANTILES[0], QUANTILES[-1]))
    return float(low), float(high)
