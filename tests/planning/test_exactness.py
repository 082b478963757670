"""Every engine against every admissible path written out, for every model and team."""

import heapq
from functools import cache

import numpy as np
import pytest
from references import of_bounds, path_values, sums_of, walks
from worlds import with_unseen

from trustbo.models import CoupledParams, RobotParams, TrustParams
from trustbo.planning import Planner
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVES

BETA0 = {
    "lost_contact": (0.0, 0.3, 0.7, 1.0, 1.3),
    "terminal": (-0.8, 0.0, 0.3, 0.7, 1.0, 1.3),
    "mean": (-0.8, 0.0, 0.3, 0.7, 1.0, 1.3),
    "success": (0.0, 0.3, 0.7, 1.0, 1.3),
    "bottleneck": (0.0, 0.3, 0.7, 1.0, 1.3),
    "stationary": (-0.8, 0.0, 0.3, 0.7),
}
CELL = 20.0


@cache
def random_map(n, connectivity, seed, extra, kind):
    """A random map of obstacles whose corners are connected, and all its admissible paths."""
    rng = np.random.default_rng([n, connectivity, seed])
    ends, kind = ((n - 1, 0), (0, n - 1)), dict(kind)
    while True:
        passable = rng.uniform(size=(n, n)) > rng.uniform(0.1, 0.15)
        passable[ends[0]] = passable[ends[1]] = True
        workspace = Workspace.from_awareness(np.full((1, n, n, 1), 0.5), passable)
        try:
            shortest = Planner(workspace, *ends, connectivity=connectivity).shortest
        except ValueError:
            continue
        longest = n * n if extra is None else shortest + extra
        paths = list(walks(passable.tolist(), *ends, longest, connectivity, **kind))
        if len(paths) < 200_000:
            break
    n_cells = np.array([len(path) for path in paths])
    flat = np.zeros((len(paths), n_cells.max()), int)
    length = np.empty(len(paths))
    for i, path in enumerate(paths):
        cells = np.array(path)
        flat[i, : len(path)] = cells @ (n, 1)
        length[i] = np.hypot(*np.diff(cells * CELL, axis=0).T).sum()
    return passable, shortest, flat, n_cells, length


def admissible(objective, n, connectivity):
    """What `max_bounds` is, and which walks these are: what can be enumerated."""
    if objective in ("lost_contact", "terminal", "mean"):
        return 2, "shortest+2", (("u_turns", False),)
    if objective == "stationary":
        return None, None, (("simple", True),)
    extra = 2 if connectivity == 4 and n == 4 else 1
    return extra, extra, ()


def random_problem(model, n, n_robots, beta0, rng, *, moves=()):
    """Awareness of cells, or of bounds with 8 moves; drift and transition by their definitions."""
    z = rng.uniform(size=(n_robots, *moves, n, n, 2))
    noise = 0.1 * np.eye(n_robots)
    if model == "pooled":
        beta, b = rng.normal(size=2), rng.normal(-0.3, 0.5)
        params = TrustParams(beta0, beta, b, 0.1, 0.1)
        return z, params, of_bounds(z @ beta + b), beta0 * np.eye(n_robots)
    if model == "hierarchical":
        own = beta0 * rng.uniform(0.7, 1.0, n_robots)
        beta, b = rng.normal(size=(n_robots, 2)), rng.normal(-0.3, 0.5, n_robots)
        params = RobotParams(own, beta, b, np.full(n_robots, 0.1), np.full(n_robots, 0.1))
        u = np.stack([z[i] @ beta[i] + b[i] for i in range(n_robots)])
        return z, params, of_bounds(u), np.diag(own)
    B0 = beta0 * np.eye(n_robots) + rng.normal(0.0, 0.1, (n_robots, n_robots)) * (
        1 - np.eye(n_robots)
    )
    B, b = rng.normal(size=(2, n_robots, n_robots)), rng.normal(-0.3, 0.5, n_robots)
    u = np.moveaxis(sum(np.moveaxis(z[..., m], 0, -1) @ B[m].T for m in range(2)) + b, -1, 0)
    return z, CoupledParams(B0, B, b, noise, noise), of_bounds(u), B0


