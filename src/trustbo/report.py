"""HTML report of a result, with figures, tables and diagnostics."""

import base64
import io
from collections import defaultdict
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from arviz_stats.summary import summary

from trustbo import plots
from trustbo.campaign.result import Result
from trustbo.campaign.state import EXCLUDED
from trustbo.data import path_text
from trustbo.display import render
from trustbo.errors import require_kind
from trustbo.files import FilePath, write_text
from trustbo.planning.plan import in_draws, past_failures_of
from trustbo.plots.style import drawing
from trustbo.workspace.closed import closed_text

__all__ = ["write_report"]
__dir__ = __all__.copy  # tab completion lists only public names

_DRAWS = 50
"""Number of posterior draws for the uncertainty map."""
_SHOWN = 3
"""Number of bounds shown in detail; these are the bounds with the least expected contact."""
_ENDS = {"n_iterations": "all missions were run", "interrupted": "none; more missions can be run"}
_OF_BOUNDS = {
    "cell": "cell",
    "posts": "posts",
    "x": "x (m)",
    "y": "y (m)",
    "trust": "expected trust",
    "trust_low": "5 %",
    "trust_high": "95 %",
    "contact": "expected contact",
    "measured": "measured",
    "p_fail": "p(failure)",
    "begun": "driven",
}
"""Headings of the table of bounds, keyed by the columns of `bounds_of`."""
_OF_MISSIONS = ("began", "start", "goal", "robots", "status", "state", "failed_bounds", "plan",
                "contact_rate", "contact_lost", "lost_share", "objective", "n_bounds",
                "n_unmeasured")  # fmt: skip
"""Columns of the table of missions, if they have values."""
_DIAGNOSTICS = {
    "k_hat": "Pareto k-hat (at most 0.7, good below 0.5)",
    "kish": "effective samples (Kish)",
    "r_hat": "R-hat (good up to 1.01)",
    "ess_bulk": "bulk ESS",
    "divergences": "divergences",
}
"""Headings of the diagnostics of a posterior, keyed by the columns of `Result.table`."""


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
    posterior = result.posterior  # raises if there is none yet
    path_table = bounds_of(result)
    page = render(
        "report.html",
        result=result,
        facts=facts_of(result),
        pictures=_pictures(result, path_table),
        tables=_tables(result, path_table),
        replanned=result.table()["replanned"].any(),
        sampler=posterior.attrs.get("sampler", "unknown"),
    )
    write_text(path, page)


def facts_of(result: Result) -> dict[str, str]:
    """Return the facts, by name, that are needed to decide whether to drive the path."""
    plan = result.plan()
    path = bounds_of(result)
    bounds = path.iloc[1:]
    rate = float(result.history["contact_rate"][-1])
    last = f"{rate:.1%} of the time" if np.isfinite(rate) else "not measured"
    cells = " → ".join(path["cell"])
    ends = [result.workspace.name_of(cell) for cell in (plan.start, plan.goal)]
    named = f"{' to '.join(ends)}: " if result.workspace.places else ""
    facts = {
        "Path": f"{named}{cells} (row,column; row 0 is north)",
        "Length": f"{len(bounds)} bounds, {plan.length:.0f} m",
    }

    if plan.risk is not None:
        low, high = plan.risk.p_arrive_band
        band = f", and {low:.1%} to {high:.1%} in 90 % of the draws" if np.isfinite(low) else ""
        facts["Probability of arrival"] = f"{plan.risk.p_arrive:.1%} on average{band}"
    if plan.past_failures:
        facts["Past failures"] = "; ".join(past_failures_of(plan))
    contact = bounds["contact"].mean()
    facts["Expected contact"] = f"{contact:.1%} of the time, averaged over robots and bounds"

    # With the sign that the objective has in the table of missions.
    lost = plan.objective == "lost_contact"
    sign = -1.0 if lost else 1.0
    value = _number(sign * plan.value) + (" bounds" if lost else "")
    value += in_draws(plan.value_band, sign)
    if plan.price_of_failure:
        value += f": {plan.parts}"
    facts["Predicted contact lost" if lost else "Objective"] = value
    if plan.workspace.closed:
        facts["Closed"] = closed_text(plan.workspace.closed, plan.workspace.name_of)

    status = result.history["status"].values[-1]
    return facts | {
        "Weakest bound": _weakest_bound(bounds),
        "Uncertain": _uncertain(bounds),
        "Last mission": f"status {status}, contact {last}",
        "Reason for stopping": _ENDS.get(result.stop_reason, result.stop_reason),
    }


