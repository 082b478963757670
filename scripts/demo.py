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
from trustbo.plots.style import ROBOTS, outlined

START, GOAL, MISSIONS = (9, 0), (0, 9), 8
HEIGHT, RADIUS = 3.0, 45.0
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
    """Draw the contact lost per mission, and trust and path before and after."""
    workspace = result.workspace
    right = tb.simulation.KinematicSimulator(workspace)
    known = tb.iterate(workspace, START, GOAL, n_iterations=MISSIONS, simulator=right)

    style = {"font.size": 9, "axes.titlesize": 10, "legend.frameon": False, "hatch.linewidth": 0.6}
    with mpl.rc_context(style):
        figure, (lost, *maps) = plt.subplots(1, 3, figsize=(9.6, 3.3), layout="constrained")
        draw_trust(figure, maps, result, center)
        worlds = {"old survey": (changed, result), "map is right": (right, known)}
        for colour, (label, world) in zip((ROBOTS[1], ROBOTS[0]), worlds.items(), strict=True):
            draw_lost(lost, *world, colour, label)
        lost.set(title="(a) contact lost", xlabel="mission", ylabel="bounds of contact lost")
        lost.xaxis.set_major_locator(MaxNLocator(integer=True))
        lost.spines[["top", "right"]].set_visible(False)
        lost.set_ylim(bottom=0.0)
        lost.set_box_aspect(1.0 / ASPECT)
        lost.legend()
        figure.savefig(file, dpi=140, facecolor="white")
    print(f"the picture is in {file}")


def draw_trust(
    figure: Figure, axes: list[Axes], result: tb.Result, center: tuple[float, float]
) -> None:
    """Draw trust map and path before the first and after the last mission, on one scale."""
    workspace = result.workspace
    before, after = result.history["trust_map"].sel(iteration=1), result.trust_map
    maps = [before.copy(), after.copy()]
    for values in maps:
        values[START] = np.nan  # the trust at the start is assumed
    low, _ = limits_of(np.stack(maps), is_trust=True)
    driven = np.zeros((2, *workspace.grid.shape), dtype=bool)
    for mission in result.missions:
        for bound in mission.bounds:
            driven[1, *bound.cell] = True
    norm = mpl.colors.Normalize(low, 1.0)  # 1: unbroken contact
    paths = [result.missions[0].path, result.path]
    titles = ["(b) trust by the old map, first path", f"(c) after {MISSIONS} missions, new path"]
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
    ax.axhline(best, color=colour, linestyle=":", label=f"best path, {label}")
    print(f"{label}: lost {np.round(values, 2)}, best {best:.2f}")


if __name__ == "__main__":
    main()
