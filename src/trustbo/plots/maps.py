"""Maps of the terrain and of the planning cells, with contour lines, paths and a scale bar."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, ListedColormap, Normalize
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, MaxNLocator
from scipy.ndimage import gaussian_filter

from trustbo.data import POST_SETS, Cell, Station
from trustbo.errors import TrustboError, require_kind, require_list, require_tuple, require_whole
from trustbo.plots.style import (
    GREY,
    N_INTERVALS,
    PAGE,
    ROBOTS,
    add_legend,
    as_text,
    background,
    figure_of,
    handles_of,
    in_lines,
    ink,
    is_broad,
    outlined,
    panels,
    styled,
)
from trustbo.workspace import Workspace
from trustbo.workspace.grid import Grid
from trustbo.workspace.moves import cells_along, posts_along, require_on_grid

MOMENTS = (1, 2, 4)
"""Missions for which `trust_maps` plots the map used for planning, by default."""
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
_BESIDE = 1.2
"""Width of axis labels and colour bar, in inches."""
_ABOVE = 0.25
"""Height of the title of a map, in inches."""
_BELOW = 0.75
"""Height of the axis labels and the legend below maps, in inches."""
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
_BAR_LOW = 0.045
"""Height of the scale bar above the edge of a map, as a fraction of the height of the map."""
_EXTENDED = {(False, False): "neither", (True, False): "min", (False, True): "max"}
"""Pointed ends of a colour bar, keyed by whether values are below and above its limits."""
_CELL = 0.38
"""Width of a cell in a new figure of the grid, in inches, unless the figure exceeds the page."""
_NAMED = 0.33
"""Width of a cell, in inches, from which its name fits, such as "10,12"."""
_TICKED = 0.25
"""Distance between ticks at rows and columns, in inches, at least."""
_HEIGHTS = (2.0, 11.0)
"""Least and largest height of a new figure of the grid, in inches."""
CLOSED = ROBOTS[1]
"""Colour of the marks of closed cells and bounds."""
COLOURS_OF_SETS = ("white", ROBOTS[5], ROBOTS[4])
"""Colours of the bounds of a path, by the set of posts from which T2 watches them."""


@styled
def trust_maps(
    history: xr.Dataset,
    trust_map: xr.DataArray,
    path: Sequence[Cell],
    workspace: Workspace,
    *,
    missions: Sequence[int] | None = None,
    driven: np.ndarray | None = None,
    sd: xr.DataArray | None = None,
    ax: Any = None,
) -> np.ndarray:
    """Plot the trust maps used to plan missions, and the planned paths (Fig. 5 of the paper).

    The last panel shows the map and the recommended path after the last mission. All maps share one
    colour scale, from the 2 % to the 98 % quantile of the learned maps. The start is grey because
    its trust is assumed. A trust slightly above 1 has the colour of 1 (unbroken contact): estimates
    of Gaussian rates are not limited to 1.

    Args:
        history: Trust map and path of each mission, such as `Result.history`.
        trust_map: Map after the last mission, dims (row, col), such as `Result.trust_map`, or of
            one robot, such as `Result.robot_maps()["trust_mean"].sel(robot="r2")`.
        path: Path recommended after the last mission, such as `Result.path`.
        workspace: Workspace of the cells.
        missions: Numbers of missions, from 1; by default those of 1, 2 and 4 that were run.
        driven: Whether each cell had been entered before each mission and after the last one, shape
            (mission + 1, row, col). Other cells are hatched, because their trust is only predicted.
        sd: Map of the standard deviation of `trust_map`, which gets a panel beside it.
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

    recommended = _require_path(path, workspace)
    numbers = history["iteration"].values
    n_missions = max(0, int(numbers.max()))  # earlier missions have negative numbers
    n_earlier = int((numbers < 0).sum())
    chosen = _moments(missions, n_missions)

    planned = history.transpose("iteration", ...).sel(iteration=chosen)
    maps = np.stack(
        [shown_values(values, workspace) for values in [*planned["trust_map"], trust_map]]
    )
    paths = [*(path_in(planned.isel(iteration=i)) for i in range(len(chosen))), recommended]
    learned = [*(i - 1 for i in chosen), n_missions]

    of_robot = str(trust_map["robot"].item()) if "robot" in trust_map.coords else ""
    for k, (values, cells) in enumerate(zip(maps, paths, strict=True)):
        if k < len(chosen) or not of_robot:
            values[cells[0][:2]] = np.nan  # trust at the start is assumed
    has_learned = np.array(learned) + n_earlier > 0
    norm = Normalize(*limits_of(maps[has_learned], is_trust=True))

    def draw(panel: Axes, values: np.ndarray, norm: Normalize, cmap: str, k: int) -> Any:
        image = draw_cells(panel, values, workspace, norm, cmap)
        if driven is not None:
            hatch_undriven(panel, np.asarray(driven)[learned[k]], workspace)
        draw_path(panel, paths[k], workspace.grid)
        return image

    axes = map_panels(workspace.grid, len(maps) + (sd is not None), ax)
    of_trust = axes[: len(maps)]
    for k, (panel, values, n) in enumerate(zip(of_trust, maps, learned, strict=True)):
        draw(panel, values, norm, BRIGHT_HIGH, k)

        # In two lines if the panel is narrow.
        words = ("before", "mission 1") if n == 0 else ("after", f"mission {n}")
        if n_missions == 0:
            words = ("after", "earlier missions")
        title = (" " if is_broad(panel) else "\n").join(words)
        panel.set_title(f"{of_robot}\n{title}" if of_robot and k == len(chosen) else title)

    _trust_bar(of_trust, ScalarMappable(norm), maps, "expected trust", explain=True)
    if sd is not None:
        known = shown_values(sd, workspace)
        known[np.isnan(maps[-1])] = np.nan
        image = draw(axes[-1], known, Normalize(*limits_of(known, is_trust=False)), BRIGHT_LOW, -1)
        axes[-1].set_title(f"{of_robot}\nuncertainty".lstrip())
        colour_bar(axes[-1:], image, "standard deviation", known)
    if ax is None:
        drawn = {handle.get_label(): handle for panel in axes for handle in handles_of(panel)}
        grey = "impassable" if of_robot and not chosen else "impassable or start"
        handles = [*drawn.values(), Patch(facecolor=GREY, label=grey)]
        if driven is not None:
            handles.append(Patch(facecolor="0.9", label="never entered", **_HATCH))
        add_legend(axes, handles)
    return axes


