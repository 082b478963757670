"""Hazard: likelihood, places of lost missions, calibration, and what is counted."""

import itertools
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy import special, stats

import trustbo as tb
from trustbo.errors import PosteriorError, TrustboError
from trustbo.hazard import Hazard
from trustbo.hazard.model import fit_hazard, impute, sample
from trustbo.hazard.prior import LIMITS
from trustbo.hazard.risk import BoundRisk
from trustbo.hazard.trials import UNKNOWN, LostMission, Trials
from trustbo.workspace.difficulty import MEASURES
from trustbo.workspace.moves import END, MOVES


def workspace(n=3):
    return tb.Workspace.from_awareness(np.full((1, n, n, 1), 0.5))


def mission(path, status="ok", n_bounds=None):
    n = len(path) - 1 if n_bounds is None else n_bounds
    return tb.Mission.from_arrays(
        path, np.full((n, 1, 1), 0.5), np.full((n, 1), 0.5), status=status
    )


def prior_risk(of):
    return BoundRisk(fit_hazard([], of), of)


LIMIT = np.deg2rad(22.0)
ROW = ((0, 0), (0, 1), (0, 2))


def trials(n, failed, lost=()):
    """Trials of made-up bounds."""
    n = np.array(n, dtype=float)
    bounds = np.zeros((len(n), 4), int)
    bounds[:, 1] = np.arange(len(n))
    paths = tuple(np.array(path) for path in lost)
    return Trials(bounds, n, np.array(failed, dtype=float), paths)


def law(difficulty):
    x = np.asarray(difficulty, dtype=float)
    return Hazard().of_bounds(x, ("tilt", "narrowness")[: x.shape[1]], LIMIT)


def test_known_outcomes_have_the_beta_binomial_likelihood_of_scipy():
    rng = np.random.default_rng(0)
    n = np.array([1, 2, 3, 12, 5, 0, 30])
    failed = np.array([0, 1, 3, 0, 2, 0, 11])
    prior = law(rng.uniform(size=(7, 2)))
    points = sample(prior, trials(n, failed), rng)[0]
    alpha, beta = prior.betas(points.x)
    binomial = stats.betabinom.logpmf(failed, n, alpha, beta) - np.log(special.comb(n, failed))
    expected = binomial.sum(1) + stats.norm.logpdf(points.x).sum(1)
    np.testing.assert_allclose(points.log_p, expected, rtol=1e-8, atol=1e-8)


def test_a_bound_is_passed_if_neither_its_difficulty_nor_the_limit_stops_robots():
    """By the tangents: 18 degrees are tan(18)/tan(22) of the limit."""
    tilt = np.tan(np.deg2rad([22.0, 18.0, 10.0])) / np.tan(np.deg2rad(22.0))
    x = np.column_stack([tilt, [0.5, 0.9, 0.1]])
    normals = {"intercept": (-3.0, 0.5), "coefficient": (1.0, 2.0), "margin": (1.0, 3.0)}
    prior = Hazard(**normals, log_width=(0.0, 0.5), limit=(0.0, 1.0))
    of = prior.of_bounds(x, ("tilt", "narrowness"), LIMIT)
    alpha, beta = (part[0] for part in of.betas(np.array([[0.2, 0.5, -0.4, 1.2, 2.0]])))
    logit = -2.9 + 2.0 * (x[:, 1] - 0.5)
    over = (np.array([0.0, -4.0, -12.0]) + 1.0 - 0.4 * 3.0) / np.exp(0.5 * 1.2)
    np.testing.assert_allclose(alpha + beta, np.exp(-0.5 + 2.0), rtol=1e-10)
    passed = (1.0 - special.expit(logit)) * (1.0 - special.expit(over))
    np.testing.assert_allclose(alpha / (alpha + beta), 1.0 - passed, rtol=1e-9)


