"""Trust that people report, in tables: a row for each person and step, as answers to a study are.

A person becomes a mission without a map, a step a bound, an asked task a row of it, a report a rate
in [0, 1]. Inputs of a step become features: what the person saw since the report before.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from trustbo.answers import levels_of, report_of
from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.logs.rows import columns_of, needed_columns, number_of

_YES = {"1", "1.0", "true", "yes", "success", "succeeded", "ok"}
_NO = {"0", "0.0", "false", "no", "failure", "failed", "fail"}
_TASK = "report"
_LARGEST = 10.0  # input, in units of an outcome
OUTCOMES = ("success", "failure")
"""Features of what a robot did."""


class _Row(NamedTuple):
    """One row of a table."""

    line: int
    report: float  # in [0, 1]; NaN if blank
    success: float
    failure: float
    demand: float
    inputs: tuple[float, ...]


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
    before anything was seen. Steps are taken in their order; a blank report was not given, so
    that reports may be at some steps only, or at the end.

    Args:
        table: Path of a CSV file with a header, separated by commas, semicolons or tabs; or a
            DataFrame, a mapping of columns or a structured array.
        person: Column that identifies the person.
        step: Column of the step, a number.
        report: Column of the report.
        outcome: Column of what the robot did: 1, `true`, `yes` or `success`, or 0, `false`, `no` or
            `failure`, or blank. It becomes the features `success` and `failure`.
        demand: Column with the demand of what was seen, from 0, easy, to 1. It becomes the features
            `success_demand`, success times demand, and `failure_demand`, failure times 1 - demand:
            success at what is hard, and failure at what is easy.
        task: Column of the task that the report is about. Each becomes a row of the mission, its
            features `task_...` being 1; rows of one step are about different tasks.
        inputs: Columns of further features, numbers of size 1, as the prior of their weights is
            that of an outcome: centre and scale columns of other units.
        scale: `"unit"`, reports in [0, 1]; `"likert7"` (or `"ordinal7"`), whole numbers 1 to 7.

    Returns:
        Missions without a map, one for each person in the order of the table; `n_ticks` is the
        number of steps of a scale of levels, such as 6.

    Raises:
        TrustboError: A missing file or column, a repeated row, a value of the wrong kind or off the
            scale, an input of values beyond 10, a person without reports, or no outcome and no
            input at all.
    """
    levels = levels_of(scale)
    named = {"person": person, "step": step, "report": report}
    named |= {"outcome": outcome, "demand": demand, "task": task}
    wanted = [name for name in (*named.values(), *inputs) if name is not None]
    if len(set(wanted)) < len(wanted):
        raise TrustboError(f"one column has two meanings: {', '.join(wanted)}.")
    columns = columns_of(table)
    missing = next((name for name in wanted if name not in columns), "")
    argument = next((name for name, column in named.items() if column == missing), "inputs")
    remedy = f'. Name its columns, such as read_reports(table, {argument}="...").'
    needed_columns(columns, wanted, remedy=remedy)
    if demand is not None and outcome is None:
        raise TrustboError(f"demand={demand!r} scales outcomes: name their column, outcome=.")
    if outcome is None and not inputs and task is None:
        raise TrustboError("reports need what was seen: give outcome=, a column, or inputs=.")
    people: dict[str, dict[float, dict[str, _Row]]] = {}
    tasks: dict[str, None] = {}
    for i in range(len(columns[person])):
        text = {name: columns[name][i] for name in wanted}
        who, about = text[person], "" if task is None else text[task]
        where = f"row {i + 1}"
        if not who or (task is not None and not about):
            raise TrustboError(f"{where}: {person if not who else task} is blank.")
        k = number_of(where, step, text[step])
        if math.isnan(k):
            raise TrustboError(f"{where}: {step} is blank.")
        steps = people.setdefault(who, {}).setdefault(k, {})
        if about in steps:
            again = f" and {task} {about}" if task else ""
            raise TrustboError(
                f"person {who}, {step} {k:g}{again} is there twice, in rows "
                f"{steps[about].line} and {i + 1}."
            )
        tasks[about] = None
        steps[about] = _row(i + 1, text, named, inputs, levels)
    return [
        _mission(who, steps, tuple(tasks), named, inputs, scale) for who, steps in people.items()
    ]


