"""Layout of figures: small multiples, maps in metres, colour bars."""

import textwrap
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from trustbo.errors import require_whole
from trustbo.workspace import Grid

_LETTERS = 12
"""Letters of a colour bar's label for each inch of the figure's height."""

MARKERS = "osD^vPX*<>"
DASHES = ("-", (0, (5, 1.5)), (0, (1, 1)), (0, (6, 1.5, 1, 1.5)), (0, (3, 1, 1, 1, 1, 1)))
"""Line styles of curves in one panel, in order, to tell them apart without colour."""


def small_multiples(
    n: int, n_columns: int | None, size: tuple[float, float], margin: float = 0.0, **shared: Any
) -> tuple[Figure, np.ndarray, np.ndarray]:
    """Make a figure of n equal panels, row by row: `size` is a panel's width and height, inches.

    At most `n_columns` per row, None for three, or two if there are four; `margin`, inches, is left
    beside the panels for a colour bar or a legend; `shared` are `sharex` and `sharey` of
    `plt.subplots`. Returns the figure, all its Axes (row, column), and those of the panels (n,);
    the others are invisible. TrustboError: `n_columns` is not a whole number from 1 on.
    """
    usual = 2 if n == 4 else 3
    columns = min(usual if n_columns is None else require_whole("n_columns", n_columns, 1), n)
    rows = -(-n // columns)
    figure, axes = plt.subplots(
        rows,
        columns,
        figsize=(size[0] * columns + margin, size[1] * rows),
        squeeze=False,
        layout="constrained",
        **shared,
    )
    panels = axes.ravel()
    for ax in panels[n:]:
        ax.set_visible(False)
    return figure, axes, panels[:n]


def map_panels(
    grid: Grid, n: int, n_columns: int | None, width: float = 2.6
) -> tuple[Figure, np.ndarray, np.ndarray]:
    """Make a figure of maps, see `small_multiples`; a tall terrain has more of them in a row."""
    tall = tallness(grid)
    if tall >= 2:
        width, n_columns = 0.6 * width, 5 if n_columns is None else n_columns
    size = width, width * tall + 0.55
    made = small_multiples(n, n_columns, size, margin=1.2, sharex=True, sharey=True)
    made[0].set_layout_engine("compressed")  # panels keep the terrain's proportions
    return made


def colour_bar(figure, image, axes, label: str, **options) -> None:
    """Add a colour bar with small numbers; a label longer than the figure is high is broken."""
    bar = figure.colorbar(image, ax=axes, pad=0.02, **{"aspect": 18, "shrink": 0.9} | options)
    n_letters = max(16, int(_LETTERS * figure.get_figheight()))
    bar.set_label(textwrap.fill(label, n_letters), fontsize=8)
    bar.ax.tick_params(labelsize=7)


def extent_of(grid: Grid) -> tuple[float, float, float, float]:
    """Left, right, bottom and top of a map, m from its lower left corner."""
    return (0.0, grid.shape[1] * grid.cell_width, 0.0, grid.shape[0] * grid.cell_height)


def tallness(grid: Grid) -> float:
    """Height over width, clipped to fit a page."""
    ratio = grid.shape[0] * grid.cell_height / (grid.shape[1] * grid.cell_width)
    return float(np.clip(ratio, 0.25, 5.0))


def grid_lines(ax: Axes, grid: Grid) -> None:
    """Draw the edges of the cells."""
    for col in range(1, grid.shape[1]):
        ax.axvline(col * grid.cell_width, color="white", linewidth=0.3, alpha=0.5)
    for row in range(1, grid.shape[0]):
        ax.axhline(row * grid.cell_height, color="white", linewidth=0.3, alpha=0.5)


def label_maps(axes: np.ndarray) -> None:
    """Label the outer Axes of a figure (row, column) of maps in metres."""
    for ax in axes.ravel():
        ax.set_aspect("equal")
        ax.tick_params(labelsize=7)
    for row in axes:
        row[0].set_ylabel("north (m)", fontsize=8)
    for ax in lowest(axes):
        ax.set_xlabel("east (m)", fontsize=8)
        ax.tick_params(labelbottom=True)


def lowest(axes: np.ndarray) -> list[Axes]:
    """Return the Axes, of all (row, column), with no visible ones below them."""
    last = len(axes) - 1
    return [
        ax
        for i, row in enumerate(axes)
        for j, ax in enumerate(row)
        if ax.get_visible() and (i == last or not axes[i + 1, j].get_visible())
    ]


def as_text(name: str) -> str:
    """Escape dollar signs, which matplotlib takes for formulas."""
    return name.replace("$", r"\$")


def plain(ax: Axes) -> None:
    """Remove the upper and right frame, and make numbers small."""
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=7)
