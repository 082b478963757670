"""Speed of planning, compared with networkx and scipy.

    python benchmarks/planning.py [--quick]

The table contains CPU times in milliseconds, as medians of 5 runs. The reference planner on
networkx runs once with fewer draws, and its time is scaled. Both planners must find the same values
(tolerance 1e-9). Dijkstra's algorithm in scipy and networkx solves an easier problem: the costs in
`planner.graph` do not depend on earlier bounds.
"""

import time

import networkx as nx
import numpy as np
from common import Table, arguments, parsed
from peers import networkx_planner
from scipy.ndimage import gaussian_filter
from scipy.sparse.csgraph import dijkstra

from trustbo.hazard.components import Components
from trustbo.inference import sample_prior
from trustbo.models import PooledTrust, TrustParams
from trustbo.planning import Planner
from trustbo.workspace import Workspace

PARAMS = TrustParams(0.6, np.array([0.8, 0.6]), -0.2, 0.1, 0.1)


def workspace_of(n, seed=0):
    """Make a workspace of one robot on n x n cells, with smooth features if n > 10."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(size=(n, n, 2))
    if n > 10:
        z = gaussian_filter(rng.normal(size=(n, n, 2)), (n / 40, n / 40, 0))
        z = (z - z.min()) / (z.max() - z.min())
    return Workspace.from_awareness(z[None])


def milliseconds(run, n=5):
    """Return the median CPU time of a call, in milliseconds, after one call to warm up."""
    run()
    took = []
    for _ in range(n):
        started = time.process_time()
        run()
        took.append(1e3 * (time.process_time() - started))
    return float(np.median(took))


def many_draws(table, n, few):
    """Time the plans of 1000 prior draws on n x n cells, from corner to corner."""
    workspace, ends = workspace_of(n), ((n - 1, 0), (0, n - 1))
    for objective in ("terminal", "lost_contact"):
        planner = Planner(workspace, *ends, objective)
        draws = sample_prior(PooledTrust(), 2, 1000, seed=0)
        took = milliseconds(lambda p=planner, d=draws: p.plan_draws(d))
        note = ""
        if few:
            started = time.process_time()
            slow = [networkx_planner.plan(planner, draws.draw(d)).value for d in range(few)]
            factor = (time.process_time() - started) * 1e6 / few / took
            np.testing.assert_allclose(planner.plan_draws(draws).values[:few], slow, rtol=1e-9)
            note = f"reference on networkx: {factor:.0f} x"
        table.row(f"1000 draws, {n} x {n}, {objective}", f"{took:.2f}", note)


def components_of(n):
    """Make failure probabilities of n x n cells, in five components from mild to severe."""
    base = np.random.default_rng(1).uniform(0.0, 0.2 / n, (8, n, n))
    severity = np.array([0.1, 0.4, 1.0, 3.0, 8.0])[:, None, None, None]
    return Components(np.minimum(base * severity, 1.0), np.array([0.4, 0.3, 0.15, 0.1, 0.05]))


def one_plan(table, n):
    """Time a plan without a failure cost, with a failure cost, and with `max_failure`."""
    workspace, components = workspace_of(n), components_of(n)
    mean = np.tensordot(components.weights, components.p_fail, 1)
    for family in ("gaussian", "censored"):
        params = PARAMS.replace(family=family)
        for label, options, risk in (
            ("", {}, None),
            (", failure cost of one component", {}, (mean,)),
            (", failure cost of five components", {}, (mean, None, components)),
            (", max_failure", {"max_failure": 0.2, "failure_cost": 0.0}, (mean,)),
        ):
            planner = Planner(workspace, (n - 1, 0), (0, n - 1), **options)
            planner = planner if risk is None else planner.with_risk(*risk)
            exact = "" if planner.plan(params).exact else "not exact"
            took = milliseconds(lambda p=planner, q=params: p.plan(q), 21 if n < 20 else 5)
            table.row(f"plan, {n} x {n}, {family}{label}", f"{took:.2f}", exact)


def large(table, n, peers):
    """Time one plan on n x n cells, including `Planner`; also Dijkstra in scipy and networkx."""
    workspace = workspace_of(n)
    for label, ends in (
        ("corners", ((0, 0), (n - 1, n - 1))),
        ("north to south", ((0, n // 2), (n - 1, n // 2))),
    ):
        took = milliseconds(lambda e=ends: Planner(workspace, *e).plan(PARAMS), 1)
        table.row(f"Planner and plan, {n} x {n}, {label}", f"{took:.0f}", "")
    if not peers:
        return
    planner = Planner(workspace, (0, 0), (n - 1, n - 1))
    graph = planner.graph(PARAMS)
    matrix = nx.to_scipy_sparse_array(graph, weight="lost", format="csr")
    took = milliseconds(lambda: dijkstra(matrix, indices=0), 1)
    table.row(f"scipy dijkstra, {n} x {n}, matrix given", f"{took:.0f}", "no history")
    ends = planner.start, planner.goal
    took = milliseconds(lambda: nx.dijkstra_path(graph, *ends, weight="lost"), 1)
    table.row(f"networkx dijkstra, {n} x {n}, graph given", f"{took:.0f}", "no history")


def main():
    given = parsed(arguments(__doc__, quick="smaller maps"))
    table = Table("", "ms", "note", first=52, others=12, name="planning")
    many_draws(table, 10, 20)
    many_draws(table, 100, 0)
    for n in (10, 50):
        one_plan(table, n)
    large(table, 100, peers=True)
    large(table, 300 if given.quick else 1000, peers=False)


if __name__ == "__main__":
    main()
