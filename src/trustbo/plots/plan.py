"""Maps of each bound of a plan: stops of the lead, posts, sight lines and routes."""

from collections.abc import Iterable, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from trustbo.data import path_text
from trustbo.errors import TrustboError, require_kind, require_list, require_whole
from trustbo.planning import Plan, Ways
from trustbo.plots.maps import (
    draw_contours,
    draw_path,
    draw_places,
    draw_scale,
    extent_of,
    positions_of,
    set_frame,
)
from trustbo.plots.style import (
    GREY,
    ROBOTS,
    add_legend,
    background,
    handles_of,
    ink,
    panels,
    robot_looks,
    styled,
)
from trustbo.workspace import Workspace

_VEGETATION = (0.44, 0.56, 0.39, 0.4)
"""Colour of vegetation: a semi-transparent green for light and dark backgrounds."""
_GROWN = 0.5
"""Minimum height of vegetation above the ground, m."""
_DASHED = (0, (3, 1.5))
"""Line style of the routes between posts."""
_HALF = 0.56
"""Half the width of the map of a bound, relative to what it must show."""
_SMALL = 3.5
"""Size of the posts in the map of the path, in points."""
_WIDTHS = (8.0, 6.5, 5.0, 3.5, 2.2, 1.0)
"""Widths of the lines of ways, in points; later ways are drawn over earlier ones."""
_WAYS_WIDTH = 5.6
"""Width of a new map of ways, in inches."""
_WAYS_LEGEND = 1.3
"""Height of its legend, in inches."""
_LEAST_HALF = 2.0
"""Half the width of a map that shows a single point, m."""


@styled
def plan_map(plan: Plan, *, bounds: Sequence[int] | None = None, ax: Any = None) -> np.ndarray:
    """Plot a map of the path of a plan with the posts of all bounds, and a map of each bound.

    The path is coloured where T2 watches from other sets of posts than the standard one.
    The map of a bound shows the lead's route between its stops, the posts of the other robots with
    their sight lines to the lead's next stop, and the routes to their next posts.

    Args:
        plan: Plan on a terrain, such as `Result.plan()`.
        bounds: Numbers of the bounds to plot, from 1; by default all. `[]` plots only the path.
        ax: Axes to draw on, one for the path and one for each bound; by default a new figure.

    Returns:
        Axes, shape (1 + bound,).

    Raises:
        TrustboError: The workspace has no terrain, or there is no such bound.

    Example:
        >>> tb.plots.plan_map(result.plan(), bounds=[1, 2])
    """
    require_kind("plan", plan, Plan, "give a Plan, such as Result.plan()")
    if plan.stops is None:
        raise TrustboError("plan_map needs a workspace made with Workspace.from_terrain.")
    n_bounds = len(plan.path) - 1
    shown = range(1, n_bounds + 1) if bounds is None else require_list("bounds", bounds)
    for k in shown:
        require_whole("bounds: a number", k, 1, n_bounds)

    size = (2.5, 3.0) if len(shown) else (5.0, 4.4)  # in inches
    axes = panels(1 + len(shown), ax, size)
    for panel in axes:
        draw_ground(panel, plan.workspace)
    draw_path(axes[0], plan.path, plan.workspace.grid)
    axes[0].set_title(f"path of {n_bounds} bounds")
    draw_scale(axes[0])

    for panel, k in zip(axes[1:], shown, strict=True):
        _draw_bound(panel, plan, k)
        ends = (path_text([station]) for station in plan.path[k - 1 : k + 1])
        panel.set_title(f"bound {k}\n{' to '.join(ends)}")

    of_path = handles_of(axes[0])
    _draw_posts(axes[0], plan)
    of_bounds = [*of_path, *_legend(plan.workspace.team.names)]
    handles = of_bounds if len(shown) else handles_of(axes[0])
    add_legend(axes, [*handles, Patch(facecolor=_VEGETATION, label="vegetation")])
    return axes


@styled
def ways_map(ways: Ways, *, ax: Axes | None = None) -> Axes:
    """Plot a map of ways between two cells, with what each of them costs in the legend.

    Where several ways coincide, the first one is drawn broadest.

    Args:
        ways: Ways to plot, such as `Result.ways(start, goal)`.
        ax: Axes to draw on; by default a new figure.

    Example:
        >>> tb.plots.ways_map(result.ways())
    """
    require_kind("ways", ways, Ways, "give ways, such as Result.ways()")
    workspace = ways[0].workspace
    left, right, bottom, top = extent_of(workspace.grid)
    tall = float(np.clip((top - bottom) / (right - left), 0.3, 1.6))
    axes = panels(1, ax, (_WAYS_WIDTH, _WAYS_WIDTH * tall + _WAYS_LEGEND))
    panel = axes[0]
    set_frame(panel, workspace.grid, xticks=[], yticks=[])
    draw_scale(panel)
    if workspace.terrain is not None:
        draw_ground(panel, workspace)
    draw_places(panel, workspace)

    rows: list[dict[str, Any]] = ways.to_frame().to_dict("records")
    looks = zip(rows, ways.plans, cycle(ROBOTS), _WIDTHS, strict=False)
    for k, (row, plan, colour, width) in enumerate(looks):
        places = positions_of(plan.path, workspace.grid)
        label = f"way {k}: {row['name']}".removesuffix(": ")
        label += f"\n{row['contact_lost']:.2f} bounds lost, arrival {row['p_arrive']:.3f}, "
        label += f"{row['metres']:.0f} m"
        panel.plot(*places.T, color=colour, linewidth=width, label=label, zorder=4)

    ends = positions_of([ways[0].start, ways[0].goal], workspace.grid)
    for place, marker in zip(ends, ("o", "*"), strict=True):
        panel.plot(*place, marker, **_filled(ink(), 9.0), zorder=6)
    add_legend(axes, handles_of(panel), columns=2)
    return panel