def problem(
    objective,
    model,
    n,
    connectivity,
    seed,
    beta0,
    *,
    team="mean",
    weight=0.0,
    unseen=0.0,
    more=None,
    family="gaussian",
):
    """Planners with either engine, parameters, and the value of every admissible path.

    `more` bounds than the fewest, without U-turns, in place of what `admissible` says.
    """
    rng = np.random.default_rng([seed, n, connectivity, int(10 * abs(beta0))])
    extra, cap, kind = admissible(objective, n, connectivity)
    if more is not None:
        extra, cap, kind = more, f"shortest+{more}", (("u_turns", False),)
    passable, shortest, paths, n_cells, length = random_map(n, connectivity, seed % 3, extra, kind)
    n_robots = (1, 3)[seed % 2] if model == "pooled" else 3
    moves = (8,) if seed else ()  # all seeds but 0 have a drift for each bound
    z, params, u, transition = random_problem(model, n, n_robots, beta0, rng, moves=moves)
    workspace = Workspace.from_awareness(z, passable, CELL)
    toll = weight * length
    if unseen:
        shares = rng.uniform(size=(8, n, n))
        workspace = with_unseen(workspace, shares)
        toll = toll + unseen * sums_of(shares, paths, n_cells)
    if model == "pooled" and team == "mean":  # one state, whose drift is capped for lost_contact
        u, transition = u.mean(0, keepdims=True), transition[:1, :1]
    rates = family, np.sqrt(0.1) if model == "coupled" else 0.1
    values = path_values(
        objective, paths, n_cells, u, transition, 0.5, team=team, toll=toll, rates=rates
    )
    cap = cap if isinstance(cap, str) or cap is None else shortest + cap
    planners = [
        Planner(
            workspace,
            (n - 1, 0),
            (0, n - 1),
            objective,
            connectivity=connectivity,
            max_bounds=cap,
            team=team,
            length_weight=weight,
            unseen_cost=unseen,
            engine=engine,
            observation=family,
        )
        for engine in ("networkx", "numba")
    ]
    return planners, params, values


def plan_and_best(*case, **options):
    """What each engine plans, and the best of all paths."""
    planners, params, values = problem(*case, **options)
    return [planner.plan(params) for planner in planners], values.max()


def check(plans, best):
    for plan in plans:
        assert plan.exact
        lost = plan.objective == "lost_contact"  # may be nothing, with trust capped at 1
        np.testing.assert_allclose(plan.value, best, rtol=1e-9, atol=1e-12 if lost else 1e-300)
    # Cell by cell: no two paths of these maps are worth the same, but by their least trust, or
    # where trust is capped.
    ties = plans[0].objective in ("bottleneck", "lost_contact")
    assert plans[0].path == plans[1].path or ties


@pytest.mark.parametrize(
    ("objective", "n", "connectivity"),
    [
        (objective, n, connectivity)
        for objective in BETA0
        for n, connectivity in [(4, 4), (4, 8), (5, 4), (5, 8)]
        # These simple paths are too many to write out.
        if (objective, n, connectivity) != ("stationary", 5, 8)
    ],
)
def test_both_engines_find_the_best_of_all_admissible_paths(objective, n, connectivity):
    for seed in range(6):
        for beta0 in BETA0[objective]:
            check(*plan_and_best(objective, "pooled", n, connectivity, seed, beta0))


def naive(planner, params):
    """Dijkstra with trust on arrival as the label, what the 2023 code does: kept as a warning."""
    moves = planner.dynamics(params)
    beta0, u, x0 = moves.transition[0, 0], moves.drift[0], moves.start[0]
    queue, done = [(0.0, planner.start, x0, (planner.start,))], set()
    while queue:
        _, cell, x, path = heapq.heappop(queue)
        if cell in done:
            continue
        if cell == planner.goal:
            return planner.evaluate(path, params).value
        done.add(cell)  # it extends only the most trusting label
        for other in planner.graph.successors(cell):
            m = MOVES[8].index((other[0] - cell[0], other[1] - cell[1])) if len(u) > 1 else 0
            after = beta0 * x + u[m, *other]
            heapq.heappush(queue, (-after, other, after, (*path, other)))
    return None


@pytest.mark.parametrize("objective", ["terminal", "success"])
def test_dijkstra_with_trust_on_arrival_as_label_is_wrong_on_the_same_maps(objective):
    wrong = n_maps = 0
    for n in (4, 5):
        for seed in range(6):
            for beta0 in (0.3, 0.7):
                (planner, _), params, values = problem(objective, "pooled", n, 8, seed, beta0)
                n_maps += 1
                wrong += naive(planner, params) < values.max() - 1e-9
    # It was wrong on 35-100 % of random maps in the prototypes; here its paths may be longer too.
    assert wrong >= 0.35 * n_maps


@pytest.mark.parametrize(
    ("model", "team"),
    [
        ("pooled", "min"),
        ("hierarchical", "mean"),
        ("hierarchical", "min"),
        ("coupled", "mean"),
        ("coupled", "min"),
    ],
)
@pytest.mark.parametrize("objective", list(BETA0))
def test_vector_trust_is_planned_exactly_too(objective, model, team):
    for seed in range(2):
        for beta0 in (0.3, 0.7):
            check(*plan_and_best(objective, model, 4, 8, seed, beta0, team=team))


