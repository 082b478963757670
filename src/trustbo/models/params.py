"""Parameters of the trust models as tuples of arrays, with leading axes such as (draw,)."""

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, Self

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax import Array

from trustbo.errors import ShapeError, TrustboError
from trustbo.models.likelihood.live import ApartFilter, CoupledFilter
from trustbo.models.likelihood.scalar import ScalarSSM
from trustbo.models.likelihood.vector import VectorSSM

Numbers = Any
"""A float, a NumPy array, or a JAX array or tracer."""


class _Draws:
    """Methods of parameters of every kind; mixed into their tuples."""

    AXES: ClassVar[Mapping[str, tuple[str, ...]]]
    """Axes of each field behind the leading ones; none where not listed."""
    WEIGHTS: ClassVar[str] = "beta"
    """Name of the field with the weights of features."""
    _fields: ClassVar[tuple[str, ...]]

    @property
    def leading(self) -> tuple[int, ...]:
        """The leading axes, (draw,) or none."""
        name = next(iter(self.AXES))
        shape = np.shape(getattr(self, name))
        return shape[: len(shape) - len(self.AXES[name])]

    @property
    def n_robots(self) -> int | None:
        """Number of robots; None where all share their parameters."""
        return self._size("b", "robot")

    @property
    def n_features(self) -> int:
        """Number of features."""
        return self._size(self.WEIGHTS, "feature") or 0

    def alike(self, n_robots: int) -> list[list[int]]:
        """Groups of robots that share their parameters."""
        everyone = list(range(n_robots))
        return [everyone] if self.n_robots is None else [[i] for i in everyone]

    def of_robot(self, robot: int) -> Self:
        """Parameters of one robot, the axis (robot,) dropped."""
        picked = {
            name: np.take(getattr(self, name), robot, axis=axes.index("robot") - len(axes))
            for name, axes in self.AXES.items()
            if "robot" in axes
        }
        return self._replace(**picked)  # pyright: ignore[reportAttributeAccessIssue]

    def draw(self, index: int) -> Self:
        """One draw out of many, with its leading axis dropped."""
        return self._map(lambda value, n: np.asarray(value)[index] if np.ndim(value) > n else value)

    def mean(self) -> Self:
        """Mean over all leading axes."""

        def average(value: Numbers, n: int) -> Numbers:
            core = np.shape(value)[np.ndim(value) - n :]
            mean = np.asarray(value, dtype=float).reshape(-1, *core).mean(0)
            return mean if n else float(mean)

        return self._map(average)

    def flat(self) -> Self:
        """Every field with exactly one leading axis (draw,), float64."""
        leading = self.leading

        def expand(value: Numbers, n: int) -> np.ndarray:
            core = np.shape(value)[np.ndim(value) - n :]
            full = np.broadcast_to(np.asarray(value, dtype=float), leading + core)
            return full.reshape(int(np.prod(leading)), *core)

        return self._map(expand)

    def _size(self, name: str, axis: str) -> int | None:
        axes = self.AXES.get(name, ())
        return np.shape(getattr(self, name))[axes.index(axis) - len(axes)] if axis in axes else None

    def _map(self, function: Any) -> Self:
        core = {name: len(self.AXES.get(name, ())) for name in self._fields}
        values = {name: function(getattr(self, name), n) for name, n in core.items()}
        return self._replace(**values)  # pyright: ignore[reportAttributeAccessIssue]


class _Trust(NamedTuple):
    beta0: Numbers
    """Autoregression, shape (...,)."""
    beta: Numbers
    """Weights, shape (..., feature)."""
    b: Numbers
    """Intercept, shape (...,)."""
    delta_w: Numbers
    """Standard deviation of the process noise, shape (...,)."""
    delta_v: Numbers
    """Standard deviation of the observation noise, shape (...,)."""
    x0_mean: Numbers = 0.5
    """Mean of trust before the first bound, shape () or (...,)."""
    x0_sd: Numbers = 0.5
    """Its standard deviation, shape () or (...,)."""


