"""Figure of a criticism: tests, residuals and coverage of a fitted model."""

from typing import Any, Unpack

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator

from trustbo.criticism.criticise import Criticism
from trustbo.errors import require_kind
from trustbo.plots.layout import PAGE, Panels, as_text, plain, small_multiples
from trustbo.plots.places import BETTER_WORSE
from trustbo.plots.style import SMALL, Style, StyleOptions, theme

_LEVEL = 0.05
_LEAST_SHARE, _MOST_SHARE = 0.02, 20.0
"""Limits of the axis of sizes."""
_LEAST_WIDTH = 1.8
"""Least width of a panel, inches."""
_LETTERS = 20
"""Letters that fit below a panel side by side."""
_KINDS = ("mission", "bound", "robot", "contact")


def criticism(found: Criticism, **style: Unpack[StyleOptions]) -> np.ndarray:
    """Draw the tests, residuals and coverage of a criticism.

    Checks by their size relative to that of a fault, red where one is found; the distribution of
    PIT values less the uniform one; coverage one mission ahead; autocorrelation;
    and mean standardised residuals by mission, bound, robot, class of expected contact rate and
    cell, there in units of the band. Grey bands hold a whole panel with a probability of 95 % where
    the model is right; what lies outside is red, and framed on the map of cells.

    Args:
        found: Criticism of `tb.criticise`.
        **style: Options of `Style`; `cmap` is that of the cells.

    Returns:
        Axes, shape (9,).
    """
    require_kind("plots.criticism", found, Criticism, "give a Criticism, from tb.criticise")
    options = Style.from_options(style)
    alone = options.ax is None and (options.width or PAGE) < 2.0 * _LEAST_WIDTH
    height = 1.4 if alone else 2.2  # nine panels in a column are a page high
    made = small_multiples(9, (2.5, height), options, least=_LEAST_WIDTH)
    tests, pit, cover, correlation, *groups, cells = made.panels
    _draw_tests(tests, found)
    _draw_curves(pit, cover, correlation, found.curves)
    for ax, kind in zip(groups, _KINDS, strict=True):
        _draw_groups(ax, found, kind)
    _draw_cells(cells, found, made)
    for ax in made.panels:
        plain(ax)
    made.titles()
    made.legend(_keys(), ncols=4)
    return made.panels


def _keys() -> list[Line2D | Patch]:
    colours = theme()
    dot: dict[str, Any] = {"marker": "o", "linestyle": "none", "markersize": 4.5}
    return [
        Line2D([], [], color=colours.ink, label="as expected", **dot),
        Line2D([], [], color=colours.odd, label="stands out", **dot),
        Patch(facecolor=colours.band, label="95 % if the model is right"),
    ]


def _draw_tests(ax: Axes, criticism: Criticism) -> None:
    columns = ("size", "limit", "p_adjusted")
    size, limit, p = (criticism.table[name].to_numpy(dtype=float) for name in columns)
    drawn = np.isfinite(size) & np.isfinite(limit)
    share = np.clip(size / limit, _LEAST_SHARE, _MOST_SHARE)[drawn]
    names = criticism.table.index.to_numpy()[drawn]
    labelled = criticism.table["label"].to_numpy()[drawn] != ""
    stands_out = labelled & (share > 1.0) & ~(p[drawn] > _LEVEL)
    y = np.arange(len(share))[::-1]
    ax.axvspan(_LEAST_SHARE / 2.0, 1.0, color=theme().band, linewidth=0.0)
    ax.scatter(share, y, s=22, color=np.where(stands_out, theme().odd, theme().ink), zorder=4)
    ax.set(xscale="log", xlim=(_LEAST_SHARE / 1.5, 1.5 * _MOST_SHARE), ylim=(-0.7, len(y) - 0.3))
    ax.set_yticks(y, names)
    for label, name in zip(ax.get_yticklabels(), names, strict=True):
        label.set_fontweight("bold" if name == criticism.fault else "normal")
    ax.set_xlabel("size / that of a fault (grey: smaller)", fontsize=SMALL)


