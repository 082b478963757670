"""Maps of trust, and what every map has: hillshade, scale, metres."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

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
    label_maps,
    map_panels,
    tallness,
)
from trustbo.terrain import Grid, Workspace, pixel_size

if TYPE_CHECKING:
    from trustbo.result import Result

COLOURS = "viridis"
"""Perceptually uniform, safe for the colour-blind, and monotone in greyscale."""
SHADOW = 0.55
"""How dark the darkest shadow of the hillshade is."""
CLOSED = "0.75"
"""Grey of cells and pixels where no robot can go."""


def trust_maps(result: "Result", *, n_columns: int | None = None) -> np.ndarray:
    """The paper's Fig. 5: the trust map of each iteration with the path planned on it.

    One more panel shows the map and the recommended path after the last mission.

    Args:
        result: A result of `iterate`.
        n_columns: Panels per row; by default 3, or more where the terrain is tall.

    Returns:
        The Axes, shape (iteration + 1,).
    """
    history = result.history
    maps = [history["trust_map"].isel(iteration=i) for i in range(history.sizes["iteration"])]
    paths = [_cells(path) for path in history["path"].values]
    titles = [f"mission {i}" for i in history["iteration"].values]
    titles[0] += " (from the prior)"
    maps, paths = [*maps, result.trust_map], [*paths, result.path]
    titles.append(f"after {len(titles)} mission{'s' if len(titles) > 1 else ''}")
    # The first map comes from the prior and may be far off, and the start cell's trust is assumed,
    # not learned: the rest sets the colours.
    everything = np.stack([trust.values for trust in maps])
    learned = everything[1:].copy()
    learned[:, *paths[0][0]] = np.nan
    low, high = np.nanmin(learned), np.nanmax(learned)
    workspace = result.workspace
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
    """One map for each robot, in the same colours.

    Args:
        maps: Dims (robot, row, col), such as `planner.cost_map(params, per_robot=True)`: the
            paper's cost f = 1 - sigma(trust).
        workspace: Whose cells they are.
        path: A path to draw on each.
        label: What is shown, for the colour bar.
        n_columns: Panels per row; by default two, or more where the terrain is tall.

    Returns:
        The Axes, shape (robot,).
    """
    maps = maps.transpose("robot", "row", "col")
    names = [str(name) for name in maps["robot"].values]
    limits = float(maps.min()), float(maps.max())
    n_columns = _two(workspace) if n_columns is None else n_columns
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
    """Where the best path may be: each cell's probability to be on it.

    Args:
        share: Dims (row, col), in [0, 1], such as `planner.path_posterior(posterior)`.
        workspace: Whose cells they are.
        path: A path to draw, such as the recommended one.

    Returns:
        The Axes.
    """
    figure, axes, (ax,) = map_panels(workspace.grid, 1, 1, width=3.6)
    cell_map(ax, share, workspace, low=0.0, high=1.0)
    if path is not None:
        draw_path(ax, path, workspace.grid)
    _finish(figure, axes, workspace, "P(cell on the best path)", (0.0, 1.0))
    return ax


def cell_map(
    ax: Axes,
    values: xr.DataArray,
    workspace: Workspace,
    *,
    low: float | None = None,
    high: float | None = None,
) -> AxesImage:
    """Draw a map of the planning cells over its terrain's hillshade; closed cells are grey.

    Args:
        ax: Where to draw.
        values: Dims (row, col).
        workspace: Whose cells they are.
        low: Value of the darkest colour.
        high: Value of the brightest colour.

    Returns:
        The image, for a colour bar.
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
    """Shadows over what is drawn already, if there is a terrain in memory.

    Args:
        ax: Where to draw.
        workspace: Whose terrain.
        heights: `"dem"` for the ground's, `"dsm"` for the surface's.
        exaggerate: How many times steeper than it is the ground is to look.
    """
    terrain = workspace.terrain
    if terrain is None or workspace.pixels is None:
        return
    # At most some 800 pixels a side: more cannot be seen.
    step = -(-max(terrain["dem"].shape) // 800)
    dem = terrain[heights].values[::step, ::step]
    height, width = pixel_size(terrain)
    known = np.isfinite(dem)
    ground = np.where(known, dem, np.nanmean(dem))
    south, east = np.gradient(exaggerate * ground, height * step, width * step)
    # Level ground has a light of 1, and so keeps its colour: that of the colour bar. The sun is in
    # the north-west at 45 degrees; not matplotlib's shading, which stretches light to its extremes.
    light = (1.0 + (east + south) / np.sqrt(2.0)) / np.sqrt(1.0 + east**2 + south**2)
    shadow = np.zeros((*dem.shape, 4))
    shadow[..., 3] = np.where(known, SHADOW * np.clip(1.0 - light, 0.0, 1.0), 0.0)
    ax.imshow(shadow, extent=extent_of(workspace.grid), interpolation="bilinear")


def draw_scale(ax: Axes, grid: Grid) -> None:
    """A bar of a round number of metres in the lower right corner of a map."""
    draw_scale_of(ax, grid.shape[1] * grid.cell_width)


def draw_scale_of(ax: Axes, width: float) -> None:
    """As `draw_scale`, on Axes that are so many metres wide."""
    magnitude = 10.0 ** np.floor(np.log10(0.4 * width))
    length = max(step * magnitude for step in (1, 2, 5) if step * magnitude <= 0.4 * width)
    outline = [patheffects.Stroke(linewidth=4.0, foreground="white"), patheffects.Normal()]
    x, y = 0.96 - length / width, 0.045  # of the axes
    ax.plot(
        [x, x + length / width],
        [y, y],
        transform=ax.transAxes,
        color="black",
        linewidth=2.0,
        solid_capstyle="butt",
        path_effects=outline,
    )
    ax.text(
        x,
        y + 0.02,
        f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m",
        transform=ax.transAxes,
        fontsize=7,
        path_effects=[patheffects.Stroke(linewidth=2.5, foreground="white"), patheffects.Normal()],
    )


def draw_path(ax: Axes, path: Sequence[Cell], grid: Grid) -> None:
    """Draw a path over a map, from its start (circle) to its goal (star)."""
    centers = np.array([grid.center(cell) for cell in path]) - grid.corner
    outline = [patheffects.Stroke(linewidth=3.2, foreground="black"), patheffects.Normal()]
    x, y = centers[:, 0], centers[:, 1]
    ax.plot(x, y, color="white", linewidth=1.6, path_effects=outline, solid_joinstyle="round")
    edge: dict[str, Any] = {
        "markeredgecolor": "black",
        "markerfacecolor": "white",
        "linestyle": "none",
    }
    ax.plot(x[0], y[0], marker="o", markersize=6, **edge)
    ax.plot(x[-1], y[-1], marker="*", markersize=11, **edge)


def _cells(path: np.ndarray) -> list[Cell]:
    return [(int(row), int(col)) for row, col in path if row >= 0]


def _extend(below: bool, above: bool) -> str:
    return {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above]


def _two(workspace: Workspace) -> int | None:
    return 2 if tallness(workspace.grid) < 2 else None


def _finish(
    figure: Figure,
    axes: np.ndarray,
    workspace: Workspace,
    label: str,
    limits: tuple[float, float],
    extend: str = "neither",
) -> None:
    """The scale, metres, and one colour bar for all panels."""
    draw_scale(axes[0, 0], workspace.grid)
    label_maps(axes)
    if not workspace.passable.all():
        label += " (grey: impassable)"
    colours = ScalarMappable(Normalize(*limits), COLOURS)
    colour_bar(figure, colours, axes, label, extend=extend, aspect=15 * len(axes))
