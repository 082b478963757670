"""KIND: on a map whose up is not north (polar stereographic, south-oriented) row 0 is called north, and northness is of another direction
RIGHT: warped to north up, refused, or said
SOURCE: South African grids EPSG:2046 to 2055: ProjNet4GeoAPI#60"""
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

tif("dem.tif", GROUND.astype("f4"), crs="EPSG:2048", at=Affine(2, 0, -18584, 0, -2, 3708220))

from pyproj import Transformer
end, got, told = tried(lambda: read("dem.tif"))
if end != "value":
    done(end == "refused", f"{end}: {got}")
back = Transformer.from_crs(got.rio.crs.to_wkt(), 4326, always_xy=True)
(lon0, lat0), (lon1, lat1) = (back.transform(float(got.x[40 % got.x.size]), float(got.y[i])) for i in (0, -1))
off = np.degrees(np.arctan2((lon0 - lon1) * np.cos(np.radians(lat0)), lat0 - lat1))
card = str(tb.Workspace.from_terrain(got, shape=(4, 4)))
done(abs(off) < 45 or "north-west" not in card or bool(told), f"row 0 lies {off:.0f} degrees from north of the last row, yet: " + next((l for l in card.splitlines() if "north-west" in l), ""))