def _row(
    line: int,
    text: Mapping[str, str],
    named: Mapping[str, str | None],
    inputs: Sequence[str],
    levels: int,
) -> _Row:
    where = f"row {line}"
    outcome, demand = named["outcome"], named["demand"]
    success, failure = (0.0, 0.0) if outcome is None else outcome_of(where, outcome, text[outcome])
    d = 0.0 if demand is None else number_of(where, demand, text[demand])
    if math.isnan(d) and not success + failure:
        d = 0.0  # of nothing seen
    if not 0.0 <= d <= 1.0:
        raise TrustboError(f"{where}: {demand} = {text[str(demand)]!r} must be in [0, 1].")
    given = tuple(number_of(where, name, text[name]) for name in inputs)
    for name, value in zip(inputs, given, strict=True):
        if math.isnan(value):
            raise TrustboError(f"{where}: {name} is blank; an input must be known at each step.")
        if abs(value) > _LARGEST:
            raise TrustboError(
                f"{where}: {name} = {value:g} is beyond {_LARGEST:g}; inputs are of size 1: "
                "centre and scale the column, such as (column - column.mean()) / column.std()."
            )
    report = str(named["report"])
    return _Row(line, report_in(where, report, text[report], levels), success, failure, d, given)


def _mission(
    who: str,
    steps: Mapping[float, Mapping[str, _Row]],
    tasks: tuple[str, ...],
    named: Mapping[str, str | None],
    inputs: Sequence[str],
    scale: str,
) -> Mission:
    features = [f"task_{name}" for name in tasks] if named["task"] else []
    features += OUTCOMES if named["outcome"] else []
    features += ["success_demand", "failure_demand"] if named["demand"] else []
    features += inputs
    z = np.zeros((len(steps), len(tasks), len(features)))
    y = np.full(z.shape[:2], np.nan)
    for k, of_step in enumerate(steps[s] for s in sorted(steps)):
        for r, name in enumerate(tasks):
            # What was seen is of the step: a task that was not asked about has it too.
            row = of_step.get(name, next(iter(of_step.values())))
            y[k, r] = row.report if name in of_step else np.nan
            values = [float(name == other) for other in tasks] if named["task"] else []
            values += [row.success, row.failure] if named["outcome"] else []
            if named["demand"]:
                values += [row.success * row.demand, row.failure * (1.0 - row.demand)]
            z[k, r] = [*values, *row.inputs]
    names = tasks if named["task"] else (_TASK,)
    if np.isnan(y).all():
        raise TrustboError(f"person {who} has no report; leave out the rows of this person.")
    try:
        return person_mission(z, y, features, names, scale)
    except TrustboError as error:
        raise TrustboError(f"person {who}: {error}") from None


def person_mission(
    z: np.ndarray, y: np.ndarray, features: Sequence[str], tasks: Sequence[str], scale: str
) -> Mission:
    """Mission of reports y (step, task) of a person, under inputs z (step, task, input)."""
    levels = levels_of(scale)
    made = Mission.from_arrays(
        None, z, y, n_ticks=levels - 1.0 if levels else None, features=features, robots=tasks
    )
    return replace(made, scale=scale)


def report_in(where: str, name: str, text: str, levels: int) -> float:
    """Report in [0, 1]."""
    answer = number_of(where, name, text, "; leave out what was not answered")
    return report_of(f"{where}: {name}", answer, levels)


def outcome_of(where: str, name: str, text: str) -> tuple[float, float]:
    """Success and failure, each 0 or 1; both 0 where nothing was seen."""
    if not text:
        return 0.0, 0.0
    if text.lower() in _YES:
        return 1.0, 0.0
    if text.lower() in _NO:
        return 0.0, 1.0
    raise TrustboError(
        f"{where}: {name} = {text!r} is no outcome; give 1 or 0, success or failure, or a blank."
    )
