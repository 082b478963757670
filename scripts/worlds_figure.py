"""Draws docs/figures/worlds.png: regret of what methods recommend, by kind of world.

    python scripts/worlds_figure.py FOLDER FILE.png

From a folder of `benchmarks/worlds.py`.
"""

import sys
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.axes import Axes

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from worlds import kept

mpl.use("Agg")
KINDS = {
    "sight as assumed": ("right", "wall", "bare", "slopes", "shapes", "teams", "four-ways"),
    "old survey, wrong canopy": ("aged", "canopy"),
    "robots and days differ": ("robots", "days", "foul"),
    "a change after six missions": ("change",),
    "jammers": ("jammer",),
    "another physics": ("physics",),
}
STYLES = {
    "trustbo": ("#0072B2", "-"),
    "residual process": ("#CC79A7", (0, (6, 1.5, 1, 1.5))),
    "running mean": ("#009E73", (0, (1, 1))),
    "line of sight": ("0.45", (0, (3, 1, 1, 1))),
}
"""Colours and lines of methods, by the names of their rows."""


def main() -> None:
    """Draw the panels."""
    folder, file = sys.argv[1:3]
    results = kept(Path(folder))
    names = [name for name in STYLES if name in results["method"].values]
    results = complete(results, names)
    figure, axes = plt.subplots(
        2, 3, figsize=(9, 5.4), sharex=True, sharey=True, layout="constrained"
    )
    for ax, (title, chosen) in zip(axes.flat, KINDS.items(), strict=True):
        n = draw(ax, {name: curves(results, name, chosen) for name in names})
        ax.set_title(f"{title} ({n})", fontsize=9, loc="left")
    for ax in axes[-1]:
        ax.set_xlabel("missions learned from", fontsize=9)
    for ax in axes[:, 0]:
        ax.set_ylabel("regret, % of the best contact", fontsize=9)
    handles = axes[0, 0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=len(names), frameon=False, fontsize=9)
    figure.savefig(file, dpi=85)


def draw(ax: Axes, regrets: dict[str, np.ndarray]) -> int:
    """Draw medians, and the middle half of ours, (run, mission); return the number of runs."""
    for name, regret in regrets.items():
        color, line = STYLES[name]
        mission = np.arange(regret.shape[1])
        low, middle, high = np.quantile(np.maximum(regret, 0.0), [0.25, 0.5, 0.75], axis=0)
        if name == "trustbo":
            ax.fill_between(mission, low, high, color=color, alpha=0.18, linewidth=0)
        ax.plot(mission, middle, linestyle=line, color=color, label=name, linewidth=1.8)
    ax.set_yscale("symlog", linthresh=1.0, linscale=0.7)
    ax.set_yticks([0, 0.5, 1, 3, 10, 30], ["0", "0.5", "1", "3", "10", "30"])
    ax.set_ylim(-0.05, 100)
    ax.spines[["top", "right"]].set_visible(False)
    return max(map(len, regrets.values()))


def complete(runs: xr.Dataset, methods: list[str]) -> xr.Dataset:
    """Runs of the worlds and courses that all of these methods have run."""
    rows = runs[["world", "course", "method"]].to_dataframe()
    rows = rows[rows["method"].isin(methods)]
    n = rows.groupby(["world", "course"])["method"].transform("nunique")
    return runs.isel(run=rows.index[n == len(methods)].to_numpy())


def curves(runs: xr.Dataset, method: str, kinds: tuple[str, ...]) -> np.ndarray:
    """Regret of the recommendation before the first mission and after each, (run, mission)."""
    there = np.isin(runs["kind"].values, kinds) & (runs["method"].values == method)
    one = runs.isel(run=there)
    return np.concatenate([one["regret_before"].values[:, None], one["regret"].values], axis=1)


if __name__ == "__main__":
    main()
