"""Draw the paper's figures 1 to 4a in our terms, for docs/paper.md.

The bound and the cloud are of the hillside in the package; overwatch and loop are diagrams.
"""

from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from docs_figures import arrow, box, draw
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

import trustbo as tb
from trustbo.plots.layout import MARKERS
from trustbo.plots.maps import VEGETATION, draw_relief, draw_scale
from trustbo.plots.plan import COLOURS
from trustbo.plots.style import theme

mpl.use("Agg")
PATH = [(5, 0), (4, 0), (3, 1), (3, 2), (2, 3), (1, 3), (0, 4), (0, 5)]
WIDE = {"fontsize": 10.5, "ha": "center", "va": "center"}


def main() -> None:
    """Draw them all."""
    draw("paper_overwatch", [], overwatch)
    draw("paper_loop", [], loop)
    terrain = tb.terrain.example()
    team = tb.Team(n_robots=3)
    workspace = tb.Workspace.from_terrain(terrain, (10, 10), team)
    plan = tb.Campaign(workspace, (9, 0), (0, 9)).ask()
    draw("paper_bound", [], lambda: bound(plan, 5))
    draw("paper_cloud", [], lambda: cloud(terrain))


def overwatch() -> Figure:
    """Cells, the path, the lead in its next cell and the subteam that watches it: Fig. 1."""
    figure, ax = plt.subplots(figsize=(5.4, 3.9), layout="constrained")
    for row in range(6):
        for col in range(6):
            ax.add_patch(
                Rectangle((col, row), 1, 1, facecolor="none", edgecolor=theme().quiet, alpha=0.6)
            )
    x, y = (np.array(PATH)[:, ::-1] + 0.5).T
    ax.plot(x[:4], y[:4], color=theme().quiet, linewidth=2)
    ax.plot(x[3:], y[3:], color=theme().quiet, linewidth=2, linestyle=(0, (3, 2)))
    (lead_x, lead_y), (own_x, own_y) = (x[4], y[4]), (x[3], y[3])
    for (dx, dy), colour, marker in zip(
        [(-0.28, 0.22), (0.0, -0.3), (0.27, 0.25)], COLOURS, MARKERS, strict=False
    ):
        ax.plot([own_x + dx, lead_x], [own_y + dy, lead_y], color=colour, linewidth=1)
        ax.plot(
            own_x + dx,
            own_y + dy,
            marker,
            color=colour,
            markersize=9,
            markeredgecolor=theme().paper,
        )
    ax.plot(lead_x, lead_y, "*", color=theme().ink, markersize=17, markeredgecolor=theme().paper)
    ax.annotate("subteam T2 stands\nand watches", (own_x + 0.1, own_y + 0.42), (2.2, 5.0), **note())
    ax.annotate("lead T1 bounds\nto the next cell", (lead_x + 0.2, lead_y), (4.95, 2.5), **note())
    ax.text(x[0], y[0] + 0.32, "start", **WIDE)
    ax.text(x[-1], y[-1] - 0.3, "goal", **WIDE)
    ax.plot(x[[0, -1]], y[[0, -1]], "o", color=theme().quiet, markersize=7)
    ax.set(xlim=(-0.05, 6.05), ylim=(6.05, -0.05), aspect="equal")
    ax.axis("off")
    return figure


def note() -> dict[str, Any]:
    """Style of a note with a line to what it names."""
    box = {"facecolor": theme().paper, "edgecolor": theme().quiet, "boxstyle": "round,pad=0.3"}
    return {
        "fontsize": 10, "ha": "center", "va": "center", "bbox": box,
        "arrowprops": {"arrowstyle": "-", "color": theme().quiet},
    }  # fmt: skip


BOXES = {
    "terrain": ((0.0, 1.5), "terrain: DEM and DSM,\nor a point cloud", "terrain.read_terrain"),
    "awareness": ((3.4, 1.5), "awareness $Z$\nof cells, or of bounds", "Workspace.from_terrain"),
    "plan": ((6.8, 1.5), "most trustworthy path\nunder the belief, by (6)", "Campaign.ask"),
    "mission": ((6.8, 0.0), "mission, bound by bound:\ncontact rates $Y$", "simulator.run"),
    "belief": ((3.4, 0.0), r"belief $p(\theta \mid Y, Z)$" + "\nby (3), (4), (5)", "Campaign.tell"),
    "prior": ((0.0, 0.0), r"prior $p(\theta)$" + "\nbefore any mission", "models.Priors"),
}  # fmt: skip
ARROWS = [
    ("terrain", "awareness"),
    ("awareness", "plan"),
    ("plan", "mission"),
    ("mission", "belief"),
    ("prior", "belief"),
    ("belief", "plan"),
    ("awareness", "belief"),
]
WIDTH, HEIGHT = 2.7, 0.95


def loop() -> Figure:
    """The iteration of Fig. 2, with our names."""
    figure, ax = plt.subplots(figsize=(8.4, 2.9), layout="constrained")
    for corner, text, name in BOXES.values():
        box(ax, corner, (WIDTH, HEIGHT), text, name)
    for start, end in ARROWS:
        arrow(ax, *_sides(start, end))
    ax.set(xlim=(-0.1, 9.6), ylim=(-0.1, 2.55), aspect="equal")
    ax.axis("off")
    return figure


