"""Figures of trust along a mission, of a campaign's history and of robot effects."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from trustbo.errors import TrustboError, require_choice, require_kind, require_whole
from trustbo.inference.draws import as_fitted
from trustbo.planning.plan import QUANTILES, Plan
from trustbo.plots.style import (
    GREY,
    MARKERS,
    ROBOTS,
    accent,
    add_legend,
    as_text,
    background,
    ink,
    is_broad,
    panels,
    styled,
)

_LABELS = {
    "contact_lost": "contact lost\n(bounds)",
    "contact_rate": "contact rate",
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
            computed from a posterior, such as `Result.plan`.
        mission: Index of the mission in a posterior; negative indices count from the last.
        ax: Axes to draw on, one for each robot; by default a new figure.

    Returns:
        Axes, shape (robot,).

    Raises:
        TrustboError: There is no such mission, or the posterior has no latent trust.

    Example:
        >>> tb.plots.trust_curves(result.posterior)  # trust in the last mission
        >>> tb.plots.trust_curves(result.plan)  # trust predicted along the recommended path
    """
    if isinstance(given, Plan):
        x = np.arange(1, len(given.trust) + 1)
        middle = given.trust
        bands = given.bands
        rates = np.full(given.trust.shape, np.nan)
        robots = given.workspace.team.names
    else:
        x, middle, bands, rates, robots = _latent_trust(given, mission)

    axes = panels(len(robots), ax, (2.4, 1.9), sharex=True, sharey=True)
    for i, (panel, name) in enumerate(zip(axes, robots, strict=True)):
        colour = accent()
        low, lower, upper, high = bands[..., i]
        style: dict[str, Any] = {"color": colour, "linewidth": 0.0}
        panel.fill_between(x, low, high, alpha=0.25, label="90 %", **style)
        panel.fill_between(x, lower, upper, alpha=0.5, label="50 %", **style)
        marker = "." if len(x) == 1 else ""  # a line of one point is invisible
        panel.plot(x, middle[:, i], color=colour, marker=marker, label="trust")
        if np.isfinite(rates[:, i]).any():
            panel.plot(x, rates[:, i], "o", color=ink(), markersize=3.5, label="contact rate")
        panel.set_title(as_text(name))
        panel.set_xlabel("bound")
        n_ticks = "auto" if is_broad(panel) else _FEW_TICKS
        panel.xaxis.set_major_locator(MaxNLocator(n_ticks, integer=True))

    limits = np.array([panel.get_ylim() for panel in axes])
    for panel in axes:  # the user's axes may have scales of their own
        panel.set_ylim(limits[:, 0].min(), limits[:, 1].max())
        if panel.get_subplotspec() is not None:
            panel.label_outer()

    axes[0].set_ylabel("trust, contact rate")
    add_legend(axes, axes[0].get_legend_handles_labels()[0])
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
    trust = latent["trust"].isel(mission=mission).stack(all_draws=("chain", "draw"))
    trust = trust.dropna("bound", how="all").transpose("all_draws", "bound", "robot")

    rates = posterior["observed_data"]["contact_rate"].isel(mission=mission)
    rates = rates.sel(bound=trust["bound"]).transpose("bound", "robot").values

    middle = np.median(trust.values, 0)
    bands = np.quantile(trust.values, QUANTILES, axis=0)
    return trust["bound"].values, middle, bands, rates, trust["robot"].values.tolist()


@styled
def campaign_history(history: xr.Dataset, *, ax: Any = None) -> np.ndarray:
    """Plot the contact, the objective and, if given, the regret of each mission.

    A filled dot marks a plan that differs from the previous plan. A cross marks a mission that did
    not reach the goal. With the objective `lost_contact`, the measured and the predicted contact
    lost share one axis, in bounds; predictions include the costs of failures.

    Args:
        history: History of a campaign, `Result.history`; see `Result.plot_history` for regret.
        ax: Axes to draw on, one for each variable; by default a new figure.

    Returns:
        Axes, shape (variable,): contact lost (or the contact rate), the objective unless it shares
        the first axes, and regret.
    """
    names = [name for name in _LABELS if name in history]
    if "contact_lost" in names:
        names.remove("contact_rate")
    predicted = None
    if "contact_lost" in names and history.attrs.get("objective") == _LOST:
        names.remove("objective")
        predicted = -history["objective"].values
    mission = history["iteration"].values
    changed = history["path_changed"].values.astype(bool) | (mission == 1)
    failed = history["status"].values.astype(str) != "ok"

    height = 2.2 if len(names) == 1 else 1.6  # in inches
    axes = panels(len(names), ax, (4.6, height), columns=1, sharex=True)
    for panel, name in zip(axes, names, strict=True):
        values = history[name].values
        panel.plot(mission, values, color=accent(), linewidth=1.0)
        if name == "contact_lost" and predicted is not None:
            style: dict[str, Any] = {"color": ink(), "linestyle": ":", "linewidth": 1.2}
            panel.plot(mission, predicted, marker=".", label="predicted by the plan", **style)

        prefix = "" if predicted is None else "measured, "
        new = f"{prefix}new path"
        same = f"{prefix}same path"
        for which, fill, label in ((changed, accent(), new), (~changed, "none", same)):
            dots = {"markerfacecolor": fill, "markeredgecolor": accent(), "label": label}
            panel.plot(mission[which], values[which], "o", markersize=5.5, **dots)

        if failed.any():
            cross = {"color": ROBOTS[1], "markersize": 9.0, "label": "goal not reached"}
            panel.plot(mission[failed], values[failed], "x", **cross)
        panel.set_ylabel(_LABELS[name])
        panel.margins(y=_MARGIN)
        if name == "contact_lost":
            panel.set_ylim(bottom=min(0.0, *panel.get_ylim()))

    axes[-1].set_xlabel("mission")
    axes[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    add_legend(axes, axes[0].get_legend_handles_labels()[0])
    return axes


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

    axes = panels(1, ax, (5.0, 2.6))
    panel = axes[0]
    panel.axhspan(-SMALL_EFFECT, SMALL_EFFECT, color=GREY, alpha=0.25, linewidth=0.0)
    groups = list(table.groupby("robot", sort=False))
    shifts = np.linspace(-_SPREAD, _SPREAD, len(groups)) if len(groups) > 1 else [0.0]

    for i, (name, rows) in enumerate(groups):
        colour = ROBOTS[i % len(ROBOTS)]
        marker = MARKERS[i % len(MARKERS)]
        x = rows["mission"].to_numpy() + shifts[i]
        y = rows["effect"].to_numpy()
        odd = rows["stands_out"].to_numpy(dtype=bool)
        panel.errorbar(x, y, 2.0 * rows["sd"].to_numpy(), color=colour, fmt="none", elinewidth=1.0)
        panel.plot(x, y, marker, color=colour, markerfacecolor=background(), label=str(name))
        panel.plot(x[odd], y[odd], marker, color=colour)

    panel.set(xlabel="mission", ylabel="effect on contact\nat full sight")
    panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    add_legend(axes, panel.get_legend_handles_labels()[0])
    return panel
