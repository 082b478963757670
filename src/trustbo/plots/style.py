"""Style, colours and axes of all figures."""

import io
import math
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import AutoLocator
from matplotlib.transforms import Bbox

from trustbo.errors import TrustboError
from trustbo.files import FilePath, write_file

RC: dict[str, Any] = {
    "font.size": 8.0,
    "axes.titlesize": 9.0,
    "axes.labelsize": 8.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "image.cmap": "viridis",
    "image.interpolation": "nearest",
    "hatch.linewidth": 0.6,
}
"""Matplotlib settings of all figures, besides Matplotlib's defaults and `KEPT`."""
KEPT = (
    "font.", "mathtext.", "figure.dpi", "figure.facecolor", "figure.edgecolor", "text.color",
    "axes.facecolor", "axes.edgecolor", "axes.labelcolor", "axes.titlecolor", "axes.labelweight",
    "axes.titleweight", "axes.grid", "axes.formatter.use_locale", "grid.", "xtick.color",
    "xtick.labelcolor", "ytick.color", "ytick.labelcolor", "legend.labelcolor",
)  # fmt: skip
"""Beginnings of the Matplotlib settings that are the user's.

These are fonts, the resolution, colours of text and background, and the grid. Other settings may
change what a figure says, as `image.origin` and `lines.linestyle` do, or crop it, as `axes.xmargin`
does.
"""
ROBOTS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
"""Colours of the robots, from the palette of Okabe and Ito (2008)."""
MARKERS = "osD^vPX*<>"
"""Markers of the robots, which distinguish them in print without colour."""
GREY = "0.55"
"""Colour of impassable cells and auxiliary lines, for light and dark backgrounds."""
PAGE = 7.6
"""Page width in inches, which is the maximum width of a new figure."""
N_INTERVALS = 5
"""Largest number of intervals between ticks.

The number does not depend on the size of the axes: Matplotlib computes the layout first, and labels
of other ticks that it chose afterwards could be cut off.
"""
_LETTERS = 15.0
"""Number of letters of an axis label per inch, a little less than fit."""
_BROAD = 1.5
"""Width of a panel, in inches, from which a title of two words and a legend fit into it."""
_WIDE = 5.0
"""Width of a figure, in inches, from which a legend has four columns instead of two."""


@contextmanager
def drawing(kept: tuple[str, ...] = KEPT) -> Iterator[None]:
    """Draw with Matplotlib's defaults, the user's settings of some names, and `RC`.

    Afterwards, the user's settings are restored. Matplotlib loads its backend with the first
    figure. In notebooks, the backend then turns on a setting for displaying figures. The backend is
    therefore loaded first, so that restoring keeps this setting.

    Args:
        kept: Beginnings of the names of the settings that stay as they are.
    """
    plt.draw_if_interactive()
    names: list[Any] = [name for name in mpl.rcParams if name.startswith(kept)]
    users = {name: mpl.rcParams[name] for name in names}
    with plt.style.context(["default", users, RC]):
        yield


styled = drawing()
"""Decorator that applies `drawing` to a function that draws a figure."""


def panels(
    n: int, ax: Any, size: tuple[float, float], *, columns: int = 4, **shared: Any
) -> np.ndarray:
    """Return axes for n panels, row by row: the user's axes, or the axes of a new figure.

    Args:
        n: Number of panels.
        ax: The user's axes, one or an array; None for a new figure.
        size: Width and height of a panel of a new figure, in inches.
        columns: Maximum number of panels in a row.
        **shared: `sharex` and `sharey` of `plt.subplots`.

    Raises:
        TrustboError: `ax` has too few axes, or contains other objects.
    """
    if ax is None:
        axes = _new_axes(n, size, min(n, columns), shared)
    else:
        axes = np.asarray(ax, dtype=object).ravel()
        if len(axes) < n or not all(isinstance(panel, Axes) for panel in axes):
            raise TrustboError(f"ax must have at least {n} Axes, one per panel; got {ax!r:.80}.")

    for panel in axes[:n]:  # the font sizes of the user's axes may differ
        panel.tick_params(labelsize=RC["xtick.labelsize"])
        panel.set_prop_cycle(None)  # the user's cycle may set markers and line styles
        for axis in (panel.xaxis, panel.yaxis):
            axis.label.set_size(RC["axes.labelsize"])
            locator = axis.get_major_locator()
            if isinstance(locator, AutoLocator):
                locator.set_params(nbins=N_INTERVALS)
    return axes[:n]


