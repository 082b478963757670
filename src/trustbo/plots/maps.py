"""Maps of planning cells over the hillshade, with a path, a scale and a colour bar."""

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from trustbo.data import Cell
from trustbo.plots.layout import (
    as_text,
    colour_bar,
    extent_of,
    grid_lines,
    label_maps,
    map_panels,
    tallness,
)
from trustbo.terrain import pixel_size
from trustbo.workspace import Grid, Workspace

COLOURS = "viridis"
"""Perceptually uniform, safe for the colour-blind, and monotone in greyscale."""
SHADOW = 0.55
"""Opacity of the darkest shadow of the hillshade."""
CLOSED = "0.75"
"""Grey of impassable cells and pixels."""
VEGETATION = "0.78"
_GROWN = 0.5  # least height of vegetation above the ground, m


def trust_maps(
    history: xr.Dataset,
    trust_map: xr.DataArray,
    path: Sequence[Cell],
    workspace: Workspace,
    *,
    n_columns: int | None = None,
) -> np.ndarray:
    """Draw the trust map of each iteration with the path planned on it, Fig. 5 of the paper.

    One more panel shows the map and the recommended path after the last mission.

    Args:
        history: Map and path of each iteration, such as `Result.history`.
        trust_map: Map after the last mission, dims (row, col), such as `Result.trust_map`.
        path: Path recommended then, such as `Result.path`.
        workspace: Workspace of the cells.
        n_columns: Panels per row; by default 3, or more where the terrain is tall.

    Returns:
        Axes, shape (iteration + 1,).
    """
    maps = [history["trust_map"].isel(iteration=i) for i in range(history.sizes["iteration"])]
    paths: list[Sequence[Cell]] = [_cells(cells) for cells in history["path"].values]
    titles = [f"mission {i}" for i in history["iteration"].values]
    titles[0] += " (prior)"
    maps, paths = [*maps, trust_map], [*paths, path]
    titles.append(f"after {len(titles)} mission{'s' if len(titles) > 1 else ''}")
    # The first map comes from the prior, and the trust of the start cell is assumed: neither sets
    # the limits of the colours.
    everything = np.stack([trust.values for trust in maps])
    learned = everything[1:].copy()
    learned[:, *paths[0][0]] = np.nan
    low, high = np.nanmin(learned), np.nanmax(learned)
    figure, axes, panels = map_panels(workspace.grid, len(maps), n_columns)
    for ax, trust, path, title in zip(panels, maps, paths, titles, strict=True):
        cell_map(ax, trust, workspace, low=low, high=high)
        draw_path(ax, path, workspace.grid)
        ax.set_title(title, fontsize=9)
    extend = _extend(np.nanmin(everything) < low, np.nanmax(everything) > high)
    _finish(figure, axes, workspace, "expected trust", (low, high), extend=extend)
    return panels


def robot_maps(
    maps: xr.DataArray,
    workspace: Workspace,
    path: Sequence[Cell] | None = None,
    *,
    label: str = "cost",
    n_columns: int | None = None,
) -> np.ndarray:
    """Draw a map for each robot, all on one scale of colours.

    Args:
        maps: Maps (robot, row, col), such as `planner.cost_map(params, per_robot=True)`, the cost
            f = 1 - sigma(trust) of the paper.
        workspace: Workspace of the cells.
        path: Path to draw on each map.
        label: Label of the colour bar.
        n_columns: Panels per row; by default two, or more where the terrain is tall.

    Returns:
        Axes, shape (robot,).
    """
    maps = maps.transpose("robot", "row", "col")
    names = [str(name) for name in maps["robot"].values]
    limits = float(maps.min()), float(maps.max())
    if n_columns is None and tallness(workspace.grid) < 2:
        n_columns = 2
    figure, axes, panels = map_panels(workspace.grid, len(names), n_columns)
    for ax, name, own in zip(panels, names, maps, strict=True):
        cell_map(ax, own, workspace, low=limits[0], high=limits[1])
        if path is not None:
            draw_path(ax, path, workspace.grid)
        ax.set_title(as_text(name), fontsize=9)
    _finish(figure, axes, workspace, label, limits)
    return panels


