"""A plan on its terrain, bound by bound: stops of the lead, posts of T2, sight lines and ways."""

from collections.abc import Sequence
from typing import Any, Unpack

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from trustbo.errors import TrustboError, require_kind
from trustbo.planning import Plan
from trustbo.plots.layout import MARKERS, as_text, extent_of, small_multiples
from trustbo.plots.maps import VEGETATION, draw_ground, draw_path, draw_scale
from trustbo.plots.style import Style, StyleOptions, theme

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
"""Colours of Okabe and Ito (2008), by robot; in grey, markers distinguish robots."""
_SHARE = Normalize(0.0, 1.0)
_DASHED = (0, (3, 1.5))
_ROOM = (0.5, 0.2)
"""Room of a scale bar in its corner, shares of the axes."""


def plan_map(
    plan: Plan,
    *,
    bounds: Sequence[int] | None = None,
    overwatch: str | None = None,
    **style: Unpack[StyleOptions],
) -> np.ndarray:
    """Draw what robots are to do, an overview of the path, then each bound.

    Of a bound, the lead's way between its stops, T2's posts with their sight lines to where the
    lead stops, and the ways on which T2 then closes up to its next posts (hollow). Vegetation is
    grey; each panel has a separate scale.

    Args:
        plan: Plan on a terrain in memory, such as `Result.plan`.
        bounds: Numbers of the bounds to draw, from 1; by default all.
        overwatch: Name of a robot: colours below each bound show how much of the lead's way it
            would see from each place, see `Workspace.overwatch_map`.
        **style: Options of `Style`.

    Returns:
        Axes, shape (1 + bound,).

    Raises:
        TrustboError: The workspace has no terrain in memory, or there is no such bound or robot.
    """
    require_kind("plots.plan_map", plan, Plan, "give a Plan, such as Result.plan or campaign.ask()")
    options = Style.from_options(style)
    if plan.stops is None:
        raise TrustboError(
            "plan_map needs a plan on a workspace made with Workspace.from_terrain of a terrain in "
            "memory."
        )
    n_bounds = len(plan.path) - 1
    shown = list(range(1, n_bounds + 1)) if bounds is None else list(bounds)
    if not set(shown) <= set(range(1, n_bounds + 1)):
        raise TrustboError(f"bounds must be some of 1..{n_bounds}; got {bounds!r}.")
    made = small_multiples(1 + len(shown), (2.5, 2.5), options)
    whole, *others = made.panels
    titles = [f"path of {n_bounds} bounds"]
    for ax in made.panels:
        draw_ground(ax, plan.workspace, "dem")
    draw_path(whole, plan.path, plan.workspace.grid)
    draw_scale(whole, plan.workspace.grid)
    for ax, k in zip(others, shown, strict=True):
        (a, b), (c, d) = plan.path[k - 1 : k + 1]
        titles.append(f"bound {k}: {a},{b} to {c},{d}")
        if overwatch is not None:
            _draw_overwatch(ax, plan, k - 1, overwatch, options)
        _draw_bound(ax, plan, k - 1)
    made.titles(titles)
    made.legend(_keys(plan.workspace.team.names))
    if overwatch is not None and shown:
        label = f"share of the lead's way that {as_text(overwatch)} sees"
        made.colour_bar(ScalarMappable(_SHARE, options.colours()), label)
    return made.panels


def _draw_overwatch(ax: Axes, plan: Plan, k: int, robot: str, options: Style) -> None:
    """Draw how much of the lead's way in the bound of index k a robot would see from each place."""
    seen = plan.workspace.overwatch_map((plan.path[k], plan.path[k + 1]), robot=robot)
    if seen is not None:
        left, bottom = plan.workspace.grid.corner
        x, y = seen["x"].values - left, seen["y"].values - bottom
        colours = {"cmap": options.colours(), "norm": _SHARE, "zorder": 1.5, "rasterized": True}
        ax.pcolormesh(x, y, seen.values, shading="nearest", alpha=0.85, **colours)


