"""Speed and memory of the terrain's features beside GDAL and xarray-spatial.

Run: python benchmarks/terrain.py [attributes] [awareness] [visibility] [huge] [--quick]

All sections by default; `--quick` leaves out the largest rasters. `gdaldem` is Debian's gdal-bin:
it is installed with apt-get where that is possible, else its rows are left out. Every figure comes
from a fresh process, is the median of 3 (of 1 from 10 000 x 10 000 pixels on), and leaves out what
importing and a first call on 50 x 50 pixels take. Peak is the process'
largest resident memory.
"""

import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import rasterio
from common import Table, arguments, faster, parsed, timed
from rasterio.transform import from_origin
from rasterio.windows import Window

ATTRIBUTES = ("slope", "roughness", "tri", "tpi")
GDALDEM = {"slope": ["slope"], "roughness": ["roughness"], "tri": ["TRI", "-alg", "Riley"],
           "tpi": ["TPI"]}  # fmt: skip
GDALDEM_TARGET = {1000: 4.0, 4000: 4.0, 10000: 2.0}


# --- rasters ---


def write_pair(folder, n):
    """DEM and DSM of n x n pixels of 1 m, float32, made and written row block by row block."""
    rng = np.random.default_rng(0)
    files = folder / f"dem{n}.tif", folder / f"dsm{n}.tif"
    profile = {"driver": "GTiff", "height": n, "width": n, "count": 1, "dtype": "float32",
               "crs": "EPSG:32633", "transform": from_origin(5e5, 5e6, 1.0, 1.0),
               "blockysize": 64, "bigtiff": "if_safer"}  # fmt: skip
    x = np.arange(n)
    with (
        rasterio.open(files[0], "w", **profile) as dem,
        rasterio.open(files[1], "w", **profile) as dsm,
    ):
        for top in range(0, n, 500):
            y = np.arange(top, min(top + 500, n))[:, None]
            ground = 30 * np.sin(x / 200) * np.cos(y / 150) + 2 * np.sin(x / 11 + y / 7)
            ground = (ground + rng.normal(0, 0.05, ground.shape)).astype("float32")
            trees = np.maximum(0, 12 * np.sin(x / 23) * np.sin(y / 17) - 4).astype("float32")
            window = Window(0, top, n, len(y))
            dem.write(ground, 1, window=window)
            dsm.write(ground + trees, 1, window=window)
    return files


# --- workers, each in a process of its own: they prepare, and return the work to time ---


def trustbo_files(dem, out):
    """Four attributes, file to file, as gdaldem does it."""
    import rioxarray

    from trustbo.terrain import features

    def run():
        with rioxarray.open_rasterio(dem) as opened:
            ground = opened.isel(band=0, drop=True).load().to_dataset(name="dem")
        with rasterio.open(dem) as source:
            profile = source.profile | {"tiled": False}
        for name in ATTRIBUTES:
            values = getattr(features, name)(ground)
            with rasterio.open(Path(out) / f"trustbo_{name}.tif", "w", **profile) as sink:
                sink.write(values.values, 1)

    warm_up(dem)
    return run


def trustbo_memory(dem, out):
    """Four attributes, in memory."""
    from trustbo.terrain import features

    warm_up(dem)
    ground = in_memory(dem)
    return lambda: [getattr(features, name)(ground) for name in ATTRIBUTES]


def warm_up(dem):
    """Compiled code is loaded at its first call."""
    from trustbo.terrain import features

    small = in_memory(dem).isel(y=slice(50), x=slice(50))
    for name in ATTRIBUTES:
        getattr(features, name)(small)
    small["dsm"] = small["dem"]
    cells_of(small, {"traversability": ATTRIBUTES[:3]})


def xrspatial_memory(dem, out):
    import xrspatial

    ground = in_memory(dem)["dem"]
    for name in ATTRIBUTES:  # compiles
        getattr(xrspatial, name)(ground[:50, :50])
    return lambda: [getattr(xrspatial, name)(ground) for name in ATTRIBUTES]


