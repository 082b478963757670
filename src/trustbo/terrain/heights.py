"""Conversion of stored raster values to heights in metres, NaN where missing."""

import re
from collections.abc import Mapping
from numbers import Real
from typing import Any

import numpy as np
import xarray as xr

from trustbo.errors import TrustboError, require_kind, warn

LOWEST = -450.0
"""Lowest height on land, m: the shore of the Dead Sea is at -430 m."""
HIGHEST = 9000.0
"""Highest height on land, m: the summit of Everest is at 8849 m."""
_FILLS = (-99999.0, -32768.0, -32767.0, -9999.0)  # also suspicious before scaling
ACCESSOR_FILL = "rio.nodata"
"""Attribute that carries the fill value of rioxarray's accessor, which most operations drop."""
_FILL_NAMES = ("_FillValue", "missing_value", "fill_value", "nodata", ACCESSOR_FILL)
_LOW = 10.0  # m; heights up to this one are level with zeros
_FAR = 100.0  # m; unlikely distance of the highest height from all others
_METRE = {"m", "metre", "metres", "meter", "meters"}
_FOOT = {"ft", "foot", "feet", "ftus", "usft"}
_OTHER_UNIT = 0.5  # share of impossible heights from which another unit is the likely cause
_US = {"us", "survey", "ftus", "usft"}
_FOOT_IN_METRES = 0.3048
_US_FOOT_IN_METRES = 1200.0 / 3937.0


def in_metres(stored: xr.DataArray, axis: float | None, nodata: float | None) -> np.ndarray:
    """Convert stored values (row, col) to heights in metres, NaN where missing.

    The unit, scale, offset and fill values are read from the attributes. `nodata` is another fill
    value. `axis` is the unit of the CRS's vertical axis in metres, negative for depths, or None if
    there is no such axis.

    Raises:
        TrustboError: Values or attributes are not real numbers, or values are impossible as heights
            on land: undeclared fill values, fill values blended with heights, or heights in another
            unit. The same error is raised if the unit is unknown, or if the band and the CRS
            disagree on it.
    """
    name = str(stored.name)
    attrs = stored.attrs
    raw = stored.to_numpy()
    if raw.dtype.kind not in "iuf":
        raise TrustboError(f"{name} holds {raw.dtype}, not heights; give real numbers.")

    metres = _unit_of(name, attrs.get("units"), axis)
    if attrs.get("positive") == "down":  # as in the CF conventions
        metres = -abs(metres)
    if abs(metres) != 1.0:
        warn(f"{name} has heights in units of {abs(metres):.6g} m; they are converted to metres.")

    # In place, because rasters may fill the memory.
    heights = raw.astype(float)
    missing = ~np.isfinite(heights)
    for fill in _fills(name, attrs, nodata):
        with np.errstate(over="ignore"):
            missing |= raw == fill  # rounded to the raster's type: float32 has no -3.4e38

    heights[missing] = np.nan

    scale = _number(name, attrs, "scale_factor", 1.0)
    offset = _number(name, attrs, "add_offset", 0.0)
    suspicious = np.isin(heights, _FILLS if scale != 1.0 else (*_FILLS, -999.0))

    heights *= scale
    heights += offset
    heights *= metres
    wrong = ~missing & (suspicious | (heights < LOWEST) | (heights > HIGHEST))
    if not wrong.any():
        _warn_of_zeros(heights, name)
        _warn_of_levels(heights, raw, name)
        if scale != 1.0:
            _warn_of_second_scale(raw[~missing], scale, name)
        return heights

    r, c = np.unravel_index(np.argmax(wrong), wrong.shape)
    value = float(raw[r, c])
    height = heights[r, c]
    scaled = "" if value == height else f" (scaled to {height:g} m)"
    where = f"{name} holds {value!r}{scaled} at row {r}, column {c}"

    share = wrong.sum() / np.isfinite(heights).sum()
    if share > _OTHER_UNIT:
        raise TrustboError(
            f"{where}, and {share:.0%} of its heights lie outside {LOWEST:g} to {HIGHEST:g} m: "
            "they may be in another unit, such as centimetres; convert them, or declare their "
            "scale, e.g. with gdal_edit.py -scale 0.01."
        )
    raise TrustboError(
        f"{where}, which is not a height on land: it may be an undeclared fill value, or one "
        f"that resampling has blended with heights. Pass nodata={value!r}, or resample the raster "
        "again with its fill value declared."
    )


def _number(name: str, attrs: Mapping[str, Any], key: str, default: float) -> float:
    """Return an attribute that is one finite number; raises TrustboError for other values."""
    try:
        number = np.asarray(attrs.get(key, default), float).item()
    except (TypeError, ValueError):
        number = np.nan
    if not np.isfinite(number):
        raise TrustboError(
            f"{name} declares {key} = {attrs[key]!r}, which is not a number; correct the attribute."
        )
    return number


