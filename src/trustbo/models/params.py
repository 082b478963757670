"""Parameters of the trust models as tuples of arrays, with leading axes such as (draw,)."""

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np

from trustbo.errors import TrustboError
from trustbo.models.parameter_draws import PLACES, Numbers, ParameterDraws


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
    place: Numbers | None = None
    """Effect of each cell entered, shape (..., effect, row, col); None: there is none. The axis
    effect is of robots, or of length 1 where all share them."""
    place_bound: Numbers | None = None
    """Effect of each bound, shape (..., effect, move, row, col), moves as in `workspace.MOVES[8]`;
    None: there is none."""


class TrustParams(ParameterDraws, _Trust):
    """Parameters of the pooled model, equations (3)-(4); leading axes (...,) such as (draw,).

    Fields: beta0 (...,), beta (..., feature), b (...,), delta_w (...,), delta_v (...,),
    x0_mean and x0_sd, () or (...,), and effects of places, place (..., effect, row, col) and
    place_bound (..., effect, move, row, col), or None.
    """

    __slots__ = ()
    AXES: ClassVar = {"beta": ("feature",), **PLACES}

    def increments(self, awareness: np.ndarray) -> np.ndarray:
        """See `ParameterDraws.increments`."""
        beta = np.asarray(self.beta, dtype=float)
        if awareness.ndim == 5:
            return np.tensordot(beta, awareness, (-1, -1))
        return np.einsum("nm,nidrcm->nidrc", beta, awareness)


class RobotParams(ParameterDraws, _Trust):
    """Parameters of robots with separate coefficients and no influence on each other.

    Fields: beta0 (..., robot), beta (..., robot, feature), b, delta_w and delta_v (..., robot),
    x0_mean, x0_sd, place and place_bound as in `TrustParams`.
    """

    __slots__ = ()
    BY_ROBOT: ClassVar = True
    AXES: ClassVar = {
        "beta": ("robot", "feature"),
        "beta0": ("robot",),
        "b": ("robot",),
        "delta_w": ("robot",),
        "delta_v": ("robot",),
        **PLACES,
    }

    def increments(self, awareness: np.ndarray) -> np.ndarray:
        """See `ParameterDraws.increments`."""
        return np.einsum("...im,...idrcm->...idrc", np.asarray(self.beta, dtype=float), awareness)


class _Deviation(ParameterDraws):
    """Methods of parameters under which what lasts is the deviation from expected trust.

    x_k = u_k + beta0 (x_{k-1} - u_{k-1}) + w_k with u_0 = E x_0: along a path, trust is carried on
    under the drift u_k - beta0 u_{k-1}. Its expectation is u_k, without memory.
    """

    __slots__ = ()

    def expected_transition(self, n_robots: int) -> np.ndarray:
        """See `ParameterDraws.expected_transition`."""
        return np.zeros_like(self.transition(n_robots))

    def with_drift(self, awareness: np.ndarray) -> "TrustParams | RobotParams":
        """See `ParameterDraws.with_drift`: what is carried on, with the drift as the intercept."""
        p = cast(Any, self)
        b, beta0 = np.asarray(p.b), p.beta0.reshape(len(p.beta0), 1, 1, -1)
        weights = "nim" if self.BY_ROBOT else "nm"
        u = np.einsum(f"jkim,{weights}->njki", awareness, p.beta)
        u = u + (b if b.ndim == 4 else b.reshape(len(b), 1, 1, -1))
        first = np.reshape(p.x0_mean, (-1, 1, 1, 1))
        first = np.broadcast_to(first, u[:, :, :1].shape)
        u = u - beta0 * np.concatenate([first, u[:, :, :-1]], axis=2)
        carried = RobotParams if self.BY_ROBOT else TrustParams
        return carried(*p._replace(beta=np.zeros_like(p.beta), b=u))


class DeviationParams(_Deviation, TrustParams):
    """`TrustParams` with memory of the deviation from expected trust."""

    __slots__ = ()


class DeviationRobotParams(_Deviation, RobotParams):
    """`RobotParams` with memory of the deviation from expected trust."""

    __slots__ = ()


