"""The planning problem: workspace, admissible paths, objective and team."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.data import Cell
from trustbo.errors import (
    ShapeError,
    TrustboError,
    require_choice,
    require_kind,
    require_not_negative,
)
from trustbo.hazard.risk import Risk
from trustbo.inference.draws import params_of
from trustbo.models.params import Params
from trustbo.planning.dynamics import TEAMS, Dynamics, trust_dynamics
from trustbo.planning.objectives import OBJECTIVES, TOLLED, Objective
from trustbo.planning.paths import AdmissiblePaths
from trustbo.planning.risk import NO_RULE, RiskRule, RiskTable, risk_table
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVES, along, move_indices


@dataclass(frozen=True, eq=False)
class PlanningProblem:
    """Workspace, admissible paths and objective: the data of a `Planner`.

    Trust of the `team` is the `"mean"` or the least (`"min"`) of its robots'. `rule` limits the
    chance that a plan fails, and `risk` has the chances that its bounds do.

    TrustboError: unknown team or objective; a length weight that is negative, or for success or
    bottleneck.
    """

    paths: AdmissiblePaths
    objective: Objective
    team: str
    rule: RiskRule = NO_RULE
    risk: Risk | None = None

    def __post_init__(self) -> None:
        self.rule.checked(self.objective.name)
        require_objective(self.objective, self.team)
        if self.objective.unseen_cost:
            _ = self.paths.unseen  # which refuses a workspace without line of sight

    @property
    def workspace(self) -> Workspace:
        """Workspace of the admissible paths."""
        return self.paths.workspace

    def awareness_along(self, path: Sequence[Cell] | np.ndarray) -> np.ndarray:
        """Awareness of a path's bounds, shape (bound, robot, feature)."""
        return np.swapaxes(along(self.workspace.bound_maps, path), 0, 1)

    def with_risk(self, risk: Risk | None) -> Self:
        """Return the problem with a risk; ShapeError if it is not of the workspace's cells."""
        expected = (len(MOVES[8]), *self.paths.passable.shape)
        if risk is not None and risk.p_fail.shape != expected:
            raise ShapeError(f"p_fail must have shape {expected}; got {risk.p_fail.shape}.")
        return replace(self, risk=risk)

    @cached_property
    def risk_table(self) -> RiskTable | None:
        """Risks of the bounds and their limits, None where plans do not depend on them.

        TrustboError: there is a limit and no risk, or what `risk_table` raises.
        """
        if self.risk is None:
            if self.rule.max_failure is not None:
                raise TrustboError(
                    f"max_failure = {self.rule.max_failure:g} needs the chance of each bound to "
                    "fail; use planner.with_risk(p_fail)."
                )
            return None
        return risk_table(self.risk, self.rule, self.failure_cost, self.paths)

    def is_within_risk(self, path: Sequence[Cell] | np.ndarray) -> bool:
        """Whether a path keeps within `max_failure`; True without one."""
        if self.rule.max_failure is None or (table := self.risk_table) is None:
            return True
        return table.is_feasible(table.along(path, self.paths.passable.shape))

    @property
    def failure_cost(self) -> float:
        """Cost of a failure, in bounds; 0 for other objectives than lost_contact."""
        if self.objective.name != "lost_contact":
            return 0.0
        cost = self.rule.failure_cost
        return float(self.paths.shortest) if cost is None else cost

    def cost_of_failure(self, path: Sequence[Cell] | np.ndarray) -> float:
        """`failure_cost` times the chance that a path fails, 0 without a risk."""
        if self.risk is None or self.failure_cost == 0.0:
            return 0.0
        return self.failure_cost * self.risk.priced(path)

    def onward(self, done: Sequence[Cell]) -> Self:
        """Return the problem of the rest of a mission that entered the cells `done`, start first.

        Bounds already made count towards the limit on their number, and their risk towards
        `max_failure`. The value of a plan is that of the rest alone: for `mean`, the mean over the
        bounds still to come. Raises what `AdmissiblePaths.onward` raises.
        """
        paths, rule, most = self.paths.onward(done), self.rule, self.rule.max_failure
        if self.risk is not None and most is not None and len(done) > 1:
            survived = self.risk.survival(done)
            rule = rule._replace(max_failure=max(0.0, 1.0 - (1.0 - most) / max(survived, 1e-300)))
        return replace(self, paths=paths, rule=rule)

    def dynamics(
        self, params: Params, x0: ArrayLike | None = None, *, team: str | None = None
    ) -> Dynamics:
        """Build the recursion of expected trust.

        `x0` is by default `params.x0_mean`, and `team` the problem's.
        """
        maps, moves = self.workspace.bound_maps, move_indices(self.paths.connectivity)
        z = maps if maps.shape[1] == 1 else maps[:, moves]
        return trust_dynamics(params, z, team or self.team, x0, moves)


def require_objective(objective: Objective, team: str) -> None:
    """Refuse an objective or a team that is unknown, or that cannot be together: TrustboError."""
    name = objective.name
    require_choice("objective", name, OBJECTIVES)
    require_choice("team", team, TEAMS)
    for weight in ("length_weight", "unseen_cost"):
        per_unit = require_not_negative(weight, getattr(objective, weight))
        if per_unit and name not in TOLLED:
            raise TrustboError(f"{weight} is for {', '.join(TOLLED)}; the objective is {name!r}.")


def draws_of(posterior: Params | xr.DataTree, *, day: bool = False) -> Params:
    """Return parameters unchanged, or the draws of a posterior: leading axis (draw,).

    `day`: see `params_of`. TrustboError: another object.
    """
    if isinstance(posterior, xr.DataTree):
        return params_of(posterior, day=day)
    return require_kind("posterior", posterior, Params, "give one of fit, or draws of parameters")


def mean_of(params: Params | xr.DataTree) -> Params:
    """Return one draw of parameters unchanged, or the mean of several, or of a posterior."""
    draws = draws_of(params)
    return draws.mean() if draws.leading else draws
