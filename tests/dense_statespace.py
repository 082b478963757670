"""The reference of the state-space form: the joint normal distribution of a mission's trust.

    d_k = A d_{k-1} + u_k + w_k,    w_k ~ N(0, Q),    d_0 ~ N(m0, P0)
    x_k = d_k + o_k,                y_k = x_k + v_k,  v_k ~ N(0, R)

Means and covariances follow from these equations one bound after the other, and all bounds are
conditioned on at once. Nothing of the package is imported, and its parameters are only read.

Arrays may have leading axes, such as (draw,). The trust of a mission is flat over (bound, robot).
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

STEPS = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1) if down or right]
"""The eight moves between cells, row by row from the north-west."""


class Form(NamedTuple):
    """Parameters of the equations; R is the covariance of all noise of the rates of a bound."""

    A: np.ndarray  # (..., robot, robot)
    Q: np.ndarray  # (..., robot, robot)
    m0: np.ndarray  # (..., robot)
    P0: np.ndarray  # (..., robot, robot)
    R: np.ndarray  # (..., robot, robot)


def form_of(
    beta0, delta_w, delta_v, x0_mean=0.5, x0_sd=0.5, *, n_robots, delta_s=0.0, deviation=False
):
    """Form of equations (1)-(2) or (3)-(4), for numbers, values (robot,) or matrices.

    Noises are standard deviations, or covariance matrices. All robots share the noise `delta_s`.
    If the deviation from expected trust is what lasts, it has mean 0 at first.
    """
    own = np.eye(n_robots)

    def covariance(noise):
        noise = np.asarray(noise, float)
        return noise if noise.ndim == 2 else noise**2 * own

    beta0 = np.asarray(beta0, float)
    return Form(
        A=beta0 if beta0.ndim == 2 else beta0 * own,
        Q=covariance(delta_w),
        m0=(0.0 if deviation else 1.0) * x0_mean * np.ones(n_robots),
        P0=np.asarray(x0_sd) ** 2 * own,
        R=covariance(delta_v) + delta_s**2,
    )


def stacked(forms):
    """Forms of several draws as one, with a leading axis."""
    return Form(*(np.stack(values) for values in zip(*forms, strict=True)))


def expected_trust(form, drift, offset):
    """Expected trust (..., bound, robot) for inputs (..., bound, robot)."""
    state = form.m0
    trust = []
    for k in range(drift.shape[-2]):
        state = (form.A @ state[..., None])[..., 0] + drift[..., k, :]
        trust.append(state + offset[..., k, :])
    return np.stack(trust, axis=-2)


def trust_covariance(form, n_bounds):
    """Covariance (..., bound * robot, bound * robot) of the trust of all bounds."""
    A, Q, _, P, _ = form
    blocks = [[None] * n_bounds for _ in range(n_bounds)]
    for k in range(n_bounds):
        P = A @ P @ A.mT + Q
        blocks[k][k] = P
        for j in range(k):
            blocks[k][j] = A @ blocks[k - 1][j]
            blocks[j][k] = blocks[k][j].mT
    return np.block(blocks)


def rate_noise(form, n_bounds):
    """Covariance (..., bound * robot, bound * robot) of the noise of all rates."""
    none = np.zeros_like(form.R)
    return np.block(
        [[form.R if j == k else none for j in range(n_bounds)] for k in range(n_bounds)]
    )


def log_density(mean, cov, y):
    """Log density (...,) of N(mean, cov) at the values y (n,) that are not NaN."""
    seen = ~np.isnan(y)
    off = (y - mean)[..., seen]
    cov = cov[..., seen, :][..., seen]
    quadratic = (off * np.linalg.solve(cov, off[..., None])[..., 0]).sum(-1)
    return -0.5 * (quadratic + np.linalg.slogdet(2.0 * np.pi * cov)[1])


def conditional(x_mean, x_cov, cross, y_mean, y_cov, y):
    """Mean and covariance of x given the values y (n,) that are not NaN.

    `cross` (..., x, y) is the covariance of x and y.
    """
    seen = ~np.isnan(y)
    cross = cross[..., seen]
    gain = np.linalg.solve(y_cov[..., seen, :][..., seen], cross.mT).mT
    off = (y - y_mean)[..., seen]
    return x_mean + (gain @ off[..., None])[..., 0], x_cov - gain @ cross.mT


class Mission(NamedTuple):
    """Joint normal of a mission's trust x and rates y, flat over (bound, robot)."""

    mean: np.ndarray  # (..., n), of trust and of rates
    trust_cov: np.ndarray  # (..., n, n)
    rate_cov: np.ndarray  # (..., n, n)

    def log_density(self, rates):
        """Log density (...,) of rates (bound, robot), NaN where not measured."""
        return log_density(self.mean, self.rate_cov, np.ravel(rates))

    def trust_given(self, rates):
        """Mean (..., n) and covariance (..., n, n) of trust given rates (bound, robot)."""
        trust = self.mean, self.trust_cov
        return conditional(*trust, self.trust_cov, self.mean, self.rate_cov, np.ravel(rates))

    def rates_given(self, rates):
        """Mean (..., n) and covariance (..., n, n) of new rates, with other noise."""
        mean, cov = self.trust_given(rates)
        return mean, cov + self.rate_cov - self.trust_cov


