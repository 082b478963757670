"""Plans within a risk against every admissible path written out."""

import json
from functools import cache

import numpy as np
import pytest
from references import of_bounds, path_values, sums_of, walks
from worlds import with_unseen

from trustbo.errors import ShapeError, TrustboError
from trustbo.hazard.strata import Strata
from trustbo.models import RobotParams, TrustParams
from trustbo.planning import InfeasibleError, Planner
from trustbo.planning.plan import plan_from_record, plan_to_record
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVES, existing_bounds

SHORT = "shortest+2", (("u_turns", False),)
WALKS = 1, ()
CLASSES = {
    "lost_contact": SHORT,
    "terminal": SHORT,
    "mean": SHORT,
    "success": WALKS,
    "bottleneck": WALKS,
    "stationary": (None, (("simple", True),)),
}


@cache
def random_map(n, seed, limit, kind):
    """Passable cells, the fewest bounds between two corners, and all admissible paths."""
    rng, ends = np.random.default_rng([n, seed]), ((n - 1, 0), (0, n - 1))
    while True:
        passable = rng.uniform(size=(n, n)) > 0.15
        passable[ends[0]] = passable[ends[1]] = True
        workspace = Workspace.from_awareness(np.full((1, n, n, 1), 0.5), passable)
        try:
            shortest = Planner(workspace, *ends).shortest
        except ValueError:
            continue
        longest = n * n if limit is None else shortest + (2 if limit == "shortest+2" else limit)
        paths = list(walks(passable.tolist(), *ends, longest, **dict(kind)))
        if len(paths) < 60_000:
            break
    n_cells = np.array([len(path) for path in paths])
    flat = np.zeros((len(paths), n_cells.max()), int)
    for i, path in enumerate(paths):
        flat[i, : len(path)] = np.array(path) @ (n, 1)
    return passable, shortest, flat, n_cells


def random_risk(passable, rng, n_draws=12):
    """Chances of bounds to end the mission, some of them large, and draws around them."""
    shape = 8, *passable.shape
    p = np.where(rng.uniform(size=shape) < 0.4, rng.uniform(0.0, 0.4, shape), 0.02)
    p = np.where(rng.uniform(size=shape) < 0.1, rng.choice([0.0, 1.0], shape), p)
    draws = rng.beta(6.0 * p + 0.1, 6.0 * (1.0 - p) + 0.1, (n_draws, *shape))
    p = np.where(existing_bounds(passable), p, np.nan)
    return p, draws


def failures(p, paths, n_cells):
    """P(fail) of every path, p (move, row, col)."""
    pairs, survival = of_bounds(p[None])[0], np.ones(len(paths))
    for k in range(1, paths.shape[1]):
        chance = 1.0 - pairs[paths[:, k - 1], paths[:, k]]
        survival *= np.where(k < n_cells, chance, 1.0)
    return 1.0 - survival


class Case:
    """A random map with a planner, and value and P(fail) of all its paths."""

    def __init__(
        self,
        objective,
        n,
        seed,
        *,
        team="mean",
        family="gaussian",
        beta0=None,
        unseen=0.0,
    ):
        rng = np.random.default_rng([n, seed])
        limit, kind = CLASSES[objective]
        self.passable, shortest, self.paths, self.n_cells = random_map(n, seed % 4, limit, kind)
        n_robots = 3 if team != "mean" or seed % 2 else 1
        z = rng.uniform(size=(n_robots, 8, n, n, 2))
        beta0 = (0.0, 0.4, 0.8)[seed % 3] if beta0 is None else beta0
        if team == "min":
            own = beta0 * rng.uniform(0.6, 1.0, n_robots)
            beta, b = rng.normal(size=(n_robots, 2)), rng.normal(-0.2, 0.4, n_robots)
            sd = np.full(n_robots, 0.1)
            self.params = RobotParams(own, beta, b, sd, sd)
            u = np.stack([z[i] @ beta[i] + b[i] for i in range(n_robots)])
            transition = np.diag(own)
        else:
            beta, b = rng.normal(size=2), rng.normal(-0.2, 0.4)
            self.params = TrustParams(beta0, beta, b, 0.1, 0.1)
            u, transition = (z @ beta + b).mean(0, keepdims=True), np.array([[beta0]])
        shares = np.random.default_rng(seed).uniform(size=(8, n, n))
        self.workspace = with_unseen(Workspace.from_awareness(z, self.passable), shares)
        toll = unseen * sums_of(shares, self.paths, self.n_cells)
        self.values = path_values(
            objective, self.paths, self.n_cells, of_bounds(u), transition, 0.5, team=team,
            toll=toll, rates=(family, 0.1),
        )  # fmt: skip
        self.p, self.draws = random_risk(self.passable, rng)
        self.p_fail = failures(self.p, self.paths, self.n_cells)
        self.failure_cost = float(shortest) if objective == "lost_contact" else 0.0
        self.options = {
            "objective": objective, "team": team, "observation": family, "unseen_cost": unseen,
            "max_bounds": shortest + limit if isinstance(limit, int) else limit,
        }  # fmt: skip
        self.ends, self.rng = ((n - 1, 0), (0, n - 1)), rng

    def planner(self, **options):
        planner = Planner(self.workspace, *self.ends, **{**self.options, **options})
        return planner.with_risk(self.p, self.draws, {"stuck": 0.75, "tipped": 0.25})

    def best(self, feasible, failure_cost=None):
        cost = self.failure_cost if failure_cost is None else failure_cost
        return (self.values - cost * self.p_fail)[feasible].max()

    def limit(self):
        """A limit that few to half of the paths keep."""
        share = self.rng.choice([0.001, 0.02, 0.2, 0.5])
        return min(float(np.quantile(self.p_fail, share)), 0.99)


