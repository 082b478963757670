"""Example of real terrain, included in the package."""

from pathlib import Path

import xarray as xr

from trustbo.terrain.read import read_terrain

_FOLDER = Path(__file__).parent / "data" / "wellington"
EXAMPLE_FILES = str(_FOLDER / "dem.tif"), str(_FOLDER / "dsm.tif")
"""Paths of the DEM and the DSM of `example`."""


def example() -> xr.Dataset:
    """Read the example of real terrain that is included in the package.

    It is a steep hillside under bush in the Wairarapa, New Zealand, near Wellington: 195 m x 278 m
    at 1 m, 211 m of relief, trees up to 44.6 m tall. The attribute `attribution` states the source
    and the licence; `LICENCE.md` beside the files says which part of it is inferred.

    Returns:
        Dataset as from `read_terrain`.
    """
    return read_terrain(*EXAMPLE_FILES).assign_attrs(
        attribution="Copyright in this work is owned by Greater Wellington Regional Council; "
        "sourced from the LINZ Data Service, CC BY 4.0"
    )
