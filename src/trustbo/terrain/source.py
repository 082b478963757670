"""Opening one raster of any kind: heights by window, in float, NaN where missing."""

import atexit
import dataclasses
import os
import threading
import warnings
import weakref
from collections.abc import Hashable
from contextlib import ExitStack
from os import PathLike

import numpy as np
import rasterio
import xarray as xr
from rasterio import Affine
from rasterio.crs import CRS
from rasterio.enums import MaskFlags
from rasterio.errors import CRSError, NotGeoreferencedWarning, RasterioError
from rasterio.io import DatasetReader
from rasterio.transform import from_origin
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window
from rioxarray.exceptions import MissingSpatialDimensionError

from trustbo.errors import TerrainError, require_positive
from trustbo.terrain.decode import decoder, require_real, scaling, tagged
from trustbo.terrain.rasterview import Raster

type RasterLike = str | PathLike[str] | DatasetReader | WarpedVRT | xr.DataArray | xr.Dataset

# A GDAL dataset serves one thread at a time.
GDAL_LOCK = threading.Lock()
# Blocks that GDAL keeps, bytes; by default a twentieth of the machine's memory. A strip needs few.
CACHE = 64_000_000
_opened: weakref.WeakSet[DatasetReader] = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    """Close what a lazy terrain left open: rasterio can no longer do so when Python is gone."""
    for dataset in list(_opened):
        dataset.close()


def open_raster(
    source: RasterLike,
    role: str,
    closing: ExitStack,
    *,
    crs: object = None,
    resolution: float | None = None,
    nodata: float | None = None,
) -> Raster:
    """Open a raster, first band, without reading its heights; the rest is as in `read_terrain`.

    Args:
        source: A path, which `closing` closes, or an open dataset or array, which stays open.
        role: What messages call it: dem or dsm.
        closing: Who closes what is opened here.
        crs: Of a raster that has none.
        resolution: Of a raster that is not georeferenced, m.
        nodata: A further value that means missing, as stored.

    Returns:
        The raster, north up, in degrees or metres.

    Raises:
        TerrainError: What cannot be terrain. Reading raises one where the file is damaged, or holds
            a fill value that nothing declares as such.
    """
    try:
        fill = [] if nodata is None else [float(nodata)]
    except (TypeError, ValueError):
        raise TerrainError(f"nodata must be a number; got {nodata!r}.") from None
    if isinstance(source, xr.DataArray | xr.Dataset):
        raster, referenced = _from_array(source, role, fill)
    elif isinstance(source, DatasetReader | WarpedVRT):
        raster, referenced = _from_dataset(source, f"{role}: {source.name!r}", fill)
    elif isinstance(source, str | PathLike):
        dataset = _open_file(os.fspath(source), role)
        closing.callback(dataset.close)
        _opened.add(dataset)
        raster, referenced = _from_dataset(dataset, f"{role}: {os.fspath(source)!r}", fill)
    else:
        raise TerrainError(
            f"{role} must be a path, a rasterio dataset open for reading, or an xarray.DataArray; "
            f"got {type(source).__name__}."
        )
    return _placed(raster, referenced, crs, resolution)


def require_metric_crs(crs: CRS | None, name: str) -> None:
    """Refuse a CRS that does not measure metres.

    Raises:
        TerrainError: There is none, or it is in degrees or another unit.
    """
    if crs is None:
        raise TerrainError(f"{name} has no CRS; set it, e.g. dem.rio.write_crs('EPSG:32633').")
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
    """Refuse coordinates that are not evenly spaced.

    Raises:
        TerrainError: They are not, or fewer than two.
    """
    steps = np.diff(values)
    if not len(steps) or not np.allclose(steps, steps[0], rtol=1e-3) or steps[0] == 0.0:
        raise TerrainError(
            f"{name}'s {axis} is not a regular axis of two pixels or more; resample it to evenly "
            "spaced, sorted coordinates."
        )


