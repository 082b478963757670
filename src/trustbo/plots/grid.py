"""Figure of the planning grid, with labelled cells."""

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap

from trustbo.errors import require_kind
from trustbo.plots.style import figure_of, in_lines, panels, round_ticks, styled
from trustbo.workspace import Workspace

_WIDTH = 7.0
"""Width of a new figure, in inches."""
_HEIGHTS = (2.0, 11.0)
"""Least and largest height of a new figure, in inches."""
_LARGEST_LABEL = 8.0
"""Size of labels, points, if cells are wide enough."""
_LABEL_WIDTH = 3.2
"""Width of a label, such as "10,12", per size."""
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

    Example:
        >>> tb.plots.grid_map(workspace).figure.savefig("grid.png")
    """
    require_kind("workspace", workspace, Workspace, "give a trustbo.Workspace")
    grid = workspace.grid
    rows, cols = grid.shape

    tall = grid.cell_height / grid.cell_width
    height = float(np.clip(_WIDTH * rows * tall / cols, *_HEIGHTS))
    (panel,) = panels(1, ax, (_WIDTH, height))

    x = np.arange(cols + 1) - 0.5
    y = np.arange(rows + 1) - 0.5

    if workspace.terrain is not None:
        light = ListedColormap(colormaps["YlOrBr"](np.linspace(0.0, 0.55, 256)))
        image = panel.pcolormesh(x, y, grid.cell_means(workspace.terrain["dem"]), cmap=light)
        label = in_lines("mean height (m)", [panel])
        panel.figure.colorbar(image, ax=panel, label=label, ticks=round_ticks())

    closed = np.ma.masked_array(np.ones(grid.shape), workspace.passable.values)
    panel.pcolor(x, y, closed, cmap=ListedColormap(["0.8"]), hatch="///", edgecolor="0.6", lw=0.0)
    panel.vlines(x, -0.5, rows - 0.5, color="black", lw=0.4, alpha=0.5)
    panel.hlines(y, -0.5, cols - 0.5, color="black", lw=0.4, alpha=0.5)

    if max(rows, cols) <= _MAX_LABELLED:
        room = figure_of([panel]).get_figwidth() * panel.get_position().width / cols  # inches
        size = min(_LARGEST_LABEL, 72.0 * room / _LABEL_WIDTH)  # 72 points per inch
        for row, col in np.ndindex(*grid.shape):
            panel.text(col, row, f"{row},{col}", ha="center", va="center", size=size, color="black")

    panel.set(xlabel="column", ylabel="row", xlim=(-0.5, cols - 0.5), ylim=(rows - 0.5, -0.5))
    panel.set_aspect(tall)
    panel.set_title(f"{grid.crs_name}\nhatched: without data or too steep")
    return panel