def bounds_of(result: Result) -> pd.DataFrame:
    """Return what is known of each bound of the path, for all parts of the report.

    The table is that of `Plan.to_frame`, where row 0 is the start, with the further columns:

    - `contact`: expected contact rate, mean of the robots.
    - `measured`: mean of the measured contact rates over missions and robots; NaN if there is none.
    - `begun`: number of times that missions on this map began the bound, from the same cell and
      with the same set of posts.

    Missions that a user has excluded do not count.
    """
    plan = result.plan()
    problem = result.planner.problem
    mean = problem.recursion(result.belief.mean())
    contact = np.minimum(mean.likelihood.mean_rate(plan.trust, mean.noise_sd), 1.0)

    state = result.state
    earlier = [mission for mission in state.earlier.missions if not mission.map]
    own = [entry.mission for entry in state.entries if entry.exclusion is None]
    rates = defaultdict(list)  # by the cells left and entered
    for mission in [*earlier, *own]:
        for (a, c), rate in zip(pairwise(mission.stations), mission.contact_rate, strict=False):
            rates[a, c[:2]].append(pd.Series(rate).mean())  # of the measured robots
    of_path = [pd.Series(rates[a, c[:2]], dtype=float) for a, c in pairwise(plan.stations)]

    table = plan.to_frame()
    table["contact"] = [np.nan, *contact.mean(1)]
    table["measured"] = [np.nan, *(of_bound.mean() for of_bound in of_path)]
    table["begun"] = [0, *map(len, of_path)]
    return table


def courses_of(result: Result) -> pd.DataFrame:
    """Return the recommended path of each course on which missions were run, one row each."""
    rows = []
    for start, goal in dict.fromkeys(course.ends for course in result.courses):
        plan = result.plan(start, goal)
        rows.append(
            {
                "start": result.workspace.name_of(start),
                "goal": result.workspace.name_of(goal),
                "path": path_text(plan.path),
                "bounds": len(plan.path) - 1,
                "metres": round(plan.length),
                "value": plan.value,
                "p(arrival)": plan.p_arrive,
            }
        )
    return pd.DataFrame(rows, index=pd.RangeIndex(1, len(rows) + 1, name="course"))


def _weakest_bound(bounds: pd.DataFrame) -> str:
    """Describe the bound with the least expected contact."""
    weakest = bounds.loc[bounds["contact"].idxmin()]
    text = f"{_label(weakest)}, expected contact {weakest['contact']:.1%}"
    if np.isfinite(weakest["measured"]):
        return f"{text}, measured contact {weakest['measured']:.1%}"
    return f"{text}, contact not measured" if weakest["begun"] else text


def _uncertain(bounds: pd.DataFrame) -> str:
    """Describe which bounds were never driven, and where the interval of trust is widest."""
    new = bounds.loc[bounds["begun"] == 0, "cell"]
    text = "every bound of the path was driven before"
    if len(new):
        listed = ", ".join(f"{k} into {cell}" for k, cell in new.items())
        text = f"{len(new)} of {len(bounds)} bounds were never driven: {listed}"

    widest = bounds.loc[(bounds["trust_high"] - bounds["trust_low"]).idxmax()]
    ends = f"{_number(widest['trust_low'])} to {_number(widest['trust_high'])}"
    return f"{text}; the widest 90 % interval of trust is {ends}, in {_label(widest)}"


def _label(bound: Any) -> str:
    """Name a row of `bounds_of`: its number, its cell and how often it was driven."""
    n = bound["begun"]
    often = {0: "never driven", 1: "driven once"}.get(n, f"driven {n} times")
    return f"bound {bound.name} into cell {bound['cell']} ({often})"


def _number(value: float) -> str:
    """Format a number as in tables."""
    return f"{value:z.3g}"


def _pictures(result: Result, path_table: pd.DataFrame) -> dict[str, str]:
    """Draw all figures, keyed by name; without a terrain, there are no posts.

    `path_table` is the table of `bounds_of`.
    """
    plan = result.plan()
    sd = result.maps(n_draws=_DRAWS)["trust_sd"]
    draw: dict[str, Callable[[], Any]] = {
        "path": lambda: plots.cell_map(result.trust_map, plan.workspace, path=plan.path),
        "history": result.plot_history,
        "maps": result.plot_maps,
        "sd": lambda: plots.cell_map(sd, result.workspace, path=plan.path),
    }
    if plan.stops is not None:
        weakest = path_table.iloc[1:].nsmallest(_SHOWN, "contact").index
        draw["path"] = lambda: plots.plan_map(plan, bounds=[])
        draw["weakest"] = lambda: plots.plan_map(plan, bounds=sorted(weakest))
    if plan.contact_lost is not None:
        draw["ways"] = lambda: plots.ways_map(result.ways())
    return {name: _picture(figure) for name, figure in draw.items()}


