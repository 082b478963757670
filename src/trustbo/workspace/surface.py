"""Rasters from which the positions, motion and sight of robots are computed."""

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy import ndimage

from trustbo.terrain.features import horn_gradient
from trustbo.terrain.pixels import index_within, pixel_size, row_and_col


class Surface(NamedTuple):
    """Rasters for sight and motion, with the conversion from positions to pixels."""

    ground: np.ndarray  # (row, col), m
    canopy: np.ndarray  # (row, col), m: the DSM
    gradient: np.ndarray  # (2, row, col): dz/dx and dz/dy, in single precision to save memory
    passable: np.ndarray  # (row, col), bool
    pixel: tuple[float, float]  # height, width of a pixel, m
    origin: tuple[float, float]  # x, y of the centre of pixel (0, 0)

    @property
    def slope(self) -> np.ndarray:
        """Slope of the ground (row, col), rad; NaN where one of the 3 x 3 heights is missing."""
        steepness = np.hypot(*self.gradient)
        np.arctan(steepness, out=steepness)
        missing = ~np.isfinite(self.ground)
        steepness[ndimage.binary_dilation(missing, np.ones((3, 3)))] = np.nan
        return steepness

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

    def centers(self, row: np.ndarray, col: np.ndarray) -> np.ndarray:
        """Return the positions of pixels' centres, shape (pixel, 2), in CRS metres."""
        x = self.origin[0] + col * self.pixel[1]
        y = self.origin[1] - row * self.pixel[0]
        return np.stack([x, y], axis=-1)

    def to_pixel(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Convert positions in CRS metres to fractional rows and columns."""
        return row_and_col(x, y, self.origin, self.pixel)

    def nearest(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Return the rows and columns of the pixels nearest to positions.

        If two pixels are equally near, the one with the even index is returned, so that rounding
        favours no direction. Kernels return the southern or eastern one; see `nearest_pixel`.
        """
        row, col = self.to_pixel(x, y)
        rows, cols = self.ground.shape
        return index_within(np.rint(row), rows), index_within(np.rint(col), cols)


def surface_of(terrain: xr.Dataset, max_slope: float | None = None) -> Surface:
    """Make the surface of a terrain.

    Pixels are passable if their slope is known and at most `max_slope`, in rad; without a limit,
    all pixels with a height are passable.
    """
    ground, canopy = (np.require(terrain[name].values, float, "W") for name in ("dem", "dsm"))
    pixel = pixel_size(terrain)
    surface = Surface(
        ground=ground,
        canopy=canopy,
        gradient=horn_gradient(_filled(ground), pixel).astype(np.float32),
        passable=np.isfinite(ground),
        pixel=pixel,
        origin=(float(terrain["x"][0]), float(terrain["y"][0])),
    )

    if max_slope is None:
        return surface
    return surface._replace(passable=surface.slope <= max_slope)


def _filled(dem: np.ndarray) -> np.ndarray:
    """Replace missing heights with the nearest height, because robots may reach missing data."""
    missing = ~np.isfinite(dem)
    if not missing.any():
        return dem

    nearest: Any = ndimage.distance_transform_edt(
        missing, return_distances=False, return_indices=True
    )
    return dem[tuple(nearest)]
