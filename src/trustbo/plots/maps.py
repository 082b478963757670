"""Maps of planning cells with contour lines, a path, a scale and a colour bar."""

from collections.abc import Sequence
from typing import Any, Unpack

import numpy as np
import xarray as xr
from contourpy import contour_generator
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, ListedColormap, LogNorm, Normalize
from matplotlib.image import AxesImage
from scipy.ndimage import gaussian_filter

from trustbo.data import Cell
from trustbo.errors import TrustboError, require_kind
from trustbo.plots.layout import (
    extent_of,
    grid_lines,
    map_panels,
)
from trustbo.plots.style import COLOURS, SMALL, Style, StyleOptions, theme
from trustbo.terrain.read import pixel_size
from trustbo.workspace import Workspace
from trustbo.workspace.grid import Grid, over_cells

VEGETATION = (0.44, 0.56, 0.39, 0.4)
"""Green that is opaque in part, for light and dark ground."""
MOMENTS = (1, 2, 4)
"""Missions before which a map is drawn by default, with one after the last."""
_ROBUST = (0.02, 0.98)
"""Quantiles of the values at the ends of the colours."""
_GROWN = 0.5  # least height of vegetation above the ground, m
_CONTOURS = 12  # levels on a map, at most
_SMOOTH = 1 / 60  # of a map's longer side: contour lines of rough ground are smoothed over it
_MOST_PIXELS = 400  # a side, of the heights that contour lines are drawn of
_LEAST_CHANCE = 1e-3
"""Chance to fail at the first colour of a map of chances."""


def trust_maps(
    history: xr.Dataset,
    trust_map: xr.DataArray,
    path: Sequence[Cell],
    workspace: Workspace,
    *,
    missions: Sequence[int] | str = "moments",
    **style: Unpack[StyleOptions],
) -> np.ndarray:
    """Draw the trust map that missions were planned on, with their paths, Fig. 5 of the paper.

    The last panel shows the map and the recommended path after the last mission. All are on one
    scale, from the 2 % to the 98 % quantile of the learned maps, the start cell left out, whose
    trust is assumed: a draw of the prior may be far off. A trust of 1 corresponds to unbroken
    contact; larger values share its colour.

    Args:
        history: Map and path of each iteration, such as `Result.history`.
        trust_map: Map after the last mission, dims (row, col), such as `Result.trust_map`.
        path: Path recommended then, such as `Result.path`.
        workspace: Workspace of the cells.
        missions: Missions to draw, numbers of the history's `iteration`; `"moments"` for the first,
            second and fourth, as far as they exist, planned after 0, 1 and 3 missions; or `"all"`.
        **style: Options of `Style`.

    Returns:
        Axes, shape (mission + 1,).

    Raises:
        TrustboError: There is no such mission.
    """
    require_kind("plots.trust_maps", history, xr.Dataset, "give a history, such as Result.history")
    options, number = Style.from_options(style), history["iteration"].values.tolist()
    chosen = _chosen(missions, number)
    maps = [history["trust_map"].sel(iteration=i) for i in chosen]
    paths: list[Sequence[Cell]] = [_cells(history["path"].sel(iteration=i).values) for i in chosen]
    learned = [len(number) if i is None else i - 1 for i in (*chosen, None)]
    titles = ["prior" if n == 0 else f"after {n} mission{'s' if n > 1 else ''}" for n in learned]
    maps, paths = [*maps, trust_map], [*paths, path]
    everything = np.stack([trust.transpose("row", "col").values for trust in maps])
    everything[:, *paths[0][0]] = np.nan
    low, high = robust_limits(everything[learned.index(0) + 1 :] if 0 in learned else everything)
    norm = Normalize(low, min(high, 1.0) if low < 1.0 else high)
    label = "expected trust (1: contact kept)"
    extend = _extend(everything, norm)
    return _draw_maps(maps, paths, titles, workspace, label, norm, options, extend=extend)


