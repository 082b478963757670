"""DEM and DSM on one grid from classified lidar points."""

import warnings
from collections.abc import Sequence
from os import PathLike, fspath
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import pyproj
import xarray as xr
from pyproj.exceptions import CRSError
from rasterio.crs import CRS
from rioxarray.exceptions import RioXarrayError
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.spatial import KDTree, QhullError

from trustbo.errors import TerrainError, pip_install, require_positive
from trustbo.files import FilePath
from trustbo.terrain.dataset import CLIP_WARNING_SHARE, assemble_terrain
from trustbo.terrain.metric import require_regular

GROUND_CLASS = 2
NOISE_CLASSES = (7, 18)  # low and high noise
NOISE = 0.25  # metres; error of returns and of the triangulation together
SPARSE_SHARE = 0.25  # largest share of pixels without a return before a warning
MAX_PIXELS = 100_000_000
_ROUNDING = 1e-6  # pixels: a point this near an edge lies on it, for any scale of a file
_REACH = 1.0 + 1e-9  # a point at the stated distance is still within it
_REPROJECT = "reproject the points to one UTM zone first, e.g. with PDAL's filters.reprojection"


class _Cloud(NamedTuple):
    """Points of a survey, without noise and withheld ones."""

    xyz: np.ndarray  # (point, 3), metres
    is_ground: np.ndarray  # (point,)
    crs: CRS
    names: str  # of the files, for messages


class _Pixels(NamedTuple):
    """Regular grid: pixel centres and size of a pixel, metres."""

    x: np.ndarray  # (col,), eastward
    y: np.ndarray  # (row,), southward
    width: float
    height: float

    @property
    def centres(self) -> np.ndarray:
        """Positions (row x col, 2) relative to the first one, exact to the last digit."""
        east, south = np.arange(len(self.x)) * self.width, np.arange(len(self.y)) * self.height
        return np.stack(np.meshgrid(east, -south), axis=-1).reshape(-1, 2)


def read_lidar(
    points: FilePath | Sequence[FilePath],
    resolution: float = 1.0,
    *,
    crs: object = None,
    max_gap: float = 3.0,
    ground_gap: float = 10.0,
    like: xr.DataArray | xr.Dataset | None = None,
) -> xr.Dataset:
    """Grid lidar points, ground classified, into ground (DEM) and surface (DSM).

    The ground is the triangulation of the points of class 2 at the pixel centres; water (class 9)
    is no ground. The surface is the highest return of a pixel; a pixel without returns takes the
    height above ground of the nearest one with returns. Noise (classes 7 and 18) and withheld
    points are left out. A million ground points take about 30 s and 1 GB.

    Args:
        points: A LAS or LAZ file, or the files of one survey.
        resolution: Pixel size, metres; pixel edges lie at its multiples. Not used with `like`.
        crs: Coordinate reference system of files without one, e.g. `"EPSG:32633"`.
        max_gap: Largest distance over which a return fills pixels without one, metres from centre
            to centre; the middle of a wider gap stays missing.
        ground_gap: Largest distance of a pixel from a ground point, metres; larger than `max_gap`,
            as canopy hides ground. In two forests, holes of 10 m radius cost 0.3 and 0.8 m RMSE.
        like: Raster with the grid of the result.

    Returns:
        Dataset with `dem` and `dsm` as from `read_terrain`; both are missing where one is.
        Attributes: `clipped_share` of the pixels had a surface below the ground, usually by
        centimetres, and were raised to it; `filled_share` have no return.

    Raises:
        TerrainError: No laspy; a file absent, unreadable or cut short; no points; ground points
            too few or in line; no projected CRS in true metres, or two; `like` elsewhere or
            irregular; no pixel with both heights.
        TrustboError: A resolution or gap that is not positive.
    """
    resolution = require_positive("resolution", resolution)
    max_gap = require_positive("max_gap", max_gap)
    ground_gap = require_positive("ground_gap", ground_gap)
    cloud = _read([points] if isinstance(points, str | PathLike) else list(points), crs)
    pixels = _pixels_over(cloud, resolution) if like is None else _pixels_of(like, cloud.crs)
    top = _highest(cloud, pixels)
    dem = _ground(cloud, pixels, ground_gap)
    dsm = _surface(dem, top, pixels, max_gap)
    if not np.isfinite(dsm).any():
        raise TerrainError(
            f"no pixel of {cloud.names} has ground within ground_gap={ground_gap:g} m and a return "
            f"within max_gap={max_gap:g} m; raise these two, or the resolution."
        )
    ground, surface = (
        xr.DataArray(z.reshape(len(pixels.y), -1), {"y": pixels.y, "x": pixels.x}, ("y", "x"))
        for z in (dem, dsm)
    )
    terrain = assemble_terrain(ground.rio.write_crs(cloud.crs), surface)
    return terrain.assign_attrs(_shares((top - dem)[np.isfinite(dsm)]))


