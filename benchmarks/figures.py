"""Draw the figures of docs/evidence.md from stored rows, each for light and for dark pages.

    python benchmarks/figures.py [--out docs/figures]

`learning`: contact lost by mission, for each group of worlds and setting. `worlds`: trustbo minus a
baseline in each world, with the t interval of each group. `arrivals`: predicted probability that
a plan fails, and the share of plans that failed. `intervals`: shares of true rates in 90 %
intervals of trust, and their width. `paths`: the paper's method minus random paths.
"""

from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from calibration import STRATA, by_world, rows_in
from common import arguments, parsed
from contact import MISSIONS
from groups import ALIKE, over_worlds
from matplotlib.figure import Figure
from scipy import stats
from tables import OURS, STORED, TITLES, difference, of_worlds, rows_of, settings

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
OF_PAPER = {
    "lost per mission": "contact lost, bounds",
    "regret after": "regret after 8 missions, %",
    "sd of weights": "sd of weights",
}
"""Columns of the rows of `paper.py` that are drawn, and their titles."""
_FARTHEST = 1.0
"""Largest difference that is drawn; dots beyond it are drawn there."""
_BINS = (0.01, 0.03, 0.1, 0.3)
"""Limits of the predicted probability of failure in the figure of arrivals."""
_RANGE = (1e-3, 1.0)
"""Range of its axes."""


def learning() -> Figure:
    """Draw the mean contact lost by mission, a column for each group and a row for each setting."""
    figure, axes = plt.subplots(
        len(settings()), len(ALIKE), figsize=(PAGE, 0.8 + 1.4 * len(settings())), sharex=True,
        sharey="col", squeeze=False, layout="constrained",
    )  # fmt: skip
    missions = np.arange(1, MISSIONS + 1)
    for row, setting in zip(axes, settings(), strict=True):
        rows = rows_of(setting)
        for panel, (group, kinds) in zip(row, ALIKE.items(), strict=True):
            some = rows[rows["kind"].isin(kinds)]
            for method, colour in SHOWN.items():
                of_method = some[some["method"] == method]
                lost = of_method[[f"lost_{k}" for k in missions]].mean()
                panel.plot(missions, lost, color=colour, label=method, linewidth=1.3)
            if setting == settings()[0]:
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
        1, len(settings()), figsize=(PAGE, 2.6), sharey=True, squeeze=False, layout="constrained"
    )
    rng = np.random.default_rng(0)
    for panel, setting in zip(axes[0], settings(), strict=True):
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
        1, len(settings()), figsize=(PAGE, 2.8), sharey=True, squeeze=False, layout="constrained"
    )
    for panel, setting in zip(axes[0], settings(), strict=True):
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
    axes[0, 0].set_ylabel("share that failed")
    return figure


def intervals() -> Figure:
    """Draw the coverage and width of 90 % intervals of trust, by true rate and by model."""
    found = by_world(rows_in(STORED / "calibration.csv"))
    figure, axes = plt.subplots(
        2, 2, figsize=(PAGE, 3.6), sharex=True, sharey="row", layout="constrained"
    )
    colours = dict(zip(dict.fromkeys(found["model"]), (ROBOTS[0], ROBOTS[1]), strict=True))
    for column, of_set in zip(axes.T, ("driven", "undriven"), strict=True):
        for panel, measure in zip(column, ("trust90", "width"), strict=True):
            for k, (model, colour) in enumerate(colours.items()):
                some = found[(found["set"] == of_set) & (found["model"] == model)]
                for x, stratum in enumerate(STRATA):
                    here = some[some["stratum"] == stratum]
                    mean, low, high, _ = over_worlds(here[measure].to_numpy(), here["world"])
                    at = x + 0.15 * (2 * k - 1)
                    panel.plot([at, at], [low, high], color=colour, linewidth=1.5)
                    label = model if x == 0 else None
                    panel.plot(at, mean, "o", color=colour, markersize=4.0, label=label)
        column[0].axhline(0.9, color=GREY, linewidth=0.8)
        column[0].set_title(f"{of_set} bounds", fontsize=8.0)
        column[1].set_ylim(bottom=0.0)
        column[1].set_xticks(range(len(STRATA)), ["all", "exactly 1", ".97 to 1", "below .97"])
        column[1].set_xlabel("true rate")
    axes[0, 0].set_ylabel("share in the interval")
    axes[1, 0].set_ylabel("width")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    return figure


def paths() -> Figure:
    """Draw the paper's method minus random paths, for both objectives, with t intervals."""
    numbers = pd.read_csv(STORED / "paper.csv")
    figure, axes = plt.subplots(
        1, len(OF_PAPER), figsize=(PAGE, 1.5), sharey=True, layout="constrained"
    )
    objectives = {"(6)": "cost (6)", "mean": "mean trust"}
    for panel, (column, title) in zip(axes, OF_PAPER.items(), strict=True):
        for k, objective in enumerate(objectives):
            greedy, random = (
                numbers[numbers["method"] == f"{policy}, {objective}"].set_index("world")[column]
                for policy in ("greedy", "random")
            )
            apart = (greedy - random).dropna()
            mean, low, high, _ = over_worlds(apart.to_numpy(), apart.index)
            panel.plot([low, high], [k, k], color=SHOWN[OURS], linewidth=2.0)
            panel.plot(mean, k, "o", color=SHOWN[OURS], markersize=5.0)
        panel.axvline(0.0, color=GREY, linewidth=0.8)
        panel.set_xlabel(title)
        panel.set_yticks(range(len(objectives)), list(objectives.values()))
        panel.set_ylim(len(objectives) - 0.5, -0.5)
    return figure


DRAWN: dict[str, Callable[[], Figure]] = {
    "learning": learning, "worlds": worlds, "arrivals": arrivals, "intervals": intervals,
    "paths": paths,
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
