"""Maps as GeoTIFF, one band each."""

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.transform import from_origin

from trustbo.export.checks import Maps, require_crs, require_file, require_maps
from trustbo.export.style import write_style
from trustbo.files import write_file
from trustbo.terrain import Workspace


def write_geotiff(
    path: str | PathLike[str],
    maps: Maps,
    workspace: Workspace,
    *,
    cog: bool = False,
    style: bool = True,
) -> None:
    """Write maps of the planning cells as the bands of a GeoTIFF in the terrain's CRS.

    Bands are float32, named after their variables, with the long name as metadata; NaN is nodata.

    Args:
        path: The file, .tif or .tiff; a complete one replaces it, or nothing.
        maps: Dims (row, col), e.g. `Result.maps()`.
        workspace: Whose cells they are; made from a terrain.
        cog: Whether to lay it out as a Cloud Optimized GeoTIFF, for maps on a web server.
        style: Whether to write a style beside it, which QGIS takes up by its name; see
            `write_style`.

    Raises:
        ShapeError: Other dims, or another number of cells.
        TrustboError: The workspace has no terrain, hence no CRS; or a path that is no such file.
    """
    crs, bands = require_crs(workspace), require_maps(maps, workspace)
    target = require_file(path, ".tif", ".tiff")
    legend = target.with_suffix(".qml")
    if style:
        require_file(legend)
    grid = workspace.grid
    # Averages stay within the range of the values in the overviews, cubic (GDAL's choice) does not.
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