def _read(paths: Sequence[FilePath], crs: object) -> _Cloud:
    """Usable points of all files."""
    if not paths:
        raise TerrainError("read_lidar was given no file; give one LAS or LAZ file or more.")
    names = ", ".join(repr(fspath(path)) for path in paths[:3]) + (", ..." if paths[3:] else "")
    tiles = [_read_tile(Path(path), crs) for path in paths]
    label = np.concatenate([tile[1] for tile in tiles])
    if not len(label):
        raise TerrainError(f"{names} has no points but noise and withheld ones; give a survey's.")
    if not (label == GROUND_CLASS).any():
        raise TerrainError(
            f"{names} has no ground points (class {GROUND_CLASS}), only those of class "
            f"{', '.join(map(str, np.unique(label)))}; classify it, e.g. with PDAL's filters.smrf."
        )
    projection = tiles[0][2]
    for path, (_, _, other) in zip(paths, tiles, strict=True):
        if other != projection:
            both = f"{fspath(path)!r} is in {other.to_string()}, but {fspath(paths[0])!r} in"
            raise TerrainError(f"{both} {projection.to_string()}; {_REPROJECT}.")
    xyz = np.concatenate([tile[0] for tile in tiles])
    onto_map = pyproj.Proj(projection.to_wkt())
    here = onto_map(*xyz[:, :2].mean(axis=0), inverse=True)
    if not abs(np.sqrt(onto_map.get_factors(*here).areal_scale) - 1.0) < 0.01:
        place = f"{projection.to_string()} is over 1 % off at {here[0]:.4g} E {here[1]:.4g} N"
        raise TerrainError(f"{names}: a metre of {place}; {_REPROJECT}.")
    return _Cloud(xyz, label == GROUND_CLASS, projection, names)


def _read_tile(path: Path, crs: object) -> tuple[np.ndarray, np.ndarray, CRS]:
    """Positions (point, 3) and classes (point,) of one file's usable points, and its CRS."""
    try:
        import laspy
    except ImportError:
        raise TerrainError(f"lidar needs laspy: {pip_install('laspy[lazrs]')}") from None
    if not path.is_file():
        raise TerrainError(f"there is no lidar file {str(path)!r}; check its path.")
    xyz, label, read = [np.empty((0, 3))], [np.empty(0, np.uint8)], 0
    try:
        with laspy.open(path) as reader:
            header, chunks = reader.header, cast(Any, reader.chunk_iterator(1_000_000))
            for chunk in chunks:
                read += len(chunk)
                classes = np.asarray(chunk.classification, np.uint8)
                usable = ~np.isin(classes, NOISE_CLASSES) & (np.asarray(chunk.withheld) == 0)
                xyz.append(np.column_stack([chunk.x, chunk.y, chunk.z])[usable])
                label.append(classes[usable])
        if read != header.point_count:
            raise ValueError(f"it ends after {read} of {header.point_count} points")
    # A file cut short is a ValueError of numpy's or a RuntimeError of lazrs'.
    except (laspy.errors.LaspyException, OSError, RuntimeError, ValueError) as error:
        raise TerrainError(
            f"{str(path)!r} cannot be read as LAS or LAZ ({error}); give a whole file, and for LAZ "
            f"{pip_install('laspy[lazrs]')}"
        ) from None
    return np.concatenate(xyz), np.concatenate(label), _crs_of(header, str(path), crs)


