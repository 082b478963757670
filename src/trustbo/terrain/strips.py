"""Horizontal strips of a raster with a halo around them, to limit memory."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import xarray as xr

from trustbo.terrain.dataset import clean, is_lazy

_PIXELS = 1 << 19  # per strip: its arrays fit in the caches
_N_SAMPLED = 32


class Strip(NamedTuple):
    """Rows of a raster, and those around them."""

    window: xr.Dataset
    """The rows and their halo, in memory."""
    rows: slice
    """Position of the rows in the raster."""
    core: slice
    """Position of the rows in the window."""
    n_clipped: int
    """Number of pixels of the window with a surface raised to the ground."""
    n_valid: int
    """Number of pixels of the window with both heights."""


def strips(terrain: xr.Dataset, around: int) -> Iterator[Strip]:
    """Cut a terrain, in memory or lazily read, into strips from north to south.

    `around` is the number of rows on both sides on which a pixel's features depend.
    """
    n_rows, n_cols = terrain["dem"].shape
    step = max(_PIXELS // n_cols, around // 2, 1)
    for first in range(0, n_rows, step):
        yield strip_of(terrain, first, min(first + step, n_rows), around)


def sample_strips(terrain: xr.Dataset, around: int, n_pixels: int) -> Iterator[Strip]:
    """Sample strips (see `strips`) spread evenly over a terrain, about `n_pixels` in all."""
    n_rows, n_cols = terrain["dem"].shape
    wanted = -(-n_pixels // n_cols)
    if wanted >= n_rows or around >= n_rows:
        yield from strips(terrain, around)
        return
    n_strips = min(_N_SAMPLED, wanted)
    height = wanted // n_strips
    for first in np.linspace(0, n_rows - height, n_strips).astype(int):
        yield strip_of(terrain, int(first), int(first) + height, around)


def strip_of(terrain: xr.Dataset, first: int, last: int, around: int) -> Strip:
    """Read rows `first` to `last`, with `around` more on both sides, as a strip."""
    top, bottom = max(0, first - around), min(terrain["dem"].shape[0], last + around)
    window, n_clipped, n_valid = terrain.isel(y=slice(top, bottom)), 0, 0
    if is_lazy(terrain):
        window, n_clipped, n_valid = clean(window.load())
    return Strip(window, slice(first, last), slice(first - top, last - top), n_clipped, n_valid)
