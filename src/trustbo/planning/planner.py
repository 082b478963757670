"""The planner, which searches for paths from a start to a goal in a workspace."""

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import replace
from typing import Any, Self

import networkx as nx
import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.arrays import read_labelled
from trustbo.data import POST_SETS, Cell, Mission, Station, require_path
from trustbo.display import Rows, Summary
from trustbo.errors import (
    TrustboError,
    require_bounds,
    require_choice,
    require_positive,
    require_switch,
    require_whole,
    warn,
)
from trustbo.hazard.components import Components
from trustbo.hazard.given import GivenRisk, read_risk
from trustbo.hazard.risk import BoundRisk
from trustbo.kernels import stopwatch
from trustbo.models.draws import Draws
from trustbo.parallel import computing
from trustbo.planning.drawn_paths import DrawnPaths, choose_draws, drawn_paths
from trustbo.planning.evaluation import evaluated
from trustbo.planning.given import draws_of, mean_and_draws_of, mean_of
from trustbo.planning.graph import graph_of
from trustbo.planning.maps import maps_of
from trustbo.planning.objectives import OBJECTIVES
from trustbo.planning.paths import AdmissiblePaths
from trustbo.planning.plan import Plan
from trustbo.planning.problem import EXACT, Problem
from trustbo.planning.recursion import Recursion
from trustbo.planning.robot_trust import robot_maps, robot_trust
from trustbo.planning.trust_map import cost_of, trust_map
from trustbo.planning.watchers import contact_dependence, watchers_along
from trustbo.workspace import Workspace
from trustbo.workspace.grid import Location
from trustbo.workspace.moves import MOVE_NAMES, bounds_along, require_on_grid

_DIMS = ("move", "row", "col")
_MOVE_LABELS = {"move": MOVE_NAMES}