def test_imputing_places_integrates_lost_missions_out_as_quadrature_does():
    """Two lost missions that share bounds: E prod_j (1 - prod_e (1 - p_e)) by tensor quadrature."""
    n, failed = [2, 1, 0], [0, 1, 0]
    data = trials(n, failed, lost=[[0, 1, 2], [2, 0]])
    of, z = law(np.empty((3, 0))), np.array([[0.7, 0.4]])
    alpha, beta = of.betas(z)
    a, b = alpha + data.failed, beta + data.n - data.failed
    axes = []
    for e in range(3):
        # Gauss-Jacobi nodes of the Beta, exact for the polynomial in question.
        x, w = special.roots_jacobi(12, b[0, e] - 1.0, a[0, e] - 1.0)
        axes.append((0.5 * (x + 1.0), w / w.sum()))
    expected = 0.0
    nodes = itertools.product(*(list(zip(*axis, strict=True)) for axis in axes))
    for (p0, w0), (p1, w1), (p2, w2) in nodes:
        both = (1.0 - (1.0 - p0) * (1.0 - p1) * (1.0 - p2)) * (1.0 - (1.0 - p2) * (1.0 - p0))
        expected += w0 * w1 * w2 * both
    n_points = 200_000
    a, b = (np.repeat(part, n_points, axis=0) for part in (a, b))
    _, log_fail = impute(a, b, data.lost, np.random.default_rng(1))
    found = np.exp(log_fail)
    # 5 standard errors of the mean over independent imputations.
    np.testing.assert_allclose(found.mean(), expected, atol=5.0 * found.std() / np.sqrt(n_points))


def test_a_lost_mission_that_enters_a_bound_twice_survived_it_once():
    """1 - E (1 - p)^2 for a path of one bound twice."""
    data, of, z = trials([0], [0], lost=[[0, 0]]), law(np.empty((1, 0))), np.zeros((1, 2))
    (a,), (b,) = (part[0] for part in of.betas(z))
    expected = 1.0 - b * (b + 1.0) / ((a + b) * (a + b + 1.0))
    log_fail = impute(*of.betas(z), data.lost, np.random.default_rng(0))[1]
    np.testing.assert_allclose(np.exp(log_fail), expected, rtol=1e-10)


def test_posterior_means_equal_those_of_a_grid():
    """One bound that failed in 3 of 8: intercept and strength on a grid."""
    data, of = trials([8], [3]), law(np.empty((1, 0)))
    points = sample(of, data, np.random.default_rng(0))[0]
    axis = np.linspace(-7.0, 7.0, 401)
    z = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    alpha, beta = (part[:, 0] for part in of.betas(z))
    log_p = stats.betabinom.logpmf(3, 8, alpha, beta) + stats.norm.logpdf(z).sum(1)
    weight = special.softmax(log_p)
    chance = weight @ ((alpha + 3.0) / (alpha + beta + 8.0))
    alpha, beta = (part[:, 0] for part in of.betas(points.x))
    # Quasi-random points with an effective number of over 500.
    np.testing.assert_allclose(points.weight @ points.x, weight @ z, atol=0.03)
    np.testing.assert_allclose(
        points.weight @ ((alpha + 3.0) / (alpha + beta + 8.0)), chance, atol=5e-3
    )
    assert points.k_hat < 0.5


MIXTURE = 0.4, 3.0


def mixture(function, x, sd, doubt):
    """Cumulative or other function of the margin's prior with mean 0, by its definition."""
    share, wide = doubt
    return (1.0 - share) * function(x, scale=sd) + share * function(x, scale=wide)


def margins(z, prior):
    """Margin in degrees for coordinates z (point,)."""
    of = prior.of_bounds(np.ones((1, 1)), ("tilt",), LIMIT)
    return of.values(np.column_stack([np.zeros_like(z), z, *np.zeros((2, len(z)))]))[1][:, 0]


