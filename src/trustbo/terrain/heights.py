"""Conversion of stored raster values to heights in metres, NaN where missing."""

import re
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from trustbo.errors import TrustboError

LOWEST, HIGHEST = -450.0, 9000.0
"""Range of heights on land, m: the Dead Sea's shore is at -430 m, Everest's summit at 8849 m."""
_FILLS = (-99999.0, -32768.0, -32767.0, -9999.0)  # suspicious before a scale is applied, too
_METRE = {"m", "metre", "metres", "meter", "meters"}
_FOOT = {"ft", "foot", "feet", "ftus", "usft"}
_US = {"us", "survey", "ftus", "usft"}
_PACKAGE = str(Path(__file__).parents[1])


class Vertical(NamedTuple):
    """Unit and vertical datum of a raster's heights.

    Attributes:
        unit: Name of the unit.
        metres: Length of the unit in metres, negative for depths.
        datum: Name of the vertical datum; None if nothing declares one.
    """

    unit: str = "m"
    metres: float = 1.0
    datum: str | None = None


def warn(message: str) -> None:
    """Issue a warning that points to the caller of the package."""
    warnings.warn(message, skip_file_prefixes=(_PACKAGE,), stacklevel=2)


def decoded(
    stored: np.ndarray,
    name: str,
    fills: Iterable[float],
    linear: tuple[float, float],
    metres: float,
) -> np.ndarray:
    """Convert stored values to heights in metres, metres * (scale * stored + offset).

    Args:
        stored: Values (row, col).
        name: Name of the raster, for messages.
        fills: Stored values that mark missing data, as non-finite ones do; they become NaN.
        linear: Scale and offset.
        metres: Length of the unit of heights in metres, negative for depths.

    Raises:
        TrustboError: Values are not real numbers, or are impossible as heights on land: undeclared
            fill values, fill values blended with heights, or heights in another unit.
    """
    if stored.dtype.kind not in "iuf":
        raise TrustboError(f"{name} holds {stored.dtype}, not heights; give real numbers.")
    values = stored.astype(float)
    missing = ~np.isfinite(values)
    with np.errstate(over="ignore"):
        for fill in fills:  # rounded to the raster's type: float32 has no exact -3.4e38
            missing |= stored == fill
    scale, offset = linear
    suspicious = np.isin(values, _FILLS if scale != 1.0 else (*_FILLS, -999.0))
    heights = metres * (scale * values + offset)
    heights[missing] = np.nan
    wrong = ~missing & (suspicious | (heights < LOWEST) | (heights > HIGHEST))
    if not wrong.any():
        return heights
    r, c = np.unravel_index(np.argmax(wrong), wrong.shape)
    value, height = float(stored[r, c]), heights[r, c]
    scaled = "" if value == height else f" (scaled to {height:g} m)"
    where = f"{name} holds {value!r}{scaled} at row {r}, column {c}"
    share = wrong.sum() / np.isfinite(heights).sum()
    if share > 0.5:
        raise TrustboError(
            f"{where}, and {share:.0%} of its heights lie outside {LOWEST:g} to {HIGHEST:g} m: "
            "they may be in another unit, such as centimetres; convert them, or declare their "
            "scale, e.g. with gdal_edit.py -scale 0.01."
        )
    raise TrustboError(
        f"{where}, which is no height on land: it is a fill value that no tag declares, or one "
        f"that resampling has blended with heights. Pass nodata={value!r}, or resample the raster "
        "again with its fill value declared."
    )


def warn_of_zeros(heights: np.ndarray, name: str) -> None:
    """Warn of pixels at exactly 0 m, far from all other heights: an undeclared fill value."""
    zero, low = heights == 0.0, np.abs(heights) <= 10.0
    others = np.isfinite(heights).sum() - zero.sum()
    if zero.any() and low.sum() < 1.1 * zero.sum() < 1.1 * others:  # else the ground is level
        warn(
            f"{name} is exactly 0 m on {zero.mean():.1%} of its pixels, and nearly nowhere else "
            "below 10 m: zeros may be missing heights; pass nodata=0 if they are."
        )


def vertical_of(name: str, declared: object, axis: Vertical | None) -> Vertical:
    """Find the unit and datum of heights; metres if nothing declares a unit.

    Args:
        name: Name of the raster.
        declared: Unit of the band, or of each band, of which the first is used; None if unknown.
        axis: Vertical axis of the CRS, if it has one.

    Raises:
        TrustboError: The unit is unknown, or band and CRS disagree.
    """
    text = str(np.ravel(np.array(declared, object))[0] or "").strip()
    if not text:
        return axis or Vertical()
    words = set(re.findall(r"[a-z]+", text.lower()))
    if words & _METRE and not words & _FOOT:
        unit, length = "m", 1.0
    elif words & _FOOT and not words & _METRE:
        unit, length = text, 1200.0 / 3937.0 if words & _US else 0.3048
    else:
        raise TrustboError(
            f"{name} has heights in {text!r}; metres and feet are known: convert them, or declare "
            "the true unit, e.g. with gdal_edit.py -units m."
        )
    if axis and abs(length / abs(axis.metres) - 1.0) > 1e-5:
        raise TrustboError(
            f"{name} has heights in {text!r} by its band, but in {axis.unit!r} by its CRS; declare "
            "the true unit, e.g. with gdal_edit.py -units m, or the true CRS, with -a_srs."
        )
    return axis._replace(unit=unit) if axis else Vertical(unit, length)
