"""Draws docs/figures/worlds.png: regret of what methods recommend, by kind of world.

    python scripts/worlds_figure.py FILE.png default=FOLDER:optimistic paper=FOLDER:paper ...

Each curve is named, default, without, botorch, paper or shortest, with the folder of
`benchmarks/worlds.py` or `trustbo worlds` and the method in it that it is of. With `--together`
before the file, all kinds of worlds are in one panel, as in docs/figures/worlds_outsider.png.
"""

import sys

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from trustbo.study import load_study

mpl.use("Agg")
KINDS = {
    "right": "sight as assumed",
    "bare": "only the ground is opaque",
    "wall": "canopy is opaque",
    "aged": "an old survey",
    "canopy": "a wrong model of the canopy",
    "slopes": "robots that climb less",
}
STYLES = {
    "default": ("trustbo", "#0072B2", "-"),
    "without": ("trustbo without places", "#56B4E9", (0, (6, 1.5, 1, 1.5))),
    "botorch": ("BoTorch over path averages", "#D55E00", "--"),
    "paper": ("the paper's method", "#009E73", (0, (1, 1))),
    "shortest": ("a shortest path", "0.45", (0, (3, 1, 1, 1))),
}


def main() -> None:
    """Draw the panels."""
    whole = sys.argv[1] != "--together"
    file, *given = sys.argv[1 if whole else 2 :]
    results = {}
    for one in given:
        name, _, source = one.partition("=")
        folder, _, method = source.rpartition(":")
        runs = load_study(folder)
        results[name] = runs.isel(run=runs["method"].values == method)
    kinds = (
        {(kind,): title for kind, title in KINDS.items()} if whole else {tuple(KINDS): "all worlds"}
    )
    shape, size = ((2, 3), (9, 5.4)) if whole else ((1, 1), (5, 3.4))
    figure, axes = plt.subplots(
        *shape, figsize=size, sharex=True, sharey=True, squeeze=False, layout="constrained"
    )
    for ax, (chosen, title) in zip(axes.flat, kinds.items(), strict=True):
        n = draw(ax, {name: curves(runs, chosen) for name, runs in results.items()})
        ax.set_title(f"{title} ({n})", fontsize=9, loc="left")
    for ax in axes[-1]:
        ax.set_xlabel("missions learned from", fontsize=9)
    for ax in axes[:, 0]:
        ax.set_ylabel("regret, % of the best contact", fontsize=9)
    handles = axes[0, 0].get_legend_handles_labels()
    figure.legend(
        *handles, loc="outside lower center", ncols=3 if whole else 2, frameon=False, fontsize=9
    )
    figure.savefig(file, dpi=85)


def draw(ax: Axes, regrets: dict[str, np.ndarray]) -> int:
    """Draw the median and the middle half of each, (run, mission); return the number of runs."""
    for name, regret in regrets.items():
        label, color, line = STYLES[name]
        mission = np.arange(regret.shape[1])
        low, middle, high = np.quantile(np.maximum(regret, 0.0), [0.25, 0.5, 0.75], axis=0)
        ax.fill_between(mission, low, high, color=color, alpha=0.18, linewidth=0)
        ax.plot(mission, middle, linestyle=line, color=color, label=label, linewidth=1.8)
    ax.set_yscale("symlog", linthresh=1.0, linscale=0.7)
    ax.set_yticks([0, 0.5, 1, 3, 10, 30], ["0", "0.5", "1", "3", "10", "30"])
    ax.set_ylim(-0.05, 100)
    ax.spines[["top", "right"]].set_visible(False)
    return max(map(len, regrets.values()))


def curves(runs: xr.Dataset, kinds: tuple[str, ...]) -> np.ndarray:
    """Regret of the recommendation before the first mission and after each, (run, mission)."""
    one = runs.isel(run=np.isin(runs["kind"].values, kinds))
    return np.concatenate([one["regret_before"].values[:, None], one["regret"].values], axis=1)


if __name__ == "__main__":
    main()