def test_a_vague_prior_on_the_strength_gives_the_posterior_of_quadrature():
    """Strengths around 1e16 must not add rounding errors to the likelihood."""
    n, failed = 7, 2
    told = [mission(ROW[:2], "stuck" if k < failed else "ok") for k in range(n)]
    prior = Hazard(log_strength=(-0.5, 10.0))
    found = fit_hazard(told, workspace(), prior)

    z = np.linspace(-6.0, 6.0, 1201)
    s = np.exp(-0.5 + 10.0 * z)
    m = special.expit(-7.5 + 1.5 * z[:, None])
    a, b = s * m, s * (1.0 - m)
    weight = stats.norm.pdf(z) * stats.norm.pdf(z)[:, None]
    for k in range(n):  # the rising factorials, factor by factor
        weight = weight * (a + k if k < failed else b + k - failed) / (s + k)
    p = (a + failed) / (s + n)
    mean = (weight * p).sum() / weight.sum()
    sd = np.sqrt((weight * (p - mean) ** 2).sum() / weight.sum())

    entered = BoundRisk(found, workspace()).mean[4, 0, 1, END]
    assert abs(entered - mean) < 4.5 * sd / np.sqrt(found.attrs["kish"])


def test_prior_draws_of_the_margin_are_of_the_mixture():
    drawn = margins(np.random.default_rng(0).standard_normal(20_000), Hazard())
    cdf = partial(mixture, stats.norm.cdf, sd=0.5, doubt=MIXTURE)
    assert stats.kstest(drawn, cdf).pvalue > 1e-3
    # 4 degrees can be learned.
    assert 0.03 < (drawn > 4.0).mean() < 0.045


@pytest.mark.parametrize("prior", [(0.5, MIXTURE), (4.0, (0.3, 0.5)), (0.5, (0.999, 30.0))])
def test_the_margin_is_the_quantile_of_the_mixture_in_both_tails(prior):
    sd, doubt = prior
    z = np.linspace(-9.0, 9.0, 181)
    margin = margins(z, Hazard(margin=(2.0, sd), limit=doubt)) - 2.0
    assert (np.diff(margin) > 0.0).all()
    lower = mixture(stats.norm.cdf, -np.abs(margin), sd, doubt)
    np.testing.assert_allclose(lower, stats.norm.cdf(-np.abs(z)), rtol=1e-6)
    # Linear with the wider sd beyond.
    far = margins(np.array([-61.0, -60.0, 60.0, 61.0]), Hazard(margin=(2.0, sd), limit=doubt))
    np.testing.assert_allclose(np.diff(far)[[0, 2]], max(sd, doubt[1]), rtol=1e-9)


def test_a_word_for_the_limit_is_a_prior_of_the_margin_and_less_known_limits_are_wider():
    z = np.random.default_rng(1).standard_normal(20_000)
    np.testing.assert_array_equal(margins(z, Hazard()), margins(z, Hazard(limit="data sheet")))
    np.testing.assert_allclose(margins(z, Hazard(limit="measured")), 0.5 * z, rtol=1e-12)
    spread = [margins(z, Hazard(limit=word)).std() for word in LIMITS]
    assert spread == sorted(spread)


def test_without_doubt_the_prior_of_the_margin_is_the_plain_normal():
    z = np.linspace(-5.0, 5.0, 11)
    plain = margins(z, Hazard(margin=(1.0, 4.0), limit=(0.0, 9.0)))
    np.testing.assert_array_equal(plain, 1.0 + 4.0 * z)


