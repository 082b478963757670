"""Closings of a campaign: cells and bounds that are closed for some time, or for ever."""

from collections.abc import Iterable
from datetime import datetime
from typing import Any, NamedTuple

from trustbo.data import Cell
from trustbo.errors import TrustboError, one_line, require_count
from trustbo.workspace.closed import Closed, closed_text


class Closing(NamedTuple):
    """Cells and bounds that a user closed.

    Attributes:
        where: Closed cells, (cell,), and bounds, (cell, cell), as in `Workspace.closed`.
        reason: Reason, as given by the user.
        at: Time of the report, ISO 8601.
        until: Time from which the closing no longer counts, ISO 8601; or the number of the first
            mission for which it no longer counts; None if it has no end.
        by: Who reported it; may be empty.
        reopened: Reason why a user reopened it, or an empty string.
    """

    where: tuple[tuple[Cell, ...], ...]
    reason: str
    at: str
    until: str | int | None = None
    by: str = ""
    reopened: str = ""

    @property
    def closed(self) -> dict[tuple[Cell, ...], str]:
        """What is closed, as in `Workspace.closed`."""
        return dict.fromkeys(self.where, self.reason)

    @property
    def until_text(self) -> str:
        """The end as text."""
        if self.until is None:
            return "for ever"
        return f"until {'mission ' if isinstance(self.until, int) else ''}{self.until}"

    def why_over(self, n_next: int) -> str:
        """Return why it no longer counts for mission `n_next`; an empty string if it counts."""
        if self.reopened:
            return self.reopened
        is_over = False
        if isinstance(self.until, int):
            is_over = n_next >= self.until
        elif self.until is not None:
            is_over = now() >= datetime.fromisoformat(self.until)
        return f"{self.until_text} only" if is_over else ""

    def after(self, n_missions: int) -> "Closing":
        """Return the closing for a campaign that begins after this number of missions."""
        until = self.until - n_missions if isinstance(self.until, int) else self.until
        return self._replace(until=until)

    def row(self, n_next: int, name_of: Any) -> dict[str, Any]:
        """Return its row in `Result.closings`."""
        return {
            "where": closed_text(dict.fromkeys(self.where, ""), name_of),
            "reason": self.reason,
            "until": "" if self.until is None else str(self.until),
            "at": self.at,
            "by": self.by,
            "over": self.why_over(n_next),
        }


def now() -> datetime:
    """Return the time with the local time zone."""
    return datetime.now().astimezone()


def closed_by(closings: Iterable[Closing], n_next: int) -> dict[tuple[Cell, ...], str]:
    """Return what is closed for mission `n_next`, planned now."""
    closed: dict[tuple[Cell, ...], str] = {}
    for closing in closings:
        if not closing.why_over(n_next):
            closed |= closing.closed
    return closed


def closing_of(closed: Closed, reason: str, until: Any, by: str, n_next: int) -> Closing:
    """Make a closing that begins now.

    Args:
        closed: What is closed.
        reason: Reason, not empty.
        until: End, as for `Campaign.close_off`.
        by: Who reports it.
        n_next: Number of the next mission.

    Raises:
        TrustboError: The end is no time or number, or has passed.
    """
    begins = now()
    if until is not None and not isinstance(until, str | datetime):
        until = require_count("until", until)
        if until <= n_next:
            raise TrustboError(
                f"until = {until} must be above {n_next}, the number of the next mission, from "
                "which on the closing would not count."
            )
    elif until is not None:
        end = _time(until)
        if end <= begins:
            raise TrustboError(f"until = {end.isoformat()} has passed; give a later time.")
        until = end.isoformat()
    return Closing(tuple(closed), reason, begins.isoformat(timespec="seconds"), until, by)


def _time(value: str | datetime) -> datetime:
    """Return a time; without a time zone, it is local."""
    try:
        time = datetime.fromisoformat(value) if isinstance(value, str) else value
    except ValueError:
        raise TrustboError(
            f"until must be a date or a time such as '2026-12-03T08:00', or the number of a "
            f"mission; got {one_line(value)}."
        ) from None
    return time.astimezone()
