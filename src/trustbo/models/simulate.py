"""Missions drawn from the model in NumPy, under many draws at once: nothing is compiled.

Robots that influence each other are drawn as one vector, others as groups that share parameters.
Draws of the parameters are the last, contiguous axis.
"""

from typing import Any, NamedTuple, Self

import numpy as np

from trustbo.models.families import Family
from trustbo.models.params import CoupledParams, Params


class TrustSample(NamedTuple):
    """Draws of latent trust and contact rate, each of shape (mission, bound, robot).

    Under many draws of the parameters, (draw, mission, bound, robot).
    """

    trust: np.ndarray
    contact_rate: np.ndarray


def draw_missions(
    family: Family,
    params: Params,
    awareness: np.ndarray,
    n_ticks: np.ndarray,
    rng: np.random.Generator,
) -> TrustSample:
    """Latent trust and contact rates of missions drawn anew, one set per draw of the parameters.

    Args:
        family: Family of observations.
        params: Draws with leading axis (draw,).
        awareness: Shape (mission, bound, robot, feature).
        n_ticks: Ticks, broadcast to (mission, bound, robot).
        rng: Random number generator.
    """
    n_missions, n_bounds, n_robots = shape = awareness.shape[:3]
    n_ticks = np.broadcast_to(n_ticks, shape)
    params = params.with_drift(awareness)
    trust, rates = np.empty((2, len(params.b), *shape))
    coupled = isinstance(params, CoupledParams)
    for robots in [list(range(n_robots))] if coupled else params.alike(n_robots):
        dynamics = _Dynamics.coupled(params) if coupled else _Dynamics.apart(params, robots)
        w, v = rng.standard_normal((2, n_bounds, n_missions, len(robots), len(params.b)))
        x = dynamics.x0_mean + dynamics.x0_sd * rng.standard_normal(w.shape[1:])
        for k in range(n_bounds):
            drift = dynamics.drift(awareness[:, k, robots], k)
            x = _times(dynamics.B0, x) + drift + _times(dynamics.w, w[k])
            shared, own = _times(dynamics.v, v[k]), dynamics.delta_v
            y = family.sample(x + shared, own, n_ticks[:, k, robots, None], rng)
            trust[:, :, k, robots] = np.moveaxis(x, -1, 0)
            rates[:, :, k, robots] = np.moveaxis(y, -1, 0)
    return TrustSample(trust, rates)


class _Dynamics(NamedTuple):
    """Parameters of one group of robots: with common parameters, or coupled; draws last."""

    B0: np.ndarray  # (draw,), or (robot, robot', draw)
    B: np.ndarray  # (feature, draw), or (feature, robot, robot', draw)
    b: np.ndarray  # (bound or 1, mission or 1, robot or 1, draw)
    w: np.ndarray  # what standard normal noise is multiplied by, as B0
    v: np.ndarray  # as w, of the noise that robots share
    delta_v: np.ndarray  # (draw,), or (robot, draw): sd of each robot's own noise
    x0_mean: np.ndarray  # (draw,)
    x0_sd: np.ndarray

    @classmethod
    def apart(cls, params: Params, robots: list[int]) -> Self:
        """Dynamics of robots with the same parameters; b may vary by bound, see `Params.on`."""
        p: Any = params.of_robot(robots[0])
        b = np.asarray(p.b)
        b = b.reshape(*b.shape, *(1,) * (4 - b.ndim)).transpose(2, 1, 3, 0)
        none = np.zeros_like(p.delta_v)
        return cls(p.beta0, p.beta.T, b, p.delta_w, none, p.delta_v, p.x0_mean, p.x0_sd)

    @classmethod
    def coupled(cls, p: CoupledParams) -> Self:
        """Dynamics of robots that influence each other."""
        eps = 0.5 * np.linalg.eigvalsh(p.Delta_v)[:, 0]
        shared = p.Delta_v - eps[:, None, None] * np.eye(p.Delta_v.shape[-1])
        if np.allclose(shared * (1.0 - np.eye(shared.shape[-1])), 0.0):  # nothing is shared
            shared, eps = 0.0 * shared, np.einsum("dii->id", p.Delta_v)
        w, v = (np.linalg.cholesky(_regular(covariance)) for covariance in (p.Delta_w, shared))
        sd = np.sqrt(np.broadcast_to(eps, p.b.T.shape))
        matrices = (np.ascontiguousarray(np.moveaxis(m, 0, -1)) for m in (p.B0, p.B, w, v))
        B0, B, w, v = matrices
        return cls(B0, B, p.b.T[None, None], w, v, sd, p.x0_mean, p.x0_sd)

    def drift(self, z: np.ndarray, k: int) -> np.ndarray:
        """Increment of trust by bound k at awareness z (mission, robot, feature)."""
        b = self.b[k % len(self.b)]
        if self.B.ndim == 2:
            return np.tensordot(z, self.B, 1) + b
        return np.einsum("jim,maid->jad", z, self.B) + b


def _times(M: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Product with x (mission, robot, draw); M is (draw,) or (robot, robot', draw)."""
    return M * x if M.ndim == 1 else np.einsum("abd,jbd->jad", M, x)


def _regular(covariance: np.ndarray) -> np.ndarray:
    """Covariances (draw, robot, robot') made positive definite against rounding."""
    n = covariance.shape[-1]
    return covariance * (1.0 + 1e-15 * n * np.eye(n)) + 1e-300 * np.eye(n)
