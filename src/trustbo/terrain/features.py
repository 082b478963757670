"""Attributes of pixels that impede motion or sight."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import xarray as xr
from scipy import ndimage

from trustbo.errors import require_whole
from trustbo.terrain import fan, stencil
from trustbo.terrain.dataset import pixel_size
from trustbo.terrain.pixel_feature import (
    FEATURES,
    PixelFeature,
    feature_named,
    register_feature,
    values_of_kernel,
)

CANOPY_THRESHOLD = 2.0
"""Vegetation at least this high (m) counts as canopy."""
COVER_RADIUS = 5.0
"""Half-width of the squares over which canopy is averaged, m."""
REACH = 50.0
"""Length of the rays of openness, m."""


def _of_window(kernel: Callable, sign: int, units: str) -> Callable[[xr.Dataset], xr.DataArray]:
    """Register the attribute of the 3 x 3 window of a kernel, with its name and docstring."""
    name = kernel.__name__

    def feature(terrain: xr.Dataset) -> xr.DataArray:
        values = values_of_kernel(terrain, kernel, slice(None), np.empty)
        return _named(terrain["dem"].copy(deep=False, data=values), name, units)

    feature.__name__ = feature.__qualname__ = name
    feature.__doc__ = kernel.__doc__
    return register_feature(name, sign=sign, kernel=kernel)(feature)


# Beyond the raster's edge the ground is level.
slope = _of_window(stencil.slope, -1, "rad")
aspect = _of_window(stencil.aspect, 1, "rad")
curvature = _of_window(stencil.curvature, 1, "1/m")
roughness = _of_window(stencil.roughness, -1, "m")
tri = _of_window(stencil.tri, -1, "m")
tpi = _of_window(stencil.tpi, 1, "m")
step_height = _of_window(stencil.step_height, -1, "m")


@register_feature("canopy_height", sign=-1)
def canopy_height(terrain: xr.Dataset) -> xr.DataArray:
    """Surface minus ground, m."""
    return _named(terrain["dsm"] - terrain["dem"], "canopy_height", "m")


@register_feature("canopy_cover", sign=-1, halo=COVER_RADIUS)
def canopy_cover(terrain: xr.Dataset, radius: float = COVER_RADIUS) -> xr.DataArray:
    """Share of the square of half-width `radius` (m) that is under canopy over 2 m high."""
    height = canopy_height(terrain)
    tall = (height.values > CANOPY_THRESHOLD).astype(height.dtype)
    return _named(_local_mean(terrain, tall, radius).clip(0.0, 1.0), "canopy_cover", "1")


@register_feature("vegetation_density", sign=-1, halo=COVER_RADIUS)
def vegetation_density(
    terrain: xr.Dataset,
    radius: float = COVER_RADIUS,
    *,
    layer: float = 3.0,
    crown_base: float = 0.3,
) -> xr.DataArray:
    """Share of the lowest metres of air filled by canopy, around each pixel.

    Args:
        terrain: DEM and DSM.
        radius: Half-width of the square around a pixel, m.
        layer: Height of the layer of air that robots see through, m.
        crown_base: Lower edge of the canopy layer as a share of its height.

    Returns:
        Dims (y, x), in [0, 1].
    """
    height = canopy_height(terrain).values
    filled = np.minimum(height, layer) - np.minimum(crown_base * height, layer)
    share = _local_mean(terrain, np.maximum(filled, 0.0) / layer, radius)
    return _named(share.clip(0.0, 1.0), "vegetation_density", "1")


def openness(
    terrain: xr.Dataset,
    reach: float = REACH,
    *,
    eye: float = 1.0,
    target: float = 1.0,
    n_rays: int = 16,
    extinction: float = 0.1,
    crown_base: float = 0.3,
    rows: slice | None = None,
) -> xr.DataArray:
    """Expected share of clear rays from a pixel to targets `reach` metres away all around.

    Args:
        terrain: DEM and DSM.
        reach: Length of the rays, m.
        eye: Height of the sensor above ground, m.
        target: Height of the targets above ground, m.
        n_rays: Number of directions.
        extinction: Extinction coefficient of the canopy, 1/m.
        crown_base: Lower edge of the canopy layer as a share of its height.
        rows: Rows of pixels to compute; the others are NaN.

    Returns:
        Dims (y, x), in [0, 1]; rays that end off the raster do not count, and a pixel without
        other rays is NaN: keep `reach` below half the terrain's shorter side.

    Raises:
        TrustboError: `n_rays` is not positive.
    """
    values = fan.openness(
        terrain["dem"].values,
        terrain["dsm"].values,
        pixel_size(terrain),
        reach,
        eye,
        target,
        require_whole("n_rays", n_rays, 1),
        extinction,
        crown_base,
        rows or slice(None),
    )
    return _named(terrain["dem"].copy(deep=False, data=values), "openness", "1")


FEATURES["openness"] = PixelFeature(openness, +1, REACH, by_rows=True)


TRAVERSABILITY = ("slope", "roughness", "tri", "step_height")
"""Pixel features of traversability (z1); each lowers it."""
VISIBILITY = ("vegetation_density", "openness")
"""Pixel features of visibility (z2): vegetation lowers it, openness raises it."""
PAPER_VISIBILITY = ("canopy_height", "canopy_cover", "openness")
"""Visibility of version 0.1, in the paper's setting; in forest it points the wrong way."""


def pixel_features(
    terrain: xr.Dataset, features: Iterable[str] | Mapping[str, PixelFeature]
) -> xr.Dataset:
    """Compute several features, as variables of dims (y, x).

    Args:
        terrain: DEM and DSM.
        features: Names of registered features, or features by name.

    Raises:
        TrustboError: An unknown name.
    """
    if not isinstance(features, Mapping):
        features = {name: feature_named(name) for name in features}
    return xr.Dataset({name: feature.compute(terrain) for name, feature in features.items()})


def gradient(dem: np.ndarray, pixel: tuple[float, float]) -> np.ndarray:
    """Horn's rise of the ground to the east and to the north, shape (2, row, col)."""
    out = np.empty((2, *dem.shape), dem.dtype)
    stencil.gradient(np.pad(dem, 1, mode="edge"), pixel, out)
    return out


def _local_mean(terrain: xr.Dataset, values: np.ndarray, radius: float) -> xr.DataArray:
    """Mean of the valid pixels in squares of half-width `radius` (m)."""
    size: Any = [2 * max(1, round(radius / step)) + 1 for step in pixel_size(terrain)]
    has_ground, valid = np.isfinite(terrain["dem"].values), np.isfinite(values)
    total = ndimage.uniform_filter(np.where(valid, values, 0.0), size, mode="nearest")
    weight = ndimage.uniform_filter(valid.astype(total.dtype), size, mode="nearest")
    with np.errstate(invalid="ignore", divide="ignore"):
        return terrain["dem"].copy(deep=False, data=np.where(has_ground, total / weight, np.nan))


def _named(array: xr.DataArray, name: str, units: str) -> xr.DataArray:
    array = array.rename(name)
    array.attrs = {"units": units, "long_name": name.replace("_", " ")}
    return array
