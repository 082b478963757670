"""State of a campaign: missions, failures and notes, as data and as a record."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import numpy as np
import xarray as xr

from trustbo.campaign.posteriors import Posterior, Posteriors
from trustbo.data import Cell, Mission
from trustbo.models.backend import VERSIONS
from trustbo.planning import Plan
from trustbo.planning.plan import plan_from_record, plan_to_record
from trustbo.workspace import Workspace

TOLD, LEARNED, SET_ASIDE = "told", "learned", "set aside"
"""States of a mission: on disk, in the posterior, or excluded from it."""
_STREAMS = ("policy", "fit", "mission", "prior", "awareness", "hazard")
"""Streams of randomness; a seed depends on the place, so that names are added at the end."""


class Failure(NamedTuple):
    """A mission that was given up."""

    after: int
    """Number of missions recorded before."""
    reason: str
    path: tuple[Cell, ...] = ()
    """Path that was asked for, start first; empty where the failure is of no bound."""
    where: Cell | None = None
    """Cell that it failed to enter, where that is recorded."""
    reported: bool = False
    """Whether the bounds that were run are a mission with a row in the history."""

    @classmethod
    def restore(cls, record: Sequence[Any]) -> Self:
        """Failure of a record."""
        after, reason, path, where, reported = record
        cells = tuple((row, col) for row, col in path)
        cell = None if where is None else (where[0], where[1])
        if cell is not None and cell not in cells[1:]:
            raise ValueError(f"no path enters {cell}")
        return cls(after, reason, cells, cell, reported)


@dataclass(eq=False)
class Entry:
    """One recorded mission.

    Attributes:
        mission: Mission with the awareness that it is learned from, see `Campaign.as_learned`.
        measured: The same mission as measured.
        plan: Plan that it was asked for with.
        trust_map: Trust map that it was planned on, dims (row, col).
        row: Numbers of the mission, by name; its `state` and the `reason` of that among them.
        posterior: Posterior after it; None where nothing could be learned yet.
        extra: Numbers that were passed with it.
    """

    mission: Mission
    measured: Mission
    plan: Plan
    trust_map: xr.DataArray
    row: dict[str, Any]
    posterior: Posterior | None
    extra: dict[str, float] = field(default_factory=dict)

    @property
    def state(self) -> str:
        """State of the mission: `TOLD`, `LEARNED` or `SET_ASIDE`."""
        return self.row["state"]

    def become(self, state: str, reason: str = "") -> None:
        """Change the state of the mission."""
        self.row |= {"state": state, "reason": reason}


@dataclass(eq=False)
class CampaignState:
    """Data of a campaign: all that a folder holds, except for the workspace.

    Attributes:
        seed: Seed of everything random.
        options: Record of the arguments that the campaign was made with.
        suggested: Plan that was asked for and not run yet.
        entries: One for each recorded mission.
        failures: Missions given up.
        notes: More for `Result.settings`, by the loop.
        stop_reason: Reason of the end.
    """

    seed: int
    options: dict[str, Any] = field(default_factory=dict)
    suggested: Plan | None = None
    entries: list[Entry] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    notes: dict[str, Any] = field(default_factory=dict)
    stop_reason: str = "interrupted"

    @property
    def missions(self) -> list[Mission]:
        """Recorded missions, their awareness filled in."""
        return [entry.mission for entry in self.entries]

    @property
    def measured(self) -> list[Mission]:
        """Recorded missions as measured."""
        return [entry.measured for entry in self.entries]

    @property
    def posteriors(self) -> Posteriors:
        """Posterior after each mission."""
        return Posteriors(entry.posterior for entry in self.entries)

    @property
    def last(self) -> Posterior | None:
        """Posterior after the last mission."""
        return self.entries[-1].posterior if self.entries else None

    @property
    def last_tree(self) -> xr.DataTree | None:
        """Tree of `last`; None where nothing could be learned yet."""
        return None if self.last is None else self.last()

    def numbers(self, *states: str) -> list[int]:
        """Numbers, from 0, of the missions in one of these states."""
        return [j for j, entry in enumerate(self.entries) if entry.state in states]

    def seed_of(self, stream: str) -> int:
        """Seed of one stream of randomness for the next mission."""
        n = len(self.entries)
        entropy = [self.seed, _STREAMS.index(stream), n]
        if n_failures := sum(failure.after == n for failure in self.failures):
            entropy.append(n_failures)  # another try may choose another path
        return int(np.random.SeedSequence(entropy).generate_state(1)[0])

    def add(
        self,
        measured: Mission,
        filled: Mission,
        plan: Plan,
        trust_map: xr.DataArray,
        extra: dict[str, float],
        **seconds: float,
    ) -> Entry:
        """Add a mission, with its row of the history; see `Entry` for the arguments."""
        before = self.entries[-1].plan if self.entries else plan
        rates = measured.contact_rate
        row: dict[str, Any] = {
            "objective": plan.value,
            "path_changed": plan.path != before.path,
            "contact_rate": float(np.nanmean(rates)) if np.isfinite(rates).any() else np.nan,
            "status": measured.status,
            "state": TOLD,
            "reason": "",
            **extra,
            **seconds,
        }
        entry = Entry(filled, measured, plan, trust_map, row, self.last, extra)
        self.entries.append(entry)
        return entry

    def to_record(self) -> dict[str, Any]:
        """JSON-serialisable record of everything that no file of a `Result` holds."""
        return {
            "options": self.options,
            "suggested": None if self.suggested is None else plan_to_record(self.suggested),
            "n_missions": len(self.entries),
            "plans": [plan_to_record(entry.plan) for entry in self.entries],
            "rows": [entry.row for entry in self.entries],
            "posteriors": self.posteriors.names,
            "failures": self.failures,
            "notes": self.notes,
            "stop_reason": self.stop_reason,
            "versions": VERSIONS | {"numpy": np.__version__},
        }

    @classmethod
    def from_record(
        cls, record: dict[str, Any], entries: list[Entry], workspace: Workspace
    ) -> Self:
        """State of a record and of its missions."""
        suggested = record.get("suggested")
        return cls(
            record["options"]["seed"],
            record["options"],
            None if suggested is None else plan_from_record(suggested, workspace),
            entries,
            [Failure.restore(failure) for failure in record["failures"]],
            dict(record["notes"]),
            str(record["stop_reason"]),
        )
