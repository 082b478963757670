"""Maps as GeoTIFF, one band each, and as netCDF, after the CF conventions."""

from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.transform import from_origin

from trustbo.export.checks import (
    Maps,
    find_crs,
    require_crs,
    require_maps,
    require_names_for_netcdf,
)
from trustbo.export.style import write_style
from trustbo.files import FilePath, require_file, write_file
from trustbo.workspace import Workspace


def write_geotiff(
    path: FilePath, maps: Maps, workspace: Workspace, *, cog: bool = False, style: bool = True
) -> None:
    """Write maps of the planning cells as the bands of a GeoTIFF in the terrain's CRS.

    Bands are float32, named after their variables, with the long name as metadata; NaN is nodata.

    Args:
        path: .tif or .tiff file to write, or to replace.
        maps: Maps (row, col), e.g. `Result.maps()`.
        workspace: Workspace of the cells, made from a terrain.
        cog: Whether to write a Cloud Optimized GeoTIFF, for maps on a web server.
        style: Whether to write a style for QGIS too, the .qml file of the same name.

    Raises:
        ShapeError: The dims or the number of cells differ.
        TrustboError: The workspace has no terrain, hence no CRS, or the file cannot be written.
    """
    crs, bands = require_crs(workspace), require_maps(maps, workspace)
    target = require_file(path, ".tif", ".tiff")
    legend = target.with_suffix(".qml")
    if style:
        require_file(legend)
    grid = workspace.grid
    # Averages stay within the range of the values; cubic resampling, GDAL's default, does not.
    layout: dict[str, Any] = {"driver": "GTiff", "interleave": "band"}
    layout = {"driver": "COG", "overview_resampling": "average"} if cog else layout

    def write(file: Path) -> None:
        with rasterio.open(
            file,
            "w",
            **layout,
            height=grid.shape[0],
            width=grid.shape[1],
            count=len(bands),
            dtype="float32",
            nodata=np.nan,
            crs=crs,
            transform=from_origin(grid.left, grid.top, grid.cell_width, grid.cell_height),
            compress="deflate",
        ) as raster:
            for i, (name, values) in enumerate(bands.items(), start=1):
                raster.write(values.values.astype(np.float32), i)
                raster.set_band_description(i, name)
                if "long_name" in values.attrs:
                    raster.update_tags(i, long_name=str(values.attrs["long_name"]))

    write_file(target, write)
    if style:
        write_style(legend, bands)


def write_netcdf(path: FilePath, maps: Maps, workspace: Workspace) -> None:
    """Write maps of the planning cells as netCDF-4 after CF-1.8, dims (y, x), north first.

    Args:
        path: File to write, or to replace.
        maps: Maps (row, col), e.g. `Result.maps()`.
        workspace: Workspace of the cells. Without a terrain there is no CRS, and x and y are metres
            from the lower left corner of the grid.

    Raises:
        ShapeError: The dims or the number of cells differ.
        TrustboError: The file cannot be written, or netCDF cannot hold the name of a map.
    """
    bands, target = require_maps(maps, workspace), require_file(path)
    require_names_for_netcdf(map(str, bands.data_vars))
    grid, crs = workspace.grid, find_crs(workspace)
    data = bands.rename(row="y", col="x").assign_coords(y=grid.y, x=grid.x)
    for name, values in data.data_vars.items():
        texts = {key: str(value) for key, value in values.attrs.items()}
        values.attrs = {"long_name": str(name), "units": "1"} | texts
        values.encoding = {"zlib": True, "_FillValue": np.nan}
    for axis, way in (("x", "east"), ("y", "north")):
        attrs = {"axis": axis.upper(), "units": "m"}
        attrs["long_name"] = f"distance {way} of the grid's lower left corner"
        if crs is not None:
            attrs["long_name"] = f"{axis} coordinate of projection"
            attrs["standard_name"] = f"projection_{axis}_coordinate"
        data[axis].attrs = attrs
        data[axis].encoding = {"_FillValue": None}  # CF: coordinates have no missing values
    if crs is not None:
        transform = from_origin(grid.left, grid.top, grid.cell_width, grid.cell_height)
        data = data.rio.write_crs(crs).rio.write_transform(transform)
    data.attrs = {
        "Conventions": "CF-1.8",
        "title": "Maps of trust after a campaign of bounding overwatch",
        "source": "trustbo",
    }
    write_file(target, lambda file: data.to_netcdf(file, engine="netcdf4"))
