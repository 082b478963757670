"""Registry of pixel features, and their computation strip by strip."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
import xarray as xr

from trustbo.errors import TerrainError, require_choice
from trustbo.parallel import over_rows
from trustbo.terrain.dataset import pixel_size

Compute = Callable[..., xr.DataArray]
"""Function of a terrain: Dataset of `dem` and `dsm` over (y, x)."""


class PixelFeature(NamedTuple):
    """Attribute of pixels, and its sign in an index."""

    compute: Compute
    """Function of a terrain or a strip of one; result with dims (y, x)."""
    sign: int
    """+1 if it raises an index, -1 if it lowers it."""
    halo: float = 0.0
    """Radius of the surroundings that a pixel depends on, m, in addition to its 8 neighbours."""
    by_rows: bool = False
    """Whether `compute` takes `rows=`, the rows to compute; it may leave out the others."""
    kernel: Callable | None = None
    """Kernel of `stencil` that computes it on arrays without labels, for strips."""

    def of_rows(
        self, terrain: xr.Dataset, rows: slice, buffer: Callable | None = None
    ) -> np.ndarray:
        """Compute the feature on rows of a terrain, shape (row, col).

        Args:
            terrain: Terrain, or a strip of it.
            rows: Rows to compute.
            buffer: Function (shape, dtype) that returns an array to write to; by default a new one.
        """
        if self.kernel is not None:
            return values_of_kernel(terrain, self.kernel, rows, buffer or np.empty)
        options = {"rows": rows} if self.by_rows else {}
        return self.compute(terrain, **options).values[rows]


FEATURES: dict[str, PixelFeature] = {}
"""Pixel features by name."""


class _Registrar(Protocol):
    def __call__[F: Compute](self, compute: F, /) -> F: ...


def register_feature(
    name: str, *, sign: int, halo: float = 0.0, kernel: Callable | None = None
) -> _Registrar:
    """Register a pixel feature under a new name, by a decorator.

    It is for a function of a terrain (Dataset of `dem` and `dsm`, dims (y, x), m) that returns a
    DataArray (y, x), NaN where unknown. TerrainError: the name is taken, or the sign neither 1 nor
    -1.

    Args:
        name: New name.
        sign: +1 if the feature raises an index, -1 if it lowers it.
        halo: Radius of the surroundings that a pixel depends on, m, for computing in strips.
        kernel: See `PixelFeature`.
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
    """Get a registered feature; TrustboError if no feature has that name."""
    return FEATURES[require_choice("feature", name, FEATURES)]


def values_of_kernel(
    terrain: xr.Dataset, kernel: Callable, rows: slice, buffer: Callable
) -> np.ndarray:
    """Attribute of the 3 x 3 window on rows of pixels, shape (row, col); see `of_rows`."""
    z, pixel = terrain.variables["dem"].values, pixel_size(terrain)
    top, bottom, _ = rows.indices(len(z))
    out = buffer((bottom - top, z.shape[1]), z.dtype)

    def work(first: int, last: int) -> None:
        i, j = top + first, top + last
        block = np.empty((j - i + 2, z.shape[1] + 2), z.dtype)
        block[1:-1, 1:-1] = z[i:j]
        block[0, 1:-1], block[-1, 1:-1] = z[max(i - 1, 0)], z[min(j, len(z) - 1)]
        block[:, 0], block[:, -1] = block[:, 1], block[:, -2]
        kernel(block, pixel, out[first:last])

    over_rows(work, len(out))
    return out