class TrustParams(_Draws, _Trust):
    """Parameters of the pooled model, equations (3)-(4); leading axes (...,) such as (draw,).

    Fields: beta0 (...,), beta (..., feature), b (...,), delta_w (...,), delta_v (...,), and
    x0_mean and x0_sd, () or (...,).
    """

    __slots__ = ()
    AXES: ClassVar = {"beta": ("feature",)}

    def ssm(self, awareness: Array, lag: float = 0.0) -> ScalarSSM:
        """The state space of missions with awareness (mission, bound, robot, feature)."""
        drift = jnp.swapaxes(awareness @ self.beta + self.b, 0, 1)
        p = self
        return ScalarSSM(p.beta0, drift, p.delta_w, p.delta_v, p.x0_mean, p.x0_sd, lag)

    def live(self, lag: float, n_robots: int) -> ApartFilter:
        """One bound of the Kalman filter; the leading axis is (draw,)."""
        return ApartFilter(self, lag, n_robots)


class RobotParams(_Draws, _Trust):
    """Parameters of robots with coefficients of their own, that do not influence each other.

    Fields: beta0 (..., robot), beta (..., robot, feature), b, delta_w and delta_v (..., robot), and
    x0_mean and x0_sd, () or (...,).
    """

    __slots__ = ()
    AXES: ClassVar = {
        "beta": ("robot", "feature"),
        "beta0": ("robot",),
        "b": ("robot",),
        "delta_w": ("robot",),
        "delta_v": ("robot",),
    }

    def ssm(self, awareness: Array, lag: float = 0.0) -> ScalarSSM:
        """The state space of missions with awareness (mission, bound, robot, feature)."""
        drift = jnp.einsum("jkim,im->kji", awareness, self.beta) + jnp.reshape(self.b, (1, 1, -1))
        p = self
        return ScalarSSM(p.beta0, drift, p.delta_w, p.delta_v, p.x0_mean, p.x0_sd, lag)

    def live(self, lag: float, n_robots: int) -> ApartFilter:
        """One bound of the Kalman filter; the leading axis is (draw,)."""
        return ApartFilter(self, lag, n_robots)


class _Coupled(NamedTuple):
    B0: Numbers
    B: Numbers
    b: Numbers
    Delta_w: Numbers
    Delta_v: Numbers
    x0_mean: Numbers = 0.5
    x0_sd: Numbers = 0.5


class CoupledParams(_Draws, _Coupled):
    """Parameters of the coupled model, equations (1)-(2).

    Fields: B0 (..., robot, robot'), B (..., feature, robot, robot'), b (..., robot), the
    covariances Delta_w and Delta_v (..., robot, robot'), and x0_mean and x0_sd, () or (...,).
    """

    __slots__ = ()
    WEIGHTS: ClassVar = "B"
    AXES: ClassVar = {
        "B": ("feature", "robot", "robot_"),
        "B0": ("robot", "robot_"),
        "b": ("robot",),
        "Delta_w": ("robot", "robot_"),
        "Delta_v": ("robot", "robot_"),
    }

    def ssm(self, awareness: Array, lag: float = 0.0) -> VectorSSM:
        """The state space of missions with awareness (mission, bound, robot, feature)."""
        drift = jnp.einsum("jkim,mai->kja", awareness, self.B) + jnp.reshape(self.b, (1, 1, -1))
        p = self
        return VectorSSM(p.B0, drift, p.Delta_w, p.Delta_v, p.x0_mean, p.x0_sd, lag)

    def live(self, lag: float, n_robots: int) -> CoupledFilter:
        """One bound of the Kalman filter; the leading axis is (draw,)."""
        return CoupledFilter(self, lag, n_robots)


Params = TrustParams | RobotParams | CoupledParams


def ordered_params(sites: Mapping[str, Numbers], x0_mean: Numbers, x0_sd: Numbers) -> CoupledParams:
    """The coupled form of robots in order, each following the one before it at the same bound.

    x_i^k = beta0_i x_i^{k-1} + gamma_i x_{i-1}^k + sum_m beta_{i,m} z_{i,m}^k + b_i + w_i, hence
    x^k = T (diag(beta0) x^{k-1} + ... + w) with T = (I - G)^-1, gamma on G's lower off-diagonal.
    Sites: beta0 (..., robot), beta (..., robot, feature), gamma (..., robot - 1), b, delta_w and
    delta_v (..., robot); x0_mean and x0_sd of trust before the first bound.
    """
    xp = np if isinstance(sites["gamma"], np.ndarray) else jnp
    gamma, beta = sites["gamma"], sites["beta"]
    n = gamma.shape[-1] + 1
    eye = xp.eye(n)
    lower = (gamma[..., None] * xp.eye(n - 1))[..., :, :]
    G = xp.pad(lower, [(0, 0)] * (gamma.ndim - 1) + [(1, 0), (0, 1)])
    T = xp.linalg.inv(xp.broadcast_to(eye, G.shape) - G)
    column = xp.swapaxes(T, -1, -2)
    weights = T[..., None, :, :] * xp.swapaxes(beta, -1, -2)[..., :, None, :]
    return CoupledParams(
        B0=T * sites["beta0"][..., None, :],
        B=weights,
        b=(T @ sites["b"][..., None])[..., 0],
        Delta_w=(T * sites["delta_w"][..., None, :] ** 2) @ column,
        Delta_v=sites["delta_v"][..., None] ** 2 * xp.broadcast_to(eye, G.shape),
        x0_mean=x0_mean,
        x0_sd=x0_sd,
    )


