"""Decoding of stored values to heights: fill values, masks, scale and offset."""

from collections.abc import Callable

import numpy as np
import xarray as xr
from numpy.typing import DTypeLike

from trustbo.errors import TerrainError

# Everest is 8849 m, the deepest dry land -430 m; -999, +-9999, -32768 and 3e38 mean "missing".
HIGHEST = 9000.0
FILL_NAMES = ("_FillValue", "missing_value", "fill_value", "nodata")


def tagged(array: xr.DataArray, name: str) -> list[float]:
    """Values declared missing by an array's attributes and encoding."""
    notes = [array.attrs, array.encoding]
    # The encoding has been applied: with a scale, its fill value is no height.
    if {"scale_factor", "add_offset", "scales", "offsets"} & set(array.encoding):
        notes.pop()
    tags = [t for note in notes for key in FILL_NAMES if key in note for t in np.ravel(note[key])]
    try:
        return [float(tag) for tag in tags if tag is not None]
    except (TypeError, ValueError):
        listed = ", ".join(map(str, tags))
        raise TerrainError(
            f"{name} has a nodata attribute that is no number: {listed}; correct it."
        ) from None


def scaling(array: xr.DataArray, name: str) -> tuple[float, float]:
    """Scale and offset still to apply: attributes, not encoding."""
    if {"scales", "offsets"} & set(array.attrs):
        raise TerrainError(
            f"{name} has bands scaled differently; open it with "
            "rioxarray.open_rasterio(path, mask_and_scale=True), or give its path."
        )
    return float(array.attrs.get("scale_factor", 1.0)), float(array.attrs.get("add_offset", 0.0))


def require_real(dtype: DTypeLike, name: str) -> None:
    """Check that values are real numbers."""
    if np.dtype(dtype).kind not in "iuf":
        raise TerrainError(f"{name} holds {dtype}, which are no heights; give whole or real ones.")


def decoder(
    name: str, fills: list[float], scale: float, offset: float, unit: float = 1.0
) -> Callable[[np.ndarray, np.ndarray | None, int, int], np.ndarray]:
    """Make the function from stored values to heights in metres, NaN where missing.

    Stored `fills` mean missing; heights are `scale` * stored + `offset`, in units of `unit` metres.
    The raster's name is for messages.
    """

    def decode(stored: np.ndarray, missing: np.ndarray | None, row: int, column: int) -> np.ndarray:
        heights = stored.astype(float)
        if missing is None:
            missing = np.zeros(stored.shape, bool)
        for fill in fills:
            missing |= heights == _as_stored(fill, stored.dtype)
        if (scale, offset) != (1.0, 0.0):
            heights *= scale
            heights += offset
        missing |= ~np.isfinite(heights)
        heights[missing] = np.nan
        # Low heights in the stored unit: -9999 feet are a fill value too.
        wrong = (heights >= HIGHEST / unit) | (heights <= -HIGHEST) | (heights == -999.0)
        if unit != 1.0:
            heights *= unit
        if wrong.any():
            r, c = np.unravel_index(np.argmax(wrong), wrong.shape)
            value, height = float(stored[r, c]), heights[r, c]
            scaled = "" if value == height else f", scaled to {height:g} m"
            raise TerrainError(
                f"{name} holds {value!r}{scaled}, at row {row + r}, column {column + c}: no height "
                f"on land, so probably a fill value that no nodata tag declares. Pass "
                f"nodata={value!r}, or set the tag, e.g. with gdal_edit.py -a_nodata {value!r}."
            )
        return heights

    return decode


def _as_stored(value: float, dtype: np.dtype) -> float:
    """Value rounded to the raster's type: float32 holds no -3.4e38."""
    with np.errstate(over="ignore"):
        return float(dtype.type(value)) if dtype.kind == "f" else value
