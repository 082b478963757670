"""The planner a user holds: one workspace, one start and goal, one objective."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import networkx as nx
import numpy as np
import xarray as xr
from scipy.special import expit

from trustbo.data import Cell
from trustbo.errors import ShapeError, TrustboError, require_choice, require_pair, require_whole
from trustbo.models import TrustParams
from trustbo.planning import search
from trustbo.planning.graph import MOVES, cell_graph, fewest_bounds
from trustbo.planning.objectives import OBJECTIVES, PathTrust, drift, roll_trust
from trustbo.planning.trustmap import best_trust
from trustbo.terrain import Workspace

DEFAULT_SLACK = 8
"""Bounds beyond the fewest possible that `success` and `bottleneck` may take by default."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A path and what is expected of it.

    Attributes:
        path: Cells, start first.
        trust: Expected trust after each bound, shape (bound, robot).
        value: The objective, to be maximised (see `OBJECTIVES`).
        objective: Its name.
        exact: Whether no admissible path is better.
        bound: Largest value that any admissible path can have; `value` where exact.
        revisits: How often the path enters a cell again.
        engine: What computed it.
        seconds: How long that took.
    """

    path: tuple[Cell, ...]
    trust: np.ndarray
    value: float
    objective: str
    exact: bool
    bound: float
    revisits: int
    engine: str
    seconds: float


class Planner:
    """Finds the most trustworthy path of a workspace, exactly.

    Attributes:
        graph: The `networkx.DiGraph` of passable cells (see `cell_graph`).
        to_goal: Fewest bounds to the goal, by cell; cells that are missing cannot reach it.
        shortest: Fewest bounds from start to goal.
        longest: Most bounds an admissible path may have.
        u_turns: Whether an admissible path may turn straight back.
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
            backend: networkx backend for the shortest paths, e.g. `"parallel"`.

        Raises:
            TrustboError: Start or goal off the grid, impassable, or equal; an unknown objective;
                `max_bounds` below the fewest possible.
            NoPathError: The goal cannot be reached.
        """
        self.objective = require_choice("objective", objective, OBJECTIVES)
        self.workspace, self.connectivity, self.revisit = workspace, connectivity, revisit
        self.start = workspace.require_cell("start", start)
        self.goal = workspace.require_cell("goal", goal)
        if self.start == self.goal:
            raise TrustboError(f"start and goal are the same cell {self.start}; choose two.")
        self.graph = cell_graph(workspace, connectivity)
        self.to_goal = fewest_bounds(self.graph, self.start, self.goal)
        self.shortest = self.to_goal[self.start]
        self._from_start = dict(nx.single_source_shortest_path_length(self.graph, self.start))
        if max_bounds is None:
            labelled = objective in ("success", "bottleneck")
            max_bounds = self.shortest + DEFAULT_SLACK if labelled else "shortest+2"
        self.longest = self._most_bounds(max_bounds)
        self.u_turns = not isinstance(max_bounds, str)
        self._backend = backend

    def plan(self, params: TrustParams) -> Plan:
        """The best admissible path for given parameters.

        Args:
            params: Parameters without leading axes.

        Raises:
            ShapeError: Parameters with leading axes, or of other features.
            TrustboError: beta0 is outside the range the objective is exact for.
        """
        _require_one_draw(params)
        started = time.perf_counter()
        path = self._search(self._recursion(params))
        plan = self.evaluate(path, params)
        seconds = time.perf_counter() - started
        return replace(plan, exact=True, bound=plan.value, engine="networkx", seconds=seconds)

    def evaluate(self, path: Sequence[Cell], params: TrustParams) -> Plan:
        """What is expected of a given path; `exact` is False and `bound` NaN.

        Args:
            path: Cells from start to goal, each a neighbour of the last.
            params: Parameters without leading axes.

        Raises:
            ShapeError: Parameters with leading axes, or of other features.
            TrustboError: A path that is broken, or does not lead from start to goal.
        """
        _require_one_draw(params)
        cells = self.require_path(path)
        awareness = self.workspace.awareness.values[:, *zip(*cells[1:], strict=True)]
        trust = roll_trust(params, np.swapaxes(awareness, 0, 1))
        u = drift(params, awareness).mean(0)
        beta0 = float(np.asarray(params.beta0))
        settled = u / (1.0 - beta0) if beta0 != 1.0 else np.full_like(u, np.nan)
        value = OBJECTIVES[self.objective](PathTrust(trust.mean(1), settled))
        revisits = len(cells) - len(set(cells))
        return Plan(cells, trust, value, self.objective, False, np.nan, revisits, "given", 0.0)

    def require_path(self, path: Sequence[Cell]) -> tuple[Cell, ...]:
        """The path as a tuple of cells, if a team can take it.

        Raises:
            TrustboError: It is broken, or does not lead from start to goal; the cell is named.
        """
        cells = tuple(require_pair(f"path[{k}]", cell) for k, cell in enumerate(path))
        if len(cells) < 2 or cells[0] != self.start or cells[-1] != self.goal:
            raise TrustboError(f"a path must lead from {self.start} to {self.goal}; got {cells}.")
        for a, b in pairwise(cells):
            if not self.graph.has_edge(a, b):
                raise TrustboError(f"the path is broken: no bound leads from {a} to {b}.")
        return cells

    def trust_map(self, params: TrustParams, *, per_robot: bool = False) -> xr.DataArray:
        """Largest expected trust with which each cell can be reached.

        Over the paths to each cell with the fewest possible bounds, or, unless `max_bounds` is
        "shortest", up to two more without turning straight back: with the default `max_bounds`,
        the goal's value is the terminal trust of the `terminal` plan. Longer walks, which an int
        admits, are left out, for they loiter to gather trust.

        Args:
            params: Parameters without leading axes.
            per_robot: One map per robot instead of the team's.

        Returns:
            DataArray (row, col), or (robot, row, col); NaN where no robot can go.

        Raises:
            ShapeError: Parameters with leading axes, or of other features.
        """
        _require_one_draw(params)
        u = drift(params, self.workspace.awareness.values)
        u = u if per_robot else u.mean(0)
        beta0, x0 = float(np.asarray(params.beta0)), float(np.asarray(params.x0_mean))
        slack = min(2, self.longest - self.shortest)
        values = best_trust(u, beta0, x0, self._from_start, MOVES[self.connectivity], slack)
        like = self.workspace.awareness.isel(feature=0, drop=True)
        like = like if per_robot else like.isel(robot=0, drop=True)
        return like.copy(data=values).rename("trust").assign_attrs(long_name="expected trust")

    def cost_map(self, params: TrustParams, *, per_robot: bool = False) -> xr.DataArray:
        """The paper's cost f = 1 - sigma(trust) of reaching each cell; axes as `trust_map`."""
        trust = self.trust_map(params, per_robot=per_robot)
        cost = trust.copy(data=1.0 - expit(trust.values)).rename("cost")
        return cost.assign_attrs(long_name="cost 1 - sigma(trust)")

    def path_posterior(
        self, posterior: TrustParams | xr.DataTree, *, n_draws: int = 200, seed: int = 0
    ) -> xr.DataArray:
        """P(cell on the best path), from the best path under each of some draws.

        Args:
            posterior: What `fit` returned, or draws with leading axis (draw,).
            n_draws: How many of them to plan under, taken at random without replacement.
            seed: Same seed, same draws.

        Returns:
            DataArray (row, col), in [0, 1].
        """
        if isinstance(posterior, xr.DataTree):
            posterior = TrustParams.from_posterior(posterior)
        n = len(np.asarray(posterior.beta0))
        chosen = np.random.default_rng(seed).choice(n, min(n, n_draws), replace=False)
        like = self.workspace.passable
        count = np.zeros(like.shape)
        for index in chosen:
            for cell in set(self.plan(posterior.draw(int(index))).path):
                count[cell] += 1.0
        share = like.copy(data=count / len(chosen)).rename("path_probability")
        return share.assign_attrs(long_name="P(cell on the best path)")

    def _recursion(self, params: TrustParams) -> search.Recursion:
        u = drift(params, self.workspace.awareness.values).mean(0)
        drifts = {cell: float(u[cell]) for cell in self.graph}
        beta0, x0 = float(np.asarray(params.beta0)), float(np.asarray(params.x0_mean))
        return search.Recursion(beta0, drifts, x0)

    def _search(self, recursion: search.Recursion) -> search.Path:
        ends = (self.graph, self.start, self.goal)
        if self.objective == "stationary":
            return search.best_stationary(*ends, recursion, self._backend)
        if self.objective in ("success", "bottleneck"):
            return search.best_labelled(
                *ends, self.to_goal, recursion, self.longest, self.objective, revisit=self.revisit
            )
        candidates = []
        for n_bounds in range(self.shortest, self.longest + 1):
            weights = search.additive_weights(self.objective, recursion.beta0, n_bounds)
            path = search.best_additive(
                *ends,
                self.to_goal,
                recursion.u,
                weights,
                u_turns=self.u_turns,
                backend=self._backend,
            )
            if path is not None:
                us = np.array([recursion.u[cell] for cell in path[1:]])
                start = recursion.x0 * recursion.beta0 * weights[0]
                candidates.append((float(weights @ us + start), path))
        return max(candidates, key=lambda candidate: candidate[0])[1]

    def _most_bounds(self, max_bounds: int | str) -> int:
        named = {"shortest": self.shortest, "shortest+2": self.shortest + 2}
        if isinstance(max_bounds, str):
            return named[require_choice("max_bounds", max_bounds, named)]
        if require_whole("max_bounds", max_bounds, 1) < self.shortest:
            raise TrustboError(
                f"max_bounds = {max_bounds} is below the fewest possible from {self.start} to "
                f"{self.goal}, which is {self.shortest}."
            )
        return int(max_bounds)


def _require_one_draw(params: TrustParams) -> None:
    if np.ndim(params.beta0) or np.ndim(params.beta) != 1:
        raise ShapeError(
            f"give one draw at a time: beta0 has shape {np.shape(params.beta0)}. "
            "Use params.draw(i) or params.mean()."
        )
