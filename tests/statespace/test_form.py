"""The form, its recursion and its draws against the joint normal written out, bound by bound."""

import numpy as np
import pytest
from dense_statespace import form_of, mission_of
from scipy import stats
from scipy.linalg import helmert
from unit_noise import UnitNoise

from trustbo.inference.columns import Columns
from trustbo.inference.density import Density, Outer
from trustbo.inference.latent import Source, draw_exactly
from trustbo.models.families import FAMILIES
from trustbo.models.observations import Observations
from trustbo.statespace import Inputs, kalman
from trustbo.statespace.blocks import Layout, LinearPredictor
from trustbo.statespace.form import coupled_robots, independent_robots

K = 5
N_POINTS = 2
N_ROBOTS = 3


def pooled(**options):
    """Equal robots: their form, and the dense form of each point."""
    rng = np.random.default_rng(0)
    numbers = rng.uniform(0.1, 0.9, (3, N_POINTS))
    x0 = rng.uniform(0.3, 0.7, (2, N_POINTS))
    shared = options.get("delta_s", np.zeros(N_POINTS))
    dense = [
        form_of(*numbers[:, p], *x0[:, p], n_robots=N_ROBOTS, delta_s=shared[p])
        for p in range(N_POINTS)
    ]
    return independent_robots(*numbers, *x0, **options), dense


def different(**options):
    """Robots with parameters of their own."""
    rng = np.random.default_rng(2)
    numbers = rng.uniform(0.1, 0.9, (5, N_POINTS, N_ROBOTS))
    shared = options.get("delta_s", np.zeros(N_POINTS))
    dense = [form_of(*numbers[:, p], n_robots=N_ROBOTS, delta_s=shared[p]) for p in range(N_POINTS)]
    return independent_robots(*numbers, **options), dense


def coupled():
    """Robots that influence each other."""
    rng = np.random.default_rng(1)
    B0 = rng.uniform(-0.3, 0.5, (N_POINTS, N_ROBOTS, N_ROBOTS))
    root_w, root_v = rng.normal(size=(2, N_POINTS, N_ROBOTS, N_ROBOTS))
    matrices = B0, root_w @ root_w.mT, root_v @ root_v.mT
    dense = [
        form_of(*(matrix[p] for matrix in matrices), 0.5, 0.4, n_robots=N_ROBOTS)
        for p in range(N_POINTS)
    ]
    return coupled_robots(*matrices, 0.5, 0.4), dense


SHARED = {"delta_s": np.array([0.3, 0.1]), "n_members": N_ROBOTS}
SPACES = {
    "equal robots": pooled(),
    "different robots": different(),
    "equal robots, shared noise": pooled(**SHARED),
    "different robots, shared noise": different(**SHARED),
    "coupled": coupled(),
}


def inputs_of(space, *, offset=True, seed=4):
    """Drift and offset (bound, robot), and the `Inputs` of each bound, equal at all points."""
    drift, of_bounds = np.random.default_rng(seed).normal(size=(2, K, N_ROBOTS))
    of_bounds = of_bounds * offset
    inputs = [
        Inputs(*(space.grouped(values[None]) for values in pair))
        for pair in zip(drift, of_bounds, strict=True)
    ]
    return drift, of_bounds, inputs


def rates_of(seed=5):
    """Rates (bound, robot), some of which were not measured."""
    rates = np.random.default_rng(seed).normal(size=(K, N_ROBOTS))
    rates[1, 2] = np.nan
    rates[3] = np.nan
    return rates