def check(plan, best, limit=None):
    assert plan.exact
    np.testing.assert_allclose(plan.value, best, rtol=1e-9, atol=1e-11)
    if limit is not None:
        assert 1.0 - np.prod(1.0 - plan.p_fail) <= limit + 1e-9


@pytest.mark.parametrize("n", [4, 5])
@pytest.mark.parametrize("objective", list(CLASSES))
def test_plans_within_a_limit_are_the_best_of_all_that_keep_it(objective, n):
    """25 maps for each objective, 300 in all; every tenth with the reference engine too."""
    for seed in range(25):
        case = Case(objective, 4 if objective == "stationary" else n, seed + 50 * n)
        limit = case.limit()
        if limit < case.p_fail.min():
            continue
        best = case.best(case.p_fail <= limit + 1e-12)
        for engine in ("numba", "networkx")[: 1 + (seed % 10 == 0)]:
            plan = case.planner(max_failure=limit, engine=engine).plan(case.params)
            check(plan, best, limit)


@pytest.mark.parametrize("family", ["censored", "beta_binomial"])
@pytest.mark.parametrize("team", ["mean", "min"])
def test_counts_and_censored_rates_and_the_least_trust_of_a_team(family, team):
    for seed in range(12):
        case = Case("lost_contact", 4, seed, team=team, family=family)
        limit = case.limit()
        best = case.best(case.p_fail <= limit + 1e-12)
        check(case.planner(max_failure=limit, engine="numba").plan(case.params), best, limit)


@pytest.mark.parametrize("objective", ["lost_contact", "terminal", "mean", "success", "bottleneck"])
def test_vector_trust(objective):
    for seed in range(8):
        case = Case(objective, 4, seed, team="min")
        limit = case.limit()
        best = case.best(case.p_fail <= limit + 1e-12)
        check(case.planner(max_failure=limit, engine="numba").plan(case.params), best, limit)


