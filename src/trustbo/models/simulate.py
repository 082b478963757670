"""Missions simulated from a model for given parameters, in NumPy without compilation."""

import numpy as np

from trustbo.models.families import Family
from trustbo.models.params import CoupledParams, Params


def draw_missions(
    family: Family,
    params: Params,
    awareness: np.ndarray,
    n_ticks: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Contact rates (mission, bound, robot): x_k = B0 x_{k-1} + u_k + w_k, y_k by the family.

    Args:
        family: Observation family.
        params: One draw of the parameters; with place effects, `params.along(path)`.
        awareness: Shape (mission, bound, robot, feature).
        n_ticks: Ticks of each bound, (mission, bound, robot).
        rng: Random number generator.
    """
    n_missions, n_bounds, n_robots = shape = awareness.shape[:3]
    B0 = params.transition(n_robots)
    as_map = np.moveaxis(awareness, 2, 0)[:, None]  # (robot, 1, mission, bound, feature)
    u = np.moveaxis(params.increments(as_map)[:, 0], 0, -1) + np.asarray(params.b)
    if params.memory == "deviation":  # x - u lasts
        first = np.full_like(u[:, :1], params.x0_mean)
        u = u - np.concatenate([first, u[:, :-1]], axis=1) @ B0.T

    of_trust, shared, own = _noise(params, family, n_robots)
    w, v = rng.standard_normal((2, n_bounds, n_missions, n_robots))
    x = params.x0_mean + params.x0_sd * rng.standard_normal((n_missions, n_robots))
    rates = np.empty(shape)
    for k in range(n_bounds):
        x = x @ B0.T + u[:, k] + w[k] @ of_trust.T
        rates[:, k] = family.sample(x + v[k] @ shared.T, own, n_ticks[:, k], rng)
    return rates


def _noise(params: Params, family: Family, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Factors of the covariances of w and of shared noise of rates, and sd of independent noise.

    As in `CoupledTrust.signal`, independent noise has half the least eigenvalue of Delta_v.
    """
    none = np.zeros((n, n))
    if not isinstance(params, CoupledParams):
        return params.delta_w * np.eye(n), none, np.asarray(params.delta_v)
    of_trust, Delta_v = np.linalg.cholesky(params.Delta_w), np.asarray(params.Delta_v)
    if not family.adds_noise:
        return of_trust, none, np.asarray(params.delta_v)
    own = 0.5 * np.linalg.eigvalsh(Delta_v)[0]
    return of_trust, np.linalg.cholesky(Delta_v - own * np.eye(n)), np.sqrt(own)
