"""Results as files that GIS programs open."""

import json
from os import PathLike

import numpy as np
import rioxarray  # noqa: F401  (registers the .rio accessor)
import xarray as xr
from rasterio.crs import CRS
from rasterio.transform import from_origin
from rasterio.warp import transform

from trustbo.errors import TrustboError
from trustbo.files import write_file, write_text
from trustbo.result import Result
from trustbo.terrain import Workspace


def write_cell_map(
    path: str | PathLike[str], values: xr.DataArray, workspace: Workspace, *, name: str = ""
) -> None:
    """Write a map of the planning cells as a GeoTIFF in the terrain's CRS.

    Args:
        path: The file; a complete one replaces it, or nothing.
        values: Dims (row, col); NaN is written as nodata.
        workspace: Whose cells they are; made from a terrain.
        name: Name of the band; by default that of `values`.

    Raises:
        TrustboError: The workspace has no terrain, hence no CRS.
    """
    grid, crs = workspace.grid, _crs(workspace)
    raster = xr.DataArray(
        values.transpose("row", "col").values.astype(np.float32),
        {"y": grid.y, "x": grid.x},
        dims=("y", "x"),
        attrs={"long_name": name or str(values.name)},
    )
    raster = raster.rio.write_crs(crs).rio.write_nodata(np.nan)
    raster = raster.rio.write_transform(
        from_origin(grid.left, grid.top, grid.cell_width, grid.cell_height)
    )
    write_file(path, lambda file: raster.rio.to_raster(file, compress="deflate"))


def write_path(path: str | PathLike[str], result: Result) -> None:
    """Write the recommended path as GeoJSON (RFC 7946: longitude and latitude on WGS 84).

    One LineString from start to goal, and one Point per cell with the bound that enters it, the
    cell, and the expected trust of each robot.

    Raises:
        TrustboError: The workspace has no terrain, hence no CRS.
    """
    workspace = result.workspace
    x, y = zip(*(workspace.grid.center(cell) for cell in result.path), strict=True)
    lon, lat, *_ = transform(_crs(workspace), CRS.from_epsg(4326), x, y)
    positions = [[round(a, 8), round(b, 8)] for a, b in zip(lon, lat, strict=True)]
    line = _feature(
        "LineString",
        positions,
        {"name": "most trustworthy path", "bounds": len(positions) - 1, "value": result.value},
    )
    points = []
    for k, (position, cell) in enumerate(zip(positions, result.path, strict=True)):
        trust = {} if k == 0 else dict(zip(workspace.team.names, result.trust[k - 1], strict=True))
        trust = {f"trust_{robot}": float(value) for robot, value in trust.items()}
        points.append(_feature("Point", position, {"bound": k, "cell": list(cell), **trust}))
    collection = {"type": "FeatureCollection", "features": [line, *points]}
    write_text(path, json.dumps(collection, indent=1))


def _feature(kind: str, coordinates: list, properties: dict[str, object]) -> dict[str, object]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _crs(workspace: Workspace) -> CRS:
    if workspace.terrain is None:
        raise TrustboError(
            "only a workspace made from a terrain has a place on Earth; use Workspace.from_terrain."
        )
    return workspace.terrain.rio.crs
