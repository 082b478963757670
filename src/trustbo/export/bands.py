"""Bands of a raster from maps of xarray: their names, and their place by their own coordinates."""

import itertools
from collections.abc import Iterator

import numpy as np
import xarray as xr
from rasterio.transform import Affine

from trustbo.errors import TrustboError, one_line

_TOLERANCE = 0.01
"""Largest distance of a coordinate from its place in an even row, as a fraction of the pixel."""
_MOST_BANDS = 65_535
"""Largest number of bands of a GeoTIFF."""
_REMEDY = (
    "give maps as from `result.maps()` or `result.robot_maps()`, which may be cut, thinned evenly "
    "or coarsened"
)
_UNKNOWN_SIZE = (
    f"the maps have a single row or column, whose size their coordinates do not tell; {_REMEDY}."
)


def north_up(maps: xr.Dataset) -> tuple[xr.Dataset, Affine]:
    """Return maps with north at the top and west at the left, and the transform of their pixels.

    The transform is that of the coordinates `x` and `y`. The stored one, which xarray does not
    change when it selects or averages pixels, is only read for the width of a single row or column.

    Raises:
        TrustboError: The maps lack the coordinates, or these are not numbers at equal distances.
    """
    for axis in ("y", "x"):
        if axis not in maps.coords or maps[axis].dims != (axis,):
            raise TrustboError(
                f"the maps have the dims {tuple(maps.sizes)} without coordinates along {axis!r}; "
                f"{_REMEDY}."
            )

    placed = maps.sortby("y", ascending=False).sortby("x")
    tall = -_step("y", placed["y"].values)
    wide = _step("x", placed["x"].values)

    # A single row or column has no distance to a next one.
    if np.isnan(tall) or np.isnan(wide):
        stored_wide, stored_tall = _stored_steps(placed, wide, tall)
        wide = stored_wide if np.isnan(wide) else wide
        tall = stored_tall if np.isnan(tall) else tall

    left = float(placed["x"][0]) - 0.5 * wide
    top = float(placed["y"][0]) + 0.5 * tall
    return placed, Affine(wide, 0.0, left, 0.0, -tall, top)


def _step(axis: str, values: np.ndarray) -> float:
    """Return the distance of sorted coordinates; NaN for one; TrustboError if it is not even."""
    if not len(values) or values.dtype.kind not in "iuf" or not np.isfinite(values).all():
        raise TrustboError(
            f"the coordinates {axis!r} of the maps must be finite numbers; got "
            f"{one_line(values.tolist())}; {_REMEDY}."
        )
    if len(values) == 1:
        return np.nan

    rounding = float(np.spacing(np.abs(values.astype(np.result_type(values, np.float32))).max()))
    values = values.astype(float)
    step = float(values[-1] - values[0]) / (len(values) - 1)
    even = np.linspace(values[0], values[-1], len(values))
    if abs(step) <= rounding or np.abs(values - even).max() > max(_TOLERANCE * abs(step), rounding):
        raise TrustboError(
            f"the coordinates {axis!r} of the maps are not at equal distances, as a GeoTIFF needs: "
            f"{one_line(values.tolist())}; {_REMEDY}."
        )
    return step


def _stored_steps(maps: xr.Dataset, wide: float, tall: float) -> tuple[float, float]:
    """Return the stored width and height of a pixel, if it is that of the coordinates.

    Args:
        maps: Maps with a single row or column.
        wide: Distance of columns; NaN for a single one.
        tall: Distance of rows; NaN for a single one.
    """
    stored = [float(number) for number in _stored_transform(maps).split()]
    if len(stored) != 6:
        raise TrustboError(_UNKNOWN_SIZE)

    left, width, _, top, _, height = stored
    steps = width, -height
    same = all(
        np.isnan(step) or abs(step - own) <= _TOLERANCE * own
        for step, own in zip((wide, tall), steps, strict=True)
    )
    offsets = (
        (float(maps["x"][0]) - left) / width - 0.5,
        (float(maps["y"][0]) - top) / height - 0.5,
    )
    is_centre = all(abs(offset - round(offset)) <= _TOLERANCE for offset in offsets)

    if not (same and is_centre):
        raise TrustboError(_UNKNOWN_SIZE)
    return steps


def _stored_transform(maps: xr.Dataset) -> str:
    """Return the transform that is stored with the CRS, as text; empty if there is none."""
    name = maps.rio.grid_mapping
    return str(maps[name].attrs.get("GeoTransform", "")) if name in maps.coords else ""


def bands_of(maps: xr.Dataset) -> list[tuple[str, xr.DataArray]]:
    """Return the name and the map (y, x) of each band.

    A variable with further axes, such as robots, has a band for each of their labels: "trust_mean
    r1", "trust_mean r2".

    Raises:
        TrustboError: There are no maps, or a variable has no rows and columns or holds no numbers.
    """
    bands = []
    for name, values in maps.data_vars.items():
        if not {"y", "x"} <= set(values.dims):
            raise TrustboError(
                f"{str(name)!r} is no map: it has the dims {values.dims} instead of (y, x); leave "
                f"it out, e.g. with maps.drop_vars({str(name)!r})."
            )
        if values.dtype.kind not in "biuf":
            raise TrustboError(
                f"{str(name)!r} has values of type {values.dtype}, and a GeoTIFF holds numbers; "
                f"leave it out, e.g. with maps.drop_vars({str(name)!r})."
            )

        others = [str(dim) for dim in values.dims if dim not in ("y", "x")]
        n_bands = int(np.prod([values.sizes[dim] for dim in others], dtype=int))
        if len(bands) + n_bands > _MOST_BANDS:
            raise TrustboError(
                f"{str(name)!r} has {n_bands} maps, more than a GeoTIFF can hold; average them, "
                f"e.g. with maps.mean({others[0]!r})."
            )
        bands += _bands_along(str(name), values, others)

    if not bands:
        raise TrustboError(f"there are no maps to write: the dataset has no variables; {_REMEDY}.")
    return bands


def _bands_along(
    name: str, values: xr.DataArray, dims: list[str]
) -> Iterator[tuple[str, xr.DataArray]]:
    """Yield the name and the map of each combination of labels along some axes."""
    for place in itertools.product(*(range(values.sizes[dim]) for dim in dims)):
        at = dict(zip(dims, place, strict=True))
        labels = [_label(values, dim, i) for dim, i in at.items()]
        yield " ".join([name, *labels]), values.isel(at).transpose("y", "x")


def _label(values: xr.DataArray, dim: str, i: int) -> str:
    """Return the label of a place along an axis; its name and number if it has no labels."""
    if dim not in values.coords:
        return f"{dim} {i}"
    label = values[dim].values[i]
    return str(label) if isinstance(label, str) else f"{dim} {label}"
