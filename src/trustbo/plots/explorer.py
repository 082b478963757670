"""Interactive map of a result, as a self-contained HTML page."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.colors import to_hex

from trustbo.data import Cell, path_text
from trustbo.errors import require_kind
from trustbo.files import FilePath, write_text
from trustbo.planning import Plan
from trustbo.plots.maps import (
    BRIGHT_HIGH,
    BRIGHT_LOW,
    cells_of,
    contours,
    extent_of,
    is_good_high,
    is_trust,
    positions_of,
    robust_limits,
    trust_limits,
)
from trustbo.plots.style import ROBOTS
from trustbo.workspace.grid import Grid

_PLANNED_ON = "trust map used to plan the mission"
_MARKERS = ("circle", "square", "diamond", "triangle", "inverted_triangle", "plus")
_HEIGHT = 800
"""Height of the page in a notebook, pixels."""
_WIDTH = 600
"""Width for which the height of the map is chosen, pixels."""
_HEIGHTS = (250, 700)
"""Least and largest height of the map, pixels."""
_BELOW = 200
"""Height of the colour bar and the legend, pixels."""
_UPDATE = """
const n = mission.value
const column = layer.value == planned_on ? `mission ${n}` : layer.value
cells.data = {...cells.data, value: cells.data[column]}
colours.palette = palettes[layer.value]
colours.low = limits[column][0]
colours.high = limits[column][1]
bar.title = titles[layer.value]
planned.data = paths[n - 1]
text.text = texts[n - 1]
"""
"""JavaScript callback that runs when the user selects a layer or a mission."""


@dataclass(frozen=True, repr=False)
class Explorer:
    """Interactive HTML page, which notebooks display.

    Attributes:
        html: Source of the page, which works offline.
    """

    html: str

    def save(self, path: FilePath) -> None:
        """Write the page to an HTML file."""
        write_text(path, self.html)

    def __repr__(self) -> str:
        size = len(self.html) / 1e6
        return f"Explorer: interactive page, {size:.1f} MB; save(path) writes it, notebooks show it"

    def _repr_html_(self) -> str:
        page = escape(self.html, quote=True)
        return f'<iframe srcdoc="{page}" width="100%" height="{_HEIGHT}" frameborder="0"></iframe>'


def explore(plan: Plan, maps: xr.Dataset, history: xr.Dataset) -> Explorer:
    """Make an interactive map with layers, cell values at the pointer, and a slider over missions.

    Args:
        plan: Recommended plan, such as `Result.plan`.
        maps: Maps of the cells, dims (y, x) or (row, col), such as `Result.maps()`.
        history: Paths, trust maps and outcomes of the missions, such as `Result.history`.

    Returns:
        Page, which notebooks display and `save` writes to a file.

    Example:
        >>> page = tb.plots.explore(result.plan, result.maps(), result.history)
        >>> page.save("explore.html")
    """
    require_kind("plan", plan, Plan, "give a Plan, such as Result.plan")
    require_kind("maps", maps, xr.Dataset, "give maps, such as Result.maps()")
    require_kind("history", history, xr.Dataset, "give Result.history")
    from bokeh.embed import file_html  # imported here, because it takes half a second
    from bokeh.resources import INLINE

    n = history.sizes["iteration"]
    start, goal = (path_text([cell]) for cell in (plan.path[0], plan.path[-1]))
    title = f"Path from {start} to {goal} after {n} {'mission' if n == 1 else 'missions'}"
    html = file_html(_layout(plan, maps, history), INLINE, title=title)
    viewport = '<meta name="viewport" content="width=device-width, initial-scale=1">'
    return Explorer(html.replace("<head>", f"<head>{viewport}", 1))


def _layout(plan: Plan, maps: xr.Dataset, history: xr.Dataset) -> Any:
    """Lay out the controls, the map and the description of the mission."""
    from bokeh import models
    from bokeh.layouts import column

    grid = plan.workspace.grid
    layers = _layers(plan, maps, history)
    names = [name for name in layers if not name.startswith("mission ")]
    trusts = [name for name in layers if name == "trust mean" or name not in names]
    limits = {name: robust_limits(values) for name, values in layers.items()}
    limits |= dict.fromkeys(trusts, trust_limits(np.stack([layers[name] for name in trusts])))

    x, y = np.meshgrid(grid.x - grid.corner[0], grid.y - grid.corner[1])
    row, col = np.indices(grid.shape)
    columns = {name: values.ravel() for name, values in layers.items()}
    position = {"x": x.ravel(), "y": y.ravel(), "cell_row": row.ravel(), "cell_col": col.ravel()}
    cells = models.ColumnDataSource({**position, **columns, "value": columns[names[0]]})

    titles = {name: _title(name, maps, limits[name]) for name in names}
    titles[_PLANNED_ON] = _title(_PLANNED_ON, maps, limits[names[0]])
    palettes = {name: _palette(name) for name in titles}

    low, high = limits[names[0]]
    colours = models.LinearColorMapper(
        palette=palettes[names[0]], low=low, high=high, nan_color="#9a9a9a"
    )
    bar = models.ColorBar(color_mapper=colours, height=12, title=titles[names[0]])
    plot = _plot_cells(plan, names, cells, colours)
    plot.add_layout(bar, "below")

    paths = [_places(cells_of(steps), grid) for steps in history["path"].values]
    texts = [_text(history.isel(iteration=i), plan.objective) for i in range(len(paths))]
    n_missions = len(paths)
    planned = models.ColumnDataSource(paths[-1])
    plot.line(
        "x",
        "y",
        source=planned,
        color=ROBOTS[1],
        line_width=4,
        line_dash="dashed",
        legend_label="plan of the mission",
    )

    _draw_plan(plot, plan)
    plot.legend.click_policy = "hide"
    plot.legend.update(orientation="horizontal", ncols=2, location="left", spacing=8, margin=0)
    plot.add_layout(plot.legend[0], "below")

    layer = models.Select(title="Layer", value=names[0], options=[*names, _PLANNED_ON])
    mission = models.Slider(
        title="Mission",
        start=1,
        end=max(n_missions, 2),
        value=n_missions,
        step=1,
        visible=n_missions > 1,
        sizing_mode="stretch_width",
    )
    text = models.Div(text=texts[-1], sizing_mode="stretch_width")
    shared = {
        "cells": cells,
        "colours": colours,
        "planned": planned,
        "layer": layer,
        "mission": mission,
        "text": text,
        "bar": bar,
        "limits": limits,
        "palettes": palettes,
        "titles": titles,
        "paths": paths,
        "texts": texts,
        "planned_on": _PLANNED_ON,
    }
    update = models.CustomJS(args=shared, code=_UPDATE)
    layer.js_on_change("value", update)
    mission.js_on_change("value", update)

    styles = {"max-width": "900px", "margin": "0 auto", "padding": "0 8px"}
    return column(layer, mission, text, plot, sizing_mode="stretch_width", styles=styles)


def _plot_cells(plan: Plan, names: Sequence[str], cells: Any, colours: Any) -> Any:
    """Plot the selected layer, with the values of all layers in `names` at the pointer.

    Args:
        plan: Plan, whose workspace has the contour lines.
        names: Names of the layers.
        cells: Bokeh data source of the cells, whose column `value` is shown.
        colours: Colour mapper.
    """
    from bokeh import models
    from bokeh.plotting import figure

    grid = plan.workspace.grid
    left, right, bottom, top = extent_of(grid)
    height = int(np.clip(_WIDTH * (top - bottom) / (right - left), *_HEIGHTS))
    plot = figure(
        height=height + _BELOW,
        sizing_mode="stretch_width",
        match_aspect=True,
        tools="pan,wheel_zoom,reset,save",
        active_drag=None,
        toolbar_location="above",
        x_axis_label="east (m)",
        y_axis_label="north (m)",
    )
    plot.grid.visible = False
    size: dict[str, Any] = {"width": grid.cell_width, "height": grid.cell_height}
    fill: Any = {"field": "value", "transform": colours}
    drawn = plot.rect("x", "y", source=cells, fill_color=fill, line_color=None, **size)

    tips = [("cell", "@cell_row,@cell_col"), ("selected layer", "@value{0.000}")]
    tips += ((n, f"@{{{n}}}{{0.000}}") for n in names)
    plot.add_tools(models.HoverTool(renderers=[drawn], tooltips=tips))

    lines = contours(plan.workspace)
    if lines:
        xs: Any = [line[:, 0] for line in lines]
        ys: Any = [line[:, 1] for line in lines]
        plot.multi_line(xs, ys, color="black", alpha=0.25, line_width=0.7)
    return plot


def _layers(plan: Plan, maps: xr.Dataset, history: xr.Dataset) -> dict[str, np.ndarray]:
    """Return maps (row, col), keyed by name; "mission 1" is the trust map of the first mission."""
    free = plan.workspace.passable.values
    grid = plan.workspace.grid
    layers = {
        str(name).replace("_", " "): grid.over_cells(str(name), values).values
        for name, values in maps.data_vars.items()
        if values.ndim == 2
    }

    trust = history["trust_map"].transpose("iteration", "row", "col").values
    layers |= {f"mission {i + 1}": values for i, values in enumerate(trust)}

    learned = free.copy()
    learned[plan.path[0]] = False  # the trust at the start is assumed
    about_trust = "trust", "cost", "mission"
    return {
        name: np.where(learned if name.startswith(about_trust) else free, values, np.nan)
        for name, values in layers.items()
    }


def _draw_plan(plot: Any, plan: Plan) -> None:
    """Plot the recommended path and, with a terrain, the posts and routes of the robots."""
    grid = plan.workspace.grid
    corner = np.array(grid.corner)
    path = _places(plan.path, grid)
    plot.line(path["x"], path["y"], color="black", line_width=5, legend_label="recommended")
    plot.line(path["x"], path["y"], color="white", line_width=3, legend_label="recommended")

    for k, marker in ((0, "circle"), (-1, "star")):
        x = path["x"][k]
        y = path["y"][k]
        plot.scatter([x], [y], marker=marker, size=14, color="white", line_color="black")

    if plan.posts is None or plan.routes is None:
        return

    for i, name in enumerate(plan.workspace.team.names):
        x, y = (plan.posts[:, i] - corner).T
        look = {"color": ROBOTS[i % len(ROBOTS)], "legend_label": f"posts of {name}"}
        marker = _MARKERS[i % len(_MARKERS)]
        plot.scatter(x, y, marker=marker, size=8, line_color="white", **look)
        routes = [bound[i + 1] - corner for bound in plan.routes if bound[i + 1] is not None]
        plot.multi_line([r[:, 0] for r in routes], [r[:, 1] for r in routes], **look)


def _places(path: Sequence[Cell], grid: Grid) -> dict[str, Any]:
    """Return the data source of a line along a path; see `positions_of`."""
    x, y = positions_of(path, grid)
    return {"x": x.tolist(), "y": y.tolist()}


def _palette(name: str) -> list[str]:
    """Return 256 colours for a layer, from low to high values; good values are bright."""
    colours = colormaps[BRIGHT_HIGH if is_good_high(name) else BRIGHT_LOW]
    return [to_hex(colour) for colour in colours(np.linspace(0.0, 1.0, 256))]


def _title(name: str, maps: xr.Dataset, limits: tuple[float, float]) -> str:
    """Return the label of the colour bar for a layer."""
    variable = maps.get(name.replace(" ", "_"))
    text = name if variable is None else variable.attrs.get("long_name", name)
    if is_trust(name) and limits[1] == 1.0:
        return f"{text} (1 or more: unbroken contact)"
    return str(text)


def _text(mission: xr.Dataset, objective: str) -> str:
    """Describe a mission in one line of HTML."""
    value = float(mission["objective"])
    predicted = f"predicted objective {value:z.3f}"
    if objective == "lost_contact":
        lost = _measured(mission, "contact_lost", 2)
        predicted = f"contact lost {lost}, predicted {-value:z.2f} bounds"
    return (
        f"<b>Mission {int(mission['iteration'])}</b>: {escape(str(mission['status'].item()))}, "
        f"contact rate {_measured(mission, 'contact_rate', 3)}, "
        f"plan of {len(cells_of(mission['path'].values)) - 1} bounds, "
        f"{predicted}"
    )


def _measured(mission: xr.Dataset, name: str, n_decimals: int) -> str:
    """Return a quantity of a mission as text."""
    value = float(mission[name]) if name in mission else np.nan
    return f"{value:z.{n_decimals}f}" if np.isfinite(value) else "not measured"