def over_robots(cov):
    """Covariance (point, robot, robot) of all robots from that of groups."""
    n_points, n_groups, n, _ = cov.shape
    every = np.zeros((n_points, N_ROBOTS, N_ROBOTS))
    for i in range(N_ROBOTS):
        for j in range(N_ROBOTS):
            if i // n == j // n:
                every[:, i, j] = cov[:, min(i // n, n_groups - 1), i % n, j % n]
    return every


def n_groups_of(space):
    return N_ROBOTS // space.n_members


@pytest.mark.parametrize("name", SPACES)
def test_moments_are_those_of_the_equation(name):
    space, forms = SPACES[name]
    n, n_groups = space.n_members, n_groups_of(space)
    drift, *_ = inputs_of(space)
    u = space.grouped(drift).swapaxes(0, 1).reshape(n_groups, K * n)
    mean, response, cov = space.moments(K)
    for point in range(N_POINTS):
        dense = mission_of(forms[point], drift, 0.0 * drift)
        of_bounds = dense.trust_cov.reshape(K, N_ROBOTS, K, N_ROBOTS)
        for group in range(n_groups):
            robots = slice(group * n, (group + 1) * n)
            expected = dense.mean.reshape(K, N_ROBOTS)[:, robots].ravel()
            at = min(group, response.shape[1] - 1)
            found = mean[point, min(group, mean.shape[1] - 1)] + response[point, at] @ u[group]
            np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)
            expected = of_bounds[:, robots, :, robots].reshape(K * n, K * n)
            np.testing.assert_allclose(cov[point, at], expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("name", SPACES)
@pytest.mark.parametrize("offset", [False, True])
def test_the_recursion_has_the_moments_of_all_bounds(name, offset):
    space, forms = SPACES[name]
    drift, of_bounds, inputs = inputs_of(space, offset=offset)
    dense = [mission_of(form, drift, of_bounds) for form in forms]
    belief = kalman.initial(space, n_groups_of(space))
    for k in range(K):
        belief = kalman.predict(space, belief, inputs[k])
        rows = slice(k * N_ROBOTS, (k + 1) * N_ROBOTS)
        mean = [one.mean[rows] for one in dense]
        cov = [one.trust_cov[rows, rows] for one in dense]
        np.testing.assert_allclose(belief.mean.reshape(N_POINTS, -1), mean, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(over_robots(belief.cov), cov, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("name", SPACES)
@pytest.mark.parametrize("offset", [False, True])
def test_the_filter_has_the_density_and_the_trust_of_the_joint_normal(name, offset):
    space, forms = SPACES[name]
    drift, of_bounds, inputs = inputs_of(space, offset=offset)
    rates = rates_of()
    belief = kalman.initial(space, n_groups_of(space))
    total = 0.0
    for k in range(K):
        predicted = kalman.predict(space, belief, inputs[k])
        y = space.grouped(rates[k])
        apart = kalman.marginal_log_densities(space, predicted, y, y, FAMILIES["gaussian"])
        belief, gained = kalman.update(space, predicted, y, y, FAMILIES["gaussian"])
        total = total + gained
        rows = slice(k * N_ROBOTS, (k + 1) * N_ROBOTS)
        before, until = (
            np.where(np.arange(K)[:, None] < k + more, rates, np.nan) for more in (0, 1)
        )
        for point, form in enumerate(forms):
            dense = mission_of(form, drift, of_bounds)
            expected = dense.log_density(until)
            np.testing.assert_allclose(total[point], expected, rtol=1e-9)
            mean, cov = dense.trust_given(until)
            np.testing.assert_allclose(
                belief.mean[point].ravel(), mean[rows], rtol=1e-9, atol=1e-11
            )
            found = over_robots(belief.cov)[point]
            np.testing.assert_allclose(found, cov[rows, rows], rtol=1e-9, atol=1e-11)

            mean, cov = dense.rates_given(before)
            of_each = stats.norm.logpdf(rates[k], mean[rows], np.sqrt(np.diag(cov)[rows]))
            np.testing.assert_allclose(apart[point], np.nan_to_num(of_each), rtol=1e-9, atol=1e-11)


class OfSpace(Source):
    """Draws of a form with known inputs (bound, robot) of one mission."""

    size = 10_000

    def __init__(self, space, drift, of_bounds, observations):
        layout = Layout.of_space(space, observations.contact_rate)
        density = Density(Columns((), observations), layout, FAMILIES["gaussian"])
        super().__init__(density, len(space.transition))
        inputs = (np.broadcast_to(v, (self.n_draws, 1, *v.shape)) for v in (drift, of_bounds))
        self.whole = Outer(np.zeros(self.n_draws), space, Inputs(*inputs), {})

    def outer(self, some):
        return self.whole.take(some), np.zeros((len(some), 0))

    def log_prior(self, given):
        return {}

    def prior(self, posterior, rng):
        raise NotImplementedError


def drawn_trust(space, drift, of_bounds, rates, rng):
    """Trust (point, bound, robot) of a mission given its rates, and their log-likelihood."""
    shape = (1, *rates.shape)
    observations = Observations(rates[None], np.zeros((*shape, 0)), np.full(shape, np.nan))
    source = OfSpace(space, drift, of_bounds, observations)
    (given,) = source.given(np.arange(source.n_draws))
    trust, log_p = draw_exactly(source, given, rng)
    return source.layout.unstack(trust)[:, 0], log_p[:, 0]


@pytest.mark.parametrize("point", range(N_POINTS))
@pytest.mark.parametrize("name", SPACES)
def test_trust_is_drawn_from_the_joint_normal_given_the_rates(name, point):
    space, forms = SPACES[name]
    drift, of_bounds, _ = inputs_of(space)
    rates = rates_of()
    copies = space.take(np.full(1 + K * N_ROBOTS, point))
    rng = UnitNoise()
    drawn, log_p = drawn_trust(copies, drift, of_bounds, rates, rng)

    mean, cov = rng.moments(drawn)
    dense = mission_of(forms[point], drift, of_bounds)
    expected_mean, expected_cov = dense.trust_given(rates)
    np.testing.assert_allclose(mean, expected_mean, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(cov, expected_cov, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(log_p, dense.log_density(rates), rtol=1e-9)


@pytest.mark.parametrize("name", ["different robots", "coupled"])
def test_many_draws_of_trust_have_the_moments_of_the_joint_normal(name):
    """Within 5 standard errors; numbers of a generator differ from point to point."""
    n = 4000
    space, forms = SPACES[name]
    drift, of_bounds, _ = inputs_of(space)
    rates = rates_of()
    copies = space.take(np.zeros(n, int))
    rng = np.random.default_rng(0)
    drawn = drawn_trust(copies, drift, of_bounds, rates, rng)[0].reshape(n, -1)

    mean, cov = mission_of(forms[0], drift, of_bounds).trust_given(rates)
    sd = np.sqrt(np.diag(cov))
    assert (np.abs(drawn.mean(0) - mean) < 5.0 * sd / np.sqrt(n)).all()
    np.testing.assert_allclose(
        np.cov(drawn.T) / np.outer(sd, sd), cov / np.outer(sd, sd), atol=5.0 * np.sqrt(2.0 / n)
    )


@pytest.mark.parametrize("n_known", [0, 2])
@pytest.mark.parametrize("name", SPACES)
def test_forecasts_of_all_rates_are_drawn_from_the_joint_normal(name, n_known):
    """Given the rates of the first bounds; the covariance between later bounds is that of trust."""
    space, forms = SPACES[name]
    drift, of_bounds, inputs = inputs_of(space)
    rates = rates_of()
    rates[n_known:] = np.nan
    n_ahead = K - n_known
    n_noises = N_ROBOTS * (1 + 3 * n_ahead)  # trust now, then process, shared and own noise
    copies = space.take(np.zeros(1 + n_noises, int))
    belief = kalman.initial(copies, n_groups_of(space))
    for k in range(n_known):
        y = space.grouped(rates[k])
        predicted = kalman.predict(copies, belief, inputs[k])
        belief, _ = kalman.update(copies, predicted, y, y, FAMILIES["gaussian"])

    rng = UnitNoise()
    ticks = space.grouped(np.full((n_ahead, N_ROBOTS), np.nan))
    ahead = kalman.forecast(copies, belief, inputs[n_known:], ticks, FAMILIES["gaussian"], rng)
    drawn = np.stack([rates_drawn for _, rates_drawn in ahead], axis=1)

    mean, cov = rng.moments(drawn)
    expected_mean, expected_cov = mission_of(forms[0], drift, of_bounds).rates_given(rates)
    rows = slice(n_known * N_ROBOTS, None)
    np.testing.assert_allclose(mean, expected_mean[rows], rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(cov, expected_cov[rows, rows], rtol=1e-9, atol=1e-10)


def test_contrasts_of_exchangeable_robots_are_independent():
    space = SPACES["equal robots, shared noise"][0]
    rotation = helmert(3, full=True)
    joint = LinearPredictor.from_space(space, Layout((1, K, 3), joint=True))
    apart = LinearPredictor.from_space(space, Layout((1, K, 3), rotation=rotation))
    turn = np.kron(np.eye(K), rotation)
    for point in range(N_POINTS):
        cov = turn @ joint.covariance[point, 0] @ turn.T
        mean = turn @ joint.mean[point, 0]
        for i in range(3):
            rows = slice(i, None, 3)
            label = min(i, 1)
            np.testing.assert_allclose(mean[rows], apart.mean[point, label], atol=1e-12)
            np.testing.assert_allclose(cov[rows, rows], apart.covariance[point, label], atol=1e-12)
            cov[rows, rows] = 0.0
        np.testing.assert_allclose(cov, 0.0, atol=1e-12)
