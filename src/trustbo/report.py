"""HTML report of a result, with figures, tables and diagnostics."""

import base64
import io
from collections.abc import Callable
from html import escape
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from arviz_stats.summary import summary

from trustbo import plots
from trustbo.campaign.result import Result
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
_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 52em; margin: 1.5em auto; padding: 0 1em;
  color: #1c1f22; background: #fff }}
h1 {{ font-size: 1.6em }} h2 {{ font-size: 1.2em; margin-top: 2em }}
img {{ max-width: 100%; height: auto }}
.wide {{ overflow-x: auto; margin: 1em 0 }}
@media (max-width: 46em) {{ img {{ max-width: 42rem }} }}
table {{ border-collapse: collapse; font-size: .85em; border: 0 }}
td, th {{ padding: .2em .7em; text-align: right; border: 0; border-bottom: 1px solid #ddd }}
.facts td, .facts th {{ text-align: left; vertical-align: top; font-size: 1.1em }}
.note {{ color: #555; font-size: .9em }}
</style></head><body>
<h1>{title}</h1>
{body}
</body></html>
"""


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
    body = [_facts(result), *_path(result.plan), *_trust(result), *_missions(result)]
    body += [*_uncertainty(result), *_diagnostics(result), *_settings(result)]
    n = len(result.missions)
    title = f"Recommended path after {n} mission{'s' * (n != 1)}"
    write_text(path, _PAGE.format(title=title, body="\n".join(body)))


def _facts(result: Result) -> str:
    """Make a table of the facts needed to decide whether to drive the path."""
    plan, problem = result.plan, result.planner.problem
    noise_sd = problem.dynamics(result.belief.mean()).noise_sd
    contact = np.minimum(problem.family.mean_rate(plan.trust, noise_sd), 1.0).mean(1)
    worst, rate = int(np.argmin(contact)), result.state.entries[-1].row["contact_rate"]
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
    rows = "".join(
        f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in facts.items()
    )
    return f'<table class="facts">{rows}</table>'


def _path(plan: Plan) -> list[str]:
    """Plot the recommended path if there is a terrain, and make a table of its bounds."""
    content = [_heading("Recommended path")]
    if plan.stops is not None:
        weakest = sorted((np.argsort(plan.trust.mean(1))[:_SHOWN] + 1).tolist())
        content += [
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
    return [*content, _table(table)]


def _trust(result: Result) -> list[str]:
    is_logit = result.settings["observation"] == "beta_binomial"
    scale = "Trust is the logit of contact." if is_logit else "A trust of 1 means unbroken contact."
    return [
        _heading("Trust map"),
        _image(result.plot_maps, "trust maps after selected missions"),
        _note(
            f"Expected trust in each cell, and the path planned with this trust. {scale} "
            "Impassable cells are grey, and so is the start, whose trust is assumed."
        ),
    ]


def _missions(result: Result) -> list[str]:
    table = result.table()
    columns = ("status", "contact_rate", "contact_lost", "objective", "n_bounds")
    shown = table.loc[:, [name for name in columns if name in table]].rename_axis("mission")
    shown.columns = [str(name).replace("_", " ") for name in shown.columns]
    return [
        _heading("Contact in each mission"),
        _image(result.plot_history, "contact and objective of each mission"),
        _table(shown),
        _note(
            f"The objective ({result.settings['objective'].replace('_', ' ')}) is the value "
            "predicted for the plan of a mission, based on all earlier missions."
        ),
    ]


def _uncertainty(result: Result) -> list[str]:
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
    return [
        _heading("Uncertainty"),
        _image(
            lambda: plots.cell_map(
                maps["trust_sd"], result.workspace, path=plan.path, label="sd of expected trust"
            ),
            "standard deviation of trust",
        ),
        _note(
            f"{known} {band} The intervals assume an adequate model (see trustbo.criticism). "
            "In cells that were never entered, trust is predicted from a map that may be outdated."
        ),
    ]


def _diagnostics(result: Result) -> list[str]:
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
    return [
        _heading("Diagnostics"),
        _note(f"Sampler: {result.posterior.attrs.get('sampler', 'unknown')}."),
        _table(pd.Series(rows, name="value").rename_axis("diagnostic").to_frame()),
        _table(table[kept].rename_axis("parameter")),
    ]


def _settings(result: Result) -> list[str]:
    texts = {name: str(value) for name, value in result.settings.items()}
    short = {name: text for name, text in texts.items() if len(text) < 120}
    return [
        _heading("Settings"),
        _table(pd.Series(short, name="value").rename_axis("setting").to_frame()),
    ]


def _name(cell: tuple[int, int]) -> str:
    return f"{cell[0]},{cell[1]}"


def _heading(text: str) -> str:
    return f"<h2>{escape(text)}</h2>"


def _note(text: str) -> str:
    return f'<p class="note">{escape(text)}</p>'


def _table(frame: pd.DataFrame) -> str:
    html = frame.reset_index().to_html(
        index=False, border=0, float_format=lambda x: f"{x:.3g}", na_rep="-"
    )
    return f'<div class="wide">{html}</div>'


def _image(draw: Callable[[], Any], alt: str) -> str:
    """Draw a figure and return an HTML image with the figure."""
    with drawing("default"):
        figure = np.ravel(draw())[0].get_figure(root=True)
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=130, bbox_inches="tight")
        plt.close(figure)
    data = base64.b64encode(file.getvalue()).decode()
    image = f'<img alt="{escape(alt)}" src="data:image/png;base64,{data}">'
    return f'<div class="wide">{image}</div>'