def test_lost_contact_pays_for_a_failure_with_and_without_a_limit():
    for seed in range(12):
        case = Case(
            "lost_contact", 4 + seed % 2, seed, family=("gaussian", "censored")[seed % 3 // 2]
        )
        for cost in (None, 0.0, 0.7, 30.0):
            everything = np.ones(len(case.paths), bool)
            planner = case.planner(failure_cost=cost, engine="numba")
            check(planner.plan(case.params), case.best(everything, cost))
            limit = max(case.limit(), case.p_fail.min())
            if limit >= 1.0:
                continue
            planner = case.planner(failure_cost=cost, max_failure=limit, engine="numba")
            plan = planner.plan(case.params)
            check(plan, case.best(case.p_fail <= limit + 1e-12, cost), limit)
            np.testing.assert_allclose(planner.evaluate(plan.path, case.params).value, plan.value)


def random_strata(p, seed):
    """Two to five strata around chances, alike in their order, or mixed."""
    rng = np.random.default_rng([seed, 7])
    n = 2 + seed % 4
    severity = np.sort(rng.lognormal(0.0, 1.2, n))[:, None, None, None]
    mixed = rng.lognormal(0.0, (0.0, 0.8)[seed // 4 % 2], (n, *p.shape))
    return Strata(np.minimum(p * severity * mixed, 1.0), rng.dirichlet(np.full(n, 0.8)))


@pytest.mark.parametrize("family", ["gaussian", "censored", "beta_binomial"])
@pytest.mark.parametrize("team", ["mean", "min"])
def test_price_over_strata_is_planned_best_of_all_paths(family, team):
    """F sum_m w_m (1 - prod (1 - p_m)) by its definition, with limits and without."""
    for seed in range(12):
        case = Case("lost_contact", 4 + (team == "mean"), seed, team=team, family=family)
        strata = random_strata(case.p, seed)
        case.p = np.tensordot(strata.shares, strata.p_fail, 1)
        case.p_fail = failures(case.p, case.paths, case.n_cells)
        joint = strata.shares @ [failures(p, case.paths, case.n_cells) for p in strata.p_fail]
        limit = max(case.limit(), case.p_fail.min())
        rules = [({}, np.ones(len(joint), bool))]
        if limit < 1.0:
            rules.append(({"max_failure": limit}, case.p_fail <= limit + 1e-12))
        cost = (None, 0.7, 30.0)[seed % 3]
        unit = case.failure_cost if cost is None else cost
        for rule, feasible in rules:
            for engine in ("numba", "networkx")[: 1 + (seed in (0, 5) and len(rule) < 2)]:
                options = rule | {"failure_cost": cost, "engine": engine}
                planner = case.planner(**options).with_risk(case.p, case.draws, {}, strata)
                plan = planner.plan(case.params)
                check(plan, (case.values - unit * joint)[feasible].max())
                again = planner.evaluate(plan.path, case.params).value
                np.testing.assert_allclose(again, plan.value, rtol=1e-9)


def test_price_of_bounds_that_fail_together_is_of_one_failure():
    """Half of the draws fail every bound: a price of .5, whatever the number of bounds."""
    case = Case("lost_contact", 4, 1)
    exists = existing_bounds(case.passable)
    p = np.where(exists, np.array([0.0, 1.0])[:, None, None, None], np.nan)
    strata = Strata(p, np.array([0.5, 0.5]))
    planner = case.planner(failure_cost=8.0).with_risk(p.mean(0), None, {}, strata)
    plan = planner.plan(case.params)
    np.testing.assert_allclose(plan.value, case.values.max() - 4.0, rtol=1e-9)


def test_safest_of_infeasible_paths_is_that_at_the_posterior_mean_with_strata_too():
    for seed in range(4):
        case = Case("lost_contact", 4, seed)
        strata = random_strata(np.maximum(case.p, 0.03), seed)
        case.p = np.tensordot(strata.shares, strata.p_fail, 1)
        case.p_fail = failures(case.p, case.paths, case.n_cells)
        joint = strata.shares @ [failures(p, case.paths, case.n_cells) for p in strata.p_fail]
        least = case.p_fail.min()
        planner = case.planner(max_failure=0.9 * least, infeasible="safest")
        plan = planner.with_risk(case.p, None, {}, strata).plan(case.params)
        np.testing.assert_allclose(1.0 - np.prod(1.0 - plan.p_fail), least, rtol=1e-9)
        safest = case.p_fail <= least + 1e-12
        check(plan, (case.values - case.failure_cost * joint)[safest].max())


@pytest.mark.parametrize("objective", [name for name in CLASSES if name != "bottleneck"])
@pytest.mark.parametrize("team", ["mean", "min"])
def test_the_time_unseen_is_paid_within_a_limit_too(objective, team):
    for seed in range(8):
        case = Case(objective, 4, seed, team=team, unseen=(0.4, 2.0)[seed % 2])
        limit = case.limit()
        if limit < case.p_fail.min():
            continue
        best = case.best(case.p_fail <= limit + 1e-12)
        both = seed == 0 and objective != "stationary"  # few of whose simple paths dominate others
        for engine in ("numba", "networkx")[: 1 + both]:
            plan = case.planner(max_failure=limit, engine=engine).plan(case.params)
            check(plan, best, limit)


@pytest.mark.parametrize("objective", ["lost_contact", "bottleneck", "stationary"])
@pytest.mark.parametrize("engine", ["networkx", "numba"])
def test_an_infeasible_limit_is_said_with_the_least_there_is_or_the_safest_is_planned(
    objective, engine
):
    for seed in range(4):
        case = Case(objective, 4, seed)
        case.p = np.maximum(case.p, 0.03)
        case.p_fail = failures(case.p, case.paths, case.n_cells)
        least = case.p_fail.min()
        options = {"max_failure": 0.9 * least, "engine": engine}
        with pytest.raises(
            InfeasibleError, match=rf"the least is {least:.4g}, on the path"
        ) as error:
            case.planner(**options).plan(case.params)
        np.testing.assert_allclose(error.value.p_fail, least, rtol=1e-9)
        assert error.value.path[-1] == case.ends[1]
        plan = case.planner(**options, infeasible="safest").plan(case.params)
        np.testing.assert_allclose(1.0 - np.prod(1.0 - plan.p_fail), least, rtol=1e-9)
        check(plan, case.best(case.p_fail <= least + 1e-12))


def test_all_draws_are_planned_within_the_limit():
    case = Case("terminal", 4, 3)
    rng = np.random.default_rng(0)
    draws = TrustParams(
        rng.uniform(0.2, 0.8, 5), rng.normal(size=(5, 2)), rng.normal(size=5), np.full(5, 0.1),
        np.full(5, 0.1),
    )  # fmt: skip
    limit = float(np.quantile(case.p_fail, 0.01))
    for engine in ("numba", "networkx"):
        planner = case.planner(max_failure=limit, engine=engine)
        drawn = planner.plan_draws(draws)
        alone = [planner.plan(draws.draw(d)).value for d in range(5)]
        np.testing.assert_allclose(drawn.values, alone, rtol=1e-9)


def test_bounds_that_fail_together_are_one_chance_to_fail_not_many():
    """One event in 4 fails all bounds: three of four missions arrive on any path."""
    case = Case("lost_contact", 4, 1)
    draws = np.zeros((8, *case.p.shape))
    draws[::4] = 1.0
    p = np.where(np.isnan(case.p), np.nan, 0.25)
    planner = Planner(case.workspace, *case.ends, **case.options).with_risk(p, draws)
    plan = planner.plan(case.params)
    n = len(plan.path) - 1
    assert n >= 3
    assert plan.p_arrive == pytest.approx(0.75, rel=1e-12)
    np.testing.assert_allclose(plan.risk.p_reach, 0.75)
    # Limits and costs add bounds up as if they were independent: never too bright here.
    within = Planner(case.workspace, *case.ends, **case.options, max_failure=0.3)
    with pytest.raises(InfeasibleError, match=f"the least is {1.0 - 0.75**planner.shortest:.4g}"):
        within.with_risk(p, draws).plan(case.params)
    record = json.loads(json.dumps(plan_to_record(plan)))
    assert plan_from_record(record, case.workspace).risk.p_reach.tolist() == [0.75] * n


def test_a_plan_says_its_chance_to_arrive_with_its_band_by_bound_and_cause():
    case = Case("lost_contact", 4, 1)
    planner = case.planner()
    plan = planner.plan(case.params)
    rows, cols = np.array(plan.path).T
    steps = np.diff(np.array(plan.path), axis=0).tolist()
    at = [MOVES[8].index(tuple(step)) for step in steps], rows[1:], cols[1:]
    np.testing.assert_array_equal(plan.p_fail, case.p[at])
    bare = Planner(case.workspace, *case.ends, **case.options).with_risk(case.p)
    np.testing.assert_allclose(
        bare.evaluate(plan.path, case.params).p_arrive, np.prod(1.0 - case.p[at])
    )
    drawn = np.prod(1.0 - case.draws[:, *at], axis=1)
    exact = np.prod(1.0 - case.p[at]) / np.prod(1.0 - case.draws[:, *at].mean(0))
    np.testing.assert_allclose(plan.p_arrive, drawn.mean() * exact)
    np.testing.assert_allclose(plan.p_arrive_band, np.quantile(drawn, [0.05, 0.95]))
    band = np.quantile(case.draws[:, *at], [0.05, 0.95], axis=0)
    np.testing.assert_allclose(plan.risk.p_fail_band, band)
    np.testing.assert_allclose(plan.risk.by_cause["stuck"], 0.75 * plan.p_fail)
    again = plan_from_record(json.loads(json.dumps(plan_to_record(plan))), case.workspace)
    assert (again.p_arrive, again.p_arrive_band) == (plan.p_arrive, plan.p_arrive_band)
    np.testing.assert_array_equal(again.risk.by_cause["tipped"], plan.risk.by_cause["tipped"])
    bare = planner.with_risk(None).plan(case.params)
    assert (bare.p_fail, bare.p_arrive, bare.p_arrive_band) == (None, None, None)


def test_the_risk_of_bounds_already_made_counts_towards_the_limit():
    case = Case("terminal", 5, 2)
    planner = case.planner(max_failure=0.5, infeasible="safest")
    plan = planner.plan(case.params)
    rest = planner.onward(plan.path[:2])
    survived = 1.0 - plan.p_fail[0]
    np.testing.assert_allclose(rest.problem.rule.max_failure, 1.0 - 0.5 / survived)
    assert rest.plan(case.params).path == plan.path[1:]


def test_what_cannot_be_is_refused():
    case = Case("lost_contact", 4, 0)
    bare = Planner(case.workspace, *case.ends, max_failure=0.1)
    with pytest.raises(TrustboError, match=r"max_failure = 0.1 needs the chance of each bound"):
        bare.plan(case.params)
    for options, said in (
        ({"max_failure": 1.0}, r"max_failure must be in \[0, 1\); got 1.0"),
        ({"failure_cost": -1.0}, "failure_cost must be finite and >= 0; got -1.0"),
        ({"failure_cost": 1.0, "objective": "mean"}, "failure_cost is for lost_contact"),
        ({"infeasible": "ignore"}, "unknown infeasible 'ignore'"),
    ):
        with pytest.raises(TrustboError, match=said):
            case.planner(**options)
    for shares in ([1.0], [0.5, 0.6], [1.5, -0.5]):
        strata = Strata(np.stack([case.p, case.p]), np.array(shares))
        with pytest.raises(TrustboError, match="strata"):
            case.planner().with_risk(case.p, None, {}, strata)
    with pytest.raises(ShapeError, match=r"p_fail must have shape \(8, 4, 4\); got \(8, 3, 3\)"):
        bare.with_risk(np.zeros((8, 3, 3)))
    with pytest.raises(ShapeError, match=r"draws of p_fail must have axes \(draw, move, row, col"):
        bare.with_risk(np.zeros((8, 4, 4)), np.zeros((8, 4, 4)))
    with pytest.raises(TrustboError, match=r"p_fail must be in \[0, 1\]; got 1.5"):
        bare.with_risk(np.full((8, 4, 4), 1.5))
    with pytest.raises(TrustboError, match="is NaN; give a chance to every possible bound"):
        bare.with_risk(np.full((8, 4, 4), np.nan)).plan(case.params)


@pytest.mark.parametrize(
    ("objective", "n", "max_bounds"),
    [
        ("lost_contact", 12, None),
        ("success", 8, 11),
        ("bottleneck", 8, 11),
        ("stationary", 15, None),
    ],
)
def test_a_search_that_is_cut_short_keeps_the_limit_and_its_bound_holds(
    objective, n, max_bounds, monkeypatch
):
    """Against the search without a cut, which other tests compare with enumeration."""
    rng, cut, most = np.random.default_rng(3), 0, 0.3
    params = TrustParams(0.5, np.array([0.6, 0.3]), -0.2, 0.1, 0.1)
    for _ in range(4):
        workspace = Workspace.from_awareness(rng.uniform(size=(1, 8, n, n, 2)))
        p = rng.uniform(0.0, 0.6 / n, (8, n, n))
        options = {"max_bounds": max_bounds, "max_failure": most}
        planner = Planner(workspace, (n - 1, 0), (0, n - 1), objective, engine="numba", **options)
        planner = planner.with_risk(p)
        whole = planner.plan(params)
        monkeypatch.setattr("trustbo.planning.search.labels.MAX_LABELS", 1)
        try:
            plan = planner.plan(params)
        except TrustboError:  # no feasible path was known by then
            continue
        finally:
            monkeypatch.undo()
        assert whole.exact
        assert 1.0 - plan.p_arrive <= most + 1e-9
        assert plan.value <= whole.value + 1e-9 <= plan.bound + 2e-9
        cut += not plan.exact
    assert cut > 0


@pytest.mark.parametrize("objective", ["success", "stationary"])
def test_paths_are_told_apart_where_their_probabilities_round_to_0(objective):
    """By the sum of log probabilities: its exp is 0 below -745."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        z, p_fail = rng.uniform(size=(1, 8, 3, 3, 2)), rng.uniform(0.0, 0.05, (8, 3, 3))
        params = TrustParams(0.5, 2000.0 * rng.normal(size=2), -500.0, 0.1, 0.1)
        workspace, scores = Workspace.from_awareness(z), []
        for engine in ("numba", "networkx"):
            options = {"max_bounds": 4} if objective == "success" else {}
            planner = Planner(
                workspace, (2, 0), (0, 2), objective, engine=engine, max_failure=0.9, **options
            ).with_risk(p_fail)
            path = planner.plan(params).path
            u = planner.dynamics(params).along(path).drift.ravel()
            x, total = params.x0_mean, 0.0
            for drift in u:
                x = 0.5 * x + drift
                trust = x if objective == "success" else drift / 0.5
                total += np.logaddexp(0.0, -trust)
            scores.append(total)
        np.testing.assert_allclose(*scores, rtol=1e-9)
