"""Missions made for tests, and the parameters that they are drawn from."""

import jax
import numpy as np

from trustbo.data import Mission
from trustbo.models import PooledTrust, TrustParams

TRUTH = TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)
N_TICKS = 20
OF_FAMILY = {
    "gaussian": TrustParams(0.6, np.array([0.5, 0.3]), -0.1, 0.1, 0.1),
    "censored": TrustParams(0.6, np.array([0.5, 0.3]), -0.1, 0.15, 0.1),
    "beta_binomial": TrustParams(0.6, np.array([2.0, 1.0]), -0.6, 0.4, 0.25, 0.0, 1.5),
}


def simulate_missions(n_missions=6, seed=0, truth=TRUTH, lengths=(7, 5, 8)):
    """Missions of three robots whose rates the pooled model draws."""
    rng = np.random.default_rng(seed)
    awareness = rng.uniform(size=(n_missions, 8, 3, 2))
    sample = PooledTrust().simulate(jax.random.key(seed), truth, awareness)
    missions = []
    for j in range(n_missions):
        n = lengths[j % len(lengths)]
        rates = np.clip(sample.contact_rate[j, :n], 0.0, 1.0)
        path = [(0, k) for k in range(n + 1)]
        missions.append(Mission.from_arrays(path, awareness[j, :n], rates))
    return missions


def counted_missions(family, seed=0, n=6, low=0.0):
    """Awareness, rates in shares of `N_TICKS`, one missing, and their missions of one robot."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(size=(n, 5, 1, 2))
    model = PooledTrust(observation=family)
    y = model.simulate(jax.random.key(seed), OF_FAMILY[family], z, n_ticks=N_TICKS).contact_rate
    y = np.round(np.clip(y, low, 1.0 - low) * N_TICKS) / N_TICKS
    y[0, 2] = np.nan
    path = [(0, k) for k in range(6)]
    n_ticks = np.full((5, 1), N_TICKS)
    missions = [Mission.from_arrays(path, a, b, n_ticks=n_ticks) for a, b in zip(z, y, strict=True)]
    return z, y, missions


def random_missions(rng, n_missions=3, n_robots=3, missing=0.2):
    """Missions of any length, whose rates no model has drawn; some are missing."""
    missions = []
    for _ in range(n_missions):
        n_bounds = int(rng.integers(1, 12))
        rates = rng.uniform(size=(n_bounds, n_robots))
        rates[rng.uniform(size=rates.shape) < missing] = np.nan
        path = [(0, k) for k in range(n_bounds + 1)]
        missions.append(Mission.from_arrays(path, rng.uniform(size=(n_bounds, n_robots, 2)), rates))
    return missions


def walking_missions(seed, n_missions=4, shape=(5, 5), n_bounds=(4, 10), missing=0.2):
    """Missions of three robots on random walks over a grid, whose rates no model has drawn."""
    rng, missions = np.random.default_rng(seed), []
    for _ in range(n_missions):
        n, path = int(rng.integers(*n_bounds)), [tuple(rng.integers(shape).tolist())]
        while len(path) <= n:
            row, col = np.array(path[-1]) + rng.integers(-1, 2, size=2)
            if 0 <= row < shape[0] and 0 <= col < shape[1] and (row, col) != path[-1]:
                path.append((int(row), int(col)))
        rates = rng.uniform(size=(n, 3))
        rates[rng.uniform(size=rates.shape) < missing] = np.nan
        missions.append(Mission.from_arrays(path, rng.uniform(size=(n, 3, 2)), rates))
    return missions


def random_params(rng):
    """Parameters of the pooled model, far wider than its prior."""
    return TrustParams(
        beta0=rng.uniform(-0.9, 1.1),
        beta=rng.normal(0.0, 1.0, 2),
        b=rng.normal(0.0, 0.5),
        delta_w=rng.uniform(0.01, 0.5),
        delta_v=rng.uniform(0.01, 0.5),
        x0_mean=rng.normal(0.5, 0.3),
        x0_sd=rng.uniform(0.0, 0.7),
    )


def random_covariance(rng, n, scale):
    """A covariance of n robots, about scale^2 on its diagonal."""
    A = rng.normal(size=(n, n))
    return scale**2 * (A @ A.T / n + 0.3 * np.eye(n))
