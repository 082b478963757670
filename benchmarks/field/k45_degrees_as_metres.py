"""KIND: coordinates in degrees under a metric CRS (a wrong write_crs) are a terrain of millimetres
RIGHT: refused or a warning: pixels below a millimetre, or coordinates of degrees
SOURCE: rioxarray#47, terra#539 (CRS given by hand); wrong -a_srs"""
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
from rasterio import Affine

yy, xx = np.mgrid[:80, :80]
GROUND = 300.0 + 12 * np.sin(xx / 15) + 9 * np.cos(yy / 20)


def tif(name, a, crs="EPSG:32633", at=Affine(1, 0, 500000, 0, -1, 5200000), unit=None, scale=None, **kw):
    a = np.asarray(a)
    a = a if a.ndim == 3 else a[None]
    with rasterio.open(name, "w", driver="GTiff", height=a.shape[1], width=a.shape[2], count=len(a),
                       dtype=kw.pop("dtype", a.dtype), crs=crs, transform=at, **kw) as d:
        d.write(a)
        if unit:
            d.units = [unit] * len(a)
        if scale:
            d.scales = [scale] * len(a)
    return name


read = tb.terrain.read_terrain

tif("dem.tif", GROUND.astype("f4"), crs="EPSG:32633", at=Affine(1e-4, 0, 15.2, 0, -1e-4, 47.1))
end, got, told = tried(lambda: str(tb.Workspace.from_terrain(read("dem.tif"), shape=(4, 4))))
done(end == "refused" or bool(told), f"{end}: " + "; ".join(l.strip() for l in got.splitlines() if "extent" in l or "cells " in l) if end == "value" else f"{end}: {got}")
