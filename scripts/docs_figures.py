"""Draw the figures of the documentation.

They are those of docs/gallery.md by its own code, and a few more. A diagram is an SVG.

Run: python scripts/docs_figures.py [name ...]
"""

import io
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from PIL import Image

from trustbo import plots
from trustbo.plots.plan import COLOURS
from trustbo.plots.style import theme

mpl.use("Agg")
FIGURES = Path(__file__).resolve().parents[1] / "docs" / "figures"
STEP = re.compile(r"^```python\n(.*?)^```|^!\[[^]]*\]\(figures/(\w+)\.png\)", flags=re.S | re.M)


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
    draw("architecture", wanted, architecture, "svg")


def draw(name: str, wanted: list[str], drawing: Callable[[], Any], suffix: str = "png") -> None:
    """Draw a figure and write it."""
    if wanted and name not in wanted:
        return
    drawing()
    save(plt.gcf(), FIGURES / f"{name}.{suffix}", "white")
    plt.close("all")


def criticism() -> None:
    """Draw the criticism of the first example of docs/howto/criticise.md."""
    page = (FIGURES.parent / "howto" / "criticise.md").read_text()
    namespace: dict[str, Any] = {}
    exec(page.split("```python\n")[1].split("```")[0], namespace)
    plots.criticism(namespace["found"])


ROOMS = {
    "terrain": ((1.75, 3.0), "features\nof pixels"),
    "workspace": ((3.9, 3.0), "awareness,\nposts, ways"),
    "planning": ((6.35, 3.0), "best path under\nthe belief"),
    "simulation": ((8.5, 3.0), "simulators;\nor your robots"),
    "data": ((10.65, 3.0), "mission: path,\nrates, status"),
    "inference": ((8.5, 1.65), "posterior of\n$\\theta$ and of trust"),
    "hazard": ((8.5, 0.45), "chance of a\nbound to fail"),
    "campaign": ((6.35, 1.05), "belief: $\\theta$, risk,\nawareness"),
    "models": ((3.9, 1.05), "equations\nand priors"),
}
"""Corner of the box of each room, and its part in the flow of data."""
FLOW = [
    ("terrain", "workspace"), ("workspace", "planning"), ("planning", "simulation"),
    ("simulation", "data"), ("data", "inference"), ("data", "hazard"), ("inference", "campaign"),
    ("hazard", "campaign"), ("campaign", "planning"), ("models", "campaign"),
]  # fmt: skip
WIDTH, HEIGHT = 1.75, 0.95


def architecture() -> Figure:
    """Draw the flow of data from room to room."""
    figure, ax = plt.subplots(figsize=(9.6, 3.6), layout="constrained")
    loop = FancyBboxPatch(
        (6.1, 0.2), 6.55, 4.0, boxstyle="round,pad=0.02,rounding_size=0.1", facecolor="none",
        edgecolor=theme().quiet, linestyle=(0, (4, 3)),
    )  # fmt: skip
    ax.add_patch(loop)
    ax.text(12.6, 4.28, "once for each mission", fontsize=9.5, ha="right", va="bottom")
    for name, (corner, text) in ROOMS.items():
        box(ax, corner, (WIDTH, HEIGHT), text, "data.py" if name == "data" else f"{name}/")
    ax.text(0.55, 3.47, "DEM and\nDSM, or a\npoint cloud", fontsize=10.5, ha="center", va="center")
    arrow(ax, (1.15, 3.47), (1.75, 3.47))
    for start, end in FLOW:
        arrow(ax, *_sides(start, end))
    ax.set(xlim=(-0.1, 12.75), ylim=(0.1, 4.6), aspect="equal")
    ax.axis("off")
    return figure


def box(
    ax: Axes, corner: tuple[float, float], size: tuple[float, float], text: str, name: str
) -> None:
    """Draw a box of a diagram: two lines of text, and a name in the code."""
    (x, y), (width, height) = corner, size
    style = "round,pad=0.02,rounding_size=0.08"
    colours = {"facecolor": theme().band, "edgecolor": COLOURS[0]}
    ax.add_patch(FancyBboxPatch(corner, width, height, boxstyle=style, **colours))
    middle = {"ha": "center", "va": "center"}
    ax.text(x + width / 2, y + 0.653 * height, text, fontsize=10.5, **middle)
    ax.text(x + width / 2, y + 0.158 * height, name, fontsize=9.5, family="monospace", **middle)


def arrow(ax: Axes, tail: tuple[float, float], head: tuple[float, float]) -> None:
    """Draw an arrow of a diagram."""
    style = {"arrowstyle": "-|>", "mutation_scale": 13, "shrinkA": 3, "shrinkB": 3}
    ax.add_patch(FancyArrowPatch(tail, head, color=theme().ink, **style))


def _sides(start: str, end: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Points of two rooms' boxes between which an arrow is drawn."""
    (x, y), (u, v) = ROOMS[start][0], ROOMS[end][0]
    if x == u:
        return (x + WIDTH / 2, y + HEIGHT), (u + WIDTH / 2, v)
    if start == "data":
        return (x + WIDTH / 2, y), (u + WIDTH, v + HEIGHT / 2)
    side = u > x
    return (x + WIDTH * side, y + HEIGHT / 2), (u + WIDTH * (not side), v + HEIGHT / 2)


def save(figure: Figure, path: Path, paper: str) -> None:
    """Write an SVG, or a PNG without an alpha channel, without an empty margin."""
    path.parent.mkdir(exist_ok=True)
    if path.suffix == ".svg":
        with plt.rc_context({"svg.hashsalt": path.stem}):  # else its ids are random
            figure.savefig(path, bbox_inches="tight", pad_inches=0.05, facecolor=paper,
                           metadata={"Date": None})  # fmt: skip
        text = path.read_text(encoding="utf-8")
        lines = [line.rstrip() for line in text.splitlines()]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return
    file = io.BytesIO()
    figure.savefig(file, dpi=110, bbox_inches="tight", pad_inches=0.05, facecolor=paper)
    Image.open(file).convert("RGB").save(path, optimize=True)


if __name__ == "__main__":
    main(sys.argv[1:])
