"""KIND: of bands that are named dsm and dtm, or labelled so in an array, the first one is the ground
RIGHT: the band of that name, or a warning with the names
SOURCE: rioxarray's long_name of bands; users who stack DSM and DTM in one file; QGIS#33180"""
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



tif("both.tif", (GROUND + 20).astype("f4"), GROUND.astype("f4"), descriptions=["dsm", "dtm"])
end, got, told = tried(lambda: read("both.tif", "both.tif"))
found = float((got["dsm"] - got["dem"]).mean()) if end == "value" else got
done(found == 20.0 or "dtm" in told, f"{end}: canopy of {found} m, of 20; warned: {told!r}")