def _moments(missions: Sequence[int] | None, n_missions: int) -> list[int]:
    """Return the numbers of the missions to show."""
    if missions is None:
        return [i for i in MOMENTS if i <= n_missions]
    given = require_list("missions", missions, remedy="give numbers of missions, such as [1]")
    return [require_whole("mission", i, 1, n_missions) for i in given]


@styled
def terrain_maps(workspace: Workspace, *, ax: Any = None) -> np.ndarray:
    """Plot the heights of the DSM and the index of each feature (Fig. 4 of the paper).

    High ground is bright. Features of bounds, such as line of sight, are averaged over robots and
    over all bounds that enter a cell.

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

    height = terrain["dsm"].values
    surface.imshow(height, cmap="cividis", extent=extent)
    surface.set_title(f"surface (DSM)\n{np.nanmin(height):z.0f} to {np.nanmax(height):z.0f} m")
    draw_contours(surface, workspace, "black", 0.25)

    for panel, name in zip(others, workspace.features, strict=True):
        index = pixels[name].values if name in pixels else of_cells.sel(feature=name).values
        panel.set_facecolor(GREY)
        panel.imshow(index, vmin=0.0, vmax=1.0, extent=extent)
        panel.set_title(as_text(name))

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
    name = str(values.name)
    norm = Normalize()
    if limits is not None:
        norm.vmin, norm.vmax = require_tuple("limits", limits, 2)
    elif np.isfinite(shown).any():
        norm.vmin, norm.vmax = limits_of(shown, (0.0, 1.0), is_trust=is_trust(name))
    if label is not None:
        require_kind("label", label, str, "give a text; '' for no colour bar")
    cells = None if path is None else _require_path(path, workspace)

    axes = map_panels(workspace.grid, 1, ax)
    good = BRIGHT_HIGH if is_good_high(name) else BRIGHT_LOW
    image = draw_cells(axes[0], shown, workspace, norm, cmap or good)

    if cells is not None:
        draw_path(axes[0], cells, workspace.grid)
        if ax is None:
            add_legend(axes, handles_of(axes[0]))
    if label == "":
        return axes[0]

    text = label or as_text(values.attrs.get("long_name", values.name or ""))
    if is_trust(name):
        _trust_bar(axes, image, shown, text, explain=label is None)
    else:
        colour_bar(axes, image, text, shown)
    return axes[0]


@styled
def grid_map(workspace: Workspace, *, ax: Axes | None = None) -> Axes:
    """Plot the mean height of each cell, labelled with its row and column.

    If the labels do not fit, rows and columns have ticks. Impassable cells, which are too steep or
    have no data or no room for the team, are grey. Without a terrain, passable cells are blank.

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
    width = float(np.clip(_CELL * cols + _BESIDE, 4.0, PAGE))
    height = float(np.clip((width - _BESIDE) * rows * tall / cols + _ABOVE + _BELOW, *_HEIGHTS))
    axes = panels(1, ax, (width, height))
    panel = axes[0]
    room = figure_of(axes).get_figwidth() * panel.get_position().width / cols  # inches

    x = np.arange(cols + 1) - 0.5
    y = np.arange(rows + 1) - 0.5

    if workspace.terrain is not None:
        light = ListedColormap(colormaps["YlOrBr"](np.linspace(0.0, 0.35, 256)))
        image = panel.pcolormesh(x, y, grid.cell_means(workspace.terrain["dem"]), cmap=light)
        colour_bar(axes, image, "mean height (m)")

    _fill(panel, x, y, ~workspace.passable.values, GREY, lw=0.0)
    _draw_edges(panel, x, y, color="black", linewidth=0.4)

    step = math.ceil(_TICKED / room)
    ticks = {"xticks": range(0, cols, step), "yticks": range(0, rows, step)}
    if room >= _NAMED:
        ticks = {"xticks": [], "yticks": []}
        for row, col in np.ndindex(*grid.shape):
            panel.text(col, row, f"{row},{col}", ha="center", va="center", color="black")

    panel.set(**ticks, xlabel="column", ylabel="row", xlim=x[[0, -1]], ylim=y[[-1, 0]], aspect=tall)
    panel.set_title(grid.crs_name)
    add_legend(axes, [Patch(facecolor=GREY, label="impassable")])
    return panel