def _chosen(missions: Sequence[int] | str, available: list[int]) -> list[int]:
    """Numbers of the missions to draw; TrustboError for one that does not exist."""
    if isinstance(missions, str):
        if missions not in ("moments", "all"):
            raise TrustboError(
                f"missions must be 'moments', 'all' or numbers of missions; got {missions!r}."
            )
        return available if missions == "all" else [i for i in available if i in MOMENTS]
    if not set(missions) <= set(available):
        raise TrustboError(
            f"missions must be some of {available[0]}..{available[-1]}; got {missions!r}."
        )
    return list(missions)


def robust_limits(values: np.ndarray) -> tuple[float, float]:
    """Values at the ends of the colours: quantiles, so that single cells do not take them all."""
    low, high = np.nanquantile(values, _ROBUST).tolist()
    if not low < high:
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return (low, high) if low < high else (low - 0.5e-3, high + 0.5e-3)


def robot_maps(
    maps: xr.DataArray,
    workspace: Workspace,
    path: Sequence[Cell] | None = None,
    *,
    label: str = "cost",
    **style: Unpack[StyleOptions],
) -> np.ndarray:
    """Draw a map for each robot, all on one robust scale of colours.

    Args:
        maps: Maps (robot, row, col), such as `planner.cost_map(params, per_robot=True)`, the cost
            f = 1 - sigma(trust) of the paper.
        workspace: Workspace of the cells.
        path: Path to draw on each map; its start, where trust is assumed, is excluded from the
            scale.
        label: Label of the colour bar.
        **style: Options of `Style`.

    Returns:
        Axes, shape (robot,).
    """
    such = "give maps (robot, row, col), such as planner.cost_map(params, per_robot=True)"
    require_kind("plots.robot_maps", maps, xr.DataArray, such)
    options, maps = Style.from_options(style), maps.transpose("robot", "row", "col")
    values = np.where(workspace.passable.values, maps.values, np.nan)
    if path is not None:
        values[:, *path[0]] = np.nan
    norm, names = Normalize(*robust_limits(values)), [str(name) for name in maps["robot"].values]
    extend = _extend(values, norm)
    return _draw_maps(
        list(maps), [path] * len(names), names, workspace, label, norm, options, extend=extend
    )


def path_posterior(
    share: xr.DataArray,
    workspace: Workspace,
    path: Sequence[Cell] | None = None,
    **style: Unpack[StyleOptions],
) -> Axes:
    """Draw the probability of each cell to be on the best path.

    Args:
        share: Probabilities (row, col), such as `planner.path_posterior(posterior)`.
        workspace: Workspace of the cells.
        path: Path to draw, such as the recommended one.
        **style: Options of `Style`.

    Returns:
        Axes of the map.
    """
    such = "give probabilities (row, col), such as planner.path_posterior(posterior)"
    require_kind("plots.path_posterior", share, xr.DataArray, such)
    label, options = "P(cell on the best path)", Style.from_options(style)
    (ax,) = _draw_maps(
        [share], [path], [""], workspace, label, Normalize(0.0, 1.0), options, width=3.6
    )
    return ax


def hazard_map(
    p_fail: np.ndarray,
    workspace: Workspace,
    path: Sequence[Cell] | None = None,
    **style: Unpack[StyleOptions],
) -> Axes:
    """Draw the chance of each cell that the bound into it ends the mission, from the worst side.

    Colours are of the logarithm of the chance, from .001 on: chances go over many decades.

    Args:
        p_fail: Chances (move, row, col), NaN where there is no bound, such as
            `planner.problem.risk.p_fail`.
        workspace: Workspace of the cells.
        path: Path to draw, such as the recommended one.
        **style: Options of `Style`.

    Returns:
        Axes of the map.
    """
    p_fail = np.asarray(p_fail, dtype=float)
    worst = np.where(np.isnan(p_fail), -np.inf, p_fail).max(0)
    hazard = workspace.passable.copy(data=np.where(worst >= 0.0, worst, np.nan))
    label, norm = "chance to fail on entering, at most", LogNorm(_LEAST_CHANCE, 1.0, clip=True)
    bar: dict[str, Any] = {"extend": "min", "format": "%g"}
    (ax,) = _draw_maps(
        [hazard], [path], [""], workspace, label, norm, Style.from_options(style), width=3.6, **bar
    )
    return ax


