"""Rasters from which the positions, motion and sight of robots are computed."""

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy import ndimage

from trustbo.terrain.features import gradient
from trustbo.terrain.pixels import index_within, pixel_size, row_and_col


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

    def to_pixel(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Convert positions in CRS metres to fractional rows and columns."""
        return row_and_col(x, y, self.origin, self.pixel)

    def nearest(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Return the rows and columns of the pixels nearest to positions.

        Of two pixels that are equally near, it is the one with the even index, so that rounding has
        no direction. In kernels, it is the southern or eastern one; see `nearest_pixel`.
        """
        row, col = self.to_pixel(x, y)
        rows, cols = self.ground.shape
        return index_within(np.rint(row), rows), index_within(np.rint(col), cols)


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
