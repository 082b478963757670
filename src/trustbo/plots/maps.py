"""Maps of the terrain and of the planning cells, with contour lines, paths and a scale bar."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from contourpy import contour_generator
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, ListedColormap, Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter
from scipy.ndimage import gaussian_filter

from trustbo.data import Cell
from trustbo.errors import TrustboError, require_kind, require_list, require_tuple, require_whole
from trustbo.plots.style import (
    GREY,
    add_legend,
    as_text,
    background,
    figure_of,
    in_lines,
    ink,
    is_broad,
    outlined,
    panels,
    round_ticks,
    styled,
)
from trustbo.terrain import pixel_size
from trustbo.workspace import Workspace
from trustbo.workspace.grid import Grid
from trustbo.workspace.moves import require_on_grid

MOMENTS = (1, 2, 4)
"""Missions for which `trust_maps` plots the map used for planning, by default."""
VEGETATION = (0.44, 0.56, 0.39, 0.4)
"""Colour of vegetation: a semi-transparent green for light and dark backgrounds."""
_GROWN = 0.5
"""Minimum height of vegetation above the ground, m."""
_CONTOURS = 12
"""Maximum number of contour levels."""
_LEVEL = 0.05
"""Range of heights, m, up to which the ground counts as level and has no contour lines."""
_MAX_PIXELS = 400
"""Maximum number of rows or columns when contour lines are computed."""
_SMOOTH = 0.01
"""Standard deviation of the smoothing, as a fraction of the raster's longer side."""
_ROBUST = (0.02, 0.98)
"""Quantiles at the ends of the colour scale."""
_BESIDE = 1.1
"""Width of axis labels and colour bar, in inches."""
_LOGIT = 1.5
"""Trust above this value is on the logit scale of beta-binomial models."""
BRIGHT_HIGH = "viridis"
"""Colours of maps in which high values are good."""
BRIGHT_LOW = "viridis_r"
"""Colours of maps in which low values are good."""
_LEAST_SIZE = (4.0, 1.7)
"""Width and height of a figure, in inches, from which the label of a colour bar may explain its
ends; in smaller figures, the explanation does not fit.
"""
_HATCH = {"hatch": "////", "edgecolor": (0.4, 0.4, 0.4, 0.65), "linewidth": 0.0}
"""Style of cells that no mission entered."""
_LONGEST_BAR = 0.4
"""Longest scale bar, as a fraction of the width of a map."""
_BAR_END = 0.96
"""Right end of the scale bar, as a fraction of the width of a map."""


@styled
def trust_maps(
    history: xr.Dataset,
    trust_map: xr.DataArray,
    path: Sequence[Cell],
    workspace: Workspace,
    *,
    missions: Sequence[int] | None = None,
    driven: np.ndarray | None = None,
    ax: Any = None,
) -> np.ndarray:
    """Plot the trust maps used to plan missions, and the planned paths (Fig. 5 of the paper).

    The last panel shows the map and the recommended path after the last mission. All maps share one
    colour scale, from the 2 % to the 98 % quantile of the learned maps. The start is grey because
    its trust is assumed. A trust slightly above 1 has the colour of 1 (unbroken contact): estimates
    of Gaussian rates are not limited to 1.

    Args:
        history: Trust map and path of each mission, such as `Result.history`.
        trust_map: Map after the last mission, dims (row, col), such as `Result.trust_map`.
        path: Path recommended after the last mission, such as `Result.path`.
        workspace: Workspace of the cells.
        missions: Numbers of missions, from 1; by default those of 1, 2 and 4 that were run.
        driven: Whether each cell had been entered before each mission and after the last one, shape
            (mission + 1, row, col). Other cells are hatched, because their trust is only predicted.
        ax: Axes to draw on, one for each panel; by default a new figure with a legend.

    Returns:
        Axes, shape (panel,).

    Raises:
        TrustboError: A mission was not run, or `ax` has too few axes.

    Example:
        >>> maps = result.history, result.trust_map, result.path
        >>> tb.plots.trust_maps(*maps, workspace, missions=[1])
    """
    require_kind("history", history, xr.Dataset, "give Result.history")
    require_kind("trust_map", trust_map, xr.DataArray, "give Result.trust_map")
    require_kind("workspace", workspace, Workspace, "give a trustbo.Workspace")

    path = require_path_of_cells(path, workspace)
    n_missions = history.sizes["iteration"]
    if missions is None:
        chosen = [i for i in MOMENTS if i <= n_missions]
    else:
        given = require_list("missions", missions, remedy="give numbers of missions, such as [1]")
        chosen = [require_whole("mission", i, 1) for i in given]
    if chosen and max(chosen) > n_missions:
        raise TrustboError(
            f"missions has {max(chosen)}, but the last mission is {n_missions}; leave it out."
        )

    maps = [history["trust_map"].sel(iteration=i) for i in chosen] + [trust_map]
    maps = [workspace.grid.over_cells("trust_map", trust) for trust in maps]
    steps = [history["path"].sel(iteration=i).values for i in chosen] + [np.array(path)]
    paths = [cells_of(cells) for cells in steps]
    learned = [i - 1 for i in chosen] + [n_missions]

    values = np.stack([trust.values for trust in maps])
    values[:, *path[0]] = np.nan
    low, high = trust_limits(values[[n > 0 for n in learned]])
    norm = Normalize(low, high)

    axes = map_panels(workspace.grid, len(maps), ax)
    for panel, trust, cells, n in zip(axes, values, paths, learned, strict=True):
        draw_cells(panel, maps[0].copy(data=trust), workspace, norm)
        if driven is not None:
            hatch_undriven(panel, np.asarray(driven)[n], workspace)
        draw_path(panel, cells, workspace.grid)
        panel.set_title(_moment(n, panel))

    draw_scale(axes[0], workspace.grid)
    shown = np.where(workspace.passable.values, values, np.nan)
    trust_bar(axes, ScalarMappable(norm), shown, "expected trust")
    if ax is None:
        add_legend(axes, _legend(driven is not None))
    return axes


