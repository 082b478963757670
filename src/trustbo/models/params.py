"""Parameters of the trust models with the symbols of the paper, as users give and read them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
import xarray as xr

from trustbo.arrays import Names, as_names, read_labelled, require_numbers
from trustbo.errors import TrustboError, require_choice
from trustbo.models.draws import PLACES, Draws
from trustbo.models.families import FAMILIES
from trustbo.models.robots_in_bounds import RobotsInBounds

Numbers = Any
"""A number or an array of numbers, which may have labels."""

COUPLED_DIMS: Mapping[str, tuple[str, ...]] = {
    "B0": ("robot", "robot_"),
    "B": ("feature", "robot", "robot_"),
    "b": ("robot",),
    "Delta_w": ("robot", "robot_"),
    "Delta_v": ("robot", "robot_"),
}
"""Axes of the parameters of the coupled model."""


class LinearParams(Draws):
    """Parameters of a model whose inputs are linear in awareness."""

    dims: ClassVar[Mapping[str, tuple[str, ...]]]
    """Axes of each parameter after (draw,); parameters that are not listed have none."""

    def _set(
        self,
        values: Mapping[str, Numbers],
        place_robot: RobotsInBounds | None,
        robots: Sequence[str] | None,
        features: Sequence[str] | None,
        family: str,
        memory: str = "level",
    ) -> None:
        """Read the arguments of a subclass; values that are None are left out.

        Raises:
            TrustboError: If a value is not a number, is infinite or exceeds 1e12, if sizes, labels
                or names differ, or if the family is unknown. Effects of places may be NaN where a
                map has no bound.
        """
        require_choice("family", family, FAMILIES)
        own_robots = as_names("robots", robots or ()) or None
        own_features = as_names("features", features or ()) or None
        names = {"robot": own_robots, "robot_": own_robots, "feature": own_features}
        given = {name: value for name, value in values.items() if value is not None}
        arrays = _arrays_of(given, self.dims, names)
        Draws.__init__(self, arrays, None, place_robot, own_robots, own_features, memory, family)

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments that make these parameters."""
        others = ("place_robot", "robots", "features", "family")
        return {**self.arrays, **{name: getattr(self, name) for name in others}}

    def replace(self, **changes: Any) -> Self:
        """Return the parameters with other values of some arguments.

        Example:
            >>> forgetful = params.replace(beta0=0.0)
        """
        return type(self)(**(self.arguments | changes))


