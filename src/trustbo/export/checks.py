"""What exports refuse before they write anything."""

from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path

import numpy as np
import rioxarray  # noqa: F401  (registers the .rio accessor)
import xarray as xr
from rasterio.crs import CRS

from trustbo.errors import ShapeError, TrustboError
from trustbo.result import require_folder
from trustbo.terrain import Workspace

Maps = xr.Dataset | xr.DataArray


def find_crs(workspace: Workspace) -> CRS | None:
    """The CRS of a workspace's grid; None without a terrain."""
    if workspace.grid.crs is not None:
        return CRS.from_user_input(workspace.grid.crs)
    return None if workspace.terrain is None else workspace.terrain.rio.crs  # of older files


def require_crs(workspace: Workspace) -> CRS:
    """The CRS of a workspace's grid.

    Raises:
        TrustboError: It was not made from a terrain.
    """
    crs = find_crs(workspace)
    if crs is None:
        raise TrustboError(
            "only a workspace made from a terrain has a place on Earth; use Workspace.from_terrain."
        )
    return crs


def require_file(path: str | PathLike[str], *suffixes: str) -> Path:
    """The file to write, which may be there already.

    Args:
        path: Its name.
        suffixes: One of which it must have, in lower case with the dot; none to allow any.

    Raises:
        TrustboError: Another suffix; a folder of that name; or a file in place of its folder.
    """
    file = Path(path)
    if suffixes and file.suffix.lower() not in suffixes:
        raise TrustboError(f"{str(file)!r} must end in {' or '.join(suffixes)}.")
    if file.is_dir():
        raise TrustboError(f"cannot write {str(file)!r}: it is a folder; name a file in it.")
    require_folder(file.parent)
    return file


def as_dataset(maps: Maps) -> xr.Dataset:
    """One or more maps by name.

    Raises:
        ShapeError: There are none.
    """
    if isinstance(maps, xr.DataArray):
        return maps.to_dataset(name="map" if maps.name is None else maps.name)
    if not maps.data_vars:
        raise ShapeError("there are no maps; give a Dataset with at least one variable.")
    return maps


def require_maps(maps: Maps, workspace: Workspace) -> xr.Dataset:
    """Maps of a workspace's cells as floats, dims (row, col), without coordinates.

    Raises:
        ShapeError: No maps, other dims, or another number of cells.
        TrustboError: Values that are no numbers.
    """
    shape, bands = workspace.grid.shape, {}
    for name, values in as_dataset(maps).data_vars.items():
        if set(values.dims) != {"row", "col"}:
            raise ShapeError(
                f"map {name!r} has dims {values.dims}; it must have (row, col): take a mean, or "
                "one of it with .sel()."
            )
        values = values.transpose("row", "col")
        if values.shape != shape:
            raise ShapeError(f"map {name!r} has {values.shape} cells, the workspace {shape}.")
        if values.dtype.kind not in "biuf":
            raise TrustboError(f"map {name!r} must hold numbers; got {values.dtype}.")
        bands[str(name)] = (("row", "col"), values.values.astype(np.float64), values.attrs)
    return xr.Dataset(bands)


def require_names_for_netcdf(names: Iterable[str]) -> None:
    """Refuse names that a map in netCDF cannot have.

    Raises:
        TrustboError: One of them, named.
    """
    for name in names:
        if "/" in name or name in ("x", "y", "spatial_ref"):
            raise TrustboError(f"a map in netCDF cannot be called {name!r}; rename it.")


def require_names_for_sql(robots: Sequence[str]) -> None:
    """Refuse names of robots that a GeoPackage could not tell apart.

    Raises:
        TrustboError: They differ by capitals alone.
    """
    if len({name.lower() for name in robots}) < len(robots):
        raise TrustboError(
            "a GeoPackage does not tell capitals from small letters, as the names of these robots "
            f"do: {tuple(robots)}; write GeoJSON instead."
        )