def _crs_of(header: Any, path: str, given: object) -> CRS:
    """Horizontal CRS of a file in metres, from its header or as given."""
    try:
        crs = header.parse_crs()
    except CRSError:
        crs = None
    # Degrees or a local system with coordinates of a map: the header lacks the projection.
    on_a_map = np.abs(header.maxs[:2]).max() > 360.0
    if crs is None or (on_a_map and not crs.is_projected and not crs.is_geocentric):
        try:
            crs = pyproj.CRS.from_user_input(given)
        except CRSError:
            problem = f"{path!r} has no CRS of its own, and crs={given!r} is none PROJ knows"
            raise TerrainError(f"{problem}; pass e.g. crs='EPSG:32633'.") from None
    return _horizontal(crs, repr(path))


def _horizontal(crs: pyproj.CRS, name: str) -> CRS:
    """Horizontal part of a CRS; its axes must be in metres."""
    if not crs.is_projected:
        raise TerrainError(f"{name} is in {crs.name}, which is no projected CRS; {_REPROJECT}.")
    for axis in crs.axis_info:
        if abs(axis.unit_conversion_factor - 1.0) > 1e-9:
            raise TerrainError(
                f"{name}: {axis.name} in {axis.unit_name}, not metres; {_REPROJECT}."
            )
    return CRS.from_wkt(crs.to_2d().to_wkt())


def _pixels_over(cloud: _Cloud, resolution: float) -> _Pixels:
    """Pixels that cover all points, edges at multiples of the resolution."""
    low, high = (edge / resolution for edge in (cloud.xyz[:, :2].min(0), cloud.xyz[:, :2].max(0)))
    first, end = np.floor(low + _ROUNDING), np.ceil(high - _ROUNDING)
    n_cols, n_rows = (int(n) for n in end - first)
    if min(n_cols, n_rows) < 2 or n_cols * n_rows > MAX_PIXELS:
        raise TerrainError(
            f"resolution {resolution:g} m makes {n_rows} x {n_cols} pixels of {cloud.names}; need "
            f"2 x 2, and {MAX_PIXELS:g} at most: change it, or remove stray points."
        )
    x, y = first[0] + 0.5 + np.arange(n_cols), end[1] - 0.5 - np.arange(n_rows)
    return _Pixels(x * resolution, y * resolution, resolution, resolution)


def _pixels_of(like: xr.DataArray | xr.Dataset, crs: CRS) -> _Pixels:
    """Pixels of a raster in the same CRS."""
    if like.rio.crs is None:
        raise TerrainError("like has no CRS; set it, e.g. like.rio.write_crs('EPSG:32633').")
    raster_crs = _horizontal(pyproj.CRS.from_wkt(like.rio.crs.to_wkt()), "like")
    if raster_crs != crs:
        raise TerrainError(
            f"like is in {raster_crs.to_string()}, but the points in {crs.to_string()}; reproject "
            "it, e.g. with like.rio.reproject."
        )
    try:
        dims = like.rio.x_dim, like.rio.y_dim
    except RioXarrayError as error:
        raise TerrainError(f"like has no x and y axes ({error}); give a raster.") from None
    for dim in dims:
        require_regular(like[dim].values, dim, "like")
    x, y = (np.sort(like[dim].values) for dim in dims)
    return _Pixels(x, y[::-1], np.ptp(x) / (len(x) - 1), np.ptp(y) / (len(y) - 1))


