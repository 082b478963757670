"""Maps of trust, and what every map has: hillshade, scale, metres."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LightSource, Normalize
from matplotlib.image import AxesImage

from trustbo.data import Cell
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
    grid = result.workspace.grid
    tall = tallness(grid)
    n_columns = min(n_columns or (3 if tall < 2 else 5), len(maps))
    n_rows = -(-len(maps) // n_columns)
    width = 2.6 if tall < 2 else 1.5
    figure, axes = plt.subplots(
        n_rows,
        n_columns,
        figsize=(width * n_columns + 1.2, width * tall * n_rows + 0.7),
        squeeze=False,
        sharex=True,
        sharey=True,
        layout="constrained",
    )
    panels = axes.ravel()
    for ax, trust, path, title in zip(panels, maps, paths, titles, strict=False):
        cell_map(ax, trust, result.workspace, low=low, high=high)
        draw_path(ax, path, grid)
        ax.set_title(title, fontsize=9)
    draw_scale(panels[0], grid)
    for ax in panels[len(maps) :]:
        ax.set_visible(False)
    label_outer(axes, grid)
    extend = _extend(np.nanmin(everything) < low, np.nanmax(everything) > high)
    label = "expected trust"
    if not result.workspace.passable.all():
        label += " (grey: impassable)"
    colours = ScalarMappable(Normalize(low, high), COLOURS)
    colour_bar(figure, colours, axes, label, extend=extend, aspect=15 * n_rows)
    return panels[: len(maps)]


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


def draw_hillshade(ax: Axes, workspace: Workspace, heights: str = "dem") -> None:
    """Shadows over what is drawn already, if there is a terrain in memory.

    Args:
        ax: Where to draw.
        workspace: Whose terrain.
        heights: `"dem"` for the ground's, `"dsm"` for the surface's.
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
    light = LightSource(azdeg=315, altdeg=45).hillshade(ground, dx=width * step, dy=height * step)
    shadow = np.zeros((*dem.shape, 4))
    # Level ground, lit at 45 degrees, keeps its colour: that of the colour bar.
    level = np.sin(np.deg2rad(45.0))
    shadow[..., 3] = np.where(known, SHADOW * np.clip(1.0 - light / level, 0.0, 1.0), 0.0)
    ax.imshow(shadow, extent=extent_of(workspace.grid), interpolation="bilinear")


def draw_scale(ax: Axes, grid: Grid) -> None:
    """A bar of a round number of metres in the lower right corner."""
    width = grid.shape[1] * grid.cell_width
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
    centers = np.array([grid.center(cell) for cell in path]) - _corner(grid)
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


def colour_bar(figure, image, axes, label: str, **options) -> None:
    """A colour bar in the figures' sizes."""
    bar = figure.colorbar(image, ax=axes, pad=0.02, **{"aspect": 18, "shrink": 0.9} | options)
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=7)


def _cells(path: np.ndarray) -> list[Cell]:
    return [(int(row), int(col)) for row, col in path if row >= 0]


def _corner(grid: Grid) -> np.ndarray:
    """The lower left corner, which maps are drawn relative to: CRS coordinates are long."""
    return np.array([grid.left, grid.top - grid.shape[0] * grid.cell_height])


def extent_of(grid: Grid) -> tuple[float, float, float, float]:
    """Left, right, bottom and top of a map, m from its lower left corner."""
    return (0.0, grid.shape[1] * grid.cell_width, 0.0, grid.shape[0] * grid.cell_height)


def tallness(grid: Grid) -> float:
    """Height over width, within what fits a page."""
    ratio = grid.shape[0] * grid.cell_height / (grid.shape[1] * grid.cell_width)
    return float(np.clip(ratio, 0.25, 5.0))


def _extend(below: bool, above: bool) -> str:
    return {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above]


def grid_lines(ax: Axes, grid: Grid) -> None:
    """The edges of the cells."""
    for col in range(1, grid.shape[1]):
        ax.axvline(col * grid.cell_width, color="white", linewidth=0.3, alpha=0.5)
    for row in range(1, grid.shape[0]):
        ax.axhline(row * grid.cell_height, color="white", linewidth=0.3, alpha=0.5)


def label_outer(axes: np.ndarray, grid: Grid) -> None:
    """Axes in metres, labelled where nothing is beside them."""
    for ax in axes.ravel():
        ax.set_aspect("equal")
        ax.tick_params(labelsize=7)
    visible = [[ax.get_visible() for ax in row] for row in axes]
    for i, row in enumerate(axes):
        row[0].set_ylabel("north (m)", fontsize=8)
        for j, ax in enumerate(row):
            lowest = i == len(axes) - 1 or not visible[i + 1][j]
            if lowest:
                ax.set_xlabel("east (m)", fontsize=8)
                ax.tick_params(labelbottom=True)
