"""Figures of the interactive page as Bokeh models, which the page's script fills."""

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Colormap, LinearSegmentedColormap, to_hex

from trustbo.planning.plan import QUANTILES
from trustbo.plots.explorer.scene import Scene
from trustbo.plots.maps import COLOURS, contours
from trustbo.plots.plan import COLOURS as ROBOTS
from trustbo.plots.style import LIGHT

MARKERS = ("circle", "square", "diamond", "triangle", "inverted_triangle", "star", "plus", "x")
"""Markers by robot, in Bokeh's names."""
CONTACT = LinearSegmentedColormap.from_list("contact", ["#d55e00", "#ffffff"])
"""Colours of contact rates, from vermilion for the least to white for full contact."""
SHADES = 64
_TOOLS = "pan,wheel_zoom,box_zoom,reset,save"


def load_bokeh() -> tuple[Any, Any]:
    """Import Bokeh, which takes half a second, and return its models and its `figure`."""
    from bokeh import models
    from bokeh.plotting import figure

    return models, figure


def palette(colours: str | Colormap) -> list[str]:
    """Return the colours of a colour map, or of the one with that name, as hexadecimal text."""
    shades = colormaps.get_cmap(colours)(np.linspace(0.0, 1.0, SHADES))
    return [to_hex(colour) for colour in shades]


def robot_marks(n: int) -> list[tuple[str, str]]:
    """Return marker and colour of each robot."""
    return [(MARKERS[i % len(MARKERS)], ROBOTS[i % len(ROBOTS)]) for i in range(n)]


def draw_map(scene: Scene) -> Any:
    """Make the figure of the map: cells under contour lines, the path, posts, and what is chosen.

    The page's script sets its height, so that the map has its proportions at any width.
    Its sources are named `cells` (x, y, value), `bounds` (x0, y0, x1, y1, contact), `ends` (x, y,
    marker, size), `posts` (x, y, marker, colour), `overwatch` (x, y, seen, width, height), `cell`
    (x, y), `bound` (x0, y0, x1, y1) and `sight` (the same, colour); its colours `colours` and
    `contact`.
    """
    models, figure = load_bokeh()
    grid = scene.workspace.grid
    size = {"width": grid.cell_width, "height": grid.cell_height}
    plot = figure(
        name="map", sizing_mode="stretch_width", tools=_TOOLS,
        active_drag=None, active_scroll=None, toolbar_location="above", match_aspect=True,
        x_range=models.DataRange1d(range_padding=0.0),
        y_range=models.DataRange1d(range_padding=0.0),
        x_axis_label="east (m)", y_axis_label="north (m)",
    )  # fmt: skip
    cells = _source("cells", x=[], y=[], value=[])
    mapper = models.LinearColorMapper(name="colours", palette=palette(COLOURS), low=0.0, high=1.0)
    mapper.nan_color = LIGHT.closed
    field = {"field": "value", "transform": mapper}
    drawn = plot.rect("x", "y", source=cells, fill_color=field, line_color=field, **size)
    plot.x_range.renderers = plot.y_range.renderers = [drawn]
    _draw_overwatch(plot)
    _draw_relief(plot, scene)
    _draw_path(plot)
    focus = {"fill_color": None, "line_color": "#ffffff", "line_width": 2}
    shadow = focus | {"line_color": "#000000", "line_width": 4}
    chosen = _source("cell", x=[], y=[])
    for style in (shadow, focus):
        plot.rect("x", "y", source=chosen, **size, **style)
    bar = models.ColorBar(color_mapper=mapper, height=12, padding=4, background_fill_color=None)
    plot.add_layout(bar, "below")
    return _plain(plot)


def _draw_overwatch(plot: Any) -> None:
    """Draw the share of the lead's way that one would see from points around its stop."""
    models, _ = load_bokeh()
    points = _source("overwatch", x=[], y=[], seen=[], width=[], height=[])
    shares = models.LinearColorMapper(palette=palette("gray"), low=0.0, high=1.0)
    colour = {"field": "seen", "transform": shares}
    plot.rect(
        "x", "y", "width", "height", source=points, fill_color=colour, line_color=None,
        fill_alpha=0.85, name="overwatch map", visible=False,
    )  # fmt: skip


