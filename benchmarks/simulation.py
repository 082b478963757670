"""Speed of sight and of missions beside other ray casters.

Run: python benchmarks/simulation.py [--data DIR] [--quick]

Rays: pairs of points up to 100 m apart, sensor and target 1 m above ground, on 1000 x 1000 pixels
of 1 m; the same pairs for all. `embree` (embreex, a triangle mesh of the ground) knows
opaque ground only, as does our mode "bare"; "wall" blocks at the surface;
"transmittance" also measures the metres inside the canopy. Agreement is with "bare". The
real scene is steep New Zealand bush at 1 m (DIR/wellington), mirrored until it is as large.
All on one core; seconds are medians of 5 (the NumPy loop: of 1, on 2000 pairs). Missing tools are
left out.
"""

import importlib.util
import os
import sys
import warnings

import numpy as np
import xarray as xr
from common import Table, arguments, faster, median_seconds, parsed, verdict

import trustbo as tb
from trustbo.workspace.sight import Sight, detection_probability

N_PAIRS, N_SIDE, REACH, EYE = 100_000, 1000, 100.0, 1.0
OPTICS = np.array([EYE, EYE, np.inf, 1.0])


def real_terrain(folder):
    """The real terrain, mirrored at its edges to N_SIDE pixels a side."""
    terrain = tb.terrain.read_terrain(folder / "dem.tif", folder / "dsm.tif")
    rows, cols = terrain["dem"].shape
    size = ((0, N_SIDE - rows), (0, N_SIDE - cols))
    coords = {"y": 5e6 - np.arange(N_SIDE) - 0.5, "x": 5e5 + np.arange(N_SIDE) + 0.5}
    arrays = (
        xr.DataArray(np.pad(terrain[name].values, size, mode="symmetric"), coords, ("y", "x"))
        for name in ("dem", "dsm")
    )
    return tb.terrain.read_terrain(*(a.rio.write_crs("EPSG:2193") for a in arrays))


def synthetic(relief):
    return tb.terrain.synthetic_terrain((N_SIDE, N_SIDE), seed=0, relief=relief)