def is_trust(name: str) -> bool:
    """Return whether a map with this name has values of trust."""
    return name.startswith("trust") and is_good_high(name)


def is_good_high(name: str) -> bool:
    """Return whether high values are good in a map with this name, unlike in maps of cost."""
    return name != "cost" and not name.endswith(("_sd", " sd"))


def _require_path(path: Sequence[Station], workspace: Workspace) -> tuple[Station, ...]:
    """Return a path; raises TrustboError if it is empty, or if a cell is off the grid."""
    cells = require_on_grid(path, workspace.grid.shape)
    if not cells:
        raise TrustboError("path must contain at least one cell; got none.")
    return cells


def path_in(mission: xr.Dataset) -> list[Station]:
    """Return the path of a mission in a history, with the sets of posts if there are several."""
    cells = [tuple(cell) for cell in mission["path"].values.tolist() if cell[0] >= 0]
    if "posts" not in mission:
        return cells

    sets = [POST_SETS[k] for k in mission["posts"].values]
    return [*((*cell, name) for cell, name in zip(cells[:-1], sets, strict=False)), cells[-1]]


def positions_of(path: Sequence[Station], grid: Grid) -> np.ndarray:
    """Return positions of a path's cells, (cell, 2), in metres from the lower left corner."""
    row, col = cells_along(path).T
    return np.column_stack([grid.x[col], grid.y[row]]) - grid.corner


def draw_path(ax: Axes, path: Sequence[Station], grid: Grid) -> None:
    """Plot a path over a map, from its start (circle) to its goal (star).

    The bounds that T2 watches from other sets of posts than the standard one are coloured.
    """
    places = positions_of(path, grid)
    outline = outlined(3.6, "black")
    ax.plot(*places.T, "w", linewidth=2.0, solid_joinstyle="round", path_effects=outline)

    bounds = np.stack([places[:-1], places[1:]], 1)
    sets = posts_along(path)
    for k in np.unique(sets[sets > 0]):
        style: dict[str, Any] = {"colors": COLOURS_OF_SETS[k], "label": f"{POST_SETS[k]} posts"}
        ax.add_collection(LineCollection([*bounds[sets == k]], linewidths=2.0, **style))

    ax.plot(*places[0], "wo", markeredgecolor="black", markersize=6, label="start")
    ax.plot(*places[-1], "w*", markeredgecolor="black", markersize=11, label="goal")


