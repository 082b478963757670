"""Features by name: what each is, and how it is got strip by strip."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
import xarray as xr

from trustbo.errors import TerrainError, require_choice
from trustbo.terrain.parallel import over_rows
from trustbo.terrain.raster import pixel_size

Compute = Callable[..., xr.DataArray]
"""Of a terrain, Dataset of `dem` and `dsm` over (y, x)."""


class PixelFeature(NamedTuple):
    """A named attribute of pixels, and how it enters an index."""

    compute: Compute
    """Of a terrain or a strip of one, dims (y, x)."""
    sign: int
    """+1 if more of it raises the index it is part of, -1 if it lowers it."""
    halo: float = 0.0
    """How far around a pixel it looks, m; the pixels next to it are always there."""
    by_rows: bool = False
    """Whether `compute` takes `rows=`, the rows that are wanted; it may leave out the others."""
    kernel: Callable | None = None
    """Of `stencil`, if that is all it is: the way without labels, for strips."""

    def of_rows(self, terrain: xr.Dataset, rows: slice, room: Callable | None = None) -> np.ndarray:
        """Its values on some rows of a terrain, shape (row, col).

        Args:
            terrain: The terrain, or a strip of it.
            rows: Which.
            room: `room(shape, dtype)` gives an array to be written to; by default a new one.
        """
        if self.kernel is not None:
            return values_of_kernel(terrain, self.kernel, rows, room or np.empty)
        options = {"rows": rows} if self.by_rows else {}
        return self.compute(terrain, **options).values[rows]


FEATURES: dict[str, PixelFeature] = {}
"""Every feature known by name."""


class _Registrar(Protocol):
    def __call__[F: Compute](self, compute: F, /) -> F: ...


def register_feature(
    name: str, *, sign: int, halo: float = 0.0, kernel: Callable | None = None
) -> _Registrar:
    """Add a feature of one's own, to be used by its name.

    Args:
        name: A new one.
        sign: +1 if more of it raises the index it is part of, -1 if it lowers it.
        halo: How far around a pixel it looks, m, so that large rasters can be done in strips.
        kernel: See `PixelFeature`.

    Returns:
        A decorator for a function of a terrain (Dataset of `dem` and `dsm`, dims (y, x), m) that
        returns a DataArray (y, x), NaN where unknown.

    Raises:
        TerrainError: The name is taken, or the sign neither 1 nor -1.
    """
    if name in FEATURES:
        raise TerrainError(f"there is a feature {name!r} already; take another name.")
    if sign not in (1, -1) or not halo >= 0.0:
        raise TerrainError(f"need sign 1 or -1 and halo >= 0; got {sign!r} and {halo!r}.")

    def register[F: Compute](compute: F, /) -> F:
        FEATURES[name] = PixelFeature(compute, sign, halo, kernel=kernel)
        return compute

    return register


def feature_named(name: str) -> PixelFeature:
    """A registered feature.

    Raises:
        TrustboError: There is none of that name.
    """
    return FEATURES[require_choice("feature", name, FEATURES)]


def values_of_kernel(
    terrain: xr.Dataset, kernel: Callable, rows: slice, room: Callable
) -> np.ndarray:
    """A 3 x 3 attribute of some rows, shape (row, col); `room` as in `PixelFeature.of_rows`."""
    z, pixel = terrain.variables["dem"].values, pixel_size(terrain)
    top, bottom, _ = rows.indices(len(z))
    out = room((bottom - top, z.shape[1]), z.dtype)

    def work(first: int, last: int) -> None:
        i, j = top + first, top + last
        block = np.empty((j - i + 2, z.shape[1] + 2), z.dtype)
        block[1:-1, 1:-1] = z[i:j]
        block[0, 1:-1], block[-1, 1:-1] = z[max(i - 1, 0)], z[min(j, len(z) - 1)]
        block[:, 0], block[:, -1] = block[:, 1], block[:, -2]
        kernel(block, pixel, out[first:last])

    over_rows(work, len(out))
    return out