def scene(terrain):
    """Surface of a terrain and random pairs on it, (pair, 2) each, m from its upper left pixel."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        workspace = tb.Workspace.from_terrain(terrain, (20, 20), bounds=False)
    surface = workspace.surface
    assert surface is not None
    rng = np.random.default_rng(0)
    a = rng.uniform(REACH + 1, N_SIDE - REACH - 2, (N_PAIRS, 2))
    angle, far = rng.uniform(0, 2 * np.pi, N_PAIRS), REACH * np.sqrt(rng.uniform(size=N_PAIRS))
    b = a + np.stack([far * np.cos(angle), far * np.sin(angle)], axis=1)
    return workspace, surface, a, b


def ours(surface, a, b, mode):
    def place(p):
        return np.stack([surface.origin[0] + p[:, 0], surface.origin[1] - p[:, 1]], axis=1)

    return detection_probability(surface, Sight(mode), place(a), place(b), OPTICS)


def heights(ground, p):
    from scipy.ndimage import map_coordinates

    return map_coordinates(ground, p[:, ::-1].T, order=1) + EYE


def numpy_loop(surface, a, b, n=2000):
    """Each ray sampled every half pixel with NumPy."""
    from scipy.ndimage import map_coordinates

    za, zb = heights(surface.ground, a), heights(surface.ground, b)
    clear = np.empty(n)
    for i in range(n):
        t = np.linspace(0, 1, max(2, int(2 * np.hypot(*(b[i] - a[i])))))[1:-1]
        x, y = (a[i, k] + t * (b[i, k] - a[i, k]) for k in range(2))
        ground = map_coordinates(surface.ground, [y, x], order=1)
        clear[i] = (za[i] + t * (zb[i] - za[i]) >= ground).all()
    return clear


def embree(surface, a, b):
    """Rays against a mesh of two triangles per pixel."""
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    n = len(surface.ground)
    col, row = np.meshgrid(np.arange(n), np.arange(n))
    vertices = np.stack([col.ravel(), row.ravel(), surface.ground.ravel()], axis=1).astype("f4")
    k = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([k, k + 1, k + n], 1), np.stack([k + 1, k + n + 1, k + n], 1)])
    world = rtcore_scene.EmbreeScene()
    TriangleMesh(world, vertices[faces])
    start = np.column_stack([a, heights(surface.ground, a)]).astype("f4")
    end = np.column_stack([b, heights(surface.ground, b)]).astype("f4")
    way = end - start
    length = np.linalg.norm(way, axis=1)
    unit = (way / length[:, None]).astype("f4")

    def cast():
        hit = world.run(start, unit, dists=length.astype("f4"), query="OCCLUDED")
        return np.asarray(hit) == -1

    return cast


class Rays(Table):
    """Speed of each caster, and its agreement with the reference."""

    def line(self, label, n, took, seen, reference=None):
        """Print a caster."""
        same = None if reference is None else np.mean((seen > 0.5) == reference[: len(seen)])
        agrees = "" if same is None else f"{same:.2%}"
        self.row(label, f"{n / took / 1e6:.3f}", f"{np.mean(seen):.1%}", agrees)


def rays(name, terrain):
    _, surface, a, b = scene(terrain)
    print(f"\n## rays, {name} (standard deviation {surface.ground.std():.1f} m)\n")
    table = Rays("", "M rays/s", "clear", "agrees", first=44, others=8)
    bare = None
    for mode in ("bare", "wall", "transmittance"):
        took = median_seconds(lambda mode=mode: ours(surface, a, b, mode))
        seen = ours(surface, a, b, mode)
        bare = seen > 0.5 if bare is None else bare
        table.line(f"trustbo, {mode}", N_PAIRS, took, seen, bare if mode == "bare" else None)
    if importlib.util.find_spec("embreex"):
        cast = embree(surface, a, b)
        table.line("embree, opaque ground", N_PAIRS, median_seconds(cast), cast(), bare)
    table.line(
        "NumPy loop",
        2000,
        median_seconds(lambda: numpy_loop(surface, a, b), 1),
        numpy_loop(surface, a, b),
        bare,
    )


def missions():
    workspace, *_ = scene(synthetic(20.0))
    path = [(k, k) for k in range(4, 15)]
    simulator = tb.simulation.KinematicSimulator(workspace)
    n_bounds = len(simulator.run(path, seed=0).bounds)
    seeds = iter(range(1, 10_000))
    alone = median_seconds(lambda: simulator.run(path, seed=next(seeds)), 20)
    batch = (
        median_seconds(lambda: simulator.run_batch(path, [next(seeds) for _ in range(256)]), 3)
        / 256
    )
    print(
        f"\n## missions of {n_bounds} bounds, the lead and 3 robots, 1000 x 1000 pixels, one core\n"
    )
    print(f"one at a time: {1e3 * alone:.1f} ms (target 50: {verdict(alone < 0.05)})")
    print(f"256 together: {1e3 * batch:.1f} ms each, faster by {faster(alone, batch, 5)}")


def main():
    given = parsed(arguments(__doc__, data=True, quick="rays of one scene"))
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    print(f"Python {sys.version.split()[0]}, one core; target: 5 M rays/s with canopy")
    for relief in (20.0,) if given.quick else (20.0, 100.0):
        rays(f"relief {relief:g} m", synthetic(relief))
    if given.quick:
        return
    if given.data is not None and (given.data / "wellington").is_dir():
        rays("wellington", real_terrain(given.data / "wellington"))
    else:
        print("\nskipped: the real scene, wellington/dem.tif and dsm.tif, which --data names")
    missions()


if __name__ == "__main__":
    main()
