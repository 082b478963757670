"""Example of real terrain, included in the package."""

from pathlib import Path

import xarray as xr

from trustbo.errors import require_choice
from trustbo.terrain.read import read_terrain

_FOLDER = Path(__file__).parent / "data"
EXAMPLES = ("wellington",)
"""Names of the terrains that `example` reads."""


def example(name: str = "wellington") -> xr.Dataset:
    """Read an example of real terrain that is included in the package.

    `"wellington"` is a steep hillside under bush in the Wairarapa, New Zealand: 195 m x 278 m at 1
    m, 211 m of relief, trees of up to 44.6 m. Copyright in this work is owned by Greater Wellington
    Regional Council; sourced from the LINZ Data Service, CC BY 4.0. The attribute `attribution`
    states this; `LICENCE.md` beside the files says which part of it is inferred.

    Args:
        name: Name of the terrain, one of `EXAMPLES`.

    Returns:
        Dataset as from `read_terrain`.

    Raises:
        TrustboError: An unknown name.
    """
    terrain = read_terrain(*example_files(name))
    return terrain.assign_attrs(
        attribution="Copyright in this work is owned by Greater Wellington Regional Council; "
        "sourced from the LINZ Data Service, CC BY 4.0"
    )


def example_files(name: str) -> tuple[str, str]:
    """Paths of the DEM and the DSM; TrustboError: an unknown name."""
    folder = _FOLDER / require_choice("example", name, EXAMPLES)
    return str(folder / "dem.tif"), str(folder / "dsm.tif")
