"""Trust that people report, in tables with a row for each person and step."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from trustbo.data import Mission, levels_of
from trustbo.errors import TrustboError
from trustbo.logs.columns import Columns

_YES = ("1", "true", "yes", "success", "succeeded", "ok")
_NO = ("0", "false", "no", "failure", "failed", "fail")
_LARGEST = 10.0
"""Largest input: the prior of its weight is that of an outcome's, which is 0 or 1."""


def read_reports(
    table: Any,
    *,
    person: str = "person",
    step: str = "step",
    report: str = "report",
    outcome: str | None = None,
    demand: str | None = None,
    task: str | None = None,
    inputs: Sequence[str] = (),
    scale: str = "unit",
) -> list[Mission]:
    """Read reports of trust from a table with a row for each person and step.

    A report is given after the outcome of its step. A first row without an outcome is the report
    before anything was seen. Steps are taken in order; a blank report was not given. A person
    becomes a mission without a map, a step a bound, an asked task a robot, a report a rate in
    [0, 1], and inputs of a step become features: what the person saw since the report before.

    Args:
        table: Path of a CSV file with a header, separated by commas, semicolons or tabs; or a
            DataFrame, a mapping of columns or a structured array.
        person: Column that identifies the person.
        step: Column of the step, a number.
        report: Column of the report.
        outcome: Column of what the robot did: 1, `true`, `yes` or `success`, or 0, `false`, `no` or
            `failure`, or blank. It becomes the features `success` and `failure`.
        demand: Column with the demand of what was seen, from 0, easy, to 1. It becomes the features
            `success_demand`, success times demand, and `failure_demand`, failure times 1 - demand.
        task: Column of the task that the report is about. Each becomes a row of the mission, its
            feature `task_...` being 1; rows of one step are about different tasks.
        inputs: Columns of further features, numbers of size 1: centre and scale other units.
        scale: `"unit"`, reports in [0, 1]; `"likert7"` (or `"ordinal7"`), whole numbers 1 to 7.

    Returns:
        Missions, one for each person in the order of the table; `n_ticks` is the number of steps
        of a scale of levels, such as 6.

    Raises:
        TrustboError: A missing file or column, a repeated row, a value of the wrong kind or off the
            scale, a large input, a person without reports, or neither an outcome nor an input.
    """
    levels = levels_of(scale)
    if outcome is None and (demand is not None or not (inputs or task)):
        raise TrustboError("reports need what was seen: give outcome=, a column, or inputs=.")
    named = {"person": person, "step": step, "report": report, "outcome": outcome}
    named |= {"demand": demand, "task": task}
    columns = Columns(table)
    for argument, column in named.items():
        if column is not None:
            columns.require([column], f' Name its columns, such as {argument}="...".')
    people, tasks = columns.names(person), columns.names(task) if task else []
    if "" in (*people, *tasks):
        raise TrustboError("a person or a task is blank; leave the row out.")
    k, answers = columns.numbers(step, blank=False), columns.numbers(report)
    rows = columns.frame.index
    y = [_report_of(f"row {i}: {report}", answer, levels)
         for i, answer in zip(rows, answers.tolist(), strict=True)]  # fmt: skip
    seen = _seen(columns, outcome, demand, inputs)
    every = list(dict.fromkeys(tasks))
    r = np.array([every.index(name) for name in tasks] if task else [0] * len(rows))
    who, missions = np.array(people), []
    for name in dict.fromkeys(people):
        of = who == name
        try:
            missions.append(_mission(k[of], r[of], np.array(y)[of], seen, of, every, scale))
        except TrustboError as error:
            raise TrustboError(f"{person} {name}: {error}") from None
    return missions


def _seen(
    columns: Columns, outcome: str | None, demand: str | None, inputs: Sequence[str]
) -> dict[str, np.ndarray]:
    """Features of what was seen, by name, each (row,)."""
    seen, rows = {}, columns.frame.index
    if outcome is not None:
        given = [text.lower() for text in columns.texts(outcome)]
        for row, text in zip(rows, given, strict=True):
            if text and text not in (*_YES, *_NO):
                raise TrustboError(
                    f"row {row}: {outcome} = {text!r} is no outcome; give 1 or 0, success or "
                    "failure, or a blank."
                )
        seen["success"] = np.array([float(text in _YES) for text in given])
        seen["failure"] = np.array([float(text in _NO) for text in given])
    if demand is not None:
        d = columns.numbers(demand)
        d = np.where(np.isnan(d) & (seen["success"] + seen["failure"] == 0.0), 0.0, d)
        if (bad := ~((d >= 0.0) & (d <= 1.0))).any():
            raise TrustboError(f"row {rows[bad][0]}: {demand} = {d[bad][0]:g} must be in [0, 1].")
        seen["success_demand"] = seen["success"] * d
        seen["failure_demand"] = seen["failure"] * (1.0 - d)
    for name in inputs:
        seen[name] = columns.numbers(name, blank=False)
        if (large := np.abs(seen[name]).max()) > _LARGEST:
            raise TrustboError(
                f"{name} has values up to {large:g}; inputs are of size 1: centre and scale the "
                "column, such as (column - column.mean()) / column.std()."
            )
    return seen


def _mission(
    k: np.ndarray,
    r: np.ndarray,
    y: np.ndarray,
    seen: dict[str, np.ndarray],
    of: np.ndarray,
    tasks: Sequence[str],
    scale: str,
) -> Mission:
    """Mission of one person: steps k, tasks r and reports y of the rows `of` the table, (row,)."""
    steps, first, s = np.unique(k, return_index=True, return_inverse=True)
    if len({*zip(s.tolist(), r.tolist(), strict=True)}) < len(s):
        raise TrustboError("a step, or a step and task, is there twice.")
    if np.isnan(y).all():
        raise TrustboError("there is no report; leave out the rows.")
    shape, n_tasks = (len(steps), max(len(tasks), 1)), len(tasks)
    z, rates = np.zeros((*shape, n_tasks + len(seen))), np.full(shape, np.nan)
    z[:, range(n_tasks), range(n_tasks)] = 1.0
    inputs = np.column_stack([values[of] for values in seen.values()] or [np.empty((len(s), 0))])
    z[..., n_tasks:] = inputs[first][:, None]  # what was seen is of the step, whatever was asked
    z[s, r, n_tasks:], rates[s, r] = inputs, y
    levels = levels_of(scale)
    made = Mission.from_arrays(
        None, z, rates, n_ticks=levels - 1.0 if levels else None,
        features=[*(f"task_{name}" for name in tasks), *seen], robots=tasks or ["report"],
    )  # fmt: skip
    return replace(made, scale=scale)


def _report_of(what: str, answer: float, levels: int) -> float:
    """Report in [0, 1] of an answer, NaN of NaN; TrustboError: it is not on the scale."""
    if np.isnan(answer):
        return np.nan
    if levels:
        if not (answer == np.round(answer) and 1 <= answer <= levels):
            raise TrustboError(
                f"{what} = {answer:g} is no whole number from 1 to {levels}; leave out what was "
                "not answered."
            )
        return (answer - 1.0) / (levels - 1.0)
    if not 0.0 <= answer <= 1.0:
        hint = "; divide it by 100" if answer > 11 else ""
        hint = '; give its scale, such as scale="likert7"' if 1 < answer <= 11 else hint
        raise TrustboError(f"{what} = {answer:g} is outside [0, 1]{hint}.")
    return float(answer)
