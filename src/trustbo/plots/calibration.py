"""Ranks and coverage of simulation-based calibration."""

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.lines import Line2D
from scipy import stats

from trustbo.plots.layout import DASHES, MARKERS, as_text, plain, small_multiples

_PROBABILITY = 0.95


def calibration(ranks: xr.Dataset) -> np.ndarray:
    """Compare ranks of true values among posterior draws, and coverage of intervals, with theory.

    Left: difference of each parameter's empirical distribution of ranks from the uniform one. If
    the parameter is calibrated, the whole curve stays within the grey band with a probability of
    95 % (Kolmogorov-Smirnov). Right: share of true values in central intervals; the grey bars hold
    95 % of such shares if the parameter is calibrated (binomial).

    Args:
        ranks: Dataset of `models.sbc`.

    Returns:
        Axes, shape (2,).
    """
    figure, _, panels = small_multiples(2, 2, (3.4, 2.9), margin=1.2)
    curves, cover = panels
    n, names = ranks.sizes["dataset"], [str(name) for name in ranks["parameter"].values]
    shades = colormaps["viridis"](np.linspace(0.0, 0.85, len(names)))
    widths, keys = ranks["interval"].values, []
    dodge = 0.025 * (np.linspace(-1.0, 1.0, len(names)) if len(names) > 1 else np.zeros(1))
    far = float(stats.kstwo.ppf(_PROBABILITY, n))
    curves.axhspan(-far, far, color="0.9", linewidth=0.0)
    for i, name in enumerate(names):
        pit = np.sort(ranks["pit"].sel(parameter=name).values)
        # A step at each rank.
        x = np.concatenate([[0.0], np.repeat(pit, 2), [1.0]])
        above = np.concatenate([[0.0, 0.0], np.repeat(np.arange(1, n + 1) / n, 2)])
        style = {"color": shades[i], "linestyle": DASHES[i % len(DASHES)], "linewidth": 1.1}
        curves.plot(x, above - x, **style)
        marker = {"marker": MARKERS[i % len(MARKERS)], "markersize": 4.0}
        cover.plot(
            widths + dodge[i], ranks["coverage"].sel(parameter=name).values,
            **style | marker | {"linestyle": "none"},
        )  # fmt: skip
        keys.append(Line2D([], [], label=as_text(name), **style | marker))
    curves.set(xlim=(0.0, 1.0))
    curves.set_xlabel("rank of the truth among the draws, as a share", fontsize=8)
    curves.set_ylabel("share of ranks below, less uniform", fontsize=8)
    expected = np.array([stats.binom.ppf((0.025, 0.975), n, width) / n for width in widths])
    cover.vlines(widths, *expected.T, color="0.87", linewidth=16.0, zorder=0)
    cover.plot([0.0, 1.0], [0.0, 1.0], color="0.5", linewidth=0.8)
    cover.set(xlim=(0.0, 1.04), ylim=(0.0, 1.04))
    cover.set_xlabel("probability of the interval", fontsize=8)
    cover.set_ylabel("share of truths in it", fontsize=8)
    for ax in panels:
        plain(ax)
    title = f"{n} data sets,\n{ranks.attrs.get('sampler', 'unknown')} sampler"
    figure.legend(
        handles=keys,
        loc="outside right upper",
        title=title,
        fontsize=7,
        title_fontsize=8,
        frameon=False,
    )
    return panels