@pytest.mark.parametrize("family", ["censored", "beta_binomial"])
@pytest.mark.parametrize(
    ("model", "team"), [("pooled", "mean"), ("pooled", "min"), ("hierarchical", "mean")]
)
def test_contact_lost_by_counts_and_censored_rates_is_the_least_of_all_paths(model, team, family):
    for n, connectivity in ((4, 8), (5, 4)):
        for seed in range(2):
            for beta0, weight in ((0.0, 0.0), (0.4, 0.0), (0.9, 0.002), (1.2, 0.0)):
                case = "lost_contact", model, n, connectivity, seed, beta0
                check(*plan_and_best(*case, team=team, family=family, weight=weight))


@pytest.mark.parametrize("more", range(7))
@pytest.mark.parametrize("family", ["gaussian", "censored", "beta_binomial"])
def test_contact_lost_is_the_least_of_longer_paths_too_and_loops_never_pay_capped(family, more):
    for connectivity, seed in ((4, 1), (4, 2), (8, 1)):
        for beta0 in (0.0, 0.3, 0.9):
            case = "lost_contact", "pooled", 3, connectivity, seed, beta0
            plans, best = plan_and_best(*case, more=more, family=family)
            check(plans, best)
            assert family != "gaussian" or not any(plan.revisits for plan in plans)


@pytest.mark.parametrize("more", range(7))
@pytest.mark.parametrize("objective", ["terminal", "mean", "success"])
def test_any_number_of_bounds_more_than_the_fewest_is_planned_exactly(objective, more):
    for connectivity, seed in ((4, 1), (8, 2)):
        for beta0 in (0.3, 0.9):
            case = objective, "pooled", 3, connectivity, seed, beta0
            plans, best = plan_and_best(*case, more=more)
            check(plans, best)
            for plan in plans:
                assert plan.revisits == len(plan.path) - len(set(plan.path))
                assert plan.revisits == 0 or more > 2


@pytest.mark.parametrize("objective", ["lost_contact", "terminal", "mean", "stationary"])
@pytest.mark.parametrize("team", ["mean", "min"])
def test_a_length_weight_is_paid_per_metre(objective, team):
    for seed in range(2):
        check(*plan_and_best(objective, "pooled", 4, 8, seed, 0.7, team=team, weight=0.004))


@pytest.mark.parametrize("objective", ["lost_contact", "terminal", "mean"])
def test_a_length_weight_is_paid_per_metre_by_three_robots_on_larger_maps(objective):
    """The networkx engine once paid a mean's length by the bound: 24 % of these were not best."""
    for seed in range(1, 21, 2):  # odd seeds have three robots
        for beta0 in (0.3, 0.7):
            case = objective, "pooled", 5, 8, seed, beta0
            check(*plan_and_best(*case, team="min", weight=0.004))


@pytest.mark.parametrize("objective", [name for name in BETA0 if name != "bottleneck"])
@pytest.mark.parametrize("team", ["mean", "min"])
def test_the_time_unseen_is_paid_bound_by_bound(objective, team):
    """Shares of bounds at random, so that the way there and the way back cost differently."""
    for seed in range(4):
        for unseen, weight in ((0.3, 0.0), (3.0, 0.004)):
            case = objective, "pooled", 4, (8, 4)[seed // 3], seed, 0.7
            check(*plan_and_best(*case, team=team, weight=weight, unseen=unseen))
            case = objective, "hierarchical", 4, 8, seed, 0.4
            check(*plan_and_best(*case, team=team, weight=weight, unseen=unseen))


@pytest.mark.parametrize("family", ["censored", "beta_binomial"])
@pytest.mark.parametrize("model", ["pooled", "hierarchical"])
def test_the_time_unseen_is_paid_by_counts_and_censored_rates_too(model, family):
    for seed in range(3):
        case = "lost_contact", model, 4, 8, seed, 0.7
        check(*plan_and_best(*case, family=family, unseen=1.0))


@pytest.mark.parametrize("b", [-400.0, 60.0])
@pytest.mark.parametrize("team", ["mean", "min"])
@pytest.mark.parametrize("engine", ["networkx", "numba"])
def test_terminal_compares_trust_where_its_sigma_rounds(engine, team, b):
    passable, _, paths, n_cells, _ = random_map(4, 8, 0, 2, (("u_turns", False),))
    z = np.random.default_rng(1).uniform(size=(3, 4, 4, 2))
    params = TrustParams(0.7, np.array([3.0, 5.0]), b, 0.1, 0.1)
    u = (z @ params.beta + b).reshape(3, -1)
    best = -np.inf
    for path, n in zip(paths, n_cells, strict=True):
        x = np.full(3, 0.5)
        for cell in path[1:n]:
            x = 0.7 * x + u[:, cell]
        best = max(best, x.mean() if team == "mean" else x.min())
    workspace = Workspace.from_awareness(z, passable, CELL)
    plan = Planner(workspace, (3, 0), (0, 3), "terminal", team=team, engine=engine).plan(params)
    trust = plan.trust[-1].mean() if team == "mean" else plan.trust[-1].min()
    np.testing.assert_allclose(trust, best, rtol=1e-12)