@pytest.mark.parametrize("doubt", [(0.0, 1.0), (0.1, 6.0)])
def test_the_posterior_of_the_margin_equals_quadrature_with_chances_integrated_out(doubt):
    """Three bounds of 22, 19 and 10 degrees; all but the limit is held by narrow priors."""
    tight = {n: (v, 1e-3) for n, v in (("intercept", -6.0), ("log_strength", 0.3))}
    sd = 3.0 if doubt[0] == 0.0 else 0.5
    prior = Hazard(
        coefficient=(2.0, 1e-3), margin=(1.0, sd), limit=doubt, log_width=(0.0, 0.5), **tight
    )
    degrees, narrow = np.array([22.0, 19.0, 10.0]), np.array([0.2, 0.6, 0.5])
    tilt = np.tan(np.deg2rad(degrees)) / np.tan(LIMIT)
    n, failed = np.array([2, 2, 3]), np.array([2, 1, 0])
    law = prior.of_bounds(np.column_stack([tilt, narrow]), ("tilt", "narrowness"), LIMIT)
    points = sample(law, trials(n, failed), np.random.default_rng(0))[0]
    off, width = np.linspace(-24.0, 24.0, 2001), 0.5 * np.linspace(-6.0, 6.0, 201)
    margin, log_width = np.meshgrid(1.0 + off, width, indexing="ij")
    of_margin, base = np.log(mixture(stats.norm.pdf, off, sd, doubt)), -6.0
    log_p = of_margin[:, None] + stats.norm.logpdf(width, scale=0.5)
    for e in range(3):
        easy = 1.0 / (1.0 + np.exp(base + 2.0 * (narrow[e] - 0.5)))
        flat = 1.0 / (1.0 + np.exp((degrees[e] - 22.0 + margin) / np.exp(log_width)))
        a, b = np.exp(0.3) * (1.0 - easy * flat) + 1e-12, np.exp(0.3) * easy * flat + 1e-12
        log_p += stats.betabinom.logpmf(failed[e], n[e], a, b)
    weight = special.softmax(log_p)
    limit = law.values(points.x)[1]
    for i, drawn in enumerate((margin, np.exp(log_width))):
        mean = (weight * drawn).sum()
        of_grid = np.sqrt((weight * drawn**2).sum() - mean**2)
        # Over 400 effective points: 3 standard errors.
        assert abs(points.weight @ limit[:, i] - mean) < 0.15 * of_grid, i
    wrong = (weight * (margin > 3.0)).sum()
    assert abs(points.weight @ (limit[:, 0] > 3.0) - wrong) < 0.03
    assert points.k_hat < 0.7


def test_failures_teach_a_limit_that_is_four_degrees_too_high():
    """Twelve bounds from 14 to 21 degrees under an assumed 22: those beyond 18 fail."""
    degrees = np.linspace(14.0, 21.0, 12)
    tilt = np.tan(np.deg2rad(degrees)) / np.tan(LIMIT)
    of = Hazard().of_bounds(tilt[:, None], ("tilt",), LIMIT)
    n = np.full(12, 3)
    for failed, low, high in ((n * (degrees > 18.0), 3.0, 5.0), (0 * n, -1.5, 0.5)):
        points = sample(of, trials(n, failed), np.random.default_rng(0))[0]
        assert low < points.weight @ of.values(points.x)[1][:, 0] < high
        assert points.k_hat < 0.7


@pytest.mark.slow  # many data sets
def test_the_hazard_is_calibrated():
    """SBC: ranks of hyperparameters and of chances are uniform over 200 data sets."""
    prior, n_sets, n_bounds, n_ranks = Hazard(), 200, 25, 20
    rng = np.random.default_rng(1)
    ranks = []
    for _ in range(n_sets):
        x = rng.uniform(size=(n_bounds, 2)) * (1.2, 1.5)
        of = prior.of_bounds(x, ("tilt", "narrowness"), LIMIT)
        z = rng.standard_normal((1, 5))
        p = rng.beta(*(part[0] for part in of.betas(z)))
        n, failed, lost = np.zeros(n_bounds), np.zeros(n_bounds), []
        for j in range(12):
            path = rng.choice(n_bounds, 6, replace=False)
            fails = rng.random(6) < p[path]
            k = int(np.argmax(fails)) if fails.any() else 6
            if fails.any() and j % 3 == 0:
                lost.append(path)
                continue
            n[path[: k + 1]] += 1
            failed[path[k : k + 1]] += fails.any()
        data = trials(n, failed, lost)
        points, places = sample(of, data, rng)
        assert points.k_hat < 0.7
        chosen = rng.choice(len(points.x), n_ranks - 1, p=points.weight)
        a, b = of.betas(points.x[chosen])
        a, b = a + failed, b + n - failed
        for j, path in enumerate(lost):
            for k, e in enumerate(path):
                a[:, e] += places[chosen, j] == k
                b[:, e] += places[chosen, j] > k
        chance = rng.beta(a, b)
        truth = np.array([*z[0], p[0], p[1], (1.0 - p).prod()])
        drawn = np.column_stack([points.x[chosen], chance[:, :2], (1.0 - chance).prod(1)])
        # Chances underflow to 0 in truth and draws alike: such ties are broken at random.
        ties = rng.integers((drawn == truth).sum(0) + 1)
        ranks.append((drawn < truth).sum(0) + ties)
    names = ["intercept", "weight", "margin", "width", "strength", "p0", "p1", "arrive"]
    for name, of_one in zip(names, np.array(ranks).T, strict=True):
        counts = np.bincount(of_one, minlength=n_ranks).reshape(10, 2).sum(1)
        assert stats.chisquare(counts).pvalue > 1e-3, (name, counts)


