"""Speed of planning beside networkx and scipy.

Run: python benchmarks/planning.py [--quick]

Peers get what they are good at: networkx a graph that is built once and whose weights are set
anew for each draw; scipy a CSR matrix likewise. All find the same costs (checked to 1e-9). Medians
of 5 (networkx: of 1, on fewer draws, scaled); uses all cores that the process may.
"""

import networkx as nx
import numpy as np
from common import Table, arguments, faster, median_seconds, parsed, timed, verdict
from scipy.ndimage import gaussian_filter
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from trustbo.inference import sample_prior
from trustbo.models import PooledTrust, TrustParams
from trustbo.planning import Planner
from trustbo.planning.paths import AdmissiblePaths, PathClass
from trustbo.planning.search.buckets import best_stationary
from trustbo.planning.values import entry_cost
from trustbo.workspace import Workspace


def workspace_of(n, kind="open", seed=0):
    """One robot on n x n cells: smooth features; a maze has walls with one gap each."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(size=(n, n, 2))
    if n > 10:
        z = gaussian_filter(rng.normal(size=(n, n, 2)), (n / 40, n / 40, 0))
        z = (z - z.min()) / (z.max() - z.min())
    passable = np.ones((n, n), bool)
    if kind == "maze":
        passable[1::4, :-1] = False
        passable[3::4, 1:] = False
        passable[-1], passable[-2, -1] = True, True
    return Workspace.from_awareness(z[None], passable)


def csr_of(admissible):
    """Edges by their targets, in CSR order: weights are then one fancy index away."""
    neighbours = admissible.neighbours
    rows, moves = np.nonzero(neighbours >= 0)
    cols = neighbours[rows, moves]
    n = len(neighbours)
    return csr_matrix((np.ones(len(cols)), (rows, cols)), shape=(n, n))


class Times(Table):
    """Milliseconds of each way, and their ratio to ours."""

    def __init__(self, what):
        super().__init__("", what, "of ours", "note", first=52, others=10)

    def line(self, label, took, ours=None, note=""):
        """Print a way."""
        self.row(label, f"{1e3 * took:.3f} ms", "" if ours is None else faster(took, ours), note)


def many_draws(n, n_networkx):
    """1000 draws of the posterior on n x n cells."""
    print(f"\n## 1000 draws, {n} x {n} cells, each draw's best path\n")
    table = Times("all 1000")
    workspace = workspace_of(n)
    ends = (workspace, (n - 1, 0), (0, n - 1))
    draws = sample_prior(PooledTrust(), 2, 1000, seed=0)
    planner = Planner(*ends, "stationary")
    ours = median_seconds(lambda: planner.plan_draws(draws))
    drawn = planner.plan_draws(draws)
    table.line("trustbo, stationary (a history-free cost)", ours)

    dynamics = planner.dynamics(draws)
    steady_state, tolls = dynamics.steady_state(), np.zeros((8, 1))
    start, goal = planner.paths.flat(planner.start), planner.paths.flat(planner.goal)
    search = median_seconds(
        lambda: best_stationary(
            steady_state.__getitem__,
            1000,
            planner.paths.passable,
            tolls,
            planner.paths.steps,
            start,
            goal,
        )
    )
    table.line("the same without computing u from the draws", search)
    costs = entry_cost(planner.paths.passable, dynamics)[:, 0]
    matrix = csr_of(planner.paths)

    def scipy_loop():
        totals = np.empty(len(costs))
        for d, cost in enumerate(costs):
            matrix.data = cost.ravel()[matrix.indices]
            totals[d] = dijkstra(matrix, indices=start)[goal]
        return totals

    took, totals = timed(scipy_loop)
    np.testing.assert_allclose(np.exp(-totals), drawn.values, rtol=1e-9)
    table.line("scipy.sparse.csgraph.dijkstra, reused matrix", took, ours, target(took / ours, 5))
    print(f"(scipy is given the costs: {took / search:.1f} x our search alone)")

    graph = planner.graph
    some = range(0, 1000, 1000 // n_networkx)

    def networkx_loop():
        totals = []
        for d in some:
            cost = costs[d]
            for _, b, data in graph.edges(data=True):
                data["weight"] = cost[b]
            totals.append(nx.dijkstra_path_length(graph, planner.start, planner.goal))
        return totals

    took, totals = timed(networkx_loop)
    np.testing.assert_allclose(np.exp(-np.array(totals)), drawn.values[list(some)], rtol=1e-9)
    took *= 1000 / len(some)
    table.line("networkx, reused graph", took, ours, target(took / ours, 50 if n == 10 else 150))
    if n == 10:
        print(f"\n5 ms for 1000 draws: {verdict(ours <= 5e-3)} ({1e3 * ours:.1f} ms)")

    planner = Planner(*ends, "terminal")
    planner.plan_draws(draws)
    ours = median_seconds(lambda: planner.plan_draws(draws))
    table.line("trustbo, terminal, shortest + 2 bounds", ours)
    contact_lost(table, ends, n)
    if n > 10:
        return
    by_networkx, few = Planner(*ends, "terminal", engine="networkx"), 20
    took, drawn = timed(lambda: by_networkx.plan_draws(draws, n_draws=few))
    compiled = planner.plan_draws(draws, n_draws=few)
    np.testing.assert_allclose(compiled.values, drawn.values, rtol=1e-9)
    table.line("our reference on networkx (layered graph)", took * 1000 / few, ours)


def contact_lost(table, ends, n):
    """1000 draws by lost_contact, for rates that are linear in trust, and for counts."""
    for family, most in (("gaussian", 5), ("beta_binomial", 50)):
        planner = Planner(*ends, observation=family)
        draws = sample_prior(PooledTrust(observation=family), 2, 1000, seed=0)
        took = median_seconds(lambda p=planner, d=draws: p.plan_draws(d))
        note = "" if n > 10 else f"target {most} ms: {verdict(took <= most * 1e-3)}"
        table.line(f"trustbo, lost_contact, {family}", took, None, note)


def target(ratio, least):
    return f"target {least} x: {verdict(ratio >= least)}"


def large(n, kind, peers):
    """One plan on n x n cells, from an array to a path."""
    print(f"\n## one plan, {n} x {n} cells, {kind}, from an array\n")
    table = Times("one plan")
    workspace = workspace_of(n, kind)
    params = TrustParams(0.6, np.array([0.8, 0.6]), -0.2, 0.1, 0.1)
    ends = (workspace, (0, 0), (n - 1, n - 1))

    def trustbo_plan():
        return Planner(*ends, "stationary", engine="numba").plan(params)

    ours, plan = median_seconds(trustbo_plan), trustbo_plan()
    table.line("trustbo, stationary, Planner and plan", ours, None, f"{len(plan.path)} cells")
    planner = Planner(*ends, "stationary")
    cost = entry_cost(planner.paths.passable, planner.dynamics(params))[0]
    start, goal = planner.paths.flat(planner.start), planner.paths.flat(planner.goal)

    def scipy_plan():
        admissible = AdmissiblePaths(workspace, (0, 0), (n - 1, n - 1), PathClass(8, "shortest+2"))
        matrix = csr_of(admissible)
        matrix.data = cost.ravel()[matrix.indices]
        total, before = dijkstra(matrix, indices=start, return_predecessors=True)
        return total[goal], path_of(before, start, goal, n)

    took, (total, _) = timed(scipy_plan)
    np.testing.assert_allclose(np.exp(-total), plan.value, rtol=1e-7)
    asked = kind == "open"  # the targets for terrain; for a maze, the heap's is the target
    note = target(took / ours, 5) if asked else ""
    table.line("scipy.sparse.csgraph.dijkstra, matrix built", took, ours, note)

    def heap_plan():
        total, before = heap(cost, start, goal)
        return total, path_of(before, start, goal, n)

    took, (total, _) = median_seconds(heap_plan), heap_plan()
    np.testing.assert_allclose(np.exp(-total), plan.value, rtol=1e-7)
    table.line(
        "a binary heap, compiled", took, ours, f"target, not over 2 x: {verdict(ours <= 2 * took)}"
    )
    if peers:
        took, total = timed(lambda: networkx_plan(cost, (0, 0), (n - 1, n - 1)))
        np.testing.assert_allclose(np.exp(-total), plan.value, rtol=1e-7)
        table.line("networkx, graph built", took, ours, target(took / ours, 500) if asked else "")


def networkx_plan(cost, start, goal):
    rows, cols = cost.shape
    graph = nx.DiGraph()
    for r, c in np.argwhere(np.isfinite(cost)).tolist():
        for i in range(max(0, r - 1), min(rows, r + 2)):
            for j in range(max(0, c - 1), min(cols, c + 2)):
                if (i, j) != (r, c) and cost[i, j] < np.inf:
                    graph.add_edge((r, c), (i, j), weight=cost[i, j])
    return nx.dijkstra_path_length(graph, start, goal)


def path_of(before, start, goal, n_cols):
    """Cells (row, col), as every peer's user wants them."""
    path, c = [goal], goal
    while c != start:
        c = before[c]
        path.append(c)
    rows, cols = np.divmod(np.array(path[::-1]), n_cols)
    return list(zip(rows.tolist(), cols.tolist(), strict=True))


def _make_heap():
    """Dijkstra with a binary heap, compiled by numba too."""
    import heapq

    from numba import njit

    @njit
    def dijkstra_heap(cost, start, goal):
        rows, cols = cost.shape
        known = np.full((rows, cols), np.inf)
        known[start // cols, start % cols] = 0.0
        before = np.full(rows * cols, -1)
        queue = [(0.0, start)]
        while queue:
            total, c = heapq.heappop(queue)
            r, k = c // cols, c % cols
            if c == goal:
                return total, before
            if total > known[r, k]:
                continue
            for i in range(max(0, r - 1), min(rows, r + 2)):
                for j in range(max(0, k - 1), min(cols, k + 2)):
                    if total + cost[i, j] < known[i, j]:
                        known[i, j], before[i * cols + j] = total + cost[i, j], c
                        heapq.heappush(queue, (known[i, j], i * cols + j))
        return np.inf, before

    return dijkstra_heap


heap = _make_heap()


def main():
    given = parsed(arguments(__doc__, quick="a smaller map, without networkx on it"))
    many_draws(10, 200)
    many_draws(100, 5)
    for kind in ("open", "maze"):
        large(300 if given.quick else 1000, kind, peers=not given.quick)


if __name__ == "__main__":
    main()
