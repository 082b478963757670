"""Draws the figures of the documentation from what `make demo` left in out/demo.

The figure of long campaigns is of the tables that `benchmarks/campaigns.py --csv` wrote.
"""

import io
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

import trustbo as tb
from trustbo import plots

mpl.use("Agg")
FIGURES = Path(__file__).resolve().parents[1] / "docs" / "figures"
RESULTS = FIGURES.parents[1] / "benchmarks" / "results"


def main() -> None:
    """Draw them all."""
    result = tb.load_result("out/demo")
    workspace, mean = result.workspace, tb.models.params_of(result.posterior).mean()
    cost = result.planner.cost_map(mean, per_robot=True)
    drawn = {
        "maps": result.plot_maps(),
        "terrain": plots.terrain_maps(workspace),
        "path_posterior": [
            plots.path_posterior(result.maps()["path_probability"], workspace, result.path)
        ],
        "robot_maps": plots.robot_maps(cost, workspace, result.path, n_columns=3),
        "mission_trust": plots.mission_trust(result.posterior),
        "plan_map": plots.plan_map(result.plan, bounds=[1, 2]),
        "plan_trust": plots.plan_trust(result.plan, workspace.team.names),
        "parameter_history": plots.parameter_history(result.posteriors),
        "campaign_history": plots.campaign_history(result.history),
        "loadings": plots.loadings(workspace.composites),
        "calibration": plots.calibration(tb.models.sbc(n_datasets=100)),
    }
    for name, axes in drawn.items():
        save(axes[0].figure, name)
    save(criticism(), "criticism")
    save(long_campaigns(), "long_campaigns")
    film = plots.animate_mission(result.missions[-1], workspace)
    contact = np.concatenate([bound.contact for bound in result.missions[-1].bounds])
    divided = np.flatnonzero(contact.any(1) & ~contact.all(1))
    film._draw_frame(divided[len(divided) // 2])  # matplotlib has no public way to one frame
    film._draw_was_started = True
    save(film._fig, "animate_mission")


def criticism() -> Figure:
    """Criticism of the first example of docs/howto/criticise.md."""
    page = (FIGURES.parent / "howto" / "criticise.md").read_text()
    namespace: dict = {}
    exec(page.split("```python\n")[1].split("```")[0], namespace)
    return plots.criticism(namespace["found"])[0].figure


def long_campaigns() -> Figure:
    """Seconds, memory and disk over 200 missions, by version 0.1 and now."""
    figure, axes = plt.subplots(1, 3, figsize=(9, 2.8), layout="constrained")
    styles = {"0.1": ("#D55E00", "--", "version 0.1"), "0.2": ("#0072B2", "-", "now")}
    for version, (color, line, label) in styles.items():
        table = np.genfromtxt(RESULTS / f"campaigns_{version}.csv", delimiter=",", names=True)
        memory = (table["memory_mb"] - table["memory_mb"][0]) / 1e3
        for ax, values in zip(
            axes, (table["seconds"], memory, table["disk_mb"] / 1e3), strict=True
        ):
            ax.plot(table["mission"], values, line, color=color, label=label)
    for ax, name in zip(axes, ("seconds a mission", "memory gained, GB", "disk, GB"), strict=True):
        ax.set(xlabel="mission", ylabel=name, ylim=(0, None), xlim=(0, 200))
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].legend(frameon=False)
    return figure


def save(figure: Figure, name: str) -> None:
    """Write a PNG without an alpha channel."""
    file = io.BytesIO()
    figure.savefig(file, dpi=85)
    plt.close(figure)
    Image.open(file).convert("RGB").save(FIGURES / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