def _draw_bound(ax: Axes, plan: Plan, k: int) -> None:
    """Draw the bound of index k, and show what is around it."""
    lead_stops, posts, ways = plan.stops, plan.posts, plan.ways
    assert lead_stops is not None and posts is not None and ways is not None  # noqa: S101, PT018
    corner = np.array(plan.workspace.grid.corner)
    lead, *closing = [None if way is None else way - corner for way in ways[k]]
    stops = lead_stops[k : k + 2] - corner
    seen = [stops, posts[k] - corner, *(way for way in (lead, *closing) if way is not None)]
    if lead is not None:
        ax.plot(*lead.T, color=theme().ink, linewidth=2.6, zorder=3)
    for i, (post, way) in enumerate(zip(posts[k] - corner, closing, strict=True)):
        colour, marker = COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)]
        if way is not None:
            ax.plot(*way.T, color=theme().paper, linewidth=2.2, zorder=4)
            ax.plot(*way.T, color=colour, linewidth=1.4, linestyle=_DASHED, zorder=4)
            ax.plot(*way[-1], marker, **_open(colour), zorder=6, clip_on=False)
        ax.plot(*np.stack([post, stops[1]]).T, color=colour, linewidth=0.8, zorder=5)
        # A post on the edge of the raster is drawn whole.
        ax.plot(*post, marker, **_filled(colour), zorder=7, clip_on=False)
    ax.plot(*stops.T, "*", **_filled(theme().ink, 11), linestyle="none", zorder=6, clip_on=False)
    low, high = (f(np.concatenate(seen), axis=0) for f in (np.min, np.max))
    half = 0.56 * float((high - low).max()) + 2.0
    left, right, bottom, top = extent_of(plan.workspace.grid)
    x, width = _window((low + high)[0] / 2.0, half, left, right)
    y, height = _window((low + high)[1] / 2.0, half, bottom, top)
    ax.set(xlim=(x, x + width), ylim=(y, y + height))
    corner = _free_corner((np.concatenate(seen) - (x, y)) / (width, height))
    draw_scale(ax, plan.workspace.grid, width=width, corner=corner)


def _free_corner(points: np.ndarray) -> tuple[int, int]:
    """Corner of the axes (right, upper) with the fewest of points (point, 2), in axes' units."""

    def n_points(corner: tuple[int, int]) -> int:
        return int((np.abs(points - corner) < _ROOM).all(1).sum())

    return min(((1, 0), (0, 0), (1, 1), (0, 1)), key=n_points)


def _window(middle: float, half: float, low: float, high: float) -> tuple[float, float]:
    """Left end and width of a window around a point, shifted into the map."""
    width = min(2.0 * half, high - low)
    return float(np.clip(middle - width / 2.0, low, high - width)), width


def _keys(names: Sequence[str]) -> list[Line2D | Patch]:
    black, colours = _filled(theme().ink, 11), theme()
    handles: list[Line2D | Patch] = [
        Line2D([], [], marker="*", linewidth=2.6, label="lead: stops, way", **black)
    ]
    for i, name in enumerate(names):
        marker, style = MARKERS[i % len(MARKERS)], _filled(COLOURS[i % len(COLOURS)])
        label = f"{as_text(name)}: post, way"
        handles.append(Line2D([], [], marker=marker, linestyle=_DASHED, label=label, **style))
    return [
        *handles,
        Line2D([], [], marker="o", linestyle="none", label="next post", **_open(colours.quiet)),
        Line2D([], [], color=colours.quiet, linewidth=0.8, label="sight line"),
        Patch(facecolor=VEGETATION, label="vegetation"),
    ]


def _filled(colour: str, size: float = 6.0) -> dict[str, Any]:
    edge = theme().paper
    return {"color": colour, "markersize": size, "markeredgecolor": edge, "markeredgewidth": 0.7}


def _open(colour: str) -> dict[str, Any]:
    return {"markersize": 5.0, "markerfacecolor": theme().paper, "markeredgecolor": colour}
