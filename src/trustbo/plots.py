"""Figures: each function takes data and returns Axes; nothing is computed here but the layout."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LightSource, ListedColormap, Normalize
from matplotlib.image import AxesImage

from trustbo.data import Cell
from trustbo.errors import TrustboError
from trustbo.terrain import Grid, Workspace, pixel_size

if TYPE_CHECKING:
    from trustbo.result import Result

COLOURS = "viridis"
"""Perceptually uniform, safe for the colour-blind, and monotone in greyscale."""
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
    tall = _tallness(grid)
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
    for ax in panels[len(maps) :]:
        ax.set_visible(False)
    _label_outer(axes, grid)
    extend = _extend(np.nanmin(everything) < low, np.nanmax(everything) > high)
    label = "expected trust"
    if not result.workspace.passable.all():
        label += " (grey: impassable)"
    colours = ScalarMappable(Normalize(low, high), COLOURS)
    _colour_bar(figure, colours, axes, label, extend=extend, aspect=15 * n_rows)
    return panels[: len(maps)]


def terrain_maps(workspace: Workspace) -> np.ndarray:
    """The paper's Fig. 4: surface, traversability and visibility of a terrain.

    Args:
        workspace: A workspace made from a terrain.

    Returns:
        The three Axes.

    Raises:
        TrustboError: The workspace has no terrain.
    """
    terrain, pixels = workspace.terrain, workspace.pixels
    if terrain is None or pixels is None:
        raise TrustboError("terrain_maps needs a workspace made with Workspace.from_terrain.")
    grid = workspace.grid
    tall = _tallness(grid)
    width = 3.6 if tall < 2 else 2.0
    figure, axes = plt.subplots(
        1,
        3,
        figsize=(3 * width + 1.8, width * tall + 0.7),
        sharex=True,
        sharey=True,
        layout="constrained",
    )
    extent = _extent(grid)
    dsm = terrain["dsm"].values
    height, width = pixel_size(terrain)
    lowest, highest = float(np.nanmin(dsm)), float(np.nanmax(dsm))
    heights = Normalize(lowest, highest)
    shaded = LightSource(azdeg=315, altdeg=45).shade(
        np.nan_to_num(dsm, nan=lowest),
        cmap=plt.get_cmap("cividis"),
        norm=heights,
        blend_mode="soft",
        dx=width,
        dy=height,
    )
    shaded[~np.isfinite(dsm)] = 1.0
    axes[0].imshow(shaded, extent=extent)
    axes[0].set_title("surface (DSM)", fontsize=9)
    _colour_bar(figure, ScalarMappable(heights, "cividis"), axes[0], "height (m)")
    for ax, name in zip(axes[1:], ("traversability", "visibility"), strict=True):
        ax.imshow(pixels[name].values, cmap=COLOURS, vmin=0, vmax=1, extent=extent)
        ax.set_title(name, fontsize=9)
    steep = np.isfinite(dsm) & ~pixels["passable"].values
    closed = np.where(steep, 1.0, np.nan)
    axes[1].imshow(closed, cmap=ListedColormap([CLOSED]), extent=extent, interpolation="nearest")
    for ax in axes:
        ax.set_facecolor("white")
        _grid_lines(ax, grid)
    label = "index (0 worst, 1 best; grey: too steep)"
    _colour_bar(figure, ScalarMappable(Normalize(0, 1), COLOURS), axes[1:], label)
    _label_outer(axes[None], grid)
    return axes


def cell_map(
    ax: Axes,
    values: xr.DataArray,
    workspace: Workspace,
    *,
    low: float | None = None,
    high: float | None = None,
) -> AxesImage:
    """Draw a map of the planning cells; cells no robot can enter are grey.

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
    extent = _extent(workspace.grid)
    return ax.imshow(
        data, cmap=COLOURS, vmin=low, vmax=high, extent=extent, interpolation="nearest"
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


def _colour_bar(figure, image, axes, label: str, **options) -> None:
    bar = figure.colorbar(image, ax=axes, pad=0.02, **{"aspect": 18, "shrink": 0.9} | options)
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=7)


def _cells(path: np.ndarray) -> list[Cell]:
    return [(int(row), int(col)) for row, col in path if row >= 0]


def _corner(grid: Grid) -> np.ndarray:
    """The lower left corner, which maps are drawn relative to: CRS coordinates are long."""
    return np.array([grid.left, grid.top - grid.shape[0] * grid.cell_height])


def _extent(grid: Grid) -> tuple[float, float, float, float]:
    return (0.0, grid.shape[1] * grid.cell_width, 0.0, grid.shape[0] * grid.cell_height)


def _tallness(grid: Grid) -> float:
    """Height over width, within what fits a page."""
    ratio = grid.shape[0] * grid.cell_height / (grid.shape[1] * grid.cell_width)
    return float(np.clip(ratio, 0.25, 5.0))


def _extend(below: bool, above: bool) -> str:
    return {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above]


def _grid_lines(ax: Axes, grid: Grid) -> None:
    for col in range(1, grid.shape[1]):
        ax.axvline(col * grid.cell_width, color="white", linewidth=0.3, alpha=0.5)
    for row in range(1, grid.shape[0]):
        ax.axhline(row * grid.cell_height, color="white", linewidth=0.3, alpha=0.5)


def _label_outer(axes: np.ndarray, grid: Grid) -> None:
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
