"""Parameters of the trust models as tuples of arrays, with leading axes such as (draw,)."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Self

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax import Array

from trustbo.data import Cell
from trustbo.display.card import Card, Displayed
from trustbo.errors import ShapeError, TrustboError
from trustbo.models.drift_form import Drift, find_drift
from trustbo.models.likelihood.live import ApartFilter, CoupledFilter, DriftFilter
from trustbo.models.likelihood.scalar import ScalarSSM
from trustbo.models.likelihood.vector import VectorSSM
from trustbo.models.place_maps import place_maps_of
from trustbo.workspace.moves import bounds_along

Numbers = Any
"""A float, a NumPy array, or a JAX array or tracer."""


_PLACES: Mapping[str, tuple[str, ...]] = {
    "place": ("effect", "row", "col"),
    "place_bound": ("effect", "move", "row", "col"),
}


class _Draws(Displayed):
    """Methods of parameters of every kind; mixed into their tuples."""

    __slots__ = ()

    AXES: ClassVar[Mapping[str, tuple[str, ...]]]
    """Axes of each field behind the leading ones; none where not listed."""
    WEIGHTS: ClassVar[str] = "beta"
    """Name of the field with the weights of features."""
    _fields: ClassVar[tuple[str, ...]]

    def _card(self) -> Card:
        n = int(np.prod(self.leading))
        many = f"{n} draws, mean +- sd" if self.leading else "one draw"
        rows: list[tuple[str, str]] = []

        def add(value: Numbers, n_own: int) -> Numbers:
            numbers = np.asarray(value, dtype=float)
            flat = numbers.reshape(-1, *numbers.shape[numbers.ndim - n_own :])
            rows.append((names[len(rows)], _written(flat)))
            return value

        names = list(self.by_name)

        self.map(add)
        return Card(f"{type(self).__name__}: {many}", rows)

    @property
    def by_name(self) -> dict[str, Numbers]:
        """Values by name, those of a drift among them; fields that are None left out."""
        found: dict[str, Numbers] = {}
        for name in self._fields:
            value = getattr(self, name)
            found |= dict(value.theta) if isinstance(value, Drift) else {name: value}
        return {name: value for name, value in found.items() if value is not None}

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
        for name, value in self.places.items():
            own = slice(robot, robot + 1) if value.shape[-len(self.AXES[name])] > 1 else slice(None)
            picked[name] = np.moveaxis(np.moveaxis(value, -len(self.AXES[name]), 0)[own], 0,
                                       -len(self.AXES[name]))  # fmt: skip
        return self._replace(**picked)  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def places(self) -> dict[str, np.ndarray]:
        """Effects of places there are, place and place_bound, by name."""
        found = {name: getattr(self, name, None) for name in _PLACES}
        return {name: np.asarray(value) for name, value in found.items() if value is not None}

    def of_places(self, bounds: np.ndarray) -> np.ndarray:
        """Effect of each bound, its cell's and its own; shape (..., bound, effect).

        Args:
            bounds: Move, row and column of each bound (bound, 3), moves as in `MOVES[8]`; the
                effect is 0 where the move is negative.
        """
        moves, rows, cols = np.asarray(bounds).T
        total: Any = 0.0
        if "place" in self.places:
            total = total + self.places["place"][..., rows, cols]
        if "place_bound" in self.places:
            total = total + self.places["place_bound"][..., moves, rows, cols]
        return np.swapaxes(np.where(moves < 0, 0.0, total), -1, -2)

    def along(self, path: Sequence[Cell] | np.ndarray) -> Self:
        """Parameters of the bounds of a path, as of one mission in `on`."""
        if not self.places:
            return self
        return self.on(bounds_along(path)[None])

    def on(self, bounds: np.ndarray | None) -> Self:
        """Parameters of given missions: the effects of their bounds' places are in the intercept.

        Args:
            bounds: Move, row and column of each bound, (mission, bound, 3).

        Returns:
            Parameters without places, b (..., mission, bound, robot), the last axis of length 1
            where all robots share it; the same parameters where there are no places.
        """
        if not self.places or bounds is None:
            return self
        effect = self.of_places(bounds.reshape(-1, 3))
        effect = effect.reshape(*effect.shape[:-2], *bounds.shape[:2], effect.shape[-1])
        b = np.asarray(self.b)  # pyright: ignore[reportAttributeAccessIssue]
        b = b[..., None, None, None] if self.n_robots is None else b[..., None, None, :]
        return self._replace(b=b + effect, place=None, place_bound=None)  # pyright: ignore

    def with_drift(self, awareness: np.ndarray) -> "Params":
        """Parameters of given missions whose drift is linear in awareness, or an intercept.

        Awareness is (mission, bound, robot, feature), leading axes of the parameters (draw,).
        """
        return self  # pyright: ignore[reportReturnType]

    def draw(self, index: int) -> Self:
        """One draw out of many, with its leading axis dropped."""
        return self.map(lambda value, n: np.asarray(value)[index] if np.ndim(value) > n else value)

    def mean(self) -> Self:
        """Mean over all leading axes."""

        def average(value: Numbers, n: int) -> Numbers:
            core = np.shape(value)[np.ndim(value) - n :]
            mean = np.asarray(value, dtype=float).reshape(-1, *core).mean(0)
            return mean if n else float(mean)

        return self.map(average)

    def flat(self) -> Self:
        """Every field with exactly one leading axis (draw,), float64."""
        leading = self.leading

        def expand(value: Numbers, n: int) -> np.ndarray:
            core = np.shape(value)[np.ndim(value) - n :]
            full = np.broadcast_to(np.asarray(value, dtype=float), leading + core)
            return full.reshape(int(np.prod(leading)), *core)

        return self.map(expand)

    def _size(self, name: str, axis: str) -> int | None:
        axes = self.AXES.get(name, ())
        return np.shape(getattr(self, name))[axes.index(axis) - len(axes)] if axis in axes else None

    def map(self, function: Callable[[Numbers, int], Numbers]) -> Self:
        """The same with a function of each field and the number of its own axes in its place."""
        core = {name: len(self.AXES.get(name, ())) for name in self._fields}
        values = {
            name: value.map(function) if isinstance(value, Drift) else function(value, n)
            for name, n in core.items()
            if (value := getattr(self, name)) is not None
        }
        return self._replace(**values)  # pyright: ignore[reportAttributeAccessIssue]


def _written(draws: np.ndarray) -> str:
    """Mean and sd over draws (draw, ...) of a field: of each number, or of many together."""
    mean, sd = draws.mean(0), draws.std(0)
    if mean.size > 6:
        return f"{mean.shape}, {mean.min():.3g} to {mean.max():.3g}"
    spread = zip(np.ravel(mean), np.ravel(sd), strict=True)
    return ", ".join(f"{m:.3g}" + (f" +- {s:.2g}" if len(draws) > 1 else "") for m, s in spread)


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


class TrustParams(_Draws, _Trust):
    """Parameters of the pooled model, equations (3)-(4); leading axes (...,) such as (draw,).

    Fields: beta0 (...,), beta (..., feature), b (...,), delta_w (...,), delta_v (...,),
    x0_mean and x0_sd, () or (...,), and effects of places, place (..., effect, row, col) and
    place_bound (..., effect, move, row, col), or None.
    """

    __slots__ = ()
    AXES: ClassVar = {"beta": ("feature",), **_PLACES}

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

    Fields: beta0 (..., robot), beta (..., robot, feature), b, delta_w and delta_v (..., robot),
    x0_mean, x0_sd, place and place_bound as in `TrustParams`.
    """

    __slots__ = ()
    AXES: ClassVar = {
        "beta": ("robot", "feature"),
        "beta0": ("robot",),
        "b": ("robot",),
        "delta_w": ("robot",),
        "delta_v": ("robot",),
        **_PLACES,
    }

    def ssm(self, awareness: Array, lag: float = 0.0) -> ScalarSSM:
        """The state space of missions with awareness (mission, bound, robot, feature)."""
        drift = jnp.swapaxes(jnp.einsum("jkim,im->jki", awareness, self.beta) + self.b, 0, 1)
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


