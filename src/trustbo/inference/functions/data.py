"""Inputs of a model that is a NumPyro function, keyed by the names of its parameters."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from trustbo import stacking
from trustbo.data import Mission
from trustbo.errors import TrustboError, require_choice
from trustbo.models.observations import Observations
from trustbo.workspace.moves import MOVES, bounds_along

RATES = "contact_rate"
"""Name of the site and of the input that contain the contact rates."""
NAMES = ("awareness", RATES, "n_ticks", "duration", "cell", "bound", "features", "observations")
"""Names of all inputs; `observations` stands for all data as `Observations`, without padding."""
_NOT_ARRAYS = ("features", "observations")
"""Inputs that compiled functions cannot take as arguments."""
_STEP_OF_BOUNDS = 8
"""Bounds are padded to a multiple of this number, which limits the number of compiled shapes."""
_FEWEST_MISSIONS = 4
"""Missions are padded to a power of 2 that is at least this number."""
_UNKNOWN = -1
"""Index of an unknown cell or move."""
_IN_EXAMPLE = {RATES: 0.5, "n_ticks": 100.0, "duration": 60.0}
"""Values of the measurements of an invented mission."""
_IN_PADDING = {
    "awareness": 0.0,
    RATES: np.nan,
    "n_ticks": 0.0,
    "duration": 0.0,
    "cell": _UNKNOWN,
    "bound": _UNKNOWN,
}
"""Values of the inputs in the padding."""

Data = Mapping[str, Any]
"""Inputs by name.

The shapes are awareness (mission, bound, robot, feature); contact_rate, n_ticks and duration
(mission, bound, robot); cell (mission, bound, 2), with rows and columns; and bound (mission, bound,
3), with moves, rows and columns. `features` are the names of the features.
"""


class FeatureNames(tuple[str, ...]):
    """Names of features, among which a function looks up an index."""

    __slots__ = ()

    def index(self, value: Any, *limits: Any) -> int:
        """Return the position of a name; raises TrustboError with all names if it is unknown."""
        return super().index(require_choice("feature", value, self), *limits)


def arrays_of(data: Data) -> dict[str, Any]:
    """Return the inputs that are arrays, which have the leading axes (mission, bound)."""
    return {name: values for name, values in data.items() if name not in _NOT_ARRAYS}


def data_of(
    missions: Sequence[Mission], observations: Observations, *, moves: bool = True
) -> dict[str, Any]:
    """Return the inputs of missions, padded so that functions are compiled for only a few shapes.

    In the padding, contact_rate is NaN, indices are -1, and the other inputs are 0. These are not
    NaN, because a NaN drift would make gradients NaN even in bounds without rates. If `moves` is
    False, all moves are -1, and paths may jump; otherwise, a jump raises a TrustboError.
    """
    bounds = []
    for mission in missions:
        if moves and mission.path:
            bounds.append(bounds_along(mission.driven_stations))
        else:
            cells = [bound.cell for bound in mission.bounds]  # -1 without a map
            bounds.append(np.insert(cells, 0, _UNKNOWN, axis=1))

    data = _inputs_of(
        observations.awareness,
        stacking.padded(bounds, _UNKNOWN),
        observations.features,
        {
            RATES: observations.contact_rate,
            "n_ticks": stacking.padded([mission.n_ticks for mission in missions], 0.0),
            "duration": stacking.padded([mission.duration for mission in missions], 0.0),
        },
    )
    n_missions, n_bounds = observations.contact_rate.shape[:2]
    return padded(data, (_power_of_two(n_missions), _rounded_up(n_bounds)))


def padded(data: Data, shape: tuple[int, int]) -> dict[str, Any]:
    """Return inputs with missions and bounds of the padding added, up to the shape."""
    arrays = {}
    for name, values in arrays_of(data).items():
        missing = [(0, n - m) for n, m in zip(shape, values.shape[:2], strict=True)]
        margin = [*missing, *[(0, 0)] * (values.ndim - 2)]
        arrays[name] = np.pad(values, margin, constant_values=_IN_PADDING[name])
    return {**data, **arrays}


def data_of_bounds(
    awareness: np.ndarray, bounds: np.ndarray, features: Sequence[str], *, measured: bool = False
) -> dict[str, Any]:
    """Return the inputs of bounds as one mission, padded as in `data_of`.

    Args:
        awareness: Awareness, shape (bound, robot, feature), without NaN.
        bounds: Moves, rows and columns, shape (bound, 3).
        features: Names of the features.
        measured: Whether to invent contact rates, numbers of ticks and durations for several
            missions. By default, these are NaN, because they are not known before a mission.
    """
    n_bounds, n_robots, _ = awareness.shape
    measurements = {
        name: np.full((1, n_bounds, n_robots), value if measured else np.nan)
        for name, value in _IN_EXAMPLE.items()
    }
    data = _inputs_of(awareness[None], bounds[None], features, measurements)
    return padded(data, (_FEWEST_MISSIONS if measured else 1, _rounded_up(n_bounds)))


def _inputs_of(
    awareness: np.ndarray,
    bounds: np.ndarray,
    features: Sequence[str],
    measurements: dict[str, np.ndarray],
) -> dict[str, Any]:
    """Return the inputs by name, without padding; bounds have the moves of their ways."""
    bounds = bounds.copy()
    known = bounds[..., 0] >= 0
    bounds[known, 0] %= len(MOVES)
    return {
        "awareness": awareness,
        **measurements,
        "cell": bounds[..., 1:],
        "bound": bounds,
        "features": tuple(features),
    }


def observations_of(data: Data) -> Observations:
    """Return inputs as `Observations`."""
    return Observations(data[RATES], data["awareness"], data["n_ticks"], data["features"])


def require_same_order(
    name: str,
    own: Mapping[str, Sequence[str]],
    given: Mapping[str, Sequence[str]],
    *,
    some: bool = False,
) -> None:
    """Raise TrustboError if a function was fitted to other robots or features, or another order.

    Args:
        name: Name of the function.
        own: Names of the robots and features of the fit, by axis.
        given: Names for which the function is to be used, by axis.
        some: Whether robots may be left out.
    """
    for axis, names in given.items():
        have = own[axis]
        is_some = some and axis == "robot"
        wanted = [robot for robot in have if robot in names] if is_some else have
        if tuple(wanted) != tuple(names):
            raise TrustboError(
                f"the function {name} was fitted to missions with the {axis}s {', '.join(have)}, "
                f"not {', '.join(names)}. A function reads them by position, so give the same "
                "names in the same order."
            )


def _rounded_up(n_bounds: int) -> int:
    """Return the number of bounds with their padding."""
    return n_bounds + -n_bounds % _STEP_OF_BOUNDS


def _power_of_two(n: int) -> int:
    """Return the smallest power of 2 that is at least n and `_FEWEST_MISSIONS`."""
    return max(_FEWEST_MISSIONS, 1 << (n - 1).bit_length())