@dataclass(frozen=True, init=False, eq=False, repr=False)
class TrustParams(LinearParams):
    """Parameters of the pooled model, equations (3)-(4).

    Each parameter is one number or array, or has the leading axis (draw,). It can be read by name,
    always with this axis.

    Args:
        beta0: Autoregression coefficient.
        beta: Feature weights, shape (feature,) or (draw, feature).
        b: Intercept.
        delta_w: Standard deviation of the process noise.
        delta_v: Standard deviation of the observation noise.
        x0_mean: Mean of trust before the first bound.
        x0_sd: Standard deviation of trust before the first bound.
        place: Effects of entered cells, shape (..., effect, row, col), or None. The axis `effect`
            runs over robots, or has length 1 if effects are common to all robots.
        place_bound: Effects of bounds, shape (..., effect, move, row, col), or None. Moves are
            ordered as in `workspace.MOVES`.
        memory: Quantity carried over between bounds, `"level"` or `"deviation"`; see `PooledTrust`.
        delta_s: Standard deviation of the noise that all robots share, or None.
        place_robot: Effects of robots in bounds, used in forecasts of the default model, or None.
        robots: Names of the robots, or None. Parameters of a posterior have the names of the fit,
            and planners, filters and simulators put them in the order of their workspace.
        features: Names of the features, or None.
        f_v: Floor of the scale of the observation noise (see `Priors.f_v`), or None for noise that
            is the same in all bounds. Predictions of rates then need names of features, of which
            one is line of sight.
        family: Observation family of the contact rates, `"gaussian"`, `"censored"` or
            `"beta_binomial"`; see `PooledTrust`. Parameters of a posterior have that of its model.

    Raises:
        TrustboError: If a value is not a number, is infinite or exceeds 1e12, if sizes or names
            differ, or if the family is unknown. An array with labels needs the names `robots` or
            `features`.

    Example:
        >>> beta = np.array([0.1, 0.1, 0.3])  # of traversability, visibility and line of sight
        >>> truth = tb.models.TrustParams(0.5, beta, b=0.0, delta_w=0.05, delta_v=0.05)
        >>> tb.simulation.ModelSimulator(workspace, truth).run(path, seed=0).contact_rate
    """

    dims: ClassVar = {"beta": ("feature",), **PLACES}

    def __init__(
        self,
        beta0: Numbers,
        beta: Numbers,
        b: Numbers,
        delta_w: Numbers,
        delta_v: Numbers,
        x0_mean: Numbers = 0.5,
        x0_sd: Numbers = 0.5,
        place: Numbers | None = None,
        place_bound: Numbers | None = None,
        memory: str = "level",
        delta_s: Numbers | None = None,
        place_robot: RobotsInBounds | None = None,
        robots: Sequence[str] | None = None,
        features: Sequence[str] | None = None,
        f_v: Numbers | None = None,
        family: str = "gaussian",
    ) -> None:
        values = {
            "beta0": beta0,
            "beta": beta,
            "b": b,
            "delta_w": delta_w,
            "delta_v": delta_v,
            "x0_mean": x0_mean,
            "x0_sd": x0_sd,
            "place": place,
            "place_bound": place_bound,
            "delta_s": delta_s,
            "f_v": f_v,
        }
        self._set(values, place_robot, robots, features, family, memory)

    @property
    def arguments(self) -> dict[str, Any]:
        """See `LinearParams.arguments`."""
        return super().arguments | {"memory": self.memory}


@dataclass(frozen=True, init=False, eq=False, repr=False)
class RobotParams(TrustParams):
    """Parameters of robots with separate coefficients and no influence on each other.

    The arguments are those of `TrustParams`, but beta has the shape (..., robot, feature), and
    beta0, b, delta_w and delta_v have the shape (..., robot).

    Example:
        >>> beta = np.tile([0.1, 0.1, 0.3], (3, 1))  # (robot, feature)
        >>> beta[1] /= 2.0  # r2 detects less
        >>> half, noise = np.full(3, 0.5), np.full(3, 0.05)
        >>> params = tb.models.RobotParams(half, beta, np.zeros(3), noise, noise)
        >>> planner.plan(params).trust.mean(axis=0).argmin().item()
        1
    """

    dims: ClassVar = {
        "beta": ("robot", "feature"),
        **dict.fromkeys(("beta0", "b", "delta_w", "delta_v"), ("robot",)),
        **PLACES,
    }


@dataclass(frozen=True, init=False, eq=False, repr=False)
class CoupledParams(LinearParams):
    """Parameters of the coupled model, equations (1)-(2).

    The shapes are B0 (..., robot, robot'), B (..., feature, robot, robot'), b (..., robot), and
    (..., robot, robot') for the covariances Delta_w and Delta_v. The other arguments are the same
    as those of `TrustParams`.

    Raises:
        TrustboError: As for `TrustParams`, or if a covariance is not symmetric and positive
            definite.

    Example:
        >>> posterior = tb.fit(missions, tb.models.CoupledTrust())
        >>> params = tb.inference.params_of(posterior)
        >>> params.B0.mean(axis=0)  # influence of each robot on each other one
    """

    dims: ClassVar = {**COUPLED_DIMS, **PLACES}

    def __init__(
        self,
        B0: Numbers,
        B: Numbers,
        b: Numbers,
        Delta_w: Numbers,
        Delta_v: Numbers,
        x0_mean: Numbers = 0.5,
        x0_sd: Numbers = 0.5,
        place: Numbers | None = None,
        place_bound: Numbers | None = None,
        place_robot: RobotsInBounds | None = None,
        robots: Sequence[str] | None = None,
        features: Sequence[str] | None = None,
        family: str = "gaussian",
    ) -> None:
        values = {
            "B0": B0,
            "B": B,
            "b": b,
            "Delta_w": Delta_w,
            "Delta_v": Delta_v,
            "x0_mean": x0_mean,
            "x0_sd": x0_sd,
            "place": place,
            "place_bound": place_bound,
        }
        self._set(values, place_robot, robots, features, family)
        for name in ("Delta_w", "Delta_v"):
            _require_covariance(name, self.arrays[name])


