"""History of a campaign: posteriors of the parameters, and outcomes of the missions."""

from collections.abc import Mapping, Sequence
from typing import Any, Unpack

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from trustbo.errors import TrustboError, require_choice, require_kind
from trustbo.inference.posterior_tree import labelled_draws
from trustbo.planning.plan import QUANTILES
from trustbo.plots.layout import plain, small_multiples
from trustbo.plots.style import SMALL, Style, StyleOptions, theme

MOST_PANELS = 64
_TRUE = (0, (4, 2))


def parameter_history(
    posteriors: Sequence[xr.DataTree],
    *,
    names: Sequence[str] | None = None,
    truth: Mapping[str, float] | None = None,
    **style: Unpack[StyleOptions],
) -> np.ndarray:
    """Draw the posterior of each parameter after each mission, and the prior.

    Thin bars hold 90 % of the draws, thick ones 50 %, dots are medians. Panels are scaled to the
    posteriors; a wide prior, in grey, may extend beyond them. Returns Axes (parameter,), titled by
    labels such as "beta[visibility]".

    Args:
        posteriors: Posterior after each mission, such as `Result.posteriors`.
        names: Parameters to draw, such as `["beta0", "beta"]`; by default all.
        truth: True values by label, such as `{"beta[visibility]": 0.4}`, where they are known.
        **style: Options of `Style`.

    Raises:
        TrustboError: There are no posteriors, a parameter or label is unknown, or there are too
            many parameters to be legible.
    """
    such = "give a list of posteriors, such as Result.posteriors"
    require_kind("plots.parameter_history", posteriors, Sequence, such)
    options, colours = Style.from_options(style), theme()
    if not posteriors:
        raise TrustboError("there are no posteriors; give one for each mission.")
    available = [str(name) for name in posteriors[-1]["posterior"].data_vars]
    chosen = [require_choice("parameter", n, available) for n in names or available]
    last = _scalars(posteriors[-1], "posterior", chosen)
    if len(last) > MOST_PANELS:
        raise TrustboError(
            f"{len(last)} parameters need as many panels; choose at most {MOST_PANELS} by names=, "
            f"of {', '.join(available)}."
        )
    for label in truth or {}:
        require_choice("label in truth", label, last)
    prior = _scalars(posteriors[-1], "prior", chosen)
    after = [_scalars(posterior, "posterior", chosen) for posterior in posteriors]
    made = small_multiples(len(last), (2.5, 1.6), options, sharex=True, least=1.4)
    for ax, label in zip(made.panels, last, strict=True):
        _draw_parameter(ax, prior.get(label), [draws[label] for draws in after])
        if truth is not None and label in truth:
            ax.axhline(truth[label], color=colours.ink, linewidth=0.9, linestyle=_TRUE)
        ax.set_xlim(-0.6, len(after) + 0.6)
        ax.xaxis.set_major_locator(MaxNLocator(nbins=4, integer=True))
        ax.yaxis.set_major_locator(MaxNLocator(nbins=4))
        plain(ax)
    made.titles(list(last))
    made.label_lower("missions")
    made.legend(_keys(truth is not None), ncols=4)
    return made.panels


def _keys(with_truth: bool) -> list[Line2D]:
    """Legend of the bars and dots of parameters."""
    colours = theme()
    dot: dict[str, Any] = {"marker": "o", "linestyle": "none", "markersize": 4.5}
    keys = [
        Line2D([], [], color=colours.line, label="median", **dot),
        Line2D([], [], color=colours.line, linewidth=3.0, label="50 %"),
        Line2D([], [], color=colours.line, linewidth=1.0, label="90 % of the posterior"),
        Line2D([], [], color=colours.quiet, linewidth=3.0, label="prior"),
    ]
    truth = Line2D([], [], color=colours.ink, linewidth=0.9, linestyle=_TRUE, label="truth")
    return [*keys, truth] if with_truth else keys