def params_of(posterior: xr.DataTree) -> Params:
    """All draws of a posterior as parameters, chains joined: leading axis (draw,).

    Args:
        posterior: DataTree from `fit`.

    Returns:
        `TrustParams`, `RobotParams` or `CoupledParams`, according to the model.
    """
    draws = posterior["posterior"].to_dataset().stack(sample=("chain", "draw"))
    # In one layout, whether they were just sampled or read from a file: sums over draws then round
    # alike, and a campaign that resumes is the campaign it was.
    sites = {
        str(n): np.ascontiguousarray(draws[n].transpose("sample", ...).values)
        for n in draws.data_vars
    }
    return assemble_params(sites, {name: posterior.attrs[name] for name in ("x0_mean", "x0_sd")})


def assemble_params(sites: Mapping[str, np.ndarray], x0: Mapping[str, float]) -> Params:
    """Parameters from their sites by name, with leading axis (draw,), and x0_mean and x0_sd."""
    if "gamma" in sites:
        return ordered_params(sites, **x0)
    if "B0" in sites:
        return CoupledParams(**{name: sites[name] for name in CoupledParams._fields[:5]}, **x0)
    values = {name: sites[name] for name in TrustParams._fields[:5]}
    if sites["beta0"].ndim == 1:
        return TrustParams(**values, **x0)
    for name in ("delta_w", "delta_v"):  # the hierarchical model's are shared
        values[name] = values[name].reshape(len(values[name]), -1)
        values[name] = np.broadcast_to(values[name], sites["beta0"].shape)
    return RobotParams(**values, **x0)


def check_params(params: Params, n_robots: int | None, n_features: int) -> None:
    """Refuse parameters that do not match the data; `n_robots` None leaves robots unchecked.

    ShapeError: another number of robots or features. TrustboError: a covariance that is not
    symmetric and positive definite.
    """
    name = params.WEIGHTS
    axes, shape = params.AXES[name], np.shape(getattr(params, name))
    if len(shape) < len(axes):
        raise ShapeError(f"params.{name} must end in the axes {axes}; got shape {shape}.")
    sizes = dict(zip(axes, shape[len(shape) - len(axes) :], strict=True))
    if sizes["feature"] != n_features:
        raise ShapeError(
            f"params.{name} has {sizes['feature']} weights, but awareness has {n_features} "
            "features."
        )
    if "robot" not in sizes:
        return
    if n_robots is not None and sizes["robot"] != n_robots:
        raise ShapeError(
            f"params.{name} is of {sizes['robot']} robots, but the missions have {n_robots}."
        )
    for field, field_axes in params.AXES.items():
        value = np.asarray(getattr(params, field))
        expected = tuple(sizes[axis.strip("_")] for axis in field_axes)
        if value.shape[value.ndim - len(expected) :] != expected or value.ndim < len(expected):
            raise ShapeError(
                f"params.{field} must end in the axes {field_axes}, here {expected}; got shape "
                f"{value.shape}."
            )
        if field.startswith("Delta"):
            _require_covariance(f"params.{field}", value)


def _require_covariance(name: str, value: np.ndarray) -> None:
    if not np.allclose(value, np.swapaxes(value, -1, -2), rtol=1e-8, atol=1e-12):
        raise TrustboError(f"{name} must be symmetric; got {value!r}.")
    smallest = np.linalg.eigvalsh(value).min()
    if not smallest > 0.0:
        raise TrustboError(
            f"{name} must be positive definite; its smallest eigenvalue is {smallest:.3g}. Robots "
            "cannot be perfectly correlated, nor have no noise at all."
        )
