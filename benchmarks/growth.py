"""Measure how CPU time and memory grow with the terrain and the grid.

    python benchmarks/growth.py [10 20 40 80] [--out DIR] [--failures]

The number is that of cells along each side of the grid. A cell has 50 x 50 pixels up to 40 cells,
and 100 x 100 pixels for 80 cells. Terrains are the example hillside, repeated by reflection, in two
GeoTIFF files of float32. Each size runs in a process of its own. The table contains the CPU time of
each step and, after it, the largest resident memory so far:

- read: `read_terrain` of the two files.
- workspace: `Workspace.from_terrain`.
- first plan: `Campaign(workspace, ...)` and `ask`.
- mission: simulating the planned path, `tell`, and the next `ask`.
- failures: with --failures, the difficulty of all bounds, which plans need after a failure.

The first run compiles kernels, so run the script twice.
"""

import json
import resource
import subprocess
import sys
import time
from argparse import SUPPRESS
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from common import Table, arguments, parsed

SIZES = ("10", "20", "40", "80")
PIXELS = {"80": 100}
"""Pixels along each side of a cell, 50 for other sizes."""
STEPS = ("read", "workspace", "first plan", "mission", "failures")
_MIB = 1024
"""KiB per MiB."""


def write_terrain(folder: Path, n_pixels: int) -> list[Path]:
    """Write a DEM and a DSM with n_pixels x n_pixels pixels, unless they exist."""
    import rasterio

    from trustbo.terrain.examples import EXAMPLE_FILES

    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for source in EXAMPLE_FILES:
        file = folder / f"{Path(source).stem}-{n_pixels}.tif"
        files.append(file)
        if file.exists():
            continue
        with rasterio.open(source) as example:
            heights = example.read(1)
            profile = example.profile
        missing = [(0, max(0, n_pixels - side)) for side in heights.shape]
        heights = np.pad(heights, missing, mode="symmetric")[:n_pixels, :n_pixels]
        profile |= {"height": n_pixels, "width": n_pixels, "driver": "GTiff"}
        with rasterio.open(file, "w", **profile) as made:
            made.write(heights, 1)
    return files


def measure(n_cells: int, files: list[str], failures: bool) -> None:
    """Print the CPU seconds and the peak memory of each step as JSON."""
    measured: dict[str, tuple[float, int]] = {}

    @contextmanager
    def step(name: str) -> Iterator[None]:
        began = time.process_time()
        yield
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // _MIB
        measured[name] = time.process_time() - began, peak

    import trustbo as tb

    with step("read"):
        terrain = tb.terrain.read_terrain(*files)
    with step("workspace"):
        workspace = tb.Workspace.from_terrain(terrain, (n_cells, n_cells))
        del terrain  # the workspace has its own
    with step("first plan"):
        cells = np.argwhere(workspace.passable_bounds.values.any(0))
        start, goal = (tuple(cells[k].tolist()) for k in (0, -1))
        campaign = tb.Campaign(workspace, start, goal)
        plan = campaign.ask()
    simulator = tb.simulation.KinematicSimulator(workspace)
    with step("mission"):
        campaign.tell(simulator.run(plan.path, seed=0))
        campaign.ask()
    if failures:
        with step("failures"):
            workspace.difficulty.whole()
    print(json.dumps(measured))


def main() -> None:
    """Measure the chosen sizes, each in its own process."""
    parser = arguments(str(__doc__), names=SIZES, out="out/growth")
    parser.add_argument("--failures", action="store_true", help="measure difficulty as well")
    parser.add_argument("--worker", nargs=3, help=SUPPRESS)
    given = parsed(parser)
    if given.worker:
        n_cells, *files = given.worker
        measure(int(n_cells), files, given.failures)
        return

    steps = STEPS if given.failures else STEPS[:-1]
    table = Table(
        "cells",
        "pixels",
        *(f"{name}, s" for name in steps),
        *(f"{name}, MiB" for name in steps),
        name="growth",
    )
    for size in given.names or SIZES:
        n_pixels = int(size) * PIXELS.get(size, 50)
        files = write_terrain(given.out, n_pixels)
        command = [sys.executable, __file__, "--worker", size, *map(str, files)]
        if given.failures:
            command.append("--failures")
        ended = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        if ended.returncode:
            table.row(size, n_pixels, f"ended with {ended.returncode}")
            continue
        found = json.loads(ended.stdout.splitlines()[-1])
        seconds = [f"{found[name][0]:.1f}" for name in steps]
        table.row(size, n_pixels, *seconds, *(found[name][1] for name in steps))


if __name__ == "__main__":
    main()
