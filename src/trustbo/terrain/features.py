"""Features of pixels that impede motion or sight.

A feature is a function of a terrain (Dataset of `dem` and `dsm`, dims (y, x), metres) that returns
an array (row, col), or a DataArray (y, x), NaN where unknown. `feature` registers such a function
for composites, as in the example in `docs/terrain.md`.
"""

from collections.abc import Callable, Iterator
from functools import reduce
from itertools import product, starmap
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy import ndimage

from trustbo.arrays import as_array
from trustbo.errors import (
    TrustboError,
    one_line,
    require_choice,
    require_kind,
    require_tuple,
    require_whole,
)
from trustbo.parallel import over_rows
from trustbo.terrain import rays
from trustbo.terrain.pixels import order_along, pixel_size

TRAVERSABILITY = ("slope", "roughness", "tri", "step_height")
"""Pixel features of traversability (z1); each lowers it."""
VISIBILITY = ("vegetation_density", "openness")
"""Pixel features of visibility (z2): vegetation lowers it, openness raises it."""
PAPER_VISIBILITY = ("canopy_height", "canopy_cover", "openness")
"""Pixel features of visibility in the paper; in forest, their index has the wrong sign."""
_HALF_WIDTH = 5.0  # of the squares over which vegetation is averaged, m
_COVER = 2.0  # height above which the surface counts as canopy cover, m
_LAYER = 3.0  # height of the layer in which vegetation density is measured, m


class Feature(NamedTuple):
    """Feature of pixels and its sign in an index: +1 if it raises the index, -1 if it lowers it."""

    compute: Callable[..., np.ndarray]
    sign: int


FEATURES: dict[str, Feature] = {}
"""Registered features by name."""


def feature[F: Callable[..., np.ndarray]](name: str, *, sign: int) -> Callable[[F], F]:
    """Register a function as a feature of pixels under a new name (decorator).

    The function returns one number for each pixel: an array (row, col) with the northernmost row
    first, or a DataArray (y, x), which is aligned with the terrain by its coordinates.

    A function replaces an earlier one with the same name from the same module, so that a cell of a
    notebook can be run again.

    Raises TrustboError if the name is not text or is taken by another function, or the sign is
    neither 1 nor -1.

    Example:
        >>> @tb.terrain.feature("bush", sign=-1)
        ... def bush(terrain):
        ...     return np.array(terrain["dsm"] - terrain["dem"] > 0.5, dtype=float)
        >>> names = {"traversability": ["slope", "bush"]}
        >>> tb.Workspace.from_terrain(tb.terrain.example(), (4, 4), features=names)
    """
    require_kind("name of the feature", name, str, "give a text, such as 'stones'")
    if require_whole("sign", sign, -1) == 0 or sign > 1:
        raise TrustboError(f"sign must be 1 or -1; got {sign!r}.")

    def register(compute: F) -> F:
        if name in FEATURES and _origin(FEATURES[name].compute) != _origin(compute):
            raise TrustboError(f"feature {name!r} already exists; choose another name.")
        FEATURES[name] = Feature(compute, sign)
        return compute

    return register


def pixel_feature(name: str, terrain: xr.Dataset, **options: float) -> np.ndarray:
    """Compute a feature of a terrain's pixels, shape (row, col).

    A DataArray that the feature returns is aligned with the terrain by its coordinates, or by
    position along axes without coordinates.

    Raises:
        TrustboError: The feature is unknown, or it did not return a number for each pixel.
    """
    compute = FEATURES[require_choice("feature", name, FEATURES)].compute
    values: Any = compute(terrain, **options)
    what = f"the result of feature {name!r}"

    dem = terrain["dem"]
    if isinstance(values, xr.DataArray):
        values = _in_order_of(terrain, what, values)

    if np.shape(values) != dem.shape:
        raise TrustboError(
            f"{what} must have the shape of the terrain, {dem.shape}; got {_kind_of(values)}."
        )
    return as_array(what, values)


def _in_order_of(terrain: xr.Dataset, what: str, values: xr.DataArray) -> np.ndarray:
    """Return values of pixels in the order of the terrain; raises TrustboError for other pixels."""
    dem = terrain["dem"]
    if set(values.dims) != set(dem.dims):
        raise TrustboError(
            f"{what} must have the dims {dem.dims}; got {values.dims}; return an array without "
            "labels if its axes are rows and columns of pixels."
        )

    for dim, step in zip(dem.dims, pixel_size(terrain), strict=True):
        if dim not in values.coords:
            continue
        order = order_along(dem[dim].values, values[dim].values, step)
        if order is None:
            raise TrustboError(
                f"{what} has other {dim} coordinates than the terrain, such as "
                f"{one_line(values[dim].values[:1].tolist())}; return one value for each pixel, "
                "e.g. with .reindex_like(terrain)."
            )
        values = values.isel({dim: order})
    return values.transpose(*dem.dims).values


