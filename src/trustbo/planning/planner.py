"""The planner a user holds: one workspace, one start and goal, one objective."""

import itertools
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.special import expit, logit

from trustbo.data import Cell
from trustbo.errors import ShapeError, TrustboError, require_choice
from trustbo.models.params import Params
from trustbo.planning import maps
from trustbo.planning import posterior as over_draws
from trustbo.planning.course import Course
from trustbo.planning.dynamics import Dynamics, roll_trust
from trustbo.planning.engines import (
    Answer,
    choose_engine,
    expected_paths,
    plan_compiled,
    require_valid,
)
from trustbo.planning.objectives import (
    ADDITIVE,
    LABELLED,
    OBJECTIVES,
    Aim,
    PathTrust,
    softplus,
)
from trustbo.planning.plan import QUANTILES, Plan
from trustbo.planning.posterior import DrawnPaths
from trustbo.planning.reference import plan_networkx
from trustbo.planning.setting import Setting, draws_of
from trustbo.planning.values import path_length, path_value
from trustbo.terrain import Workspace

EXACT = 1e-12
"""A plan is exact if no path can be better by more, in trust or log probability."""


class Planner(Setting):
    """Finds the most trustworthy path of a workspace, exactly.

    Attributes:
        objective: What paths should be best at.
        engine: What finds them.
    """

    def __init__(
        self,
        workspace: Workspace,
        start: Cell,
        goal: Cell,
        objective: str = "terminal",
        *,
        connectivity: int = 8,
        max_bounds: int | str | None = None,
        revisit: bool = True,
        team: str = "mean",
        length_weight: float = 0.0,
        engine: str = "auto",
        backend: str | None = None,
    ) -> None:
        """Prepare to plan.

        Args:
            workspace: Where.
            start: First cell.
            goal: Last cell.
            objective: `"terminal"`, `"mean"`, `"success"`, `"bottleneck"` or `"stationary"`.
            connectivity: 4, or 8 to allow diagonal bounds too.
            max_bounds: Which paths are admissible. `"shortest"`: those with the fewest possible
                bounds. `"shortest+2"` (default for terminal and mean): up to two more, without
                turning straight back, which keeps them simple; from corner to corner of an
                8-connected grid, the shortest path alone would leave no choice. An int: walks of
                at most that many bounds (default for success and bottleneck: shortest + 8).
                Without effect on stationary, which is over all simple paths.
            revisit: Whether walks of success and bottleneck may enter a cell twice.
            team: The team's trust is the `"mean"` or the `"min"` (least) of its robots'.
            length_weight: What a metre of the path costs, for terminal, mean (in units of trust)
                and stationary (in units of log probability).
            engine: `"networkx"`, the reference; `"numba"`, compiled; or `"auto"`: networkx for
                single plans on up to 50 x 50 cells. All find paths of the same value.
            backend: networkx backend for the shortest paths, e.g. `"parallel"`.

        Raises:
            TrustboError: Start or goal off the grid, impassable, or equal; an unknown name;
                `max_bounds` below the fewest possible; a length weight that is negative, or for
                success or bottleneck.
            NoPathError: The goal cannot be reached.
        """
        self.objective = require_choice("objective", objective, OBJECTIVES)
        self.engine, self._backend = engine, backend
        choose_engine(engine, 0, 1)
        self._aim = Aim(objective, _require_length_weight(length_weight, objective))
        if max_bounds is None and objective not in LABELLED:
            max_bounds = "shortest+2"
        course = Course(workspace, start, goal, connectivity, max_bounds, revisit)
        super().__init__(workspace, course, team)

    def plan(self, params: Params, *, x0: ArrayLike | None = None) -> Plan:
        """The best admissible path for given parameters.

        Args:
            params: Parameters of any model, without leading axes.
            x0: Expected trust at the start, shape () or (robot,); by default `params.x0_mean`.

        Raises:
            ShapeError: Parameters with leading axes, or of other robots or features.
            TrustboError: beta0 is outside the range the objective is exact for.
        """
        started = time.perf_counter()
        _require_one_draw(params)
        path, slack, engine = self._find(self.dynamics(params, x0))
        plan = self._evaluate(path, params, x0)
        return replace(
            plan,
            exact=slack <= EXACT,
            bound=self._bound(plan.value, slack),
            engine=engine,
            seconds=time.perf_counter() - started,
        )

    def best_path(self, moves: Dynamics) -> tuple[Cell, ...]:
        """The best admissible path for dynamics of your own, such as an optimistic drift.

        Args:
            moves: Without leading axes; see `dynamics`.

        Raises:
            TrustboError: beta0 is outside the range the objective is exact for.
        """
        return self._find(moves)[0]

    def plan_expected(self, posterior: Params | xr.DataTree) -> Plan:
        """The path with the best expectation over draws of terminal trust, or of mean trust.

        Exact for the posterior as it is given, correlations between parameters included, because
        both are linear in the cells' drifts. `value` is that of the mean terminal trust, or the
        mean of mean trust.

        Args:
            posterior: What `fit` returned, or draws with leading axis (draw,).

        Raises:
            TrustboError: Another objective, or `team="min"`.
        """
        started = time.perf_counter()
        params = draws_of(posterior)
        moves = self.dynamics(params)
        if self.objective not in ("terminal", "mean") or len(moves.views) > 1:
            raise TrustboError(
                "an expectation over draws is planned exactly for 'terminal' and 'mean' of a "
                f"team's mean trust; got {self.objective!r} with team={self.team!r}."
            )
        path = self.course.cells(expected_paths(self.course, moves, self._aim).paths[0])
        plan = self.evaluate(path, params)
        return replace(
            plan, exact=True, bound=plan.value, engine="numba",
            seconds=time.perf_counter() - started,
        )  # fmt: skip

    def plan_draws(
        self,
        posterior: Params | xr.DataTree,
        *,
        n_draws: int | None = None,
        seed: int = 0,
    ) -> DrawnPaths:
        """The best path under every draw.

        Args:
            posterior: What `fit` returned, or draws with leading axis (draw,).
            n_draws: How many of them, taken at random without replacement; by default all.
            seed: Same seed, same draws.

        Raises:
            TrustboError: beta0 of a draw is outside the range the objective is exact for.
        """
        params, chosen = over_draws.choose(draws_of(posterior), n_draws, seed)
        moves = self.dynamics(params, draws=chosen)
        require_valid(moves, self.objective)
        engine = choose_engine(self.engine, self.course.passable.size, len(chosen))
        if engine == "numba":
            answer = plan_compiled(self.course, moves, self._aim)
        else:
            paths = [
                plan_networkx(self.course, moves.draw(d), self._aim, self._backend)
                for d in range(len(chosen))
            ]
            answer = Answer(over_draws.padded(self.course, paths), np.zeros(len(paths)))
        return DrawnPaths(self.course, moves, self._aim, answer.paths, answer.slack, chosen)

    def evaluate(
        self, path: Sequence[Cell], params: Params | xr.DataTree, *, x0: ArrayLike | None = None
    ) -> Plan:
        """What is expected of a given path; `exact` is False and `bound` NaN.

        Args:
            path: Cells from start to goal, each a neighbour of the last.
            params: One draw of parameters, or many, or a posterior: then `trust` and `value` are
                those of mean trust over draws, and `bands` its quantiles.
            x0: Expected trust at the start; by default `params.x0_mean`.

        Raises:
            ShapeError: Parameters of other robots or features.
            TrustboError: A path that is broken, or does not lead from start to goal.
        """
        return self._evaluate(self.require_path(path), draws_of(params), x0)

    def _evaluate(
        self, cells: tuple[Cell, ...], draws: Params, x0: ArrayLike | None = None
    ) -> Plan:
        """What is expected of a path that is known to be one."""
        flat, grid = np.fromiter(itertools.chain.from_iterable(cells), int), self.workspace.grid
        where = flat.reshape(-1, 2)
        rows, cols = where.T
        z = self.awareness if draws.leading else self.mean_awareness
        along = z[..., rows[1:], cols[1:], :]  # ([draw], robot, bound, feature)
        if along.ndim == 4:
            along = along[np.arange(draws.leading[0]) % len(along)]
        many = roll_trust(draws, np.swapaxes(along, -3, -2), x0)
        many = many.reshape(-1, *many.shape[-2:])
        trust = many.mean(0)
        team = trust.mean(1) if self.team == "mean" else trust.min(1)
        if self.objective == "stationary":
            value = path_value(self.dynamics(draws, x0), self._aim, self.course, where).mean()
        else:
            toll = self._aim.length_weight * path_length(self.course, where)
            value = OBJECTIVES[self.objective](PathTrust(team, team, toll))
        return Plan(
            cells,
            np.stack([grid.x[cols], grid.y[rows]], axis=1),
            path_length(self.course, where),
            trust,
            _bands(many),
            float(value),
            float(np.exp(-softplus(-team).sum())),
            self.objective,
            False,
            np.nan,
            len(cells) - len(set(cells)),
            "given",
            0.0,
        )

    def bands(self, path: Sequence[Cell], posterior: Params | xr.DataTree) -> np.ndarray:
        """`Plan.bands` of a path over draws, shape (quantile, bound, robot)."""
        return self.evaluate(path, posterior).bands

    # --- maps ---

    def trust_map(
        self,
        params: Params | xr.DataTree,
        *,
        per_robot: bool = False,
        x0: ArrayLike | None = None,
    ) -> xr.DataArray:
        """Largest expected trust with which each cell can be reached; see `maps.trust_map`.

        Args:
            params: Parameters of any model; of draws, or a posterior, every draw's map.
            per_robot: One map per robot instead of the team's.
            x0: Expected trust at the start, shape () or (robot,); by default `params.x0_mean`.

        Returns:
            DataArray (row, col), or (robot, row, col), with a leading (draw,) for draws; NaN where
            no robot can go.

        Raises:
            ShapeError: Parameters of other robots or features.
        """
        return maps.trust_map(self, params, per_robot=per_robot, x0=x0)

    def cost_map(
        self,
        params: Params | xr.DataTree,
        *,
        per_robot: bool = False,
        x0: ArrayLike | None = None,
    ) -> xr.DataArray:
        """The cost f = 1 - sigma(trust) of reaching each cell, equation (6); as `trust_map`."""
        return maps.cost_map(self, params, per_robot=per_robot, x0=x0)

    def trust_summary(
        self,
        posterior: Params | xr.DataTree,
        *,
        per_robot: bool = False,
        n_draws: int = 200,
        seed: int = 0,
    ) -> xr.Dataset:
        """Dataset of `mean` and `sd` of the trust map, and the mean `cost`, over draws.

        Args:
            posterior: What `fit` returned, or draws with leading axis (draw,).
            per_robot: One map per robot instead of the team's: (robot, row, col), not (row, col).
            n_draws: How many draws, taken at random without replacement.
            seed: Same seed, same draws.
        """
        return maps.trust_summary(self, posterior, per_robot=per_robot, n_draws=n_draws, seed=seed)

    def path_posterior(
        self, posterior: Params | xr.DataTree, *, n_draws: int | None = 1000, seed: int = 0
    ) -> xr.DataArray:
        """P(cell on the best path), from the best path under each of some draws.

        Args:
            posterior: What `fit` returned, or draws with leading axis (draw,).
            n_draws: How many of them to plan under, taken at random without replacement.
            seed: Same seed, same draws.

        Returns:
            DataArray (row, col), in [0, 1].
        """
        drawn = self.plan_draws(posterior, n_draws=n_draws, seed=seed)
        share = self.workspace.passable.copy(data=drawn.share()).rename("path_probability")
        return share.assign_attrs(long_name="P(cell on the best path)")

    def _find(self, moves: Dynamics) -> tuple[tuple[Cell, ...], float, str]:
        """A best path, by how much it could be better at most, and the engine."""
        require_valid(moves, self.objective)
        engine = choose_engine(self.engine, self.course.passable.size, 1)
        if engine == "networkx":
            return plan_networkx(self.course, moves, self._aim, self._backend), 0.0, engine
        answer = plan_compiled(self.course, moves.stacked(), self._aim)
        return self.course.cells(answer.paths[0]), float(answer.slack[0]), engine

    def _bound(self, value: float, slack: float) -> float:
        """The value a plan could have at most, its search having left this much slack."""
        if slack <= 1e-12:
            return value
        if self.objective == "terminal":
            return float(expit(logit(value) + slack))
        return value * float(np.exp(slack)) if self.objective == "success" else value + slack


def _bands(trust: np.ndarray) -> np.ndarray:
    """Quantiles over draws (draw, bound, robot); one draw is all of its own quantiles."""
    if len(trust) == 1:
        return np.repeat(trust, len(QUANTILES), axis=0)
    return np.quantile(trust, QUANTILES, axis=0)


def _require_one_draw(params: Params) -> None:
    if params.leading:
        raise ShapeError(
            f"give one draw at a time: the parameters have leading axes {params.leading}. Use "
            "params.draw(i) or params.mean(), or planner.plan_draws for all of them."
        )


def _require_length_weight(length_weight: float, objective: str) -> float:
    if not 0.0 <= length_weight < np.inf:
        raise TrustboError(f"length_weight must be finite and >= 0; got {length_weight!r}.")
    if length_weight and objective not in ADDITIVE:
        raise TrustboError(
            f"length_weight is for {', '.join(ADDITIVE)}; the objective is {objective!r}."
        )
    return float(length_weight)