def _fills(name: str, attrs: Mapping[str, Any], nodata: float | None) -> list[float]:
    """Return the fill values of the attributes, and `nodata`; NaN for each that is not given."""
    if nodata is not None:
        require_kind("nodata", nodata, Real, "give the number that marks missing data, or None")

    fills = [np.nan if nodata is None else float(nodata)]
    for key in _FILL_NAMES:
        try:
            fills += np.ravel(np.array(attrs.get(key), float)).tolist()  # None becomes NaN
        except (TypeError, ValueError):
            raise TrustboError(
                f"{name} declares the fill value {key} = {attrs[key]!r}, which is not a number; "
                "correct the attribute."
            ) from None

    return fills


def _warn_of_zeros(heights: np.ndarray, name: str) -> None:
    """Warn of pixels at exactly 0 m that are far from all other heights (missing values?).

    Ground may be level. If most pixels are zero, a warning therefore requires that all others are
    far away and differ: walls on a floor often have one height.
    """
    n_zero = int((heights == 0.0).sum())
    n_low = int(((heights >= -_LOW) & (heights <= _LOW)).sum()) - n_zero
    is_high = (heights < -_LOW) | (heights > _LOW)
    n_high = int(is_high.sum())

    few_are_low = n_low < 0.1 * n_zero
    if n_zero >= n_low + n_high:
        low, high = _range_of(heights, is_high)
        few_are_low = n_low == 0 and low < high

    if n_zero and few_are_low:
        warn(
            f"{name} is exactly 0 m on {n_zero / heights.size:.1%} of its pixels, but hardly any "
            f"other height is below {_LOW:g} m: zeros may be missing heights; pass nodata=0 if "
            "they are."
        )


def _warn_of_levels(heights: np.ndarray, raw: np.ndarray, name: str) -> None:
    """Warn if several pixels share the lowest or the highest height, far from all others.

    Arithmetic turns fill values into heights: -9999 cm are -99.99 m, and 65535 dm are 6553.5 m.
    Roofs also share a height, so the highest one must be further away from the others. `raw` holds
    the stored values.
    """
    lowest = np.fmin.reduce(heights, axis=None)
    highest = np.fmax.reduce(heights, axis=None)
    for level, gap in ((lowest, _LOW), (highest, _FAR)):
        is_level = heights == level
        is_other = np.isfinite(heights) & ~is_level
        if level == 0.0 or not 2 <= is_level.sum() < is_other.sum():
            continue

        low, high = _range_of(heights, is_other)
        if min(abs(low - level), abs(high - level)) > gap and low < high:
            warn(
                f"{name} is exactly {level:g} m on {is_level.mean():.1%} of its pixels, but no "
                f"other height is within {gap:g} m: they may be missing heights that were scaled "
                f"or shifted; pass nodata={float(raw[is_level][0])!r} if they are."
            )


def _range_of(heights: np.ndarray, chosen: np.ndarray) -> tuple[float, float]:
    """Return the lowest and the highest of the chosen heights; (inf, -inf) if none is chosen."""
    lowest = np.min(heights, where=chosen, initial=np.inf)
    return float(lowest), float(np.max(heights, where=chosen, initial=-np.inf))


def _warn_of_second_scale(values: np.ndarray, scale: float, name: str) -> None:
    """Warn of stored values that are not whole numbers: they may have been scaled before.

    To save space, values with a scale are stored as whole numbers.
    """
    if (values != np.round(values)).mean() > 0.5:
        warn(
            f"{name} declares the scale {scale:g}, which is applied, but its values are not whole "
            "numbers: if they were scaled before, remove the attribute, e.g. "
            "del array.attrs['scale_factor'] (xarray keeps attributes in arithmetic)."
        )


def _unit_of(name: str, declared: object, axis: float | None) -> float:
    """Return the unit of the heights in metres, negative for depths.

    `declared` is the unit of the band, or a list with the unit of each band; None if unknown.
    """
    text = str(np.ravel(np.array(declared, object))[0] or "").strip()
    words = set(re.findall(r"[a-z]+", text.lower()))

    in_metres = bool(words & _METRE)
    in_feet = bool(words & _FOOT)
    if text and (in_metres == in_feet or re.search(r"^[\d.]|/|[a-z] ?(\^|\*\*)?-\d", text.lower())):
        raise TrustboError(
            f"{name} has heights in {text!r}, not in metres or feet; convert them, or declare "
            "the true unit, e.g. with gdal_edit.py -units m."
        )

    length = 1.0
    if in_feet:
        length = _US_FOOT_IN_METRES if words & _US else _FOOT_IN_METRES

    if text and axis and abs(length / abs(axis) - 1.0) > 1e-5:
        raise TrustboError(
            f"the band of {name} declares heights in {text!r}, but its CRS units of "
            f"{abs(axis):.6g} m; correct either with gdal_edit.py -units or gdal_edit.py -a_srs."
        )

    return axis or length