def _kind_of(values: Any) -> str:
    """Describe a wrong result of a feature: its shape or, without axes, its value."""
    return f"shape {np.shape(values)}" if np.ndim(values) else one_line(values)


def _origin(function: Callable[..., Any]) -> tuple[object, ...]:
    """Return the module and name of a function, which do not change if it is defined again."""
    return tuple(getattr(function, name, None) for name in ("__module__", "__qualname__"))


def _window(z: np.ndarray) -> Callable[[int, int], np.ndarray]:
    """Return a function that gives the heights one step (down, right) from each pixel.

    Heights beyond the raster and missing heights are as in gdaldem with -compute_edges: beyond an
    edge, the ground continues straight on; in the four corners, it does so to the north and south,
    and is level to the east and west. A missing neighbour has the height of the pixel itself.
    """
    across, along = ((0, 0), (1, 1)), ((1, 1), (0, 0))
    inner = np.pad(_straight_on(z, across), along, mode="edge")
    outer = _straight_on(np.pad(z, across, mode="edge"), along)  # for the first and the last row
    rows, cols = z.shape

    def heights(down: int, right: int) -> np.ndarray:
        there = slice(1 + down, 1 + down + rows), slice(1 + right, 1 + right + cols)
        height = inner[there].copy()
        height[[0, -1]] = outer[there][[0, -1]]
        return np.where(np.isfinite(height), height, z)

    return heights


