"""Metric maps: units of heights and coordinates, and even spacing."""

import re
from collections.abc import Hashable, Mapping
from typing import NamedTuple

import numpy as np
import pyproj
import xarray as xr
from rasterio.crs import CRS
from rasterio.errors import CRSError

from trustbo.errors import TerrainError


class HeightUnit(NamedTuple):
    """Unit of heights: its name, and its length in metres."""

    name: str
    metres: float


METRE = HeightUnit("m", 1.0)
_FOOT, _SURVEY_FOOT = 0.3048, 1200.0 / 3937.0
# Names without spaces and punctuation.
_LENGTHS: dict[str, float] = {
    **dict.fromkeys(("m", "metre", "metres"), 1.0),
    **dict.fromkeys(("foot", "internationalfoot", "footinternational"), _FOOT),
    **dict.fromkeys(("ussurveyfoot", "surveyfoot", "usfoot", "footus"), _SURVEY_FOOT),
}


def height_unit(name: str, declared: object, crs: CRS | None) -> HeightUnit:
    """Find the unit of a raster's heights; metres if nothing declares one.

    `declared` is the unit of the band (of each band, the first counts), or None; the vertical axis
    of the CRS may have one. TerrainError: an unknown unit, or a band and a CRS that disagree.
    """
    text = str(np.ravel(np.array(declared, object))[0] or "").strip()
    axis = _vertical(crs)
    if not text:
        return axis or METRE
    plain = re.sub(r"[\s_.()-]", "", text.lower())
    length = _LENGTHS.get(re.sub("feet|ft", "foot", plain).replace("meter", "metre"))
    remedy = "tag its true one, e.g. with gdal_edit.py -units m, or in the attribute units"
    if length is None:
        raise TerrainError(
            f"{name} has heights in {text!r}; metres and feet are known: convert them, or {remedy}."
        )
    if axis and abs(length / axis.metres - 1.0) > 1e-5:
        raise TerrainError(
            f"{name} has heights in {text!r} by its band, but in {axis.name!r} by its CRS; "
            f"{remedy}, or the true CRS, e.g. with gdal_edit.py -a_srs."
        )
    return METRE if length == 1.0 else HeightUnit(text, length)


def metric_heights(crs: CRS) -> CRS:
    """CRS of heights that are converted: without a vertical axis in another unit than metres."""
    if _vertical(crs) in (None, METRE):
        return crs
    return CRS.from_wkt(pyproj.CRS.from_wkt(crs.to_wkt()).to_2d().to_wkt())


def _vertical(crs: CRS | None) -> HeightUnit | None:
    """Unit of the vertical axis, if the CRS has one."""
    axes = pyproj.CRS.from_wkt(crs.to_wkt()).axis_info if crs else []
    for axis in axes:
        if axis.direction in ("up", "down"):
            length = axis.unit_conversion_factor
            return METRE if length == 1.0 else HeightUnit(axis.unit_name, length)
    return None


def require_metric(terrain: Mapping[str, xr.DataArray] | xr.Dataset, crs: CRS | None) -> None:
    """Refuse a dem and a dsm in other units than metres, or unevenly spaced: TerrainError."""
    require_metric_crs(crs, "the terrain")
    for name in ("dem", "dsm"):
        heights = terrain[name]
        unit = height_unit(name, heights.attrs.get("units"), heights.rio.crs)
        if unit != METRE:
            raise TerrainError(
                f"{name} has heights in {unit.name!r}, not metres; read it with read_terrain, "
                "which converts them."
            )
    for axis in ("y", "x"):
        require_regular(terrain["dem"][axis].values, axis, "the raster")


def require_metric_crs(crs: CRS | None, name: str) -> None:
    """Refuse a map without CRS, or with one in another unit than metres: TerrainError."""
    if crs is None:
        raise TerrainError(f"{name} has no CRS; set it, e.g. with .rio.write_crs('EPSG:32633').")
    if crs.is_geographic:
        raise TerrainError(
            f"{name} is in degrees; reproject it, e.g. with "
            "dem.rio.reproject(dem.rio.estimate_utm_crs())."
        )
    try:
        metres = crs.linear_units_factor[1]
    except CRSError:
        raise TerrainError(
            f"{name} is in a CRS that is no map of the Earth; give it a projected one, e.g. "
            "'EPSG:32633'."
        ) from None
    if abs(metres - 1.0) > 1e-9:
        raise TerrainError(
            f"{name} is in {crs.linear_units}, but heights and distances must be in metres; warp "
            "it to a metric CRS and convert its heights."
        )


def require_regular(values: np.ndarray, axis: Hashable, name: str) -> None:
    """Refuse coordinates that are fewer than two, or not evenly spaced: TerrainError."""
    steps = np.diff(values)
    if not len(steps) or not np.allclose(steps, steps[0], rtol=1e-3) or steps[0] == 0.0:
        raise TerrainError(
            f"{name}'s {axis} is not a regular axis of two pixels or more; resample it to evenly "
            "spaced, sorted coordinates."
        )