def map_panels(grid: Grid, n: int, ax: Any) -> np.ndarray:
    """Return axes for n maps, in metres from the lower left corner; the first has a scale bar."""
    _, right, _, top = extent_of(grid)
    tall = float(np.clip(top / right, 0.3, 3.0))
    columns = min(n, 2 if n == 4 else 3)
    width = min(3.0 if n > 1 else 4.0, PAGE / columns)

    inner = width - _BESIDE / columns
    height = inner * tall + _ABOVE + _BELOW / math.ceil(n / columns)
    axes = panels(n, ax, (width, height), columns=columns)

    for panel in axes:
        set_frame(panel, grid, xlabel="east (m)", ylabel="north (m)")
        panel.locator_params(nbins=4)
        if panel.get_subplotspec() is not None:
            panel.label_outer()
    draw_scale(axes[0])
    return axes


def set_frame(ax: Axes, grid: Grid, **settings: Any) -> None:
    """Show the area of a grid in axes with a frame; `settings` are those of `Axes.set`."""
    extent = extent_of(grid)
    ax.set(xlim=extent[:2], ylim=extent[2:], aspect="equal", **settings)
    ax.spines[:].set_visible(True)
    ax.grid(visible=False)  # its lines would look like edges of cells


def colour_bar(
    axes: Sequence[Axes] | np.ndarray,
    image: Any,
    label: str,
    values: np.ndarray | None = None,
    *,
    pad: float = 0.02,
    **options: Any,
) -> Any:
    """Draw a colour bar beside axes, and return it; its ends are pointed if `values` exceed it."""
    if values is not None and image.norm.scaled():
        found = values[np.isfinite(values)]
        beyond = bool((found < image.norm.vmin).any()), bool((found > image.norm.vmax).any())
        options["extend"] = _EXTENDED.get(beyond, "both")

    ticks = MaxNLocator(N_INTERVALS, steps=[1.0, 2.0, 2.5, 5.0, 10.0])
    bar = figure_of(axes).colorbar(image, ax=list(axes), pad=pad, ticks=ticks, **options)
    bar.set_label(in_lines(label, axes) if bar.orientation == "vertical" else label)
    return bar


def _trust_bar(
    axes: np.ndarray, image: Any, values: np.ndarray, label: str, *, explain: bool
) -> None:
    """Draw a colour bar of trust; an upper end of 1 is labelled "≥ 1" if values exceed 1.

    With `explain`, the label of the bar in a large figure explains that 1 is unbroken contact.
    """
    bar = colour_bar(axes, image, label, values)
    if image.norm.vmax != 1.0:
        return

    is_above = bar.extend in ("max", "both")
    if explain and (figure_of(axes).get_size_inches() >= _LEAST_SIZE).all():
        bar.set_label(in_lines(f"{label}\n(1: unbroken contact)", axes))
    if is_above:
        bar.formatter = FuncFormatter(lambda x, _: "≥ 1" if math.isclose(x, 1.0) else f"{x:.4g}")
        bar.update_ticks()


def draw_cells(
    ax: Axes, shown: np.ndarray, workspace: Workspace, norm: Normalize, cmap: str | Colormap
) -> Any:
    """Draw values of the planning cells (row, col), and return the image; NaN is grey."""
    ax.set_facecolor(GREY)
    image = ax.imshow(shown, cmap=cmap, norm=norm, extent=extent_of(workspace.grid))
    draw_contours(ax, workspace, "black", 0.25)
    draw_places(ax, workspace)
    return image


def draw_places(ax: Axes, workspace: Workspace) -> None:
    """Mark the named places of a workspace, and the middle of what is closed."""
    for cells in workspace.closed:
        x, y = positions_of(cells, workspace.grid).mean(0)
        (cross,) = ax.plot(x, y, "x", color=CLOSED, markersize=6, mew=1.8, zorder=6, label="closed")
        cross.set_path_effects(outlined(3.2, "white"))
    for name, position in workspace.places.items():
        x, y = np.array(position) - workspace.grid.corner
        ax.plot(x, y, "+", color="black", markersize=7, zorder=6)
        style: dict[str, Any] = {"color": "black", "fontsize": "small", "zorder": 6}
        text = ax.annotate(name, (x, y), (4, 4), textcoords="offset points", **style)
        text.set_path_effects(outlined(2.0, "white"))


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
    new = workspace.passable.values & ~driven
    _fill(ax, *edges_of(workspace.grid), new, "none", **_HATCH)