def _open_file(path: str, role: str) -> DatasetReader:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            return rasterio.open(path)
    except RasterioError as error:
        # GDAL's own addresses (/vsizip/..., https://..., NETCDF:...) are no files to look for.
        if not os.path.exists(path) and not path.startswith("/vsi") and ":" not in path[2:]:
            raise TerrainError(f"{role}: there is no file {path!r}.") from None
        raise TerrainError(
            f"{role}: {path!r} is no raster that GDAL can read ({error}); "
            "give a GeoTIFF or another raster format."
        ) from None


def _from_dataset(
    dataset: DatasetReader | WarpedVRT, name: str, fill: list[float]
) -> tuple[Raster, bool]:
    """The first band of a GDAL dataset, and whether it is georeferenced."""
    if dataset.closed:
        raise TerrainError(f"{name} is closed; open it, and leave it open while it is read.")
    if not dataset.count:
        parts = ", ".join(dataset.subdatasets) or "nothing"
        raise TerrainError(f"{name} has no band of its own; give one of its parts: {parts}.")
    require_real(dataset.dtypes[0], name)
    masked = MaskFlags.all_valid not in dataset.mask_flag_enums[0]
    tag = dataset.nodatavals[0]
    # A mask or an alpha band hides the tag from GDAL, hence the comparison here.
    decode = decoder(
        name, fill if tag is None else [*fill, tag], dataset.scales[0], dataset.offsets[0]
    )

    def read(rows: slice, cols: slice) -> np.ndarray:
        window = Window.from_slices(rows, cols)
        with GDAL_LOCK, rasterio.Env(GDAL_CACHEMAX=CACHE):
            stored = dataset.read(1, window=window)
            missing = dataset.read_masks(1, window=window) == 0 if masked else None
        return decode(stored, missing, rows.start, cols.start)

    raster = Raster(name, dataset.crs, dataset.transform, dataset.shape, read)
    return raster, not dataset.transform.is_identity


def _from_array(
    source: xr.DataArray | xr.Dataset, role: str, fill: list[float]
) -> tuple[Raster, bool]:
    """The first band of an array as rioxarray gives it, and whether it is georeferenced."""
    array, name = _only_array(source, role)
    y, x = _spatial_dims(array, name)
    bands = [dim for dim in array.dims if dim not in (y, x)]
    if len(bands) > 1 or not array.size:
        raise TerrainError(
            f"{name} has axes {dict(array.sizes)}; need ({y}, {x}), or bands of them, of which the "
            "first is taken."
        )
    require_real(array.dtype, name)
    decode = decoder(name, [*fill, *tagged(array, name)], *scaling(array, name))

    def read(rows: slice, cols: slice) -> np.ndarray:
        window = array.isel({y: rows, x: cols} | dict.fromkeys(bands, 0)).compute()
        return decode(window.transpose(y, x).to_numpy(), None, rows.start, cols.start)

    crs = array.rio.crs or source.rio.crs
    shape = array.sizes[y], array.sizes[x]
    if y in array.coords and x in array.coords and min(shape) > 1:
        for axis in (y, x):
            require_regular(array[axis].values, axis, name)
        (top, height), (left, width) = (
            (float(at[0]), float(at[-1] - at[0]) / (len(at) - 1))
            for at in (array[y].values, array[x].values)
        )
        transform = Affine(width, 0.0, left - width / 2, 0.0, height, top - height / 2)
        # Pixel numbers of a bare image look like this too, but it has no CRS.
        referenced = not transform.is_identity or crs is not None
    else:
        transform = array.rio.transform(recalc=False)
        referenced = not transform.is_identity
    return Raster(name, crs, transform, shape, read), referenced


