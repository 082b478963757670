"""Draw the figures of the documentation, except `demo.png`, which `scripts/demo.py` draws.

    python scripts/figures.py [--out docs/figures]

Some pages have figures of their examples. "Trust of one robot at one place", "Change a prior",
"Your own model" and "Run a study in parallel" draw their own; those of "Planning", "Trust models"
and "Several courses on one ground" are drawn here.
"""

import argparse
import contextlib
import re
import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle

import trustbo as tb
from trustbo.plots.maps import draw_scale
from trustbo.plots.plan import draw_ground
from trustbo.plots.style import GREY, RC, outlined, robot_looks

DOCS = Path(__file__).resolve().parents[1] / "docs"
EXAMPLE = DOCS / "howto" / "trust-of-one-robot-at-one-place.md"
PRIOR = DOCS / "howto" / "change-a-prior.md"
FUNCTION = DOCS / "howto" / "your-own-model.md"
COURSES = DOCS / "howto" / "several-courses.md"
MODELS = DOCS / "models.md"
STUDY = DOCS / "howto" / "run-a-study-in-parallel.md"
PLANNING = DOCS / "planning.md"
START, GOAL = (9, 0), (0, 9)
BOUND = 11
"""Number of the bound of the first plan that is drawn, from 1."""
ASPECT = 0.75
"""Height of the map of a bound, divided by its width."""
PATH = [(5, 0), (4, 0), (3, 1), (3, 2), (2, 3), (1, 3), (0, 4), (0, 5)]
"""Cells of the path in the sketch of overwatch."""
REACHED = 3
"""Index of the cell in which T2 stands in the sketch."""
POSTS = np.array([(-0.3, -0.3), (-0.1, 0.25), (0.35, 0.3)])
"""Posts in the sketch, from the centre of that cell, as fractions of a cell."""
LOOKS = (("tab:red", "-"), ("black", "--"), ("tab:blue", "-."))
"""Colour and style of the path by each objective."""
LEAST = 1e-3
"""Least probability of a threat on the colour scale."""
DASHED = (0, (3, 1.5))
OUTLINE = outlined(3.4, "white")