Params = TrustParams | RobotParams | CoupledParams


def assemble_params(parameters: Mapping[str, np.ndarray], **others: Any) -> Params:
    """Build parameters from variables (draw, ...) by name; `others` are further arguments."""
    if "B0" in parameters:
        others.pop("memory", None)  # is always "level"
        return CoupledParams(**{name: parameters[name] for name in COUPLED_DIMS}, **others)

    names = ("beta0", "beta", "b", "delta_w", "delta_v")
    values: dict[str, Any] = {name: parameters[name] for name in names}
    values |= {name: parameters.get(name) for name in ("delta_s", "f_v")}
    n_robots = parameters["b"].shape[1:]
    if not n_robots:
        return TrustParams(**values, **others)

    for name in ("beta0", "delta_w", "delta_v"):  # robots share these in the hierarchical model
        values[name] = np.broadcast_to(values[name][:, None], parameters["b"].shape)
    return RobotParams(**values, **others)


def _arrays_of(
    given: Mapping[str, Numbers],
    dims: Mapping[str, tuple[str, ...]],
    names: Mapping[str, Names | None],
) -> dict[str, np.ndarray]:
    """Return parameters as arrays (draw, ...)."""
    arrays = {}
    for name, value in given.items():
        what = f"params.{name}"
        axes = dims.get(name, ())
        if axes or isinstance(value, xr.DataArray):
            leading = [str(dim) for dim in getattr(value, "dims", ()) if dim not in axes]
            value = read_labelled(what, value, (*leading, *axes), names).values

        array = require_numbers(what, value, missing=name in PLACES)
        if array.ndim < len(axes):
            raise TrustboError(f"{what} must end in the axes {axes}; got the shape {array.shape}.")
        arrays[name] = array.reshape(-1, *array.shape[array.ndim - len(axes) :])

    n_draws = max(len(array) for array in arrays.values())
    for name, array in arrays.items():
        if len(array) == 1:
            arrays[name] = np.broadcast_to(array, (n_draws, *array.shape[1:]))

    # Axes of the same name must have the same length, unless effects of places are common.
    coords = {axis: list(known) for axis, known in names.items() if known and axis != "robot_"}
    variables = {}
    for name, array in arrays.items():
        axes = ["draw", *dims.get(name, ())]
        if name in PLACES:
            axes[1] = f"effect of {name}" if array.shape[1] == 1 else "robot"
        variables[name] = axes, array
    try:
        xr.Dataset(variables, coords)
    except ValueError as error:
        raise TrustboError(f"the parameters do not fit together: {error}.") from None
    return arrays


def _require_covariance(name: str, value: np.ndarray) -> None:
    """Raise TrustboError for a covariance that is not symmetric and positive definite."""
    is_square = value.shape[-1] == value.shape[-2]
    is_same = is_square and np.allclose(value, value.mT, rtol=1e-8, atol=1e-12)
    if not (is_same and np.linalg.eigvalsh(value).min() > 0.0):
        raise TrustboError(f"params.{name} must be symmetric and positive definite; got {value!r}.")
