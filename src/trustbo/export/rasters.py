"""Maps as GeoTIFF, one band each."""

from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import from_origin

from trustbo.export.checks import Maps, require_crs, require_maps
from trustbo.files import FilePath, require_file, write_file
from trustbo.workspace import Workspace


def write_geotiff(path: FilePath, maps: Maps, workspace: Workspace) -> None:
    """Write maps of the planning cells as the bands of a GeoTIFF in the terrain's CRS.

    Bands are float32, named after their variables, with the long name as metadata; NaN is nodata.

    Args:
        path: .tif or .tiff file to write, or to replace.
        maps: Maps (row, col), e.g. `Result.maps()`.
        workspace: Workspace of the cells, made from a terrain.

    Raises:
        ShapeError: The dims or the number of cells differ.
        TrustboError: The workspace has no terrain, hence no CRS, or the file cannot be written.
    """
    crs, bands = require_crs(workspace), require_maps(maps, workspace)
    target = require_file(path, ".tif", ".tiff")
    grid = workspace.grid

    def write(file: Path) -> None:
        with rasterio.open(
            file,
            "w",
            driver="GTiff",
            interleave="band",
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