def mission_of(form, drift, offset, scale=None):
    """Joint normal of a mission for inputs (..., bound, robot), and for a scale of the noise."""
    n_bounds = drift.shape[-2]
    mean = expected_trust(form, drift, offset)
    cov = trust_covariance(form, n_bounds)
    noise = rate_noise(form, n_bounds)
    if scale is not None:
        g = scale.reshape(*scale.shape[:-2], -1)
        noise = noise * g[..., :, None] * g[..., None, :]
    return Mission(mean.reshape(*mean.shape[:-2], -1), cov, cov + noise)


def noise_scale_of(params, awareness):
    """Scale (draw, bound, robot) of the noise by the team's mean line of sight; None without."""
    if "f_v" not in params.values:
        return None
    sight = [m for m, name in enumerate(params.features) if name.startswith("line_of_sight")]
    m = awareness[..., sight].mean((1, 2))
    f = np.asarray(params.f_v)[:, None]
    g = np.sqrt(f**2 + (1.0 - f**2) * 4.0 * m * (1.0 - m))
    return g[:, :, None] * np.ones(awareness.shape[1])


def mission_of_params(params, awareness, path=None, *, x0=None):
    """Joint normal of a mission under draws of parameters; see `equations_of_params`."""
    scale = noise_scale_of(params, awareness)
    if scale is not None and params.n_draws == 1:
        scale = scale[0]
    return mission_of(*equations_of_params(params, awareness, path, x0=x0), scale)


def trust_of_params(params, awareness, path=None, *, x0=None):
    """Expected trust (..., bound, robot) under draws of parameters; see `equations_of_params`."""
    return expected_trust(*equations_of_params(params, awareness, path, x0=x0))


def equations_of_params(params, awareness, path=None, *, x0=None):
    """Form, drift and offset (draw, bound, robot) of a mission; without (draw,) for one draw."""
    form, *inputs = _equations_of_draws(params, awareness, path, x0=x0)
    if params.n_draws > 1:
        return form, *inputs
    return Form(*(field[0] if np.ndim(field) > 1 else field for field in form)), *(
        u[0] for u in inputs
    )


def _equations_of_draws(params, awareness, path=None, *, x0=None):
    """Form, drift and offset (draw, bound, robot) of a mission under draws of parameters.

    Args:
        params: `TrustParams`, whose fields (draw, ...) are read.
        awareness: Awareness (bound, robot, feature).
        path: Cells from the start on; needed with effects of places.
        x0: Trust before the first bound, if it is known, shape () or (robot,).
    """
    n_robots = awareness.shape[1]
    u = np.stack(
        [np.stack([weighted(params, z, i) for i in range(n_robots)], axis=-1) for z in awareness],
        axis=-2,
    )
    if path is not None:
        u = u + of_places(params, path)

    own = np.eye(n_robots)
    if x0 is None:
        m0 = np.asarray(params.x0_mean)[..., None] * np.ones(n_robots)
        P0 = np.asarray(params.x0_sd)[..., None, None] ** 2 * own
    else:
        m0 = np.asarray(x0) * np.ones(n_robots)
        P0 = 0.0 * own[None]
    if hasattr(params, "B0"):
        form = Form(params.B0, params.Delta_w, m0, P0, params.Delta_v)
        return form, u, np.zeros_like(u)

    def diagonal(values):
        if not params.per_robot:
            values = np.asarray(values)[..., None]
        return values[..., None] * own

    noise = diagonal(params.delta_v) ** 2
    if "delta_s" in params.values:
        noise = noise + np.asarray(params.delta_s)[..., None, None] ** 2
    form = Form(diagonal(params.beta0), diagonal(params.delta_w) ** 2, m0, P0, noise)
    if params.memory == "deviation":
        return form._replace(m0=0.0 * m0), np.zeros_like(u), u
    return form, u, np.zeros_like(u)


def weighted(params, z, i):
    """Intercept and weighted awareness (...,) of robot i in a bound, for awareness z."""
    total = params.b if params.b.ndim == 1 else params.b[..., i]
    for m in range(z.shape[1]):
        if hasattr(params, "B0"):
            for j in range(len(z)):
                total = total + params.B[..., m, i, j] * z[j, m]
        elif params.per_robot:
            total = total + params.beta[..., i, m] * z[i, m]
        else:
            total = total + params.beta[..., m] * z[i, m]
    return total


def of_places(params, path):
    """Effects (..., bound, robot or 1) of the cells that a path enters, and of its bounds."""
    effects = []
    for before, (row, col) in pairwise(path):
        move = STEPS.index((row - before[0], col - before[1]))
        effect = np.zeros(1)
        if "place" in params.values:
            effect = effect + params.place[..., row, col]
        if "place_bound" in params.values:
            effect = effect + params.place_bound[..., move, row, col]
        if params.place_robot is not None:
            effect = effect + params.place_robot.everywhere()[..., move, row, col]
        effects.append(effect)
    return np.stack(effects, axis=-2)