def campaign_history(history: xr.Dataset, **style: Unpack[StyleOptions]) -> np.ndarray:
    """Draw the objective of each plan, and the contact rate of its mission.

    A filled dot marks a path that differs from the previous one; a cross, with the status, a
    mission that did not reach the goal.

    Args:
        history: `Result.history` or `Campaign.history`.
        **style: Options of `Style`.

    Returns:
        Axes, shape (2,): objective of the plans, mean contact rate of the missions.

    Raises:
        TrustboError: The history is empty.
    """
    require_kind(
        "plots.campaign_history", history, xr.Dataset, "give a history, such as Result.history"
    )
    options, colours = Style.from_options(style), theme()
    if not history.sizes.get("iteration"):
        raise TrustboError("the history has no mission yet; tell the campaign one first.")
    made = small_multiples(2, (4.6, 1.6), options, columns=1, sharex=True)
    panels = made.panels
    mission, changed = history["iteration"].values, history["path_changed"].values.astype(bool)
    changed[0] |= mission[0] == 1  # the first path is new
    status = [str(s) for s in history["status"].values]
    failed = np.array([s != "ok" for s in status])
    for ax, name, label in (
        (panels[0], "objective", "objective\nwhen planned"),
        (panels[1], "contact_rate", "contact rate\nmeasured"),
    ):
        values = history[name].values
        dots = {"linestyle": "none", "marker": "o", "markersize": 5.5}
        dots["markeredgecolor"] = colours.line
        ax.plot(mission, values, color=colours.inner, linewidth=1.0, zorder=1)
        fills = (changed, colours.line, "a new path"), (~changed, colours.paper, "the same path")
        for which, fill, text in fills:
            ax.plot(mission[which], values[which], color=fill, label=text, **dots)
        ax.set_ylabel(label, fontsize=SMALL)
        plain(ax)
    crosses = {"linestyle": "none", "marker": "x", "markersize": 9, "color": colours.ink}
    rate = history["contact_rate"].values
    if failed.any():
        panels[1].plot(mission[failed], rate[failed], label="not at the goal", **crosses)
    for j in np.flatnonzero(failed):
        panels[1].annotate(
            status[j], (mission[j], rate[j]), (5, 5), textcoords="offset points", fontsize=SMALL
        )
    made.label_lower("mission")
    panels[1].xaxis.set_major_locator(MaxNLocator(integer=True))
    made.titles()
    made.legend(panels[1].get_legend_handles_labels()[0])
    return panels


def _draw_parameter(ax: Axes, prior: np.ndarray | None, after: Sequence[np.ndarray]) -> None:
    ends = np.stack([np.quantile(draws, (*QUANTILES, 0.5)) for draws in after], axis=1)
    bars, colours = [(1.0 + np.arange(len(after)), ends, theme().line)], theme()
    if prior is not None:
        quantiles = np.quantile(prior, (*QUANTILES, 0.5))[:, None]
        bars.append((np.zeros(1), quantiles, colours.quiet))
    for x, (low, lower, upper, high, middle), colour in bars:
        ax.vlines(x, low, high, color=colour, linewidth=1.0)
        ax.vlines(x, lower, upper, color=colour, linewidth=3.0)
        ax.plot(
            x, middle, "o", color=colour, markersize=4.5, markeredgecolor=colours.paper,
            markeredgewidth=0.6,
        )  # fmt: skip
    # The first missions may be uninformative; the later ones set the scale.
    settled = ends[:, len(after) // 4 :]
    low, high = float(settled.min()), float(settled.max())
    margin = 0.15 * max(high - low, 1e-6 * max(abs(high), 1.0))
    ax.set_ylim(low - margin, high + margin)


def _scalars(posterior: xr.DataTree, group: str, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Draws (draw,) by label; empty if there is no such group."""
    if group not in posterior:
        return {}
    chosen = posterior[group].to_dataset()[list(names)]
    return {label: draws for label, _, _, draws in labelled_draws(chosen)}