def draw_ground(ax: Axes, workspace: Workspace) -> None:
    """Draw vegetation and contour lines."""
    terrain = workspace.terrain
    assert terrain is not None  # noqa: S101
    set_frame(ax, workspace.grid, xticks=[], yticks=[])
    grown = np.where((terrain["dsm"] - terrain["dem"]).values > _GROWN, 1.0, np.nan)
    ax.imshow(grown, cmap=ListedColormap([_VEGETATION]), extent=extent_of(workspace.grid))
    draw_contours(ax, workspace, GREY, 0.8)


def _draw_posts(ax: Axes, plan: Plan) -> None:
    """Plot the posts of all bounds as small markers."""
    posts = plan.posts
    assert posts is not None  # noqa: S101
    places = np.swapaxes(posts - plan.workspace.grid.corner, 0, 1)
    looks = robot_looks(plan.workspace.team.names)
    for of_robot, (name, colour, marker) in zip(places, looks, strict=True):
        style = {**_filled(colour, _SMALL), "linestyle": "none", "label": f"posts: {name}"}
        ax.plot(*of_robot.T, marker, **style, zorder=7)


def _draw_bound(ax: Axes, plan: Plan, k: int) -> None:
    """Plot bound k, counted from 1, and its surroundings."""
    stops = plan.stops
    posts = plan.posts
    routes = plan.routes
    assert stops is not None and posts is not None and routes is not None  # noqa: S101, PT018

    grid = plan.workspace.grid
    ends = stops[k - 1 : k + 1] - grid.corner
    places = posts[k - 1] - grid.corner
    lead, *others = [None if route is None else route - grid.corner for route in routes[k - 1]]

    if lead is not None:
        ax.plot(*lead.T, color=ink(), linewidth=2.6, zorder=3)
    ax.plot(*ends.T, "*", **_filled(ink(), 11.0), linestyle="none", zorder=6)

    looks = robot_looks(plan.workspace.team.names)
    for post, route, (_, colour, marker) in zip(places, others, looks, strict=True):
        ax.plot(*np.stack([post, ends[1]]).T, color=colour, linewidth=0.8, zorder=5)
        ax.plot(*post, marker, **_filled(colour), zorder=7)
        if route is not None:
            ax.plot(*route.T, color=colour, linewidth=1.4, linestyle=_DASHED, zorder=4)
            ax.plot(*route[-1], marker, **_open(colour), zorder=6)

    driven = [route for route in (lead, *others) if route is not None]
    _zoom(ax, np.concatenate([ends, places, *driven]), np.array(extent_of(grid)[1::2]))
    draw_scale(ax)


def _zoom(ax: Axes, places: np.ndarray, size: np.ndarray) -> None:
    """Show the surroundings of places (point, 2), within a map of this width and height, m."""
    low = places.min(0)
    high = places.max(0)
    half = _HALF * float((high - low).max()) + _LEAST_HALF

    shown = np.minimum(2.0 * half, size)
    left, bottom = np.clip((low + high - shown) / 2.0, 0.0, size - shown)
    ax.set(xlim=(left, left + shown[0]), ylim=(bottom, bottom + shown[1]))


def _legend(names: Iterable[str]) -> list[Line2D]:
    """Return the legend of the maps of bounds."""
    lead = {"marker": "*", "linewidth": 2.6, "label": "lead: stops, route"}
    lines: list[dict[str, Any]] = [lead | _filled(ink(), 11.0)]
    for name, colour, marker in robot_looks(names):
        robot = {"marker": marker, "linestyle": _DASHED, "label": f"{name}: post, route"}
        lines.append(robot | _filled(colour))

    lines.append({"marker": "o", "linestyle": "none", "label": "next post", **_open(GREY)})
    lines.append({"color": GREY, "linewidth": 0.8, "label": "sight line"})
    return [Line2D([], [], **line) for line in lines]


def _filled(colour: str, size: float = 6.0) -> dict[str, Any]:
    edge = background()
    return {"color": colour, "markersize": size, "markeredgecolor": edge, "markeredgewidth": 0.7}


def _open(colour: str) -> dict[str, Any]:
    return {"markersize": 5.0, "markerfacecolor": background(), "markeredgecolor": colour}
