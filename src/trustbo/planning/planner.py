"""The planner of a user: one workspace, one start and goal, one objective."""

import time
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import Self

import networkx as nx
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.data import Cell
from trustbo.display import Rows, Summary
from trustbo.errors import require_choice
from trustbo.hazard.risk import Risk
from trustbo.hazard.strata import Strata
from trustbo.models.families import FAMILIES
from trustbo.models.params import Params
from trustbo.planning.dynamics import Dynamics
from trustbo.planning.objectives import DEFAULT_MAX_BOUNDS, Objective
from trustbo.planning.paths import AdmissiblePaths, PathClass
from trustbo.planning.plan import Plan
from trustbo.planning.posterior import DrawnPaths, choose_draws
from trustbo.planning.problem import PlanningProblem, draws_of, mean_of
from trustbo.planning.risk import RiskRule
from trustbo.planning.search import solve
from trustbo.planning.trust_map import cost_of, summary_of, trust_map
from trustbo.planning.values import evaluate
from trustbo.workspace import Workspace
from trustbo.workspace.location import Location


class Planner(Summary):
    """Search for the most trustworthy path of a workspace.

    Attributes:
        problem: Planning problem, from which all that follows is taken but the engine.
        workspace: Planning grid with awareness and passability.
        paths: Admissible paths, with tables of the grid.
        start: First cell.
        goal: Last cell.
        shortest: Fewest bounds from start to goal.
        longest: Largest number of bounds of an admissible path.
        max_bounds: Limit on the number of bounds, as given.
        connectivity: 4 or 8.
        objective: Name of the objective.
        team: `"mean"` or `"min"`.
        engine: `"auto"`, `"networkx"` or `"numba"`.
    """

    def __init__(
        self,
        workspace: Workspace,
        start: Location,
        goal: Location,
        objective: str = "lost_contact",
        *,
        connectivity: int = 8,
        max_bounds: int | str | None = None,
        team: str = "mean",
        length_weight: float = 0.0,
        unseen_cost: float = 0.0,
        engine: str = "auto",
        observation: str = "gaussian",
        max_failure: float | None = None,
        failure_cost: float | None = None,
        infeasible: str = "refuse",
    ) -> None:
        """Prepare to plan.

        Args:
            workspace: Planning grid with awareness and passability.
            start: First cell, or a position in it; see `Workspace.locate`.
            goal: Last cell, or a position in it.
            objective: `"lost_contact"`, `"terminal"`, `"mean"`, `"success"`, `"bottleneck"` or
                `"stationary"`; see `OBJECTIVES`.
            connectivity: 4, or 8 to allow diagonal bounds too.
            max_bounds: Limit on the number of bounds. `"shortest"`: the fewest possible;
                `"shortest+n"`: up to n more, without U-turns (default: n = 2 for terminal and mean,
                4 for lost_contact); paths are simple for n up to 2, and `Plan.revisits` counts
                cells entered again for larger n. An int: walks of at most that many bounds
                (default for success and bottleneck: shortest + 8). Without effect on stationary,
                whose admissible paths are all simple paths.
            team: Trust of the team: `"mean"` or `"min"` (least) of that of its robots.
            length_weight: Cost of a metre of the path, for lost_contact (in bounds), terminal and
                mean (in units of trust), success and stationary (in units of log probability).
            unseen_cost: Cost of a bound in which nobody sees anybody, in the same units: a path
                pays this times the sum over its bounds of the share of their time that
                `Workspace.unseen_bounds` expects so.
            engine: `"numba"`, compiled, which `"auto"` takes; or `"networkx"`, the reference. Both
                find paths of the same value.
            observation: Family of the contact rates, that of the trust model; for
                lost_contact.
            max_failure: Largest chance that a path fails, in [0, 1), under the risk of `with_risk`;
                by default no limit.
            failure_cost: Cost of a failure for lost_contact, in bounds: its value is less by this
                times the chance to fail. By default the fewest bounds from start to goal, so that
                a mission that fails counts as one that lost all contact.
            infeasible: Response to a `max_failure` that no path respects, `"refuse"` or
                `"safest"`: plan the best of the safest paths.

        Raises:
            TrustboError: Start or goal off the grid, impassable, or equal; an unknown name;
                `max_bounds` below the fewest possible; a length weight or an unseen cost that is
                negative, or for bottleneck; an unseen cost without a terrain in memory.
            NoPathError: The goal cannot be reached.
        """
        self.engine = require_choice("engine", engine, solve.ENGINES)
        family = FAMILIES[require_choice("observation", observation, FAMILIES)]
        if max_bounds is None:
            max_bounds = DEFAULT_MAX_BOUNDS.get(objective, "shortest+2")
        admitted = PathClass(connectivity, max_bounds)
        paths = AdmissiblePaths(workspace, start, goal, admitted)
        rule = RiskRule(max_failure, failure_cost, infeasible)
        chosen = Objective(objective, length_weight, family, unseen_cost)
        self._hold(PlanningProblem(paths, chosen, team, rule=rule))

    def _rows(self) -> Rows:
        rows = [
            ("from", f"{self.start} to {self.goal}, {self.connectivity} directions"),
            ("objective", f"{self.objective}, {self.team} of the robots"),
            ("paths", f"{self.shortest} to {self.longest} bounds ({self.max_bounds})"),
            ("rates", self.family.name),
            ("risk", "of each bound" if self.problem.risk is not None else "not known"),
            ("engine", self.engine),
        ]
        return rows

    def _hold(self, problem: PlanningProblem) -> None:
        paths = problem.paths
        self.problem, self.workspace, self.paths = problem, problem.workspace, paths
        self.start, self.goal = paths.start, paths.goal
        self.shortest, self.longest = paths.shortest, paths.longest
        self.max_bounds, self.connectivity = paths.max_bounds, paths.connectivity
        self.objective, _, self.family, _ = problem.objective
        self.team = problem.team

    def _with(self, problem: PlanningProblem) -> Self:
        other = copy(self)
        other._hold(problem)
        return other

    @property
    def graph(self) -> nx.DiGraph:
        """Graph of passable cells; nodes with `x`, `y` (CRS metres), edges with `length` (m)."""
        return self.paths.graph

    def graph_of(self, params: Params | xr.DataTree) -> nx.DiGraph:
        """Build `graph` with the costs of its bounds, for any algorithm of networkx.

        Attributes of the edges: `length` (m); `drift` of the team's mean trust; `cost`, that of
        `stationary`: -log sigma of the trust that the bound would lead to if all were like it, and
        the toll; for lost_contact of rates that measure trust `lost`, the contact that the bound
        would lose then, in bounds, and the toll; and with a risk `risk`, -log(1 - p_fail).

        Args:
            params: Posterior or parameters, whose mean is taken.

        Raises:
            TrustboError: abs(beta0) >= 1, for which trust settles nowhere.
        """
        return solve.graph_of(self.problem, self.problem.dynamics(mean_of(params)))

    def require_path(self, path: Sequence[Cell]) -> tuple[Cell, ...]:
        """Return a path as a tuple of cells; refuse a broken one, or one between other ends."""
        return self.paths.require_path(path)

    def avoiding(self, bounds: np.ndarray, risk: np.ndarray) -> Self:
        """Return the planner of paths without some bounds; see `AdmissiblePaths.avoiding`."""
        return self._with(replace(self.problem, paths=self.paths.avoiding(bounds, risk)))

    def with_observation(self, observation: str) -> Self:
        """Return the planner for contact rates of another family, see `Planner`."""
        family = FAMILIES[require_choice("observation", observation, FAMILIES)]
        if family is self.family:  # what the problem has computed stays
            return self
        objective = self.problem.objective._replace(family=family)
        return self._with(replace(self.problem, objective=objective))

    def with_objective(self, objective: str) -> Self:
        """Return the planner of another objective, with the same admissible paths.

        A cost of failure is dropped unless the objective is lost_contact.

        Raises:
            TrustboError: An unknown objective, or one that admits no length weight where there is
                one.
        """
        chosen, rule = self.problem.objective._replace(name=objective), self.problem.rule
        if objective != "lost_contact":
            rule = rule._replace(failure_cost=None)
        return self._with(replace(self.problem, objective=chosen, rule=rule))

    def with_risk(
        self,
        p_fail: ArrayLike | None,
        draws: ArrayLike | None = None,
        causes: Mapping[str, ArrayLike] | None = None,
        strata: Strata | None = None,
    ) -> Self:
        """Return the planner with the chance of each bound to end the mission.

        Plans then have `p_arrive`, respect `max_failure`, and pay `failure_cost` in lost_contact.

        Args:
            p_fail: Posterior mean, shape (move, row, col) with the moves of `workspace.moves.MOVES`
                for connectivity 8; NaN where there is no bound. None: no risk.
            draws: Draws from its posterior, shape (draw, move, row, col), for bands of `p_arrive`.
            causes: Share of each cause of failure, numbers or arrays (move, row, col).
            strata: Chances under groups of draws, such as `BoundRisk.strata()`, by which a failure
                is priced; by default `p_fail`, as if bounds failed independently.

        Raises:
            ShapeError: Other shapes.
            TrustboError: A chance outside [0, 1].
        """
        if p_fail is None:
            return self._with(self.problem.with_risk(None))
        drawn = None if draws is None else np.asarray(draws, dtype=float)
        risk = Risk(np.asarray(p_fail, dtype=float), drawn, dict(causes or {}), strata)
        return self._with(self.problem.with_risk(risk))

    def with_failure_cost(self, failure_cost: float) -> Self:
        """Return the planner with another cost of a failure, in bounds.

        Objectives other than lost_contact have no such cost, and their planner is unchanged.

        Raises:
            TrustboError: It is negative, or not finite.
        """
        if self.objective != "lost_contact":
            return self
        rule = self.problem.rule._replace(failure_cost=failure_cost)
        return self._with(replace(self.problem, rule=rule))

    def onward(self, done: Sequence[Cell]) -> Self:
        """Return a planner for the rest of a mission; see `PlanningProblem.onward`."""
        return self._with(self.problem.onward(done))

    def dynamics(self, params: Params, x0: ArrayLike | None = None) -> Dynamics:
        """Build the recursion of expected trust; see `PlanningProblem.dynamics`."""
        return self.problem.dynamics(params, x0)

    def plan(self, params: Params | xr.DataTree, *, x0: ArrayLike | None = None) -> Plan:
        """Find the best admissible path for given parameters, or for the mean of a posterior.

        Args:
            params: Posterior of `fit`, or parameters; of several draws, the path is that of their
                mean, and the bands are over the draws, see `evaluate`.
            x0: Expected trust at the start, shape () or (robot,); by default `params.x0_mean`.

        Raises:
            ShapeError: Parameters of other robots or features.
            TrustboError: beta0 outside the range that the objective is exact for.
            InfeasibleError: No path respects `max_failure`.
        """
        started = time.perf_counter()
        mean = mean_of(params)
        best = solve.find_paths(self.problem, self.problem.dynamics(mean, x0), self.engine)
        plan = evaluate(self.problem, self.paths.cells(best.paths[0]), mean, x0)
        if mean is not params:
            plan = plan.with_draws(self.evaluate(plan.path, params, x0=x0))
        gap = float(best.gap[0])
        return replace(
            plan,
            exact=gap <= solve.EXACT,
            bound=solve.value_limit(self.objective, plan.value, gap),
            engine="networkx" if self.engine == "networkx" else "numba",
            seconds=time.perf_counter() - started,
        )

    def best_path(self, dynamics: Dynamics) -> tuple[Cell, ...]:
        """Find the best admissible path under other dynamics, such as an optimistic drift.

        Args:
            dynamics: Recursion of expected trust without leading axes; see `dynamics`.

        Raises:
            TrustboError: beta0 is outside the range the objective is exact for.
        """
        best = solve.find_paths(self.problem, dynamics, self.engine)
        return self.paths.cells(best.paths[0])

    def plan_draws(
        self, posterior: Params | xr.DataTree, *, n_draws: int | None = None, seed: int = 0
    ) -> DrawnPaths:
        """Find the best path under every draw.

        Args:
            posterior: Posterior of `fit`, or draws with leading axis (draw,).
            n_draws: Number of draws, taken at random without replacement; by default all.
            seed: Seed of the choice of draws.

        Raises:
            TrustboError: beta0 of a draw is outside the range the objective is exact for.
        """
        params, chosen = choose_draws(draws_of(posterior), n_draws, seed)
        dynamics = self.problem.dynamics(params)
        best = solve.find_paths(self.problem, dynamics, self.engine)
        return DrawnPaths(self.problem, dynamics, best.paths, best.gap, chosen)

    def evaluate(
        self, path: Sequence[Cell], params: Params | xr.DataTree, *, x0: ArrayLike | None = None
    ) -> Plan:
        """Evaluate a given path; `exact` is False and `bound` NaN.

        Args:
            path: Cells from start to goal, each a neighbour of the last.
            params: Draws of parameters, one or many, or a posterior; of many, `trust` and `value`
                are those of mean trust, and `bands` its quantiles. For lost_contact and stationary,
                `value` is the mean over draws. Draws of a posterior have the next mission's day of
                each robot, see `params_of`.
            x0: Expected trust at the start; by default `params.x0_mean`.

        Raises:
            ShapeError: Parameters of other robots or features.
            TrustboError: A path that is broken, or does not lead from start to goal.
        """
        return evaluate(self.problem, self.require_path(path), draws_of(params, day=True), x0)

    def trust_map(
        self, params: Params | xr.DataTree, *, per_robot: bool = False, x0: ArrayLike | None = None
    ) -> xr.DataArray:
        """Compute the largest expected trust with which each cell can be reached; NaN if none can.

        Over the paths to each cell with the fewest possible bounds, or, unless `max_bounds` is
        "shortest", up to two more without U-turns: with the default `max_bounds`, the value of the
        goal is the terminal trust of the `terminal` plan. Longer walks, which an int admits, are
        excluded, for they loiter to gather trust. Shape (row, col), with `per_robot` (robot, row,
        col), with a leading (draw,) for draws.

        Args:
            params: Parameters of any model; a map for every draw if they have draws.
            per_robot: True for one map per robot instead of the team's.
            x0: Expected trust at the start, shape () or (robot,); by default `params.x0_mean`.
        """
        return trust_map(self.problem, draws_of(params), per_robot=per_robot, x0=x0)

    def cost_map(
        self, params: Params | xr.DataTree, *, per_robot: bool = False, x0: ArrayLike | None = None
    ) -> xr.DataArray:
        """Compute the cost f = 1 - sigma(trust map) of each cell, equation (6); see `trust_map`."""
        return cost_of(self.trust_map(params, per_robot=per_robot, x0=x0))

    def trust_summary(
        self,
        posterior: Params | xr.DataTree,
        *,
        n_draws: int = 200,
        seed: int = 0,
    ) -> xr.Dataset:
        """Compute `mean` and `sd` of the trust map over draws, (row, col), and the mean `cost`.

        Args:
            posterior: Posterior of `fit`, or draws with leading axis (draw,).
            n_draws: Number of draws, taken at random without replacement.
            seed: Seed of the choice of draws.
        """
        params, _ = choose_draws(draws_of(posterior), n_draws, seed)
        return summary_of(trust_map(self.problem, params))

    def path_posterior(
        self, posterior: Params | xr.DataTree, *, n_draws: int | None = 1000, seed: int = 0
    ) -> xr.DataArray:
        """Compute P(cell on the best path), (row, col), from the best path under some draws.

        Args:
            posterior: Posterior of `fit`, or draws with leading axis (draw,).
            n_draws: Number of draws, taken at random without replacement.
            seed: Seed of the choice of draws.
        """
        drawn = self.plan_draws(posterior, n_draws=n_draws, seed=seed)
        share = self.workspace.passable.copy(data=drawn.share()).rename("path_probability")
        return share.assign_attrs(long_name="P(cell on the best path)")
