"""Figures of a page, each with its caption and its description."""

import numpy as np

from trustbo import plots
from trustbo.campaign.result import Result
from trustbo.criticism.criticise import Criticism
from trustbo.display import joined
from trustbo.inference import params_of, place_maps
from trustbo.inference.posterior_tree import labelled_draws
from trustbo.report.blocks import Picture
from trustbo.report.drawing import picture
from trustbo.report.numbers import counted, number

MOST_BOUNDS = 3
"""Number of bounds with a map of posts and ways: the first, the last, and some between."""
MOST_PARAMETERS = 30


def trust_maps(result: Result) -> Picture:
    """Draw the trust map and the path at a few moments of the campaign."""
    n = result.history.sizes["iteration"]
    low, high = _ends(result.trust_map)
    n_changes = int(result.history["path_changed"].sum())
    return picture(
        result.plot_maps,
        f"Maps of expected trust from the prior to the end. After the last mission trust goes from "
        f"{low} to {high}. Over {counted(n, 'mission')} the path changed "
        f"{counted(n_changes, 'time')}.",
        "Expected trust with which each cell can be reached, and the path planned on it (white, "
        "from circle to star): from the prior, and as missions taught it. All maps have one scale, "
        "the 2 % to the 98 % quantile of what was learned; 1 is the trust of unbroken contact.",
    )


def orders(result: Result) -> Picture:
    """Draw posts and routes of robots along the recommended path."""
    n, names = len(result.path) - 1, joined(result.workspace.team.names)
    shown = np.unique(np.linspace(1, n, min(n, MOST_BOUNDS)).round().astype(int)).tolist()
    caption = (
        "In each bound, the lead drives between its stops (stars) while the others watch it from "
        "their posts; then they close up on the dashed ways to their next posts (hollow)."
    )
    if len(shown) < n:
        caption += f" {len(shown)} of the {n} bounds are shown."
    return picture(
        lambda: plots.plan_map(result.plan, bounds=shown),
        f"A map of the path, and {counted(len(shown), 'map')} of single bounds: stops and way of "
        f"the lead, posts of {names}, their sight lines and ways.",
        caption,
    )


def path_posterior(result: Result) -> Picture:
    """Draw the probability of each cell to be on the best path."""
    share = result.planner.path_posterior(result.posterior)
    values = share.values
    sure = int((values >= 0.95).sum())
    likely = int(((values >= 0.05) & (values < 0.95)).sum())
    return picture(
        lambda: plots.path_posterior(share, result.workspace, path=result.path),
        f"Map of the probability of each cell to be on the best path: {counted(sure, 'cell')} with "
        f"at least 95 %, {counted(likely, 'more cell')} with 5 % to 95 %.",
        "Share of posterior draws whose best path enters a cell; white, the recommended path. "
        "If other cells are likely too, more missions may change the path.",
    )


def hazard(result: Result) -> Picture:
    """Draw the chance to fail of the bounds into each cell."""
    risk = result.planner.problem.risk
    assert risk is not None  # noqa: S101
    low, high = _ends(risk.p_fail)
    return picture(
        lambda: plots.hazard_map(risk.p_fail, result.workspace, path=result.path),
        f"Map of the chance that a bound into each cell fails, from the worst side. Over bounds it "
        f"goes from {low} to {high}.",
        "Chance that a bound into a cell ends the mission, from the side where it is largest; "
        "white, the recommended path.",
    )


def places(result: Result) -> Picture:
    """Draw the effects of places."""
    effects = place_maps(result.posterior)
    name = "place_mean" if "place_mean" in effects else "place_bound_mean"
    low, high = _ends(effects[name])
    kind = "cells" if name == "place_mean" else "bounds"
    n_visited = result.posterior["places"].sizes["bound"]
    return picture(
        lambda: plots.place_map(result.posterior, result.workspace),
        f"Maps of the effects of places on trust: the mean of {kind} goes from {low} to {high}; "
        f"and their standard deviation. Arrows are the {counted(n_visited, 'place')} visited.",
        "Left, the mean effect on trust of entering a cell, its sign large where it has a "
        "probability of 95 %; right, its standard deviation. Arrows are bounds that were made, "
        "their colour the further effect of the bound.",
    )