def path_posterior(
    share: xr.DataArray, workspace: Workspace, path: Sequence[Cell] | None = None
) -> Axes:
    """Draw the probability of each cell to be on the best path.

    Args:
        share: Probabilities (row, col), such as `planner.path_posterior(posterior)`.
        workspace: Workspace of the cells.
        path: Path to draw, such as the recommended one.

    Returns:
        Axes of the map.
    """
    return _one_map(share, workspace, path, "P(cell on the best path)", 1.0)


def hazard_map(
    p_fail: np.ndarray, workspace: Workspace, path: Sequence[Cell] | None = None
) -> Axes:
    """Draw the chance of each cell that the bound into it ends the mission, from the worst side.

    Args:
        p_fail: Chances (move, row, col), NaN where there is no bound, such as
            `planner.problem.risk.p_fail`.
        workspace: Workspace of the cells.
        path: Path to draw, such as the recommended one.

    Returns:
        Axes of the map.
    """
    worst = np.where(np.isnan(p_fail), -np.inf, p_fail).max(0)
    hazard = workspace.passable.copy(data=np.where(worst >= 0.0, worst, np.nan))
    high = max(0.2, float(np.nanmax(hazard, initial=0.0)))
    return _one_map(hazard, workspace, path, "chance to fail on entering, at most", high)


def _one_map(
    values: xr.DataArray, workspace: Workspace, path: Sequence[Cell] | None, label: str, high: float
) -> Axes:
    """Draw a single map in colours from 0 to `high`."""
    figure, axes, (ax,) = map_panels(workspace.grid, 1, 1, width=3.6)
    cell_map(ax, values, workspace, low=0.0, high=high)
    if path is not None:
        draw_path(ax, path, workspace.grid)
    _finish(figure, axes, workspace, label, (0.0, high))
    return ax


def cell_map(
    ax: Axes,
    values: xr.DataArray,
    workspace: Workspace,
    *,
    low: float | None = None,
    high: float | None = None,
) -> AxesImage:
    """Draw a map of the planning cells under the hillshade; impassable cells are grey.

    Args:
        ax: Axes to draw on.
        values: Map (row, col).
        workspace: Workspace of the cells.
        low: Value of the darkest colour.
        high: Value of the brightest colour.

    Returns:
        Image, for a colour bar.
    """
    ax.set_facecolor(CLOSED)
    data = np.where(workspace.passable.values, values.transpose("row", "col").values, np.nan)
    extent = extent_of(workspace.grid)
    image = ax.imshow(
        data, cmap=COLOURS, vmin=low, vmax=high, extent=extent, interpolation="nearest"
    )
    draw_hillshade(ax, workspace)
    return image


def draw_hillshade(
    ax: Axes, workspace: Workspace, heights: str = "dem", *, exaggerate: float = 2.0
) -> None:
    """Draw the shadows of the terrain over a map, if the terrain is in memory.

    `heights` is `"dem"` or `"dsm"`, `exaggerate` a factor of the slopes.
    """
    shadow = hillshade(workspace, heights, exaggerate=exaggerate)
    if shadow is None:
        return
    pixels = np.zeros((*shadow.shape, 4))
    pixels[..., 3] = shadow
    ax.imshow(pixels, extent=extent_of(workspace.grid), interpolation="bilinear")


