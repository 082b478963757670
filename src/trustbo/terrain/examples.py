"""Terrains to try out the package: a real hillside, and synthetic relief with vegetation."""

from pathlib import Path

import numpy as np
import xarray as xr
from scipy import ndimage

from trustbo.errors import TrustboError, require_positive, require_tuple, require_whole
from trustbo.terrain.place import require_proj
from trustbo.terrain.read import check_size, read_terrain

_FOLDER = Path(__file__).parent / "data" / "wellington"
EXAMPLE_FILES = str(_FOLDER / "dem.tif"), str(_FOLDER / "dsm.tif")
"""Paths of the DEM and the DSM of `example`."""
_ORIGIN = 380_000.0, 5_225_000.0
"""Upper left corner of `synthetic_terrain`: x and y in metres of EPSG:32616."""


def example() -> xr.Dataset:
    """Read the example of real terrain that is included in the package.

    It is a steep hillside under bush in the Wairarapa, New Zealand (Wellington region): 195 m x
    278 m at 1 m, 211 m of relief, trees up to 44.6 m tall. The attribute `attribution` states the
    source and the licence; `LICENCE.md` beside the files says which part of this information is
    inferred.
    Robots need a slope limit of about 38 degrees or more; for robots with lower limits, use
    `synthetic_terrain`.

    Returns:
        Dataset as from `read_terrain`.

    Example:
        >>> terrain = tb.terrain.example()
        >>> (terrain["dsm"] - terrain["dem"]).max().item()  # height of the tallest tree, m
    """
    return read_terrain(*EXAMPLE_FILES).assign_attrs(
        attribution="Copyright in this work is owned by Greater Wellington Regional Council; "
        "sourced from the LINZ Data Service, CC BY 4.0"
    )


def synthetic_terrain(
    size: tuple[float, float] = (500.0, 500.0),
    resolution: float = 1.0,
    seed: int = 0,
    *,
    relief: float = 30.0,
) -> xr.Dataset:
    """Make a terrain with fractional Brownian relief and clumped vegetation of varying height.

    The relief has a Hurst exponent of 0.9. Vegetation with a mean height of 6 m covers 40 % of the
    area. The terrain lies on the Keweenaw peninsula in northern Michigan (EPSG:32616).

    Args:
        size: Height (north-south) and width (east-west), m.
        resolution: Pixel size, m.
        seed: Seed of the terrain.
        relief: Difference between the highest and the lowest ground, m.

    Returns:
        Dataset as from `read_terrain`.

    Raises:
        TrustboError: A size is under 4 pixels, or an argument is negative.

    Example:
        >>> terrain = tb.terrain.synthetic_terrain((150.0, 100.0), seed=3)
        >>> terrain["dem"].shape
        (150, 100)
    """
    step = require_positive("resolution", resolution)
    sides = require_tuple("size", size, 2)
    height, width = (require_positive(f"size[{i}]", side) for i, side in enumerate(sides))

    shape = (round(height / step), round(width / step))
    check_size(shape, f"size {size} m at {resolution} m")
    if min(shape) < 4:
        raise TrustboError(f"size {size} m is under 4 pixels of {resolution} m.")

    relief = require_positive("relief", relief, or_zero=True)
    rng = np.random.default_rng(require_whole("seed", seed, 0))
    ground = _fractal(rng, shape, exponent=1.9)

    # Patches of ruggedness below a metre (ruts, rocks), which the relief lacks.
    rough = np.clip(ndimage.gaussian_filter(_fractal(rng, shape, 1.6), 2.0 / resolution), 0.3, 1.0)
    dem = relief * ground + 0.25 * rough * rng.standard_normal(shape)
    dem = ndimage.gaussian_filter(dem, 0.7)

    patches = _fractal(rng, shape, exponent=1.5)
    wooded = patches > np.quantile(patches, 0.6)
    crowns = ndimage.gaussian_filter(rng.standard_normal(shape), 2.0 / resolution)

    height = 6.0 * np.exp(0.5 * crowns / crowns.std() - 0.125)
    dsm = dem + np.where(wooded, height, 0.0)

    require_proj()
    y = _ORIGIN[1] - (np.arange(shape[0]) + 0.5) * resolution
    x = _ORIGIN[0] + (np.arange(shape[1]) + 0.5) * resolution
    maps = (xr.DataArray(z, {"y": y, "x": x}, ("y", "x")) for z in (dem, dsm))
    return read_terrain(*(one.rio.write_crs("EPSG:32616") for one in maps))


def _fractal(rng: np.random.Generator, shape: tuple[int, int], exponent: float) -> np.ndarray:
    """Draw a Gaussian field with spectrum f^-(2 exponent), scaled to [0, 1].

    The field is synthesised by the Fourier method (Saupe 1988). Because the method is periodic, a
    field of twice the size is drawn and then cropped.
    """
    rows = 2 * shape[0]
    cols = 2 * shape[1]
    frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(cols)[None])
    frequency[0, 0] = np.inf

    spectrum = np.fft.rfft2(rng.standard_normal((rows, cols))) * frequency**-exponent
    field = np.fft.irfft2(spectrum, s=(rows, cols))[: shape[0], : shape[1]]
    return (field - field.min()) / np.ptp(field)