def _all_heights(z: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the nine heights of each pixel's 3 x 3 window, one array after another."""
    return starmap(_window(z), product((-1, 0, 1), repeat=2))


def _by_rows(
    compute: Callable[[np.ndarray], np.ndarray], z: np.ndarray, *n_maps: int
) -> np.ndarray:
    """Compute maps of 3 x 3 windows on blocks of rows, so that only small arrays are temporary.

    `compute` converts heights (row, col) to maps (*n_maps, row, col). It also gets the rows beside
    a block; the values at these rows are dropped.
    """
    maps = np.empty((*n_maps, *z.shape), np.result_type(z, np.float32))

    def work(first: int, last: int) -> None:
        north = max(first - 1, 0)
        of_block = compute(z[north : last + 1])
        maps[..., first:last, :] = of_block[..., first - north : last - north, :]

    over_rows(work, len(z))
    return maps


def _straight_on(z: np.ndarray, width: Any) -> np.ndarray:
    """Pad heights with twice the outermost minus the next one; a single one is repeated."""
    return np.pad(z, width, mode="reflect", reflect_type="odd")


def gradient(dem: np.ndarray, pixel: tuple[float, float]) -> np.ndarray:
    """Compute the gradient of the ground to the east and north (Horn 1981), (2, row, col).

    Example:
        >>> dem = np.tile(np.arange(5.0), (5, 1))  # rises by 1 m per pixel to the east
        >>> east, north = tb.terrain.gradient(dem, pixel=(1.0, 1.0))
        >>> east[2, 2].item()
        1.0
    """
    if getattr(dem, "ndim", 0) != 2 or not dem.size or dem.dtype.kind not in "iuf":
        raise TrustboError(f"dem must be an array of heights (row, col); got {one_line(dem)}.")
    return horn_gradient(dem, require_tuple("pixel", pixel, 2))


def horn_gradient(dem: np.ndarray, pixel: tuple[float, ...]) -> np.ndarray:
    """Compute the gradient of heights and pixels that have been checked; see `gradient`."""
    return _by_rows(lambda z: _gradient_of(z, pixel), dem, 2)


def _gradient_of(z: np.ndarray, pixel: tuple[float, ...]) -> np.ndarray:
    """Compute the gradient of a block of rows; see `gradient`."""
    height, width = pixel
    w = _window(z)
    east = (w(-1, 1) - w(-1, -1)) + 2.0 * (w(0, 1) - w(0, -1)) + (w(1, 1) - w(1, -1))
    south = (w(1, -1) - w(-1, -1)) + 2.0 * (w(1, 0) - w(-1, 0)) + (w(1, 1) - w(-1, 1))
    return np.stack([0.125 * east / width, -0.125 * south / height])


@feature("slope", sign=-1)
def slope(terrain: xr.Dataset) -> np.ndarray:
    """Compute the slope of the ground, rad (Horn 1981)."""
    pixel = pixel_size(terrain)

    def of_block(z: np.ndarray) -> np.ndarray:
        steepness = np.hypot(*_gradient_of(z, pixel))
        return np.arctan(steepness) + (z - z)  # missing stays missing

    return _by_rows(of_block, terrain["dem"].values)


@feature("roughness", sign=-1)
def roughness(terrain: xr.Dataset) -> np.ndarray:
    """Compute the range of ground heights in the 3 x 3 window, m (Wilson et al. 2007)."""

    def of_block(z: np.ndarray) -> np.ndarray:
        return reduce(np.maximum, _all_heights(z)) - reduce(np.minimum, _all_heights(z))

    return _by_rows(of_block, terrain["dem"].values)


@feature("tri", sign=-1)
def tri(terrain: xr.Dataset) -> np.ndarray:
    """Compute the terrain ruggedness index, m: root sum of squared steps (Riley 1999)."""

    def of_block(z: np.ndarray) -> np.ndarray:
        return np.sqrt(sum(((w - z) ** 2 for w in _all_heights(z)), np.zeros_like(z)))

    return _by_rows(of_block, terrain["dem"].values)


@feature("step_height", sign=-1)
def step_height(terrain: xr.Dataset) -> np.ndarray:
    """Compute the largest step to one of the 8 neighbours, m; missing neighbours are ignored."""

    def of_block(z: np.ndarray) -> np.ndarray:
        return reduce(np.maximum, (np.abs(w - z) for w in _all_heights(z)))

    return _by_rows(of_block, terrain["dem"].values)


@feature("canopy_height", sign=-1)
def canopy_height(terrain: xr.Dataset) -> np.ndarray:
    """Compute the surface minus the ground, m."""
    return terrain["dsm"].values - terrain["dem"].values


@feature("canopy_cover", sign=-1)
def canopy_cover(terrain: xr.Dataset) -> np.ndarray:
    """Compute the fraction of a square of half-width 5 m covered by canopy over 2 m high."""
    height = canopy_height(terrain)
    covered = np.where(np.isfinite(height), height > _COVER, np.nan)
    return _local_mean(terrain, covered)


@feature("vegetation_density", sign=-1)
def vegetation_density(terrain: xr.Dataset, crown_base: float = 0.3) -> np.ndarray:
    """Compute the fraction of the lowest 3 m above ground that canopy fills.

    The fraction is averaged over squares of half-width 5 m. The canopy is the layer from
    `crown_base` times its height to its top.
    """
    height = canopy_height(terrain)
    filled = np.minimum(height, _LAYER) - np.minimum(crown_base * height, _LAYER)
    return _local_mean(terrain, np.maximum(filled, 0.0) / _LAYER)


@feature("openness", sign=+1)
def openness(
    terrain: xr.Dataset,
    reach: float = 50.0,
    *,
    eye: float = 1.0,
    target: float = 1.0,
    extinction: float = 0.1,
    crown_base: float = 0.3,
) -> np.ndarray:
    """Compute the expected fraction of clear rays from a pixel to targets all around.

    Rays are `reach` metres long and run from `eye` to `target` metres above ground. Canopy with an
    `extinction` (1/m) attenuates them, from `crown_base` times its height to its top. Rays that end
    off the raster are ignored; a pixel with no other rays is NaN, so keep `reach` below half the
    terrain's shorter side. Pixels of a 4 x 4 square share the value of its centre.
    """
    ground = terrain["dem"].values
    surface = terrain["dsm"].values
    rows, cols = ground.shape
    coarse = np.empty((-(-rows // rays.BLOCK), -(-cols // rays.BLOCK)))

    # As floats, because kernels are compiled again for whole numbers.
    reach = float(reach)
    heights = float(eye), float(target)
    canopy = float(extinction), float(crown_base)

    def work(first: int, last: int) -> None:
        maps = ground, surface, pixel_size(terrain)
        rays.openness(*maps, reach, heights, canopy, coarse, first, last)

    over_rows(work, len(coarse))
    whole = coarse.repeat(rays.BLOCK, axis=0).repeat(rays.BLOCK, axis=1)[:rows, :cols]
    whole[~np.isfinite(ground)] = np.nan
    return whole


def _local_mean(terrain: xr.Dataset, values: np.ndarray) -> np.ndarray:
    """Average valid pixels in squares of half-width 5 m, in [0, 1]; NaN without ground."""
    size: Any = [2 * max(1, round(_HALF_WIDTH / step)) + 1 for step in pixel_size(terrain)]
    valid = np.isfinite(values)
    total = np.where(valid, values, 0.0)
    weight = valid.astype(float)
    for sums in (total, weight):
        ndimage.uniform_filter(sums, size, output=sums, mode="nearest")

    with np.errstate(invalid="ignore", divide="ignore"):
        total /= weight
    np.clip(total, 0.0, 1.0, out=total)
    total[~np.isfinite(terrain["dem"].values)] = np.nan
    return total
