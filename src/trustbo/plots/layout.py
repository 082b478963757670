"""Layout of figures: small multiples, maps in metres, colour bars and legends."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.transforms import Bbox

from trustbo.plots.style import MEDIUM, SMALL, Style
from trustbo.workspace.grid import Grid

PAGE = 7.6
"""Width of a page, inches: figures of several panels are no wider by default."""
_KEY, _LETTER = 0.45, 0.068
"""Widths of a legend's key with its margins, and of a letter of its text, inches."""
_LINE = 0.18
"""Height of a line of a legend, inches; added to the figure's height to keep that of panels."""
_PAD = 0.04
"""Margin around a figure, inches."""
_LETTERS = 11
"""Letters of a colour bar's label for each inch of the figure's height."""

MARKERS = "osD^vPX*<>"
DASHES = ("-", (0, (5, 1.5)), (0, (1, 1)), (0, (6, 1.5, 1, 1.5)), (0, (3, 1, 1, 1, 1, 1)))
"""Line styles of curves in one panel, in order, distinct without colour."""


@dataclass(frozen=True, eq=False)
class Panels:
    """Panels of a figure, with the options of the user."""

    panels: np.ndarray
    """Axes of the panels, (panel,)."""
    left: list[Axes]
    """Those at the left edge."""
    lower: list[Axes]
    """Those with no panel below."""
    style: Style

    @property
    def figure(self) -> Figure:
        """Top-level figure, also of Axes in a subfigure."""
        figure = self.panels[0].get_figure(root=True)
        assert isinstance(figure, Figure)  # noqa: S101
        return figure

    def titles(self, titles: Sequence[str] = ()) -> None:
        """Write the titles of panels, and the user's above them or in place of a single one."""
        title = self.style.title
        if title is not None and len(self.panels) == 1:
            titles = [title]
        elif title and self.style.ax is None:
            self.figure.suptitle(as_text(title), fontsize=MEDIUM + 1.0)
        for ax, text in zip(self.panels, titles, strict=False):
            if text:
                ax.set_title(as_text(text), fontsize=MEDIUM)

    def label_maps(self) -> None:
        """Label the outer Axes of maps in metres."""
        for ax in self.panels:
            ax.set_aspect("equal")
            ax.tick_params(labelsize=SMALL)
            ax.locator_params(nbins=4)
        for ax in self.left:
            ax.set_ylabel("north (m)", fontsize=SMALL)
        self.label_lower("east (m)")

    def label_lower(self, text: str) -> None:
        """Label the Axes with no panel below."""
        for ax in self.lower:
            ax.set_xlabel(text, fontsize=SMALL)
            ax.tick_params(labelbottom=True)

    def colour_bar(self, image: Any, label: str, **options: Any) -> None:
        """Add a colour bar, unless left out; a label longer than its bar is broken.

        The option `axes=` has the Axes of the bar, by default all panels.
        """
        if not self.style.legend:
            return
        axes = list(options.pop("axes", self.panels))
        rows: dict[float, float] = {}  # height of each row of Axes, wherever in the figure it is
        for ax in axes:
            box = ax.get_position(original=True)
            row = round(box.y0 + box.y1, 2)
            rows[row] = max(rows.get(row, 0.0), box.height)
        shrink = 0.95 * (_share_filled(axes) if self.style.ax is not None else 1.0)
        shape = {"aspect": 14 * min(len(rows), 3), "shrink": shrink, "pad": 0.02}
        bar = axes[0].figure.colorbar(image, ax=axes, **shape | options)
        if "location" in options:
            bar.ax.locator_params(axis="x", nbins=4)
        else:
            height = sum(rows.values()) * self.figure.get_figheight()
            label = textwrap.fill(label, max(18, int(_LETTERS * height)))
            if bar.norm.__class__ is Normalize:
                bar.ax.locator_params(axis="y", nbins=5)
        bar.set_label(label, fontsize=SMALL)
        bar.ax.tick_params(labelsize=SMALL)

    def legend(self, handles: Sequence[Any], **options: Any) -> None:
        """Add a legend outside the panels, on the user's Axes inside the first; unless left out."""
        if not self.style.legend:
            return
        shape: dict[str, Any] = {"fontsize": SMALL, "frameon": False, "handles": list(handles)}
        shape |= {"handlelength": 1.6, "columnspacing": 1.2}
        first, figure = self.panels[0], self.figure
        width, labels = figure.get_figwidth(), [str(handle.get_label()) for handle in handles]
        if self.style.ax is not None:
            letters = int((first.get_position().width * width - _KEY) / _LETTER)
            lines = [textwrap.fill(label, max(letters, 8)) for label in labels]
            first.legend(**shape | {"labels": lines, "frameon": True, "framealpha": 0.85})
            return
        room = int(width / (_KEY + _LETTER * max(map(len, labels), default=1)))
        options["ncols"] = max(1, min(options.get("ncols", 3), room))
        figure.legend(**shape | {"loc": "outside lower center"} | options)
        lines = -(-len(handles) // options["ncols"]) + ("title" in options)
        figure.set_figheight(figure.get_figheight() + _LINE * lines)

    def fit_height(self) -> None:
        """Give a new figure of maps the height that they take at its width.

        It depends on the proportions of the maps and on the width of bars and numbers; any other
        height would leave a gap above, or at the sides.
        """
        if self.style.ax is not None:
            return
        figure = self.figure
        engine = ConstrainedLayoutEngine(compress=True)  # panels keep the terrain's proportions
        figure.set_layout_engine(engine)
        figure.set_figheight(1.5 * figure.get_figheight())  # for the width alone to limit the maps
        engine.execute(figure)
        boxes = [ax.get_tightbbox() for ax in figure.axes if ax.get_visible()]
        panels = Bbox.union([box for box in boxes if box is not None])
        title = (MEDIUM + 4.0) / 72.0 if figure.get_suptitle() else 0.0
        figure.set_figheight(panels.height / figure.dpi + 2.0 * _PAD + title)


def _share_filled(axes: Sequence[Axes]) -> float:
    """Share of the height of Axes that their maps, of fixed proportions, fill."""
    for ax in axes:
        ax.apply_aspect()
    drawn, given = (
        Bbox.union([ax.get_position(original=original) for ax in axes]).height
        for original in (False, True)
    )
    return drawn / given


def small_multiples(
    n: int,
    size: tuple[float, float],
    style: Style,
    *,
    margin: float = 0.0,
    columns: int | None = None,
    least: float = 1.5,
    **shared: Any,
) -> Panels:
    """Lay out n equal panels row by row, in a new figure or on the user's Axes.

    Args:
        n: Number of panels.
        size: Width and height of a panel, inches; a panel that has to be narrower keeps its height.
        style: Options of the user.
        margin: Width at the side of the panels for a colour bar or a legend, inches.
        columns: Panels per row, by default the number from three to five that leaves the fewest
            places empty; fewer where they would be narrower than `least` inches.
        least: Least width of a panel, inches.
        **shared: `sharex` and `sharey` of `plt.subplots`.

    Raises:
        TrustboError: Too few Axes of the user.
    """
    if style.ax is not None:
        panels = style.axes(n)
        return Panels(panels, list(panels), list(panels), style)
    margin = margin if style.legend else 0.0
    most = max(1, int(((style.width or PAGE) - margin) / least))
    wanted = style.n_columns or min(columns or _columns(n), most)
    cols = min(wanted, n)
    rows = -(-n // cols)
    natural = size[0] * cols + margin
    width = style.width or (natural if cols == style.n_columns else min(natural, PAGE))
    _, axes = plt.subplots(
        rows, cols, figsize=(width, size[1] * rows), squeeze=False, layout="constrained", **shared
    )
    panels = axes.ravel()
    for ax in panels[n:]:
        ax.set_visible(False)
    last = {j: ax for row in axes for j, ax in enumerate(row) if ax.get_visible()}
    return Panels(panels[:n], [row[0] for row in axes], list(last.values()), style)


def _columns(n: int) -> int:
    """Number of columns for n panels: three to five, with the fewest places left empty."""
    if n <= 4:
        return 2 if n == 4 else n
    return min((3, 4, 5), key=lambda cols: -n % cols)


def map_panels(
    grid: Grid,
    n: int,
    style: Style,
    *,
    width: float = 2.6,
    columns: int | None = None,
    margin: float = 1.0,
    least: float = 1.2,
) -> Panels:
    """Lay out maps, see `small_multiples`; of a tall terrain there are more in a row."""
    ratio = grid.shape[0] * grid.cell_height / (grid.shape[1] * grid.cell_width)
    tall = float(np.clip(ratio, 0.25, 5.0))  # to fit a page
    if tall >= 2:
        width, columns = 0.6 * width, 5 if columns is None else columns
    room = (style.width or PAGE) - (margin if style.legend else 0.0)
    cols = min(style.n_columns or columns or _columns(n), n, max(1, int(room / least)))
    if style.width is not None or (style.n_columns is None and width * cols > room):
        width = max(min(width, room / cols) if style.width is None else room / cols, 1.2)
    return small_multiples(
        n, (width, width * tall + 0.5), style, margin=margin, columns=columns, least=least,
        sharex=True, sharey=True,
    )  # fmt: skip


def extent_of(grid: Grid) -> tuple[float, float, float, float]:
    """Left, right, bottom and top of a map, m from its lower left corner."""
    return (0.0, grid.shape[1] * grid.cell_width, 0.0, grid.shape[0] * grid.cell_height)


def grid_lines(ax: Axes, grid: Grid) -> None:
    """Draw the edges of the cells."""
    for col in range(1, grid.shape[1]):
        ax.axvline(col * grid.cell_width, color="white", linewidth=0.3, alpha=0.5)
    for row in range(1, grid.shape[0]):
        ax.axhline(row * grid.cell_height, color="white", linewidth=0.3, alpha=0.5)


def as_text(name: str) -> str:
    """Escape dollar signs, which matplotlib takes for formulas."""
    return name.replace("$", r"\$")


def plain(ax: Axes) -> None:
    """Remove the upper and right frame, and set the size of numbers."""
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=SMALL)
