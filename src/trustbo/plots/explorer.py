"""Interactive map of a result, as a self-contained HTML page."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import xarray as xr

from trustbo.data import POST_SETS, Station
from trustbo.errors import require_kind
from trustbo.files import FilePath, write_text
from trustbo.planning import Plan
from trustbo.plots.maps import (
    COLOURS_OF_SETS,
    extent_of,
    is_good_high,
    is_trust,
    limits_of,
    path_in,
    positions_of,
    shown_values,
    smooth_ground,
)
from trustbo.plots.style import robot_looks
from trustbo.workspace.grid import Grid
from trustbo.workspace.moves import posts_along

_PLANNED_ON = "trust map used to plan the mission"
_BOKEH_MARKERS = {"o": "circle", "s": "square", "D": "diamond", "^": "triangle",
                  "v": "inverted_triangle"}  # fmt: skip
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
const look = looks[layer.value]
cells.data = {...cells.data, value: cells.data[column]}
colours.setv(look.colours)
bar.title = look.title
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
        plan: Recommended plan, such as `Result.plan()`.
        maps: Maps of the cells, dims (y, x) or (row, col), such as `Result.maps()`.
        history: Paths, trust maps and outcomes of the missions, such as `Result.history`.

    Returns:
        Page, which notebooks display and `save` writes to a file.

    Example:
        >>> page = tb.plots.explore(result.plan(), result.maps(), result.history)
        >>> page.save("explore.html")
    """
    require_kind("plan", plan, Plan, "give a Plan, such as Result.plan()")
    require_kind("maps", maps, xr.Dataset, "give maps, such as Result.maps()")
    require_kind("history", history, xr.Dataset, "give Result.history")
    from bokeh.embed import file_html  # imported here, because it takes half a second
    from bokeh.resources import INLINE

    n = history.sizes["iteration"]
    start, goal = (plan.workspace.name_of(cell) for cell in (plan.start, plan.goal))
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
    looks = _looks(layers, maps)
    missions = [history.isel(iteration=i) for i in range(history.sizes["iteration"])]
    paths = [_places(path_in(mission), grid) for mission in missions]
    texts = [_text(mission, plan.objective) for mission in missions]

    plot, of_plot = _plot_cells(plan, layers, looks)
    planned = models.ColumnDataSource(paths[-1])
    dashed = {"color": "#d55e00", "line_width": 4, "line_dash": "dashed"}
    plot.line("x", "y", source=planned, legend_label="plan of the mission", **dashed)
    _draw_plan(plot, plan)

    plot.legend.click_policy = "hide"
    plot.legend.update(orientation="horizontal", ncols=2, location="left", spacing=8, margin=0)
    plot.add_layout(plot.legend[0], "below")

    last = len(paths)
    wide: dict[str, Any] = {"sizing_mode": "stretch_width"}
    layer = models.Select(title="Layer", value=next(iter(looks)), options=[*looks])
    mission = models.Slider(
        title="Mission", start=1, end=max(last, 2), value=last, step=1, visible=last > 1, **wide
    )
    text = models.Div(text=texts[-1], **wide)

    shared = {"layer": layer, "mission": mission, "text": text, "planned": planned, "paths": paths}
    shared |= {"texts": texts, "looks": looks, "planned_on": _PLANNED_ON, **of_plot}
    update = models.CustomJS(args=shared, code=_UPDATE)
    layer.js_on_change("value", update)
    mission.js_on_change("value", update)

    styles = {"max-width": "900px", "margin": "0 auto", "padding": "0 8px"}
    return column(layer, mission, text, plot, styles=styles, **wide)


