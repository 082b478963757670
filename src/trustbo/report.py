"""HTML report of a result, with figures, tables and diagnostics."""

import base64
import io
from collections import defaultdict
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from arviz_stats.summary import summary

from trustbo import plots
from trustbo.campaign.replan import is_replanned
from trustbo.campaign.result import Result
from trustbo.campaign.state import GIVEN_UP, Entry, incomplete_bounds
from trustbo.data import Cell
from trustbo.display import render
from trustbo.errors import require_kind
from trustbo.files import FilePath, write_text
from trustbo.planning.plan import past_failures_of
from trustbo.plots.style import drawing
from trustbo.team import Team

__all__ = ["write_report"]
__dir__ = __all__.copy  # tab completion lists only public names

_DRAWS = 50
"""Number of posterior draws for the uncertainty map."""
_SHOWN = 3
"""Number of bounds shown in detail; these are the bounds with the least expected contact."""
_NOT_PRINTED = "screen"
"""Class of sections that are not printed."""
_LAST_PRINTED = "missions"
"""Class of sections of which only the last 12 rows are printed."""
_ENDS = {"n_iterations": "all missions were run", "interrupted": "none; more missions can be run"}


class _Block(NamedTuple):
    """Part of a section of the page: an image, a table or a note."""

    image: str = ""  # PNG in base64
    alt: str = ""  # text in place of the image
    table: str = ""  # HTML with its texts escaped
    note: str = ""


class _Section(NamedTuple):
    """Section of the page, with its class in the style sheet of the template."""

    heading: str
    blocks: list[_Block]
    css_class: str = ""


def write_report(path: FilePath, result: Result) -> None:
    """Write a result as one self-contained HTML page.

    The first screen shows the recommended path on the terrain with the overwatch posts, the contact
    in each mission, the probability of arrival, and what is uncertain. Tables with the coordinates
    of all stops, maps, diagnostics and settings follow. The page prints on two sheets, without
    diagnostics and settings.

    Args:
        path: File to write.
        result: Result of a campaign with a posterior.

    Raises:
        TrustboError: There is no posterior yet, or the file cannot be written.

    Example:
        >>> tb.report.write_report("report.html", result)
    """
    require_kind("result", result, Result, "give a result or a campaign")
    _ = result.posterior  # raises if there is none yet
    n = len(result.missions)
    missions = "1 mission" if n == 1 else f"{n} missions"
    page = render(
        "report.html",
        title=f"Recommended path after {missions}",
        facts=facts_of(result),
        pictures=[_path_map(result), _image(result.plot_history, "contact lost in each mission")],
        sections=[
            _bounds(result),
            _missions(result),
            _maps(result),
            _weakest(result),
            _diagnostics(result),
            _settings(result),
        ],
    )
    write_text(path, page)


def facts_of(result: Result) -> dict[str, str]:
    """Return the facts, by name, that are needed to decide whether to drive the path."""
    plan = result.plan
    bounds = bounds_of(result)
    rate = result.state.entries[-1].measures["contact_rate"]
    last = f"{rate:.1%} of the time" if np.isfinite(rate) else "not measured"
    cells = " → ".join(_name(cell) for cell in plan.path)
    facts = {
        "Path": f"{cells} (row,column; row 0 is north)",
        "Length": f"{len(plan.path) - 1} bounds, {plan.length:.0f} m",
    }

    if plan.p_arrive is not None and plan.risk is not None:
        low, high = plan.risk.p_arrive_band
        band = f", and {low:.1%} to {high:.1%} in 90 % of the draws" if np.isfinite(low) else ""
        facts["Probability of arrival"] = f"{plan.p_arrive:.1%} on average{band}"
    if plan.past_failures:
        facts["Past failures"] = "; ".join(past_failures_of(plan))
    contact = bounds["contact"].mean()
    return facts | {
        "Expected contact": f"{contact:.1%} of the time, averaged over robots and bounds",
        **_objective(result),
        "Weakest bound": _weakest_bound(bounds),
        "Uncertain": _uncertain(bounds),
        "Last mission": f"status {result.missions[-1].status}, contact {last}",
        "Reason for stopping": _ENDS.get(result.stop_reason, result.stop_reason),
    }


