"""Opening of a raster file, dataset or array as heights by window, NaN where missing."""

import atexit
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
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.io import DatasetReader
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window
from rioxarray.exceptions import MissingSpatialDimensionError

from trustbo.errors import TerrainError
from trustbo.files import FilePath
from trustbo.terrain.georeference import known_crs, placed
from trustbo.terrain.metric import height_unit, require_regular
from trustbo.terrain.nodata import decoder, require_real, scaling, tagged
from trustbo.terrain.raster import Raster

type RasterLike = FilePath | DatasetReader | WarpedVRT | xr.DataArray | xr.Dataset

# A GDAL dataset serves one thread at a time.
GDAL_LOCK = threading.Lock()
# Size of GDAL's block cache, bytes; by default a twentieth of the memory. A strip needs few blocks.
CACHE = 64_000_000
_opened: weakref.WeakSet[DatasetReader] = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    """Close the files of lazy terrains: rasterio cannot once the interpreter has shut down."""
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
    """Open a raster, first band, without reading its heights; see `read_terrain`.

    The source is a path, whose file `closing` closes, or an open dataset or array, which stays
    open; `role`, dem or dsm, is for messages. `crs` is for a raster without one, `resolution` (m)
    for one without a georeference, `nodata` another stored value that means missing. Returns a
    raster, north up, in degrees or metres.

    TerrainError: the source is no raster of heights. Reading raises one if the file is damaged or
    holds an undeclared fill value.
    """
    try:
        fill = [] if nodata is None else [float(nodata)]
    except (TypeError, ValueError):
        raise TerrainError(f"nodata must be a number; got {nodata!r}.") from None
    given = None if crs is None else known_crs(crs)
    if isinstance(source, xr.DataArray | xr.Dataset):
        raster, referenced = _from_array(source, role, fill, given)
    elif isinstance(source, DatasetReader | WarpedVRT):
        raster, referenced = _from_dataset(source, f"{role}: {source.name!r}", fill, given)
    elif isinstance(source, str | PathLike):
        dataset = _open_file(os.fspath(source), role)
        closing.callback(dataset.close)
        _opened.add(dataset)
        raster, referenced = _from_dataset(dataset, f"{role}: {os.fspath(source)!r}", fill, given)
    else:
        raise TerrainError(
            f"{role} must be a path, a rasterio dataset open for reading, or an xarray.DataArray; "
            f"got {type(source).__name__}."
        )
    return placed(raster, referenced, crs, resolution)


def _open_file(path: str, role: str) -> DatasetReader:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            return rasterio.open(path)
    except RasterioError as error:
        # GDAL's own addresses (/vsizip/..., https://..., NETCDF:...) are no paths of files.
        if not os.path.exists(path) and not path.startswith("/vsi") and ":" not in path[2:]:
            raise TerrainError(f"{role}: there is no file {path!r}.") from None
        raise TerrainError(
            f"{role}: {path!r} is no raster that GDAL can read ({error}); "
            "give a GeoTIFF or another raster format."
        ) from None


def _from_dataset(
    dataset: DatasetReader | WarpedVRT, name: str, fill: list[float], given: CRS | None
) -> tuple[Raster, bool]:
    """First band of a GDAL dataset, and whether it is georeferenced."""
    if dataset.closed:
        raise TerrainError(f"{name} is closed; open it, and leave it open while it is read.")
    if not dataset.count:
        parts = ", ".join(dataset.subdatasets) or "nothing"
        raise TerrainError(f"{name} has no band of its own; give one of its parts: {parts}.")
    require_real(dataset.dtypes[0], name)
    masked = MaskFlags.all_valid not in dataset.mask_flag_enums[0]
    tag = dataset.nodatavals[0]
    # A mask or an alpha band hides the tag from GDAL, hence the comparison here.
    fills = fill if tag is None else [*fill, tag]
    unit = height_unit(name, dataset.units[0], dataset.crs or given)
    decode = decoder(name, fills, dataset.scales[0], dataset.offsets[0], unit.metres)

    def read(rows: slice, cols: slice) -> np.ndarray:
        window = Window.from_slices(rows, cols)
        with GDAL_LOCK, rasterio.Env(GDAL_CACHEMAX=CACHE):
            stored = dataset.read(1, window=window)
            missing = dataset.read_masks(1, window=window) == 0 if masked else None
        return decode(stored, missing, rows.start, cols.start)

    raster = Raster(name, dataset.crs, dataset.transform, dataset.shape, read, unit)
    return raster, not dataset.transform.is_identity


def _from_array(
    source: xr.DataArray | xr.Dataset, role: str, fill: list[float], given: CRS | None
) -> tuple[Raster, bool]:
    """First band of an array of rioxarray, and whether it is georeferenced."""
    array, name = _only_array(source, role)
    y, x = _spatial_dims(array, name)
    bands = [dim for dim in array.dims if dim not in (y, x)]
    if len(bands) > 1 or not array.size:
        raise TerrainError(
            f"{name} has axes {dict(array.sizes)}; need ({y}, {x}), or bands of them, of which the "
            "first is taken."
        )
    require_real(array.dtype, name)
    crs = array.rio.crs or source.rio.crs
    unit = height_unit(name, array.attrs.get("units"), crs or given)
    decode = decoder(name, [*fill, *tagged(array, name)], *scaling(array, name), unit.metres)

    def read(rows: slice, cols: slice) -> np.ndarray:
        window = array.isel({y: rows, x: cols} | dict.fromkeys(bands, 0)).compute()
        return decode(window.transpose(y, x).to_numpy(), None, rows.start, cols.start)

    shape = array.sizes[y], array.sizes[x]
    if y in array.coords and x in array.coords and min(shape) > 1:
        for axis in (y, x):
            require_regular(array[axis].values, axis, name)
        (top, height), (left, width) = (
            (float(coordinate[0]), float(coordinate[-1] - coordinate[0]) / (len(coordinate) - 1))
            for coordinate in (array[y].values, array[x].values)
        )
        transform = Affine(width, 0.0, left - width / 2, 0.0, height, top - height / 2)
        # A bare image has pixel numbers of this form too, but no CRS.
        referenced = not transform.is_identity or crs is not None
    else:
        transform = array.rio.transform(recalc=False)
        referenced = not transform.is_identity
    return Raster(name, crs, transform, shape, read, unit), referenced


def _only_array(source: xr.DataArray | xr.Dataset, role: str) -> tuple[xr.DataArray, str]:
    """Array to read, and its name for messages."""
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
    """Names of the axes of rows and of columns."""
    try:
        return array.rio.y_dim, array.rio.x_dim
    except MissingSpatialDimensionError:
        if {"lat", "lon"} <= set(array.dims):
            return "lat", "lon"
        raise TerrainError(
            f"{name} has axes {dict(array.sizes)}, of which none are known as y and x; name them, "
            "e.g. with array.rename(northing='y', easting='x')."
        ) from None