class Planner(Summary):
    """Planner that finds the most trustworthy path in a workspace.

    Attributes:
        problem: Admissible paths, objective and costs.

    Example:
        >>> planner = tb.planning.Planner(workspace, start=(9, 0), goal=(0, 9))
        >>> planner.plan(posterior).path
    """

    def __init__(
        self,
        workspace: Workspace,
        start: Location,
        goal: Location,
        objective: str = "lost_contact",
        *,
        max_bounds: int | str | None = None,
        bound_cost: ArrayLike = 0.0,
        max_failure: float | None = None,
        failure_cost: float | None = None,
    ) -> None:
        """Check the arguments and find the admissible paths.

        Args:
            workspace: Planning grid with awareness and passability.
            start: First cell, or a position inside this cell (see `Workspace.locate`).
            goal: Last cell, or a position inside this cell.
            objective: `"lost_contact"`, `"terminal"` or `"mean"` (see `OBJECTIVES`).
            max_bounds: Limit on the number of bounds. `"shortest"` allows only paths with the
                fewest bounds. `"shortest+n"` allows up to n more bounds, but no U-turns. An int
                allows any walk of up to that many bounds. The default is n = 4 for lost_contact
                and n = 2 for the others. If n > 2, paths may revisit cells (see `Plan.revisits`).
            bound_cost: Additional cost of each bound (edge cost), such as its length or duration.
                The array must broadcast to (move, row, col), with the moves of `workspace.MOVES`; a
                DataArray is aligned by its dims and labels. Costs are in bounds for lost_contact,
                and in units of trust for the other objectives.
            max_failure: Largest failure probability of a path, in [0, 1); by default, no limit.
            failure_cost: Cost of a failure in bounds, for lost_contact. The value is reduced by
                this cost times the failure probability. The default is the smallest number of
                bounds of a path, so a failed mission counts as a mission without contact. If this
                or `max_failure` is given, and `with_risk` is not called, plans have the failure
                probabilities of the posterior of a campaign (its group `hazard`).

        Raises:
            TrustboError: If the start or goal is off the grid or impassable; the start equals the
                goal; `max_bounds` is too small; `bound_cost` has the wrong shape; a name is
                unknown; or a number is out of range.
            NoPathError: If the goal cannot be reached from the start.
        """
        aim = OBJECTIVES[require_choice("objective", objective, OBJECTIVES)]
        if max_bounds is None:
            max_bounds = aim.max_bounds

        paths = AdmissiblePaths(workspace, start, goal, max_bounds)
        bound_cost = _bound_cost_of(bound_cost, paths.bounds)
        self.problem = Problem(paths, aim, bound_cost, max_failure, failure_cost)

    def _rows(self) -> Rows:
        problem = self.problem
        paths = problem.paths
        return [
            ("from", f"{self.start} to {self.goal}"),
            ("objective", problem.objective.name),
            ("paths", f"{paths.shortest} to {paths.longest} bounds ({paths.max_bounds})"),
            ("risk", "given for each bound" if problem.risk is not None else "not given"),
        ]

    @property
    def workspace(self) -> Workspace:
        """Workspace in which the planner searches."""
        return self.problem.paths.workspace

    @property
    def start(self) -> Cell:
        """First cell."""
        return self.problem.paths.start

    @property
    def goal(self) -> Cell:
        """Last cell."""
        return self.problem.paths.goal

    @property
    def max_bounds(self) -> int | str:
        """Limit on the number of bounds."""
        return self.problem.paths.max_bounds

    def _with(self, **changes: Any) -> Self:
        """Return a copy of the planner with changed attributes of the problem."""
        other = copy(self)
        other.problem = replace(self.problem, **changes)
        return other

    def from_cell(
        self,
        cell: Location,
        *,
        x0: ArrayLike | None = None,
        blocked: Sequence[Sequence[Cell]] = (),
        n_driven: int = 0,
    ) -> Self:
        """Return a planner for the rest of a mission, from the current cell of the team.

        The limit `max_failure` applies to the rest of the mission alone, and so does `max_bounds`
        if it is a string. A risk is kept, but the bounds that `avoiding` excluded are allowed
        again.

        Args:
            cell: Current cell of the lead, or a position in it.
            x0: Expected trust in this cell, shape () or (robot,), such as `Follower.trust.mean`.
                The default is `x0_mean` of the parameters.
            blocked: Pairs of neighbouring cells. No path takes a bound between the cells of a pair,
                in either direction.
            n_driven: Number of bounds that the team has driven so far. If `max_bounds` is a number,
                `n_driven` is subtracted from it, but the result is never less than the fewest
                bounds that lead to the goal.

        Raises:
            TrustboError: If the cell is impassable or is the goal, or if the cells of a pair are
                not neighbours.
            NoPathError: If the goal cannot be reached.

        Example:
            >>> rest = planner.from_cell((5, 4), x0=follower.trust.mean).plan(posterior)
        """
        paths = self.problem.paths
        closed = None
        pairs = require_bounds("blocked", blocked)
        if pairs:
            closed = np.zeros(paths.workspace.passable_bounds.shape, bool)
            for a, b in pairs:
                there_and_back = require_on_grid([a, b, a], closed.shape[1:])
                closed[*bounds_along(there_and_back).T] = True

        max_bounds = paths.max_bounds
        n_driven = require_whole("n_driven", n_driven, 0)
        if not isinstance(max_bounds, str):
            rest = AdmissiblePaths(paths.workspace, cell, self.goal, "shortest", blocked=closed)
            max_bounds = max(max_bounds - n_driven, rest.shortest)
        rest = AdmissiblePaths(paths.workspace, cell, self.goal, max_bounds, blocked=closed)
        return self._with(paths=rest, x0=self.problem.initial_trust(x0))

    def require_path(self, path: Sequence[Station]) -> tuple[Station, ...]:
        """Check that a path leads from start to goal and return it as a tuple of cells."""
        return self.problem.paths.require_path(path)

    def avoiding(self, bounds: np.ndarray, risk: np.ndarray) -> Self:
        """Return a planner that avoids the given bounds (see `AdmissiblePaths.avoiding`)."""
        avoided = read_labelled("bounds", bounds, _DIMS, _MOVE_LABELS).values
        risks = read_labelled("risk", risk, _DIMS, _MOVE_LABELS).values

        shape = self.problem.paths.bounds.shape
        for name, values in (("bounds", avoided), ("risk", risks)):
            if values.shape != shape:
                raise TrustboError(f"{name} must have the shape {shape}; got {values.shape}.")

        return self._with(paths=self.problem.paths.avoiding(avoided > 0.0, risks))

    def with_risk(
        self,
        p_fail: BoundRisk | ArrayLike,
        draws: ArrayLike | None = None,
        components: Components | None = None,
    ) -> Self:
        """Return a planner with the given failure probability of each bound and next move.

        With a risk, plans respect `max_failure` and have an arrival probability `p_arrive`. For
        lost_contact, the value of a plan includes the expected cost of failure.

        Args:
            p_fail: A `BoundRisk`, without other arguments. Or posterior means of the shape (move,
                row, col, next_move), where the last next move is the end of the path, or (move,
                row, col) if the next move does not matter; NaN where there is no bound. They hold
                for all sets of posts, unless the axes are the ways of `Workspace.awareness`.
            draws: Posterior draws, with a leading axis (draw,), for `p_arrive` and its 90 % band.
            components: Mean failure probabilities of groups of draws, with a leading axis
                (component,), such as `BoundRisk.components()`. They are used for the expected cost
                of failure. By default, bounds fail independently with probability `p_fail`.

        Raises:
            TrustboError: If the shapes do not match, a probability is outside [0, 1], or the
                weights of the components do not sum to 1.
        """
        if isinstance(p_fail, BoundRisk):
            if draws is not None or components is not None:
                raise TrustboError("give a BoundRisk without draws= and components=; it has both.")
            return self._with(risk=p_fail)

        n_posts = self.workspace.n_posts
        mean = read_risk("p_fail", p_fail, (), n_posts)
        drawn = None if draws is None else read_risk("draws", draws, ("draw",), n_posts)
        if components is not None:
            groups = read_risk("components", components.p_fail, ("component",), n_posts)
            components = components._replace(p_fail=groups)
        return self._with(risk=GivenRisk(mean, drawn, components))

    def _informed_by(self, params: Draws | xr.DataTree) -> Self:
        """Return a planner with the risk of a posterior, if failures count and no risk was given.

        Warns if failures count, but neither the planner nor the posterior has a risk.
        """
        problem = self.problem
        counts = bool(problem.failure_cost) or problem.max_failure is not None
        if problem.risk is not None or not counts:
            return self

        if isinstance(params, xr.DataTree) and "hazard" in params.children:
            return self.with_risk(BoundRisk(params["hazard"].to_dataset(), self.workspace))
        if problem.max_failure is None:  # otherwise, the search raises an error
            warn(
                f"failure_cost = {problem.failure_cost:g} has no effect, because neither the "
                "planner nor the posterior has failure probabilities; give the posterior of a "
                "campaign, or use planner.with_risk(...)."
            )
        return self

    def with_failure_cost(self, failure_cost: float) -> Self:
        """Return a planner with another failure cost, in bounds.

        If the objective is not lost_contact, the planner is returned unchanged.

        Raises:
            TrustboError: If the failure cost is negative or not finite.
        """
        cost = require_positive("failure_cost", failure_cost, or_zero=True)
        if not self.problem.objective.of_contact:
            return self
        return self._with(failure_cost=cost)

    @computing()
    def plan(self, params: Draws | xr.DataTree, *, x0: ArrayLike | None = None) -> Plan:
        """Find the best admissible path for given parameters, or for the mean of a posterior.

        Args:
            params: Posterior from `fit`, or parameters. If there are several draws, the path is
                optimal for their mean, and the bands are quantiles over the draws. For a posterior,
                the mean has the expected effects of robots, and the bands those of `evaluate`.
            x0: Expected trust at the start, shape () or (robot,), or labelled with the names of the
                robots. The default is `params.x0_mean`.

        Returns:
            Best path, with its expected trust after each bound (bound, robot) and the value of the
            objective, both at the mean parameters. `bands`, shape (quantile, bound, robot), are the
            0.05, 0.25, 0.75 and 0.95 quantiles of expected trust over the draws, and `value_band`
            are the 0.05 and 0.95 quantiles of the value. `exact` is False if the search was cut off
            before it proved that no path is better; no path has a value above `limit`.

        Raises:
            TrustboError: If the robots or features of the parameters differ from those of the
                workspace, or if beta0 is outside the range in which the search is exact.
            InfeasibleError: If no path respects `max_failure`.
        """
        problem = self._informed_by(params).problem
        with stopwatch() as elapsed:
            mean, draws = mean_and_draws_of(params, self.workspace)
            score, limits, paths = problem.best(problem.searched(mean, x0))
            plan = evaluated(problem, problem.paths.cells(paths[0]), mean, draws, x0)
            seconds = elapsed()

        exact = bool(limits[0] - score[0] <= EXACT)
        limit = plan.value if exact else float(problem.objective.value(limits[0]))
        return replace(plan, exact=exact, limit=limit, seconds=seconds)

    def best_path(self, recursion: Recursion) -> tuple[Station, ...]:
        """Find the best admissible path for a given recursion, such as one with optimistic drifts.

        Args:
            recursion: Recursion for expected trust with one draw (see `Problem.searched`).

        Raises:
            TrustboError: If beta0 is outside the range in which the search is exact.
            InfeasibleError: If no path respects `max_failure`.
        """
        _, _, paths = self.problem.best(recursion)
        return self.problem.paths.cells(paths[0])

    @computing()
    def plan_draws(
        self, posterior: Draws | xr.DataTree, *, n_draws: int | None = None, seed: int = 0
    ) -> DrawnPaths:
        """Find the best path for each draw of a posterior, with the expected effects of robots.

        Args:
            posterior: Posterior from `fit`, or parameters with leading axis (draw,).
            n_draws: Number of draws, chosen at random without replacement; by default all.
            seed: Seed for choosing the draws.

        Raises:
            TrustboError: If any draw has beta0 outside the range in which the search is exact.
            InfeasibleError: If no path respects `max_failure`.
        """
        problem = self._informed_by(posterior).problem
        ahead = draws_of(posterior, self.workspace)
        return drawn_paths(problem, choose_draws(ahead.expected, n_draws, seed))

    @computing()
    def evaluate(
        self, path: Sequence[Station], params: Draws | xr.DataTree, *, x0: ArrayLike | None = None
    ) -> Plan:
        """Return a plan for a given path, with `exact` False and `limit` NaN.

        Args:
            path: Cells from start to goal, each adjacent to the previous one.
            params: Posterior from `fit`, or parameters. If there are several draws, `trust` is the
                mean and `bands` are quantiles of trust over the draws. `value` is computed from the
                mean trust or, for lost_contact, averaged over the draws. The draws of a posterior
                include robot effects drawn for the next mission (see `params_of`).
            x0: Expected trust at the start; by default `params.x0_mean`.

        Raises:
            TrustboError: If the robots or features of the parameters differ from those of the
                workspace, or if the path has gaps or does not lead from start to goal.
        """
        problem = self._informed_by(params).problem
        path = self.require_path(path)
        draws = draws_of(params, self.workspace).drawn
        return evaluated(problem, path, draws, None, x0)

    @computing()
    def compare_posts(self, path: Sequence[Station], params: Draws | xr.DataTree) -> pd.DataFrame:
        """Compare the sets of posts in each bound of a path.

        Args:
            path: Cells from start to goal, such as `Plan.path`.
            params: Posterior from `fit`, or parameters. Several draws are replaced by their mean.

        Returns:
            Table with one row for each bound of the path, from 1, and each set of posts, which
            index it. The columns are whether the path has the set (`chosen`); the team's expected
            trust after the bound (`trust`) and in the whole path (`value`, the objective) if T2
            watches this bound from the set and the other bounds as in the path.

        Raises:
            TrustboError: The path is not admissible, or the parameters do not fit the workspace.

        Example:
            >>> planner.compare_posts(plan.path, posterior).loc[1]
        """
        path = self.require_path(path)
        problem = self._informed_by(params).problem
        mean = mean_of(params, self.workspace)

        rows = []
        for k in range(1, len(path)):
            cell = path[k - 1][:2]
            for name in self.workspace.post_sets:
                other = require_path("path", [*path[: k - 1], (*cell, name), *path[k:]])
                plan = evaluated(problem, other, mean, None, None)
                rows.append((k, name, other == path, plan.trust[k - 1].mean(), plan.value))

        columns = ["bound", "posts", "chosen", "trust", "value"]
        return pd.DataFrame(rows, columns=columns).set_index(["bound", "posts"])

    @computing()
    def watchers(
        self,
        path: Sequence[Station],
        params: Draws | xr.DataTree,
        *,
        missions: Iterable[Mission] = (),
        seed: int = 0,
    ) -> pd.DataFrame:
        """Predict the contact of each robot along a path, and how often several have contact.

        To learn what is lost without a robot, compare the tables of `Workspace.of_robots` with and
        without it.

        Robots do not lose contact independently, because a ridge may hide the lead from all of
        them. The drawn rates of a bound have the effects of the place and the noise that robots
        share. Given the rates, contact at a tick is a mixture of robots that lose the lead at the
        same time and of independent robots; see `planning.at_least`.

        Args:
            path: Cells from start to goal, such as `Plan.path`.
            params: Posterior from `fit`, or parameters. The effects of robots are drawn for the
                next mission, as in `evaluate`.
            missions: Missions whose contact at ticks is used to estimate how dependent contact is
                (see `planning.contact_dependence`), such as `campaign.missions`.
            seed: Seed of the drawn rates.

        Returns:
            Table with one row for each bound of the path, from 1, and the columns `rate_r1`, ...,
            the expected contact rate of each robot that takes part, and `at_least_one` and
            `at_least_two`, the expected shares of the bound's time in which so many robots have
            contact. Means over the rows are those of the path.

        Raises:
            TrustboError: The path is not admissible, or the parameters do not fit the workspace.

        Example:
            >>> two = planner.workspace.of_robots(["r1", "r2"])
            >>> of_two = tb.Planner(two, planner.start, planner.goal)
            >>> of_two.watchers(plan.path, posterior, missions=[mission]).mean()
        """
        path = self.require_path(path)
        seed = require_whole("seed", seed, 0)
        draws = draws_of(params, self.workspace).drawn
        return watchers_along(self.problem, path, draws, contact_dependence(missions), seed)

    @computing()
    def graph(self, params: Draws | xr.DataTree) -> nx.DiGraph | nx.MultiDiGraph:
        """Return the cells and bounds as a networkx graph.

        With several sets of posts, the graph is a multigraph, in which the names of the sets are
        the keys of parallel edges.

        Nodes are the passable cells `(row, col)`, with the CRS coordinates `x` and `y` of their
        centres in metres. Edges are the bounds, with the attributes

        - `length`: length in metres.
        - `drift`: drift of the team's mean trust.
        - `trust`: the team's stationary trust, the limit of trust if the bound is repeated.
        - `lost`: contact lost at this trust, in bounds, plus the bound cost.
        - `cost`: amount by which the bound reduces the objective at this trust; see below.
        - `risk`: -log(1 - p), if the planner has a risk, where p is the failure probability of the
          bound, averaged over the next moves and their sets of posts.

        The algorithms of networkx minimise a sum over edges. If beta0 is 0, trust is not carried
        over, and the sum of `cost` along a path to the goal gives its value:

        - `lost_contact`: the value is minus the sum. With a risk, the cost of a bound includes
          `failure_cost` times its failure probability, so the value is at least minus the sum.
        - `terminal`: the value is sigma(c - sum), where c is `graph.graph["constant"]`. The cost
          differs from the bound cost only for bounds that enter the goal.
        - `mean`: the value of a path of n bounds is c - sum / n. Since this value is not a sum,
          `cost` orders only paths with the same number of bounds.

        For the first two objectives, `nx.shortest_path(graph, start, goal, weight="cost")` then has
        the value of the plan, unless it has more than `max_bounds` bounds or the planner has a
        risk. If beta0 is not 0, this path is a heuristic, because trust after a bound depends on
        the bounds before it. For your own objectives, the costs are those of `terminal` if trust
        counts only at the goal, and those of `mean` otherwise.

        Costs are at least 0, as Dijkstra's algorithm requires, unless a bound cost is negative. In
        that case, use `nx.bellman_ford_path`, provided that no loop has a negative cost.

        Args:
            params: Posterior from `fit`, or parameters. Several draws are replaced by their mean.

        Raises:
            TrustboError: If abs(beta0) >= 1, because trust would then grow without limit.
        """
        problem = self._informed_by(params).problem
        return graph_of(problem, mean_of(params, self.workspace))

    @computing()
    def trust(
        self,
        params: Draws | xr.DataTree,
        robot: str | None = None,
        cell: Location | None = None,
        *,
        move: str | None = None,
        posts: str = POST_SETS[0],
        as_rate: bool = False,
        expected: bool = False,
    ) -> xr.DataArray:
        """Compute how trustworthy a robot is while the lead enters a cell.

        Expected trust is carried over from bound to bound, so it depends on the path. Instead, this
        method returns the stationary trust (I - B0)^-1 u, the limit of expected trust if a bound
        with the drift u is repeated. Stationary trust depends only on the bound, and equals u if
        beta0 is 0 or if the model has `memory="deviation"`. The trust at a cell is the mean over
        the bounds that enter it.

        Args:
            params: Posterior from `fit`, or parameters of any model.
            robot: Name of a robot of T2; by default all robots.
            cell: Cell (row, col) that the lead enters, or a position in it (see
                `Workspace.locate`); by default all cells.
            move: Direction of the bound that enters the cell, such as `"ne"` (see
                `workspace.MOVE_NAMES`); by default the mean over all directions.
            posts: Set of posts from which T2 watches; see `Workspace.post_sets`.
            as_rate: Whether to return the expected contact rate at this trust, in [0, 1]. The mean
                of Gaussian contact rates is trust, limited to [0, 1]. For the family
                `"beta_binomial"`, trust is the logit of the contact rate.
            expected: Whether to use the expected effects of robots in the next mission, instead of
                drawing them. Parameters, unlike a posterior, are used as they are.

        Returns:
            DataArray with the dims (draw, robot, row, col). The dims of a given robot or cell are
            dropped, and so is draw for a single set of parameters. Values are NaN where no bound
            enters a cell and, with a warning, for draws in which trust diverges.

        Raises:
            TrustboError: If the robot, move or set of posts is unknown, the cell is off the grid or
                impassable, no such bound enters the cell, or trust diverges in all draws.

        Example:
            >>> planner.trust(posterior, "r2", (3, 4)).quantile([0.05, 0.5, 0.95])
        """
        require_switch("as_rate", as_rate)
        require_switch("expected", expected)
        draws = draws_of(params, self.workspace).of_robots(expected=expected)
        about = {"move": move, "posts": posts, "as_rate": as_rate}
        return robot_trust(self.workspace, draws, robot, cell, **about)

    @computing()
    def robot_maps(self, posterior: Draws | xr.DataTree, *, expected: bool = False) -> xr.Dataset:
        """Compute maps of the trust in each robot under a posterior.

        The draws are processed in parts, so large maps fit in memory.

        Args:
            posterior: Posterior from `fit`, or parameters of any model.
            expected: Whether to use the expected effects of robots in the next mission, instead of
                drawing them; see `trust`.

        Returns:
            Dataset with the dims (robot, y, x), whose coordinates are those of `maps`. The
            variables are the mean `trust_mean` and standard deviation `trust_sd` of `trust`, and
            the mean `contact_rate` of `trust(as_rate=True)`. Cells that no bound enters are NaN.
        """
        require_switch("expected", expected)
        draws = draws_of(posterior, self.workspace).of_robots(expected=expected)
        return robot_maps(self.workspace, draws)

    @computing()
    def trust_map(
        self,
        params: Draws | xr.DataTree,
        *,
        per_robot: bool = False,
        x0: ArrayLike | None = None,
        expected: bool = False,
    ) -> xr.DataArray:
        """Compute the largest expected trust on arrival at each cell; NaN if it is unreachable.

        The maximum is over paths without U-turns to the cell that have at most two bounds more than
        the fewest, or fewer if `max_bounds` is tighter. Longer walks are excluded because they
        could gain trust by loitering. With the default `max_bounds` and no bound costs, the value
        at the goal equals the final trust of the `terminal` plan. The map has the shape (row, col),
        or (robot, row, col) with `per_robot`, and a leading axis (draw,) if there are several
        draws.

        Args:
            params: Posterior from `fit`, or parameters of any model.
            per_robot: Whether to compute one map per robot instead of one for the team.
            x0: Expected trust at the start, shape () or (robot,); by default `params.x0_mean`.
            expected: Whether to use the expected effects of robots in the next mission, instead of
                drawing them; see `trust`.
        """
        require_switch("per_robot", per_robot)
        require_switch("expected", expected)
        draws = draws_of(params, self.workspace).of_robots(expected=expected)
        trust = trust_map(self.problem, draws, per_robot=per_robot, x0=x0)
        return trust if draws.n_draws > 1 else trust.isel(draw=0)

    @computing()
    def cost_map(
        self,
        params: Draws | xr.DataTree,
        *,
        per_robot: bool = False,
        x0: ArrayLike | None = None,
        expected: bool = False,
    ) -> xr.DataArray:
        """Compute the cost f = 1 - sigma(trust) of each cell, equation (6), from `trust_map`."""
        require_switch("per_robot", per_robot)
        require_switch("expected", expected)
        return cost_of(self.trust_map(params, per_robot=per_robot, x0=x0, expected=expected))

    @computing()
    def maps(
        self,
        posterior: Draws | xr.DataTree,
        *,
        n_draws: int = 250,
        seed: int = 0,
        expected: bool = False,
    ) -> xr.Dataset:
        """Compute maps of the cells under a posterior, for GIS and figures.

        Args:
            posterior: Posterior from `fit`, or parameters with leading axis (draw,).
            n_draws: Number of draws, chosen at random without replacement.
            seed: Seed for choosing the draws.
            expected: Whether to use the expected effects of robots in the next mission, instead of
                drawing them; see `trust`. Plans, and so `path_probability`, always use them.

        Returns:
            Dataset with dims (y, x), whose coordinates are the cell centres in CRS metres;
            `isel(y=row, x=col)` selects a cell. The accessor `.rio` has the CRS and writes rasters.
            The maps are the mean `trust_mean` and standard deviation `trust_sd` of trust on arrival
            at each cell, and its mean `cost` (see `cost_map`), on the paths that are best under the
            mean of the draws; the probability `path_probability` that a cell is on the best
            path (on the safest path if no path respects `max_failure`), and each feature, averaged
            over robots and moves (named `awareness_<name>` if the name is taken). With place
            effects, there are also their `place_mean` and `place_sd`. Impassable cells are NaN. The
            attribute `start` of the maps of trust and cost is the start, where trust is assumed.
        """
        require_switch("expected", expected)
        ahead = draws_of(posterior, self.workspace)
        return maps_of(
            self._informed_by(posterior).problem, ahead, n_draws, seed, expected=expected
        )


def _bound_cost_of(bound_cost: ArrayLike, bounds: np.ndarray) -> np.ndarray:
    """Return the cost of each bound, shape (move, row, col); 0 where there is no bound.

    Raises TrustboError if the shape does not broadcast or the cost of a bound is not finite.
    """
    given = read_labelled("bound_cost", bound_cost, _DIMS, _MOVE_LABELS, partial=True).values
    try:
        bound_cost = np.where(bounds, np.broadcast_to(given, bounds.shape), 0.0)
    except ValueError:
        raise TrustboError(
            f"bound_cost must broadcast to (move, row, col) = {bounds.shape}; got shape "
            f"{given.shape}."
        ) from None

    if not np.isfinite(bound_cost).all():
        move, row, col = np.argwhere(~np.isfinite(bound_cost))[0].tolist()
        raise TrustboError(
            f"bound_cost[{move}, {row}, {col}] = {bound_cost[move, row, col]} is not finite; give "
            "a finite cost for every bound."
        )

    return bound_cost