def _draw_curves(pit: Axes, cover: Axes, correlation: Axes, curves: xr.Dataset) -> None:
    u = curves["u"].values
    pit.fill_between(u, curves["pit_low"], curves["pit_high"], color=theme().band, linewidth=0.0)
    pit.plot(u, curves["pit"], color=theme().ink, linewidth=1.2)
    _mark(pit, u, curves, "pit")
    pit.set_xlabel("PIT of rates one bound ahead", fontsize=SMALL)
    pit.set_ylabel("share below,\nless uniform", fontsize=SMALL)
    if "coverage" in curves:
        level, low, high = (curves[n].values for n in ("level", "coverage_low", "coverage_high"))
        x = np.arange(len(level))
        cover.bar(x, high - low, 0.7, bottom=low - level, color=theme().band)
        cover.axhline(0.0, color=theme().quiet, linewidth=0.8)
        cover.plot(x, curves["coverage"] - level, "o", color=theme().ink, markersize=4.5)
        outside = (curves["coverage"].values < low) | (curves["coverage"].values > high)
        cover.plot(
            x[outside], (curves["coverage"] - level)[outside], "o", color=theme().odd, markersize=5
        )
        cover.set_xticks(x, [f"{p:.0%}" for p in level])
    cover.set_xlabel("interval one mission ahead", fontsize=SMALL)
    cover.set_ylabel("share inside,\nless nominal", fontsize=SMALL)
    ticks, lags = [], []
    for name, axis in (("autocorrelation", "lag"), ("autocorrelation_missions", "mission_lag")):
        if name not in curves:  # missions of one bound, or only one mission
            continue
        x = curves[axis].values + (ticks[-1] + 1 if ticks else 0)
        low, high = curves[f"{name}_low"].values, curves[f"{name}_high"].values
        correlation.bar(x, high - low, 0.8, bottom=low, color=theme().band)
        correlation.vlines(x, 0.0, curves[name], color=theme().ink, linewidth=1.5)
        _mark(correlation, x, curves, name)
        ticks, lags = [*ticks, *x], [*lags, *curves[axis].values]
    correlation.axhline(0.0, color=theme().quiet, linewidth=0.8)
    correlation.set_xticks(ticks, lags)
    correlation.set_xlabel("lag in bounds | lag in missions", fontsize=SMALL)
    correlation.set_ylabel("autocorrelation", fontsize=SMALL)


def _mark(ax: Axes, x: np.ndarray, curves: xr.Dataset, name: str) -> None:
    """Points of a curve outside its band."""
    y = curves[name].values
    outside = (y < curves[f"{name}_low"].values) | (y > curves[f"{name}_high"].values)
    ax.plot(x[outside], y[outside], "o", color=theme().odd, markersize=4, zorder=4)


def _draw_groups(ax: Axes, criticism: Criticism, kind: str) -> None:
    groups = _groups_of(criticism, kind)
    mean, band = (groups[name].to_numpy(dtype=float) for name in ("mean", "band"))
    odd, labels = groups["stands_out"].to_numpy(dtype=bool), list(groups["group"])
    x = np.arange(len(mean)) if kind in ("robot", "contact") else np.array(labels, dtype=float)
    ax.bar(x, 2.0 * band, 0.8, bottom=-band, color=theme().band)
    ax.axhline(0.0, color=theme().quiet, linewidth=0.8)
    ax.plot(x[~odd], mean[~odd], "o", color=theme().ink, markersize=4)
    ax.plot(x[odd], mean[odd], "o", color=theme().odd, markersize=5)
    if kind in ("robot", "contact"):
        texts = [as_text(str(label)) for label in labels]
        crowded = sum(len(text) + 1 for text in texts) > _LETTERS
        ax.set_xticks(x, texts, rotation=90.0 * crowded)
    else:
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("expected contact rate" if kind == "contact" else kind, fontsize=SMALL)
    ax.set_ylabel("mean residual (sd)", fontsize=SMALL)


def _draw_cells(ax: Axes, criticism: Criticism, made: Panels) -> None:
    groups = _groups_of(criticism, "cell")
    cells = np.array(list(groups["group"]))
    values = np.full(tuple(cells.max(0) + 1), np.nan)
    mean, band = (groups[name].to_numpy(dtype=float) for name in ("mean", "band"))
    values[*cells.T] = mean / band
    far = max(float(np.nanmax(np.abs(values))), 1.0)
    image = ax.imshow(values, cmap=made.style.colours(BETTER_WORSE), vmin=-far, vmax=far)
    for row, col in cells[groups["stands_out"].to_numpy(dtype=bool)]:
        corner = col - 0.5, row - 0.5
        ax.add_patch(Rectangle(corner, 1.0, 1.0, fill=False, edgecolor="black", linewidth=1.6))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("column of the cell entered", fontsize=SMALL)
    ax.set_ylabel("row", fontsize=SMALL)
    made.colour_bar(image, "mean residual / band", axes=[ax])


def _groups_of(criticism: Criticism, kind: str) -> pd.DataFrame:
    return criticism.groups.loc[criticism.groups["kind"].to_numpy() == kind, :]
