"""Draw the figures of the documentation on light and dark paper.

They are those of docs/gallery.md by its own code, and a few more.

The figures of long campaigns and of reliability are of the tables that `benchmarks/campaigns.py
--csv` and `benchmarks/failures.py --csv` wrote. Run: python scripts/docs_figures.py [name ...]
"""

import io
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

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
PAPERS = {"": plots.LIGHT._replace(paper="#ffffff"), "dark": plots.DARK._replace(paper="#131416")}
"""Themes by folder; their papers are those of the pages of the documentation."""


def main(wanted: list[str]) -> None:
    """Draw the figures of these names, by default all."""
    names: dict[str, Any] = {}
    code = ""
    for block, name in STEP.findall((FIGURES.parent / "gallery.md").read_text()):
        if block and ("plot" not in block or "import" in block):
            exec(block, names)
        elif block:
            code = block
        elif code:
            draw(name, wanted, lambda code=code: exec(code, names))
            code = ""
    draw("criticism", wanted, criticism)
    draw("long_campaigns", wanted, long_campaigns)
    draw("reliability", wanted, reliability)
    draw("animate_mission", wanted, lambda: frame(names["result"]))


def draw(name: str, wanted: list[str], drawing: Callable[[], Any]) -> None:
    """Draw a figure on each paper."""
    if wanted and name not in wanted:
        return
    for folder, theme in PAPERS.items():
        with plt.rc_context(theme.settings()):
            drawing()
            save(plt.gcf(), FIGURES / folder / f"{name}.png", theme.paper)
        plt.close("all")


def frame(result: Any) -> None:
    """Draw the frame of the last mission's film at which contact is most divided."""
    mission = result.missions[-1]
    film = plots.animate_mission(mission, result.workspace)
    contact = np.concatenate([bound.contact for bound in mission.bounds])
    divided = np.flatnonzero(contact.any(1) & ~contact.all(1))
    film._draw_frame(divided[len(divided) // 2])  # matplotlib has no public way to one frame
    film._draw_was_started = True


def criticism() -> None:
    """Draw the criticism of the first example of docs/howto/criticise.md."""
    page = (FIGURES.parent / "howto" / "criticise.md").read_text()
    namespace: dict[str, Any] = {}
    exec(page.split("```python\n")[1].split("```")[0], namespace)
    plots.criticism(namespace["found"])


def long_campaigns() -> Figure:
    """Draw seconds, memory and disk over 200 missions, by version 0.1 and now."""
    figure, axes = plt.subplots(1, 3, figsize=(7.6, 2.6), layout="constrained")
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
    """Draw the share of missions that arrived by the chance predicted, after 15 and 60 missions."""
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
        ax.fill_between([0, 1], [-0.05, 0.95], [0.05, 1.05], color="0.5", alpha=0.25, linewidth=0,
                        label="off by .05")  # fmt: skip
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


def save(figure: Figure, path: Path, paper: str) -> None:
    """Write a PNG without an alpha channel, and without an empty margin."""
    path.parent.mkdir(exist_ok=True)
    file = io.BytesIO()
    figure.savefig(file, dpi=110, bbox_inches="tight", pad_inches=0.05, facecolor=paper)
    Image.open(file).convert("RGB").save(path, optimize=True)


if __name__ == "__main__":
    main(sys.argv[1:])
