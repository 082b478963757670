"""Trust map: largest expected trust with which each cell can be reached, per draw and robot."""

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.special import expit

from trustbo.data import Cell
from trustbo.models.params import Params
from trustbo.planning.dynamics import Dynamics
from trustbo.planning.objectives import Objective
from trustbo.planning.paths import SIMPLE_EXTRA, AdmissiblePaths
from trustbo.planning.problem import PlanningProblem
from trustbo.planning.search.case import Case
from trustbo.planning.search.compiled import plan_compiled
from trustbo.planning.search.reachable_trust import best_trust
from trustbo.planning.values import path_trust


def trust_map(
    problem: PlanningProblem,
    params: Params,
    *,
    per_robot: bool = False,
    x0: ArrayLike | None = None,
) -> xr.DataArray:
    """Compute the map of `Planner.trust_map`."""
    team = "min" if per_robot else None
    dynamics = problem.dynamics(params, x0, team=team).flat()
    like = problem.workspace.awareness.isel(feature=0, drop=True)
    if per_robot:
        robots = [_of_robot(dynamics, i) for i in range(dynamics.start.shape[-1])]
        values = np.stack([_largest_trust(problem.paths, robot) for robot in robots], axis=1)
    else:
        values, like = _largest_trust(problem.paths, dynamics), like.isel(robot=0, drop=True)
    like = like.expand_dims(draw=len(values)) if params.leading else like
    trust = like.copy(data=values if params.leading else values[0])
    return trust.rename("trust").assign_attrs(long_name="expected trust")


def cost_of(trust: xr.DataArray) -> xr.DataArray:
    """Compute the paper's cost f = 1 - sigma(trust) of a trust map."""
    cost = trust.copy(data=1.0 - expit(trust.values)).rename("cost")
    return cost.assign_attrs(long_name="cost 1 - sigma(trust)")


def summary_of(trust: xr.DataArray) -> xr.Dataset:
    """Compute `mean` and `sd` of a trust map over its draws, and the mean `cost`."""
    summary = {
        "mean": trust.mean("draw").assign_attrs(long_name="mean expected trust"),
        "sd": trust.std("draw").assign_attrs(long_name="sd of expected trust"),
        "cost": cost_of(trust).mean("draw").assign_attrs(long_name="mean cost 1 - sigma(trust)"),
    }
    return xr.Dataset(summary)


def _of_robot(dynamics: Dynamics, robot: int) -> Dynamics:
    """Dynamics whose view is one robot; its state suffices where robots do not interact."""
    n_robots, one = dynamics.start.shape[-1], slice(robot, robot + 1)
    transition, drift, start, _, sd = dynamics
    if (transition == transition * np.eye(n_robots)).all():
        return Dynamics(transition[:, one, one], drift[:, one], start[:, one], np.eye(1), sd)
    return dynamics._replace(views=np.eye(n_robots)[one])


def _largest_trust(admissible: AdmissiblePaths, dynamics: Dynamics) -> np.ndarray:
    """Largest trust of every draw and cell, shape (draw, row, col); NaN if out of reach."""
    extra = min(SIMPLE_EXTRA, admissible.longest - admissible.shortest)
    fewest = admissible.bounds_from_start
    if dynamics.is_scalar:
        beta0, x0 = dynamics.transition[:, 0, 0], dynamics.start[:, 0]
        drift = admissible.masked(dynamics.drift[:, 0])
        return best_trust(drift, beta0, x0, fewest, admissible.steps, extra)
    values = np.full((len(dynamics.start), *fewest.shape), np.nan)
    for row, col in np.argwhere(fewest >= 0).tolist():
        values[:, row, col] = _trust_at(admissible, dynamics, (row, col), extra)
    return values


def _trust_at(
    admissible: AdmissiblePaths, dynamics: Dynamics, cell: Cell, extra: int
) -> np.ndarray:
    """Largest trust at one cell, by planning a path to it: vector trust has no scalar recursion."""
    if cell == admissible.start:
        return (dynamics.start @ dynamics.views.T).min(-1)
    objective = Objective("terminal")
    best = plan_compiled(Case(admissible.to(cell, extra), dynamics, objective))
    assert best is not None  # as there is no risk  # noqa: S101
    paths = [admissible.cells(flat) for flat in best.paths]
    along = [dynamics.take(d).along(path) for d, path in enumerate(paths)]
    return np.array([path_trust(one, objective, 0.0).trust[-1] for one in along])
