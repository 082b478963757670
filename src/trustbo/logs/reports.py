"""Trust reports of people, in tables with one row per person and step."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from trustbo.arrays import without_rounding
from trustbo.data import Mission, levels_of
from trustbo.errors import TrustboError, require_kind, require_list
from trustbo.logs.columns import Columns, folded, require_one_spelling

_YES = ("1", "true", "yes", "success", "succeeded", "ok")
_NO = ("0", "false", "no", "failure", "failed", "fail")
_OUTCOMES = ("success", "failure")
"""Features of an outcome."""
_WORDS = ", and words as numbers: frame[column].map({'agree': 6})"


def read_reports(
    table: Any,
    *,
    person: str = "person",
    step: str = "step",
    report: str = "report",
    outcome: str | None = None,
    inputs: Sequence[str] = (),
    scale: str = "unit",
) -> list[Mission]:
    """Read trust reports from a table with one row per person and step.

    Each report follows the outcome of its step. A first row without an outcome has the report given
    before the first observation. Steps are sorted; a blank means that no report was given. Each
    person becomes a mission without a map, each step a bound of one robot, and each report a rate
    in [0, 1]. The inputs since the previous report become the features of the step.

    Args:
        table: Path of a CSV file (commas, semicolons or tabs), a DataFrame, or a mapping of lists.
        person: Column that identifies the person.
        step: Column with the number of the step.
        report: Column with the report.
        outcome: Column with the robot's outcome: 1, `true`, `yes` or `success`; 0, `false`, `no` or
            `failure`; or blank. The outcome becomes the features `success` and `failure`.
        inputs: Columns of further features; standardise columns whose values are not of order 1.
        scale: `"unit"` for reports in [0, 1]; `"likert7"` (or `"ordinal7"`) for whole numbers from
            1 to 7.

    Returns:
        Missions, one per person in the order of the table. For a scale of levels, `n_ticks` is the
        number of levels minus 1, such as 6.

    Raises:
        TrustboError: A column is missing, a row or an input is repeated, a value has the wrong type
            or is off the scale, a person has no reports, or there is neither an outcome nor an
            input.

    Example:
        >>> people = tb.logs.read_reports("answers.csv", outcome="outcome", scale="likert7")
        >>> posterior = tb.fit(people)  # of HumanTrust
    """
    levels = levels_of(scale)
    columns = {"person": person, "step": step, "report": report}
    for what, name in columns.items():
        require_kind(what, name, str, "give the name of a column")
    inputs = require_list("inputs", inputs, str, "give the names of columns")
    if outcome is None and not inputs:
        raise TrustboError("give the column of outcomes (outcome=) or other columns (inputs=).")
    features = [*inputs, *(() if outcome is None else _OUTCOMES)]
    if len({folded(name) for name in features}) < len(features):
        raise TrustboError(
            f"inputs must be different columns, which are not called {' or '.join(_OUTCOMES)} if "
            f"there is an outcome; got {inputs}."
        )

    columns = Columns(table)
    people = np.array(columns.texts(person, blank=False))
    steps = columns.numbers(step, blank=False)
    require_one_spelling(f"column {person}", people.tolist())

    given = columns.numbers(report, whole=levels > 0, hint=_WORDS)
    given = given if levels else without_rounding(given)
    low = 1 if levels else 0
    high = levels or 1
    columns.refuse(
        report,
        (given < low) | (given > high),
        f'is not between {low} and {high}; give the scale, such as scale="likert7", divide '
        "percentages by 100, and leave missing answers blank",
    )

    y = (given - low) / (high - low)
    seen = _seen(columns, outcome, inputs)
    z = np.column_stack([*seen.values()])

    missions = []
    for name in dict.fromkeys(people.tolist()):
        of = np.flatnonzero(people == name)
        of = of[np.argsort(steps[of])]
        if (np.diff(steps[of]) == 0.0).any():
            raise TrustboError(f"{person} {name}: two rows have the same step.")
        if np.isnan(y[of]).all():
            raise TrustboError(f"{person} {name}: there is no report; leave out these rows.")

        made = Mission.from_arrays(
            None,
            z[of][:, None],
            y[of][:, None],
            n_ticks=levels - 1.0 if levels else None,
            features=[*seen],
            robots=["report"],
        )
        missions.append(replace(made, scale=scale))

    return missions


def _seen(columns: Columns, outcome: str | None, inputs: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the features by name, each (row,)."""
    seen = {}
    if outcome is not None:
        given = np.array([text.lower() for text in columns.texts(outcome)])
        unknown = ~np.isin(given, ["", *_YES, *_NO])
        columns.refuse(outcome, unknown, "must be 1 or 0, success or failure, or blank")
        for name, words in zip(_OUTCOMES, (_YES, _NO), strict=True):
            seen[name] = np.isin(given, words).astype(float)

    return seen | {name: columns.numbers(name, blank=False, hint=_WORDS) for name in inputs}