def _moment(n: int, panel: Axes) -> str:
    """Describe the moment after n missions, in two lines if the panel is narrow."""
    words = ("before", "mission 1") if n == 0 else ("after", f"mission {n}")
    return (" " if is_broad(panel) else "\n").join(words)


def _legend(hatched: bool) -> list[Line2D | Patch]:
    """Return the legend of maps with a path."""
    white: dict[str, Any] = {"color": "white", "markeredgecolor": "black", "linestyle": "none"}
    handles: list[Line2D | Patch] = [
        Line2D([], [], marker="o", markersize=6, label="start", **white),
        Line2D([], [], marker="*", markersize=11, label="goal", **white),
        Patch(facecolor=GREY, label="impassable or start"),
    ]
    if hatched:
        handles.append(Patch(facecolor="0.9", label="never entered", **_HATCH))
    return handles


@styled
def terrain_maps(workspace: Workspace, *, ax: Any = None) -> np.ndarray:
    """Plot the heights of the DSM and the index of each feature (Fig. 4 of the paper).

    Features of bounds, such as line of sight, are averaged over robots and over all bounds that
    enter a cell.

    Args:
        workspace: Workspace made from a terrain.
        ax: Axes to draw on, one for each panel; by default a new figure.

    Returns:
        Axes, shape (1 + feature,).

    Raises:
        TrustboError: The workspace has no terrain.

    Example:
        >>> tb.plots.terrain_maps(workspace)[0].figure.savefig("terrain.png")
    """
    require_kind("workspace", workspace, Workspace, "give a trustbo.Workspace")
    terrain = workspace.terrain
    pixels = workspace.pixels
    grid = workspace.grid
    if terrain is None or pixels is None:
        raise TrustboError("terrain_maps needs a workspace made with Workspace.from_terrain.")

    axes = map_panels(grid, 1 + len(workspace.features), ax)
    surface, *others = axes
    extent = extent_of(grid)
    of_cells = workspace.awareness.mean(("robot", "move"))

    heights = surface.imshow(terrain["dsm"].values, cmap="cividis", extent=extent)
    surface.set_title("surface (DSM)")

    for panel, name in zip(others, workspace.features, strict=True):
        index = pixels[name].values if name in pixels else of_cells.sel(feature=name).values
        panel.set_facecolor(GREY)
        panel.imshow(index, vmin=0.0, vmax=1.0, extent=extent)
        panel.set_title(as_text(name))

    for panel in axes:
        draw_contours(panel, workspace, "black", 0.25)
        draw_cell_edges(panel, grid)

    draw_scale(surface, grid)
    colour_bar(axes, heights, "height (m)", location="bottom", aspect=40)
    colour_bar(axes, ScalarMappable(Normalize(0.0, 1.0)), "index\n(0 worst, 1 best)")
    return axes


