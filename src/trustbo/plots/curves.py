"""Figures of trust along a mission, of a campaign's history and of robot effects."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from trustbo.errors import TrustboError, require_choice, require_kind, require_whole
from trustbo.inference.order import as_fitted
from trustbo.planning.plan import QUANTILES, Plan
from trustbo.plots.style import (
    GREY,
    ROBOTS,
    accent,
    add_legend,
    as_text,
    background,
    handles_of,
    ink,
    is_broad,
    panels,
    robot_looks,
    styled,
)

_LABELS = {
    "contact_lost": "contact lost\n(bounds)",
    "lost_share": "contact lost\n(% of bounds)",
    "objective": "objective\n(predicted)",
    "regret": "regret (%)",
}
"""Axis labels of the variables that `campaign_history` plots, keyed by name."""
_FEW_TICKS = 3
"""Number of intervals between the ticks of a narrow panel."""
_MARGIN = 0.1
"""Space above and below the points of a panel, as a fraction of its height."""
_LOST = "lost_contact"
"""Objective that predicts minus the contact lost, in bounds."""
SMALL_EFFECT = 0.1
"""Robot effect, as a fraction of contact, up to which plans hardly change."""
_SPREAD = 0.2
"""Largest shift of a robot's markers from the number of their mission, so that they do not overlap.
"""


@styled
def trust_curves(given: xr.DataTree | Plan, mission: int = -1, *, ax: Any = None) -> np.ndarray:
    """Plot the trust in each robot along a mission or a plan, with 50 % and 90 % bands.

    Args:
        given: Posterior from `tb.fit`, whose measured contact rates are plotted as dots; or a plan
            computed from a posterior, such as `Result.plan()`.
        mission: Index of the mission in a posterior; negative indices count from the last.
        ax: Axes to draw on, one for each robot; by default a new figure.

    Returns:
        Axes, shape (robot,).

    Raises:
        TrustboError: There is no such mission, or the posterior has no latent trust.

    Example:
        >>> tb.plots.trust_curves(result.posterior)  # trust in the last mission
        >>> tb.plots.trust_curves(result.plan())  # trust predicted along the recommended path
    """
    if isinstance(given, Plan):
        x = np.arange(1, len(given.trust) + 1)
        middle = given.trust
        bands = given.bands
        rates = np.full(middle.shape, np.nan)
        robots = given.workspace.team.names
    else:
        x, middle, bands, rates, robots = _latent_trust(given, mission)

    axes = panels(len(robots), ax, (2.4, 1.9), sharex=True, sharey=True)
    style: dict[str, Any] = {"color": accent(), "linewidth": 0.0}
    for i, (panel, name) in enumerate(zip(axes, robots, strict=True)):
        low, lower, upper, high = bands[..., i]
        panel.fill_between(x, low, high, alpha=0.25, label="90 %", **style)
        panel.fill_between(x, lower, upper, alpha=0.5, label="50 %", **style)
        marker = "." if len(x) == 1 else ""  # a line of one point is invisible
        panel.plot(x, middle[:, i], color=accent(), marker=marker, label="trust")
        if np.isfinite(rates[:, i]).any():
            panel.plot(x, rates[:, i], "o", color=ink(), markersize=3.5, label="contact rate")
        panel.set(title=as_text(name), xlabel="bound")
        n_ticks = "auto" if is_broad(panel) else _FEW_TICKS
        panel.xaxis.set_major_locator(MaxNLocator(n_ticks, integer=True))

    low, high = np.transpose([panel.get_ylim() for panel in axes])
    for panel in axes:  # the user's axes may have scales of their own
        panel.set_ylim(low.min(), high.max())
        if panel.get_subplotspec() is not None:
            panel.label_outer()

    axes[0].set_ylabel("trust, contact rate")
    add_legend(axes, handles_of(axes[0]))
    return axes


def _latent_trust(
    posterior: xr.DataTree, mission: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Sequence[str]]:
    """Return bounds, trust medians and quantiles, contact rates and robots of a mission."""
    posterior = as_fitted("trust_curves", posterior)
    if "latent" not in posterior.children:
        raise TrustboError(
            "this posterior has no latent trust; use inference.add_latent(posterior, missions)."
        )

    latent = posterior["latent"].to_dataset()
    n = latent.sizes["mission"]
    mission = require_whole("mission", mission, -n, n - 1)
    trust = latent["trust"].isel(mission=mission).dropna("bound", how="all")
    trust = trust.transpose("chain", "draw", "bound", "robot")
    rates = posterior["observed_data"]["contact_rate"].isel(mission=mission)
    rates = rates.sel(bound=trust["bound"]).transpose("bound", "robot").values

    middle = np.median(trust, (0, 1))
    bands = np.quantile(trust, QUANTILES, axis=(0, 1))
    return trust["bound"].values, middle, bands, rates, trust["robot"].values.tolist()


@styled
def campaign_history(history: xr.Dataset, *, ax: Any = None) -> np.ndarray:
    """Plot the contact, the objective and, if given, the regret of each mission.

    A filled dot marks a plan that differs from the previous plan. A cross marks a mission that did
    not reach the goal. With the objective `lost_contact`, the measured and the predicted contact
    lost share one axis, in bounds; predictions include the costs of failures. If the missions have
    several courses, whose lengths may differ, the contact lost is also shown as a share of the
    bounds of each mission.

    Args:
        history: History of a campaign, `Result.history`; see `Result.plot_history` for regret.
        ax: Axes to draw on, one for each variable; by default a new figure.

    Returns:
        Axes, shape (variable,): contact lost, its share of the bounds if there are several courses,
        the objective unless it shares the axes of contact lost, and regret.
    """
    predicts_lost = history.attrs.get("objective") == _LOST
    names = [name for name in _LABELS if name in history]
    if predicts_lost:
        names.remove("objective")
    if "lost_share" in names and not _has_several_courses(history):
        names.remove("lost_share")

    n_planned = (history["path"].isel(axis=0) >= 0).sum("step").values - 1
    factors = {"lost_share": 100.0}
    predicted = {
        "contact_lost": -history["objective"].values,
        "lost_share": -history["objective"].values / n_planned,
    }

    mission = history["iteration"].values
    changed = history["path_changed"].values.astype(bool) | (mission == mission[0])
    failed = history["status"].values.astype(str) != "ok"
    prefix = "measured, " if predicts_lost else ""
    dots = (changed, accent(), f"{prefix}new path"), (~changed, background(), f"{prefix}same path")

    height = 2.6 if len(names) == 1 else 1.8  # in inches
    axes = panels(len(names), ax, (4.0, height), columns=1, sharex=True)
    for panel, name in zip(axes, names, strict=True):
        factor = factors.get(name, 1.0)
        values = factor * history[name].values
        panel.plot(mission, values, color=accent(), linewidth=1.6)
        if name in predicted and predicts_lost:
            style = {"color": ink(), "markersize": 14.0, "label": "predicted by the plan"}
            panel.plot(mission, factor * predicted[name], "_", markeredgewidth=1.6, **style)
        for which, fill, label in dots:
            style = {"color": accent(), "markerfacecolor": fill, "label": label}
            panel.plot(mission[which], values[which], "o", markersize=6.5, **style)
        if failed.any():
            cross = {"color": ROBOTS[1], "markersize": 11.0, "label": "goal not reached"}
            panel.plot(mission[failed], values[failed], "x", markeredgewidth=2.0, **cross)

        panel.set_ylabel(_LABELS[name])
        panel.margins(y=_MARGIN)
        if name in predicted:
            panel.set_ylim(bottom=min(0.0, *panel.get_ylim()))

    axes[-1].set_xlabel("mission")
    axes[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    add_legend(axes, handles_of(axes[0]))
    return axes


def _has_several_courses(history: xr.Dataset) -> bool:
    """Return whether the missions of a history differ in their start or goal."""
    return len(set(zip(history["start"].values, history["goal"].values, strict=True))) > 1


@styled
def robot_effects(table: pd.DataFrame, *, ax: Axes | None = None) -> Axes:
    """Plot the effect of each robot in each mission, with bars of two standard deviations.

    The grey band marks effects that hardly change a plan. Filled markers show robots that stand out
    from the team. Bars that are shorter than the marker are hidden.

    Args:
        table: Table `robots` of a `tb.check`, with one row for each mission and robot. Its columns
            are `mission` (from 1), `robot`, `effect`, `sd` and `stands_out`.
        ax: Axes to draw on; by default a new figure.

    Returns:
        Axes with the effects.

    Raises:
        TrustboError: The model has no robot effects, or a column is missing.

    Example:
        >>> tb.plots.robot_effects(tb.check(result).robots)
    """
    require_kind("table", table, pd.DataFrame, "give tb.check(result).robots")
    if table.empty:
        raise TrustboError(
            "the table is empty, because the model has no robot effects; use a model with "
            "models.RobotEffect(), such as the default model."
        )
    for name in ("mission", "robot", "effect", "sd", "stands_out"):
        require_choice("column", name, [str(column) for column in table.columns])

    axes = panels(1, ax, (4.0, 2.6))
    panel = axes[0]
    panel.axhspan(-SMALL_EFFECT, SMALL_EFFECT, color=GREY, alpha=0.25, linewidth=0.0)
    place: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
    place |= {"ha": "right", "va": "top"}
    panel.annotate("small effect", (1.0, SMALL_EFFECT), (-2.0, -1.0), color=ink(), **place)
    robots = table["robot"].unique()
    shifts = np.linspace(-_SPREAD, _SPREAD, len(robots)) if len(robots) > 1 else [0.0]

    for shift, (name, colour, marker) in zip(shifts, robot_looks(robots), strict=True):
        rows = table[table["robot"] == name]
        odd = rows[rows["stands_out"].astype(bool)]
        x = rows["mission"] + shift
        y = rows["effect"]
        panel.errorbar(x, y, 2.0 * rows["sd"], color=colour, fmt="none", elinewidth=1.0)
        panel.plot(x, y, marker, color=colour, markerfacecolor=background(), label=name)
        panel.plot(odd["mission"] + shift, odd["effect"], marker, color=colour)

    panel.margins(y=_MARGIN)
    panel.set(xlabel="mission", ylabel="effect on contact\nat full sight")
    panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    add_legend(axes, handles_of(panel))
    return panel
