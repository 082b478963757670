"""Content of the interactive page: layers of the map, and the paths of its slider."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from trustbo.data import Cell
from trustbo.plots.maps import COLOURS
from trustbo.workspace import Workspace

MOST_BYTES = 3_200_000
"""Upper limit in bytes of steps and layers, for a page below 5 MB; further layers are dropped."""
_PER_VALUE = 11  # bytes, at most, of a cell's value
_DIGITS = 6


@dataclass(frozen=True, eq=False)
class Layer:
    """Map of the planning cells.

    Attributes:
        name: Name, such as that of `Result.maps()`.
        label: Name for a reader, with the unit if there is one.
        group: Heading in the list of layers.
        values: Shape (row, col), or (step, row, col) of a map for each step of the slider; NaN
            where there is no value.
        limits: Values of the first and the last colour.
        colours: Name of matplotlib's colours.
        sd: Name of the layer with its standard deviation.
    """

    name: str
    label: str
    group: str
    values: np.ndarray
    limits: tuple[float, float]
    colours: str = COLOURS
    sd: str | None = None

    def record(self, passable: np.ndarray) -> dict[str, Any]:
        """JSON-serialisable layer, without values where cells are impassable."""
        values = np.where(passable, self.values, np.nan)
        maps = [to_list(one.ravel()) for one in values.reshape(-1, *passable.shape)]
        return {
            "name": self.name, "label": self.label, "group": self.group, "sd": self.sd,
            "low": self.limits[0], "high": self.limits[1], "colours": self.colours, "maps": maps,
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class Overwatch:
    """Share of the lead's way in a bound that one would see from points around its stop.

    Attributes:
        x: Columns of points, m from the map's lower left corner, (col,).
        y: Rows of points, (row,).
        seen: Shares, (robot, row, col); NaN where robots cannot stand.
    """

    x: np.ndarray
    y: np.ndarray
    seen: np.ndarray

    def record(self) -> dict[str, Any]:
        """JSON-serialisable maps: one for all robots where they see alike."""
        alike = np.array_equal(self.seen, np.broadcast_to(self.seen[:1], self.seen.shape), True)
        maps = self.seen[:1] if alike else self.seen
        percent = np.where(np.isnan(maps), -1, np.rint(100.0 * np.nan_to_num(maps))).astype(int)
        return {
            "x": to_list(self.x.round(2)), "y": to_list(self.y.round(2)),
            "percent": percent.reshape(len(maps), -1).tolist(),
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class Step:
    """Path of one step of the slider.

    Attributes:
        title: Name of the step, such as "mission 3".
        note: Outcome, in a line.
        heading: Heading of the trust along the path.
        path: Cells, start first.
        stops: Stops of the lead, x and y in m from the map's lower left corner, (cell, 2).
        posts: Posts of the robots while the lead runs each bound, (bound, robot, 2); None where
            they are not known.
        contact: Contact rates measured, (bound, robot), NaN where there are none.
        trust: Quantiles of the team's trust after each bound, (quantile, bound), those of
            `QUANTILES` with the median in their middle; NaN where it is not known.
        numbers: Further numbers of each bound as text, by their names; (bound,) each.
        overwatch: Share of each bound that one would see, (bound,), so that posts can be moved;
            None where it is not known.
    """

    title: str
    note: str
    heading: str
    path: Sequence[Cell]
    stops: np.ndarray
    posts: np.ndarray | None
    contact: np.ndarray
    trust: np.ndarray
    numbers: dict[str, list[str]] = field(default_factory=dict)
    overwatch: Sequence[Overwatch] | None = None

    def record(self) -> dict[str, Any]:
        """JSON-serialisable step."""
        posts = None if self.posts is None else to_list(self.posts.round(2))
        return {
            "title": self.title, "note": self.note, "heading": self.heading,
            "path": [list(cell) for cell in self.path], "stops": to_list(self.stops.round(2)),
            "posts": posts, "contact": to_list(self.contact), "trust": to_list(self.trust),
            "numbers": self.numbers,
            "overwatch": None if self.overwatch is None else [o.record() for o in self.overwatch],
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class Scene:
    """Content of the page.

    Attributes:
        title: Heading.
        workspace: Workspace of the cells.
        layers: Layers, the most important first.
        steps: Paths, the last of them the recommended one.
    """

    title: str
    workspace: Workspace
    layers: Sequence[Layer]
    steps: Sequence[Step]

    def record(self) -> dict[str, Any]:
        """JSON-serialisable content, with as many layers as the size limit allows."""
        grid, passable = self.workspace.grid, self.workspace.passable.values
        steps = [step.record() for step in self.steps]
        room, shown = MOST_BYTES - len(json.dumps(steps)), []
        for layer in self.layers:
            if layer.values.size * _PER_VALUE <= room:
                shown.append(layer)
                room -= layer.values.size * _PER_VALUE
        return {
            "shape": list(grid.shape),
            "cell": [grid.cell_height, grid.cell_width],
            "robots": list(self.workspace.team.names),
            "layers": [layer.record(passable) for layer in shown],
            "left_out": [layer.label for layer in self.layers if layer not in shown],
            "steps": steps,
        }


def to_list(values: np.ndarray) -> Any:
    """Values as nested lists of at most six digits; None for NaN."""
    if values.ndim > 1:
        return [to_list(part) for part in values]
    numbers = (float(f"{value:.{_DIGITS}g}") for value in values.tolist())
    return [number if math.isfinite(number) else None for number in numbers]