def bounds_of(result: Result) -> pd.DataFrame:
    """Return what is known of each bound of the path, for all parts of the report.

    The table has one row per bound, labelled by its number from 1, with the columns:

    - `cell`: cell that the bound enters, as text.
    - `trust`, `low`, `high`: expected trust and the ends of its 90 % interval, means of the robots.
    - `contact`: expected contact rate, mean of the robots.
    - `measured`: mean of the measured contact rates over missions and robots; NaN if there is none.
    - `driven`: number of times that missions on this map began the bound, from the same cell.
    """
    plan = result.plan
    problem = result.planner.problem
    noise_sd = problem.recursion(result.belief.mean()).noise_sd
    contact = np.minimum(problem.likelihood.mean_rate(plan.trust, noise_sd), 1.0)

    earlier = [mission for mission in result.state.earlier.missions if not mission.map]
    rates = defaultdict(list)  # by the cells left and entered
    for mission in [*earlier, *result.missions]:
        for ends, driven in zip(pairwise(mission.path), mission.bounds, strict=False):
            rates[ends].append(driven.contact_rate)
    of_path = [rates[ends] for ends in pairwise(plan.path)]

    return pd.DataFrame(
        {
            "cell": [_name(cell) for cell in plan.path[1:]],
            "trust": plan.trust.mean(1),
            "low": plan.bands[0].mean(1),
            "high": plan.bands[-1].mean(1),
            "contact": contact.mean(1),
            "measured": [_mean_rate(of_bound) for of_bound in of_path],
            "driven": [len(of_bound) for of_bound in of_path],
        },
        index=pd.RangeIndex(1, len(plan.path), name="bound"),
    )


def _mean_rate(rates: list[np.ndarray]) -> float:
    """Return the mean over missions of the mean rate of the measured robots; NaN if none."""
    known = [np.nanmean(rate) for rate in rates if np.isfinite(rate).any()]
    return float(np.mean(known)) if known else np.nan


def _objective(result: Result) -> dict[str, str]:
    """Return the value of the objective, with the sign that it has in the table of missions."""
    plan = result.plan
    low, high = (np.nan, np.nan) if plan.value_band is None else plan.value_band
    value = plan.value
    name, unit = "Objective", ""
    if plan.objective == "lost_contact":
        name, unit = "Predicted contact lost", " bounds"
        value, low, high = -value, -high, -low

    band = f", {_number(low)} to {_number(high)} in 90 % of the draws" if np.isfinite(low) else ""
    cost = result.planner.problem.cost_of_failure
    costs = f"; includes a cost of {_number(cost)} bounds if the mission fails" if cost else ""
    return {name: f"{_number(value)}{unit}{band}{costs}"}


def _weakest_bound(bounds: pd.DataFrame) -> str:
    """Describe the bound with the least expected contact."""
    i = int(np.argmin(bounds["contact"]))
    expected = bounds["contact"].to_numpy()[i]
    measured = bounds["measured"].to_numpy()[i]
    text = f"{_label(bounds, i)}, expected contact {expected:.1%}"
    if np.isfinite(measured):
        return f"{text}, measured contact {measured:.1%}"
    return f"{text}, contact not measured" if bounds["driven"].to_numpy()[i] else text


def _uncertain(bounds: pd.DataFrame) -> str:
    """Describe which bounds were never driven, and where the interval of trust is widest."""
    new = bounds.loc[bounds["driven"] == 0, "cell"]
    text = "every bound of the path was driven before"
    if len(new):
        listed = ", ".join(f"{k} into {cell}" for k, cell in zip(new.index, new, strict=True))
        text = f"{len(new)} of {len(bounds)} bounds were never driven: {listed}"

    low = bounds["low"].to_numpy()
    high = bounds["high"].to_numpy()
    i = int(np.argmax(high - low))
    return (
        f"{text}; the widest 90 % interval of trust is {_number(low[i])} to {_number(high[i])}, in "
        f"{_label(bounds, i)}"
    )


def _label(bounds: pd.DataFrame, i: int) -> str:
    """Name the bound in row i of `bounds_of`: its number, its cell and how often it was driven."""
    n = int(bounds["driven"].to_numpy()[i])
    often = {0: "never driven", 1: "driven once"}.get(n, f"driven {n} times")
    return f"bound {i + 1} into cell {bounds['cell'].to_numpy()[i]} ({often})"


def _number(value: float) -> str:
    """Format a number as in tables."""
    return f"{value:z.3g}"


def _path_map(result: Result) -> _Block:
    """Plot the path on the terrain with all posts or, without a terrain, on the trust map."""
    plan = result.plan
    if plan.stops is not None:
        return _image(lambda: plots.plan_map(plan, bounds=[]), "path and overwatch posts")
    draw = plots.cell_map
    return _image(lambda: draw(result.trust_map, plan.workspace, path=plan.path), "path")