def _ground(cloud: _Cloud, pixels: _Pixels, ground_gap: float) -> np.ndarray:
    """Triangulated ground at the pixel centres (row x col,), NaN far from ground points."""
    ground = cloud.xyz[cloud.is_ground]
    ground = ground[np.lexsort(ground.T[::-1])]  # by x, then y, then height
    lowest = np.r_[True, (np.diff(ground[:, :2], axis=0) != 0.0).any(axis=1)]
    # Relative to a pixel: small coordinates keep the triangulation exact.
    places = ground[lowest, :2] - [pixels.x[0], pixels.y[0]]
    try:
        interpolate = LinearNDInterpolator(places, ground[lowest, 2])
    except (QhullError, ValueError):
        raise TerrainError(
            f"the {len(places)} ground points (class {GROUND_CLASS}) of {cloud.names} are too few "
            "or in line: it takes three that span an area; classify more ground."
        ) from None
    centres, dem = pixels.centres, np.full(len(pixels.x) * len(pixels.y), np.nan)
    distance, _ = KDTree(places).query(centres, distance_upper_bound=ground_gap * _REACH)
    near = np.isfinite(distance)
    dem[near] = interpolate(centres[near])
    return dem


def _highest(cloud: _Cloud, pixels: _Pixels) -> np.ndarray:
    """Highest return in each pixel (row x col,), NaN without one."""
    shape, steps = np.array([len(pixels.x), len(pixels.y)]), [pixels.width, -pixels.height]
    cell = (cloud.xyz[:, :2] - [pixels.x[0], pixels.y[0]]) / steps + 0.5
    inside = ((cell > -_ROUNDING) & (cell < shape + _ROUNDING)).all(axis=1)
    if not inside.any():
        (left, bottom), (right, top) = cloud.xyz[:, :2].min(0), cloud.xyz[:, :2].max(0)
        raise TerrainError(
            f"like covers no point of {cloud.names}, x {left:.1f} to {right:.1f} and y "
            f"{bottom:.1f} to {top:.1f}; give a raster of that place."
        )
    # A point on an edge belongs to the pixel east or south of it, on the last edge to the last.
    col, row = np.minimum((cell[inside] + _ROUNDING).astype(int), shape - 1).T
    highest = np.full(shape.prod(), np.nan)
    np.fmax.at(highest, row * shape[0] + col, cloud.xyz[inside, 2])
    return highest


def _surface(dem: np.ndarray, top: np.ndarray, pixels: _Pixels, max_gap: float) -> np.ndarray:
    """Returns, raised to the ground, with the gaps between them filled, (row x col,)."""
    surface, gap, centres = np.maximum(top, dem), np.isnan(top), pixels.centres
    # Heights above ground: on a slope, absolute heights would make steps and false canopy.
    canopy = NearestNDInterpolator(centres[~gap], (surface - dem)[~gap])
    surface[gap] = dem[gap] + canopy(centres[gap], distance_upper_bound=max_gap * _REACH)
    return surface


def _shares(above: np.ndarray) -> dict[str, float]:
    """Attributes of the result, from the highest returns above ground, NaN without one."""
    filled, clipped, deep = np.isnan(above).mean(), (above < 0).mean(), (above < -NOISE).mean()
    if filled > SPARSE_SHARE:
        warnings.warn(
            f"{filled:.0%} of pixels hold no return and take the canopy of the nearest that does; "
            "take a coarser resolution.",
            stacklevel=3,
        )
    # The warning of assemble_terrain is about vertical datums; one survey has only one.
    if deep > CLIP_WARNING_SHARE:
        warnings.warn(
            f"on {deep:.1%} of pixels the highest return lies over {NOISE:g} m below the ground, "
            "to which it is raised; check the classes of the points.",
            stacklevel=3,
        )
    return {"clipped_share": float(clipped), "filled_share": float(filled)}
