"""Rasters read window by window, and their lazy arrays."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from rasterio import Affine
from rasterio.crs import CRS
from rasterio.errors import RasterioError
from rasterio.transform import array_bounds
from tqdm import tqdm
from xarray.backends import BackendArray
from xarray.core import indexing

from trustbo.errors import TerrainError
from trustbo.terrain.metric import METRE, HeightUnit

_PIXELS = 1 << 23  # read together, to be averaged


@dataclass(frozen=True, eq=False)
class Raster:
    """Heights on a north-up grid, read window by window.

    Attributes:
        name: Name for messages.
        crs: Coordinate reference system.
        transform: Map from (column, row) of a pixel's upper left corner to (x, y) in the CRS.
        shape: Rows and columns.
        read: Function of a slice of rows and a slice of columns that returns their heights,
            float64, NaN where missing.
        unit: Unit of the stored heights; `read` converts them to metres.
    """

    name: str
    crs: CRS
    transform: Affine
    shape: tuple[int, int]
    read: Callable[[slice, slice], np.ndarray]
    unit: HeightUnit = METRE

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Left, bottom, right and top in the CRS."""
        return array_bounds(*self.shape, self.transform)

    def coarsened(self, factor: int, progress: bool = False) -> "Raster":
        """Raster of the means of `factor` x `factor` pixels, computed strip by strip when read.

        Missing pixels do not count; over half of them make a mean missing. Rows and columns at the
        southern and eastern edges that fill no pixel are left out.
        """
        rows, cols = (n // factor for n in self.shape)

        def strip(above: slice, columns: slice) -> np.ndarray:
            fine = self.read(*(slice(s.start * factor, s.stop * factor) for s in (above, columns)))
            blocks = fine.reshape(above.stop - above.start, factor, -1, factor)
            valid = np.isfinite(blocks)
            n = valid.sum((1, 3))
            total = np.add.reduce(np.where(valid, blocks, 0.0), (1, 3))
            return np.where(2 * n >= factor**2, total / np.maximum(n, 1), np.nan)

        def read(above: slice, columns: slice) -> np.ndarray:
            step = max(1, _PIXELS // (factor**2 * (columns.stop - columns.start)))
            tops = range(above.start, above.stop, step)
            shown = tqdm(tops, f"reading {self.name}", disable=not progress, leave=False)
            parts = [strip(slice(top, min(top + step, above.stop)), columns) for top in shown]
            return np.concatenate(parts)

        wider = self.transform * Affine.scale(factor)
        return replace(self, transform=wider, shape=(rows, cols), read=read)

    def array(self, dtype: type[np.floating]) -> xr.DataArray:
        """Make the array of heights, dims (y, x), read when a window of it is loaded."""
        lazy: Any = indexing.LazilyIndexedArray(_Heights(self, dtype))
        rows, cols = (np.arange(n) + 0.5 for n in self.shape)
        coords = {
            "y": self.transform.f + rows * self.transform.e,
            "x": self.transform.c + cols * self.transform.a,
        }
        return xr.DataArray(indexing.CopyOnWriteArray(lazy), coords, ("y", "x")).rio.write_crs(
            self.crs
        )


class _Heights(BackendArray):
    """Interface through which xarray reads windows of a raster."""

    def __init__(self, raster: Raster, dtype: type[np.floating]) -> None:
        self.raster, self.shape, self.dtype = raster, raster.shape, np.dtype(dtype)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.BASIC, self._window
        )

    def _window(self, key: tuple[int | slice, ...]) -> np.ndarray:
        spans = [
            range(n)[k] if isinstance(k, slice) else range(k, k + 1)
            for k, n in zip(key, self.shape, strict=True)
        ]
        if not all(spans):
            return np.empty(
                [len(s) for s, k in zip(spans, key, strict=True) if isinstance(k, slice)]
            )
        try:
            window = self.raster.read(*(slice(span[0], span[-1] + 1) for span in spans))
        except RasterioError as error:
            raise TerrainError(
                f"{self.raster.name} could not be read ({error}); it is damaged, out of reach, or "
                "was closed before it was read."
            ) from None
        steps = (slice(None, None, k.step) if isinstance(k, slice) else 0 for k in key)
        return window[tuple(steps)].astype(self.dtype, copy=False)