def _bounds(result: Result) -> _Section:
    """Make a table of the bounds of the path, with coordinates."""
    plan = result.plan
    bounds = bounds_of(result)
    positions = plan.positions if plan.stops is None else plan.stops

    table = pd.DataFrame(
        {
            "cell": [_name(cell) for cell in plan.path],
            "x (m)": [f"{x:.1f}" for x in positions[:, 0]],
            "y (m)": [f"{y:.1f}" for y in positions[:, 1]],
            "expected trust": [np.nan, *bounds["trust"]],
            "5 %": [np.nan, *bounds["low"]],
            "95 %": [np.nan, *bounds["high"]],
            "expected contact": [np.nan, *bounds["contact"]],
            "measured": [np.nan, *bounds["measured"]],
        },
        index=pd.RangeIndex(len(plan.path), name="bound"),
    )
    if plan.p_fail is not None:
        table["p(failure)"] = [np.nan, *plan.p_fail]
    table["driven"] = ["start", *(f"{n}" for n in bounds["driven"])]

    where = "centre of the cell" if plan.stops is None else "stop of the lead"
    note = (
        f"x and y: {where}, {plan.workspace.grid.crs_name}. Bound 0 is the start. Trust and "
        "contact are means of the robots. Driven: how often missions began the bound, from the "
        "same cell; measured: mean of the contact rates in the bound."
    )
    return _Section("Bounds of the path", [_table(table), _note(note)])


def _weakest(result: Result) -> _Section:
    """Plot the bounds with the least expected contact, if there is a terrain."""
    plan = result.plan
    if plan.stops is None:
        return _Section("Weakest bounds", [_note("Without a terrain, there are no posts.")])

    contact = bounds_of(result)["contact"].to_numpy()
    weakest = sorted((np.argsort(contact)[:_SHOWN] + 1).tolist())
    text = (
        "The bounds with the least expected contact. The robots watch from their posts while the "
        "lead drives, and then drive to their next posts."
    )
    return _Section(
        "Weakest bounds",
        [
            _image(lambda: plots.plan_map(plan, bounds=weakest), "posts and routes of bounds"),
            _note(text),
        ],
    )


def _maps(result: Result) -> _Section:
    """Plot the trust maps of missions and the standard deviation of trust."""
    plan = result.plan
    is_logit = result.settings["family"] == "beta_binomial"
    scale = "Trust is the logit of contact." if is_logit else "A trust of 1 means unbroken contact."
    sd = result.maps(n_draws=_DRAWS)["trust_sd"]
    return _Section(
        "Trust and its uncertainty",
        [
            _image(result.plot_maps, "trust maps after selected missions"),
            _image(
                lambda: plots.cell_map(sd, result.workspace, path=plan.path),
                "standard deviation of trust",
            ),
            _note(
                f"Expected trust in each cell, and the path planned with this trust. {scale} "
                "Bright cells are good: high trust, or a small standard deviation. No mission has "
                "entered hatched cells, so their trust is only predicted from a map that may be "
                "outdated. Bounds into other cells may be new as well. The intervals assume an "
                "adequate model (see trustbo.criticism)."
            ),
        ],
    )


def failed_bounds_of(result: Result) -> list[str]:
    """Return the bounds that were not completed in each row of `Result.table`, as text."""
    words = []
    for row, entry in _rows_and_entries(result):
        if entry is None:  # only the cell is known
            words.append(f"into {row['where']} ({row['status']})" if row["where"] else "")
            continue
        failed = incomplete_bounds(entry.mission)
        words.append(", ".join(f"{k} into {_name(cell)} ({why})" for k, cell, why in failed))
    return words


def replanned_of(result: Result) -> list[str]:
    """Return "replanned" or "" for each row of `Result.table`."""
    return [
        "replanned" if entry is not None and is_replanned(entry.plan) else ""
        for _, entry in _rows_and_entries(result)
    ]


def _rows_and_entries(result: Result) -> Iterator[tuple[dict[str, Any], Entry | None]]:
    """Yield each row of `Result.table` with its mission; None for missions that were given up."""
    entries = iter(result.state.entries)
    for row in result.table().to_dict("records"):
        yield row, None if row["state"] == GIVEN_UP else next(entries)


