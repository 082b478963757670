"""Planning problem: admissible paths, objective and costs, and the search for the best path."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, NoReturn, cast

import numpy as np
from numpy.typing import ArrayLike

from trustbo.arrays import read_labelled, require_numbers
from trustbo.data import Station, cells_of, path_text
from trustbo.errors import TrustboError, require_positive
from trustbo.fixed import Uncached
from trustbo.hazard.path_risk import ROUNDING, Risk
from trustbo.models.draws import Draws
from trustbo.planning.labels import best_labels
from trustbo.planning.limits import LOGISTIC, LOSSES, TINY_SD, Costs
from trustbo.planning.objectives import Objective, Weights, capped, has_history, weights_of
from trustbo.planning.paths import AdmissiblePaths
from trustbo.planning.recursion import Recursion, trust_recursion
from trustbo.planning.sums import best_sums
from trustbo.workspace.moves import (
    END,
    cells_along,
    for_sets,
    moves_along,
    next_names,
    pairs_along,
    possible_next,
    way_names,
)

EXACT = 1e-12
"""Tolerance: a path is optimal if its score is within this distance of the upper limit."""
_CERTAIN = 700.0  # used instead of -log(1 - p) = inf for a bound that always fails


class InfeasibleError(TrustboError):
    """No admissible path respects `max_failure`.

    Attributes:
        path: Cells of the safest admissible path.
        stations: The same path with its sets of posts; see `Plan.stations`.
        p_fail: Failure probability of the safest path.

    Example:
        >>> unsafe = np.full((8, 10, 10), 0.5)  # (move, row, col)
        >>> planner = tb.Planner(workspace, (9, 0), (0, 9), max_failure=0.1).with_risk(unsafe)
        >>> try:
        ...     planner.plan(params.mean())
        ... except tb.planning.InfeasibleError as error:
        ...     print(len(error.path) - 1, "bounds")
        9 bounds
    """

    def __init__(self, message: str, stations: tuple[Station, ...], p_fail: float) -> None:
        super().__init__(message)
        self.path = tuple(cells_of(stations))
        self.stations = stations
        self.p_fail = p_fail

    def __reduce__(self) -> tuple[Any, ...]:
        # By default, pickle would call the class with the message alone.
        return type(self), (str(self), self.stations, self.p_fail)


@dataclass(frozen=True, eq=False)
class Problem(Uncached):
    """Admissible paths, objective and costs of a planner; see `Planner` for their meaning.

    Attributes:
        paths: Admissible paths.
        objective: One of the objectives in `OBJECTIVES`.
        bound_cost: Additional cost of each bound, shape (move, row, col).
        max_failure: Largest failure probability allowed for a path, or None for no limit.
        failure_cost: Cost of a failure in bounds, or None for the smallest number of bounds of a
            path.
        risk: Failure probability of each bound, by way and next way, or None if the planner has no
            risk.
        x0: Expected trust at the start, shape (robot,), or None for `x0_mean` of the parameters.
    """

    paths: AdmissiblePaths
    objective: Objective
    bound_cost: np.ndarray
    max_failure: float | None = None
    failure_cost: float | None = None
    risk: Risk | None = None
    x0: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.max_failure is not None:
            require_positive("max_failure", self.max_failure, or_zero=True)
            if self.max_failure >= 1.0:
                raise TrustboError(f"max_failure must be below 1; got {self.max_failure!r}.")

        if self.failure_cost is not None:
            require_positive("failure_cost", self.failure_cost, or_zero=True)
            if not self.objective.of_contact:
                raise TrustboError(
                    f"failure_cost is a loss of contact, but the objective "
                    f"{self.objective.name!r} does not measure contact; use max_failure instead."
                )

        n_ways = len(self.paths.bounds) * self.paths.workspace.n_posts
        shape = (n_ways, *self.paths.bounds.shape[1:], n_ways + 1)
        if self.risk is not None and self.risk.shape != shape:
            raise TrustboError(f"p_fail must have the shape {shape}; got {self.risk.shape}.")

    @property
    def cost_of_failure(self) -> float:
        """Cost of a failure in bounds; 0 without a risk or if contact is not the objective."""
        if self.risk is None or not self.objective.of_contact:
            return 0.0
        if self.failure_cost is None:
            return float(self.paths.shortest)
        return self.failure_cost

    def along(self, path: Sequence[Station] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the awareness (robot, bound, feature) and the bounds (bound, 3) of a path."""
        pairs = pairs_along(path, self.paths.workspace.n_posts)
        return self.paths.workspace.of_pairs(pairs), pairs[:, :3]

    def bound_cost_along(self, path: Sequence[Station] | np.ndarray) -> float:
        """Sum the costs of the bounds of a path."""
        return float(self.bound_cost[moves_along(path), *cells_along(path)[1:].T].sum())

    def value_along(self, bound_cost: float, trust: np.ndarray, along: Recursion) -> np.ndarray:
        """Compute the value of a path, shape (...,), assuming that no bound fails.

        `bound_cost` is the sum over the path. The team's `trust` after each bound has shape (...,
        bound), and `along` is its recursion, of which only the noise and the family are used.
        """
        objective = self.objective
        if objective.of_contact:
            lost = 1.0 - along.likelihood.mean_rate(trust, along.noise_sd[..., None])
            return objective.value(-lost.sum(-1) - bound_cost)

        n_bounds = trust.shape[-1]
        credit = objective.credit(np.arange(n_bounds))[::-1]
        scale = objective.scale(np.array([float(n_bounds)]))[0]
        return objective.value((trust @ credit - bound_cost) / scale)

    def failure_along(self, path: Sequence[Station] | np.ndarray) -> float:
        """Compute the expected cost of failure of a path, in bounds."""
        if not self.risk or not self.cost_of_failure:
            return 0.0
        return self.cost_of_failure * self.risk.failure(path)

    def contact_lost(self, path: Sequence[Station] | np.ndarray, value: float) -> float:
        """Return the contact lost on a path with this value: without costs of failure and bounds.

        The value is that of the objective lost_contact.
        """
        return -value - self.failure_along(path) - self.bound_cost_along(path)

    def costs_of_bounds(self, trust: np.ndarray, lost: np.ndarray) -> tuple[np.ndarray, float]:
        """Compute the costs of all bounds as if trust were not carried over; see `Planner.graph`.

        Args:
            trust: The team's trust after each bound of `paths.bounds`, for each set of posts in
                turn, shape (bound,).
            lost: Contact lost in each bound plus the bound cost, shape (bound,).

        Returns:
            Costs (bound,), which are nonnegative unless a bound cost is negative, and a constant c.
            The score of a path is c - (sum of costs), or c - (sum of costs) / n if it is a mean
            over n bounds.
        """
        n_posts = self.paths.workspace.n_posts
        bounds = for_sets(self.paths.bounds, n_posts)
        if self.objective.of_contact:
            if self.risk is None:
                return lost, 0.0
            p_fail = np.nan_to_num(self.risk.of_bounds)
            return lost + self.cost_of_failure * p_fail[bounds], 0.0

        bound_cost = for_sets(self.bound_cost, n_posts)[bounds]
        credit = self.objective.credit(np.arange(self.paths.longest + 1))
        if credit[1:].any():
            cost = bound_cost - trust
            constant = float(np.max(-cost, initial=0.0))
            return cost + constant, constant

        # Trust counts only at the goal. The constant makes the costs of the last bounds positive.
        enters_goal = np.zeros(bounds.shape, bool)
        enters_goal[:, *self.paths.goal] = True
        is_last = enters_goal[bounds]
        constant = float(credit[0] * trust[is_last].max())
        return bound_cost + np.where(is_last, constant - credit[0] * trust, 0.0), constant

    def is_within_limit(self, path: Sequence[Station] | np.ndarray) -> bool:
        """Return whether a path respects `max_failure`."""
        if self.max_failure is None or self.risk is None:
            return True
        return self.risk.failure(path) <= self.max_failure + ROUNDING

    def recursion(
        self, params: Draws, x0: ArrayLike | None = None, *, by_robot: bool = False
    ) -> Recursion:
        """Build the recursion for expected trust (see `trust_recursion`)."""
        z = self.paths.workspace.awareness.values
        return trust_recursion(params, z, self.initial_trust(x0), by_robot=by_robot)

    def searched(self, params: Draws, x0: ArrayLike | None = None) -> Recursion:
        """Build the recursion for `best`.

        With several sets of posts, its drift (draw, state, pair) is that of `paths.pairs`.
        """
        if self.paths.workspace.n_posts == 1:
            return self.recursion(params, x0)

        z = self.paths.awareness_of_pairs
        bounds = self.paths.pairs[:, :3]
        params.require_grid(self.paths.bounds.shape[1:])
        return trust_recursion(params, z, self.initial_trust(x0), bounds=bounds)

    def initial_trust(self, x0: ArrayLike | None) -> np.ndarray | None:
        """Read expected trust at the start, shape () or (..., robot), by the robots' names."""
        if x0 is None:
            return self.x0

        dims = ("draw", "robot") if "draw" in getattr(x0, "dims", ()) else ("robot",)
        robots = {"robot": self.paths.workspace.team.names}
        start = require_numbers("x0", read_labelled("x0", x0, dims, robots).values)

        n_robots = len(robots["robot"])
        if start.ndim and start.shape[-1] != n_robots:
            raise TrustboError(f"x0 must have the shape () or ({n_robots},); got {start.shape}.")
        return start

    @cached_property
    def edge_risks(self) -> "EdgeRisks | None":
        """Log risks of the edges in the form of the search; None if plans do not depend on risk.

        Raises:
            TrustboError: If `max_failure` is set without a risk, or `p_fail` of a bound is NaN.
        """
        if self.risk is None and self.max_failure is not None:
            raise TrustboError(
                f"max_failure = {self.max_failure:g} needs the failure probability "
                "of each bound; use planner.with_risk(p_fail)."
            )
        if self.risk is None or (self.max_failure is None and self.cost_of_failure == 0.0):
            return None

        p_fail, weights = self.risk.searched
        n_posts = self.paths.workspace.n_posts
        missing = np.isnan(p_fail).any(0) & possible_next(self.paths.bounds, n_posts)
        if missing.any():
            way, row, col, after = np.argwhere(missing)[0].tolist()
            raise TrustboError(
                f"p_fail is NaN for the bound that enters {(row, col)} by the move "
                f"{way_names(n_posts)[way]!r}, followed by {next_names(n_posts)[after]!r}; give a "
                "probability for every possible bound."
            )

        limit = np.inf if self.max_failure is None else self.max_failure + ROUNDING
        risks = risks_by_bound(p_fail)[self.paths.committed.risk]
        return EdgeRisks(risks, self.cost_of_failure, weights, limit)

    def best(self, recursion: Recursion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the best admissible path for each draw of the recursion from `searched`.

        Returns:
            Scores (draw,), upper limits on the score of any path (draw,), and paths (draw, cell),
            as `AdmissiblePaths.cells` reads them. The limits equal the scores if the search is
            exact.

        Raises:
            TrustboError: If beta0 is outside the range in which the search is exact.
            InfeasibleError: If no path respects `max_failure`.
        """
        history = has_history(self.objective, recursion.likelihood)
        self._require_valid(recursion, history)
        recursion = capped(self.objective, recursion)

        graph = self.paths.graph
        bound_cost = self.bound_cost.ravel()
        if self.paths.workspace.n_posts > 1:
            way, row, col, _ = self.paths.pairs.T
            bound_cost = self.bound_cost[way % END, row, col]
        if self.paths.workspace.n_posts > 1 or self.edge_risks is not None:
            graph = self.paths.committed.graph

        n_draws, n_states = recursion.start.shape
        drift = recursion.drift.reshape(n_draws, n_states, -1)
        state_weights = np.full(n_states, 1.0 / n_states)
        weights = weights_of(self.objective, recursion, state_weights, graph.longest)

        if self.edge_risks is None and not history:
            score, paths = best_sums(graph, drift, weights, bound_cost)
            return score, score, paths

        n_trust = 0
        loss = LOGISTIC  # not used, because trust is not tracked
        if history:  # the cost depends on trust itself and is not a weighted sum of drifts
            n_trust = n_states
            loss = LOSSES[recursion.likelihood.expected_rate]
            weights = Weights(0.0 * weights.per_bound, 0.0 * weights.constant, weights.scale)

        risks = self.edge_risks or EdgeRisks(
            np.zeros((len(graph.head), 1)), 0.0, np.zeros(1), np.inf
        )
        costs = Costs(
            loss=loss,
            drift=drift,
            weight=weights.per_bound,
            start=-weights.constant,
            transition=recursion.transition[:, :n_trust, :n_trust].copy(),
            x0=recursion.start[:, :n_trust].copy(),
            sd=np.maximum(recursion.noise_sd, TINY_SD),
            bound_cost=bound_cost,
            risk=risks.of_edges,
            failure=risks.cost_of_failure * risks.weights,
            share=risks.weights,
            limit=risks.limit,
        )
        cost, lower, paths = best_labels(graph, costs, weights.scale)
        if np.isinf(cost).any():
            self._raise_infeasible()
        return -cost, -lower, paths

    def safest(self) -> tuple[tuple[Station, ...], float]:
        """Find the admissible path with the smallest failure probability; requires a risk.

        Returns:
            The path, and its failure probability, which accounts for the components of the risk.
        """
        graph, of_edges = self.paths.committed
        p_fail, weights = cast("Risk", self.risk).searched
        n_bounds = int(graph.bound.max()) + 1
        n = graph.longest + 1

        # No bound costs anything, and a failure costs 1.
        costs = Costs(
            loss=LOGISTIC,
            drift=np.zeros((1, 1, n_bounds)),
            weight=np.zeros((1, n, 1)),
            start=np.zeros((1, n)),
            transition=np.zeros((1, 0, 0)),
            x0=np.zeros((1, 0)),
            sd=np.ones(1),
            bound_cost=np.zeros(n_bounds),
            risk=risks_by_bound(p_fail)[of_edges],
            failure=weights,
            share=weights,
            limit=np.inf,
        )
        p, _, paths = best_labels(graph, costs, np.ones(n))
        return self.paths.cells(paths[0]), float(p[0])

    def _require_valid(self, recursion: Recursion, history: bool) -> None:
        """Raise TrustboError if the search is not exact for this recursion."""
        if not self.objective.of_contact:
            return

        beta0 = np.diagonal(recursion.transition, axis1=-2, axis2=-1)
        if beta0.min() < 0.0 or (history and recursion.transition.min() < 0.0):
            raise TrustboError(
                f"the objective {self.objective.name!r} requires beta0 >= 0. If rates are "
                "nonlinear in trust, it also requires all entries of B0 >= 0. The smallest is "
                f"{recursion.transition.min():g}; use 'terminal' or 'mean' instead."
            )

    def _raise_infeasible(self) -> NoReturn:
        """Raise an error with the safest path, because no path respects `max_failure`."""
        path, p_fail = self.safest()
        if p_fail <= cast("float", self.max_failure):
            raise TrustboError(
                f"the search stopped before it found a path with a failure probability of at most "
                f"max_failure = {self.max_failure:g}; the safest path has {p_fail:.4g}. Increase "
                "max_failure, or reduce max_bounds."
            )
        raise InfeasibleError(
            f"no admissible path from {self.paths.start} to {self.paths.goal} has a failure "
            f"probability of at most max_failure = {self.max_failure:g}. The smallest is "
            f"{p_fail:.4g} on the path {path_text(path)}. Increase max_failure or max_bounds, or "
            "use this path (attribute `path` of the error).",
            path,
            p_fail,
        )


class EdgeRisks(NamedTuple):
    """Log risks -log(1 - p_fail) of the edges, which the search sums along a path.

    `of_edges` (edge, component) contains the risk of the bound of each edge of `paths.committed`,
    with one column per component of the risk. If the risks of a path add up to r_m in
    column m, it fails with probability sum_m w_m (1 - exp(-r_m)), where `weights` (component,)
    contains the w_m. This probability must not exceed `limit`, and a failure costs
    `cost_of_failure`.
    """

    of_edges: np.ndarray
    cost_of_failure: float
    weights: np.ndarray
    limit: float


def risk_of(p_fail: np.ndarray) -> np.ndarray:
    """Compute the risk -log(1 - p_fail), which is at most 700, and 0 where there is no bound."""
    with np.errstate(divide="ignore"):
        return np.minimum(-np.log1p(-np.nan_to_num(p_fail)), _CERTAIN)


def risks_by_bound(p_fail: np.ndarray) -> np.ndarray:
    """Compute risks (bound, component); a bound is a flat index into (way, row, col, next_way).

    Args:
        p_fail: Failure probabilities, shape (component, way, row, col, next_way).
    """
    return np.ascontiguousarray(risk_of(p_fail).reshape(len(p_fail), -1).T)
