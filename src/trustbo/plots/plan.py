"""Maps of each bound of a plan: stops of the lead, posts, sight lines and routes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from trustbo.errors import TrustboError, require_kind, require_list, require_whole
from trustbo.planning import Plan
from trustbo.plots.maps import VEGETATION, draw_ground, draw_path, draw_scale, extent_of
from trustbo.plots.style import GREY, MARKERS, ROBOTS, add_legend, background, ink, panels, styled

_DASHED = (0, (3, 1.5))
"""Line style of the routes between posts."""
_HALF = 0.56
"""Half the width of the map of a bound, relative to what it must show."""
_SMALL = 4.0
"""Size of the posts in the map of the path, in points."""
_LEAST_HALF = 2.0
"""Half the width of a map that shows a single point, m."""


@styled
def plan_map(plan: Plan, *, bounds: Sequence[int] | None = None, ax: Any = None) -> np.ndarray:
    """Plot a map of the path of a plan, and a map of each bound.

    The map of a bound shows the lead's route between its stops, the posts of the other robots with
    their sight lines to the lead's next stop, and the routes to their next posts.

    Args:
        plan: Plan on a terrain, such as `Result.plan`.
        bounds: Numbers of the bounds to plot, from 1; by default all. `[]` plots only the
            path, with the posts of all bounds.
        ax: Axes to draw on, one for the path and one for each bound; by default a new figure.

    Returns:
        Axes, shape (1 + bound,).

    Raises:
        TrustboError: The workspace has no terrain, or there is no such bound.

    Example:
        >>> tb.plots.plan_map(result.plan, bounds=[1, 2])
    """
    require_kind("plan", plan, Plan, "give a Plan, such as Result.plan")
    if plan.stops is None:
        raise TrustboError("plan_map needs a workspace made with Workspace.from_terrain.")
    n_bounds = len(plan.path) - 1
    shown = range(1, n_bounds + 1) if bounds is None else require_list("bounds", bounds)
    for k in shown:
        require_whole("bounds: a number", k, 1, n_bounds)

    size = (2.5, 2.6) if len(shown) else (5.0, 4.4)  # in inches
    axes = panels(1 + len(shown), ax, size)
    for panel in axes:
        draw_ground(panel, plan.workspace)
    draw_path(axes[0], plan.path, plan.workspace.grid)
    if not len(shown):
        _draw_posts(axes[0], plan)
    draw_scale(axes[0], plan.workspace.grid)
    axes[0].set_title(f"path of {n_bounds} bounds")

    for panel, k in zip(axes[1:], shown, strict=True):
        _draw_bound(panel, plan, k - 1)
        (a, b), (c, d) = plan.path[k - 1 : k + 1]
        panel.set_title(f"bound {k}\n{a},{b} to {c},{d}")

    names = plan.workspace.team.names
    add_legend(axes, _legend(names) if len(shown) else _legend_of_path(names))
    return axes


def _draw_posts(ax: Axes, plan: Plan) -> None:
    """Plot the posts of all bounds as small markers."""
    posts = plan.posts
    assert posts is not None  # noqa: S101
    for i, positions in enumerate(np.swapaxes(posts - np.array(plan.workspace.grid.corner), 0, 1)):
        style = _filled(ROBOTS[i % len(ROBOTS)], _SMALL)
        ax.plot(*positions.T, MARKERS[i % len(MARKERS)], **style, linestyle="none", zorder=7)


def _draw_bound(ax: Axes, plan: Plan, k: int) -> None:
    """Plot bound k, counted from 0, and its surroundings."""
    stops = plan.stops
    posts = plan.posts
    routes = plan.routes
    assert stops is not None and posts is not None and routes is not None  # noqa: S101, PT018

    corner = np.array(plan.workspace.grid.corner)
    lead, *others = [None if route is None else route - corner for route in routes[k]]
    before, after = stops[k : k + 2] - corner

    if lead is not None:
        ax.plot(*lead.T, color=ink(), linewidth=2.6, zorder=3)

    for i, (post, route) in enumerate(zip(posts[k] - corner, others, strict=True)):
        colour = ROBOTS[i % len(ROBOTS)]
        marker = MARKERS[i % len(MARKERS)]
        ax.plot(*np.stack([post, after]).T, color=colour, linewidth=0.8, zorder=5)
        ax.plot(*post, marker, **_filled(colour), zorder=7)
        if route is not None:
            ax.plot(*route.T, color=colour, linewidth=1.4, linestyle=_DASHED, zorder=4)
            ax.plot(*route[-1], marker, **_open(colour), zorder=6)

    ax.plot(*np.stack([before, after]).T, "*", **_filled(ink(), 11), linestyle="none", zorder=6)

    driven = [route for route in (lead, *others) if route is not None]
    seen = np.concatenate([[before, after], posts[k] - corner, *driven])

    middle = (seen.min(0) + seen.max(0)) / 2.0
    half = _HALF * float(np.ptp(seen, axis=0).max()) + _LEAST_HALF

    left, right, bottom, top = extent_of(plan.workspace.grid)
    ax.set_xlim(*_window(middle[0], half, left, right))
    ax.set_ylim(*_window(middle[1], half, bottom, top))
    draw_scale(ax, plan.workspace.grid)


def _window(middle: float, half: float, low: float, high: float) -> tuple[float, float]:
    """Return the limits of a window around a point, shifted so that it is within the map."""
    width = min(2.0 * half, high - low)
    left = float(np.clip(middle - width / 2.0, low, high - width))
    return left, left + width


def _legend_of_path(names: Sequence[str]) -> list[Line2D | Patch]:
    """Return the legend of the map of the path."""
    white: dict[str, Any] = {"color": "white", "markeredgecolor": "black", "linestyle": "none"}
    handles: list[Line2D | Patch] = [
        Line2D([], [], marker="o", markersize=6, label="start", **white),
        Line2D([], [], marker="*", markersize=11, label="goal", **white),
    ]
    for i, name in enumerate(names):
        marker = MARKERS[i % len(MARKERS)]
        style = _filled(ROBOTS[i % len(ROBOTS)], _SMALL)
        handles.append(
            Line2D([], [], marker=marker, linestyle="none", label=f"posts: {name}", **style)
        )
    return [*handles, Patch(facecolor=VEGETATION, label="vegetation")]


def _legend(names: Sequence[str]) -> list[Line2D | Patch]:
    star = _filled(ink(), 11)
    handles: list[Line2D | Patch] = [
        Line2D([], [], marker="*", linewidth=2.6, label="lead: stops, route", **star)
    ]
    for i, name in enumerate(names):
        marker = MARKERS[i % len(MARKERS)]
        style = _filled(ROBOTS[i % len(ROBOTS)])
        label = f"{name}: post, route"
        handles.append(Line2D([], [], marker=marker, linestyle=_DASHED, label=label, **style))
    return [
        *handles,
        Line2D([], [], marker="o", linestyle="none", label="next post", **_open(GREY)),
        Line2D([], [], color=GREY, linewidth=0.8, label="sight line"),
        Patch(facecolor=VEGETATION, label="vegetation"),
    ]


def _filled(colour: str, size: float = 6.0) -> dict[str, Any]:
    edge = background()
    return {"color": colour, "markersize": size, "markeredgecolor": edge, "markeredgewidth": 0.7}


def _open(colour: str) -> dict[str, Any]:
    return {"markersize": 5.0, "markerfacecolor": background(), "markeredgecolor": colour}