def hillshade(
    workspace: Workspace, heights: str = "dem", *, exaggerate: float = 2.0, most: int = 800
) -> np.ndarray | None:
    """Opacity of the terrain's shadows, (y, x) of some `most` pixels a side; None without one."""
    terrain = workspace.terrain
    if terrain is None or workspace.pixels is None:
        return None
    step = -(-max(terrain["dem"].shape) // most)  # more would not be visible
    dem = terrain[heights].values[::step, ::step]
    height, width = pixel_size(terrain)
    known = np.isfinite(dem)
    ground = np.where(known, dem, np.nanmean(dem))
    south, east = np.gradient(exaggerate * ground, height * step, width * step)
    # Sun in the north-west at 45 degrees. Level ground has a light of 1 and keeps the colour of the
    # colour bar, unlike in matplotlib's shading, which stretches the light to its extremes.
    light = (1.0 + (east + south) / np.sqrt(2.0)) / np.sqrt(1.0 + east**2 + south**2)
    return np.where(known, SHADOW * np.clip(1.0 - light, 0.0, 1.0), 0.0)


def draw_ground(ax: Axes, workspace: Workspace, heights: str = "dsm") -> None:
    """Draw vegetation in grey under the hillshade, or the grid without a terrain.

    The hillshade is that of the surface, `"dsm"`, or of the ground, `"dem"`.
    """
    terrain, grid = workspace.terrain, workspace.grid
    if terrain is None or workspace.pixels is None:
        ax.set_facecolor("0.92")
        grid_lines(ax, grid)
        return
    grown = (terrain["dsm"] - terrain["dem"]).values > _GROWN
    extent = extent_of(grid)
    ax.imshow(grown, cmap="Greys", vmin=0.0, vmax=3.0, extent=extent, interpolation="nearest")
    draw_hillshade(ax, workspace, heights, exaggerate=3.0)


def draw_scale(ax: Axes, grid: Grid) -> None:
    """Draw a bar of a round number of metres in the lower right corner of a map."""
    draw_scale_of(ax, grid.shape[1] * grid.cell_width)


def draw_scale_of(ax: Axes, width: float) -> None:
    """Draw a scale bar, see `draw_scale`, on Axes `width` metres wide."""
    magnitude = 10.0 ** np.floor(np.log10(0.4 * width))
    length = max(step * magnitude for step in (1, 2, 5) if step * magnitude <= 0.4 * width)
    x, y = 0.96 - length / width, 0.045  # of the axes
    (bar,) = ax.plot([x, x + length / width], [y, y], color="black", transform=ax.transAxes)
    bar.set(linewidth=2.0, solid_capstyle="butt", path_effects=outlined(4.0))
    label = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    text = ax.text(x, y + 0.02, label, fontsize=7, transform=ax.transAxes)
    text.set_path_effects(outlined(2.5))


def draw_path(ax: Axes, path: Sequence[Cell], grid: Grid) -> None:
    """Draw a path over a map, from its start (circle) to its goal (star)."""
    centers = np.array([grid.center(cell) for cell in path]) - grid.corner
    x, y = centers[:, 0], centers[:, 1]
    (line,) = ax.plot(x, y, color="white", linewidth=1.6, solid_joinstyle="round")
    line.set_path_effects(outlined(3.2, "black"))
    ax.plot(x[0], y[0], "wo", markeredgecolor="black", markersize=6)
    ax.plot(x[-1], y[-1], "w*", markeredgecolor="black", markersize=11)


def outlined(width: float, colour: str = "white") -> list[patheffects.AbstractPathEffect]:
    """Return the effect of an outline, `width` points with the line."""
    return [patheffects.withStroke(linewidth=width, foreground=colour)]


def _cells(path: np.ndarray) -> list[Cell]:
    return [(int(row), int(col)) for row, col in path if row >= 0]


def _extend(below: bool, above: bool) -> str:
    return {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above]


def _finish(
    figure: Figure,
    axes: np.ndarray,
    workspace: Workspace,
    label: str,
    limits: tuple[float, float],
    extend: str = "neither",
) -> None:
    """Add the scale, labels in metres, and one colour bar for all panels."""
    draw_scale(axes[0, 0], workspace.grid)
    label_maps(axes)
    if not workspace.passable.all():
        label += " (grey: impassable)"
    colours = ScalarMappable(Normalize(*limits), COLOURS)
    colour_bar(figure, colours, axes, label, extend=extend, aspect=15 * len(axes))
