"""Where robots stand: the lead's waypoint in each cell, and T2's formation around it."""

from typing import Any

import numpy as np
import xarray as xr
from scipy import ndimage

from trustbo.data import Cell
from trustbo.simulation.sight import Sight, Surface, chance, optics
from trustbo.terrain import Workspace, pixel_size
from trustbo.terrain.features import gradient

SPACING = 2.0
"""Least distance between two robots of a formation, m."""


class Positions:
    """Waypoints and formations of a workspace's cells; positions are x, y in CRS metres."""

    def __init__(
        self,
        workspace: Workspace,
        surface: Surface,
        sight: Sight,
        ease: xr.DataArray,
        radius: float,
    ) -> None:
        """Prepare.

        Args:
            workspace: The cells and the team.
            surface: The terrain.
            sight: What hinders sight.
            ease: How easy each pixel is to cross, dims (y, x).
            radius: How far from the lead's waypoint T2 may stand, m.
        """
        self._workspace, self._surface, self._sight = workspace, surface, sight
        self._ease = _smoothed(ease.values, surface.pixel)
        self._standable = _largest_region(surface.passable)
        self._radius = radius
        self._waypoints: dict[Cell, np.ndarray] = {}
        self._formations: dict[tuple[Cell, Cell | None], np.ndarray] = {}
        # Row and column of the cell that each row and column of pixels belongs to, ascending.
        self._cells = workspace.grid.cells_along(ease["y"].values, ease["x"].values)

    def window(self, a: Cell, b: Cell) -> tuple[int, int, int, int]:
        """Pixels of two cells and half a cell around them."""
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
        """Where the lead stops in a cell: its easiest standable pixel, rather near the middle."""
        if cell not in self._waypoints:
            self._waypoints[cell] = self._waypoint(cell)
        return self._waypoints[cell]

    def formation(self, cell: Cell, next_cell: Cell | None) -> np.ndarray:
        """Where T2 stands in a cell: (robot, 2), spread out, with sight of the next waypoint."""
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
        return position[np.argmax(self._ease[row, col] - off_center)]

    def _formation(self, cell: Cell, next_cell: Cell | None) -> np.ndarray:
        team, here = self._workspace.team, self.waypoint(cell)
        goal = here if next_cell is None else self.waypoint(next_cell)
        row, col = self._pixels_of(cell)
        position = self._position(row, col)
        distance = np.linalg.norm(position - here, axis=1)
        near = np.flatnonzero((distance <= self._radius) & (distance >= SPACING))
        if len(near) < len(team.robots):  # hardly any standing room, or pixels as large as that
            order = np.argsort(distance, kind="stable")
            near = order[distance[order] > 0.0][: len(team.robots)]
            near = near if len(near) else order
        position = position[near]
        aim = np.broadcast_to(goal, position.shape)
        chosen: list[np.ndarray] = []
        for robot in team.robots:
            seen = chance(self._surface, self._sight, position, aim, optics(robot, team.lead))
            # Among equally good views the closer one; nobody on top of another if there is room.
            score = seen - 1e-3 * distance[near]
            gaps = [np.linalg.norm(position - other, axis=1) for other in chosen]
            crowded = np.min(gaps, axis=0) < SPACING if gaps else np.zeros(len(position), bool)
            chosen.append(position[np.argmax(score - 10.0 * crowded)])
        return np.stack(chosen)

    def _pixels_of(self, cell: Cell) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the pixels of a cell where a robot can stand."""
        rows, cols = self._cells
        top, bottom = np.searchsorted(rows, (cell[0], cell[0] + 1))
        left, right = np.searchsorted(cols, (cell[1], cell[1] + 1))
        for allowed in (self._standable, self._surface.passable):
            row, col = np.nonzero(allowed[top:bottom, left:right])
            if len(row):
                break
        return row + top, col + left

    def _position(self, row: np.ndarray, col: np.ndarray) -> np.ndarray:
        x = self._surface.origin[0] + col * self._surface.pixel[1]
        y = self._surface.origin[1] - row * self._surface.pixel[0]
        return np.stack([x, y], axis=-1)


def surface_of(terrain: xr.Dataset, pixels: xr.Dataset) -> Surface:
    """A workspace's terrain as the arrays that sight and motion work on."""
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
    """Missing heights replaced by the nearest known: a robot may brush the edge of the data."""
    nearest: Any = ndimage.distance_transform_edt(
        ~np.isfinite(dem), return_distances=False, return_indices=True
    )
    return dem[tuple(nearest)]


def _smoothed(values: np.ndarray, pixel: tuple[float, float], width: float = 5.0) -> np.ndarray:
    size = [max(1, round(width / step)) for step in pixel]
    window: dict[str, Any] = {"size": size, "mode": "nearest"}
    return ndimage.uniform_filter(np.nan_to_num(values), **window)


def _largest_region(passable: np.ndarray) -> np.ndarray:
    """The largest connected set of passable pixels; a robot outside it could go nowhere.

    Connected by edges: routes do not squeeze through where two pixels touch at a corner only.
    """
    regions: Any = ndimage.label(passable)
    labels, n_regions = regions
    if n_regions == 0:
        return passable
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == np.argmax(sizes)
