"""Trust of each robot along a mission: expected, learned, and with measured contact rates."""

from collections.abc import Sequence
from typing import Unpack

import numpy as np
import xarray as xr
from matplotlib.ticker import MaxNLocator

from trustbo.errors import ShapeError, TrustboError, require_kind
from trustbo.inference.draws import is_of_people
from trustbo.planning.plan import QUANTILES, Plan
from trustbo.plots.layout import plain, small_multiples
from trustbo.plots.style import SMALL, Style, StyleOptions, theme

_SIZE = 2.5, 1.9


def mission_trust(
    posterior: xr.DataTree, mission: int = -1, **style: Unpack[StyleOptions]
) -> np.ndarray:
    """Draw latent trust of each robot along a mission, and the measured contact rates.

    Bands hold 50 % and 90 % of the draws of trust in the group `latent`, the line is their median.
    Dots are contact rates, or reports of people; bounds that were not measured have none.

    Args:
        posterior: Posterior of `tb.fit`, or `Result.posterior`.
        mission: Index of the mission, from 0; negative indices count from the last.
        **style: Options of `Style`.

    Returns:
        Axes, shape (robot,).

    Raises:
        TrustboError: There is no such mission, or the posterior has parameters alone.
    """
    require_kind(
        "plots.mission_trust", posterior, xr.DataTree, "give a posterior, such as Result.posterior"
    )
    if "latent" not in posterior.children:
        raise TrustboError(
            "plots.mission_trust: this posterior has no latent trust; give that of "
            "trustbo.inference.complete(posterior, missions)."
        )
    options, latent = Style.from_options(style), posterior["latent"].to_dataset()
    n_missions = latent.sizes["mission"]
    if not isinstance(mission, int | np.integer) or not -n_missions <= mission < n_missions:
        raise TrustboError(
            f"mission must be one of {n_missions}, from {-n_missions} to {n_missions - 1}; "
            f"got {mission!r}."
        )
    trust = latent["trust"].isel(mission=mission).stack(all_draws=("chain", "draw"))
    trust = trust.dropna("bound", how="all").transpose("all_draws", "bound", "robot")
    rates = posterior["observed_data"]["contact_rate"].isel(mission=mission)
    rates = rates.sel(bound=trust["bound"]).transpose("bound", "robot").values
    middle, bands = np.median(trust.values, 0), np.quantile(trust.values, QUANTILES, axis=0)
    robots = [str(name) for name in trust["robot"].values]
    of_people = is_of_people(posterior)
    seen, step = ("report", "step") if of_people else ("contact rate", "bound")
    named = "trust", "median", seen, step
    return _panels(robots, trust["bound"].values, middle, bands, rates, named, options)


def plan_trust(
    plan: Plan,
    robots: Sequence[str],
    contact_rate: np.ndarray | None = None,
    **style: Unpack[StyleOptions],
) -> np.ndarray:
    """Draw the expected trust of each robot along a plan, with bands over the posterior.

    Args:
        plan: Plan over a posterior, such as `campaign.ask()` or `Result.plan`.
        robots: Names of the robots, such as `workspace.team.names`.
        contact_rate: Contact rates measured when the plan was run, shape (bound, robot), if any.
        **style: Options of `Style`.

    Returns:
        Axes, shape (robot,).

    Raises:
        ShapeError: The number of robots or bounds differs from that of the plan.
    """
    require_kind(
        "plots.plan_trust", plan, Plan, "give a Plan, such as Result.plan or campaign.ask()"
    )
    options, (n_bounds, n_robots) = Style.from_options(style), plan.trust.shape
    if len(robots) != n_robots:
        raise ShapeError(f"the plan has {n_robots} robots; got the names {tuple(robots)}.")
    rates = np.full(plan.trust.shape, np.nan)
    if contact_rate is not None:
        measured = np.asarray(contact_rate, dtype=float)
        if measured.ndim != 2 or measured.shape[1] != n_robots or len(measured) > n_bounds:
            raise ShapeError(
                f"contact_rate must be ({n_bounds}, {n_robots}) or of fewer bounds; "
                f"got shape {measured.shape}."
            )
        rates[: len(measured)] = measured
    bounds = np.arange(1, n_bounds + 1)
    names = [str(robot) for robot in robots]
    named = "expected trust", "mean", "contact rate", "bound"
    return _panels(names, bounds, plan.trust, plan.bands, rates, named, options)


def _panels(
    robots: Sequence[str],
    bounds: np.ndarray,
    middle: np.ndarray,
    bands: np.ndarray,
    rates: np.ndarray,
    named: tuple[str, str, str, str],
    options: Style,
) -> np.ndarray:
    (what, centre, seen, step), colours = named, theme()
    made = small_multiples(len(robots), _SIZE, options, sharex=True, sharey=True)
    for i, ax in enumerate(made.panels):
        x, m, (low, lower, upper, high) = bounds, middle[:, i], bands[:, :, i]
        if len(x) == 1:  # a band of one bound would not be seen
            x = np.array([x[0] - 0.3, x[0] + 0.3])
            m, low, lower, upper, high = (np.repeat(v, 2) for v in (m, low, lower, upper, high))
        ax.fill_between(x, low, high, color=colours.outer, linewidth=0.0, label=f"90 % of {what}")
        ax.fill_between(
            x, lower, upper, color=colours.inner, linewidth=0.0, label=f"50 % of {what}"
        )
        ax.plot(x, m, color=colours.line, linewidth=1.2, label=f"{centre} of {what}")
        label = f"{seen} measured" if np.isfinite(rates[:, i]).any() else "_"
        (dots,) = ax.plot(bounds, rates[:, i], "o", color=colours.ink, markersize=4.0, label=label)
        dots.set(markeredgecolor=colours.paper, markeredgewidth=0.5)
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        plain(ax)
    made.titles(robots)
    made.label_lower(step)
    for ax in made.left:
        ax.set_ylabel(f"trust, {seen}", fontsize=SMALL)
    made.legend(made.panels[0].get_legend_handles_labels()[0], ncols=4)
    return made.panels