def _plot_cells(
    plan: Plan, layers: dict[str, np.ndarray], looks: dict[str, Any]
) -> tuple[Any, dict[str, Any]]:
    """Plot the first layer, with the values of all layers at the pointer.

    Args:
        plan: Plan, whose workspace has the contour lines.
        layers: Maps (row, col), keyed by name.
        looks: Colours and title of each layer that can be selected; see `_looks`.

    Returns:
        The plot, and its parts that change with the layer, keyed by their names in `_UPDATE`.
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

    row, col = np.indices(grid.shape).reshape(2, -1)
    names = [name for name in looks if name in layers]
    columns: dict[str, Any] = {name: values.ravel() for name, values in layers.items()}
    columns |= {"cell_row": row, "cell_col": col, "value": columns[names[0]]}
    columns |= _places(list(zip(row, col, strict=True)), grid)
    cells = models.ColumnDataSource(columns)

    look = looks[names[0]]
    colours = models.LinearColorMapper(**look["colours"], nan_color="#9a9a9a")
    fill: Any = {"field": "value", "transform": colours}
    size: dict[str, Any] = {"width": grid.cell_width, "height": grid.cell_height}
    drawn = plot.rect("x", "y", source=cells, fill_color=fill, line_color=None, **size)

    tips = [("cell", "@cell_row,@cell_col"), ("selected layer", "@value{0.000}")]
    tips += ((name, f"@{{{name}}}{{0.000}}") for name in names)
    plot.add_tools(models.HoverTool(renderers=[drawn], tooltips=tips))

    ground = smooth_ground(plan.workspace)
    if ground is not None:
        plot.contour(*ground, line_color="black", line_alpha=0.25, line_width=0.7)

    bar = models.ColorBar(color_mapper=colours, height=12, title=look["title"])
    plot.add_layout(bar, "below")
    return plot, {"cells": cells, "colours": colours, "bar": bar}


def _layers(plan: Plan, maps: xr.Dataset, history: xr.Dataset) -> dict[str, np.ndarray]:
    """Return maps (row, col), keyed by name; "mission 1" is the trust map of the first mission."""
    workspace = plan.workspace
    layers = {
        str(name).replace("_", " "): shown_values(values, workspace)
        for name, values in maps.data_vars.items()
        if values.ndim == 2
    }
    for i in range(history.sizes["iteration"]):
        mission = history.isel(iteration=i)
        values = shown_values(mission["trust_map"], workspace)
        values[path_in(mission)[0][:2]] = np.nan  # assumed
        layers[f"mission {int(mission['iteration'])}"] = values
    return layers


def _looks(layers: dict[str, np.ndarray], maps: xr.Dataset) -> dict[str, Any]:
    """Return the colours and the title of the colour bar of each layer that can be selected.

    The trust after the last mission and the maps used for planning share one scale.
    """
    from bokeh.palettes import Viridis256

    shared = [name for name in layers if name.startswith(("trust mean", "mission "))]
    of_trust = limits_of(np.stack([layers[name] for name in shared]), is_trust=True)

    looks = {}
    for name in (*(name for name in layers if not name.startswith("mission ")), _PLANNED_ON):
        trusted = name in shared or name == _PLANNED_ON
        low, high = of_trust if trusted else limits_of(layers[name], is_trust=False)
        title = name
        if name in layers:
            title = str(maps[name.replace(" ", "_")].attrs.get("long_name", name))
        if is_trust(name) and high == 1.0:
            title += " (1 or more: unbroken contact)"

        palette = Viridis256 if is_good_high(name) else Viridis256[::-1]
        looks[name] = {"colours": {"palette": palette, "low": low, "high": high}, "title": title}
    return looks


def _draw_plan(plot: Any, plan: Plan) -> None:
    """Plot the recommended path, coloured by sets of posts, and posts and routes on a terrain."""
    from bokeh import models

    grid = plan.workspace.grid
    path = _places(plan.path, grid)
    for colour, width in (("black", 5), ("white", 3)):
        plot.line(**path, color=colour, line_width=width, legend_label="recommended")
    sets = posts_along(plan.stations)
    for i in np.flatnonzero(sets):
        bound = {axis: places[i : i + 2] for axis, places in path.items()}
        look = {"color": COLOURS_OF_SETS[sets[i]], "legend_label": f"{POST_SETS[sets[i]]} posts"}
        plot.line(**bound, line_width=3, **look)
    for k, marker in ((0, "circle"), (-1, "star")):
        look = {"marker": marker, "size": 14, "color": "white", "line_color": "black"}
        plot.scatter([path["x"][k]], [path["y"][k]], **look)

    if plan.posts is None or plan.routes is None:
        return

    names = [POST_SETS[k] for k in sets]
    of_bounds = {"bound": list(range(1, 1 + len(names))), "set": names}
    drawn = []
    for i, (name, colour, marker) in enumerate(robot_looks(plan.workspace.team.names)):
        x, y = (plan.posts[:, i] - grid.corner).T
        routes = [
            route - grid.corner for _, *others in plan.routes if (route := others[i]) is not None
        ]
        look = {"color": colour, "legend_label": f"posts of {name}"}
        shape = _BOKEH_MARKERS.get(marker, "plus")
        posts = models.ColumnDataSource({**of_bounds, "x": x, "y": y, "robot": [name] * len(x)})
        drawn.append(
            plot.scatter("x", "y", source=posts, marker=shape, size=8, line_color="white", **look)
        )
        plot.multi_line([r[:, 0] for r in routes], [r[:, 1] for r in routes], **look)

    tips = [("robot", "@robot"), ("posts", "@set, bound @bound")]
    plot.add_tools(models.HoverTool(renderers=drawn, tooltips=tips, attachment="above"))


def _places(path: Sequence[Station], grid: Grid) -> dict[str, Any]:
    """Return the data source of cells or of a line along a path; see `positions_of`."""
    x, y = positions_of(path, grid).T.tolist()
    return {"x": x, "y": y}


def _text(mission: xr.Dataset, objective: str) -> str:
    """Describe a mission in one line of HTML."""
    value = mission["objective"]
    predicted = f"predicted objective {_measured(value, '.3f')}"
    if objective == "lost_contact":
        lost = _measured(mission["contact_lost"], ".2f")
        predicted = f"contact lost {lost} bounds"
        if np.isfinite(value):
            predicted = f"contact lost {lost}, predicted {-float(value):z.2f} bounds"
    start, goal = (mission[name].item() for name in ("start", "goal"))
    return (
        f"<b>Mission {int(mission['iteration'])}</b>, {start} to {goal} with "
        f"{escape(str(mission['robots'].item()))}: {escape(str(mission['status'].item()))}, "
        f"contact rate {_measured(mission['contact_rate'], '.3f')}, "
        f"plan of {len(path_in(mission)) - 1} bounds, "
        f"{predicted}"
    )


def _measured(value: xr.DataArray, style: str) -> str:
    """Return a quantity of a mission as text, formatted in a style such as ".2f"."""
    return format(value.item(), f"z{style}") if np.isfinite(value) else "not measured"
