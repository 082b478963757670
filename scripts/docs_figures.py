"""Draw the figures of the documentation: those of docs/gallery.md by its own code, and two more.

The figures of long campaigns and of reliability are of the tables that `benchmarks/campaigns.py
--csv` and `benchmarks/failures.py --csv` wrote.
"""

import io
import re
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from trustbo import plots

mpl.use("Agg")
FIGURES = Path(__file__).resolve().parents[1] / "docs" / "figures"
RESULTS = FIGURES.parents[1] / "benchmarks" / "results"
STEP = re.compile(r"^```python\n(.*?)^```|^!\[[^]]*\]\(figures/(\w+)\.png\)", flags=re.S | re.M)


def main() -> None:
    """Draw them all."""
    names: dict = {}
    for code, name in STEP.findall((FIGURES.parent / "gallery.md").read_text()):
        if code:
            exec(code, names)
        elif plt.get_fignums():
            save(plt.gcf(), name)
            plt.close("all")
    save(criticism(), "criticism")
    save(long_campaigns(), "long_campaigns")
    save(reliability(), "reliability")
    result = names["result"]
    film = plots.animate_mission(result.missions[-1], result.workspace)
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


def reliability() -> Figure:
    """Share of missions that arrived, by the chance predicted, after 15 and 60 missions."""
    table = np.genfromtxt(
        RESULTS / "failures_reliability.csv", delimiter=",", names=True, dtype=None, encoding=None
    )
    figure, axes = plt.subplots(1, 2, figsize=(7, 3.3), layout="constrained", sharey=True)
    styles = {
        "topography": ("#0072B2", "o"),
        "tahoe": ("#D55E00", "s"),
        "synthetic-0": ("#009E73", "^"),
    }
    for ax, missions in zip(axes, (15, 60), strict=True):
        ax.fill_between([0, 1], [-0.05, 0.95], [0.05, 1.05], color="0.9", label="off by .05")
        ax.plot([0, 1], [0, 1], color="0.5", linewidth=0.8)
        for name, (color, marker) in styles.items():
            of = table[np.char.startswith(table["world"], name) & (table["missions"] == missions)]
            many, few = of[of["n"] >= 100], of[(of["n"] < 100) & (of["n"] > 0)]
            ax.plot(many["predicted"], many["arrived"], marker, color=color, label=name)
            ax.plot(
                few["predicted"], few["arrived"], marker, color=color, fillstyle="none", alpha=0.6
            )
        ax.set(xlabel="predicted chance to arrive", title=f"after {missions} missions")
        ax.set(xlim=(0, 1), ylim=(0, 1.02))
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("share that arrived")
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
