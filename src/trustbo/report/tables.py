"""Tables of a page."""

from collections.abc import Hashable
from typing import Any

import numpy as np
from arviz_stats import sampling_diagnostics

from trustbo.campaign.result import Result
from trustbo.campaign.state import GIVEN_UP
from trustbo.criticism.criticise import Criticism
from trustbo.data import path_text
from trustbo.files import to_json
from trustbo.inference.posterior_tree import labelled_draws
from trustbo.report.blocks import Table
from trustbo.report.numbers import NONE, decimals_for, number


def bounds_table(result: Result) -> Table:
    """Tabulate the recommended path: expected trust of each robot after each bound."""
    plan, names = result.plan, result.workspace.team.names
    low, high = plan.bands[0], plan.bands[-1]
    # One digit of the sd, where 90 % is +- 1.65 sd.
    places = min(max(decimals_for(float(np.median(high - low)) / 3.3) - 1, 2), 3)

    def trust(k: int, i: int) -> str:
        ends = f"{number(low[k, i], places)} to {number(high[k, i], places)}"
        return f"{number(plan.trust[k, i], places)} ({ends})"

    rows = [
        (str(k + 1), path_text([cell]), *(trust(k, i) for i in range(len(names))))
        for k, cell in enumerate(plan.path[1:])
    ]
    return Table(
        "Expected trust after each bound of the recommended path, from cell "
        f"{path_text(plan.path[:1])} on; in brackets the 90 % band over the posterior.",
        ("bound", "cell", *names),
        rows,
    )


def parameter_table(result: Result) -> Table:
    """Tabulate the posterior of each parameter after the last mission."""
    posterior = result.posterior
    # The draws of the exact sampler are nearly independent; its diagnostic is k-hat, not R-hat.
    diagnosed = posterior.attrs["sampler"] != "exact"
    sites = posterior["posterior"].to_dataset()
    with np.errstate(invalid="ignore"):
        rhat = sampling_diagnostics.rhat(sites) if diagnosed else None
        ess = sampling_diagnostics.ess(sites, method="bulk") if diagnosed else None
    rows = []
    for label, name, where, draws in labelled_draws(sites):
        sd = float(draws.std())
        places = decimals_for(sd)
        low, high = np.quantile(draws, (0.05, 0.95))
        row = [label, *(number(float(v), places) for v in (draws.mean(), sd, low, high))]
        if rhat is not None and ess is not None:
            moves = bool(np.ptp(draws) > 0.0)  # else it is a constant of the model
            row.append(number(float(ess[name][where]), 0) if moves else NONE)
            row.append(number(float(rhat[name][where]), 3) if moves else NONE)
        rows.append(row)
    head = ["parameter", "mean", "sd", "5 %", "95 %"]
    caption = "The posterior of each parameter after the last mission"
    if diagnosed:
        head += ["bulk ESS", "R-hat"]
        caption += ", and its diagnostics"
    else:
        khat, kish = (float(posterior.attrs[name]) for name in ("k_hat", "kish"))
        caption += (
            f", resampled by weights of k-hat {number(khat, 2)} and Kish size {number(kish, 0)}: "
            "the evidence that the draws are sound. R-hat and ESS would be good with any weights, "
            "and are left out"
        )
    return Table(f"{caption}.", head, rows)


def history_table(result: Result) -> Table:
    """Tabulate the missions, one per row."""
    table = result.table()
    columns = {
        "status": [_outcome(row) for row in table.to_dict("records")],
        "contact rate": [number(rate, 2) for rate in table["contact_rate"]],
        "objective": [number(value, 3) for value in table["objective"]],
        "path": [_path(label, row) for label, row in table.iterrows()],
    }
    for name, label, places in (
        ("regret", "regret (%)", 1), ("r_hat", "R-hat", 3), ("ess_bulk", "bulk ESS", 0),
        ("divergences", "divergences", 0), ("k_hat", "k-hat", 2), ("kish", "Kish size", 0),
    ):  # fmt: skip
        if name in table:
            columns[label] = [number(float(value), places) for value in table[name]]
    seconds = table.filter(regex="^seconds_").sum(axis=1, skipna=False)
    columns["seconds"] = [number(value, 1) for value in seconds]
    rows = [
        [NONE if lost else str(i), *row]
        for i, lost, row in zip(
            table.index, table.index.isna(), zip(*columns.values(), strict=True), strict=True
        )
    ]
    return Table(
        "Each mission: how it ended, and on entering which cell it failed, the mean contact rate "
        "measured, the objective when it was planned, the posterior's diagnostics, and the seconds "
        "for all of it.",
        ("mission", *columns),
        rows,
        text_columns=(1, 4),
    )


def _path(label: Hashable, row: Any) -> str:
    if np.isnan(row["objective"]):
        return NONE
    return "first" if label == 1 else "new" if row["path_changed"] else "same"


def _outcome(row: dict[Hashable, Any]) -> str:
    """Text of how a mission ended, and where it failed."""
    status = str(row["status"]).replace("_", " ")
    where = f" at {row['where']}" if row["where"] else ""
    return f"given up: {row['reason']}{where}" if row["state"] == GIVEN_UP else f"{status}{where}"


def criticism_table(criticism: Criticism) -> Table:
    """Tabulate the tests of a criticism."""
    table = criticism.table
    p, after = (map(_p, table[name].to_numpy(dtype=float)) for name in ("p_adjusted", "p_after"))
    size, limit = (
        [NONE if np.isnan(value) else number(value, 2) for value in table[name].to_numpy(float)]
        for name in ("size", "limit")
    )
    words = (map(str, column) for column in (table.index, table["label"], table["finding"]))
    names, labels, findings = words
    rows = list(zip(names, labels, size, limit, p, after, findings, strict=True))
    return Table(
        "Tests of what may be wrong with the model: the label with the strongest evidence, its "
        "size in contact and that from which on it is a fault, p adjusted for the number of "
        "tests, and p once the fault that is named is accounted for.",
        ("check", "label", "size", "limit", "adjusted p", "p after", "finding"),
        rows,
        text_columns=(1, 6),
    )


def _p(value: float) -> str:
    if np.isnan(value):
        return NONE
    return "< .001" if value < 0.001 else number(value, 3)


def settings_table(result: Result) -> Table:
    """Tabulate the settings of the campaign."""
    rows = [(name.replace("_", " "), _plain(value)) for name, value in result.settings.items()]
    return Table("Settings of the campaign.", ("setting", "value"), rows, text_columns=(1,))


def _plain(value: object) -> str:
    if isinstance(value, str | int | float | bool):
        return str(value)
    if isinstance(value, list | tuple) and not any(isinstance(v, list | dict) for v in value):
        return ", ".join(str(v) for v in value) or "none"
    return " ".join(to_json(value).split())
