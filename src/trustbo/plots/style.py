"""Appearance that all figures share: colours, and the options of a user."""

from dataclasses import dataclass, fields
from typing import Any, NamedTuple, Self, TypedDict

import matplotlib as mpl
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, to_hex, to_rgb

from trustbo.errors import TrustboError, require_known, require_positive, require_whole

COLOURS = "viridis"
"""Perceptually uniform, safe for the colour-blind, and monotone in greyscale."""
SMALL, MEDIUM = 8.0, 9.0
"""Sizes of text, points: of numbers and keys, and of labels and titles."""


class Theme(NamedTuple):
    """Colours of all but data values, hexadecimal."""

    ink: str
    """Colour of text, frames and measurements."""
    paper: str
    """Background."""
    quiet: str
    """References, such as a prior or a line at 0."""
    band: str
    """Area where a sound model stays."""
    line: str
    """Middle of a posterior."""
    inner: str
    """Half of a posterior."""
    outer: str
    """Nine tenths of a posterior."""
    odd: str
    """Points outside their band."""
    ground: str
    """Bare ground under robots."""
    contour: str
    """Lines of equal height on it."""
    closed: str
    """Cells and pixels that cannot be entered."""


LIGHT = Theme(
    "#1c1f22", "#fcfcfa", "#8c9196", "#dfe2e4", "#00416b", "#7fb2d6", "#c6dcec", "#c1272d",
    "#f1f0ec", "#a9aaa4", "#bcbfc2",
)  # fmt: skip


def theme() -> Theme:
    """Colours of the figure to be drawn: ink and paper are those of matplotlib's settings."""
    ink, paper = (to_hex(mpl.rcParams[name]) for name in ("text.color", "axes.facecolor"))
    return LIGHT._replace(ink=ink, paper=paper)


def luminance(colour: Any) -> float:
    """Luma of a colour, 0 black to 1 white (ITU-R BT.601)."""
    return float(np.dot(to_rgb(colour), (0.299, 0.587, 0.114)))


class StyleOptions(TypedDict, total=False):
    """Keyword arguments of every figure; see `Style`."""

    ax: Any
    n_columns: int | None
    width: float | None
    cmap: str | Colormap | None
    title: str | None
    legend: bool


@dataclass(frozen=True)
class Style:
    """Options that every figure takes as keyword arguments.

    Attributes:
        ax: Axes to draw on, one for each panel, in an array or a list; by default a new figure.
        n_columns: Panels per row of a new figure.
        width: Width of a new figure, inches: 3.5 is a column of a journal's page. Text stays of 8
            points or more, and there are fewer panels per row.
        cmap: Colours of values or curves, a name or a `Colormap` of matplotlib.
        title: Title of a figure of one panel, or above all panels of a new figure; `""` for none.
        legend: Whether to draw the legend or the colour bar.

    Raises:
        TrustboError: An option is unknown, or its value invalid.
    """

    ax: Any = None
    n_columns: int | None = None
    width: float | None = None
    cmap: str | Colormap | None = None
    title: str | None = None
    legend: bool = True

    def __post_init__(self) -> None:
        if self.n_columns is not None:
            require_whole("n_columns", self.n_columns, 1)
        if self.width is not None:
            require_positive("width", self.width)
        if not isinstance(self.legend, bool | np.bool_):
            raise TrustboError(f"legend must be True or False; got {self.legend!r}.")
        if self.title is not None and not isinstance(self.title, str):
            raise TrustboError(f"title must be text; got {self.title!r}.")
        self.colours()

    @classmethod
    def from_options(cls, options: StyleOptions) -> Self:
        """Check the keyword arguments of a figure."""
        require_known("option", options, [f.name for f in fields(cls)])
        return cls(**options)

    def colours(self, default: str = COLOURS) -> Colormap:
        """Colour map of the user, or a default one."""
        chosen = default if self.cmap is None else self.cmap
        try:
            return colormaps.get_cmap(chosen)
        except (ValueError, TypeError):
            raise TrustboError(
                f"unknown cmap {chosen!r}; give a name of matplotlib.colormaps, such as 'viridis', "
                "or a Colormap."
            ) from None

    def axes(self, n: int) -> np.ndarray:
        """Axes of the user, shape (n,)."""
        given = np.atleast_1d(np.asarray(self.ax, dtype=object)).ravel()
        if not all(isinstance(ax, Axes) for ax in given):
            raise TrustboError(f"ax must be matplotlib Axes; got a {type(self.ax).__name__}.")
        if len(given) < n:
            raise TrustboError(f"this figure has {n} panels, and ax {len(given)}; give {n} Axes.")
        return given[:n]


def curve_colours(n: int, style: Style) -> np.ndarray:
    """Colours of n curves that stand out from the paper, also in grey; shape (n, 4)."""
    ends = (0.35, 1.0) if luminance(theme().paper) < 0.5 else (0.0, 0.8)
    return style.colours()(np.linspace(*ends, max(n, 1)))
