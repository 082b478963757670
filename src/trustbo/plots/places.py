"""Maps of the effects of places that the terrain does not explain: mean and standard deviation."""

from typing import Any, Unpack

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize

from trustbo.errors import ShapeError, require_kind
from trustbo.inference import place_maps
from trustbo.plots.layout import map_panels
from trustbo.plots.maps import draw_cells, draw_scale, outlined, robust_limits
from trustbo.plots.style import Style, StyleOptions
from trustbo.workspace import Workspace
from trustbo.workspace.grid import Grid
from trustbo.workspace.moves import MOVES

BETTER_WORSE = "RdBu"
"""Diverging colours: red where contact is worse, blue where it is better."""
_OF_BOUND = "effect", "move", "row", "col"
_SURE = 1.645
"""Standard deviations from 0 at which the sign is known with 95 %."""
_SEEN = 0.2
"""Share of the largest effect from which cells have a sign."""
_TIP, _TAIL = 0.2, 0.47
"""Ends of an arrow, in steps back from the centre of the cell entered."""


def place_map(
    posterior: xr.DataTree, workspace: Workspace, **style: Unpack[StyleOptions]
) -> np.ndarray:
    """Draw effects of places: contact better or worse than the terrain explains, and its sd.

    The left panel has the mean effect of each cell, with + or -, large where that sign has a
    probability of 95 %; the right one the standard deviation. Arrows, in the cell entered, are the
    bounds made by missions: their colour is the further effect of the bound, on the same scale.

    Args:
        posterior: DataTree from `fit` of a model with `place=PlaceEffect()`, such as
            `Result.posterior`.
        workspace: Workspace of the cells.
        **style: Options of `Style`; `cmap` is that of the standard deviation.

    Returns:
        Axes of the mean and of the standard deviation, shape (2,); where robots have separate
        effects, those of each robot in turn, shape (2 robot,).

    Raises:
        TrustboError: The model has no effects of places.
        ShapeError: The workspace has fewer cells than the posterior's grid.
    """
    such = "give a posterior with places, such as Result.posterior, and a Workspace"
    require_kind("plots.place_map", posterior, xr.DataTree, such)
    require_kind("plots.place_map", workspace, Workspace, such)
    options, maps = Style.from_options(style), place_maps(posterior)
    have, grid = (maps.sizes["row"], maps.sizes["col"]), workspace.grid
    if have[0] > grid.shape[0] or have[1] > grid.shape[1]:
        raise ShapeError(
            f"the posterior's places are on {have[0]} rows and {have[1]} columns, the workspace "
            f"has {grid.shape[0]} and {grid.shape[1]}; give the workspace that it was fitted on."
        )
    names = [str(name) for name in maps["robot"].values] if "robot" in maps.dims else [""]
    maps = maps if "robot" in maps.dims else maps.expand_dims("robot")
    units = posterior["places"].to_dataset()
    _, top = _ends(abs(maps), "mean", units)
    colours = {
        "mean": (Normalize(-top, top), colormaps[BETTER_WORSE]),
        "sd": (Normalize(*_ends(maps, "sd", units)), options.colours()),
    }
    wording = {"mean": "better (+) or worse (\N{MINUS SIGN})", "sd": "how sure"}
    made = map_panels(grid, 2 * len(names), options, columns=2, width=3.4, margin=0.0, least=2.0)
    titles = []
    for i, name in enumerate(names):
        maps_of_robot = maps.isel(robot=i)
        for ax, (kind, drawn) in zip(made.panels[2 * i : 2 * i + 2], colours.items(), strict=True):
            _draw(ax, maps_of_robot, kind, units, i, workspace, *drawn)
            titles.append(f"{name}: {wording[kind]}" if name else wording[kind])
        if "place_mean" in maps_of_robot:
            _signs(made.panels[2 * i], maps_of_robot, workspace, top)
    draw_scale(made.panels[0], grid)
    made.label_maps()
    made.titles(titles)
    labels = {"mean": "effect on trust, mean", "sd": "effect on trust, sd"}
    under: dict[str, Any] = {"location": "bottom", "aspect": 24, "pad": 0.02}
    for k, kind in enumerate(colours):
        of_kind = {"axes": made.panels[k::2], "extend": "both" if k == 0 else "neither"}
        made.colour_bar(ScalarMappable(*colours[kind]), labels[kind], **of_kind, **under)
    made.fit_height()
    return made.panels