class _OwnDrift(NamedTuple):
    beta0: Numbers
    drift: Drift
    delta_w: Numbers
    delta_v: Numbers
    x0_mean: Numbers = 0.5
    x0_sd: Numbers = 0.5
    b: Numbers = 0.0
    place: Numbers | None = None
    place_bound: Numbers | None = None


class DriftParams(_Draws, _OwnDrift):
    """Parameters of `DriftTrust`; made by its `params`.

    Fields: beta0 (...,), the drift with its own parameters, delta_w and delta_v (...,), x0_mean,
    x0_sd, place and place_bound as in `TrustParams`; b is 0, for effects of places to enter by.
    """

    __slots__ = ()
    AXES: ClassVar = {"beta0": (), **_PLACES}

    @property
    def n_features(self) -> int:
        """Number of features."""
        return self.drift.n_features

    def ssm(self, awareness: Array, lag: float = 0.0) -> ScalarSSM:
        """The state space of missions with awareness (mission, bound, robot, feature)."""
        drift = jnp.swapaxes(self.drift.at(awareness) + self.b, 0, 1)
        p = self
        return ScalarSSM(p.beta0, drift, p.delta_w, p.delta_v, p.x0_mean, p.x0_sd, lag)

    def live(self, lag: float, n_robots: int) -> ApartFilter:
        """One bound of the Kalman filter; the leading axis is (draw,)."""
        return DriftFilter(self, lag, n_robots)

    def with_drift(self, awareness: np.ndarray) -> "TrustParams":
        """See `_Draws.with_drift`: the drift of each bound is its intercept."""
        n_draws, n_features = len(self.beta0), awareness.shape[-1]
        u = self.drift.values(awareness.reshape(-1, *awareness.shape[2:]), many=True)
        u = u.reshape(n_draws, *awareness.shape[:3])
        b = np.asarray(self.b)
        known = {
            name: getattr(self, name)
            for name in ("beta0", "delta_w", "delta_v", "x0_mean", "x0_sd")
        }
        zero = np.zeros((n_draws, n_features))
        return TrustParams(beta=zero, b=u + (b if b.ndim == 4 else b[:, None, None, None]), **known)


