"""DEM and DSM on one grid from classified lidar points."""

from collections.abc import Sequence
from os import PathLike, fspath
from typing import Any

import numpy as np
import xarray as xr
from rasterio.crs import CRS
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree, QhullError

from trustbo.errors import TrustboError, require_positive
from trustbo.files import FilePath
from trustbo.terrain.heights import HIGHEST, LOWEST
from trustbo.terrain.place import known_crs, require_map
from trustbo.terrain.read import check_size, read_terrain

GROUND_CLASS, NOISE_CLASSES = 2, (7, 18)
GROUND_GAP, MAX_GAP = 10.0, 3.0
"""Maximum distances of a pixel from a ground point and from the return that fills it, m."""


def read_lidar(
    points: FilePath | Sequence[FilePath], resolution: float = 1.0, *, crs: object = None
) -> xr.Dataset:
    """Grid classified lidar points into ground (DEM) and surface (DSM).

    The ground is interpolated at the pixel centres from a triangulation of the points of class 2;
    it is missing more than 10 m away from them. The surface is the highest return in each pixel. A
    pixel without returns has the height above ground of the nearest pixel with returns, up to 3 m
    away. Noise (classes 7 and 18) and withheld points are ignored. A million ground points take
    about 30 s and 1 GB.

    Args:
        points: A LAS or LAZ file, or the files of one survey.
        resolution: Pixel size, m; pixel edges are at its multiples.
        crs: Coordinate reference system of files without one, e.g. `"EPSG:32633"`.

    Returns:
        Dataset with `dem` and `dsm` as from `read_terrain`.

    Raises:
        TrustboError: laspy is not installed; a file is unreadable; there are no ground points, or
            heights are impossible; there is no projected CRS, or more than one; no pixel has both
            heights.
    """
    step, given = require_positive("resolution", resolution), crs and known_crs(crs)
    files = [points] if isinstance(points, str | PathLike) else list(points)
    tiles = [_read_tile(fspath(file), given) for file in files]
    if not tiles or len({tile[2].to_wkt() for tile in tiles}) > 1:
        raise TrustboError("give one LAS or LAZ file or more, all in one CRS.")
    xyz, label = (np.concatenate([tile[k] for tile in tiles]) for k in (0, 1))  # pyright: ignore[reportArgumentType, reportCallIssue]
    if not (label == GROUND_CLASS).any():
        raise TrustboError(
            f"{files[0]!r} has no ground points (class {GROUND_CLASS}); classify its ground, e.g. "
            "with PDAL's filters.smrf."
        )
    # Pixels count from the upper left corner; a point on an edge is in the pixel south or east.
    place = np.array([[1.0, -1.0]]) * xyz[:, :2] / step
    corner = np.floor(place.min(0) + 1e-6)
    shape = np.maximum(np.ceil(place.max(0) - 1e-6) - corner, 1.0).astype(int)
    check_size(tuple(shape.tolist()), f"a grid of {step:g} m")
    col, row = np.minimum((place - corner + 1e-6).astype(int), shape - 1).T
    x, y = (corner[0] + 0.5 + np.arange(shape[0])), -(corner[1] + 0.5 + np.arange(shape[1]))
    dem = _triangulated(xyz[label == GROUND_CLASS], x * step, y * step)
    highest = np.full(dem.shape, np.nan)
    np.fmax.at(highest, (row, col), xyz[:, 2])
    # Heights above ground: on a slope, absolute heights would make steps and false canopy.
    canopy = np.maximum(highest - dem, 0.0)
    nearest: Any = distance_transform_edt(np.isnan(canopy), step, return_indices=True)
    canopy = np.where(nearest[0] <= MAX_GAP, canopy[tuple(nearest[1])], np.nan)
    coords = {"y": y * step, "x": x * step}
    maps = (xr.DataArray(z, coords, ("y", "x")) for z in (dem, dem + canopy))
    return read_terrain(*(z.rio.write_crs(tiles[0][2]) for z in maps))


def _read_tile(path: str, given: CRS | None) -> tuple[np.ndarray, np.ndarray, CRS]:
    """Positions (point, 3) and classes (point,) of one file's usable points, and its CRS."""
    try:
        import laspy
    except ImportError:
        raise TrustboError("lidar needs laspy: python -m pip install 'laspy[lazrs]'") from None
    try:
        cloud = laspy.read(path)
        own = cloud.header.parse_crs()
    # A file cut short is a ValueError of NumPy's or a RuntimeError of lazrs' or PROJ's.
    except (laspy.errors.LaspyException, OSError, RuntimeError, ValueError) as error:
        raise TrustboError(f"{path!r} cannot be read as LAS or LAZ: {error}.") from None
    label = np.asarray(cloud.classification, np.uint8)
    usable = ~np.isin(label, NOISE_CLASSES) & (np.asarray(cloud.withheld) == 0)
    xyz = np.column_stack([cloud.x, cloud.y, cloud.z])[usable]  # pyright: ignore[reportArgumentType, reportCallIssue]
    wrong = (xyz[:, 2] < LOWEST) | (xyz[:, 2] > HIGHEST)
    if wrong.any():
        raise TrustboError(
            f"{path!r} has {wrong.sum()} points at heights that no land has, such as "
            f"{xyz[np.argmax(wrong), 2]:g} m; classify them as noise (7), or correct the unit."
        )
    crs = require_map(repr(path), own, given)
    if crs.is_geographic:
        raise TrustboError(f"{path!r} is in degrees; reproject its points to a UTM zone.")
    return xyz, label[usable], crs


def _triangulated(ground: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Heights of the triangulated ground points at pixel centres, NaN far from them, (row, col)."""
    lowest_first = ground[np.argsort(ground[:, 2], kind="stable")]
    places, lowest = np.unique(lowest_first[:, :2], axis=0, return_index=True)
    corner = np.array([x[0], y[0]])  # small coordinates keep the triangulation exact
    places, centres = places - corner, np.stack(np.meshgrid(x, y), axis=-1) - corner
    try:
        heights = LinearNDInterpolator(places, lowest_first[lowest, 2])(centres)
    except QhullError:
        raise TrustboError("the ground points (class 2) must span an area, not a line.") from None
    return np.where(KDTree(places).query(centres)[0] <= GROUND_GAP, heights, np.nan)
