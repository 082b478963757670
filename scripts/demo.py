"""Run a demo campaign in which the map is outdated, and write its report.

    python scripts/demo.py [--out out/demo] [--picture FILE]

The terrain is the hillside in the package, in the Wellington region. Since the survey, 3 m of scrub
have grown within 45 m of the middle of the first path. The output folder contains the campaign, its
report, and maps and path for GIS. With `--picture`, the script also runs the campaign in a world
where the map is right, finds the best path in both worlds, and draws the first figure of the docs.
"""

import argparse
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator

import trustbo as tb
from trustbo.plots.maps import (
    BRIGHT_HIGH,
    draw_cells,
    draw_path,
    draw_scale,
    hatch_undriven,
    limits_of,
    shown_values,
)
from trustbo.plots.plan import draw_ground
from trustbo.plots.style import GREY, ROBOTS, outlined

START, GOAL, MISSIONS = (9, 0), (0, 9), 8
HEIGHT, RADIUS = 3.0, 45.0
BOUND = 10
"""Number of the bound of the new path that is drawn in panel (a), from 1."""
ASPECT = 1.43
"""Width of a panel divided by its height, as for the hillside."""


def main() -> None:
    """Run the campaign, print a summary, and draw the picture if asked to."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("out/demo"))
    parser.add_argument("--picture", type=Path)
    given = parser.parse_args()

    mpl.use("agg")
    workspace = tb.Workspace.from_terrain(tb.terrain.example(), shape=(10, 10))
    with tb.Campaign(workspace, START, GOAL, directory=given.out, overwrite=True) as campaign:
        first = campaign.ask()
        print(f"the first path arrives with probability {first.p_arrive:.2f} under the prior")
        path = first.path
        center = workspace.grid.center(path[len(path) // 2])
        scrub = tb.simulation.Trees(HEIGHT, center, RADIUS)
        changed = tb.simulation.KinematicSimulator(workspace, events=[scrub])
        for _ in campaign.run(changed, MISSIONS):
            pass

    tb.report.write_report(given.out / "report.html", campaign)
    tb.export.export_result(campaign, given.out)
    table = campaign.table()
    lost = table["contact_lost"].to_numpy()
    print(
        f"{(table['status'] == 'ok').sum()} of {MISSIONS} missions arrived; the recommended path "
        f"arrives with probability {campaign.plan().p_arrive:.2f}"
    )
    print(
        f"contact lost in mission 1, with scrub that the map does not show: {lost[0]:.1f} of "
        f"{len(path) - 1} bounds; in mission {MISSIONS}, on a new path: {lost[-1]:.1f} of "
        f"{table['n_bounds'].iloc[-1]} bounds"
    )
    print(f"results are in {given.out}; open {given.out / 'report.html'}")
    if given.picture is not None:
        draw(campaign, changed, center, given.picture)


def draw(
    result: tb.Result,
    changed: tb.simulation.KinematicSimulator,
    center: tuple[float, float],
    file: Path,
) -> None:
    """Draw a bound, the contact lost per mission, and trust and path before and after."""
    workspace = result.workspace
    right = tb.simulation.KinematicSimulator(workspace)
    known = tb.iterate(workspace, START, GOAL, n_iterations=MISSIONS, simulator=right)

    style = {"font.size": 9, "axes.titlesize": 10, "legend.frameon": False, "hatch.linewidth": 0.6}
    with mpl.rc_context(style):
        figure, axes = plt.subplots(2, 2, figsize=(8.0, 6.8), layout="constrained")
        figure.get_layout_engine().set(h_pad=0.08)
        (bound, lost), maps = axes
        draw_bound(bound, result.plan())
        draw_trust(figure, maps, result, center)
        worlds = {"old survey": (changed, result), "map is right": (right, known)}
        for colour, (label, world) in zip((ROBOTS[1], ROBOTS[0]), worlds.items(), strict=True):
            draw_lost(lost, *world, colour, label)
        lost.set(title="(b) contact lost", xlabel="mission", ylabel="bounds of contact lost")
        lost.xaxis.set_major_locator(MaxNLocator(integer=True))
        lost.spines[["top", "right"]].set_visible(False)
        lost.set_ylim(bottom=0.0)
        lost.set_box_aspect(1.0 / ASPECT)
        lost.legend()
        figure.savefig(file, dpi=140, facecolor="white")
    print(f"the picture is in {file}")


def draw_bound(ax: Axes, plan: tb.planning.Plan) -> None:
    """Draw one bound: T1 drives its route while T2 watches from overwatch points."""
    corner = np.array(plan.workspace.grid.corner)
    draw_ground(ax, plan.workspace)
    route, *others = (one - corner for one in plan.routes[BOUND - 1])
    posts = plan.posts[BOUND - 1] - corner
    for share in (0.3, 0.65, 1.0):
        ends = np.broadcast_to(route[round(share * (len(route) - 1))], posts.shape)
        sight = ax.plot(*np.stack([posts, ends], 1).T, color=GREY, linewidth=1.3)
    (moves,) = ax.plot(*route.T, color="black", linewidth=2.5)
    (lead,) = ax.plot(*route[0], "*", color="black", markersize=13, linestyle="none")
    ax.plot(*route[-1], "*", color="black", markersize=13, markerfacecolor="white")
    for other in others:
        (follows,) = ax.plot(*other.T, "--", color=ROBOTS[0], linewidth=1.2)
    (watches,) = ax.plot(*posts.T, "o", color=ROBOTS[0], markersize=7, markeredgecolor="white")
    seen = np.concatenate([route, posts, *others])
    low, high = seen.min(0) - 2.0, seen.max(0) + 2.0
    height = 1.4 * max(high[1] - low[1], (high[0] - low[0]) / ASPECT)  # with room for the legend
    x = (low[0] + high[0] - ASPECT * height) / 2.0
    ax.set(xlim=(x, x + ASPECT * height), ylim=(low[1], low[1] + height))
    ax.set_title("(a) a bound")
    legend = {
        "T1, the lead": lead, "1. T1 moves": moves, "T2 at overwatch points": watches,
        "T2 watches": sight[0], "2. T2 closes up": follows,
    }  # fmt: skip
    ax.legend(legend.values(), legend.keys(), loc="upper left", fontsize=8)
    draw_scale(ax)


def draw_trust(
    figure: Figure, axes: np.ndarray, result: tb.Result, center: tuple[float, float]
) -> None:
    """Draw trust map and path before the first and after the last mission, on one scale."""
    workspace = result.workspace
    maps = [result.history["trust_map"].sel(iteration=1), result.trust_map]
    for values in maps:
        values[START] = np.nan  # the trust at the start is assumed
    low, _ = limits_of(np.stack(maps), is_trust=True)
    driven = np.zeros((2, *workspace.grid.shape), dtype=bool)
    for mission in result.missions:
        for bound in mission.bounds:
            driven[1, *bound.cell] = True
    norm = mpl.colors.Normalize(low, 1.0)  # 1: unbroken contact
    paths = [result.missions[0].path, result.path]
    titles = ["(c) trust by the old map, first path", f"(d) after {MISSIONS} missions, new path"]
    x, y = np.array(center) - workspace.grid.corner
    for ax, values, known, path, title in zip(axes, maps, driven, paths, titles, strict=True):
        shown = shown_values(values, workspace)
        image = draw_cells(ax, shown, workspace, norm, BRIGHT_HIGH)
        hatch_undriven(ax, known, workspace)
        draw_path(ax, path, workspace.grid)
        circle = Circle((x, y), RADIUS, fill=False, color="white", linestyle="--", linewidth=1.3)
        circle.set_path_effects(outlined(2.6, "black"))
        ax.add_patch(circle)
        ax.set(xticks=[], yticks=[], title=title)
        draw_scale(ax)
    bar = figure.colorbar(image, ax=axes, extend="both", location="bottom", aspect=50, shrink=0.7)
    bar.set_label("expected trust (1: unbroken contact); hatched: never entered, only predicted")


def draw_lost(
    ax: Axes,
    simulator: tb.simulation.KinematicSimulator,
    result: tb.Result,
    colour: str,
    label: str,
) -> None:
    """Draw the expected contact lost on the path of each mission and on the best path."""
    truth = tb.simulation.Truth.from_simulator(simulator)
    values = [truth.lost(mission.stations) for mission in result.missions]
    best = truth.lost(truth.best(START, GOAL))
    ax.plot(range(1, 1 + len(values)), values, "o-", color=colour, label=label)
    ax.axhline(best, color=colour, linestyle=":", label=f"{label}: best path")
    print(f"{label}: lost {np.round(values, 2)}, best {best:.2f}")


if __name__ == "__main__":
    main()