class _Coupled(NamedTuple):
    B0: Numbers
    B: Numbers
    b: Numbers
    Delta_w: Numbers
    Delta_v: Numbers
    x0_mean: Numbers = 0.5
    x0_sd: Numbers = 0.5


class CoupledParams(ParameterDraws, _Coupled):
    """Parameters of the coupled model, equations (1)-(2).

    Fields: B0 (..., robot, robot'), B (..., feature, robot, robot'), b (..., robot), the
    covariances Delta_w and Delta_v (..., robot, robot'), and x0_mean and x0_sd, () or (...,).
    """

    __slots__ = ()
    WEIGHTS: ClassVar = "B"
    BY_ROBOT: ClassVar = True
    AXES: ClassVar = {
        "B": ("feature", "robot", "robot_"),
        "B0": ("robot", "robot_"),
        "b": ("robot",),
        "Delta_w": ("robot", "robot_"),
        "Delta_v": ("robot", "robot_"),
    }

    @property
    def delta_v(self) -> np.ndarray:
        """Standard deviation of each robot's observation noise, (..., robot)."""
        return np.sqrt(np.diagonal(self.Delta_v, axis1=-2, axis2=-1))

    def transition(self, n_robots: int) -> np.ndarray:
        """See `ParameterDraws.transition`."""
        return np.asarray(self.B0, dtype=float)

    def increments(self, awareness: np.ndarray) -> np.ndarray:
        """See `ParameterDraws.increments`."""
        return np.einsum("...mai,...idrcm->...adrc", np.asarray(self.B, dtype=float), awareness)


Params = TrustParams | RobotParams | CoupledParams


def assemble_params(
    sites: Mapping[str, np.ndarray], x0: Mapping[str, float], memory: str = "level"
) -> Params:
    """Parameters from their sites by name, with leading axis (draw,), and x0_mean and x0_sd.

    `memory`: what trust carries on, see `PooledTrust`.
    """
    if "B0" in sites:
        return CoupledParams(**{name: sites[name] for name in CoupledParams._fields[:5]}, **x0)
    values = {name: sites[name] for name in TrustParams._fields[:5]}
    if sites["b"].ndim == 1:
        return (TrustParams if memory == "level" else DeviationParams)(**values, **x0)
    for name in ("beta0", "delta_w", "delta_v"):  # the hierarchical model's are shared
        values[name] = np.broadcast_to(values[name][:, None], sites["b"].shape)
    return (RobotParams if memory == "level" else DeviationRobotParams)(**values, **x0)


def check_params(params: Params, n_robots: int | None, n_features: int) -> None:
    """Refuse parameters that do not match the data; `n_robots` None leaves robots unchecked.

    TrustboError: another number of robots or features, or a covariance that is not
    symmetric and positive definite.
    """
    for field, value in params.places.items():
        if (n := value.shape[-len(PLACES[field])]) not in (1, n_robots or n):
            raise TrustboError(
                f"params.{field} is of {n} robots, but the missions have {n_robots}."
            )
    name = params.WEIGHTS
    axes, shape = params.AXES[name], np.shape(getattr(params, name))
    if len(shape) < len(axes):
        raise TrustboError(f"params.{name} must end in the axes {axes}; got shape {shape}.")
    sizes = dict(zip(axes, shape[len(shape) - len(axes) :], strict=True))
    if sizes["feature"] != n_features:
        raise TrustboError(
            f"params.{name} has {sizes['feature']} weights, but awareness has {n_features} "
            "features."
        )
    if n_robots is not None and sizes.get("robot", n_robots) != n_robots:
        raise TrustboError(
            f"params.{name} is of {sizes['robot']} robots, but the missions have {n_robots}."
        )
    for field in params.AXES.keys() - PLACES.keys():
        field_axes, value = params.AXES[field], np.asarray(getattr(params, field))
        expected = tuple(sizes[axis.strip("_")] for axis in field_axes)
        if value.shape[value.ndim - len(expected) :] != expected or value.ndim < len(expected):
            raise TrustboError(
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
