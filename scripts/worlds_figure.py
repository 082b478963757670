"""Draws docs/figures/worlds.png: regret of what contenders recommend, by kind of world.

    python scripts/worlds_figure.py FOLDER ...

Folders are those of `benchmarks/worlds.py` and `trustbo worlds`; their runs are drawn together.
"""

import sys
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import xarray as xr

from trustbo.study import load_study

mpl.use("Agg")
FILE = Path(__file__).resolve().parents[1] / "docs" / "figures" / "worlds.png"
KINDS = {
    "right": "sight as assumed",
    "bare": "only the ground is opaque",
    "wall": "canopy is opaque",
    "aged": "an old survey",
    "canopy": "a wrong model of the canopy",
    "slopes": "robots that climb less",
}
STYLES = {
    "optimistic": ("trustbo: bounds, places, optimistic", "#0072B2", "-"),
    "greedy": ("bounds without places, greedy", "#56B4E9", (0, (6, 1.5, 1, 1.5))),
    "BoTorch": ("BoTorch over path averages", "#D55E00", "--"),
    "paper": ("the paper's method", "#009E73", (0, (1, 1))),
    "shortest path": ("a shortest path", "0.45", (0, (3, 1, 1, 1))),
}


def main() -> None:
    """Draw the panels."""
    results = [load_study(folder) for folder in sys.argv[1:]]
    figure, axes = plt.subplots(
        2, 3, figsize=(9, 5.4), sharex=True, sharey=True, layout="constrained"
    )
    for ax, (kind, title) in zip(axes.flat, KINDS.items(), strict=True):
        n_courses = 0
        for name, (label, color, line) in STYLES.items():
            regret = curves(results, kind, name)
            if not len(regret):
                continue
            mission = np.arange(regret.shape[1])
            low, middle, high = np.quantile(np.maximum(regret, 0.0), [0.25, 0.5, 0.75], axis=0)
            ax.fill_between(mission, low, high, color=color, alpha=0.18, linewidth=0)
            ax.plot(mission, middle, linestyle=line, color=color, label=label, linewidth=1.8)
            n_courses = max(n_courses, len(regret))
        ax.set_yscale("symlog", linthresh=1.0, linscale=0.7)
        ax.set_yticks([0, 0.5, 1, 3, 10, 30], ["0", "0.5", "1", "3", "10", "30"])
        ax.set_ylim(-0.05, 100)
        ax.set_title(f"{title} ({n_courses})", fontsize=9, loc="left")
        ax.spines[["top", "right"]].set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel("missions learned from", fontsize=9)
    for ax in axes[:, 0]:
        ax.set_ylabel("regret, % of the best contact", fontsize=9)
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False,
        fontsize=9,
    )  # fmt: skip
    figure.savefig(FILE, dpi=85)


def curves(results: list[xr.Dataset], kind: str, contender: str) -> np.ndarray:
    """Regret of the recommendation before the first mission and after each, (run, mission)."""
    found = []
    for result in results:
        chosen = (result["kind"].values == kind) & (result["contender"].values == contender)
        one = result.isel(run=chosen)
        found.append(
            np.concatenate([one["regret_before"].values[:, None], one["regret"].values], axis=1)
        )
    return np.concatenate(found)


if __name__ == "__main__":
    main()