def _picture(draw: Callable[[], Any]) -> str:
    """Draw a figure as PNG in base64."""
    with drawing(kept=()):
        figure = np.ravel(draw())[0].get_figure(root=True)
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=130, bbox_inches="tight")
        plt.close(figure)
    return base64.b64encode(file.getvalue()).decode()


def _tables(result: Result, path_table: pd.DataFrame) -> dict[str, str]:
    """Return all tables as HTML, keyed by name; `path_table` is the table of `bounds_of`."""
    bounds: Any = path_table.astype({"begun": object})
    bounds.loc[0, "begun"] = "start"
    bounds[["x", "y"]] = bounds[["x", "y"]].map("{:.1f}".format)
    bounds = bounds[[name for name in _OF_BOUNDS if name in bounds]].rename(columns=_OF_BOUNDS)

    missions: Any = result.table()
    missions["plan"] = np.where(missions["replanned"], "replanned", "")
    empty = [name for name in ("failed_bounds", "plan") if not missions[name].any()]
    if not (missions["state"] == EXCLUDED).any():
        empty.append("state")
    empty += [name for name in ("start", "goal", "robots") if missions[name].nunique() < 2]
    if "start" in empty and "goal" in empty:
        empty.append("lost_share")
    if not (missions["n_unmeasured"] > 0).any():
        empty.append("n_unmeasured")
    shown = [name for name in _OF_MISSIONS if name in missions and name not in empty]
    missions = missions[shown]
    if result.settings["objective"] == "lost_contact":
        missions = missions.assign(objective=-missions["objective"])
        missions = missions.rename(columns={"objective": "predicted_lost"})
    missions.columns = missions.columns.str.replace("_", " ")

    posterior = result.state.last
    found = {} if posterior is None else posterior.diagnostics
    diagnostics = {
        name: float(found[column])
        for column, name in _DIAGNOSTICS.items()
        if np.isfinite(found.get(column, np.nan))
    }
    parameters: Any = summary(result.posterior, round_to="none")
    kept = [name for name in ("mean", "sd", "eti89_lb", "eti89_ub") if name in parameters]

    courses = courses_of(result)
    closings: Any = result.closings()
    closings = closings[closings["over"] == ""].drop(columns="over")
    plan = result.plan()
    ways: Any = None if plan.contact_lost is None else result.ways().to_frame()
    return {
        "bounds": _table(bounds),
        "missions": _table(missions),
        "courses": _table(courses) if len(courses) > 1 else "",
        "ways": "" if ways is None else _of_ways(ways),
        "limits": "" if ways is None or plan.stops is None else _of_ways(result.limits()),
        "closings": _table(closings) if len(closings) else "",
        "diagnostics": _table(_listed(diagnostics, "diagnostic")),
        "parameters": _table(parameters[kept].rename_axis("parameter")),
        "settings": _table(_listed(_settings(result), "setting")),
    }


def _of_ways(table: Any) -> str:
    """Return a table of ways as HTML."""
    table = table.rename(columns={"p_arrive": "p(arrival)", "contact_lost": "contact lost"})
    return _table(table.assign(metres=table["metres"].round().astype(int)))


def _settings(result: Result) -> dict[str, str]:
    """Return the settings with short values, and the limits of the robots."""
    texts = {name: str(value) for name, value in result.settings.items()}
    short = {name: text for name, text in texts.items() if len(text) < 120}

    robots = result.workspace.team.members.items()
    limits = (f"{name} {np.rad2deg(robot.max_slope):.3g}" for name, robot in robots)
    ranges = (f"{name} {robot.lidar_range:.3g}" for name, robot in robots)
    return short | {
        "robots": ", ".join(result.workspace.team.members),
        "slope limits (degrees)": ", ".join(limits),
        "lidar ranges (m)": ", ".join(ranges),
    }


def _listed(values: dict[str, Any], name: str) -> pd.DataFrame:
    """Return a table of names and values."""
    return pd.Series(values, name="value").rename_axis(name).to_frame()


def _table(frame: pd.DataFrame) -> str:
    """Convert a table to HTML with its texts escaped."""
    return frame.reset_index().to_html(index=False, border=0, float_format=_number, na_rep="-")
