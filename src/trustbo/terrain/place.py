"""Georeferencing: CRS of rasters, and warping to metric maps with north at the top."""

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import rasterio.crs
import xarray as xr
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError
from rasterio.enums import Resampling
from rasterio.errors import CRSError as RasterioCRSError

from trustbo.errors import TrustboError

_NORTH = 22.5  # degrees; half the angle between two neighbouring moves
_DISTORTION = 0.01  # relative error of lengths from which a map is warped
_SMALLEST = 0.01  # m; smaller pixels of a map are in degrees
_DEGREE = 111_320.0  # m: length of a degree of latitude
_STEP = 100.0  # m; distance over which a map's directions and lengths are measured


_OF_PROJ = ("PROJ_DATA", "PROJ_LIB")
"""Environment variables that replace the data of PROJ."""


def require_proj() -> None:
    """Check that rasterio and pyproj find PROJ's database, without which they know no CRS.

    Call this function before either makes a CRS. Raises TrustboError if they do not, which is
    usual if QGIS, ROS or conda has set the folder of another version of PROJ.
    """
    try:
        rasterio.crs.CRS.from_epsg(4326)
        CRS.from_epsg(4326)
    except (RasterioCRSError, CRSError) as error:
        given = [f"{name}={os.environ[name]!r}" for name in _OF_PROJ if name in os.environ]
        reason = " ".join(str(error).split())
        raise TrustboError(
            "the database of PROJ, which defines coordinate reference systems, cannot be used: "
            f"{reason}. Unset the environment variables PROJ_DATA and PROJ_LIB (now "
            f"{', '.join(given) or 'neither is set'}), or reinstall rasterio and pyproj."
        ) from None


@contextmanager
def quiet_affine() -> Iterator[None]:
    """Ignore affine's PendingDeprecationWarning for products that rioxarray computes.

    Users may turn warnings into errors (`python -W error`), but cannot change these products.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Use `@` matmul", PendingDeprecationWarning)
        yield


def require_map(name: str, own: Any, given: Any) -> CRS:
    """Return a raster's CRS, in degrees or metres: its own, or the given one if it has none.

    Raises TrustboError if the CRS is missing, not the given one, or not in degrees or metres.
    """
    if own is None and given is None:
        raise TrustboError(f"{name} has no coordinate reference system; pass crs=.")

    try:
        declared = [CRS.from_user_input(one) for one in (own, given) if one is not None]
    except CRSError:
        raise TrustboError(f"crs {given!r} is unknown to PROJ; give e.g. 'EPSG:32633'.") from None

    crs = declared[0]
    flat = horizontal(crs)
    if not flat.equals(horizontal(declared[-1]), ignore_axis_order=True):
        raise TrustboError(
            f"{name} is in {crs.to_string()}, but crs= is {given}; leave crs= out, or correct the "
            "raster's own CRS, e.g. with gdal_edit.py -a_srs."
        )

    if not flat.is_geographic and not _is_in_metres(flat):
        raise TrustboError(
            f"{name} is in {crs.to_string()}, which is neither in degrees nor in metres; warp it, "
            "e.g. with gdalwarp -t_srs EPSG:32633."
        )
    return crs


def _is_in_metres(crs: CRS) -> bool:
    """Return whether a CRS is a map whose coordinates are in metres."""
    return crs.is_projected and abs(crs.axis_info[0].unit_conversion_factor - 1.0) <= 1e-9


def horizontal(crs: CRS) -> CRS:
    """Return the CRS without its vertical axis."""
    return crs.to_2d()


def vertical_axis(crs: CRS) -> tuple[float | None, str | None]:
    """Return the unit of a CRS's vertical axis in metres, negative for depths, and its datum."""
    part = crs.sub_crs_list[-1] if crs.is_compound else crs
    if part.is_bound and part.source_crs is not None:  # heights tied to a grid of the geoid
        part = part.source_crs

    axis = part.axis_info[-1] if part.axis_info else None
    if axis is None or axis.direction not in ("up", "down"):
        return None, None

    length = axis.unit_conversion_factor
    datum = "the ellipsoid"
    if part.is_vertical:
        datum = part.name if part.datum is None else part.datum.name
    return length if axis.direction == "up" else -length, datum