def test_missions_count_as_exposures_up_to_where_they_end():
    path = ((0, 0), (0, 1), (0, 2), (1, 2))
    counted = Trials.from_missions(
        [mission(path), mission(path, "stuck", 2), mission(path, "aborted", 2)],
        [LostMission(path, (0, 1)), LostMission(path)],
    )
    east, south = 4, 6
    assert counted.bounds.tolist() == [[east, 0, 1, east], [east, 0, 2, south], [south, 1, 2, END]]
    assert counted.n.tolist() == [4, 2, 1]
    assert counted.failed.tolist() == [1, 1, 0]
    assert counted.lost[0].tolist() == [0, 1, 2]


def test_each_bound_that_failed_counts_and_the_way_back_does_not():
    a, b, c, d = (0, 0), (0, 1), (0, 2), (1, 1)
    path = (a, b, c, b, d, c)
    ends = "ok", "stuck", "ok", "aborted", "ok"
    n_bounds = len(ends)
    z = np.full((n_bounds, 1, 1), 0.5)
    rates = np.full((n_bounds, 1), 0.5)
    counted = Trials.from_missions([tb.Mission.from_arrays(path, z, rates, status=ends)])
    east, north_east, west, south = 4, 2, 3, 6
    # Where the robots had planned to go from c, before they got stuck, is not in the path.
    expected = [[north_east, *c, END], [east, *b, east], [east, *c, UNKNOWN]]
    assert counted.bounds.tolist() == expected
    assert counted.n.tolist() == [1, 1, 1]
    assert counted.failed.tolist() == [0, 0, 1]

    ends = "ok", "stuck", "tipped"  # on the way back
    stuck = tb.Mission.from_arrays(path, z[:3], rates[:3], status=ends)
    counted = Trials.from_missions([stuck])
    expected = [[west, *b, south], [east, *b, east], [east, *c, UNKNOWN]]
    assert counted.bounds.tolist() == expected
    assert counted.n.tolist() == [1, 1, 1]
    assert counted.failed.tolist() == [1, 0, 1]


def test_a_failure_whose_next_move_is_unknown_is_shared_by_all_next_moves():
    a, b, c = (0, 0), (0, 1), (0, 2)
    stuck = tb.Mission.from_arrays((a, b, c), np.full((2, 1, 1), 0.5), [[0.5], [0.5]], status=[
        "ok", "stuck"
    ])  # fmt: skip
    lost = LostMission((a, b, c))
    east, south = 4, 6

    # A path that ends at its goal was planned to end there.
    assert Trials.from_missions([stuck], goals=[c]).bounds.tolist() == [
        [east, *b, east],
        [east, *c, END],
    ]
    counted = Trials.from_missions([stuck], [lost], goals=[(1, 2)])
    assert counted.bounds.tolist() == [[east, *b, east], [east, *c, UNKNOWN], [east, *c, END]]

    # c has three next moves: south, the end of the path, and back, of which two are one unit.
    exists = np.zeros((8, 2, 3, 9), bool)
    exists[east, 0, 1, [east, END]] = True
    exists[east, 0, 2, [3, south, END]] = True
    shared = counted.with_known_next(exists)
    assert shared.bounds[1:].tolist() == [[east, *c, 3], [east, *c, south], [east, *c, END]]
    np.testing.assert_allclose(shared.failed, [0.0, 1 / 3, 1 / 3, 1 / 3])
    np.testing.assert_allclose(shared.n, [1.0, 1 / 3, 1 / 3, 1 / 3])
    units = shared.bounds.copy()
    units[-1, 3] = south
    np.testing.assert_allclose(shared.of_units(units).failed, [0.0, 1 / 3, 2 / 3])
    assert [shared.bounds[i].tolist() for i in shared.lost[0]] == [
        [east, *b, east],
        [east, *c, END],
    ]

    nowhere = counted.with_known_next(np.zeros(exists.shape, bool))
    assert nowhere.bounds.tolist() == [[east, *b, east], [east, *c, END]]


