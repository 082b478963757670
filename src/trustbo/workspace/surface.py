"""Rasters from which the positions, motion and sight of robots are computed."""

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy import ndimage

from trustbo.terrain.features import gradient
from trustbo.terrain.read import pixel_size


class Surface(NamedTuple):
    """Rasters for sight and motion, with the conversion from positions to pixels."""

    ground: np.ndarray  # (row, col), m
    canopy: np.ndarray  # (row, col), m: the DSM
    gradient: np.ndarray  # (2, row, col): dz/dx and dz/dy
    passable: np.ndarray  # (row, col), bool
    pixel: tuple[float, float]  # height, width of a pixel, m
    origin: tuple[float, float]  # x, y of the centre of pixel (0, 0)

    @property
    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """The y coordinates of pixel rows and the x coordinates of pixel columns, in metres."""
        rows, cols = self.ground.shape
        y = self.origin[1] - np.arange(rows) * self.pixel[0]
        return y, self.origin[0] + np.arange(cols) * self.pixel[1]

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Edges of the raster in CRS metres: smallest x, smallest y, largest x and largest y."""
        y, x = self.axes
        high = 0.5 * self.pixel[0]
        wide = 0.5 * self.pixel[1]
        return float(x[0] - wide), float(y[-1] - high), float(x[-1] + wide), float(y[0] + high)

    def to_pixel(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Convert positions in CRS metres to fractional rows and columns."""
        return (self.origin[1] - y) / self.pixel[0], (x - self.origin[0]) / self.pixel[1]

    def nearest(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows and columns of the pixels nearest to positions."""
        row, col = self.to_pixel(np.asarray(x), np.asarray(y))
        rows, cols = self.ground.shape
        return (
            np.minimum(np.maximum(np.rint(row), 0), rows - 1).astype(int),
            np.minimum(np.maximum(np.rint(col), 0), cols - 1).astype(int),
        )

    def pixel_at(self, x: float, y: float) -> tuple[int, int]:
        """Return the row and column of the pixel nearest to one position."""
        rows, cols = self.ground.shape
        row = (self.origin[1] - y) / self.pixel[0]
        col = (x - self.origin[0]) / self.pixel[1]
        return min(max(round(row), 0), rows - 1), min(max(round(col), 0), cols - 1)


def surface_of(terrain: xr.Dataset, passable: np.ndarray) -> Surface:
    """Make the surface of a terrain; `passable` is a mask (row, col) of the terrain's pixels."""
    ground, canopy = (terrain[name].values.astype(float) for name in ("dem", "dsm"))
    return Surface(
        ground=ground,
        canopy=canopy,
        gradient=gradient(filled(ground), pixel_size(terrain)),
        passable=passable,
        pixel=pixel_size(terrain),
        origin=(float(terrain["x"][0]), float(terrain["y"][0])),
    )


def filled(dem: np.ndarray) -> np.ndarray:
    """Replace missing heights with the nearest height, because robots may reach missing data."""
    nearest: Any = ndimage.distance_transform_edt(
        ~np.isfinite(dem), return_distances=False, return_indices=True
    )
    return dem[tuple(nearest)]
