"""Attributes of every pixel that make ground hard to cross or sight hard to keep."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import xarray as xr
import xrspatial
from scipy import ndimage

from trustbo.terrain import rays
from trustbo.terrain.raster import pixel_size

CANOPY_THRESHOLD = 2.0
"""Vegetation at least this high (m) counts as canopy."""


class PixelFeature(NamedTuple):
    """A named attribute and the sign with which it enters its composite."""

    compute: Callable[[xr.Dataset], xr.DataArray]
    sign: int


def slope(terrain: xr.Dataset) -> xr.DataArray:
    """Slope of the ground, rad, by Horn's (1981) 3 x 3 stencil."""
    degrees = xrspatial.slope(terrain["dem"], boundary="nearest")
    return _named(degrees * (np.pi / 180.0), "slope", "rad")


def roughness(terrain: xr.Dataset) -> xr.DataArray:
    """Highest minus lowest ground in the 3 x 3 window, m (GDAL's roughness)."""
    return _named(xrspatial.roughness(terrain["dem"], boundary="nearest"), "roughness", "m")


def tri(terrain: xr.Dataset) -> xr.DataArray:
    """Terrain ruggedness index, m: root sum of squared steps to the 8 neighbours (Riley 1999)."""
    return _named(xrspatial.tri(terrain["dem"], boundary="nearest"), "tri", "m")


def step_height(terrain: xr.Dataset) -> xr.DataArray:
    """Largest step up or down to one of the 8 neighbours, m."""
    dem = terrain["dem"].values
    rows, cols = dem.shape
    padded = np.pad(dem, 1, mode="edge")
    steps = np.zeros_like(dem)
    for i in range(3):
        for j in range(3):
            # fmax: a missing neighbour is no step.
            steps = np.fmax(steps, np.abs(padded[i : i + rows, j : j + cols] - dem))
    values = np.where(np.isnan(dem), np.nan, steps)
    return _named(terrain["dem"].copy(data=values), "step_height", "m")


def canopy_height(terrain: xr.Dataset) -> xr.DataArray:
    """Surface minus ground, m."""
    return _named(terrain["dsm"] - terrain["dem"], "canopy_height", "m")


def canopy_cover(terrain: xr.Dataset, radius: float = 5.0) -> xr.DataArray:
    """Share of the square of half-width `radius` (m) that is under canopy over 2 m high."""
    height = canopy_height(terrain)
    size = [2 * max(1, round(radius / step)) + 1 for step in pixel_size(terrain)]
    valid = np.isfinite(height.values)
    tall = np.where(valid, height.values > CANOPY_THRESHOLD, False).astype(float)
    window = {"size": size, "mode": "nearest"}
    weight = ndimage.uniform_filter(valid.astype(float), **window)
    with np.errstate(invalid="ignore", divide="ignore"):
        cover = np.where(valid, ndimage.uniform_filter(tall, **window) / weight, np.nan)
    return _named(height.copy(data=np.clip(cover, 0.0, 1.0)), "canopy_cover", "1")


def openness(
    terrain: xr.Dataset,
    reach: float = 50.0,
    *,
    eye: float = 1.0,
    target: float = 1.0,
    n_rays: int = 16,
    extinction: float = 0.1,
    crown_base: float = 0.3,
) -> xr.DataArray:
    """Expected share of clear rays from a pixel to targets `reach` metres away all around.

    Args:
        terrain: DEM and DSM.
        reach: Length of the rays, m; at most half the terrain's shorter side is used.
        eye: Height of the sensor above ground, m.
        target: Height of the targets above ground, m.
        n_rays: Number of directions.
        extinction: Extinction coefficient of the canopy, 1/m.
        crown_base: Lower edge of the canopy layer as a share of its height.

    Returns:
        Dims (y, x), in [0, 1]; rays that end off the raster do not count.
    """
    pixel = pixel_size(terrain)
    extent = min(n * step for n, step in zip(terrain["dem"].shape, pixel, strict=True))
    values = rays.openness(
        terrain["dem"].values,
        terrain["dsm"].values,
        pixel,
        min(reach, 0.5 * extent),
        eye,
        target,
        n_rays,
        extinction,
        crown_base,
    )
    return _named(terrain["dem"].copy(data=values), "openness", "1")


TRAVERSABILITY: Mapping[str, PixelFeature] = {
    "slope": PixelFeature(slope, -1),
    "roughness": PixelFeature(roughness, -1),
    "tri": PixelFeature(tri, -1),
    "step_height": PixelFeature(step_height, -1),
}
"""What traversability (z1) is made of: all of it lowers it."""

VISIBILITY: Mapping[str, PixelFeature] = {
    "canopy_height": PixelFeature(canopy_height, -1),
    "canopy_cover": PixelFeature(canopy_cover, -1),
    "openness": PixelFeature(openness, +1),
}
"""What visibility (z2) is made of: canopy lowers it, openness raises it."""


def pixel_features(terrain: xr.Dataset, features: Mapping[str, PixelFeature]) -> xr.Dataset:
    """Every feature of a composite, as variables of dims (y, x)."""
    return xr.Dataset({name: feature.compute(terrain) for name, feature in features.items()})


def _named(array: xr.DataArray, name: str, units: str) -> xr.DataArray:
    array = array.astype(float).rename(name)
    array.attrs = {"units": units, "long_name": name.replace("_", " ")}
    return array