def _sides(start: str, end: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Points of two boxes between which an arrow is drawn."""
    (x, y), (u, v) = BOXES[start][0], BOXES[end][0]
    if y == v:
        side = u > x
        return (x + WIDTH * side, y + HEIGHT / 2), (u + WIDTH * (not side), v + HEIGHT / 2)
    up = v > y
    if x == u:
        return (x + WIDTH / 2, y + HEIGHT * up), (u + WIDTH / 2, v + HEIGHT * (not up))
    return (x + WIDTH, y + HEIGHT), (u, v)


def bound(plan: tb.planning.Plan, k: int) -> Figure:
    """The two phases of a bound, with posts, ways and sight lines: Fig. 3."""
    figure, axes = plt.subplots(1, 2, figsize=(8.4, 4.4), layout="constrained")
    corner = np.array(plan.workspace.grid.corner)
    stops = plan.waypoints[k : k + 2] - corner
    lead, *closing = [None if way is None else way - corner for way in plan.ways[k]]
    posts, after = plan.posts[k] - corner, plan.posts[k + 1] - corner
    for ax, title in zip(
        axes, ("1: the lead bounds, T2 watches", "2: T2 closes up, the lead watches"), strict=True
    ):
        _ground(ax, plan, np.concatenate([stops, posts, after, lead]))
        ax.set_title(title, fontsize=10)
    first, second = axes
    ink, paper = theme().ink, theme().paper
    first.plot(*lead.T, color=ink, linewidth=2.5)
    first.plot(*stops[0], "*", color=paper, markersize=15, markeredgecolor=ink)
    for ax, lead_at in ((first, stops[1]), (second, stops[1])):
        ax.plot(*lead_at, "*", color=ink, markersize=16, markeredgecolor=paper, zorder=6)
    for i, (post, way, then) in enumerate(zip(posts, closing, after, strict=True)):
        colour, marker = COLOURS[i], MARKERS[i]
        here = {"color": colour, "markersize": 9, "markeredgecolor": paper, "zorder": 7}
        first.plot(*np.stack([post, stops[1]]).T, color=colour, linewidth=1)
        first.plot(*post, marker, **here)
        second.plot(*way.T, color=colour, linewidth=1.8, linestyle=(0, (3, 1.5)))
        second.plot(*np.stack([then, stops[1]]).T, color=colour, linewidth=0.8)
        second.plot(*post, marker, **{**here, "color": paper, "markeredgecolor": colour})
        second.plot(*then, marker, **here, label=f"{plan.workspace.team.names[i]}")
    second.plot([], [], "*", color=ink, markersize=12, label="lead")
    figure.legend(loc="outside lower center", ncols=4, fontsize=9, frameon=False)
    return figure


def _ground(ax: Axes, plan: tb.planning.Plan, seen: np.ndarray) -> None:
    """Draw contour lines, tall vegetation and the borders of cells around points."""
    terrain, grid = plan.workspace.terrain, plan.workspace.grid
    x = terrain["x"].values - grid.corner[0]
    y = terrain["y"].values - grid.corner[1]
    grown = (terrain["dsm"] - terrain["dem"]).values
    ax.set_facecolor(theme().ground)
    ax.contourf(x, y, grown, levels=[3.0, 60.0], colors=[VEGETATION])
    draw_relief(ax, plan.workspace, colour=theme().contour, opacity=1.0)
    for col in range(grid.shape[1] + 1):
        ax.axvline(col * grid.cell_width, color=theme().quiet, linewidth=0.8, linestyle=":")
    for row in range(grid.shape[0] + 1):
        ax.axhline(row * grid.cell_height, color=theme().quiet, linewidth=0.8, linestyle=":")
    low, high = seen.min(0), seen.max(0)
    half, middle = 0.58 * (high - low).max() + 2.0, (low + high) / 2.0
    ax.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
    ax.set(aspect="equal", xticks=[], yticks=[])
    draw_scale(ax, grid, width=2.0 * half)


def cloud(terrain) -> Figure:
    """Highest points of a survey by lidar, one a square metre: Fig. 4a."""
    figure = plt.figure(figsize=(6.4, 4.0))
    ax = figure.add_axes((0.0, 0.0, 0.84, 1.0), projection="3d")
    top, ground = terrain["dsm"].values, terrain["dem"].values
    x, y = np.meshgrid(terrain["x"].values, terrain["y"].values)
    known = np.isfinite(top)
    x, y = (a[known] - a[known].min() for a in (x, y))
    points = ax.scatter(
        x, y, top[known], c=(top - ground)[known], s=1.2, cmap="viridis", linewidths=0, vmax=30
    )
    ax.set_box_aspect((np.ptp(x), np.ptp(y), np.ptp(top[known])), zoom=0.92)
    ax.view_init(28, -62)
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.set_pane_color(theme().ground)
    ax.set(xlabel="east (m)", ylabel="north (m)", zlabel="height (m)")
    ax.set(xticks=[0, 100, 200], yticks=[0, 100], zticks=[450, 550, 650])
    ax.tick_params(labelsize=9, pad=0)
    bar = figure.colorbar(points, cax=figure.add_axes((0.88, 0.2, 0.022, 0.6)), extend="max")
    bar.set_label("height above the ground (m)", fontsize=9)
    return figure


if __name__ == "__main__":
    main()