def _draw_path(plot: Any) -> None:
    """Draw the bounds in the colours of contact, the posts, and the chosen bound's sight lines."""
    models, _ = load_bokeh()
    ends = {"x0": "x0", "y0": "y0", "x1": "x1", "y1": "y1"}
    bounds, bound, sight = (
        _source(name, **{axis: [] for axis in ends}, **more)
        for name, more in (("bounds", {"contact": []}), ("bound", {}), ("sight", {"colour": []}))
    )
    contact = models.LinearColorMapper(name="contact", palette=palette(CONTACT), low=0.0, high=1.0)
    contact.nan_color = "#ffffff"
    colour = {"field": "contact", "transform": contact}
    plot.segment(**ends, source=bound, line_color="#ffe600", line_width=17, line_cap="round")
    plot.segment(**ends, source=sight, line_color="#ffffff", line_width=3)
    plot.segment(**ends, source=sight, line_color="colour", line_width=1.6)
    plot.segment(**ends, source=bounds, line_color="#000000", line_width=7, line_cap="round")
    plot.segment(**ends, source=bounds, line_color=colour, line_width=4, line_cap="round")
    posts = _source("posts", x=[], y=[], marker=[], colour=[])
    plot.scatter(
        "x", "y", source=posts, marker="marker", fill_color="colour", line_color="#ffffff",
        line_width=0.7, size=7, name="post marks",
    )  # fmt: skip
    stops = _source("ends", x=[], y=[], marker=[], size=[])
    plot.scatter(
        "x", "y", source=stops, marker="marker", size="size", fill_color="#ffffff",
        line_color="#000000", line_width=1.2,
    )  # fmt: skip


def draw_chart(scene: Scene) -> Any:
    """Make the figure of trust along the path, with the measured contact.

    Its sources are named `trust` (bound, q0, ..., q4), `rates` (bound, rate, marker, colour) and
    `chosen` (bound).
    """
    models, figure = load_bokeh()
    seen = np.concatenate([np.r_[s.trust.ravel(), s.contact.ravel()] for s in scene.steps])
    low, high = float(np.nanmin(seen)), float(np.nanmax(seen))
    margin = 0.06 * max(high - low, 0.05)
    longest = max(len(step.path) - 1 for step in scene.steps)
    plot = figure(
        name="chart", height=290, sizing_mode="stretch_width", tools="save", toolbar_location=None,
        x_range=models.Range1d(0.4, longest + 0.6),
        y_range=models.Range1d(low - margin, high + margin),
        x_axis_label="bound", y_axis_label="trust, contact rate",
    )  # fmt: skip
    every = -(-longest // 14)
    plot.xaxis.ticker = models.FixedTicker(ticks=list(range(1, longest + 1, every)))
    chosen = _source("chosen", bound=[])
    plot.vspan("bound", source=chosen, line_color="#e0b400", line_width=10, line_alpha=0.45)
    trust = _source("trust", bound=[], **{f"q{i}": [] for i in range(len(QUANTILES) + 1)})
    for inner, outer, alpha in (("q0", "q4", 0.35), ("q1", "q3", 0.6)):
        plot.varea("bound", inner, outer, source=trust, fill_color=LIGHT.inner, fill_alpha=alpha)
    plot.line("bound", "q2", source=trust, line_width=2, name="median")
    rates = _source("rates", bound=[], rate=[], marker=[], colour=[])
    plot.scatter(
        "bound", "rate", source=rates, marker="marker", fill_color="colour", line_color="#ffffff",
        line_width=0.7, size=8,
    )  # fmt: skip
    return _plain(plot)


def _draw_relief(plot: Any, scene: Scene) -> None:
    """Draw the contour lines of the terrain, where there is one."""
    lines = contours(scene.workspace)
    if lines:
        xs, ys = ([line[:, axis].round(1).tolist() for line in lines] for axis in (0, 1))
        plot.multi_line(
            xs, ys, line_color="#000000", line_alpha=0.25, line_width=0.7, name="relief"
        )


def _source(name: str, **columns: Any) -> Any:
    return load_bokeh()[0].ColumnDataSource(columns, name=name)


def _plain(plot: Any) -> Any:
    """Remove frames and colours that the page's style sets."""
    plot.toolbar.logo = None
    plot.background_fill_color = plot.border_fill_color = plot.outline_line_color = None
    plot.grid.visible = plot.name == "chart"
    plot.xgrid.visible = False
    plot.axis.minor_tick_line_color = None
    plot.axis.axis_label_text_font_style = "normal"
    plot.axis.axis_label_text_font_size = plot.axis.major_label_text_font_size = "12px"
    return plot