def _missions(result: Result) -> _Section:
    table = result.table()
    failed = failed_bounds_of(result)
    if any(failed):
        table["failed_bounds"] = failed

    replanned = replanned_of(result)
    if any(replanned):
        table["plan"] = replanned

    columns = (
        "status",
        "failed_bounds",
        "plan",
        "contact_rate",
        "contact_lost",
        "objective",
        "n_bounds",
    )
    has_unmeasured = bool((table["n_unmeasured"] > 0).any())
    if has_unmeasured:
        columns += ("n_unmeasured",)
    shown = table.loc[:, [name for name in columns if name in table]].rename_axis("mission")
    about = f"The objective is {result.settings['objective'].replace('_', ' ')}."
    if result.settings["objective"] == "lost_contact":
        shown["objective"] = -shown["objective"]
        shown = shown.rename(columns={"objective": "predicted_lost"})
        about = (
            "Contact lost is in bounds. Predicted losses include the costs of failures, measured "
            "ones do not."
        )
    shown.columns = [str(name).replace("_", " ") for name in shown.columns]

    about += " The value predicted for the plan of a mission is based on all earlier missions."
    if has_unmeasured:
        about += " Bounds without a measured rate count as the mean of the mission's other bounds."
    if any(replanned):
        about += f" {_about_replanned(result)}"
    return _Section(
        "Contact in each mission",
        [
            _table(shown),
            _note(f"{about} Printed pages have the last 12 missions."),
        ],
        css_class=_LAST_PRINTED,
    )


def _about_replanned(result: Result) -> str:
    """Return what the predicted value of a mission means that was replanned."""
    covers = "refers to the rest of the path"
    if result.planner.problem.objective.of_contact:
        covers = "includes the contact already lost"
    return (
        "In replanned missions, it is the value of the last plan, which is also based on the "
        f"bounds driven before, and {covers}."
    )


def _diagnostics(result: Result) -> _Section:
    names = {
        "k_hat": "Pareto k-hat (at most 0.7, good below 0.5)",
        "kish": "effective samples (Kish)",
        "r_hat": "R-hat (good up to 1.01)",
        "ess_bulk": "bulk ESS",
        "divergences": "divergences",
    }
    last = result.history.isel(iteration=-1)
    known = [name for name in names if name in last and np.isfinite(last[name])]
    rows = {names[name]: float(last[name]) for name in known}
    table: Any = summary(result.posterior, round_to="none")
    kept = [name for name in ("mean", "sd", "eti89_lb", "eti89_ub") if name in table]
    return _Section(
        "Diagnostics",
        [
            _note(f"Sampler: {result.posterior.attrs.get('sampler', 'unknown')}."),
            _table(pd.Series(rows, name="value").rename_axis("diagnostic").to_frame()),
            _table(table[kept].rename_axis("parameter")),
        ],
        css_class=_NOT_PRINTED,
    )


def _settings(result: Result) -> _Section:
    texts = {name: str(value) for name, value in result.settings.items()}
    short = {name: text for name, text in texts.items() if len(text) < 120}
    short |= _about_team(result.workspace.team)
    return _Section(
        "Settings",
        [
            _table(pd.Series(short, name="value").rename_axis("setting").to_frame()),
        ],
        css_class=_NOT_PRINTED,
    )


def _about_team(team: Team) -> dict[str, str]:
    """Return the names, slope limits and lidar ranges of the robots, as texts."""
    limits = {name: np.rad2deg(robot.max_slope) for name, robot in team.members.items()}
    ranges = {name: robot.lidar_range for name, robot in team.members.items()}

    def listed(values: dict[str, float]) -> str:
        return ", ".join(f"{name} {value:.3g}" for name, value in values.items())

    return {
        "robots": ", ".join(team.members),
        "slope limits (degrees)": listed(limits),
        "lidar ranges (m)": listed(ranges),
    }


def _name(cell: Cell) -> str:
    return f"{cell[0]},{cell[1]}"


def _note(text: str) -> _Block:
    return _Block(note=text)


def _table(frame: pd.DataFrame) -> _Block:
    html = frame.reset_index().to_html(index=False, border=0, float_format=_number, na_rep="-")
    return _Block(table=html)


def _image(draw: Callable[[], Any], alt: str) -> _Block:
    """Draw a figure as an image with a text in its place."""
    with drawing(kept=()):
        figure = np.ravel(draw())[0].get_figure(root=True)
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=130, bbox_inches="tight")
        plt.close(figure)

    return _Block(image=base64.b64encode(file.getvalue()).decode(), alt=alt)
