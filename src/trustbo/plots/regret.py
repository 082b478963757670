"""Regret of policies, mission by mission, over many runs."""

from collections.abc import Sequence
from typing import Unpack

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from trustbo.errors import TrustboError, require_choice, require_kind
from trustbo.plots.layout import DASHES, MARKERS, plain, small_multiples
from trustbo.plots.style import SMALL, Style, StyleOptions, curve_colours, theme

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Quantiles over the runs: ends of the thin bars, of the thick bars, and the marker."""
_SPREAD = 0.6  # width of the curves side by side, as a share of a mission's


def regret_curves(
    dataset: xr.Dataset,
    *,
    by: str = "policy",
    panels: str | None = None,
    **style: Unpack[StyleOptions],
) -> np.ndarray:
    """Draw the regret of a study after each mission: its median and its spread over the runs.

    Thin bars hold 90 % of the runs, thick ones 50 %. Curves differ in colour, lightness, dashes and
    marker, to be distinct without colour as well.

    Args:
        dataset: Runs of a study, dims (run, mission), from `study.load_study`.
        by: Coordinate of the runs with a value for each curve.
        panels: Coordinate of the runs with a value for each panel, such as `"terrain"`.
        **style: Options of `Style`; `cmap` is that of the curves.

    Returns:
        Axes, shape (panel,).

    Raises:
        TrustboError: This is no dataset; a coordinate is unknown; or regret is missing, as no
            simulator of the study has a truth.
    """
    such = "give a study's dataset, from study.load_study"
    require_kind("plots.regret_curves", dataset, xr.Dataset, such)
    options = Style.from_options(style)
    for name in (by, panels or by):
        require_choice(
            "coordinate", name, [str(n) for n, c in dataset.coords.items() if "run" in c.dims]
        )
    regret = dataset["regret"]
    if not np.isfinite(regret).any():
        raise TrustboError(
            'no regret is known: use simulators of the kind "model", or known_truth of others.'
        )
    names = list(dict.fromkeys(dataset[by].values.tolist()))
    values = [None] if panels is None else list(dict.fromkeys(dataset[panels].values.tolist()))
    width = min(1.0 + 0.16 * len(names) * regret.sizes["mission"], 6.5)
    size, n, titles = (max(width, 2.5), 3.2), len(values), []
    made = small_multiples(n, size, options, columns=n, least=2.2, sharey=True)
    for ax, value in zip(made.panels, values, strict=True):
        chosen = regret if value is None else regret[dataset[panels].values == value]
        _draw(ax, chosen, names, by, options)
        n_runs = [int(np.sum(chosen[by].values == name)) for name in names]
        counted = "-".join(str(n) for n in sorted({min(n_runs), max(n_runs)}))
        titles.append(f"{'' if value is None else f'{panels} {value}, '}{counted} runs each")
    made.titles(titles)
    made.label_lower("mission")
    first = made.panels[0]
    for ax in made.left:
        ax.set_ylabel(
            "regret of the path recommended,\n% of the contact that the best keeps", fontsize=SMALL
        )
    top = max(ax.get_ylim()[1] for ax in made.panels)
    for ax in made.panels:
        ax.set_ylim(-0.03 * top, top)  # shows markers at 0 whole
    # Below the panels, so that it covers no curve.
    keys = first.get_legend_handles_labels()[0]
    label = f"{by}: median, 50 % and 90 % of runs"
    made.legend(keys, title=label, title_fontsize=SMALL, ncols=min(len(keys), 4))
    return made.panels


def _draw(ax: Axes, regret: xr.DataArray, names: Sequence[object], by: str, options: Style) -> None:
    mission, shades, colours = regret["mission"].values, curve_colours(len(names), options), theme()
    # Side by side; shaded bands would cover each other.
    dodge = np.linspace(-0.5, 0.5, len(names)) * _SPREAD if len(names) > 1 else [0.0]
    for i, name in enumerate(names):
        runs = regret.values[regret[by].values == name]
        defined = np.isfinite(runs).any(0)
        if not defined.any():
            continue
        ends = np.nanquantile(runs[:, defined], QUANTILES, axis=0)
        place, own_style = mission[defined] + dodge[i], {"color": shades[i], "zorder": 3}
        ax.vlines(place, ends[0], ends[4], linewidth=0.9, **own_style)
        ax.vlines(place, ends[1], ends[3], linewidth=3.2, **own_style)
        (curve,) = ax.plot(place, ends[2], linewidth=1.1, label=str(name), **own_style)
        curve.set(linestyle=DASHES[i % len(DASHES)], marker=MARKERS[i % len(MARKERS)])
        curve.set(markersize=6.0, markeredgecolor=colours.paper, markeredgewidth=0.6)
    for k in mission[::2]:
        ax.axvspan(k - 0.5, k + 0.5, color=colours.band, alpha=0.4, linewidth=0.0, zorder=0)
    ax.set_xlim(mission[0] - 0.5, mission[-1] + 0.5)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    plain(ax)