def placed(heights: xr.DataArray, name: str) -> xr.DataArray:
    """Check that a raster is on Earth, and shift longitudes to -180 to 180."""
    crs = heights.rio.crs
    y, x = (heights[axis].values for axis in ("y", "x"))
    middle = 0.5 * (x[0] + x[-1])
    side = min(abs(x[1] - x[0]), abs(y[1] - y[0]))

    if crs.is_geographic:
        if max(abs(y[0]), abs(y[-1])) <= 90.0 and abs(middle) <= 540.0:
            return heights.assign_coords(x=x - 360.0 * round(middle / 360.0))
    elif side >= _SMALLEST and np.isfinite(_middle(heights, "EPSG:4326")).all():
        return heights

    raise TrustboError(
        f"{name} has coordinates around ({middle:.8g}, {y[len(y) // 2]:.8g}) and pixels of "
        f"{side:.2g}, which is impossible in its CRS, {crs.to_string()}; correct the CRS."
    )


def _middle(heights: xr.DataArray, crs: str, step: float = 0.0) -> np.ndarray:
    """Convert a raster's centre, and points one step east and north of it, to another CRS.

    The result is infinite if the centre is outside the domain of the raster's CRS.
    """
    x, y = (0.5 * float(heights[axis][0] + heights[axis][-1]) for axis in ("x", "y"))
    return np.array(converted(heights.rio.crs, crs, [x, x + step, x], [y, y, y + step]))


def on_metric_grid(heights: xr.DataArray) -> xr.DataArray:
    """Warp heights to a metric map with north at the top, unless they are already on one."""
    lon, lat = _middle(heights, "EPSG:4326")[:, 0].tolist()
    at = f"+lat_0={lat} +lon_0={lon} +datum=WGS84 +units=m"
    if not heights.rio.crs.is_geographic:
        here, to_east, to_north = _middle(heights, f"+proj=aeqd {at}", step=_STEP).T / _STEP
        east, up = to_east - here
        right, north = to_north - here

        turned = np.rad2deg(np.arctan2([up, right], [east, north]))
        lengths = np.hypot([east, right], [up, north])
        if (abs(lengths - 1.0) < _DISTORTION).all() and np.abs(turned).max() < _NORTH:
            return heights

    zone = f"EPSG:{(32600 if lat >= 0.0 else 32700) + int((lon + 180.0) // 6.0) % 60 + 1}"
    if not -80.0 <= lat <= 84.0:  # no UTM zone
        zone = f"+proj=tmerc {at}"

    with quiet_affine():
        return heights.rio.reproject(zone, resampling=Resampling.bilinear, nodata=np.nan)


def converted(source: Any, target: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """Convert positions to another CRS, where x is the easting or longitude in either CRS.

    `x` and `y` are numbers or arrays, and so is the result. Coordinates are infinite where the
    conversion is impossible.
    """
    return Transformer.from_crs(source, target, always_xy=True).transform(x, y)


def pixel_side(heights: xr.DataArray) -> float:
    """Return the shorter side of a raster's pixels in metres; approximate for degrees."""
    side = _shorter_side(heights)
    return side * _DEGREE if heights.rio.crs.is_geographic else side


def _shorter_side(heights: xr.DataArray) -> float:
    """Return the shorter side of a raster's pixels in the unit of its CRS."""
    with quiet_affine():
        return min(abs(side) for side in heights.rio.resolution())


def same_grid(a: xr.DataArray, b: xr.DataArray) -> bool:
    """Return whether the pixels of two rasters coincide within a thousandth of a pixel."""
    if a.shape != b.shape or a.rio.crs != b.rio.crs:
        return False
    with quiet_affine():
        rounding = 1e-3 * _shorter_side(a)
        return np.allclose(a.rio.bounds(), b.rio.bounds(), rtol=0.0, atol=rounding)