def _ends(maps: xr.Dataset, kind: str, units: xr.Dataset) -> tuple[float, float]:
    """Robust ends of the values that are drawn of a kind of moment."""
    shown = []
    if f"place_{kind}" in maps:
        shown.append(maps[f"place_{kind}"].values.ravel())
    if f"place_bound_{kind}" in maps:
        of_bounds = maps[f"place_bound_{kind}"].transpose("robot", "move", "row", "col").values
        shown.append(of_bounds[*(units[f"bound_{n}"].values for n in _OF_BOUND)])
    return robust_limits(np.concatenate(shown))


def _draw(
    ax: Axes,
    maps: xr.Dataset,
    kind: str,
    units: xr.Dataset,
    effect: int,
    workspace: Workspace,
    norm: Normalize,
    colours: Colormap,
) -> None:
    """Draw cells and visited bounds of one robot, or of all of them."""
    data = np.full(workspace.passable.shape, np.nan)
    if f"place_{kind}" in maps:
        of_cells = maps[f"place_{kind}"].transpose("row", "col").values
        data[: of_cells.shape[0], : of_cells.shape[1]] = of_cells
    elif kind == "mean":
        data[:] = 0.0
    cells = workspace.passable.copy(data=data)
    draw_cells(ax, cells, workspace, norm, colours)
    if f"place_bound_{kind}" in maps:
        mine = units["bound_effect"].values == effect
        move, row, col = (units[f"bound_{n}"].values[mine] for n in _OF_BOUND[1:])
        of_bounds = maps[f"place_bound_{kind}"].transpose("move", "row", "col").values
        _arrows(ax, move, row, col, colours(norm(of_bounds[move, row, col])), workspace.grid)


def _arrows(
    ax: Axes, move: np.ndarray, row: np.ndarray, col: np.ndarray, colour: np.ndarray, grid: Grid
) -> None:
    """Draw bounds as arrows from the edge of the cell entered towards its centre."""
    down, right = np.array(MOVES[8])[move].T
    size = np.array([grid.cell_width, grid.cell_height])
    step = np.column_stack([right, -down]) * size
    centre = np.column_stack([col + 0.5, grid.shape[0] - row - 0.5]) * size
    ax.quiver(
        *(centre - _TAIL * step).T, *((_TAIL - _TIP) * step).T, color=colour, edgecolor="black",
        linewidth=0.4, angles="xy", scale_units="xy", scale=1.0, units="xy",
        width=0.09 * min(size), headwidth=2.4, headlength=2.0, headaxislength=2.0, minlength=0.0,
        zorder=3,
    )  # fmt: skip


def _signs(ax: Axes, maps: xr.Dataset, workspace: Workspace, top: float) -> None:
    """Write + or - into cells, for colours lose the sign in grey: large where it is sure."""
    grid = workspace.grid
    mean, sd = (maps[f"place_{n}"].transpose("row", "col").values for n in ("mean", "sd"))
    size = float(np.clip(72 * 0.4 * 2.6 / grid.shape[1], 3.0, 9.0))
    sure = np.abs(mean) > _SURE * sd
    for row, col in np.argwhere(sure | (np.abs(mean) > _SEEN * top)).tolist():
        if not workspace.passable.values[row, col]:
            continue
        x, y = (col + 0.5) * grid.cell_width, (grid.shape[0] - row - 0.5) * grid.cell_height
        text = "+" if mean[row, col] > 0.0 else "\N{MINUS SIGN}"
        mark = ax.text(x, y, text, fontsize=size, ha="center", va="center", zorder=4, color="black")
        if sure[row, col]:
            mark.set_path_effects(outlined(1.2))
        else:
            mark.set(fontsize=0.7 * size, color="0.25")
