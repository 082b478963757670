"""KIND: a fill that arithmetic has scaled or shifted (-9999 cm is -99.99 m, 65535 dm is 6553.5 m) is a height in silence, although no other height is near
RIGHT: missing, or a warning
SOURCE: rioxarray#20 and #69 (nodata and scaling), xarray_leaflet#15; k01 of an earlier round"""
import os
import sys
import tempfile
import warnings

os.chdir(tempfile.mkdtemp())
import numpy as np

import trustbo as tb


def tried(f):
    """Kind of end (value, refused, crash), its value or message, and text of warnings."""
    with warnings.catch_warnings(record=True) as got:
        warnings.simplefilter("always")
        try:
            end = "value", f()
        except tb.errors.TrustboError as error:
            end = "refused", str(error)
        except Exception as error:
            end = "crash", f"{type(error).__name__}: {error}"
    told = [str(w.message) for w in got if w.category is UserWarning]
    return *end, " ".join(t for t in told if "no surface (DSM)" not in t)


def done(right, line):
    print(("right: " if right else "WRONG: ") + " ".join(str(line).split())[:300])
    sys.exit(0 if right else 1)

import rasterio
import rioxarray
from rasterio import Affine

yy, xx = np.mgrid[:80, :80]
GROUND = 300.0 + 12 * np.sin(xx / 15) + 9 * np.cos(yy / 20)


def tif(name, *bands, scales=None, descriptions=None, **kw):
    with rasterio.open(name, "w", driver="GTiff", height=80, width=80, count=len(bands),
                       dtype=bands[0].dtype, crs="EPSG:32633",
                       transform=Affine(1, 0, 500000, 0, -1, 5200000), **kw) as d:
        d.write(np.stack(bands))
        if scales:
            d.scales = scales
        if descriptions:
            d.descriptions = descriptions
    return name


read = tb.terrain.read_terrain



stored = np.where(xx < 5, -9999, GROUND * 100).astype("f4")
dem = rioxarray.open_rasterio(tif("dem.tif", stored, nodata=-9999.0)) / 100.0
end, got, told = tried(lambda: float(read(dem, dem)["dem"].min()))
done(end != "value" or got > 200.0 or "-99.99" in told, f"{end}: lowest height {got} m; warned: {told!r}")