def _fill(
    ax: Axes, x: np.ndarray, y: np.ndarray, cells: np.ndarray, colour: str, **style: Any
) -> None:
    """Fill or hatch cells, a mask (row, col), between the edges x (col + 1,) and y (row + 1,)."""
    shown = np.ma.masked_array(np.ones(cells.shape), ~cells)
    ax.pcolor(x, y, shown, cmap=ListedColormap([colour]), **style)


def _draw_edges(ax: Axes, x: np.ndarray, y: np.ndarray, **style: Any) -> None:
    """Draw all edges of cells, at x and y."""
    ax.vlines(x, y[0], y[-1], alpha=0.5, **style)
    ax.hlines(y, x[0], x[-1], alpha=0.5, **style)


def draw_contours(ax: Axes, workspace: Workspace, colour: str, opacity: float) -> None:
    """Draw contour lines of the ground, if there is a terrain that is not level."""
    ground = smooth_ground(workspace)
    if ground is not None:
        style: dict[str, Any] = {"linestyles": "solid", "linewidths": 0.5}
        ax.contour(*ground, colors=colour, alpha=opacity, **style)


def smooth_ground(
    workspace: Workspace,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Sequence[float]] | None:
    """Smooth the ground for contour lines at up to 12 round heights.

    Returns:
        x (col,) and y (row,) of pixels, in metres from the lower left corner of the grid; smooth
        heights (row, col), masked where unknown; and the heights of contour lines. None if the
        ground is level or there is no terrain.
    """
    terrain = workspace.terrain
    if terrain is None:
        return None

    step = math.ceil(max(terrain["dem"].shape) / _MAX_PIXELS)
    ground = terrain["dem"][::step, ::step]
    height = ground.values
    valid = np.isfinite(height)
    if min(height.shape) < 3 or not valid.any():
        return None

    # Smooth the known heights only (normalised convolution).
    width = max(1.0, _SMOOTH * max(height.shape))
    weight = gaussian_filter(valid.astype(float), width)
    smooth = gaussian_filter(np.where(valid, height, 0.0), width) / np.maximum(weight, 1e-9)

    smooth = np.ma.masked_where(~valid, smooth)
    low = float(smooth.min())
    high = float(smooth.max())
    if high - low <= _LEVEL:
        return None

    left, bottom = workspace.grid.corner
    levels = MaxNLocator(_CONTOURS, steps=[1.0, 2.0, 5.0, 10.0]).tick_values(low, high)
    return ground["x"].values - left, ground["y"].values - bottom, smooth, levels


def limits_of(
    values: np.ndarray, ends: tuple[float, float] = _ROBUST, *, is_trust: bool
) -> tuple[float, float]:
    """Return limits of a colour scale: two quantiles, by default ones robust to outliers.

    An upper limit of trust just above 1 (unbroken contact) becomes 1.
    """
    low, high = np.nanquantile(values, ends).tolist()
    if is_trust and low < 1.0 < high < _LOGIT:
        high = 1.0
    room = 0.05 if low == high else 0.0  # a scale of one value has no colours
    return low - room, high + room


def draw_scale(ax: Axes) -> None:
    """Draw a scale bar, whose length is a round number, in the lower right corner of a map."""
    left, right = ax.get_xlim()
    longest = _LONGEST_BAR * (right - left)
    lengths = np.array([1.0, 2.0, 5.0]) * 10.0 ** np.floor(np.log10(longest))
    length = lengths[lengths <= longest * (1.0 + 1e-9)].max()  # up to rounding

    ends = (_BAR_END - length / (right - left), _BAR_END)
    outline = outlined(4.0, background())
    style: dict[str, Any] = {"linewidth": 2.0, "solid_capstyle": "butt", "transform": ax.transAxes}
    ax.plot(ends, (_BAR_LOW, _BAR_LOW), color=ink(), path_effects=outline, **style)

    label = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    place: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points"}
    place |= {"ha": "right", "va": "bottom"}
    text = ax.annotate(label, (_BAR_END, _BAR_LOW), (0.0, 2.5), color=ink(), **place)
    text.set_path_effects(outlined(2.5, background()))


def edges_of(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Return x of the edges of columns, and y of rows from north, m from the lower left corner."""
    rows, cols = grid.shape
    return np.arange(cols + 1) * grid.cell_width, np.arange(rows, -1, -1) * grid.cell_height


def extent_of(grid: Grid) -> tuple[float, float, float, float]:
    """Return the left, right, bottom and top edges of a grid, m from its lower left corner."""
    return (0.0, grid.shape[1] * grid.cell_width, 0.0, grid.shape[0] * grid.cell_height)
