"""Planning grid of a surveyed terrain, with the names of its cells."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.ticker import MultipleLocator

from trustbo.plots.style import SMALL
from trustbo.workspace import Survey
from trustbo.workspace.location import crs_name

_MOST_NAMED = 15
"""Rows or columns above which cells are named at the edges alone."""


def grid_map(found: Survey) -> Axes:
    """Draw the mean heights of the cells of a terrain, with the cells' names, row,col.

    Impassable cells are hatched; a suggested start is a circle, a goal a star.
    """
    grid, cells = found.grid, found.cells
    (rows, cols), (left, bottom, right, top) = grid.shape, grid.bounds
    wide = 7.0
    tall = float(np.clip(wide * (top - bottom) / (right - left), 3.0, 11.0))
    figure, ax = plt.subplots(figsize=(wide + 1.6, tall + 1.2), layout="constrained")
    heights = cells["height"].where(cells["missing"] < 1.0).values
    light = ListedColormap(plt.get_cmap("YlOrBr")(np.linspace(0.0, 0.55, 256)))  # names are black
    image = ax.imshow(heights, cmap=light, extent=(-0.5, cols - 0.5, rows - 0.5, -0.5))
    ax.set_aspect(grid.cell_height / grid.cell_width)
    figure.colorbar(image, ax=ax, label="mean height (m)", shrink=0.8)
    closed = np.ma.masked_array(np.ones(grid.shape), found.passable)
    edges = np.arange(cols + 1) - 0.5, np.arange(rows + 1) - 0.5
    grey = ListedColormap(["0.8"])
    ax.pcolor(*edges, closed, cmap=grey, hatch="///", edgecolor="0.6", linewidth=0.0)
    ax.vlines(edges[0], -0.5, rows - 0.5, color="black", linewidth=0.4, alpha=0.5)
    ax.hlines(edges[1], -0.5, cols - 0.5, color="black", linewidth=0.4, alpha=0.5)
    if max(grid.shape) <= _MOST_NAMED:
        for row, col in np.ndindex(*grid.shape):
            ax.text(
                col, row, f"{row},{col}", ha="center", va="center", fontsize=SMALL, color="black"
            )
    if found.passable.sum() > 1:
        start, goal = found.ends
        for cell, marker, name in ((start, "o", "start"), (goal, "*", "goal")):
            label = f"e.g. --{name} {cell[0]},{cell[1]}"
            ax.plot(
                cell[1], cell[0] + 0.3, marker, color="white", markeredgecolor="black",
                markersize=10, linestyle="none", label=label,
            )  # fmt: skip
        figure.legend(loc="outside lower center", ncols=2, frameon=False)
    for axis, n in ((ax.xaxis, cols), (ax.yaxis, rows)):
        axis.set_major_locator(MultipleLocator(max(1, -(-n // 20))))
    ax.set_xlabel("column")
    ax.set_ylabel("row")
    ax.set_title(
        f"{crs_name(grid)}: x {left:.1f} to {right:.1f}, y {bottom:.1f} to {top:.1f} m\n"
        "hatched: without data or too steep",
        fontsize=9,
    )
    return ax
