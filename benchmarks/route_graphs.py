"""Routes of Nav2 on files of route graphs, against the exact plans that the files are made of.

    python benchmarks/route_graphs.py -n 3 --seeds 1

For each world, course and seed, a campaign of n missions; the graph of its posterior mean is
written for both objectives, loaded by the rules of Nav2's loader (`peers.nav2_loader`, which shares
no code with trustbo), and searched by networkx's Dijkstra. Lost is the contact that the route of
lost_contact loses beyond the exact plan, in % of the contact expected on the plan. A route may have
more bounds than `max_bounds` admits, and lose less: "admitted" compares it with the exact plan of
as many bounds as it has. Stationary: whether the route is the plan, or one of equal value.
"""

import tempfile
import warnings
from pathlib import Path

import numpy as np
from common import Table, arguments, parsed, timed, verdict
from peers.nav2_loader import load

import trustbo as tb
from trustbo.inference import params_of
from trustbo.planning import Planner
from trustbo.study import worlds
from trustbo.study.world import COURSES, World

MEDIAN, MOST = 0.2, 1.0
EQUAL = 1e-9
FEW = ("synthetic-0", "synthetic-1-wall", "wellington", "wellington-bare")


def main() -> None:
    parser = arguments(__doc__, quick="four worlds", n=3, seeds=1)
    given = parsed(parser)
    chosen = {
        name: world
        for name, world in worlds().items()
        if (world.is_made or world.is_packaged) and (not given.quick or name in FEW)
    }
    table = Table(
        "world", "course", "beta0", "largest id", "lost, %", "more bounds", "admitted, %",
        "stationary", "s", first=28,
    )  # fmt: skip
    rows = []
    for name, world in chosen.items():
        workspace = world.workspace()
        for course in COURSES:
            for seed in range(given.seeds):
                row = one(world, workspace, course, given.n, seed)
                rows.append(row)
                lost, more, admitted, same, largest, beta0, seconds = row
                table.row(
                    name, course, f"{beta0:.2f}", largest, f"{lost:.3f}", more,
                    f"{admitted:.3f}", verdict(same), f"{seconds:.2f}",
                )  # fmt: skip
    lost, _, admitted, same, *_ = (np.array(column) for column in zip(*rows, strict=True))
    for what, values in (("the plan", lost), ("that of as many bounds", admitted)):
        middle, most = np.median(values), values.max()
        print(
            f"lost beyond {what}: median {middle:.3f} % (target {MEDIAN} %: "
            f"{verdict(middle <= MEDIAN)}), most {most:.3f} % (target {MOST} %: "
            f"{verdict(most <= MOST)})"
        )
    print(f"stationary is the plan in {same.sum()} of {len(same)}: {verdict(same.all())}")


def one(
    world: World, workspace: tb.Workspace, course: str, n: int, seed: int
) -> tuple[float, int, float, bool, int, float, float]:
    """Figures of a campaign; seconds are those of a file."""
    start, goal = world.ends(course)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = tb.iterate(
            workspace, start, goal, n_iterations=n, simulator=world.simulator(workspace),
            connectivity=world.connectivity, progress=False, seed=seed,
        )  # fmt: skip
    params, planner = params_of(result.posterior).mean(), result.planner
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "graph.geojson"
        graph, route, seconds = {}, {}, 0.0
        for objective in ("lost_contact", "stationary"):
            seconds, graph[objective] = timed(
                lambda kind=objective: tb.export.write_route_graph(file, result, objective=kind)
            )
            route[objective] = cells_of(file, workspace, start, goal)
    plan = planner.plan(params)
    found = planner.evaluate(route["lost_contact"], params)
    contact = len(plan.path) - 1 + plan.value + planner.problem.cost_of_failure(plan.path)
    more = len(found.path) - len(plan.path)
    best = plan.value
    if len(found.path) - 1 > planner.longest:
        wider = Planner(
            workspace, start, goal, max_bounds=f"shortest+{len(found.path) - 1 - planner.shortest}",
            connectivity=world.connectivity,
        )  # fmt: skip
        risk = planner.problem.risk
        best = wider.with_risk(None if risk is None else risk.p_fail).plan(params).value
    free = planner.with_objective("stationary")
    exact = free.plan(params)
    scores = [np.log(plan.value) for plan in (exact, free.evaluate(route["stationary"], params))]
    largest = int(max(graph["lost_contact"].edges.max(), graph["lost_contact"].nodes.max()))
    lost, admitted = (100.0 * (value - found.value) / contact for value in (plan.value, best))
    same = scores[0] - scores[1] <= EQUAL
    return lost, more, admitted, bool(same), largest, float(np.mean(params.beta0)), seconds


def cells_of(
    file: Path, workspace: tb.Workspace, start: tuple[int, int], goal: tuple[int, int]
) -> list[tuple[int, int]]:
    """Cells of the cheapest route of a file."""
    rows, cols = workspace.grid.shape
    nodes = load(file).route(*(row * cols + col for row, col in (start, goal)))
    return [divmod(node, cols) for node in nodes if node < rows * cols]


if __name__ == "__main__":
    main()
