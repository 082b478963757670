"""The compiled engine where plans have a risk: dispatch of each objective to its kernel."""

from itertools import pairwise

import numpy as np

from trustbo.data import Cell
from trustbo.errors import TrustboError
from trustbo.parallel import over_rows
from trustbo.planning.dynamics import Dynamics
from trustbo.planning.objectives import Objective
from trustbo.planning.paths import AdmissiblePaths
from trustbo.planning.risk import RiskTable
from trustbo.planning.search.constrained_stationary import Network, least_to_goal
from trustbo.planning.search.constrained_stationary import best_within as best_free_within
from trustbo.planning.search.contact_loss import LAWS, TINY_SD
from trustbo.planning.search.costs_to_go import (
    LEAST,
    NONE,
    SOFTPLUS,
    Bounds,
    EdgeRisk,
    safest_to_go,
)
from trustbo.planning.search.dual import Best
from trustbo.planning.search.labels import best_within
from trustbo.planning.search.layers import Weights, additive_weights, best_additive
from trustbo.planning.search.reference import best_stationary

_MAX_LABELS = 300_000  # per search
_MAX_ENTRIES = 20_000_000  # of the risks of labels


class LayeredSearch:
    """Search for the best path within a risk over the layered DAG, for one draw after another."""

    def __init__(
        self, admissible: AdmissiblePaths, risk: RiskTable, length_cost: np.ndarray
    ) -> None:
        """Prepare what all draws share: risk and length cost of the edges."""
        layers = admissible.layers
        self.layers, self.lengths = layers, np.arange(len(layers.starts))
        self.lengths = self.lengths[layers.starts >= 0]
        n_cells, cell = admissible.passable.size, layers.cell[layers.head].astype(np.int64)
        self.n_cells, self.cell, self.left = n_cells, cell, layers.left[layers.head]
        self.bound = layers.move.astype(np.int64) * n_cells + cell
        of_bounds = np.ascontiguousarray(risk.of_bounds.reshape(len(risk.limits), -1).T)
        self.length_cost = length_cost[layers.move]
        self.risk = EdgeRisk(
            of_bounds,
            self.bound,
            *risk.priced(of_bounds),
            risk.limits,
            risk.needed,
            risk.failure_cost,
            safest_to_go(layers, of_bounds, self.bound),
        )

    def sums(self, gain: np.ndarray, constant: np.ndarray, scale: np.ndarray) -> Best:
        """Find the path with the largest (constant + sum of gains) / scale less its length cost.

        Gains (left, move and cell) by the bounds left after a bound, of one move where all into a
        cell are alike; constant and scale (length,).
        """
        gains = gain[self.left, self.bound if gain.shape[1] > self.n_cells else self.cell]
        best = Best(np.empty(0, np.int64), np.inf, np.inf)
        groups = [self.lengths] if (scale == 1.0).all() else self.lengths[:, None]
        for lengths in groups:
            start_cost = np.full(len(scale), np.inf)
            start_cost[lengths] = -constant[lengths] / scale[lengths]
            toll = self.length_cost - gains / scale[lengths[0]]
            found = self._find(toll, np.zeros(len(toll)), start_cost, (0.0, 0.0, 1.0), NONE, best)
            best = found
        return best

    def losses(self, dynamics: Dynamics, law: int) -> Best:
        """Find the path of the least losses of scalar trust; `dynamics` of one draw."""
        drift, start_cost = dynamics.drift[0], np.full(len(self.layers.starts), np.inf)
        start_cost[self.lengths] = 0.0
        sd = max(float(dynamics.noise_sd), TINY_SD)
        trust = float(dynamics.transition[0, 0]), float(dynamics.start[0]), sd
        u = drift.ravel()[self.bound if len(drift) > 1 else self.cell]
        best = Best(np.empty(0, np.int64), np.inf, np.inf)
        return self._find(self.length_cost.copy(), u, start_cost, trust, law, best)

    def _find(
        self,
        toll: np.ndarray,
        drift: np.ndarray,
        start_cost: np.ndarray,
        trust: tuple[float, float, float],
        law: int,
        best: Best,
    ) -> Best:
        """Find a path better than `best`, which else is returned with the lower of both bounds."""
        found = best_within(
            self.layers,
            Bounds(toll, drift, start_cost, *trust, law),
            self.risk,
            best.cost,
            most_labels(self.risk.limits),
        )
        bound = min(found.bound, best.bound)
        return Best(found.path if len(found.path) else best.path, min(found.cost, best.cost), bound)