@styled
def cell_map(
    values: xr.DataArray,
    workspace: Workspace,
    *,
    path: Sequence[Cell] | None = None,
    limits: tuple[float, float] | None = None,
    cmap: str | Colormap | None = None,
    label: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Plot a map of the planning cells with contour lines; impassable cells are grey.

    Bright cells are good: the colours are reversed for costs and standard deviations, which are
    recognised by the names `cost` and `..._sd`. The start is grey in maps of trust and cost (see
    the attribute `start` of `Result.maps`) because its trust is assumed.

    Args:
        values: Map with the dims (row, col), or (y, x) as in `Result.maps`, which is aligned with
            the cells by its coordinates if it has any.
        workspace: Workspace of the cells.
        path: Path to draw.
        limits: Values at the ends of the colour scale; by default the range of the map, up to 1 if
            trust is slightly above 1.
        cmap: Matplotlib `Colormap` or its name.
        label: Label of the colour bar; by default the long name or the name of the map; `""` for no
            colour bar.
        ax: Axes to draw on; by default a new figure.

    Returns:
        Axes of the map; the image of the map is `images[0]` of these axes.

    Raises:
        TrustboError: The map has other axes, such as `robot`, another shape or coordinates of other
            cells, or the path is not on the grid.

    Example:
        >>> tb.plots.cell_map(result.maps()["trust_sd"], workspace, path=result.path)
    """
    require_kind("values", values, xr.DataArray, "give a map of the cells")
    require_kind("workspace", workspace, Workspace, "give a trustbo.Workspace")
    shown = shown_values(values, workspace)
    norm = Normalize()
    if limits is not None:
        low, high = require_tuple("limits", limits, 2)
        norm = Normalize(low, high)
    elif is_trust(str(values.name)) and np.isfinite(shown).any():
        norm = Normalize(*up_to_contact(float(np.nanmin(shown)), float(np.nanmax(shown))))
    if label is not None:
        require_kind("label", label, str, "give a text; '' for no colour bar")
    cells = None if path is None else require_path_of_cells(path, workspace)

    axes = map_panels(workspace.grid, 1, ax)
    image = draw_cells(axes[0], values, workspace, norm, cmap)

    if cells is not None:
        draw_path(axes[0], cells, workspace.grid)
    draw_scale(axes[0], workspace.grid)
    if label != "":
        name = values.attrs.get("long_name", values.name)
        text = label or as_text(name or "")
        if is_trust(str(values.name)):
            trust_bar(axes, image, shown, text, explain=label is None)
        else:
            colour_bar(axes, image, text, extend=_extend(shown, norm))
    return axes[0]


def is_trust(name: str) -> bool:
    """Return whether a map with this name has values of trust."""
    return name.startswith("trust") and is_good_high(name)


def is_good_high(name: str) -> bool:
    """Return whether high values are good in a map with this name, unlike in maps of cost."""
    return name != "cost" and not name.endswith(("_sd", " sd"))


def require_path_of_cells(path: Sequence[Cell], workspace: Workspace) -> list[Cell]:
    """Return the cells of a path; raises TrustboError if there are none or one is off the grid."""
    cells = require_on_grid(path, workspace.grid.shape)
    if not cells:
        raise TrustboError("path must contain at least one cell; got none.")
    return cells


def cells_of(steps: np.ndarray) -> list[Cell]:
    """Return the cells of a path in a history, (step, 2), without the padding of -1."""
    return [(int(row), int(col)) for row, col in steps if row >= 0]


def positions_of(path: Sequence[Cell], grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y of a path's cells, each (cell,), m from the lower left corner of the grid."""
    x, y = (np.array([grid.center(cell) for cell in path]) - grid.corner).T
    return x, y


def draw_path(ax: Axes, path: Sequence[Cell], grid: Grid) -> None:
    """Plot a path over a map, from its start (circle) to its goal (star)."""
    x, y = positions_of(path, grid)
    (line,) = ax.plot(x, y, color="white", linewidth=1.6, solid_joinstyle="round")
    line.set_path_effects(outlined(3.2, "black"))
    ax.plot(x[0], y[0], "wo", markeredgecolor="black", markersize=6)
    ax.plot(x[-1], y[-1], "w*", markeredgecolor="black", markersize=11)


def map_panels(grid: Grid, n: int, ax: Any) -> np.ndarray:
    """Return axes for n maps; positions are in metres from the lower left corner of the grid."""
    left, right, bottom, top = extent_of(grid)
    tall = float(np.clip((top - bottom) / (right - left), 0.3, 3.0))
    width = 3.0 if n > 1 else 4.0
    columns = 2 if n == 4 else 3

    inner = width - _BESIDE / min(n, columns)
    axes = panels(n, ax, (width, inner * tall + 0.4), columns=columns)

    for panel in axes:
        panel.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
        panel.spines[:].set_visible(True)
        panel.grid(visible=False)  # its lines would look like edges of cells
        panel.locator_params(nbins=4)
        panel.set(xlabel="east (m)", ylabel="north (m)")
        if panel.get_subplotspec() is not None:
            panel.label_outer()
    return axes


def colour_bar(axes: Sequence[Axes] | np.ndarray, image: Any, label: str, **options: Any) -> Any:
    """Draw a colour bar beside axes, and return it."""
    bar = axes[0].figure.colorbar(image, ax=list(axes), pad=0.02, ticks=round_ticks(), **options)
    bar.set_label(in_lines(label, axes) if bar.orientation == "vertical" else label)
    return bar


def trust_bar(
    axes: Sequence[Axes] | np.ndarray,
    image: Any,
    values: np.ndarray,
    label: str,
    *,
    explain: bool = True,
) -> None:
    """Draw a colour bar of trust; an upper end of 1 is labelled "≥ 1" if values exceed 1.

    Unless `explain` is false, the label of the bar in a large figure explains that 1 is unbroken
    contact.
    """
    bar = colour_bar(axes, image, label, extend=_extend(values, image.norm))
    if image.norm.vmax != 1.0:
        return

    is_above = bool((values[np.isfinite(values)] > 1.0).any())
    if explain and (figure_of(axes).get_size_inches() >= _LEAST_SIZE).all():
        more = "; estimates\ncan be higher" if is_above else ""
        bar.set_label(f"{label}\n(1: unbroken\ncontact{more})")  # short lines, as bars are short
    if is_above:
        bar.formatter = FuncFormatter(lambda x, _: "≥ 1" if math.isclose(x, 1.0) else f"{x:.4g}")
        bar.update_ticks()


def _extend(values: np.ndarray, norm: Normalize) -> str:
    """Return the ends of a colour scale beyond which there are values."""
    found = values[np.isfinite(values)]
    below = bool((found < norm.vmin).any()) if norm.vmin is not None else False
    above = bool((found > norm.vmax).any()) if norm.vmax is not None else False
    return {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above]


def draw_cells(
    ax: Axes,
    values: xr.DataArray,
    workspace: Workspace,
    norm: Normalize,
    cmap: str | Colormap | None = None,
) -> Any:
    """Draw a map of the planning cells, and return the image; see `cell_map` for the colours."""
    if cmap is None:
        cmap = BRIGHT_HIGH if is_good_high(str(values.name)) else BRIGHT_LOW

    ax.set_facecolor(GREY)
    data = shown_values(values, workspace)
    image = ax.imshow(data, cmap=cmap, norm=norm, extent=extent_of(workspace.grid))
    draw_contours(ax, workspace, "black", 0.25)
    return image


def shown_values(values: xr.DataArray, workspace: Workspace) -> np.ndarray:
    """Return a map (row, col) with NaN in impassable cells and where trust is assumed."""
    of_cells = workspace.grid.over_cells("values", values).values
    shown = np.where(workspace.passable.values, of_cells, np.nan)
    if "start" in values.attrs:
        row, col = values.attrs["start"].split(",")
        shown[int(row), int(col)] = np.nan
    return shown


def hatch_undriven(ax: Axes, driven: np.ndarray, workspace: Workspace) -> None:
    """Hatch the passable cells that were not `driven`, shape (row, col)."""
    left, right, bottom, top = extent_of(workspace.grid)
    rows, cols = workspace.grid.shape
    x = np.linspace(left, right, cols + 1)
    y = np.linspace(top, bottom, rows + 1)
    new = np.ma.masked_array(np.ones((rows, cols)), driven | ~workspace.passable.values)
    ax.pcolor(x, y, new, cmap=ListedColormap(["none"]), **_HATCH)


def draw_ground(ax: Axes, workspace: Workspace) -> None:
    """Draw vegetation and contour lines or, without a terrain, the cell edges."""
    terrain = workspace.terrain
    extent = extent_of(workspace.grid)
    ax.set(xlim=extent[:2], ylim=extent[2:], aspect="equal", xticks=[], yticks=[])
    ax.spines[:].set_visible(True)
    ax.grid(visible=False)  # its lines would look like edges of cells
    if terrain is None:
        draw_cell_edges(ax, workspace.grid)
        return

    grown = np.where((terrain["dsm"] - terrain["dem"]).values > _GROWN, 1.0, np.nan)
    ax.imshow(grown, cmap=ListedColormap([VEGETATION]), extent=extent)
    draw_contours(ax, workspace, GREY, 0.8)


def draw_cell_edges(ax: Axes, grid: Grid) -> None:
    """Draw the edges of all cells."""
    _, right, _, top = extent_of(grid)
    style: dict[str, Any] = {"color": "white", "linewidth": 0.3, "alpha": 0.5}
    ax.vlines(np.arange(1, grid.shape[1]) * grid.cell_width, 0.0, top, **style)
    ax.hlines(np.arange(1, grid.shape[0]) * grid.cell_height, 0.0, right, **style)


def draw_contours(ax: Axes, workspace: Workspace, colour: str, opacity: float) -> None:
    """Draw contour lines of the ground, if there is a terrain."""
    lines = LineCollection(contours(workspace), colors=colour, alpha=opacity, linewidths=0.5)
    ax.add_collection(lines, autolim=False)


def contours(workspace: Workspace) -> list[np.ndarray]:
    """Compute contour lines of the ground at up to 12 round heights.

    Returns:
        Lines, each (point, 2): x and y in metres from the lower left corner of the grid.
    """
    if workspace.terrain is None:
        return []

    terrain = workspace.terrain
    step = math.ceil(max(terrain["dem"].shape) / _MAX_PIXELS)
    height = terrain["dem"].values[::step, ::step]
    valid = np.isfinite(height)
    if min(height.shape) < 3 or not valid.any():
        return []

    # Smooth the known heights only (normalised convolution).
    width = max(1.0, _SMOOTH * max(height.shape))
    weight = gaussian_filter(valid.astype(float), width)
    smooth = gaussian_filter(np.where(valid, height, 0.0), width) / np.maximum(weight, 1e-9)

    low = float(smooth[valid].min())
    high = float(smooth[valid].max())
    interval = contour_interval(high - low)
    if interval is None:
        return []

    dy, dx = (float(size) for size in pixel_size(terrain))  # m
    x = (np.arange(height.shape[1]) * step + 0.5) * dx
    y = extent_of(workspace.grid)[3] - (np.arange(height.shape[0]) * step + 0.5) * dy
    traced = contour_generator(x, y, np.ma.masked_where(~valid, smooth), line_type="Separate")
    levels = np.arange(np.ceil(low / interval), np.floor(high / interval) + 1) * interval
    return [np.asarray(line) for level in levels for line in traced.lines(level)]


def contour_interval(relief: float) -> float | None:
    """Choose a round contour interval, m, for this height range, m; None on level ground."""
    if not relief > _LEVEL:
        return None
    magnitude = 10.0 ** np.floor(np.log10(relief / _CONTOURS))
    steps = (factor * magnitude for factor in (1, 2, 5, 10))
    return float(next(step for step in steps if relief / step <= _CONTOURS))


def robust_limits(values: np.ndarray) -> tuple[float, float]:
    """Return limits of a colour scale: the 2 % and 98 % quantiles, to be robust to outliers."""
    low, high = np.nanquantile(values, _ROBUST).tolist()
    if low < high:
        return low, high
    return low - 0.5e-3, high + 0.5e-3  # a scale of one value has no colours


def trust_limits(values: np.ndarray) -> tuple[float, float]:
    """Return `robust_limits`, where an upper limit just above 1 (unbroken contact) becomes 1."""
    return up_to_contact(*robust_limits(values))


def up_to_contact(low: float, high: float) -> tuple[float, float]:
    """Lower the upper end of a scale of trust to 1 if it is just above 1; see `trust_limits`."""
    if low < 1.0 < high < _LOGIT:
        high = 1.0
    return low, high


def draw_scale(ax: Axes, grid: Grid) -> None:
    """Draw a scale bar, whose length is a round number, in the lower right corner of a map."""
    left, right = ax.get_xlim()
    width = right - left
    longest = _LONGEST_BAR * width
    magnitude = 10.0 ** np.floor(np.log10(longest))
    lengths = (factor * magnitude for factor in (1, 2, 5))
    length = max(length for length in lengths if length <= longest * (1 + 1e-9))  # up to rounding
    ends = [_BAR_END - length / width, _BAR_END]

    (bar,) = ax.plot(ends, [0.045, 0.045], color=ink(), linewidth=2.0, transform=ax.transAxes)
    bar.set(solid_capstyle="butt", path_effects=outlined(4.0, background()))

    label = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    text = ax.annotate(
        label,
        (_BAR_END, 0.045),
        (0.0, 2.5),  # points above the bar
        xycoords="axes fraction",
        textcoords="offset points",
        ha="right",
        va="bottom",
        color=ink(),
    )
    text.set_path_effects(outlined(2.5, background()))


def extent_of(grid: Grid) -> tuple[float, float, float, float]:
    """Return the left, right, bottom and top edges of a grid, m from its lower left corner."""
    return (0.0, grid.shape[1] * grid.cell_width, 0.0, grid.shape[0] * grid.cell_height)
