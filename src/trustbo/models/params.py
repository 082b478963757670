"""Parameters of the trust models with the symbols of the paper, as users give and read them."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import xarray as xr

from trustbo.arrays import Names, as_names, read_labelled, require_numbers
from trustbo.errors import TrustboError, require_choice, require_switch, warn
from trustbo.models.draws import COUPLED_DIMS, PLACES, ROBOT_DIMS, Dims, Draws
from trustbo.models.families import FAMILIES
from trustbo.models.robots_in_bounds import RobotsInBounds

Numbers = Any
"""A number or an array of numbers, which may have labels."""

POOLED_DIMS: Dims = {"beta0": (), "beta": ("feature",), "b": (), "delta_w": (), "delta_v": ()}
"""Parameters that all robots share, equations (3)-(4)."""
_NOT_COUPLED = ("delta_s", "f_v", "memory", "per_robot")
"""Further arguments that the coupled model does not have."""


@dataclass(frozen=True, init=False, eq=False, repr=False)
class TrustParams(Draws):
    """Parameters of a trust model whose inputs are linear in awareness.

    There are three forms. By default, all robots share the parameters beta0, beta, b, delta_w and
    delta_v of equations (3)-(4). With `per_robot`, these have an axis (robot,). The coupled model,
    equations (1)-(2), has the parameters B0, B, b, Delta_w and Delta_v.

    Each parameter is one number or array, or has the leading axis (draw,). It can be read by name,
    always with this axis.

    Args:
        beta0: Autoregression coefficient, shape () or (draw,); with `per_robot`, (..., robot).
        beta: Feature weights, shape (..., feature); with `per_robot`, (..., robot, feature).
        b: Intercept, of the shape of beta0; shape (..., robot) in the coupled model.
        delta_w: Standard deviation of the process noise, of the shape of beta0.
        delta_v: Standard deviation of the observation noise, of the shape of beta0.
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
        per_robot: Whether beta0, beta, b, delta_w and delta_v have an axis of robots.
        B0: Influence of each robot' on each robot, shape (..., robot, robot').
        B: Feature weights of the coupled model, shape (..., feature, robot, robot').
        Delta_w: Covariance of its process noise, shape (..., robot, robot').
        Delta_v: Covariance of its observation noise, shape (..., robot, robot').

    Raises:
        TrustboError: If parameters of a form are missing or belong to another form; if a value is
            not a number, is infinite or exceeds 1e12; if sizes or names differ; if a covariance is
            not symmetric and positive definite; or if the family is unknown. An array with labels
            needs the names `robots` or `features`. Effects of places may be NaN where a map has no
            bound.

    Example:
        >>> beta = np.array([0.1, 0.1, 0.3])  # of traversability, visibility and line of sight
        >>> truth = tb.models.TrustParams(0.5, beta, b=0.0, delta_w=0.05, delta_v=0.05)
        >>> tb.simulation.ModelSimulator(workspace, truth).run(path, seed=0).contact_rate
        >>> beta = np.tile(beta, (3, 1))  # (robot, feature)
        >>> beta[1] /= 2.0  # r2 detects less
        >>> half, noise = np.full(3, 0.5), np.full(3, 0.05)
        >>> params = tb.models.TrustParams(half, beta, np.zeros(3), noise, noise, per_robot=True)
        >>> planner.plan(params).trust.mean(axis=0).argmin().item()
        1
    """

    def __init__(
        self,
        beta0: Numbers | None = None,
        beta: Numbers | None = None,
        b: Numbers | None = None,
        delta_w: Numbers | None = None,
        delta_v: Numbers | None = None,
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
        *,
        per_robot: bool = False,
        B0: Numbers | None = None,
        B: Numbers | None = None,
        Delta_w: Numbers | None = None,
        Delta_v: Numbers | None = None,
    ) -> None:
        values = {
            "beta0": beta0,
            "beta": beta,
            "B0": B0,
            "B": B,
            "b": b,
            "delta_w": delta_w,
            "delta_v": delta_v,
            "Delta_w": Delta_w,
            "Delta_v": Delta_v,
            "x0_mean": x0_mean,
            "x0_sd": x0_sd,
            "place": place,
            "place_bound": place_bound,
            "delta_s": delta_s,
            "f_v": f_v,
        }
        given = {name: value for name, value in values.items() if value is not None}
        named = set(given)
        if memory != "level":
            named.add("memory")
        if require_switch("per_robot", per_robot):
            named.add("per_robot")
        form = _form_of(named)

        require_choice("family", family, FAMILIES)
        own_robots = as_names("robots", robots or ()) or None
        own_features = as_names("features", features or ()) or None
        names = {"robot": own_robots, "robot_": own_robots, "feature": own_features}
        arrays = _arrays_of(given, {**form, **PLACES}, names)
        for name in ("Delta_w", "Delta_v"):
            if name in form:
                _require_covariance(name, arrays[name])
        super().__init__(arrays, None, place_robot, own_robots, own_features, memory, family)

    @property
    def per_robot(self) -> bool:
        """Whether beta0, beta, b, delta_w and delta_v have an axis of robots."""
        return "B0" not in self.arrays and self.arrays["b"].ndim > 1

    @property
    def dims(self) -> Dims:
        """Axes of each parameter after (draw,); parameters that are not listed have none."""
        given = {*self.arrays, "per_robot"} if self.per_robot else {*self.arrays}
        return {**_form_of(given), **PLACES}

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments that make these parameters."""
        others = ("place_robot", "robots", "features", "memory", "family", "per_robot")
        return {**self.arrays, **{name: getattr(self, name) for name in others}}

    def replace(self, **changes: Any) -> Self:
        """Return the parameters with other values of some arguments.

        Example:
            >>> forgetful = params.replace(beta0=0.0)
        """
        return type(self)(**(self.arguments | changes))


def assemble_params(variables: Mapping[str, np.ndarray], **others: Any) -> TrustParams:
    """Make parameters from variables (draw, ...) of a model, of which others are left out.

    The hierarchical model has variables that all robots share; these are repeated for each robot.
    `others` are further arguments of `TrustParams`.
    """
    if "B0" in variables:
        return TrustParams(**{name: variables[name] for name in COUPLED_DIMS}, **others)

    names = (*POOLED_DIMS, "delta_s", "f_v")
    values = {name: variables[name] for name in names if name in variables}
    b = values["b"]
    if b.ndim > 1:
        for name in ("beta0", "delta_w", "delta_v"):
            values[name] = np.broadcast_to(values[name][:, None], b.shape)
    return TrustParams(**values, per_robot=b.ndim > 1, **others)


def RobotParams(*arguments: Any, **options: Any) -> TrustParams:  # noqa: N802
    """Deprecated; use `TrustParams` with `per_robot=True`."""
    warn("RobotParams is deprecated; use TrustParams(..., per_robot=True).")
    return TrustParams(*arguments, **options, per_robot=True)


def CoupledParams(*arguments: Any, **options: Any) -> TrustParams:  # noqa: N802
    """Deprecated; use `TrustParams` with B0, B, b, Delta_w and Delta_v by name."""
    warn("CoupledParams is deprecated; use TrustParams(B0=, B=, b=, Delta_w=, Delta_v=).")
    settings = ("x0_mean", "x0_sd", "place", "place_bound", "place_robot", "robots", "features")
    names = (*COUPLED_DIMS, *settings, "family")
    return TrustParams(**dict(zip(names, arguments, strict=False)), **options)


def _form_of(given: Collection[str]) -> Dims:
    """Return the axes of the five parameters of a form, from the names of given arguments.

    Raises TrustboError if one of them is missing, or if an argument belongs to another form.
    """
    linear = POOLED_DIMS.keys() & given
    coupled = COUPLED_DIMS.keys() & given
    is_coupled = len(coupled) > len(linear)
    form = COUPLED_DIMS if is_coupled else ROBOT_DIMS if "per_robot" in given else POOLED_DIMS

    foreign = (*POOLED_DIMS, *_NOT_COUPLED) if is_coupled else COUPLED_DIMS
    wrong = {
        "missing": [name for name in form if name not in given],
        "not of this form": [name for name in foreign if name in given and name not in form],
    }
    if any(wrong.values()):
        found = "; ".join(f"{what}: {', '.join(names)}" for what, names in wrong.items() if names)
        raise TrustboError(
            f"parameters are {', '.join(POOLED_DIMS)}, or those of the coupled model, "
            f"{', '.join(COUPLED_DIMS)}; {found}."
        )
    return form


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
