"""Checks of workspaces, maps and names, before an export writes anything."""

from collections.abc import Sequence

import numpy as np
import rioxarray  # noqa: F401  (registers the .rio accessor)
import xarray as xr
from rasterio.crs import CRS

from trustbo.errors import ShapeError, TrustboError
from trustbo.workspace import Workspace
from trustbo.workspace.grid import over_cells

Maps = xr.Dataset | xr.DataArray
LEAD = "lead"
"""Name of the lead among the robots."""


def find_crs(workspace: Workspace) -> CRS | None:
    """Return the CRS of a workspace's grid; None without a terrain."""
    if workspace.grid.crs is not None:
        return CRS.from_user_input(workspace.grid.crs)
    return None if workspace.terrain is None else workspace.terrain.rio.crs  # file of 0.1


def require_crs(workspace: Workspace) -> CRS:
    """Return the CRS of a workspace's grid; TrustboError if it was not made from a terrain."""
    crs = find_crs(workspace)
    if crs is None:
        raise TrustboError(
            "only a workspace made from a terrain has a CRS; use Workspace.from_terrain."
        )
    return crs


def as_dataset(maps: Maps) -> xr.Dataset:
    """Return one or more maps as a dataset; ShapeError if there are none."""
    if isinstance(maps, xr.DataArray):
        return maps.to_dataset(name="map" if maps.name is None else maps.name)
    if not maps.data_vars:
        raise ShapeError("there are no maps; give a Dataset with at least one variable.")
    return maps


def require_maps(maps: Maps, workspace: Workspace) -> xr.Dataset:
    """Return maps of a workspace's cells as floats, dims (row, col), without coordinates.

    Those of `Result.maps` have dims (y, x). ShapeError: no maps, or other dims or another number of
    cells. TrustboError: no numbers.
    """
    shape, bands = workspace.grid.shape, {}
    for name, values in over_cells(as_dataset(maps)).data_vars.items():
        if set(values.dims) != {"row", "col"}:
            raise ShapeError(
                f"map {name!r} has dims {values.dims}; it must have (row, col): take a mean, or "
                "select one with .sel()."
            )
        values = values.transpose("row", "col")
        if values.shape != shape:
            raise ShapeError(f"map {name!r} has {values.shape} cells, the workspace {shape}.")
        if values.dtype.kind not in "biuf":
            raise TrustboError(f"map {name!r} must hold numbers; got {values.dtype}.")
        bands[str(name)] = (("row", "col"), values.values.astype(np.float64), values.attrs)
    return xr.Dataset(bands)


def require_lead_apart(robots: Sequence[str]) -> None:
    """Refuse a robot of T2 that is called as the lead: TrustboError."""
    if LEAD in robots:
        raise TrustboError(f"a robot is called {LEAD!r}, as the lead is in exports; rename it.")


def require_names_for_sql(robots: Sequence[str]) -> None:
    """Refuse names of robots that differ in capitals only, for a GeoPackage: TrustboError."""
    if len({name.lower() for name in robots}) < len(robots):
        raise TrustboError(
            "a GeoPackage does not tell capitals from small letters, as the names of these robots "
            f"do: {tuple(robots)}; write GeoJSON instead."
        )