def robot_costs(result: Result) -> Picture:
    """Draw the cost map of each robot."""
    cost = result.planner.cost_map(params_of(result.posterior).mean(), per_robot=True)
    alike = bool(np.allclose(cost.values, cost.values[:1], equal_nan=True))
    shown = cost.isel(robot=slice(1)) if alike else cost

    title = "every robot" if alike else None

    def draw():
        return plots.robot_maps(shown, result.workspace, path=result.path, title=title)

    low, high = _ends(shown)
    names = joined([str(name) for name in cost["robot"].values])
    same = " It is the same for all of them: they share parameters and awareness." if alike else ""
    return picture(
        draw,
        f"Maps of the cost of reaching each cell, for {names}: from {low} to {high}.{same}",
        "The paper's cost 1 \N{MINUS SIGN} \N{GREEK SMALL LETTER SIGMA}(trust) of reaching each "
        f"cell, for {names}; white, the recommended path.{same}",
    )


def terrain(result: Result) -> Picture:
    """Draw the surface and the index of each feature."""
    features = joined(result.workspace.features)
    closed = int((~result.workspace.passable).sum())
    return picture(
        lambda: plots.terrain_maps(result.workspace, n_columns=2),
        f"Maps of the surface's height, and of {features}. {counted(closed, 'cell')} of the "
        "planning grid cannot be entered.",
        f"Surface (DSM), and the index of each pixel: {features}, 0 worst, 1 best. "
        "Lines are the planning grid.",
    )


def parameters(result: Result) -> Picture | None:
    """Draw the parameters, mission by mission; None if there are too many."""
    sites = result.posterior["posterior"].to_dataset()
    sizes: dict[str, int] = {}
    for _, name, _, _ in labelled_draws(sites):
        sizes[name] = sizes.get(name, 0) + 1
    shown, total = [], 0
    for name, size in sizes.items():
        if total + size <= MOST_PARAMETERS:
            shown.append(name)
            total += size
    if not shown:
        return None
    rest = [name for name in sizes if name not in shown]
    caption = (
        "Each parameter after each mission: thick bars hold 50 % of the posterior, thin ones 90 %; "
        "grey at 0, the prior."
    )
    if rest:
        caption += f" Of {joined(rest)}, see the table."
    return picture(
        lambda: plots.parameter_history(result.posteriors, names=shown),
        f"{counted(total, 'panel')}, one for each parameter: its posterior over "
        f"{counted(len(result.posteriors), 'mission')}. The table has the numbers.",
        caption,
    )


def criticism(outcome: Criticism) -> Picture:
    """Draw the tests and residuals of the model's criticism."""
    odd = outcome.groups.loc[outcome.groups["stands_out"].to_numpy(), :]
    sentence = (
        f"{counted(len(odd), 'mean')} outside a band" if len(odd) else "all within their bands"
    )
    return picture(
        lambda: plots.criticism(outcome),
        "Nine panels: adjusted p of each test, PIT, coverage, autocorrelation, and mean residuals "
        f"by mission, bound, robot, expected contact and cell; {sentence}. "
        "The table has the tests.",
        "Tests (hollow: once the named fault is accounted for), predictions and mean residuals. "
        "Grey bands hold a whole panel with 95 % where the model is right; red is outside.",
    )


def last_mission(result: Result) -> Picture:
    """Draw trust along the last mission."""
    mission = result.missions[-1]
    low, high = (number(float(f(mission.contact_rate)), 2) for f in (np.nanmin, np.nanmax))
    return picture(
        lambda: plots.mission_trust(result.posterior),
        f"{counted(len(mission.robots), 'panel')}, one for each robot: latent trust over the "
        f"{counted(len(mission.bounds), 'bound')} of the last mission. Contact rates measured go "
        f"from {low} to {high}.",
        "Latent trust of each robot along the last mission, given all missions: bands of 50 % and "
        "90 %. Dots are the contact rates measured.",
    )


def history(result: Result) -> Picture:
    """Draw the objective and the contact rate over the campaign."""
    first, last = (number(float(v)) for v in result.history["objective"].values[[0, -1]])
    return picture(
        lambda: plots.campaign_history(result.history),
        f"Two curves over {counted(len(result.missions), 'mission')}: the objective when planned, "
        f"from {first} to {last}, and the contact rate measured.",
        "Objective of each plan, and mean contact rate of its mission. The first plan comes from "
        "the prior, and its objective may be far off.",
    )


def _ends(values) -> tuple[str, str]:
    return number(float(np.nanmin(values))), number(float(np.nanmax(values)))