def _draw_maps(
    maps: Sequence[xr.DataArray],
    paths: Sequence[Sequence[Cell] | None],
    titles: Sequence[str],
    workspace: Workspace,
    label: str,
    norm: Normalize,
    options: Style,
    *,
    width: float = 2.6,
    **bar: Any,
) -> np.ndarray:
    """Draw maps on one scale of colours, each with its path, and their colour bar."""
    made, colours = map_panels(workspace.grid, len(maps), options, width=width), options.colours()
    for ax, values, path in zip(made.panels, maps, paths, strict=True):
        draw_cells(ax, values, workspace, norm, colours)
        if path is not None:
            draw_path(ax, path, workspace.grid)
    made.titles(titles)
    draw_scale(made.panels[0], workspace.grid)
    made.label_maps()
    if not workspace.passable.all():
        label = f"{label[:-1]}; " if label.endswith(")") else f"{label} ("
        label += "grey: impassable)"
    made.colour_bar(ScalarMappable(norm, colours), label, **bar)
    made.fit_height()
    return made.panels


def cell_map(
    ax: Axes,
    values: xr.DataArray,
    workspace: Workspace,
    *,
    low: float | None = None,
    high: float | None = None,
    cmap: str | Colormap = COLOURS,
) -> AxesImage:
    """Draw a map of the planning cells in the colours of its bar; impassable cells are grey.

    Args:
        ax: Axes to draw on.
        values: Map (row, col).
        workspace: Workspace of the cells.
        low: Value of the first colour.
        high: Value of the last colour.
        cmap: Colours, a name or a `Colormap` of matplotlib.

    Returns:
        Image, for a colour bar.
    """
    return draw_cells(ax, values, workspace, Normalize(low, high), cmap)


def draw_cells(
    ax: Axes,
    values: xr.DataArray,
    workspace: Workspace,
    norm: Normalize,
    cmap: str | Colormap,
) -> AxesImage:
    """Draw a map of the planning cells, see `cell_map`."""
    shown = over_cells(values).transpose("row", "col").values
    data = np.where(workspace.passable.values, shown, np.nan)
    ax.set_facecolor(theme().closed)
    extent = extent_of(workspace.grid)
    image = ax.imshow(data, cmap=cmap, norm=norm, extent=extent, interpolation="nearest")
    draw_relief(ax, workspace)
    return image


def draw_relief(
    ax: Axes,
    workspace: Workspace,
    heights: str = "dem",
    colour: str = "black",
    opacity: float = 0.22,
) -> None:
    """Draw contour lines of the terrain, see `contours`, over a map.

    They are thin, and do not change a map's colours, as a shade would.
    """
    lines = contours(workspace, heights)
    style = {"colors": colour, "alpha": opacity, "linewidths": 0.5}
    ax.add_collection(LineCollection(lines, **style), autolim=False)


