"""Line of sight of bounds: beside whole simulated bounds without noise, and its time.

For each terrain and sight mode: correlation, bias and rmse of `line_of_sight` with the share of
contact of 200 bounds, simulated with the chances of detection instead of detections, mean over four
next cells; and R2 of the team's contact. Beside them the correlation of that contact with the
visibility of the cell entered: of the default index, and of the paper's. Then seconds for all
bounds of a terrain of 500 x 500 pixels, beside `from_terrain(bounds=False)` in the same run.

    python benchmarks/line_of_sight.py [mode ...] [--data DIR] [--quick]
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import xarray as xr
from common import Table, arguments, median_seconds, parsed

from trustbo import Team, Workspace
from trustbo.simulation import KinematicSimulator
from trustbo.simulation.sensing import detections
from trustbo.terrain import PAPER_VISIBILITY, read_terrain, synthetic_terrain
from trustbo.workspace.moves import MOVES, existing_bounds

N_BOUNDS, N_NEXT = 200, 4


def terrains(data: Path | None, n: int) -> Iterator[tuple[str, xr.Dataset]]:
    """Made terrains, and those that the folder holds."""
    for seed in range(n):
        yield f"synthetic {seed}", synthetic_terrain((500.0, 500.0), seed=seed)
    for name in ("wellington", "tahoe", "bcts", "topography"):
        if data is None:
            continue
        files = [data / name / f"{kind}.tif" for kind in ("dem", "dsm")]
        if not files[0].is_file():
            print(f"{name} skipped: there is no {files[0]}")
            continue
        terrain = read_terrain(*files)
        if name == "bcts":  # the fullest 250 m of a strip
            rows = round(250.0 / abs(float(terrain["y"][1] - terrain["y"][0])))
            known = np.isfinite(terrain["dem"].values).sum(1)
            first = int(np.argmax(np.convolve(known, np.ones(rows), "valid")))
            terrain = terrain.isel(y=slice(first, first + rows))
        yield name, terrain


def compared(workspace: Workspace) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Line of sight and simulated contact of some bounds, each (bound, robot); cells entered."""
    rng, simulator = np.random.default_rng(0), KinematicSimulator(workspace)
    passable = workspace.passable.values
    index = np.argwhere(existing_bounds(passable))
    expected, simulated, entered = [], [], []
    for m, row, col in index[rng.permutation(len(index))[:N_BOUNDS]].tolist():
        a, c = (row - MOVES[8][m][0], col - MOVES[8][m][1]), (row, col)
        near = [(row + i, col + j) for i, j in MOVES[8]]
        ahead = [
            n
            for n in near
            if n != a and 0 <= n[0] < len(passable) and 0 <= n[1] < passable.shape[1]
            and passable[n]
        ]  # fmt: skip
        drives = []
        for k in rng.permutation(len(ahead))[:N_NEXT]:
            state = simulator.standing(a, c)
            drives.append(simulator._drive(state, 1, c, ahead[k], np.random.default_rng(0)))
        drives = [drive for drive in drives if drive.status == "ok"]
        if drives:
            detected = detections(simulator._now, simulator.team, drives)
            simulated.append(np.mean([f.mean(0) for f in detected], axis=0))
            expected.append(workspace.bound_awareness.values[:, m, row, col, -1])
            entered.append((row, col))
    return np.array(expected), np.array(simulated), np.array(entered)


def of_cells(workspace: Workspace, cells: np.ndarray, rate: np.ndarray) -> float:
    """Correlation of contact with the visibility of the cells entered."""
    index = workspace.awareness.sel(feature="visibility").isel(robot=0).values[*cells.T]
    known = np.isfinite(index)
    return np.corrcoef(index[known], rate.mean(1)[known])[0, 1]


def main() -> None:
    """Print both tables."""
    modes = ("transmittance", "wall", "bare")
    given = parsed(arguments(__doc__, names=modes, data=True, quick="one synthetic terrain"))
    table = Table(
        "terrain", "sight", "r", "bias", "rmse", "R2 of the team's contact",
        "r of visibility", "of the paper's",
    )  # fmt: skip
    made = 1 if given.quick else 3
    for name, terrain in terrains(None if given.quick else given.data, made):
        for mode in given.names:
            workspace = Workspace.from_terrain(terrain, (10, 10), sight=mode)
            los, rate, cells = compared(workspace)
            index = {"visibility": PAPER_VISIBILITY}
            paper = Workspace.from_terrain(terrain, (10, 10), features=index, bounds=False)
            visible = [f"{of_cells(each, cells, rate):.2f}" for each in (workspace, paper)]
            r = np.corrcoef(los.ravel(), rate.ravel())[0, 1]
            team = np.corrcoef(los.mean(1), rate.mean(1))[0, 1] ** 2
            off = los - rate
            rmse = np.sqrt((off**2).mean())
            table.row(
                name, mode, f"{r:.3f}", f"{off.mean():+.3f}", f"{rmse:.3f}", f"{team:.3f}", *visible
            )
    terrain, team = synthetic_terrain((500.0, 500.0), seed=0), Team(n_robots=4)
    for side in (10, 50):
        plain, whole = (
            median_seconds(
                lambda s=side, b=bounds: Workspace.from_terrain(terrain, (s, s), team, bounds=b), 3
            )
            for bounds in (False, True)
        )
        print(f"{side} x {side} cells, 4 robots: {whole:.2f} s, {plain:.2f} s without bounds")


if __name__ == "__main__":
    main()
