"""Recording of what happens in a campaign: it is written, and then learned from."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from typing import Any, Self

import xarray as xr

from trustbo.campaign.closing import closing_of
from trustbo.campaign.folder import FolderStorage, MemoryStorage
from trustbo.campaign.learning import with_posterior
from trustbo.campaign.result import Result
from trustbo.campaign.state import Entry, Exclusion, State
from trustbo.errors import TrustboError, require_switch, require_whole, warn
from trustbo.files import FilePath, holding_interrupts
from trustbo.inference.learns import Learner
from trustbo.workspace import Workspace
from trustbo.workspace.closed import require_closed


class Recorder(Result):
    """Result whose state changes, in memory or in a folder.

    Attributes:
        storage: `FolderStorage` of the campaign, or a `MemoryStorage`.
    """

    def __init__(self, workspace: Workspace, state: State, learner: Learner) -> None:
        """Store the state in memory; see `Result`."""
        super().__init__(workspace, state, learner)
        self.storage: FolderStorage | MemoryStorage = MemoryStorage()

    def store_in(self, directory: FilePath, *, overwrite: bool = False) -> None:
        """Write the campaign to a folder, and record everything there from now on.

        A folder that the campaign used before remains as it is, and is released.

        Args:
            directory: Folder, as in the constructor of a campaign.
            overwrite: Whether to replace an existing campaign in that folder.

        Raises:
            TrustboError: The folder already contains a campaign or cannot be written.
        """
        require_switch("overwrite", overwrite)
        with self._turn:
            # Other threads may be waiting for the campaign's lock, which therefore stays the same.
            storage = FolderStorage.begin(
                directory,
                self.workspace,
                self.state,
                overwrite=overwrite,
                take_over=overwrite,
                turn=self._turn,
            )
            storage.adopt(self.state)

            before = self.storage
            self.storage = storage
            before.close()

    def _record(self, **changes: Any) -> None:
        """Change the state and write it; if this fails, nothing has changed."""
        state = replace(self.state, **changes)
        with holding_interrupts():
            self.storage.write(state)
            self.state = state
            if "entries" in changes or "failures" in changes:
                self._computed.clear()

    def _use_posterior(self) -> None:
        """Compute the posterior of the missions that are used now; see `with_posterior`."""
        hazard = self.hazard  # does not depend on what was learned about trust
        state = with_posterior(self.state, self.learner, self.workspace, hazard, self._progress)
        with holding_interrupts():
            self.state = state
            self._computed = {"hazard": hazard}

    def _learn(self) -> None:
        """Learn from the missions, unless this has been done."""
        if self.state.fitted == self.state.used:
            return

        self._use_posterior()
        if self.state.why_not:
            warn(
                f"all is recorded, but the posterior after mission {len(self.state.entries)} "
                f"cannot be computed yet: {self.state.why_not.rstrip('.')}. Learning is retried "
                "after the next mission."
            )

    def _learn_and_write(self, what: str) -> None:
        """Learn after something was recorded; `what` describes it in messages.

        The next call repeats what fails here, so a failure must not look like a failed call.
        """
        try:
            self._learn()
            with holding_interrupts():
                self.storage.write(self.state)
        except TrustboError as error:
            warn(
                f"{what}, and what was learned is in memory, but it could not be written: {error} "
                "The next call writes it."
            )
        except BaseException as error:
            error.add_note(f"{what}; it will be learned at the next call.")
            raise

    def exclude(self, n: int, reason: str) -> xr.DataTree | None:
        """Exclude a mission from learning; to use it again, pass the mission to `tell`.

        Args:
            n: Number of the mission, from 1.
            reason: Reason to store in the table of missions.

        Returns:
            Posterior of the parameters given the other missions; None if there are none. If it
            cannot be computed, a warning is issued, and the previous posterior is returned.

        Raises:
            TrustboError: There is no such mission, it is already excluded by a user, the reason is
                empty, or the exclusion cannot be recorded. The mission is then not excluded.
        """
        with self._turn:
            self._require_mission(n, reason)
            self._learn()
            self._record(entries=self._excluding(n, reason), asked=None)
            self._learn_and_write(f"the exclusion of mission {n} is recorded")
            return self.state.posterior

    def _require_mission(self, n: int, reason: str) -> None:
        """Raise TrustboError unless mission n counts, and can be excluded for this reason."""
        if n in self.state.earlier_here:
            raise TrustboError(
                f"mission {n} is of an earlier campaign; correct it there, and begin this campaign "
                "again with earlier=."
            )
        before = [entry.exclusion and entry.exclusion.reason for entry in self.state.entries]
        self._require_counts("mission", n, reason, before, "excluded")

    def _excluding(self, n: int, reason: str) -> tuple[Entry, ...]:
        """Return the entries, of which mission n is excluded."""
        entries = list(self.state.entries)
        exclusion = Exclusion(len(entries), reason)
        entries[n - 1] = replace(entries[n - 1], exclusion=exclusion)
        return tuple(entries)

    def withdraw(self, n: int, reason: str) -> None:
        """Withdraw a report of `Campaign.fail` that was a mistake; `ask` then plans again.

        Args:
            n: Number of the report, from 1: of the rows of `table` without a number, the n-th.
            reason: Reason to store in the table of missions.

        Raises:
            TrustboError: There is no such report, it is already withdrawn, the reason is empty, or
                the withdrawal cannot be recorded. The report then still counts.
        """
        with self._turn:
            failures = list(self.state.failures)
            before = [failure.withdrawn for failure in failures]
            self._require_counts("report of `fail`", n, reason, before, "withdrawn")

            self._learn()
            failures[n - 1] = failures[n - 1]._replace(withdrawn=reason)
            self._record(failures=tuple(failures), asked=None)

    def close_off(
        self,
        where: Sequence[Any],
        reason: str,
        *,
        until: str | datetime | int | None = None,
        by: str = "",
    ) -> int:
        """Close cells and bounds, such as a way that is blocked by a wreck.

        Plans of `ask`, `plan`, `ways` and `replan` do not use them; see `Workspace.closing`. If the
        plan that was asked for does, `ask` plans again. Nothing is learned from a closing, and
        missions that used what is closed are accepted.

        Args:
            where: Cells, and bounds as pairs of neighbouring cells; or positions, or names of
                places.
            reason: Reason to show in messages and tables.
            until: Time from which the closing no longer counts, such as "2026-12-03T08:00" (local
                time unless it names a time zone; a date begins at midnight); or the number of the
                first mission for which it no longer counts. By default, it has no end.
            by: Who reported it.

        Returns:
            Number of the closing, for `reopen`.

        Raises:
            TrustboError: A cell is off the grid or impassable, cells are no neighbours, the reason
                is empty, `until` has passed, or the closing cannot be recorded.

        Example:
            >>> n = campaign.close_off([(3, 4), ((2, 1), (1, 1))], "wreck", until="2099-12-03")
            >>> campaign.reopen(n, "towed away")
        """
        with self._turn:
            self.storage.require_open()
            _require_reason(reason)
            closed = require_closed(where, reason, self.workspace.locate)
            n_next = len(self.state.entries) + 1
            closing = closing_of(closed, reason, until, by, n_next)
            self._record(closings=(*self.state.closings, closing))
            return len(self.state.closings)

    def reopen(self, n: int, reason: str) -> None:
        """Reopen what was closed; `ask` then plans again.

        Args:
            n: Number of the closing, as in `closings`.
            reason: Reason to store in the table of closings.

        Raises:
            TrustboError: There is no such closing, it no longer counts, the reason is empty, or
                this cannot be recorded. The closing then still counts.
        """
        with self._turn:
            closings = list(self.state.closings)
            n_next = len(self.state.entries) + 1
            before = [one.why_over(n_next) for one in closings]
            self._require_counts("closing", n, reason, before, "open")

            closings[n - 1] = closings[n - 1]._replace(reopened=reason)
            self._record(closings=tuple(closings))

    def _require_counts(
        self, what: str, n: int, reason: str, before: Sequence[str | None], done: str
    ) -> None:
        """Raise TrustboError unless mission or report n counts, and can be taken back.

        Args:
            what: "mission" or "report of `fail`".
            n: Number, from 1.
            reason: Reason for which it is taken back.
            before: Reasons for which others were taken back; None or "" for those that count.
            done: Participle for messages.
        """
        self.storage.require_open()
        if require_whole("n", n, 1) > len(before):
            raise TrustboError(f"there is no {what} with number {n}; there are {len(before)}.")
        _require_reason(reason)
        if before[n - 1]:
            raise TrustboError(f"{what} {n} is already {done}: {before[n - 1]}")

    def close(self) -> None:
        """Release the folder, so that others can use it; a campaign in memory can go on.

        The results can still be used. Further calls have no effect.
        """
        with self._turn:
            self.storage.close()

    def __getstate__(self) -> dict[str, Any]:
        return super().__getstate__() | {"storage": None}  # the copy is in memory

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self.storage = MemoryStorage()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _require_reason(reason: object) -> None:
    """Raise TrustboError unless a reason is a text that is not empty."""
    if not isinstance(reason, str) or not reason.strip():
        raise TrustboError(f"reason must be a text that is not empty; got {reason!r}.")