def _new_axes(n: int, size: tuple[float, float], columns: int, shared: Any) -> np.ndarray:
    """Return n axes of a new figure that fits on a page; see `panels`."""
    rows = math.ceil(n / columns)
    width = min(columns * size[0], PAGE)
    height = rows * size[1] * width / (columns * size[0])
    _, grid = plt.subplots(
        rows, columns, figsize=(width, height), squeeze=False, layout="compressed", **shared
    )

    axes = grid.ravel()
    for unused in axes[n:]:
        unused.remove()
    return axes[:n]


def robot_looks(names: Iterable[str]) -> Iterator[tuple[str, str, str]]:
    """Yield the name, the colour and the marker of each robot."""
    return zip(names, cycle(ROBOTS), cycle(MARKERS), strict=False)


def in_lines(label: str, axes: Sequence[Axes] | np.ndarray) -> str:
    """Break the label of a vertical axis beside axes into lines that are shorter than these."""
    height = Bbox.union([panel.get_position() for panel in axes]).height  # of the figure
    most = max(int(_LETTERS * figure_of(axes).get_figheight() * height), 1)
    lines = label.split("\n")
    return "\n".join(textwrap.fill(line, most, break_long_words=False) for line in lines)


def figure_of(axes: Sequence[Axes] | np.ndarray) -> Figure:
    """Return the figure that contains the axes, not a subfigure."""
    figure = axes[0].get_figure(root=True)
    assert isinstance(figure, Figure)  # noqa: S101
    return figure


def save_figure(path: FilePath, axes: Any) -> None:
    """Write the figure of axes to an image file whose ending names the format.

    Raises TrustboError if Matplotlib does not know the format, or the file cannot be written.
    """
    picture = io.BytesIO()
    figure = figure_of(np.ravel(axes))
    try:
        figure.savefig(picture, format=Path(path).suffix[1:] or "png", dpi=150)
    except ValueError as error:
        raise TrustboError(f"{path}: {error}.") from None
    write_file(path, picture.getvalue())


def handles_of(panel: Axes) -> list[Any]:
    """Return the labelled lines and areas of a panel, for a legend."""
    return panel.get_legend_handles_labels()[0]


def add_legend(axes: np.ndarray, handles: Sequence[Any], *, columns: int = 4) -> None:
    """Add a legend below the axes or, without a constrained layout, inside the first axes.

    It has at most `columns` columns, and at most two in a narrow figure.

    Without a constrained layout, narrow axes get no legend, because it would hide the data.
    """
    figure = figure_of(axes)
    if isinstance(figure.get_layout_engine(), ConstrainedLayoutEngine):
        most = columns if figure.get_figwidth() >= _WIDE else min(columns, 2)
        columns = min(len(handles), most)
        figure.legend(handles=handles, loc="outside lower center", ncols=columns)
    elif is_broad(axes[0]):
        axes[0].legend(handles=list(handles))


def is_broad(panel: Axes) -> bool:
    """Return whether a panel is wide enough for a title of two words, or for a legend."""
    return figure_of([panel]).get_figwidth() * panel.get_position().width >= _BROAD


def accent() -> str:
    """Return the colour of a single curve: a light blue on dark backgrounds, else a dark blue."""
    return ROBOTS[4] if np.mean(to_rgb(background())) < 0.5 else ROBOTS[0]


def ink() -> str:
    """Return the colour of text."""
    return mpl.rcParams["text.color"]


def background() -> str:
    """Return the background colour of axes."""
    return mpl.rcParams["axes.facecolor"]


def outlined(width: float, colour: str) -> list[patheffects.AbstractPathEffect]:
    """Return an effect that outlines a line; `width` is the total width, in points."""
    return [patheffects.withStroke(linewidth=width, foreground=colour)]


def as_text(name: object) -> str:
    """Convert a name to plain text for Matplotlib: escape "$", and replace "_" with a space."""
    return str(name).replace("$", r"\$").replace("_", " ")