def test_a_failed_bound_has_a_higher_risk_and_a_completed_one_a_lower():
    ws = workspace()
    group = fit_hazard([mission(ROW, "stuck", 2)] * 3, ws)
    risk = BoundRisk(group, ws)
    first, second, never = (4, 0, 1, 4), (4, 0, 2, END), (4, 1, 1, 4)
    # Failures elsewhere raise the risk of what was never tried, for all bounds share a mean.
    assert risk.mean[first] < risk.mean[never] < 0.1
    assert prior_risk(ws).mean[never] < risk.mean[never]
    assert risk.mean[second] > 0.6
    assert risk.past_failures[second[:3]] == 3
    assert np.isnan(risk.mean[4, 0, 0]).all()  # no cell west of the grid
    # Without a terrain, nothing says how next moves differ: they share what was learned.
    np.testing.assert_array_equal(risk.mean[4, 0, 2, 0], risk.mean[second])


def test_draws_of_chances_have_the_means_of_the_map():
    ws = workspace()
    lost = [LostMission(ROW), LostMission(((0, 0), (0, 1), (1, 1)))]
    risk = BoundRisk(fit_hazard([mission(ROW), mission(ROW, "stuck", 2)], ws, lost=lost), ws)
    draws = risk.draw(20_000, seed=1)
    assert (np.isfinite(draws[..., END]) == ws.passable_bounds.values).all()
    exists = risk.exists
    # 5 standard errors, of 1000 distinct hyperparameters.
    error = 5.0 * draws.std(0)[exists] / np.sqrt(1000)
    assert (np.abs(draws.mean(0) - risk.mean)[exists] < error).all()


@pytest.fixture(scope="module")
def hilly():
    """Ground of which some bounds are near the limit of 11 degrees."""
    robot = tb.Robot(max_slope=np.deg2rad(11.0))
    terrain = tb.terrain.synthetic_terrain((150.0, 150.0), resolution=2.0, seed=3, relief=8.0)
    return tb.Workspace.from_terrain(
        terrain, (5, 5), tb.Team(robots=(robot,), lead=robot), bounds=False
    )


def test_one_failure_on_steep_ground_teaches_all_that_is_as_steep(hilly):
    tilt = np.nan_to_num(hilly.difficulty.whole().values[..., MEASURES.index("tilt")])
    # Ends of paths alone, of which each is another unit.
    steepest = np.argsort(tilt[..., END].ravel())[::-1][:6]
    assert 0.8 < tilt[..., END].flat[steepest[-1]] < 1.2
    move, row, col = np.unravel_index(steepest, tilt.shape[:3])
    cells = [(row[0] - MOVES[move[0]][0], col[0] - MOVES[move[0]][1]), (row[0], col[0])]
    path = [tuple(int(i) for i in cell) for cell in cells]
    prior, gone = prior_risk(hilly), fit_hazard([], hilly, lost=[LostMission(path)])
    after = BoundRisk(gone, hilly)
    others = move[1:], row[1:], col[1:], np.full(5, END)
    assert (after.mean[others] > prior.mean[others] + 0.05).all()
    flat = np.unravel_index(np.argmin(np.where(tilt > 0.0, tilt, 9.0)), tilt.shape)
    assert after.mean[flat] < 0.5 * after.mean[others].min()
    # Its prior margin is shared: bounds are passed together, or fail together.
    drawn = 1.0 - prior.draw(1000)[:, *others]
    assert drawn.prod(1).mean() > drawn.mean(0).prod() + 0.05
    assert gone["margin"].mean() > 0.4
    assert (gone["margin"].attrs["units"], gone["width"].attrs["units"]) == ("degrees", "degrees")
    assert gone["measure"].values.tolist() == ["untraversable", "narrowness", "tightness"]


