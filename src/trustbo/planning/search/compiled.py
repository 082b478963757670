"""The compiled engine: the search for each kind of case, in one table."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from trustbo.data import Cell
from trustbo.errors import TrustboError
from trustbo.parallel import over_rows, plain
from trustbo.planning.dynamics import Dynamics
from trustbo.planning.objectives import Objective
from trustbo.planning.paths import AdmissiblePaths
from trustbo.planning.search import labels, labels_vector
from trustbo.planning.search.buckets import best_stationary
from trustbo.planning.search.case import Case
from trustbo.planning.search.costs_to_go import safest_to_go
from trustbo.planning.search.graph import Best, Graph, Resources, SearchProblem, no_resources
from trustbo.planning.search.labels import solve
from trustbo.planning.search.layers import Weights, best_additive
from trustbo.planning.search.losses import NONE, TINY_SD, loss_for
from trustbo.planning.values import entry_cost


def plan_compiled(case: Case) -> Best | None:
    """Find the best path of every draw; None if none is feasible under a risk."""
    best = SEARCHES[case.kind, case.risk is not None](case)
    missing = best.paths[:, 0] < 0
    if not missing.any():
        return best
    if (missing & (best.lower < np.inf)).any():
        raise _too_many_labels(case)
    return None


def _sums(case: Case) -> Best:
    u = case.dynamics.drift
    return _best_of_lengths(case, u.reshape(*u.shape[:3], -1), case.weights)


def _best_of_lengths(case: Case, drift: np.ndarray, weights: Weights) -> Best:
    layers, tolls = case.admissible.layers, case.tolls
    lengths = np.arange(case.admissible.shortest, case.admissible.longest + 1)
    if not tolls.any() or (weights.scale == 1.0).all():
        scores, paths = best_additive(layers, drift, weights, tolls, lengths)
        return Best(paths, -scores, -scores)
    # A mean divides by the number of bounds, so its toll is scaled for each of them.
    tries = [
        best_additive(layers, drift, weights, n * tolls, lengths[i : i + 1])
        for i, n in enumerate(lengths)
    ]
    scores = np.stack([scores for scores, _ in tries])
    chosen = np.argmax(scores, axis=0)
    paths = np.stack([tries[i][1][d] for d, i in enumerate(chosen)])
    return Best(paths, -scores.max(0), -scores.max(0))


def _sums_within(case: Case) -> Best:
    weights, u = case.weights, case.dynamics.drift
    u = u.reshape(*u.shape[:2], -1)
    return _best_sums(
        case, [w @ of_draw for w, of_draw in zip(weights.per_bound, u, strict=True)], weights
    )


def _best_sums(case: Case, gains: list[np.ndarray], weights: Weights) -> Best:
    """Find the paths of the largest score of gains (left, bound) or (left, cell) of each draw."""
    layers, n_cells = case.admissible.layers, case.admissible.passable.size
    left, bound, cell = layers.rank[layers.head], layers.bound, layers.cell[layers.head]
    return best_sums(
        layers,
        lambda d: gains[d][left, bound if gains[d].shape[1] > n_cells else cell],
        weights,
        case.tolls_on(layers),
        _resources(case, layers),
    )


def best_sums(
    layers: Graph,
    gains: Callable[[int], np.ndarray],
    weights: Weights,
    tolls: np.ndarray,
    resources: Resources,
) -> Best:
    """Find the paths of the largest (constant + sum of gains) / scale less their toll.

    Gains (edge,) of a draw, by its index, and tolls (edge,).
    """
    scale, lengths = weights.scale, np.flatnonzero(layers.starts >= 0)
    groups = [lengths] if (scale == 1.0).all() else lengths[:, None]
    found: list[Best] = [_nothing()] * len(weights.constant)

    def work(first: int, last: int) -> None:
        for d in range(first, last):
            of_edges = gains(d)
            for group in groups:
                start_cost = np.full((1, len(scale)), np.inf)
                start_cost[0, group] = -weights.constant[d, group] / scale[group]
                toll = (tolls - of_edges / scale[group[0]])[None]
                found[d] = _better(
                    solve(_of_sums(layers, toll, start_cost, resources), found[d].cost), found[d]
                )

    over_rows(work, len(found)) if len(found) > 1 else work(0, 1)
    return _together(found)


def _of_sums(
    graph: Graph, toll: np.ndarray, start_cost: np.ndarray, resources: Resources
) -> SearchProblem:
    """Problem of tolls (draw, edge) alone."""
    trust = np.repeat([[0.0, 0.0, 1.0]], len(toll), axis=0)
    return SearchProblem(graph, toll, np.zeros((1, 1)), start_cost, trust, NONE, resources)


def _nothing() -> Best:
    return Best(np.full((1, 1), -1), np.array([np.inf]), np.array([np.inf]))


def _better(new: Best, old: Best) -> Best:
    """The new path of one draw if there is one, else the old one, with the lower of both limits."""
    paths = new.paths if new.paths[0, 0] >= 0 else old.paths
    return Best(paths, np.minimum(new.cost, old.cost), np.minimum(new.lower, old.lower))


def _together(found: list[Best]) -> Best:
    """Best paths of several draws, in one table."""
    paths = np.full((len(found), max(best.paths.shape[1] for best in found)), -1)
    for row, best in zip(paths, found, strict=True):
        row[: best.paths.shape[1]] = best.paths[0]
    return Best(
        paths,
        np.concatenate([best.cost for best in found]),
        np.concatenate([best.lower for best in found]),
    )


def _history(case: Case) -> Best:
    layers = case.admissible.layers
    toll = np.zeros(len(layers.head))
    if case.objective.has_toll:
        toll = case.tolls_on(layers)
    return best_history(layers, case.dynamics, case.objective, toll, _resources(case, layers))


def best_history(
    layers: Graph, dynamics: Dynamics, objective: Objective, tolls: np.ndarray, resources: Resources
) -> Best:
    """Find the paths of the least sum of losses of one trust, and of tolls (edge,)."""
    n_draws = len(dynamics.start)
    start_cost, trust = np.zeros((1, len(layers.starts))), np.empty((n_draws, 3))
    trust[:, 0], trust[:, 1] = dynamics.transition[:, 0, 0], dynamics.start[:, 0]
    trust[:, 2] = np.maximum(dynamics.noise_sd, TINY_SD)
    drift = plain(dynamics.drift[:, 0].reshape(n_draws, -1))
    loss = loss_for(objective)
    return solve(SearchProblem(layers, tolls[None], drift, start_cost, trust, loss, resources))


def _resources(case: Case, graph: Graph) -> Resources:
    """Risks of bounds as resources on a graph; none without a risk."""
    admissible, risk = case.admissible, case.risk
    if risk is None:
        return no_resources(graph, len(admissible.steps) * admissible.passable.size)
    of_bounds = np.ascontiguousarray(risk.of_bounds.reshape(len(risk.limits), -1).T)
    return Resources(
        of_bounds,
        risk.limits,
        risk.needed,
        risk.failure_costs,
        *risk.priced(of_bounds),
        safest_to_go(graph, of_bounds),
    )


def _vector(case: Case) -> Best:
    grid = case.admissible.grid
    resources = _resources(case, grid)
    of_cells = np.full((case.admissible.passable.size, len(resources.limits)), np.inf)
    of_cells[grid.cell] = resources.safest
    resources = resources._replace(safest=of_cells)
    return labels_vector.best_paths(case.admissible, case.dynamics, case.objective, resources)


def _free(case: Case) -> Best:
    admissible, dynamics = case.admissible, case.dynamics
    totals, paths = best_stationary(
        lambda part: admissible.masked(dynamics.take(part).steady_state()),
        len(dynamics.start),
        admissible.passable,
        case.tolls,
        admissible.steps,
        admissible.flat(admissible.start),
        admissible.flat(admissible.goal),
    )
    return Best(paths, totals, totals)


def _free_within(case: Case) -> Best:
    grid, cost = case.admissible.grid, entry_cost(case.admissible.passable, case.dynamics)
    cost = cost.reshape(len(cost), -1)
    by_bound = cost.shape[1] > case.admissible.passable.size
    toll = cost[:, grid.bound if by_bound else grid.cell[grid.head]] + case.tolls_on(grid)
    return solve(_of_sums(grid, toll, np.zeros((1, 1)), _resources(case, grid)))


SEARCHES = {
    ("sum", False): _sums,
    ("sum", True): _sums_within,
    ("history", False): _history,
    ("history", True): _history,
    ("vector", False): _vector,
    ("vector", True): _vector,
    ("free", False): _free,
    ("free", True): _free_within,
}
"""Search by the kind of a problem, and whether there is a risk."""


def safest_path(
    admissible: AdmissiblePaths, objective: str, of_bounds: np.ndarray
) -> tuple[tuple[Cell, ...], float]:
    """Find the admissible path with the least sum of a risk (move, cell), and this sum."""
    graph = admissible.grid if objective == "stationary" else admissible.layers
    start_cost = np.zeros((1, len(graph.starts)))
    toll = of_bounds.ravel()[graph.bound][None]
    best = solve(_of_sums(graph, toll, start_cost, no_resources(graph, of_bounds.size)))
    path = admissible.cells(best.paths[0])
    rows, cols = np.array(path[1:]).T
    moves = [admissible.steps.tolist().index([c[0] - a[0], c[1] - a[1]]) for a, c in pairwise(path)]
    return path, float(of_bounds[moves, rows * admissible.passable.shape[1] + cols].sum())


def _too_many_labels(case: Case) -> TrustboError:
    """Error of a search that reached the limit on labels without a path."""
    where, instead = "", "team='mean'"
    if case.risk is not None:
        where, instead = " under max_failure", "a higher limit"
    return TrustboError(
        f"more than {labels.MAX_LABELS} partial paths are worth keeping{where}; lower max_bounds = "
        f"{case.admissible.longest}, use larger cells, or {instead}."
    )
