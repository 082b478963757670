"""Parameters of the trust models, as tuples of arrays with leading axes such as (draw,)."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.arrays import Names, read_labelled, require_numbers
from trustbo.display import Rows, Summary
from trustbo.errors import TrustboError
from trustbo.models.draws import Draws
from trustbo.models.robots_in_bounds import RobotsInBounds
from trustbo.statespace import StateSpace
from trustbo.statespace.form import coupled_robots, independent_robots

Numbers = Any
"""A float, a NumPy array, or a JAX array or tracer."""
PLACES: Mapping[str, tuple[str, ...]] = {
    "place": ("effect", "row", "col"),
    "place_bound": ("effect", "move", "row", "col"),
}
"""Axes of the fields that contain place effects, after the leading axes."""
_NOT_ARRAYS = ("memory", "place_robot", "robots", "features")
"""Fields that are not arrays."""


class ParameterDraws(Summary, Draws):
    """Mixin with methods common to the parameters of all built-in models."""

    __slots__ = ()

    AXES: ClassVar[Mapping[str, tuple[str, ...]]]
    """Axes of each field after the leading axes; fields that are not listed have none."""
    WEIGHTS: ClassVar[str] = "beta"
    """Name of the field that contains the feature weights."""
    SUM: ClassVar[str]
    """Subscripts of the `np.einsum` call that sums weights times awareness."""
    BY_ROBOT: ClassVar[bool] = False
    """Whether coefficients differ between robots; if so, b has the axis (robot,)."""
    place_robot: RobotsInBounds | None
    robots: Names | None
    features: Names | None
    _fields: ClassVar[tuple[str, ...]]

    def _rows(self) -> Rows:
        leading = self.leading
        rows = [("draws", f"{np.prod(leading)} draws, mean +- sd" if leading else "one draw")]
        for name, value in self.flat().by_name.items():
            rows.append((name, _written(value)))
        return rows

    @property
    def by_name(self) -> dict[str, Numbers]:
        """Arrays by name, excluding fields that are None."""
        values = {name: getattr(self, name) for name in self._fields if name not in _NOT_ARRAYS}
        return {name: value for name, value in values.items() if value is not None}

    @property
    def leading(self) -> tuple[int, ...]:
        """Shape of the leading axes, such as (draw,)."""
        shape = np.shape(getattr(self, self.WEIGHTS))
        return shape[: len(shape) - len(self.AXES[self.WEIGHTS])]

    @property
    def n_robots(self) -> int | None:
        """Number of robots; None if the parameters are the same for all robots."""
        return np.shape(self.b)[-1] if self.BY_ROBOT else None  # pyright: ignore

    @property
    def n_features(self) -> int:
        """Number of features."""
        axes = self.AXES[self.WEIGHTS]
        return np.shape(getattr(self, self.WEIGHTS))[axes.index("feature") - len(axes)]

    def state_space(self, n_robots: int, *, adds_noise: bool = True) -> StateSpace:
        """Return the model's equation at each draw, with leading axes joined to one axis.

        Args:
            n_robots: Number of robots.
            adds_noise: Whether the observation family adds noise (see `coupled_robots`).
        """
        names = ("beta0", "delta_w", "delta_v", "x0_mean", "x0_sd", "delta_s")
        values: dict[str, Any] = self._joined(names)
        if not self.carried:
            values["x0_mean"] = 0.0

        delta_s = values.pop("delta_s", None)
        n_members = 1 if delta_s is None else n_robots
        return independent_robots(**values, delta_s=delta_s, n_members=n_members)

    def _joined(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Return fields in float64 with exactly one leading axis (draw,), without None."""
        leading = self.leading
        n_draws = int(np.prod(leading))
        joined = {}
        for name in names:
            value = getattr(self, name)
            if value is None:
                continue
            value = np.asarray(value, dtype=float)

            core = value.shape[value.ndim - len(self.AXES.get(name, ())) :]
            joined[name] = np.broadcast_to(value, leading + core).reshape(n_draws, *core)

        return joined

    @property
    def carried(self) -> bool:
        """Whether the inputs of a bound are carried over to later bounds (see `statespace`)."""
        return self.memory == "level"  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def by_robot(self) -> bool:
        """See `Draws.by_robot`."""
        return self.BY_ROBOT

    @property
    def grid_shape(self) -> tuple[int, int] | None:
        """Shape (row, col) of the grid of place effects; None without place effects."""
        for effect in self.places.values():
            return effect.shape[-2:]
        return None

    def require_valid(self, n_robots: int | None = None, n_features: int | None = None) -> None:
        """See `Draws.require_valid`."""
        params: Any = self
        require_values(params)
        if n_features is not None:
            require_shapes(params, n_robots, n_features)
        require_covariances(params)

    def in_order(self, robots: Sequence[str], features: Sequence[str]) -> Self:
        """See `Draws.in_order`; fields that are labelled arrays are read by their labels.

        Parameters that all robots share apply to robots with any names.
        """
        wanted = {"robot": tuple(robots), "feature": tuple(features)}
        own = {
            "robot": self.robots or wanted["robot"],
            "feature": self.features or wanted["feature"],
        }

        params = self._without_labels(own)
        for axis, names in wanted.items():
            if own[axis] != names and not (axis == "robot" and self._is_shared):
                params = params._turned(axis, own[axis], names)
        return params._replace(robots=wanted["robot"], features=wanted["feature"])  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def _is_shared(self) -> bool:
        """Whether no field depends on the robot."""
        n_effects = [effect.shape[-len(PLACES[name])] for name, effect in self.places.items()]
        return not self.BY_ROBOT and self.place_robot is None and max(n_effects, default=1) == 1

    def _without_labels(self, names: Mapping[str, Names]) -> Self:
        """Read fields with labels, such as DataArrays, by the names of robots and features."""
        labels = {**names, "robot_": names["robot"]}
        read = {}
        for field, value in self.by_name.items():
            axes = self.AXES.get(field, ())
            if isinstance(value, xr.DataArray):
                leading = [str(dim) for dim in value.dims if dim not in axes]
            elif axes and isinstance(value, pd.Series | pd.DataFrame | Mapping):
                leading = []
            else:
                continue
            read[field] = read_labelled(f"params.{field}", value, (*leading, *axes), labels).values
        return self._replace(**read)  # pyright: ignore[reportAttributeAccessIssue]

    def _turned(self, axis: str, own: Names, names: Names) -> Self:
        """Return the parameters with the robots or features `own` in the order of `names`."""
        if sorted(own) != sorted(names):
            raise TrustboError(
                f"the parameters have the {axis}s {', '.join(own)}, not {', '.join(names)}; give "
                "parameters of the same names."
            )
        order = [own.index(name) for name in names]
        turned: dict[str, Any] = {}
        for field, value in self.by_name.items():
            axes = self.AXES.get(field, ())
            for i, one in enumerate(axes, start=-len(axes)):
                is_effect = one == "effect" and axis == "robot" and np.shape(value)[i] > 1
                if is_effect or one.removesuffix("_") == axis:
                    turned[field] = np.take(turned.get(field, value), order, axis=i)

        if axis == "robot" and self.place_robot is not None:
            known = self.place_robot.known[..., order, :]
            turned["place_robot"] = self.place_robot._replace(known=known)
        return self._replace(**turned)  # pyright: ignore[reportAttributeAccessIssue]

    def inputs(self, awareness: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
        """Compute the input u = sum_m beta_m z_m + b of bounds, with any place effects.

        See `Draws.inputs`.

        Raises:
            TrustboError: If the number of robots, features or cells does not match the parameters.
        """
        n_robots = None if self.places else len(awareness)
        require_shapes(self, n_robots, awareness.shape[-1])  # pyright: ignore[reportArgumentType]
        u = self.increments(awareness)

        axes = awareness.ndim - 2  # of bounds
        b = np.asarray(self.b, dtype=float)  # pyright: ignore[reportAttributeAccessIssue]
        if not self.BY_ROBOT:
            b = b[..., None]
        u += b.reshape(*b.shape, *(1,) * axes)  # in place, because the array may be large

        if bounds is not None:
            return u + self.of_places(bounds) if self.places else u

        for name, effect in self.places.items():
            if effect.shape[-2:] != u.shape[-2:]:
                raise TrustboError(
                    f"the effects of places ({name}) cover a grid of {effect.shape[-2:]} cells, "
                    f"but the awareness has {u.shape[-2:]}; fit the posterior to the workspace: "
                    "tb.fit(missions, workspace=workspace)."
                )
            if name == "place":  # the effect of a cell is the same for all moves that enter it
                effect = effect[..., None, :, :]
            u = u + effect

        if self.place_robot is not None:
            u = u + self.place_robot.everywhere()
        return u

    def team_inputs(self, awareness: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
        """See `Draws.team_inputs`; shared weights are applied to the robots' mean awareness."""
        if len(awareness) > 1 and not self.BY_ROBOT:
            awareness = awareness.mean(0, keepdims=True)
        return super().team_inputs(awareness, bounds)

    def increments(self, awareness: np.ndarray) -> np.ndarray:
        """Compute weighted awareness (..., robot, *bound), without the intercept.

        `awareness` has the shape (robot, *bound, feature), with any axes for bounds.
        """
        flat = awareness.reshape(len(awareness), -1, awareness.shape[-1])
        weights = np.asarray(getattr(self, self.WEIGHTS), dtype=float)
        weighted = np.einsum(self.SUM, weights, flat)
        return weighted.reshape(*weighted.shape[:-1], *awareness.shape[1:-1])

    @property
    def places(self) -> dict[str, np.ndarray]:
        """Place effects `place` and `place_bound` by name, if the model has them."""
        return {name: np.asarray(v) for name, v in self.by_name.items() if name in PLACES}

    def of_places(self, bounds: np.ndarray) -> np.ndarray:
        """Return the sum (..., effect, bound) of the effects of the entered cell and each bound.

        `bounds` (bound, 3) contains moves, rows and columns; effects of move -1 are 0.
        """
        moves, rows, cols = np.asarray(bounds).T
        total: Any = 0.0
        if "place" in self.places:
            total = total + self.places["place"][..., rows, cols]
        if "place_bound" in self.places:
            total = total + self.places["place_bound"][..., moves, rows, cols]

        total = np.where(moves < 0, 0.0, total)
        return total if self.place_robot is None else total + self.place_robot.at(bounds)

    def draw(self, index: int | np.ndarray) -> Self:
        """Select draws by index; a single index also drops the leading axis."""
        drawn = self.map(lambda value, n: np.asarray(value)[index] if np.ndim(value) > n else value)
        return drawn._with_robots(lambda robots: robots.draw(index))

    def mean(self) -> Self:
        """Average over all leading axes."""
        mean = self.flat().map(lambda value, _: value.mean(0))
        return mean._with_robots(RobotsInBounds.mean)

    def flat(self) -> Self:
        """Return every field in float64 with exactly one leading axis (draw,)."""
        flat: Self = self._replace(**self._joined(list(self.by_name)))  # pyright: ignore[reportAttributeAccessIssue]
        return flat._with_robots(RobotsInBounds.flat)

    def _with_robots(self, change: Callable[[RobotsInBounds], RobotsInBounds]) -> Self:
        """Return the parameters with changed effects of robots in bounds, if there are any."""
        if self.place_robot is None:
            return self
        return self._replace(place_robot=change(self.place_robot))  # pyright: ignore[reportAttributeAccessIssue]

    def record(self) -> dict[str, Any]:
        """See `Draws.record`; effects of robots in bounds are left out."""
        record: dict[str, Any] = {n: np.asarray(v).tolist() for n, v in self.by_name.items()}
        if not self.carried:
            record["memory"] = "deviation"
        return record

    def map(self, function: Callable[[Numbers, int], Numbers]) -> Self:
        """Apply `function(field, number of trailing axes)` to every field."""
        values = {
            name: function(value, len(self.AXES.get(name, ())))
            for name, value in self.by_name.items()
        }
        return self._replace(**values)  # pyright: ignore[reportAttributeAccessIssue]


class _Trust(NamedTuple):
    beta0: Numbers
    beta: Numbers
    b: Numbers
    delta_w: Numbers
    delta_v: Numbers
    x0_mean: Numbers = 0.5
    x0_sd: Numbers = 0.5
    place: Numbers | None = None
    place_bound: Numbers | None = None
    memory: str = "level"
    delta_s: Numbers | None = None
    place_robot: RobotsInBounds | None = None
    robots: Names | None = None
    features: Names | None = None


class TrustParams(ParameterDraws, _Trust):
    """Parameters of the pooled model, equations (3)-(4), with leading axes such as (draw,).

    Attributes:
        beta0: Autoregression coefficient, shape (...,).
        beta: Feature weights, shape (..., feature).
        b: Intercept, shape (...,).
        delta_w: Standard deviation of the process noise, shape (...,).
        delta_v: Standard deviation of the observation noise, shape (...,).
        x0_mean: Mean of trust before the first bound, shape () or (...,).
        x0_sd: Standard deviation of trust before the first bound, shape () or (...,).
        place: Effects of entered cells, shape (..., effect, row, col), or None. The axis `effect`
            runs over robots, or has length 1 if effects are common to all robots.
        place_bound: Effects of bounds, shape (..., effect, move, row, col), or None. Moves are
            ordered as in `workspace.MOVES`.
        memory: Quantity carried over between bounds, `"level"` or `"deviation"`; see `PooledTrust`.
        delta_s: Standard deviation of the noise that all robots share, shape (...,), or None.
        place_robot: Effects of robots in bounds, used in forecasts of the default model, or None.
        robots: Names of the robots, or None. Parameters of a posterior have the names of the fit,
            and planners, filters and simulators put them in the order of their workspace.
        features: Names of the features, or None.

    Example:
        >>> beta = np.array([0.1, 0.1, 0.3])  # of traversability, visibility and line of sight
        >>> truth = tb.models.TrustParams(0.5, beta, b=0.0, delta_w=0.05, delta_v=0.05)
        >>> tb.simulation.ModelSimulator(workspace, truth).run(path, seed=0).contact_rate
    """

    __slots__ = ()
    AXES: ClassVar = {"beta": ("feature",), **PLACES}

    def increments(self, awareness: np.ndarray) -> np.ndarray:
        """See `ParameterDraws.increments`."""
        return np.tensordot(np.asarray(self.beta, dtype=float), awareness, (-1, -1))


class RobotParams(ParameterDraws, _Trust):
    """Parameters of robots with separate coefficients and no influence on each other.

    The fields are those of `TrustParams`, but beta has the shape (..., robot, feature), and beta0,
    b, delta_w and delta_v have the shape (..., robot).

    Example:
        >>> beta = np.tile([0.1, 0.1, 0.3], (3, 1))  # (robot, feature)
        >>> beta[1] /= 2.0  # r2 detects less
        >>> half, noise = np.full(3, 0.5), np.full(3, 0.05)
        >>> params = tb.models.RobotParams(half, beta, np.zeros(3), noise, noise)
        >>> planner.plan(params).trust.mean(axis=0).argmin().item()
        1
    """

    __slots__ = ()
    BY_ROBOT: ClassVar = True
    AXES: ClassVar = {
        "beta": ("robot", "feature"),
        **dict.fromkeys(("beta0", "b", "delta_w", "delta_v"), ("robot",)),
        **PLACES,
    }
    SUM: ClassVar = "...im,...ikm->...ik"


class _Coupled(NamedTuple):
    B0: Numbers
    B: Numbers
    b: Numbers
    Delta_w: Numbers
    Delta_v: Numbers
    x0_mean: Numbers = 0.5
    x0_sd: Numbers = 0.5
    place: Numbers | None = None
    place_bound: Numbers | None = None
    place_robot: RobotsInBounds | None = None
    robots: Names | None = None
    features: Names | None = None


class CoupledParams(ParameterDraws, _Coupled):
    """Parameters of the coupled model, equations (1)-(2).

    The fields are B0 (..., robot, robot'), B (..., feature, robot, robot'), b (..., robot), and the
    covariances Delta_w and Delta_v (..., robot, robot'). The fields x0_mean, x0_sd, place,
    place_bound, place_robot, robots and features are the same as in `TrustParams`.

    Example:
        >>> posterior = tb.fit(missions, tb.models.CoupledTrust())
        >>> params = tb.inference.params_of(posterior)
        >>> params.B0.mean(axis=0)  # influence of each robot on each other one
    """

    __slots__ = ()
    WEIGHTS: ClassVar = "B"
    SUM: ClassVar = "...mai,...ikm->...ak"
    memory: ClassVar = "level"
    BY_ROBOT: ClassVar = True
    AXES: ClassVar = {
        "B": ("feature", "robot", "robot_"),
        "b": ("robot",),
        **dict.fromkeys(("B0", "Delta_w", "Delta_v"), ("robot", "robot_")),
        **PLACES,
    }

    @property
    def delta_v(self) -> np.ndarray:
        """Standard deviation (..., robot) of each robot's observation noise."""
        return np.sqrt(np.diagonal(self.Delta_v, axis1=-2, axis2=-1))

    def state_space(self, n_robots: int, *, adds_noise: bool = True) -> StateSpace:
        """See `ParameterDraws.state_space`."""
        values = self._joined(("B0", "Delta_w", "Delta_v", "x0_mean", "x0_sd"))
        return coupled_robots(**values, adds_noise=adds_noise)


Params = TrustParams | RobotParams | CoupledParams

COUPLED_NAMES = CoupledParams._fields[:5]
"""Parameters of the coupled model, excluding x0 and place effects."""
_POOLED_NAMES = TrustParams._fields[:5]

_MOST_SHOWN = 6  # largest number of values that a summary shows; longer fields are shown as a range


def assemble_params(
    parameters: Mapping[str, np.ndarray], x0: Mapping[str, Any], memory: str = "level"
) -> Params:
    """Build parameters from variables (draw, ...) by name, and from x0_mean and x0_sd.

    `memory` is the quantity carried over between bounds; see `PooledTrust`.
    """
    if "B0" in parameters:
        return CoupledParams(**{name: parameters[name] for name in COUPLED_NAMES}, **x0)

    values: dict[str, Any] = {name: parameters[name] for name in _POOLED_NAMES}
    values["delta_s"] = parameters.get("delta_s")
    if parameters["b"].ndim == 1:
        return TrustParams(**values, **x0, memory=memory)

    for name in ("beta0", "delta_w", "delta_v"):  # robots share these in the hierarchical model
        values[name] = np.broadcast_to(values[name][:, None], parameters["b"].shape)
    return RobotParams(**values, **x0, memory=memory)


def require_values(params: Params) -> None:
    """Raise TrustboError for a value that is not a number, is infinite or exceeds 1e12.

    Place effects may be NaN where a map has no bound.
    """
    for field, value in params.by_name.items():
        require_numbers(f"params.{field}", value, missing=field in PLACES)


def require_covariances(params: Params) -> None:
    """Raise TrustboError for a covariance that is not symmetric and positive definite."""
    for field in params.by_name:
        if not field.startswith("Delta"):
            continue

        value = np.asarray(getattr(params, field))
        same = np.allclose(value, np.swapaxes(value, -1, -2), rtol=1e-8, atol=1e-12)
        if not (same and np.linalg.eigvalsh(value).min() > 0.0):
            raise TrustboError(
                f"params.{field} must be symmetric and positive definite; got {value!r}."
            )


def require_shapes(params: Params, n_robots: int | None, n_features: int) -> None:
    """Raise TrustboError unless shapes match `n_features` and, if it is not None, `n_robots`."""
    n = params.n_robots if n_robots is None else n_robots
    sizes = {"feature": {n_features}, "robot": {n}, "robot_": {n}, "effect": {1, n}}

    for field, axes in params.AXES.items():
        if getattr(params, field) is None:
            continue

        value = np.asarray(getattr(params, field))
        ends = dict(zip(axes, value.shape[-len(axes) :], strict=False))
        wrong = [axis for axis, size in ends.items() if size not in sizes.get(axis, {size})]
        if len(ends) < len(axes) or (wrong and (n is not None or "feature" in wrong)):
            raise TrustboError(
                f"params.{field} must end in the axes {axes}, with {n_features} features "
                f"and {n or 'any number of'} robots; got the shape {value.shape}."
            )


def _written(draws: np.ndarray) -> str:
    """Format the mean and standard deviation of a field (draw, ...) over draws."""
    mean = draws.mean(0)
    if mean.size > _MOST_SHOWN:
        return f"{mean.shape}, {mean.min():.3g} to {mean.max():.3g}"
    if len(draws) == 1:
        return ", ".join(f"{m:.3g}" for m in np.ravel(mean))

    sd = draws.std(0)
    moments = zip(np.ravel(mean), np.ravel(sd), strict=True)
    return ", ".join(f"{m:.3g} +- {s:.2g}" for m, s in moments)