def _only_array(source: xr.DataArray | xr.Dataset, role: str) -> tuple[xr.DataArray, str]:
    """The array to be read, and what messages call it."""
    if isinstance(source, xr.DataArray):
        title = f" {source.name!r}" if source.name else ""
        return source, f"{role}: DataArray{title}"
    names = [name for name, variable in source.data_vars.items() if variable.ndim > 1]
    if len(names) != 1:
        raise TerrainError(
            f"{role} is a Dataset of {', '.join(map(str, names)) or 'no raster'}; give one "
            f"DataArray, e.g. dataset[{names[0] if names else role!r}]."
        )
    return source[names[0]], f"{role}: {names[0]!r} of a Dataset"


def _spatial_dims(array: xr.DataArray, name: str) -> tuple[Hashable, Hashable]:
    """Names of the rows' and the columns' axis."""
    try:
        return array.rio.y_dim, array.rio.x_dim
    except MissingSpatialDimensionError:
        if {"lat", "lon"} <= set(array.dims):
            return "lat", "lon"
        raise TerrainError(
            f"{name} has axes {dict(array.sizes)}, of which none are known as y and x; name them, "
            "e.g. with array.rename(northing='y', easting='x')."
        ) from None


def _placed(raster: Raster, referenced: bool, crs: object, resolution: float | None) -> Raster:
    """The raster where it lies on Earth, north up; refused where that cannot be known."""
    if min(raster.shape) < 2:
        raise TerrainError(
            f"{raster.name} has {raster.shape[0]} x {raster.shape[1]} pixels; a terrain needs at "
            "least two rows and two columns."
        )
    if not referenced:
        raster = _georeference(raster, crs, resolution)
    elif raster.transform.b or raster.transform.d:
        raise TerrainError(
            f"{raster.name} is on a rotated grid; warp it to north-up first, e.g. with gdalwarp."
        )
    if raster.crs is None:
        raster = dataclasses.replace(raster, crs=_given_crs(raster.name, crs))
    if not raster.crs.is_geographic:
        require_metric_crs(raster.crs, raster.name)
    return _north_up(raster)


def _georeference(raster: Raster, crs: object, resolution: float | None) -> Raster:
    """Put a bare image at the origin, with a pixel size its user knows."""
    if resolution is None or crs is None:
        raise TerrainError(
            f"{raster.name} carries no georeference; pass both crs= and resolution= (metres), on "
            "the command line --crs and --resolution."
        )
    known = _given_crs(raster.name, crs)
    if known.is_geographic:
        raise TerrainError(
            f"crs {crs!r} is in degrees, but resolution= is in metres; give a metric one."
        )
    step = require_positive("resolution", resolution)
    transform = from_origin(0.0, raster.shape[0] * step, step, step)
    return dataclasses.replace(raster, crs=raster.crs or known, transform=transform)


def _given_crs(name: str, crs: object) -> CRS:
    if crs is None:
        raise TerrainError(
            f"{name} has no coordinate reference system; pass crs=, e.g. "
            '"EPSG:32633" (--crs on the command line).'
        )
    try:
        return CRS.from_user_input(crs)
    except CRSError:
        raise TerrainError(f"crs {crs!r} is not one PROJ knows; give e.g. 'EPSG:32633'.") from None


def _north_up(raster: Raster) -> Raster:
    """The same raster with its first row in the north and its first column in the west."""
    t, (height, width) = raster.transform, raster.shape
    south_first, east_first = t.e > 0.0, t.a < 0.0
    if not (south_first or east_first):
        return raster

    def read(rows: slice, cols: slice) -> np.ndarray:
        if south_first:
            rows = slice(height - rows.stop, height - rows.start)
        if east_first:
            cols = slice(width - cols.stop, width - cols.start)
        return raster.read(rows, cols)[:: -1 if south_first else 1, :: -1 if east_first else 1]

    left, bottom, right, top = raster.bounds
    transform = Affine(abs(t.a), 0.0, min(left, right), 0.0, -abs(t.e), max(bottom, top))
    return dataclasses.replace(raster, transform=transform, read=read)
