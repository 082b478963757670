"""Planning grid of a surveyed terrain, with the names of its cells."""

import math

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.ticker import MultipleLocator

from trustbo.plots.style import SMALL
from trustbo.workspace.location import crs_name
from trustbo.workspace.survey import Survey

_WIDTH, _HEIGHT, _LEAST = 7.0, 11.0, 1.5
"""Largest width and height of the map, and the least of either, inches."""
_LETTER = SMALL / 72.0
"""Height of a letter of a cell's name, inches; its width is some 0.6 of that."""


def grid_map(survey: Survey) -> Axes:
    """Draw the mean heights of the cells of a terrain, with the cells' names, row,col.

    Cells too small for a name are named at the edges alone. Impassable cells are hatched; a
    suggested start is a circle, a goal a star.
    """
    grid, cells = survey.grid, survey.cells
    (rows, cols), (left, bottom, right, top) = grid.shape, grid.bounds
    scale = min(_WIDTH / (right - left), _HEIGHT / (top - bottom))
    wide, tall = (max(scale * side, _LEAST) for side in (right - left, top - bottom))
    cell = scale * grid.cell_width, scale * grid.cell_height
    figure, ax = plt.subplots(figsize=(wide + 1.6, tall + 1.2), layout="constrained")
    heights = cells["height"].where(cells["missing"] < 1.0).values
    light = ListedColormap(plt.get_cmap("YlOrBr")(np.linspace(0.0, 0.55, 256)))  # names are black
    image = ax.imshow(heights, cmap=light, extent=(-0.5, cols - 0.5, rows - 0.5, -0.5))
    ax.set_aspect(grid.cell_height / grid.cell_width)
    figure.colorbar(image, ax=ax, label="mean height (m)", shrink=0.8)
    closed = np.ma.masked_array(np.ones(grid.shape), survey.passable)
    edges = np.arange(cols + 1) - 0.5, np.arange(rows + 1) - 0.5
    grey = ListedColormap(["0.8"])
    ax.pcolor(*edges, closed, cmap=grey, hatch="///", edgecolor="0.6", linewidth=0.0)
    ax.vlines(edges[0], -0.5, rows - 0.5, color="black", linewidth=0.4, alpha=0.5)
    ax.hlines(edges[1], -0.5, cols - 0.5, color="black", linewidth=0.4, alpha=0.5)
    letters = len(f"{rows - 1},{cols - 1}")
    named = cell[0] > 0.6 * (letters + 1) * _LETTER and cell[1] > 1.3 * _LETTER
    if named:
        for row, col in np.ndindex(*grid.shape):
            ax.text(
                col, row, f"{row},{col}", ha="center", va="center", fontsize=SMALL, color="black"
            )
    if survey.passable.sum() > 1:
        start, goal = survey.ends
        cell_is_wide, size = cell[0] > 2.0 * cell[1], min(10.0, max(4.0, 43.0 * min(cell)))
        for end, marker, name in ((start, "o", "start"), (goal, "*", "goal")):
            label = f"e.g. --{name} {end[0]},{end[1]}"
            aside = (0.0, 0.0)
            if named:
                aside = (-0.3, 0.0) if cell_is_wide else (0.0, 0.3)
            ax.plot(
                end[1] + aside[0], end[0] + aside[1], marker, color="white",
                markeredgecolor="black", markersize=size, linestyle="none", label=label,
            )  # fmt: skip
        figure.legend(loc="outside lower center", ncols=2 if wide > 4.0 else 1, frameon=False)
    for axis, n, side in ((ax.xaxis, cols, cell[0]), (ax.yaxis, rows, cell[1])):
        axis.set_major_locator(MultipleLocator(max(1, -(-n // 20), math.ceil(0.15 / side))))
    ax.set_xlabel("column")
    ax.set_ylabel("row")
    gap = " " if wide > 5.0 else "\n"
    ax.set_title(
        f"{crs_name(grid)}:{gap}x {left:.1f} to {right:.1f},{gap}y {bottom:.1f} to {top:.1f} m\n"
        f"hatched:{gap}without data or too steep",
        fontsize=9,
    )
    return ax