def plan_layered(
    admissible: AdmissiblePaths, dynamics: Dynamics, objective: Objective, risk: RiskTable
) -> list[Best]:
    """Find the best feasible path of every draw of scalar trust, or where the value is a sum.

    `dynamics` with a leading axis (draw,); no path where none is feasible.
    """
    n_draws, nothing = len(dynamics.start), Best(np.empty(0, np.int64), np.inf, np.inf)
    search = LayeredSearch(admissible, risk, objective.length_weight * admissible.lengths)
    weights = additive_weights(dynamics, dynamics.views[0], objective, admissible.longest)
    found = [nothing] * n_draws

    def work(first: int, last: int) -> None:
        for d in range(first, last):
            one = dynamics.take(d)
            if objective.has_labels:
                found[d] = search.losses(one, law_of(objective))
            else:
                gain = weights.per_bound[d] @ one.drift.reshape(len(one.start), -1)
                found[d] = search.sums(gain, weights.constant[d], weights.scale)

    work(0, n_draws) if n_draws == 1 else over_rows(work, n_draws)
    return found


def safest_path(
    admissible: AdmissiblePaths, objective: str, of_bounds: np.ndarray
) -> tuple[tuple[Cell, ...], float]:
    """Find the admissible path with the least sum of a risk (move, cell), and this sum."""
    if objective == "stationary":
        cost = of_bounds.reshape(-1, *admissible.passable.shape)
        path = best_stationary(admissible, cost, 0.0, None)
    else:
        n = admissible.longest + 1
        weights = Weights(np.ones((1, n, 1)), np.zeros((1, n)), np.ones(n))
        lengths = np.arange(admissible.shortest, n)
        no_cost = np.zeros(len(admissible.lengths))
        drift = -of_bounds[None, None]
        _, paths = best_additive(admissible.layers, drift, weights, no_cost, lengths)
        path = admissible.cells(paths[0])
    rows, cols = np.array(path[1:]).T
    moves = [admissible.steps.tolist().index([c[0] - a[0], c[1] - a[1]]) for a, c in pairwise(path)]
    return path, float(of_bounds[moves, rows * admissible.passable.shape[1] + cols].sum())


def plan_stationary(
    admissible: AdmissiblePaths, cost: np.ndarray, length_cost: np.ndarray, risk: RiskTable
) -> list[Best]:
    """Find the feasible path of least cost under every draw.

    Costs are those of bounds, (draw, move, row, col).
    """
    of_bounds = np.ascontiguousarray(risk.of_bounds.reshape(len(risk.limits), -1).T)
    goal = admissible.flat(admissible.goal)
    n_moves, n_cells = len(length_cost), admissible.passable.size
    by_bound = np.broadcast_to(cost.reshape(len(cost), -1, n_cells), (len(cost), n_moves, n_cells))
    tolls = (by_bound + length_cost[:, None]).reshape(len(cost), -1)
    shared = of_bounds, *risk.priced(of_bounds), risk.limits, risk.needed
    safest = least_to_goal(admissible.neighbours, of_bounds, goal)
    ends = admissible.neighbours, admissible.flat(admissible.start), goal
    return [
        best_free_within(Network(*ends, toll, *shared, safest), most_labels(risk.limits))
        for toll in tolls
    ]


def most_labels(limits: np.ndarray) -> int:
    """Limit on the labels of a search."""
    return min(_MAX_LABELS, _MAX_ENTRIES // len(limits))


def law_of(objective: Objective) -> int:
    """Loss of a bound for an objective with labels."""
    if objective.name == "success":
        return SOFTPLUS
    return LEAST if objective.name == "bottleneck" else LAWS[objective.family.expected_rate]


def require_complete(found: list[Best], longest: int) -> None:
    """Refuse searches that ended at the limit on labels without a path: TrustboError."""
    if any(len(best.path) == 0 and best.bound < np.inf for best in found):
        raise TrustboError(
            f"more than {_MAX_LABELS} partial paths are worth keeping under max_failure; lower "
            f"max_bounds = {longest}, use larger cells, or no confidence."
        )
