"""Failures of a campaign: missions that were given up, with their reasons."""

import difflib
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

from trustbo.data import Cell, Mission
from trustbo.errors import TrustboError, require_pair
from trustbo.hazard.exposures import CAUSES


def require_reason(reason: object, mission: Mission | None) -> None:
    """Refuse a reason that is none or a misspelt cause, or a cause beside a mission that arrived.

    Raises TrustboError.
    """
    if not isinstance(reason, str) or not reason.strip():
        raise TrustboError(f"give a reason, such as one of {', '.join(CAUSES)}; got {reason!r}.")
    if reason in CAUSES:
        if mission is not None and mission.status == "ok":
            raise TrustboError(
                f"the mission reached the goal, its status is 'ok', and {reason!r} is a failure; "
                "give the bounds that were run and their status, or tell the mission."
            )
        return
    plain = reason.strip().lower().replace(" ", "_")
    if near := difflib.get_close_matches(plain, CAUSES, n=1, cutoff=0.8):
        raise TrustboError(
            f"{reason!r} is no cause of failures, and teaches nothing; did you mean {near[0]!r}?"
        )


def require_another(failures: "Sequence[Failure]", n_told: int) -> None:
    """Refuse to give up a mission that was given up already, when no other was asked for since.

    Raises TrustboError.
    """
    if failures and failures[-1].after == n_told:
        raise TrustboError(
            f"the mission that was asked for was given up already: {failures[-1].reason!r}. Ask "
            "for the next one; or, if another really failed too, fail(reason, again=True)."
        )


class Failure(NamedTuple):
    """A mission that was given up."""

    after: int
    """Number of missions told before."""
    reason: str
    path: tuple[Cell, ...] = ()
    """Path that was asked for, start first; empty where its failure says nothing of the bounds."""
    where: Cell | None = None
    """Cell that it failed to enter, where that is known."""
    told: bool = False
    """Whether the bounds that were run were told, as a mission that has a row of the history."""

    @classmethod
    def of(cls, after: int, reason: str, path: Sequence[Cell], where: Cell | None = None) -> Self:
        """Failure on the way along a path; reasons other than `CAUSES` say nothing of its bounds.

        TrustboError: a `where` that the path does not enter, or for another reason.
        """
        reason = str(reason)
        if where is None:
            return cls(after, reason, tuple(path) if reason in CAUSES else ())
        cell = require_pair("where", where)
        if reason not in CAUSES:
            raise TrustboError(
                f"where = {cell} is for the reasons {', '.join(CAUSES)}, from which bounds are "
                f"learned; got {reason!r}."
            )
        if cell not in path[1:]:
            raise TrustboError(f"where must be a cell that the plan enters, {path}; got {cell}.")
        return cls(after, reason, tuple(path), cell)

    @classmethod
    def restore(cls, record: Sequence[Any]) -> Self:
        """Failure of a record."""
        after, reason, path, where, told = record
        cells = tuple((row, col) for row, col in path)
        cell = None if where is None else (where[0], where[1])
        if cell is not None and cell not in cells[1:]:
            raise ValueError(f"no path enters {cell}")
        return cls(after, reason, cells, cell, told)