def in_memory(dem):
    import rioxarray  # noqa: F401  # gives arrays their .rio
    import xarray as xr

    with rasterio.open(dem) as source:
        values = source.read(1)
    n = len(values)
    y, x = 5e6 - 0.5 - np.arange(n), 5e5 + 0.5 + np.arange(n)
    ground = xr.DataArray(values, {"y": y, "x": x}, ("y", "x")).rio.write_crs("EPSG:32633")
    return ground.to_dataset(name="dem").assign_attrs(res=(1.0, 1.0))


def trustbo_cells(dem, out):
    """Traversability of 10 x 10 cells from a DEM in memory."""
    warm_up(dem)
    ground = in_memory(dem)
    ground["dsm"] = ground["dem"]
    return lambda: cells_of(ground, {"traversability": ATTRIBUTES[:3]})


def cells_of(ground, features):
    from trustbo.team import Team
    from trustbo.workspace.awareness import cell_maps
    from trustbo.workspace.grid import Grid

    grid = Grid.over(ground, (10, 10))
    return cell_maps(ground, grid, features, Team.of(None), keep_pixels=False)


def xrspatial_cells(dem, out):
    """The same three maps in full, and their averages over 10 x 10 cells."""
    import xrspatial

    ground = in_memory(dem)["dem"]
    for name in ATTRIBUTES:
        getattr(xrspatial, name)(ground[:50, :50])

    def run():
        for name in ATTRIBUTES[:3]:
            values = getattr(xrspatial, name)(ground).values
            np.nanmean(values.reshape(10, len(values) // 10, 10, -1), axis=(1, 3))

    return run


def trustbo_lazy(dem, out, **how):
    """Everything that a workspace needs, from files that are never whole in memory."""
    import trustbo as tb

    def run():
        terrain = tb.terrain.read_terrain(
            dem, str(dem).replace("dem", "dsm"), **how or {"lazy": True}
        )
        tb.Workspace.from_terrain(terrain, (10, 10), bounds=False)

    return run


def trustbo_averaged(dem, out):
    """DEM and DSM averaged while they are read, as the command line does, and the workspace."""
    return trustbo_lazy(dem, out, max_pixels=9e6)


def visibility(dem, out):
    import rioxarray  # noqa: F401

    from trustbo.terrain.dataset import assemble_terrain
    from trustbo.terrain.features import openness

    ground = in_memory(dem)["dem"].astype(float)
    x = np.arange(len(ground))
    trees = np.maximum(0.0, 12 * np.sin(x / 23) * np.sin(x[:, None] / 17) - 4)
    terrain = assemble_terrain(ground, ground + trees)
    openness(terrain, 40.0, n_rays=24)
    return lambda: openness(terrain, 40.0, n_rays=24)


def peak():
    """Largest resident memory of this process, MB; rusage's would count its parent's, too."""
    status = Path("/proc/self/status").read_text()
    return float(status.split("VmHWM:")[1].split()[0]) / 1024


def work(name, dem, out):
    run = globals()[name](dem, out)
    before = peak()
    seconds, _ = timed(run)
    print(json.dumps([seconds, peak(), peak() - before]))


# --- the tables ---


def measure(name, dem, out, repeats):
    """Median seconds, peak MB, and MB beyond the input."""
    runs = []
    for _ in range(repeats):
        command = [sys.executable, "-W", "ignore", __file__, "work", name, str(dem), str(out)]
        done = subprocess.run(command, capture_output=True, text=True, env=os.environ)
        if done.returncode:
            print(f"{name}: did not run here: {done.stderr.strip().splitlines()[-1]}", flush=True)
            return None
        runs.append(json.loads(done.stdout.splitlines()[-1]))
    return statistics.median(r[0] for r in runs), max(r[1] for r in runs), runs[0][2]


def gdaldem(dem, out, repeats):
    """Median seconds of the four commands, and the largest peak."""
    if not shutil.which("gdaldem"):
        return None

    def run():
        for name, words in GDALDEM.items():
            target = str(out / f"gdal_{name}.tif")
            subprocess.run(["gdaldem", words[0], str(dem), target, *words[1:], "-q"], check=True)

    return statistics.median(timed(run)[0] for _ in range(repeats)), float("nan"), None


class Costs(Table):
    """Seconds and memory of each way, and its speed relative to the first."""

    def __init__(self, title):
        print(f"\n## {title}\n")
        super().__init__("", "seconds", "peak MB", "faster", first=52, others=9)

    def line(self, label, result, base=None, target=None):
        """Print a way, if it ran."""
        if result is not None:
            seconds, most, _ = result
            ratio = "" if base is None else faster(base, seconds, target)
            self.row(label, f"{seconds:.3f}", f"{most:.0f}", ratio)


def attributes(folder, sizes):
    for n in sizes:
        dem, _ = write_pair(folder, n)
        repeats = 3 if n < 10000 else 1
        table = Costs(f"slope, roughness, TRI, TPI of {n} x {n} pixels")
        reference = gdaldem(dem, folder, repeats)
        base = None if reference is None else reference[0]
        table.line("gdaldem, file to file, 4 runs", reference)
        table.line(
            "trustbo, file to file",
            measure("trustbo_files", dem, folder, repeats),
            base,
            GDALDEM_TARGET[n],
        )
        ours = measure("trustbo_memory", dem, folder, repeats)
        table.line("trustbo, in memory", ours, base, GDALDEM_TARGET[n])
        table.line(
            "xarray-spatial, in memory", measure("xrspatial_memory", dem, folder, repeats), base
        )
        if shutil.which("gdaldem"):
            compare(folder)


def compare(folder):
    """Largest difference from gdaldem's numbers."""
    for name in ATTRIBUTES:
        with (
            rasterio.open(folder / f"gdal_{name}.tif") as a,
            rasterio.open(folder / f"trustbo_{name}.tif") as b,
        ):
            window = Window(1, 1, 900, 900)
            theirs, ours = a.read(1, window=window), b.read(1, window=window)
        ours = np.rad2deg(ours) if name == "slope" else ours
        print(f"{name}: differs from gdaldem by {np.abs(ours - theirs).max():.2g} at most")


def awareness(folder, sizes):
    for n in sizes:
        dem, _ = write_pair(folder, n)
        repeats = 3 if n < 10000 else 1
        table = Costs(f"DEM of {n} x {n} pixels in memory to traversability of 10 x 10 cells")
        full = measure("xrspatial_cells", dem, folder, repeats)
        base = None if full is None else full[0]
        table.line("xarray-spatial: 3 whole maps, averaged", full)
        ours = measure("trustbo_cells", dem, folder, repeats)
        table.line(
            "trustbo: sampled fit, strips, index per cell", ours, base, 10.0 if n == 4000 else None
        )
        for label, result in (("xarray-spatial", full), ("trustbo", ours)):
            if result is not None:
                print(f"{label}: {result[2]:.0f} MB beyond the input")


def huge(folder, n):
    dem, _ = write_pair(folder, n)
    table = Costs(f"workspace of {n} x {n} pixels, DEM and DSM on disk, openness included")
    table.line(
        "trustbo, averaged to 9e6 pixels at most", measure("trustbo_averaged", dem, folder, 1)
    )
    table.line("trustbo, lazy", measure("trustbo_lazy", dem, folder, 1))


def main():
    names = ("attributes", "awareness", "visibility", "huge")
    given = parsed(arguments(__doc__, names=names, quick="without the largest rasters"))
    sections, quick = given.names, given.quick
    if not shutil.which("gdaldem"):
        subprocess.run(["apt-get", "install", "-y", "-qq", "gdal-bin"], capture_output=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if "attributes" in sections:
            attributes(folder, (1000, 4000) if quick else (1000, 4000, 10000))
        if "awareness" in sections:
            awareness(folder, (4000,) if quick else (4000, 10000))
        if "visibility" in sections:
            table = Costs("visibility index of 500 x 500 pixels, 24 rays of 40 m, with canopy")
            table.line("trustbo", measure("visibility", write_pair(folder, 500)[0], folder, 3))
        if "huge" in sections:
            huge(folder, 4000 if quick else 20000)


if __name__ == "__main__":
    if sys.argv[1:2] == ["work"]:
        work(*sys.argv[2:])
    else:
        main()