Params = TrustParams | RobotParams | CoupledParams | DriftParams


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
        `TrustParams`, `RobotParams`, `CoupledParams` or `DriftParams`, according to the model.

    Raises:
        TrustboError: This process has made no `DriftTrust` with the drift of the posterior.
    """
    draws = posterior["posterior"].to_dataset().stack(sample=("chain", "draw"))
    # In one layout, whether they were just sampled or read from a file: sums over draws then round
    # alike, and a campaign that resumes is the campaign it was.
    sites = {
        str(n): np.ascontiguousarray(draws[n].transpose("sample", ...).values)
        for n in draws.data_vars
    }
    params = params_from(sites, posterior.attrs)
    if "places" not in posterior.children:
        return params
    return params._replace(**place_maps_of(posterior["places"].to_dataset(), sites))  # pyright: ignore


def params_from(sites: Mapping[str, np.ndarray], about: Mapping[Any, Any]) -> Params:
    """Parameters from draws by name, leading axis (draw,), and the attributes of a posterior.

    TrustboError: they are of a drift that is not known here.
    """
    x0 = {name: about[name] for name in ("x0_mean", "x0_sd")}
    if "drift" not in about:
        return assemble_params(sites, x0)
    shared = {name: sites[name] for name in ("beta0", "delta_w", "delta_v")}
    return DriftParams(drift=find_drift(about, sites), **shared, **x0)


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
    _check_places(params, n_robots)
    if isinstance(params, DriftParams):
        params.drift.require(n_robots, n_features)
        return
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
    for field in params.AXES.keys() - _PLACES.keys():
        field_axes, value = params.AXES[field], np.asarray(getattr(params, field))
        expected = tuple(sizes[axis.strip("_")] for axis in field_axes)
        if value.shape[value.ndim - len(expected) :] != expected or value.ndim < len(expected):
            raise ShapeError(
                f"params.{field} must end in the axes {field_axes}, here {expected}; got shape "
                f"{value.shape}."
            )
        if field.startswith("Delta"):
            _require_covariance(f"params.{field}", value)


def _check_places(params: Params, n_robots: int | None) -> None:
    for field, value in params.places.items():
        if (n := value.shape[-len(_PLACES[field])]) not in (1, n_robots or n):
            raise ShapeError(f"params.{field} is of {n} robots, but the missions have {n_robots}.")


def _require_covariance(name: str, value: np.ndarray) -> None:
    if not np.allclose(value, np.swapaxes(value, -1, -2), rtol=1e-8, atol=1e-12):
        raise TrustboError(f"{name} must be symmetric; got {value!r}.")
    smallest = np.linalg.eigvalsh(value).min()
    if not smallest > 0.0:
        raise TrustboError(
            f"{name} must be positive definite; its smallest eigenvalue is {smallest:.3g}. Robots "
            "cannot be perfectly correlated, nor have no noise at all."
        )