def main() -> None:
    """Draw and save all figures."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=DOCS / "figures")
    out = parser.parse_args().out.resolve()
    out.mkdir(parents=True, exist_ok=True)

    mpl.use("agg")
    terrain = tb.terrain.example()
    with mpl.rc_context({**RC, "font.size": 9.0, "legend.fontsize": 9.0}):
        workspace = tb.Workspace.from_terrain(terrain, shape=(10, 10))
        plan = tb.Campaign(workspace, START, GOAL).ask()  # warns that failure is likely
        save(bound(plan), out / "paper_bound.png")
        save(overwatch(), out / "paper_overwatch.png")
        save(cloud(terrain), out / "paper_cloud.png")

    with tempfile.TemporaryDirectory() as folder:  # examples write other files, too
        for page in (EXAMPLE, PRIOR, FUNCTION, STUDY):  # each saves one picture
            run_example(page, Path(folder))
        for picture in Path(folder).glob("*.png"):
            shutil.copy(picture, out)
            print(f"the picture is in {out / picture.name}")

        of_courses = run_example(COURSES, Path(folder))
        of_models = run_example(MODELS, Path(folder))
        of_planning = run_example(PLANNING, Path(folder))
        with mpl.rc_context({**RC, "font.size": 9.0, "legend.fontsize": 9.0}):
            save(courses(of_courses), out / "several_courses.png")
            save(places(of_models), out / "place_effects.png")
            save(objectives(of_planning), out / "objectives.png")
            save(threat(of_planning), out / "threat.png")


def run_example(page: Path, folder: Path) -> dict[str, Any]:
    """Run the examples of a page in a folder; return the names that they define."""
    code = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    names: dict[str, Any] = {}
    with contextlib.chdir(folder):
        exec("\n".join(code), names)
    return names


def save(figure: Figure, file: Path) -> None:
    """Save a figure at the size at which pages show it."""
    figure.savefig(file, dpi=110, facecolor="white")
    print(f"the picture is in {file}")


def courses(names: dict[str, Any]) -> Figure:
    """Draw paths of two courses, and trust before and after the missions on the first course."""
    workspace, campaign, ends = names["workspace"], names["campaign"], (names["A"], names["B"])
    new = tb.Campaign(workspace)
    first = [new.plan(*course).path for course in ends]
    driven = [mission.path for mission in campaign.missions[:6]]
    n_first = sum(path[0] == ends[0][0] for path in driven)
    planner = tb.Planner(workspace, *ends[0])
    beliefs = new.belief, campaign.posteriors[n_first - 1]

    figure, axes = plt.subplots(1, 2, figsize=(7.6, 4.1), layout="compressed")
    for ax, belief, paths in zip(axes, beliefs, (first, driven), strict=True):
        trust = planner.robot_maps(belief)["trust_mean"].mean("robot")
        label = "" if paths is first else "mean trust in r1, r2 and r3"
        tb.plots.cell_map(trust, workspace, limits=(0.1, 1.0), label=label, ax=ax)
        centre = workspace.grid.center(names["shared"]) - np.array(workspace.grid.corner)
        look = {"ec": "white", "ls": ":", "lw": 1.5, "path_effects": outlined(3.0, "dimgrey")}
        ax.add_patch(Circle(centre, names["jammer"].radius, fill=False, **look))
        for path in paths:
            k = int(path[0] != ends[0][0])
            style = "--" if paths is first else "-"
            draw_path(ax, path, workspace, ("tab:red", "black")[k], style, f"course {'AB'[k]}")

    axes[0].set_title("before the first mission, with plans")
    axes[1].set_title("after four missions on A, with driven paths")
    handles, labels = axes[1].get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(unique.values(), unique, loc="outside lower center", ncols=2)
    return figure


def places(names: dict[str, Any]) -> Figure:
    """Draw the effect of a hollow and its estimates, in the bounds that were driven."""
    workspace, place, s, e = (names[name] for name in ("workspace", "place", "s", "e"))
    north, east = tb.workspace.MOVES.index((-1, 0)), tb.workspace.MOVES.index((0, 1))
    driven = np.concatenate([e[north, :-1], e[east, -1:]])
    driven[-1, 0] = np.nan  # where all missions start
    shown = {"true effect": place[0], "estimate of $s$": s, "estimate of $s + e$": s + driven}

    figure, axes = plt.subplots(1, 3, figsize=(7.6, 2.6), sharey=True, layout="compressed")
    for ax, (title, values) in zip(axes, shown.items(), strict=True):
        cells = xr.DataArray(values, dims=("row", "col"))
        tb.plots.cell_map(cells, workspace, limits=(-0.3, 0.0), label="", ax=ax)
        ax.set_title(title)
        hollow = np.unravel_index(place[0].argmin(), place[0].shape)
        centre = workspace.grid.center(hollow) - np.array(workspace.grid.corner)
        look = {"color": "white", "fontsize": 8.0, "ha": "center", "va": "center"}
        ax.text(*centre, f"{values[hollow]:.2f}", **look, path_effects=outlined(1.4, "black"))
    figure.colorbar(axes[0].images[0], ax=list(axes), label="effect on the drift")
    return figure


def objectives(names: dict[str, Any]) -> Figure:
    """Draw the best path by each objective on a map of the predicted trust."""
    workspace = names["hill"]
    trust = tb.Planner(workspace, START, GOAL).robot_maps(names["known"])["trust_mean"]
    figure, ax = plt.subplots(figsize=(5.8, 4.2), layout="compressed")
    tb.plots.cell_map(trust.mean("robot"), workspace, label="mean predicted trust", ax=ax)

    for (name, plan), (colour, style) in zip(names["plans"].items(), LOOKS, strict=True):
        draw_path(ax, plan.path, workspace, colour, style, label=name)
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def threat(names: dict[str, Any]) -> Figure:
    """Draw the probability of a threat in each cell, and the next path, before and after it."""
    workspace, jam = names["plain"], names["jam"]
    maps = [one["probability"].sum("reach") for one in names["threats"][-2:]]
    paths = names["driven"].path, names["campaign"].ask().path
    titles = "after mission 3, before the jammer", "after mission 4, with the jammer"

    figure, axes = plt.subplots(1, 2, figsize=(7.6, 2.9), layout="compressed")
    for ax, values, path, title in zip(axes, maps, paths, titles, strict=True):
        tb.plots.cell_map(values, workspace, label="", cmap="Reds", ax=ax)
        ax.images[0].set_norm(LogNorm(LEAST, 1.0, clip=True))
        draw_path(ax, path, workspace, "black", "-")
        centre = np.array(jam.center) - workspace.grid.corner
        look = {"ec": "black", "ls": ":", "lw": 1.5, "path_effects": OUTLINE}
        ax.add_patch(Circle(centre, jam.radius, fill=False, zorder=4, **look))
        ax.set_title(title)
    figure.colorbar(axes[1].images[0], ax=axes, extend="min", label="probability of a threat")
    return figure


def draw_path(
    ax: Axes, path: Iterable[Any], workspace: tb.Workspace, colour: str, style: Any, label: str = ""
) -> None:
    """Draw a path through the centres of cells, from a circle to a star."""
    places = np.array([workspace.grid.center(cell) for cell in path]) - workspace.grid.corner
    look = {"color": colour, "zorder": 5, "path_effects": OUTLINE}
    ax.plot(*places.T, linestyle=style, lw=2.0, label=label, **look)
    ax.plot(*places[0], "o", ms=6, **look)
    ax.plot(*places[-1], "*", ms=10, **look)


def bound(plan: tb.planning.Plan, k: int = BOUND) -> Figure:
    """Draw both phases of a bound: the lead moves while T2 watches, and T2 closes up."""
    figure, axes = plt.subplots(1, 2, figsize=(7.6, 3.4), layout="constrained")
    corner = plan.workspace.grid.corner
    lead, *others = (route - corner for route in plan.routes[k - 1])
    posts, then = plan.posts[k - 1 : k + 1] - corner
    shown = np.concatenate([lead, posts, then])
    middle = (shown.min(0) + shown.max(0)) / 2.0
    wide, tall = np.ptp(shown, axis=0)
    half = 0.58 * max(wide, tall / ASPECT) * np.array([1.0, ASPECT])
    (left, bottom), (right, top) = middle - half, middle + half

    titles = "1. the lead moves, T2 watches", "2. T2 closes up, the lead watches"
    for ax, title in zip(axes, titles, strict=True):
        draw_ground(ax, plan.workspace)
        ax.set(xlim=(left, right), ylim=(bottom, top), title=title)
        draw_scale(ax)

    first, second = axes
    first.plot(*lead.T, color="black", linewidth=3.0)
    draw_lead(first, lead[0], "white")
    draw_robots(first, posts, lead[-1], plan.workspace.team.names)
    for (_, colour, marker), post, route in zip(
        robot_looks(plan.workspace.team.names), posts, others, strict=True
    ):
        second.plot(*route.T, color=colour, linewidth=2.0, linestyle=DASHED)
        second.plot(*post, marker, color=colour, markersize=8, markerfacecolor="white")
    draw_robots(second, then, lead[-1], plan.workspace.team.names)

    for ax in axes:
        draw_lead(ax, lead[-1], "black")
    second.plot([], [], "*", color="black", markersize=14, label="lead (white: before its move)")
    figure.legend(*second.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def draw_lead(ax: Axes, place: np.ndarray, colour: str) -> None:
    """Draw the lead as a star."""
    edge = "white" if colour == "black" else "black"
    ax.plot(*place, "*", color=colour, markersize=16, markeredgecolor=edge, zorder=6)


def draw_robots(ax: Axes, posts: np.ndarray, seen: np.ndarray, names: Iterable[str]) -> None:
    """Draw the robots of T2 at their posts, with sight lines to what they see."""
    for (name, colour, marker), post in zip(robot_looks(names), posts, strict=True):
        ax.plot(*np.stack([post, seen]).T, color=colour, linewidth=1.0)
        style = {"color": colour, "markersize": 9, "markeredgecolor": "white", "zorder": 7}
        ax.plot(*post, marker, **style, linestyle="none", label=name)


def overwatch() -> Figure:
    """Sketch a path of cells, the lead in its next cell, and T2, which watches it."""
    figure, ax = plt.subplots(figsize=(4.0, 4.0), layout="constrained")
    places = np.array(PATH)[:, ::-1] + 0.5
    here, lead = places[REACHED : REACHED + 2]
    ax.set(xlim=(0, 6), ylim=(6, 0), aspect="equal", xticks=range(7), yticks=range(7))
    ax.tick_params(length=0, labelleft=False, labelbottom=False)
    ax.grid(color="0.8")
    ax.spines[:].set(visible=True, color="0.8")

    line = {"color": GREY, "linewidth": 2.5}
    ax.plot(*places[: REACHED + 1].T, **line)
    ax.plot(*places[REACHED:].T, linestyle=DASHED, **line)
    for name, place, side in (("start", places[0], 0.35), ("goal", places[-1], -0.35)):
        ax.plot(*place, "o", color=GREY, markersize=8)
        ax.text(place[0], place[1] + side, name, ha="center", va="center")
    draw_robots(ax, here + POSTS, lead, ("r1", "r2", "r3"))
    draw_lead(ax, lead, "black")

    note = {"ha": "center", "va": "center", "textcoords": "offset points"}
    note["arrowprops"] = {"arrowstyle": "-", "color": GREY, "shrinkB": 12.0}
    ax.annotate("subteam T2 stays\nand watches", here + POSTS.mean(0), (25.0, -70.0), **note)
    ax.annotate("lead T1 moves to\nthe next cell", lead, (75.0, -15.0), **note)
    return figure


def cloud(terrain: xr.Dataset) -> Figure:
    """Draw the highest point in each square metre, coloured by its height above the ground."""
    figure = plt.figure(figsize=(6.4, 3.9))
    ax = figure.add_axes((-0.03, 0.02, 0.92, 1.02), projection="3d")
    top = terrain["dsm"].values
    grown = top - terrain["dem"].values
    known = np.isfinite(grown)
    x, y = np.meshgrid(terrain["x"].values, terrain["y"].values)
    x, y = (values[known] - values[known].min() for values in (x, y))

    style = {"s": 1.6, "cmap": "viridis", "linewidths": 0, "vmax": 30.0, "alpha": 1.0}
    points = ax.scatter(x, y, top[known], c=grown[known], **style)
    ax.set_box_aspect((np.ptp(x), np.ptp(y), np.ptp(top[known])), zoom=0.95)
    ax.view_init(28, -62)
    ax.set(xlabel="east (m)", ylabel="north (m)", zlabel="height (m)")
    ax.set(xticks=[0, 100, 200], yticks=[0, 100], zticks=[450, 550, 650])
    bar = figure.colorbar(points, cax=figure.add_axes((0.88, 0.2, 0.022, 0.6)), extend="max")
    bar.set_label("height above the ground (m)")
    return figure


if __name__ == "__main__":
    main()