def test_few_draws_have_the_mean_chance_to_arrive_of_many(hilly):
    risk = prior_risk(hilly)
    at = np.nonzero(risk.exists & (risk.steepness > -4.0))

    def arrive(n, seed):
        return (1.0 - risk.draw(n, seed=seed)[:, *at]).prod(1)

    many = arrive(10_000, 0)
    off = [arrive(100, seed).mean() - many.mean() for seed in range(1, 21)]
    # A plain mean of 100 has a standard error of sd / 10.
    assert np.sqrt(np.mean(np.square(off))) < 0.7 * many.std() / 10.0


def test_the_same_seed_gives_the_same_hazard():
    ws, told = workspace(), [mission(ROW, "stuck", 1)]
    lost = [LostMission(ROW)]
    one, other = (fit_hazard(told, ws, lost=lost, seed=3) for _ in range(2))
    assert one.drop_attrs().identical(other.drop_attrs())
    assert not one["intercept"].equals(fit_hazard(told, ws, lost=lost, seed=4)["intercept"])


def test_a_bad_proposal_is_refused(monkeypatch):
    def unlucky(*args):
        points, places = sample(*args)
        return points._replace(k_hat=0.93), places

    monkeypatch.setattr("trustbo.hazard.model.sample", unlucky)
    with pytest.raises(PosteriorError, match="k-hat") as caught:
        fit_hazard([], workspace())
    assert caught.value.posterior.attrs["k_hat"] == 0.93


def test_a_hazard_of_another_workspace_is_refused(hilly):
    ws = workspace()
    walls = np.ones((3, 3), bool)
    walls[1, 1] = False
    walled = tb.Workspace.from_awareness(np.full((1, 3, 3, 1), 0.5), walls)
    with pytest.raises(TrustboError, match="bounds"):
        BoundRisk(fit_hazard([], ws), walled)

    flat = tb.Workspace.from_awareness(np.full((1, *hilly.grid.shape, 1), 0.5))
    of_hilly = fit_hazard([], hilly).drop_vars("is_bound")
    with pytest.raises(TrustboError, match="measures"):
        BoundRisk(of_hilly, flat)


def test_wrong_input_is_named():
    ws = workspace()
    with pytest.raises(TrustboError, match=r"where .*\(2, 2\)"):
        fit_hazard([], ws, lost=[LostMission(ROW, (2, 2))])
    with pytest.raises(TrustboError, match=r"a mission enters \(0, 2\), outside"):
        fit_hazard([mission(ROW)], workspace(2))
    with pytest.raises(TrustboError, match="'quarry'"):
        fit_hazard([replace(mission(ROW), map="quarry")], ws)
    unmapped = tb.Mission.from_arrays(None, np.full((1, 1, 1), 0.5), np.full((1, 1), 0.5))
    with pytest.raises(TrustboError, match="map"):
        fit_hazard([unmapped], ws)
    with pytest.raises(TrustboError, match="missions"):
        fit_hazard(mission(ROW), ws)
    with pytest.raises(TrustboError, match="sd of intercept must be positive"):
        Hazard(intercept=(0.0, 0.0))
    with pytest.raises(TrustboError, match="wrong limit"):
        Hazard(limit=(1.0, 4.0))
    with pytest.raises(TrustboError, match="sd of a wrong limit"):
        Hazard(limit=(0.1, 0.0))
    with pytest.raises(TrustboError, match="'known'; choose one of measured, data sheet, guessed"):
        Hazard(limit="known")
