"""Maps as netCDF, after the CF conventions."""

import numpy as np
from rasterio.transform import from_origin

from trustbo.export.checks import Maps, find_crs, require_maps, require_names_for_netcdf
from trustbo.files import FilePath, require_file, write_file
from trustbo.workspace import Workspace


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
