"""HTML report of a result, with figures, tables and diagnostics."""

import base64
import io
from collections.abc import Callable
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from arviz_stats.summary import summary

from trustbo import plots
from trustbo.campaign.result import Result
from trustbo.display import render
from trustbo.errors import require_kind
from trustbo.files import FilePath, write_text
from trustbo.planning import Plan
from trustbo.plots.style import drawing

__all__ = ["write_report"]
__dir__ = __all__.copy  # tab completion lists only public names

_DRAWS = 50
"""Number of posterior draws for the uncertainty map."""
_SHOWN = 3
"""Number of bounds shown in detail, which are the bounds with the least trust."""
_ENDS = {"n_iterations": "all missions were run", "interrupted": "none; more missions can be run"}


class _Block(NamedTuple):
    """Part of a section of the page: an image, a table or a note."""

    image: str = ""  # PNG in base64
    alt: str = ""  # text in place of the image
    table: str = ""  # HTML with its texts escaped
    note: str = ""


class _Section(NamedTuple):
    """Section of the page."""

    heading: str
    blocks: list[_Block]


def write_report(path: FilePath, result: Result) -> None:
    """Write a result as one self-contained HTML page.

    The page begins with the recommended path and its predicted contact and risk. The trust map,
    the missions, the uncertainty, the diagnostics and the settings follow.

    Args:
        path: File to write.
        result: Result of a campaign with a posterior.

    Raises:
        TrustboError: There is no posterior yet, or the file cannot be written.
    """
    require_kind("result", result, Result, "give a result or a campaign")
    _ = result.posterior  # raises if there is none yet
    n = len(result.missions)
    missions = "1 mission" if n == 1 else f"{n} missions"
    page = render(
        "report.html",
        title=f"Recommended path after {missions}",
        facts=_facts(result),
        sections=[
            _path(result.plan),
            _trust(result),
            _missions(result),
            _uncertainty(result),
            _diagnostics(result),
            _settings(result),
        ],
    )
    write_text(path, page)


def _facts(result: Result) -> dict[str, str]:
    """Return the facts, by name, that are needed to decide whether to drive the path."""
    plan = result.plan
    problem = result.planner.problem
    noise_sd = problem.recursion(result.belief.mean()).noise_sd
    contact = np.minimum(problem.likelihood.mean_rate(plan.trust, noise_sd), 1.0).mean(1)
    worst = int(np.argmin(contact))

    rate = result.state.entries[-1].row["contact_rate"]
    last = f"{rate:.1%} of the time" if np.isfinite(rate) else "not measured"
    cells = " → ".join(f"{row},{col}" for row, col in plan.path)
    facts = {
        "Path": f"{cells} (row,column; row 0 is north)",
        "Length": f"{len(plan.path) - 1} bounds, {plan.length:.0f} m",
        "Expected contact": f"{contact.mean():.1%} of the time, averaged over robots and bounds",
        "Weakest bound": f"bound {worst + 1} into cell {_name(plan.path[worst + 1])}, "
        f"expected contact {contact[worst]:.1%}",
        "Last mission": f"status {result.missions[-1].status}, contact {last}",
        "Reason for stopping": _ENDS.get(result.stop_reason, result.stop_reason),
    }
    if plan.p_arrive is not None:
        facts["Probability of arrival"] = f"{plan.p_arrive:.1%}, given the robots' slope limit"
    return facts


def _path(plan: Plan) -> _Section:
    """Plot the recommended path if there is a terrain, and make a table of its bounds."""
    blocks = []
    if plan.stops is not None:
        weakest = sorted((np.argsort(plan.trust.mean(1))[:_SHOWN] + 1).tolist())
        blocks += [
            _image(lambda: plots.plan_map(plan, bounds=weakest), "path, posts and routes"),
            _note(
                "The first map shows the path from start (circle) to goal (star). The others show "
                "the bounds with the least trust. The robots watch from their posts while the lead "
                "drives, and then drive to their next posts."
            ),
        ]

    low, high = plan.bands[0], plan.bands[-1]
    table = pd.DataFrame({
        "cell": [_name(cell) for cell in plan.path[1:]],
        "expected trust": plan.trust.mean(1),
        "5 %": low.mean(1),
        "95 %": high.mean(1),
    }, index=pd.RangeIndex(1, len(plan.path), name="bound"))  # fmt: skip
    return _Section("Recommended path", [*blocks, _table(table)])


def _trust(result: Result) -> _Section:
    is_logit = result.settings["family"] == "beta_binomial"
    scale = "Trust is the logit of contact." if is_logit else "A trust of 1 means unbroken contact."
    return _Section(
        "Trust map",
        [
            _image(result.plot_maps, "trust maps after selected missions"),
            _note(
                f"Expected trust in each cell, and the path planned with this trust. {scale} "
                "Impassable cells are grey, and so is the start, whose trust is assumed."
            ),
        ],
    )


def _missions(result: Result) -> _Section:
    table = result.table()
    columns = ("status", "contact_rate", "contact_lost", "objective", "n_bounds")
    shown = table.loc[:, [name for name in columns if name in table]].rename_axis("mission")
    shown.columns = [str(name).replace("_", " ") for name in shown.columns]
    return _Section(
        "Contact in each mission",
        [
            _image(result.plot_history, "contact and objective of each mission"),
            _table(shown),
            _note(
                f"The objective ({result.settings['objective'].replace('_', ' ')}) is the value "
                "predicted for the plan of a mission, based on all earlier missions."
            ),
        ],
    )


def _uncertainty(result: Result) -> _Section:
    plan = result.plan
    maps = result.maps(n_draws=_DRAWS)
    driven = {bound.cell for mission in result.missions for bound in mission.bounds}
    new = [_name(cell) for cell in plan.path[1:] if cell not in driven]
    known = "Every cell of the path was entered in a mission."
    if new:
        known = f"Cells of the path that were never entered: {', '.join(new)}."
    band = ""
    if plan.value_band is not None:
        low, high = plan.value_band
        band = (
            f"The objective is {plan.value:.3g}, with a 90 % interval of {low:.3g} to {high:.3g}; "
            "only the objective limits trust to 1, so it can lie outside."
        )
    return _Section(
        "Uncertainty",
        [
            _image(
                lambda: plots.cell_map(
                    maps["trust_sd"], result.workspace, path=plan.path, label="sd of expected trust"
                ),
                "standard deviation of trust",
            ),
            _note(
                f"{known} {band} The intervals assume an adequate model (see trustbo.criticism). "
                "In cells that were never entered, trust is predicted from a map that may be "
                "outdated."
            ),
        ],
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
    )


def _settings(result: Result) -> _Section:
    texts = {name: str(value) for name, value in result.settings.items()}
    short = {name: text for name, text in texts.items() if len(text) < 120}
    return _Section(
        "Settings",
        [
            _table(pd.Series(short, name="value").rename_axis("setting").to_frame()),
        ],
    )


def _name(cell: tuple[int, int]) -> str:
    return f"{cell[0]},{cell[1]}"


def _note(text: str) -> _Block:
    return _Block(note=text)


def _table(frame: pd.DataFrame) -> _Block:
    html = frame.reset_index().to_html(
        index=False, border=0, float_format=lambda x: f"{x:.3g}", na_rep="-"
    )
    return _Block(table=html)


def _image(draw: Callable[[], Any], alt: str) -> _Block:
    """Draw a figure as an image with a text in its place."""
    with drawing("default"):
        figure = np.ravel(draw())[0].get_figure(root=True)
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=130, bbox_inches="tight")
        plt.close(figure)

    return _Block(image=base64.b64encode(file.getvalue()).decode(), alt=alt)
