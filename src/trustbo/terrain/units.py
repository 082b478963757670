"""Units of heights, as a band or the vertical axis of a CRS declares them."""

import re
from typing import NamedTuple

import numpy as np
import pyproj
from rasterio.crs import CRS

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
