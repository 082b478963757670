"""Figure of the planning grid, with labelled cells."""

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap

from trustbo.errors import require_kind
from trustbo.plots.style import figure_of, panels, styled
from trustbo.workspace import Workspace

_WIDTH = 7.0  # of a new figure, inches
_MAX_LABELLED = 24
"""Number of rows or columns up to which every cell is labelled."""


@styled
def grid_map(workspace: Workspace, *, ax: Axes | None = None) -> Axes:
    """Plot the mean height of each cell, labelled with its row and column.

    Impassable cells are hatched. Without a terrain, passable cells are blank.

    Args:
        workspace: Workspace of the cells.
        ax: Axes to draw on; by default a new figure.

    Returns:
        Axes of the figure.
    """
    require_kind("workspace", workspace, Workspace, "give a trustbo.Workspace")
    grid, (rows, cols) = workspace.grid, workspace.grid.shape
    tall = grid.cell_height / grid.cell_width
    height = float(np.clip(_WIDTH * rows * tall / cols, 2.0, 11.0))
    (one,) = panels(1, ax, (_WIDTH, height))
    edges = np.arange(cols + 1) - 0.5, np.arange(rows + 1) - 0.5
    if workspace.terrain is not None:
        light = ListedColormap(colormaps["YlOrBr"](np.linspace(0.0, 0.55, 256)))
        image = one.pcolormesh(*edges, grid.cell_means(workspace.terrain["dem"]), cmap=light)
        one.figure.colorbar(image, ax=one, label="mean height (m)")
    closed = np.ma.masked_array(np.ones(grid.shape), workspace.passable.values)
    one.pcolor(*edges, closed, cmap=ListedColormap(["0.8"]), hatch="///", edgecolor="0.6", lw=0.0)
    one.vlines(edges[0], -0.5, rows - 0.5, color="black", lw=0.4, alpha=0.5)
    one.hlines(edges[1], -0.5, cols - 0.5, color="black", lw=0.4, alpha=0.5)
    if max(rows, cols) <= _MAX_LABELLED:
        room = figure_of([one]).get_figwidth() * one.get_position().width / cols  # inches
        size = min(8.0, 72.0 * room / 3.2)
        for row, col in np.ndindex(*grid.shape):
            one.text(col, row, f"{row},{col}", ha="center", va="center", size=size, color="black")
    one.set(xlabel="column", ylabel="row", xlim=(-0.5, cols - 0.5), ylim=(rows - 0.5, -0.5))
    one.set_aspect(tall)
    one.set_title(f"{grid.crs_name}\nhatched: without data or too steep")
    return one
