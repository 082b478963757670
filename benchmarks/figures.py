"""Draw the figures of docs/evidence.md from stored rows, each for light and for dark pages.

    python benchmarks/figures.py [--out docs/figures]

`learning`: contact lost by mission, for each group of worlds and setting. `worlds`: trustbo minus a
baseline in each world, with the t interval of each group. `arrivals`: predicted probability that
a plan fails, and the share of plans that failed.
"""

from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from common import arguments, parsed
from contact import MISSIONS, SETTINGS
from groups import ALIKE
from matplotlib.figure import Figure
from scipy import stats
from tables import OURS, TITLES, difference, of_worlds, rows_of

from trustbo.plots.style import GREY, PAGE, RC, ROBOTS

FIGURES = Path(__file__).parents[1] / "docs" / "figures"
SHOWN = {OURS: ROBOTS[0], "running mean": ROBOTS[1], "line of sight": ROBOTS[2]}
"""Colours of the methods that are drawn; the tables have all."""
OTHER = "running mean"
"""Baseline with which worlds are compared."""
DARK = {
    "figure.facecolor": "#131416", "axes.facecolor": "#131416", "text.color": "0.85",
    "axes.labelcolor": "0.85", "axes.titlecolor": "0.85", "xtick.color": "0.85",
    "ytick.color": "0.85", "axes.edgecolor": "0.6", "legend.labelcolor": "0.85",
}  # fmt: skip
"""Colours for dark pages, on the background of the site."""
_FARTHEST = 1.0
"""Largest difference that is drawn; dots beyond it are named at the edge."""
_BINS = (0.01, 0.03, 0.1, 0.3)
"""Limits of the predicted probability of failure in the figure of arrivals."""
_RANGE = (1e-3, 1.0)
"""Range of its axes."""


def learning() -> Figure:
    """Draw the mean contact lost by mission, a column for each group and a row for each setting."""
    figure, axes = plt.subplots(
        len(SETTINGS), len(ALIKE), figsize=(PAGE, 3.6), sharex=True, sharey="col",
        layout="constrained",
    )  # fmt: skip
    missions = np.arange(1, MISSIONS + 1)
    for row, setting in zip(axes, SETTINGS, strict=True):
        rows = rows_of(setting)
        for panel, (group, kinds) in zip(row, ALIKE.items(), strict=True):
            some = rows[rows["kind"].isin(kinds)]
            for method, colour in SHOWN.items():
                of_method = some[some["method"] == method]
                lost = of_method[[f"lost_{k}" for k in missions]].mean()
                panel.plot(missions, lost, color=colour, label=method, linewidth=1.3)
            if setting == next(iter(SETTINGS)):
                panel.set_title(group.replace(", ", ",\n", 1), fontsize=8.0)
            panel.set_ylim(bottom=0.0)
            panel.set_xticks([1, 5, 10, 15])
        row[0].set_ylabel(f"{TITLES[setting].lower()}\nbounds lost")
    axes[-1, len(ALIKE) // 2].set_xlabel("mission")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(SHOWN), frameon=False)
    return figure


def worlds() -> Figure:
    """Draw a dot for each world, and a bar for the t interval of each group."""
    figure, axes = plt.subplots(
        1, len(SETTINGS), figsize=(PAGE, 2.6), sharey=True, layout="constrained"
    )
    rng = np.random.default_rng(0)
    for panel, setting in zip(axes, SETTINGS, strict=True):
        lost = of_worlds(rows_of(setting), "lost")
        for k, (_, kinds) in enumerate(ALIKE.items()):
            some = lost[lost["kind"].isin(kinds)]
            less = (some[OURS] - some[OTHER]).to_numpy()
            shown = np.clip(less, -_FARTHEST, _FARTHEST)
            height = k + rng.uniform(-0.22, 0.22, len(less))
            panel.plot(shown, height, ".", color=GREY, markersize=4.0)
            mean, low, high, _ = difference(some, OTHER)
            panel.plot([low, high], [k, k], color=SHOWN[OURS], linewidth=2.0)
            panel.plot(mean, k, "o", color=SHOWN[OURS], markersize=5.0)
        panel.axvline(0.0, color=GREY, linewidth=0.8)
        panel.set_title(TITLES[setting], fontsize=8.0)
        panel.set_xlabel(f"{OURS} minus {OTHER}, bounds per mission")
        panel.set_yticks(range(len(ALIKE)), list(ALIKE))
        panel.set_ylim(len(ALIKE) - 0.5, -0.5)
    return figure


def arrivals() -> Figure:
    """Draw the share of plans that failed, by predicted probability, and how many there were."""
    figure, axes = plt.subplots(
        1, len(SETTINGS), figsize=(PAGE, 2.8), sharey=True, layout="constrained"
    )
    for panel, setting in zip(axes, SETTINGS, strict=True):
        rows = rows_of(setting)
        rows = rows[rows["method"] == OURS]
        predicted = 1.0 - rows[[f"p_{k + 1}" for k in range(MISSIONS)]].to_numpy().ravel()
        failed = np.array([sign != "." for status in rows["status"] for sign in status])
        index = np.digitize(predicted, _BINS)
        for k in np.unique(index):
            here = index == k
            n = here.sum()
            low, high = stats.beta.ppf([0.025, 0.975], 0.5 + failed[here].sum(),
                                       0.5 + n - failed[here].sum())  # fmt: skip
            at = predicted[here].mean()
            panel.plot([at, at], [low, high], color=SHOWN[OURS], linewidth=1.5)
            panel.plot(at, failed[here].mean(), "o", color=SHOWN[OURS], markersize=4.0)
            panel.annotate(
                f"{n}", (at, low), xytext=(4, -2), textcoords="offset points", fontsize=7.0
            )
        panel.plot(_RANGE, _RANGE, color=GREY, linewidth=0.8)
        panel.set(xscale="log", yscale="log", xlim=_RANGE, ylim=_RANGE)
        panel.set_title(TITLES[setting], fontsize=8.0)
        panel.set_xlabel("predicted probability of failure")
    axes[0].set_ylabel("share that failed")
    return figure


DRAWN: dict[str, Callable[[], Figure]] = {
    "learning": learning, "worlds": worlds, "arrivals": arrivals,
}  # fmt: skip


def main() -> None:
    parser = arguments(__doc__ or "", names=DRAWN)
    parser.add_argument("--out", type=Path, default=FIGURES)
    given = parsed(parser)
    mpl.use("agg")
    given.out.mkdir(parents=True, exist_ok=True)
    for name in given.names:
        for suffix, colours in (("", {}), ("-dark", DARK)):
            with mpl.rc_context({**RC, "font.size": 8.0, "legend.fontsize": 8.0, **colours}):
                figure = DRAWN[name]()
                figure.savefig(given.out / f"{name}{suffix}.png", dpi=110)
                plt.close(figure)


if __name__ == "__main__":
    main()
