"""The form against the paper's equations written out, bound by bound."""

import numpy as np
import pytest
from scipy.linalg import block_diag, helmert

from trustbo.models.families import FAMILIES
from trustbo.statespace import Inputs, StateSpace, kalman
from trustbo.statespace.blocks import Layout, LinearPredictor
from trustbo.statespace.form import coupled_robots, independent_robots

K = 5


def pooled(n_points=2, **options):
    rng = np.random.default_rng(0)
    beta0, delta_w, delta_v = rng.uniform(0.1, 0.9, (3, n_points))
    return independent_robots(beta0, delta_w, delta_v, 0.5, 0.4, **options)


def coupled(n=3, n_points=2):
    rng = np.random.default_rng(1)
    B0 = rng.uniform(-0.3, 0.5, (n_points, n, n))
    root_w, root_v = rng.normal(size=(2, n_points, n, n))
    Delta_w = root_w @ np.swapaxes(root_w, 1, 2)
    Delta_v = root_v @ np.swapaxes(root_v, 1, 2)
    return coupled_robots(B0, Delta_w, Delta_v, 0.5, 0.4)


SPACES = {
    "independent": pooled(),
    "different robots": independent_robots(
        *np.random.default_rng(2).uniform(size=(3, 2, 3)), 0.5, 0.4
    ),
    "shared noise": pooled(delta_s=np.array([0.3, 0.1]), n_members=3),
    "coupled": coupled(),
}


def stepwise(space: StateSpace, point, group, u):
    """Mean and covariance of the states of all bounds, from the equation itself."""

    def of(values):
        return values[point, group if values.shape[1] > 1 else 0]

    A, Q = of(space.transition), of(space.process_cov)
    n = len(A)
    mean = of(space.initial_mean)
    noise = block_diag(of(space.initial_cov), *[Q] * K)  # (d_0, w_1, ..., w_K)
    response = np.zeros((n, n * (K + 1)))
    response[:, :n] = np.eye(n)
    means, rows = [], []
    for k in range(K):
        mean = A @ mean + u[k]
        response = A @ response
        response[:, n * (k + 1) : n * (k + 2)] += np.eye(n)
        means.append(mean)
        rows.append(response)

    rows = np.concatenate(rows)
    return np.concatenate(means), rows @ noise @ rows.T


@pytest.mark.parametrize("name", SPACES)
def test_moments_are_those_of_the_equation(name):
    space = SPACES[name]
    n = space.n_members
    u = np.random.default_rng(3).normal(size=(K, n))
    mean, response, cov = space.moments(K)
    for point in range(2):
        for group in range(mean.shape[1]):
            at = group if response.shape[1] > 1 else 0
            wanted_mean, wanted_cov = stepwise(space, point, group, u)
            found = mean[point, group] + response[point, at] @ u.ravel()
            np.testing.assert_allclose(found, wanted_mean, rtol=1e-10, atol=1e-12)
            np.testing.assert_allclose(cov[point, at], wanted_cov, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("name", SPACES)
@pytest.mark.parametrize("offset", [False, True])
def test_the_recursion_has_the_moments_of_all_bounds(name, offset):
    space = SPACES[name]
    n = space.n_members
    n_groups = space.noise_sd.shape[1]
    rng = np.random.default_rng(4)
    u, o = rng.normal(size=(2, K, 2, n_groups, n))
    o = o * offset
    mean, response, cov = space.moments(K)
    belief = kalman.initial(space, n_groups)
    for k in range(K):
        belief = kalman.predict(space, belief, Inputs(u[k], o[k]))
        rows = slice(k * n, (k + 1) * n)
        of_u = np.moveaxis(u, 0, 2).reshape(2, n_groups, -1)
        wanted = mean[..., rows] + (response[..., rows, :] @ of_u[..., None])[..., 0] + o[k]
        np.testing.assert_allclose(belief.mean, wanted, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(
            belief.cov, np.broadcast_to(cov[..., rows, rows], belief.cov.shape), rtol=1e-10
        )


@pytest.mark.parametrize("name", ["shared noise", "coupled"])
def test_the_filter_has_the_density_and_the_trust_of_the_joint_normal(name):
    space = SPACES[name]
    rng = np.random.default_rng(5)
    u = rng.normal(size=(K, 2, 1, 3))
    y = rng.normal(size=(K, 1, 3))
    y[1, 0, 2] = np.nan
    y[3] = np.nan
    layout = Layout.from_rates(np.full((1, K, 3), np.nan), joint=True)
    predictor = LinearPredictor.from_space(space, layout)
    belief = kalman.initial(space, 1)
    log_density = 0.0
    for k in range(K):
        predicted = kalman.predict(space, belief, Inputs(u[k]))
        belief, gained = kalman.update(space, predicted, y[k], np.nan * y[k], FAMILIES["gaussian"])
        log_density = log_density + gained

    seen = ~np.isnan(y.ravel())
    for point in range(2):
        mean = predictor.mean[point, 0] + predictor.response[point, 0] @ u[:, point].ravel()
        cov = predictor.covariance[point, 0] + np.diag(
            np.broadcast_to(predictor.noise_sd[point, 0], mean.shape) ** 2
        )
        off = y.ravel()[seen] - mean[seen]
        V = cov[np.ix_(seen, seen)]
        cross = predictor.trust_cov[point, 0][-3:, seen]
        wanted = -0.5 * (off @ np.linalg.solve(V, off) + np.linalg.slogdet(2.0 * np.pi * V)[1])
        assert log_density[point] == pytest.approx(wanted, rel=1e-9)
        trust = mean[-3:] + cross @ np.linalg.solve(V, off)
        np.testing.assert_allclose(belief.mean[point, 0], trust, rtol=1e-8, atol=1e-10)


def test_contrasts_of_exchangeable_robots_are_independent():
    space = SPACES["shared noise"]
    rotation = helmert(3, full=True)
    joint = LinearPredictor.from_space(space, Layout((1, K, 3), joint=True))
    apart = LinearPredictor.from_space(space, Layout((1, K, 3), rotation=rotation))
    turn = np.kron(np.eye(K), rotation)
    for point in range(2):
        cov = turn @ joint.covariance[point, 0] @ turn.T
        mean = turn @ joint.mean[point, 0]
        for i in range(3):
            rows = slice(i, None, 3)
            label = min(i, 1)
            np.testing.assert_allclose(mean[rows], apart.mean[point, label], atol=1e-12)
            np.testing.assert_allclose(cov[rows, rows], apart.covariance[point, label], atol=1e-12)
            cov[rows, rows] = 0.0
        np.testing.assert_allclose(cov, 0.0, atol=1e-12)
