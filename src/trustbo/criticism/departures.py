"""Departures from a trust model that its residuals are tested for, one after another.

A departure is either an effect in the drift, given as columns over the slots (mission, bound,
robot), or a source of correlation, given as a covariance of the rates. Each has labels, such as
features, of which the one with the strongest evidence is named.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from trustbo.criticism.joint_normal import Data, Normal, Point
from trustbo.data import Mission
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.params import CoupledParams
from trustbo.models.place import bounds_of, correlation, has_places, visited

_LENGTH_SCALE = 2.0  # cells, the default of PlaceEffect
_MEMORY = 0.7  # correlation of successive bounds, and of successive missions


class Departure(NamedTuple):
    """A departure and its labels."""

    name: str
    effects: Mapping[str, np.ndarray] = {}
    """Columns (slot, direction) by label."""
    sources: Mapping[str, np.ndarray] = {}
    """Covariances (rate, rate) by label."""


def departures(
    missions: Sequence[Mission],
    data: Data,
    normal: Normal,
    point: Point,
    place: PlaceEffect | None,
) -> tuple[list[Departure], dict[str, str]]:
    """Alternatives to test, and those that cannot be tested, with the reason."""
    tests, left_out = [], {}
    if (sources := _places(missions, data, normal, place)) is None:
        left_out["place"] = "paths jump between cells, so that bounds have no places."
    elif sources:
        tests.append(Departure("place", sources=sources))
    else:
        left_out["place"] = "the model has effects of cells and bounds."
    curves = {}
    for m, feature in enumerate(missions[0].features):
        if len(np.unique(data.z[:, m])) > 2:
            curves[feature] = (data.z[:, m : m + 1] - data.z[:, m].mean()) ** 2
    if curves:
        tests.append(Departure("curvature", curves))
    else:
        left_out["curvature"] = "every feature has two values at most."
    tests.append(Departure("correlation", sources=_correlations(data, normal, point)))
    return tests, left_out


def cells_of(missions: Sequence[Mission], data: Data) -> np.ndarray:
    """Cell entered of each slot, (slot, 2)."""
    return np.array([missions[j].bounds[k].cell for j, k, _ in data.slots])


def cell_columns(
    missions: Sequence[Mission], data: Data
) -> tuple[list[tuple[int, int]], np.ndarray]:
    """Cells entered, and the column of each over the slots, (slot, cell)."""
    entered, index = np.unique(cells_of(missions, data), axis=0, return_inverse=True)
    names = [(int(row), int(col)) for row, col in entered]
    return names, (index.ravel()[:, None] == np.arange(len(entered))).astype(float)


def _places(
    missions: Sequence[Mission], data: Data, normal: Normal, place: PlaceEffect | None
) -> dict[str, np.ndarray] | None:
    if not has_places(missions):
        return None
    places = visited(bounds_of(missions), PlaceEffect(), data.n_robots)
    mission, bound, _ = data.slots.T
    unit = places.unit[mission, bound, 0]
    of_units = normal.carry @ (unit[:, None] == np.arange(len(places.units)))
    of_cells = normal.carry @ (places.cell_of[unit][:, None] == np.arange(len(places.cells)))
    sources = {}
    if place is None or not place.cells:
        K = correlation(places.cells, places.cells, _LENGTH_SCALE)
        sources["cells"] = of_cells @ K @ of_cells.T
    if place is None or not place.bounds:
        sources["bounds"] = of_units @ of_units.T
    return sources


def _correlations(data: Data, normal: Normal, point: Point) -> dict[str, np.ndarray]:
    """Covariances of rates that the model takes as independent given trust."""
    mission, bound, robot = data.slots.T
    C = normal.carry
    sources = {}
    if data.n_robots > 1 and not isinstance(point.params, CoupledParams):
        w, v = (np.mean(getattr(point.params, name)) for name in ("delta_w", "delta_v"))
        together = (mission * (bound.max() + 1) + bound)[:, None]
        shared = (together == np.unique(together)).astype(float)
        of_rates = shared[data.seen]
        sources["robots in one bound"] = (
            w**2 * (C @ shared) @ (C @ shared).T + v**2 * of_rates @ of_rates.T
        )
    sequences = mission * data.n_robots + robot
    sequence = sequences[data.seen]
    gap = np.abs(np.subtract.outer(bound[data.seen], bound[data.seen]))
    sources["successive bounds"] = _MEMORY**gap * np.equal.outer(sequence, sequence)
    return sources
