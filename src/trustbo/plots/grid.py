"""Planning grid of a workspace, with the names of its cells."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap

from trustbo.plots.style import SMALL
from trustbo.workspace import Workspace
from trustbo.workspace.location import crs_name

_WIDTH = 7.0
"""Width of a new figure, inches."""
_MOST_NAMED = 24
"""Rows and columns above which cells are named at the edges alone."""


def grid_map(workspace: Workspace, *, ax: Axes | None = None) -> Axes:
    """Draw the mean heights of the cells, with the cells' names, row,col.

    Impassable cells are hatched; without a terrain, passable cells are blank.

    Args:
        workspace: Workspace of the cells.
        ax: Axes to draw on; by default a new figure.

    Returns:
        Axes of the grid.
    """
    grid, free = workspace.grid, workspace.passable.values
    rows, cols = grid.shape
    aspect = grid.cell_height / grid.cell_width
    if ax is None:
        height = np.clip(_WIDTH * rows * aspect / cols, 2.0, 11.0)
        _, ax = plt.subplots(figsize=(_WIDTH, height), layout="constrained")
    edges = np.arange(cols + 1) - 0.5, np.arange(rows + 1) - 0.5
    if workspace.terrain is not None:
        light = ListedColormap(plt.get_cmap("YlOrBr")(np.linspace(0.0, 0.55, 256)))
        image = ax.pcolormesh(*edges, grid.cell_means(workspace.terrain["dem"]), cmap=light)
        ax.figure.colorbar(image, ax=ax, label="mean height (m)", shrink=0.8)
    closed = np.ma.masked_array(np.ones(grid.shape), free)
    ax.pcolor(*edges, closed, cmap=ListedColormap(["0.8"]), hatch="///", edgecolor="0.6", lw=0.0)
    ax.vlines(edges[0], -0.5, rows - 0.5, color="black", lw=0.4, alpha=0.5)
    ax.hlines(edges[1], -0.5, cols - 0.5, color="black", lw=0.4, alpha=0.5)
    if max(rows, cols) <= _MOST_NAMED:
        size = min(SMALL, 72.0 * _WIDTH / (4.5 * cols))
        for row, col in np.ndindex(*grid.shape):
            name = f"{row},{col}"
            ax.text(col, row, name, ha="center", va="center", fontsize=size, color="black")
    ax.set(xlabel="column", ylabel="row", xlim=(-0.5, cols - 0.5), ylim=(rows - 0.5, -0.5))
    ax.set_aspect(aspect)
    ax.set_title(f"{crs_name(grid)}; hatched: without data or too steep", fontsize=9)
    return ax
