"""`trustbo info`, and rasters with a start and a goal on them, checked before awareness."""

import warnings
from functools import partial
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trustbo.errors import TrustboError, require_whole

if TYPE_CHECKING:
    from collections.abc import Callable

    import xarray as xr

    from trustbo.data import Cell
    from trustbo.team import Team
    from trustbo.workspace import Workspace

_MOST_PIXELS = 9e6
"""Most pixels of a raster that is not averaged: a campaign on it takes some 2 GB."""


def info(
    dem: Path,
    dsm: Path | None = None,
    shape: str = "10,10",
    crs: str | None = None,
    resolution: float | None = None,
    nodata: float | None = None,
    max_slope: float = 45.0,
    out: Path = Path("out/grid.png"),
) -> None:
    """Print and draw the planning grid of a terrain, before anything is computed on it.

    Example: trustbo info dem.tif dsm.tif --shape 12,12 --out grid.png

    It takes seconds: of large rasters, some rows are read. Printed are the CRS, the
    extent, pixels and cells, heights, the share without data and of impassable
    cells, and a start and a goal in each spelling of --start and --goal.
    """
    cells, team = pair("shape", shape), team_of(max_slope)
    from trustbo.cli.outputs import use_no_screen, write_figure
    from trustbo.files import require_file
    from trustbo.workspace import survey

    require_file(out, ".png")
    with reader_of(dem, dsm, crs, resolution, nodata)(lazy=True) as headers:
        surveyed = survey(headers, cells, team)
    print(surveyed)
    use_no_screen()
    from trustbo.plots.grid import grid_map

    write_figure(out, [grid_map(surveyed)])
    print(f"the grid, with the names of its cells, is drawn in {out}")


def reader_of(
    dem: Path, dsm: Path | None, crs: str | None, resolution: float | None, nodata: float | None
) -> "Callable[..., xr.Dataset]":
    """Make `read_terrain` of the rasters that flags name."""
    from trustbo.terrain import read_terrain

    return partial(read_terrain, dem, dsm, crs=crs, resolution=resolution, nodata=nodata)


def workspace_with(
    start: str,
    goal: str,
    read: "Callable[..., xr.Dataset]",
    shape: tuple[int, int],
    team: "Team",
    *,
    progress: bool,
    **options: Any,
) -> "tuple[Workspace, tuple[Cell, Cell]]":
    """Make a workspace once start and goal are located: by the headers, then by the heights.

    Options are those of `Workspace.from_terrain`. TrustboError: an end is off the grid, without
    data or too steep; no awareness was computed.
    """
    from trustbo.workspace import Workspace, survey
    from trustbo.workspace.grid import Grid
    from trustbo.workspace.location import cell_of

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they come again with the heights
        headers = read(lazy=True, max_pixels=_MOST_PIXELS)
    with headers:
        grid = Grid.over(headers, shape)
        for name, end in (("start", start), ("goal", goal)):
            cell_of(name, end, grid)
    terrain = read(max_pixels=_MOST_PIXELS, progress=progress)
    cells = survey(terrain, shape, team)
    ends = cells.require_cell("start", start), cells.require_cell("goal", goal)
    return Workspace.from_terrain(terrain, shape, team, **options), ends


def pair(what: str, text: str) -> tuple[int, int]:
    """Read two whole numbers from the text of a flag; TrustboError: it has others, or none."""
    try:
        first, second = (int(number) for number in text.split(","))
    except ValueError:
        raise TrustboError(
            f"--{what} must be rows and columns, such as 10,12; got {text!r}."
        ) from None
    return first, second


def team_of(max_slope: float, n_robots: int = 3, lidar_range: float = 100.0) -> "Team":
    """Make a team of equal robots; the slope is in degrees."""
    if not 0.0 < max_slope < 90.0:
        raise TrustboError(f"--max-slope must be between 0 and 90 degrees; got {max_slope:g}.")
    require_whole("n_robots", n_robots, 1)
    from trustbo.team import Robot, Team

    robot = Robot(max_slope=radians(max_slope), lidar_range=lidar_range)
    return Team(robots=(robot,) * n_robots, lead=robot)
