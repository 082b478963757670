"""Trust that people report: scales of answers, and the reports of a mission."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from trustbo.errors import ShapeError, TrustboError, require_known, require_whole

PERSON = "operator"
"""Name of a person who is not named."""
_NAMED = re.compile(r"(likert|ordinal)(\d*)")


def levels_of(scale: object) -> int:
    """Number of levels of a scale, 0 of "unit".

    TrustboError: the name is none of "unit", "likert7" and "ordinal7", with any number from 2.
    """
    found = _NAMED.fullmatch(scale) if isinstance(scale, str) else None
    if scale != "unit" and found is None:
        raise TrustboError(
            f'scale must be "unit", "likert7" or "ordinal7", the number being that of levels; '
            f"got {scale!r}."
        )
    return 0 if found is None else require_whole("levels of a scale", int(found[2] or 7), 2)


def report_of(what: str, answer: float, levels: int) -> float:
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


@dataclass(frozen=True, eq=False)
class Reports:
    """Trust in each robot that a person reported before, during and after a mission.

    Attributes:
        values: Reports in [0, 1], shape (1 + bound, robot): before the mission, and after each
            bound that was run; NaN where none was given.
        person: Name of the person.
        scale: `"unit"`, numbers in [0, 1]; `"likert7"` or `"ordinal7"`, so many levels, of which
            the values are (answer - 1) / 6. See `HumanTrust`.

    Raises:
        TrustboError: A value that is not on the scale, or a person without a name.
    """

    values: np.ndarray
    person: str = PERSON
    scale: str = "unit"

    def __post_init__(self) -> None:
        if not isinstance(self.person, str) or not self.person.strip():
            raise TrustboError(f"person must be a name; got {self.person!r}.")
        answers, given = self.answers, ~np.isnan(self.values)
        off = (self.values < 0.0) | (self.values > 1.0)
        if levels := levels_of(self.scale):
            off |= given & (answers != np.round(answers))
        for k, i in np.argwhere(off):
            report_of(f"report [{k}, {i}]", float(answers[k, i]), levels)

    @classmethod
    def of(
        cls, answers: Any, robots: Sequence[str], n_bounds: int, person: str, scale: str
    ) -> Self:
        """Reports of answers on their scale, see `Mission.with_reports`."""
        levels = levels_of(scale)
        if isinstance(answers, Mapping):
            require_known("robot", answers, robots)
            answers = [answers.get(name, np.nan) for name in robots]
        try:
            given = np.array(answers, dtype=float)
        except (TypeError, ValueError):
            raise TrustboError(f"reports must be numbers; got {answers!r:.80}.") from None
        n, full = len(robots), np.full((1 + n_bounds, len(robots)), np.nan)
        if given.shape not in ((n,), (n_bounds, n), full.shape):
            raise ShapeError(
                f"reports must be ({n},), of each robot after the mission, ({n_bounds}, {n}), "
                f"after each bound, or ({n_bounds + 1}, {n}), before the first too; got "
                f"{given.shape}."
            )
        rows = full[len(full) - len(np.atleast_2d(given)) :]
        for (k, i), answer in np.ndenumerate(np.atleast_2d(given)):
            rows[k, i] = report_of(f"report about {robots[i]}", answer, levels)
        return cls(full, person, scale)

    @property
    def answers(self) -> np.ndarray:
        """Answers on the scale, of the shape of `values`."""
        return answer_of(self.values, levels_of(self.scale))


def answer_of(report: Any, levels: int) -> Any:
    """Answers on a scale of levels, 1 to their number, of reports in [0, 1]; or these."""
    return np.round(report * (levels - 1.0) * 1e6) / 1e6 + 1.0 if levels else report
