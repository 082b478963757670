"""Ranks and coverage of simulation-based calibration."""

from typing import Any, Unpack

import numpy as np
import xarray as xr
from matplotlib.lines import Line2D
from scipy import stats

from trustbo.errors import require_kind
from trustbo.plots.layout import DASHES, MARKERS, as_text, plain, small_multiples
from trustbo.plots.style import SMALL, Style, StyleOptions, curve_colours, theme

_PROBABILITY = 0.95


def calibration(ranks: xr.Dataset, **style: Unpack[StyleOptions]) -> np.ndarray:
    """Compare ranks of true values among posterior draws, and coverage of intervals, with theory.

    Left: difference of each parameter's empirical distribution of ranks from the uniform one. If
    the parameter is calibrated, the whole curve stays within the grey band with a probability of
    95 % (Kolmogorov-Smirnov). Right: share of true values in central intervals; the grey bars hold
    95 % of such shares if the parameter is calibrated (binomial).

    Args:
        ranks: Dataset of `inference.sbc`.
        **style: Options of `Style`; `cmap` is that of the curves.

    Returns:
        Axes, shape (2,).
    """
    require_kind("plots.calibration", ranks, xr.Dataset, "give the Dataset of inference.sbc")
    options, colours = Style.from_options(style), theme()
    made = small_multiples(2, (3.6, 2.9), options, least=2.4)
    curves, cover = made.panels
    n, names = ranks.sizes["dataset"], [str(name) for name in ranks["parameter"].values]
    shades = curve_colours(len(names), options)
    widths, keys = ranks["interval"].values, []
    dodge = 0.025 * (np.linspace(-1.0, 1.0, len(names)) if len(names) > 1 else np.zeros(1))
    far = float(stats.kstwo.ppf(_PROBABILITY, n))
    curves.axhspan(-far, far, color=colours.band, linewidth=0.0)
    for i, name in enumerate(names):
        pit = np.sort(ranks["pit"].sel(parameter=name).values)
        # A step at each rank.
        x = np.concatenate([[0.0], np.repeat(pit, 2), [1.0]])
        above = np.concatenate([[0.0, 0.0], np.repeat(np.arange(1, n + 1) / n, 2)])
        drawn: dict[str, Any] = {
            "color": shades[i],
            "linestyle": DASHES[i % len(DASHES)],
            "linewidth": 1.1,
        }
        curves.plot(x, above - x, **drawn)
        marker: dict[str, Any] = {"marker": MARKERS[i % len(MARKERS)], "markersize": 4.0}
        cover.plot(
            widths + dodge[i], ranks["coverage"].sel(parameter=name).values,
            **drawn | marker | {"linestyle": "none"},
        )  # fmt: skip
        keys.append(Line2D([], [], label=as_text(name), **drawn | marker))
    curves.set(xlim=(0.0, 1.0))
    curves.set_xlabel("rank of the truth among the draws, as a share", fontsize=SMALL)
    curves.set_ylabel("share of ranks below,\nless uniform", fontsize=SMALL)
    expected = np.array([stats.binom.ppf((0.025, 0.975), n, width) / n for width in widths])
    cover.vlines(widths, *expected.T, color=colours.band, linewidth=16.0, zorder=0)
    cover.plot([0.0, 1.0], [0.0, 1.0], color=colours.quiet, linewidth=0.8)
    cover.set(xlim=(0.0, 1.04), ylim=(0.0, 1.04))
    cover.set_xlabel("probability of the interval", fontsize=SMALL)
    cover.set_ylabel("share of truths in it", fontsize=SMALL)
    for ax in made.panels:
        plain(ax)
    made.titles()
    subtitle = f"{n} data sets, {ranks.attrs.get('sampler', 'unknown')} sampler"
    made.legend(keys, title=subtitle, title_fontsize=SMALL, ncols=min(len(keys), 5))
    return made.panels
