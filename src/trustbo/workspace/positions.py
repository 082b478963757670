"""Positions of robots: the lead's waypoint in each cell, and T2's formation around it."""

from typing import Any

import numpy as np
import xarray as xr
from scipy import ndimage

from trustbo.data import Cell
from trustbo.terrain import pixel_size
from trustbo.terrain.features import gradient
from trustbo.workspace.sight import Sight, Surface, detection_probability, optics
from trustbo.workspace.workspace import Workspace

SPACING = 2.0
"""Least distance between two robots of a formation, m."""


class Positions:
    """Waypoints and formations of a workspace's cells; positions are x, y in CRS metres."""

    def __init__(
        self,
        workspace: Workspace,
        surface: Surface,
        sight: Sight,
        traversability: xr.DataArray,
        radius: float,
    ) -> None:
        """Prepare the maps of pixels; `traversability` has dims (y, x).

        `radius` is the largest distance of T2 from the lead's waypoint, m.
        """
        self._workspace, self._surface, self._sight = workspace, surface, sight
        self._traversability = _smoothed(traversability.values, surface.pixel)
        self._standable = _largest_region(surface.passable)
        self._radius = radius
        self._waypoints: dict[Cell, np.ndarray] = {}
        self._formations: dict[tuple[Cell, Cell | None], np.ndarray] = {}
        # Row and column of the cell that each row and column of pixels belongs to, ascending.
        y, x = (traversability[axis].values for axis in ("y", "x"))
        self._cells = workspace.grid.cells_along(y, x)

    def window(self, a: Cell, b: Cell) -> tuple[int, int, int, int]:
        """Window of pixels of two cells and half a cell around: first and end row, then col."""
        grid, (rows, cols) = self._workspace.grid, self._surface.ground.shape
        per_row, per_col = rows / grid.shape[0], cols / grid.shape[1]
        top, bottom = min(a[0], b[0]) - 0.5, max(a[0], b[0]) + 1.5
        left, right = min(a[1], b[1]) - 0.5, max(a[1], b[1]) + 1.5
        return (
            max(0, int(top * per_row)),
            min(rows, int(np.ceil(bottom * per_row))),
            max(0, int(left * per_col)),
            min(cols, int(np.ceil(right * per_col))),
        )

    def waypoint(self, cell: Cell) -> np.ndarray:
        """Stop of the lead in a cell: a traversable pixel near the centre."""
        if cell not in self._waypoints:
            self._waypoints[cell] = self._waypoint(cell)
        return self._waypoints[cell]

    def formation(self, cell: Cell, next_cell: Cell | None) -> np.ndarray:
        """Positions of T2 in a cell, (robot, 2), spread out, with sight of the next waypoint."""
        key = cell, next_cell
        if key not in self._formations:
            self._formations[key] = self._formation(cell, next_cell)
        return self._formations[key]

    def _waypoint(self, cell: Cell) -> np.ndarray:
        row, col = self._pixels_of(cell)
        center = np.array(self._workspace.grid.center(cell))
        position = self._position(row, col)
        size = np.hypot(self._workspace.grid.cell_height, self._workspace.grid.cell_width)
        off_center = np.linalg.norm(position - center, axis=1) / size
        return position[np.argmax(self._traversability[row, col] - off_center)]

    def _formation(self, cell: Cell, next_cell: Cell | None) -> np.ndarray:
        team, here = self._workspace.team, self.waypoint(cell)
        goal = here if next_cell is None else self.waypoint(next_cell)
        row, col = self._pixels_of(cell)
        position = self._position(row, col)
        distance = np.linalg.norm(position - here, axis=1)
        near = np.flatnonzero((distance <= self._radius) & (distance >= SPACING))
        if len(near) < len(team.robots):  # few passable pixels, or large ones
            order = np.argsort(distance, kind="stable")
            near = order[distance[order] > 0.0][: len(team.robots)]
            near = near if len(near) else order
        position = position[near]
        aim = np.broadcast_to(goal, position.shape)
        chosen: list[np.ndarray] = []
        for robot in team.robots:
            seen = detection_probability(
                self._surface, self._sight, position, aim, optics(robot, team.lead)
            )
            # Of equal probabilities the closer position; no robot on top of another if possible.
            score = seen - 1e-3 * distance[near]
            gaps = [np.linalg.norm(position - other, axis=1) for other in chosen]
            crowded = np.min(gaps, axis=0) < SPACING if gaps else np.zeros(len(position), bool)
            chosen.append(position[np.argmax(score - 10.0 * crowded)])
        return np.stack(chosen)

    def _pixels_of(self, cell: Cell) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of a cell's passable pixels, those of the largest region if any.

        All of its pixels if none is passable; no route leads there.
        """
        rows, cols = self._cells
        top, bottom = np.searchsorted(rows, (cell[0], cell[0] + 1))
        left, right = np.searchsorted(cols, (cell[1], cell[1] + 1))
        anywhere = np.ones_like(self._standable)
        for allowed in (self._standable, self._surface.passable, anywhere):
            row, col = np.nonzero(allowed[top:bottom, left:right])
            if len(row):
                break
        return row + top, col + left

    def _position(self, row: np.ndarray, col: np.ndarray) -> np.ndarray:
        x = self._surface.origin[0] + col * self._surface.pixel[1]
        y = self._surface.origin[1] - row * self._surface.pixel[0]
        return np.stack([x, y], axis=-1)


def surface_of(terrain: xr.Dataset, pixels: xr.Dataset) -> Surface:
    """Arrays of a workspace's terrain for sight and motion."""
    ground, canopy = (terrain[name].values.astype(float) for name in ("dem", "dsm"))
    return Surface(
        ground=ground,
        canopy=canopy,
        gradient=gradient(filled(ground), pixel_size(terrain)),
        passable=pixels["passable"].values.astype(bool),
        pixel=pixel_size(terrain),
        origin=(float(terrain["x"][0]), float(terrain["y"][0])),
    )


def filled(dem: np.ndarray) -> np.ndarray:
    """Heights, missing ones replaced by the nearest: a robot may touch the edge of the data."""
    nearest: Any = ndimage.distance_transform_edt(
        ~np.isfinite(dem), return_distances=False, return_indices=True
    )
    return dem[tuple(nearest)]


def _smoothed(values: np.ndarray, pixel: tuple[float, float], width: float = 5.0) -> np.ndarray:
    size = [max(1, round(width / step)) for step in pixel]
    window: dict[str, Any] = {"size": size, "mode": "nearest"}
    return ndimage.uniform_filter(np.nan_to_num(values), **window)


def _largest_region(passable: np.ndarray) -> np.ndarray:
    """Largest connected set of passable pixels; no route leaves it.

    Pixels are connected by edges: routes do not pass where two touch at a corner only.
    """
    regions: Any = ndimage.label(passable)
    labels, n_regions = regions
    if n_regions == 0:
        return passable
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == np.argmax(sizes)
