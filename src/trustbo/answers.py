"""Scales of the trust that people report."""

import re
from typing import Any

import numpy as np

from trustbo.errors import TrustboError, require_whole

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


def answer_of(report: Any, levels: int) -> Any:
    """Answers on a scale of levels, 1 to their number, of reports in [0, 1]; or these."""
    return np.round(report * (levels - 1.0) * 1e6) / 1e6 + 1.0 if levels else report
