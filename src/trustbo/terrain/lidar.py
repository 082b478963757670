"""DEM and DSM on one grid from classified lidar points."""

from os import PathLike
from os.path import expanduser
from typing import Any

import numpy as np
import xarray as xr
from pyproj import CRS
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import distance_transform_edt
from scipy.spatial import QhullError

from trustbo.errors import TrustboError, require_kind, require_positive
from trustbo.files import FilePath
from trustbo.terrain.heights import HIGHEST, LOWEST
from trustbo.terrain.place import require_map, require_proj, vertical_axis
from trustbo.terrain.read import check_size, require_terrain

_GROUND_GAP = 10.0
"""Maximum distance of a pixel to one with ground points, m."""
_MAX_GAP = 3.0
"""Maximum distance of a pixel without returns to the one that fills it, m."""
_GROUND = 2  # class of ground points (ASPRS LAS 1.4)
_ROUNDING = 1e-6  # pixels; points this close to an edge are on it
_NOISE = (7, 18)  # classes of low and high noise


def read_lidar(points: FilePath, resolution: float = 1.0, *, crs: object = None) -> xr.Dataset:
    """Grid classified lidar points into ground (DEM) and surface (DSM).

    The ground is interpolated at the pixel centres from a triangulation of the points of class 2;
    it is NaN more than 10 m away from pixels with such points. The surface is the highest return in
    each pixel. A pixel without returns takes the height above ground of the nearest pixel with
    returns, up to 3 m away. Noise (classes 7 and 18) and withheld points are ignored.

    Args:
        points: A LAS or LAZ file.
        resolution: Pixel size, m; pixel edges are at multiples of it.
        crs: Coordinate reference system, if the file has none, e.g. `"EPSG:32633"`.

    Returns:
        Dataset with `dem` and `dsm` as from `read_terrain`.

    Raises:
        TrustboError: laspy is not installed; the file is unreadable or has no projected CRS; there
            are no points or no ground points; heights are impossible; or no pixel has both heights.

    Example:
        >>> terrain = tb.terrain.read_lidar("points.laz", resolution=1.0)
        >>> workspace = tb.Workspace.from_terrain(terrain, shape=(4, 4))
    """
    step = require_positive("resolution", resolution)
    remedy = "give the path of one file; merge tiles first, e.g. with pdal merge"
    path = expanduser(require_kind("points", points, str | PathLike, remedy))
    require_proj()
    xyz, is_ground, own = _read_points(path, crs)

    # Pixels are counted from the upper left; points on an edge are in the pixel south or east.
    place = np.array([[1.0, -1.0]]) * xyz[:, :2] / step
    corner = np.floor(place.min(0) + _ROUNDING)
    cols, rows = np.maximum(np.ceil(place.max(0) - _ROUNDING) - corner, 1.0).astype(int).tolist()
    check_size((rows, cols), f"a grid of {step:g} m")
    col, row = np.minimum((place - corner + _ROUNDING).astype(int), [cols - 1, rows - 1]).T

    highest = np.full((rows, cols), np.nan)
    no_ground = np.ones((rows, cols), bool)
    np.fmax.at(highest, (row, col), xyz[:, 2])
    no_ground[row[is_ground], col[is_ground]] = False

    # Coordinates relative to the corner keep the triangulation exact.
    centres = np.stack(np.meshgrid(np.arange(cols) + 0.5, np.arange(rows) + 0.5), axis=-1)
    try:
        dem = LinearNDInterpolator((place - corner)[is_ground], xyz[is_ground, 2])(centres)
    except (QhullError, ValueError):
        raise TrustboError(
            "the ground points (class 2) must span an area; classify the ground, e.g. with PDAL's "
            "filters.smrf."
        ) from None
    dem[np.asarray(distance_transform_edt(no_ground, step)) > _GROUND_GAP] = np.nan

    # Heights above ground: on a slope, absolute heights would create steps and false canopy.
    canopy = np.maximum(highest - dem, 0.0)
    nearest: Any = distance_transform_edt(np.isnan(canopy), step, return_indices=True)
    canopy = np.where(nearest[0] <= _MAX_GAP, canopy[tuple(nearest[1])], np.nan)

    x = (corner[0] + centres[0, :, 0]) * step
    y = -(corner[1] + centres[:, 0, 1]) * step
    surface = dem + canopy
    ground = np.where(np.isfinite(surface), dem, np.nan)

    maps = {"dem": (("y", "x"), ground), "dsm": (("y", "x"), surface)}
    return require_terrain(xr.Dataset(maps, {"y": y, "x": x}).rio.write_crs(own.to_string()))


def _read_points(path: str, given: object) -> tuple[np.ndarray, np.ndarray, CRS]:
    """Read positions (point, 3) of a file's usable points, whether each is ground, and the CRS."""
    try:
        import laspy
    except ImportError:
        raise TrustboError("lidar needs laspy: python -m pip install 'laspy[lazrs]'") from None
    try:
        cloud = laspy.read(path)
        own = cloud.header.parse_crs()
    # A truncated file raises ValueError in NumPy, or RuntimeError in lazrs or PROJ.
    except (laspy.errors.LaspyException, OSError, RuntimeError, ValueError) as error:
        raise TrustboError(f"{path!r} cannot be read as LAS or LAZ: {error}.") from None

    label = np.asarray(cloud.classification, np.uint8)
    usable = ~np.isin(label, _NOISE) & (np.asarray(cloud.withheld) == 0)

    if not usable.any():
        raise TrustboError(f"{path!r} has no points, or all of them are noise or withheld.")

    crs = require_map(repr(path), own, given)
    if crs.is_geographic:
        raise TrustboError(f"{path!r} is in degrees; reproject its points to a UTM zone.")

    xyz = np.column_stack([cloud.x, cloud.y, cloud.z])[usable]  # pyright: ignore[reportArgumentType, reportCallIssue]
    unit, _ = vertical_axis(crs)  # the heights are converted with the rasters
    metres = xyz[:, 2] * (unit or 1.0)
    if ((metres < LOWEST) | (metres > HIGHEST)).any():
        raise TrustboError(
            f"{path!r} has points outside {LOWEST:g} to {HIGHEST:g} m; classify them as noise (7), "
            "or correct the unit."
        )
    return xyz, label[usable] == _GROUND, crs