def contours(workspace: Workspace, heights: str = "dem") -> list[np.ndarray]:
    """Contour lines of the terrain, up to a dozen levels at a round number of metres.

    Args:
        workspace: Workspace of the cells.
        heights: `"dem"` or `"dsm"`.

    Returns:
        Lines, each (point, 2): x and y in m from the map's lower left corner. None of them on level
        ground, or without a terrain in memory.
    """
    terrain = workspace.terrain
    if terrain is None or workspace.pixels is None:
        return []
    step = -(-max(terrain[heights].shape) // _MOST_PIXELS)  # more would not be visible
    height = terrain[heights].values[::step, ::step]
    valid = np.isfinite(height)
    if min(height.shape) < 3 or not valid.any():
        return []
    # A normalised convolution: only known heights are smoothed.
    width = max(1.0, _SMOOTH * max(height.shape))
    weight = gaussian_filter(valid.astype(float), width)
    smooth = gaussian_filter(np.where(valid, height, 0.0), width) / np.maximum(weight, 1e-9)
    interval = contour_interval(float(np.ptp(smooth[valid])))
    if interval is None:
        return []
    low, high = (float(f(smooth[valid])) for f in (np.min, np.max))
    dy, dx = (float(size) for size in pixel_size(terrain))
    _, _, _, top = extent_of(workspace.grid)
    x = (np.arange(height.shape[1]) * step + 0.5) * dx
    y = top - (np.arange(height.shape[0]) * step + 0.5) * dy
    traced = contour_generator(x, y, np.ma.masked_where(~valid, smooth), line_type="Separate")
    levels = np.arange(np.ceil(low / interval), np.floor(high / interval) + 1) * interval
    return [np.asarray(line) for level in levels for line in traced.lines(level)]


def contour_interval(relief: float) -> float | None:
    """Round number of metres between contour lines; None on level ground."""
    if not relief > 0.05:
        return None
    magnitude = 10.0 ** np.floor(np.log10(relief / _CONTOURS))
    return float(
        next(f * magnitude for f in (1, 2, 5, 10) if relief / (f * magnitude) <= _CONTOURS)
    )


def draw_ground(ax: Axes, workspace: Workspace, heights: str = "dsm") -> None:
    """Draw vegetation and contour lines on a plain ground, or the grid without a terrain.

    Contour lines are those of the surface, `"dsm"`, or of the ground, `"dem"`; axes have no ticks.
    """
    terrain, grid, colours = workspace.terrain, workspace.grid, theme()
    left, right, bottom, top = extent_of(grid)
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xticks=[], yticks=[])
    ax.set_facecolor(colours.ground)
    if terrain is None or workspace.pixels is None:
        grid_lines(ax, grid)
        return
    grown = np.where((terrain["dsm"] - terrain["dem"]).values > _GROWN, 1.0, np.nan)
    green, extent = ListedColormap([VEGETATION]), (left, right, bottom, top)
    ax.imshow(grown, cmap=green, extent=extent, interpolation="nearest")
    draw_relief(ax, workspace, heights, colours.contour, 1.0)


def draw_scale(
    ax: Axes, grid: Grid, *, width: float | None = None, corner: tuple[int, int] = (1, 0)
) -> None:
    """Draw a bar of a round number of metres in a corner of a map.

    Args:
        ax: Axes of the map.
        grid: Grid of the cells.
        width: Width of the Axes, m, where they show a part of the map.
        corner: Corner, (1, 0) for the lower right one, (0, 1) for the upper left one.
    """
    width = grid.shape[1] * grid.cell_width if width is None else width
    magnitude = 10.0 ** np.floor(np.log10(0.4 * width))
    length = max(f * magnitude for f in (1, 2, 5) if f * magnitude <= 0.4 * width * (1 + 1e-9))
    share = length / width  # of the axes
    x, y = (0.96 - share if corner[0] else 0.04), (0.87 if corner[1] else 0.045)
    (bar,) = ax.plot([x, x + share], [y, y], color=theme().ink, transform=ax.transAxes)
    halo = theme().paper
    bar.set(linewidth=2.0, solid_capstyle="butt", path_effects=outlined(4.0, halo))
    label = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    edge = ("left", x) if corner[0] == 0 else ("right", x + share)  # for a long text to stay inside
    text = ax.text(edge[1], y + 0.02, label, ha=edge[0], fontsize=SMALL, transform=ax.transAxes)
    text.set(color=theme().ink, path_effects=outlined(2.5, halo))


def draw_path(ax: Axes, path: Sequence[Cell], grid: Grid) -> None:
    """Draw a path over a map, from its start (circle) to its goal (star)."""
    centers = np.array([grid.center(cell) for cell in path]) - grid.corner
    x, y = centers[:, 0], centers[:, 1]
    (line,) = ax.plot(x, y, color="white", linewidth=1.6, solid_joinstyle="round")
    line.set_path_effects(outlined(3.2, "black"))
    ax.plot(x[0], y[0], "wo", markeredgecolor="black", markersize=6)
    ax.plot(x[-1], y[-1], "w*", markeredgecolor="black", markersize=11)


def outlined(width: float, colour: str = "white") -> list[patheffects.AbstractPathEffect]:
    """Return the effect of an outline, `width` points with the line."""
    return [patheffects.withStroke(linewidth=width, foreground=colour)]


def _cells(path: np.ndarray) -> list[Cell]:
    return [(int(row), int(col)) for row, col in path if row >= 0]


def _extend(values: np.ndarray, norm: Normalize) -> str:
    """Ends of the colour bar that values go beyond."""
    below, above = np.nanmin(values) < norm.vmin, np.nanmax(values) > norm.vmax
    return {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above]
