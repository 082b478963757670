"""State of a campaign: missions, failures and notes, as data and as a record."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import numpy as np
import xarray as xr

from trustbo.campaign.failures import Failure
from trustbo.campaign.posteriors import Posterior, Posteriors
from trustbo.data import Mission
from trustbo.models.backend import VERSIONS
from trustbo.planning import Plan
from trustbo.planning.plan import plan_from_record, plan_to_record
from trustbo.workspace import Workspace

TOLD, LEARNED, SET_ASIDE = "told", "learned", "set aside"
"""States of a mission: on disk, in the posterior, or never to be."""
_STREAMS = ("policy", "fit", "mission", "prior", "awareness", "hazard")
"""Streams of randomness; a seed depends on the place, so that names are added at the end."""


@dataclass(eq=False)
class Entry:
    """One mission that was told.

    Attributes:
        mission: Mission, its awareness filled in where it was not measured.
        measured: The same mission as it was told.
        plan: Plan that it was asked for with.
        trust_map: Trust map that it was planned on, dims (row, col).
        row: Numbers of the mission, by name; its `state` and the `reason` of that among them.
        posterior: Posterior after it; None where nothing could be learned yet.
        extra: Numbers that it was told with.
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
        """State of the mission: told, learned or set aside."""
        return self.row["state"]

    def become(self, state: str, reason: str = "") -> None:
        """Change the state of the mission."""
        self.row |= {"state": state, "reason": reason}


class Kept(NamedTuple):
    """Missions of a saved result, the posterior after each, and `Result.history`."""

    missions: list[Mission]
    posteriors: Posteriors
    history: xr.Dataset


@dataclass(eq=False)
class CampaignState:
    """Data of a campaign: all that a folder holds, besides the workspace.

    Attributes:
        seed: Seed of everything random.
        options: Record of the arguments that the campaign was made with.
        suggested: Plan that was asked for and not run yet.
        entries: One for each mission told.
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
        """Missions told, their awareness filled in."""
        return [entry.mission for entry in self.entries]

    @property
    def measured(self) -> list[Mission]:
        """Missions as they were told."""
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
        """The tree of `last`; None where nothing could be learned yet."""
        return None if self.last is None else self.last()

    def numbers(self, *states: str) -> list[int]:
        """Numbers, from 0, of the missions in one of these states."""
        return [j for j, entry in enumerate(self.entries) if entry.state in states]

    def seed_of(self, stream: str) -> int:
        """Seed of one stream of randomness ("policy", "fit", "mission") at this iteration."""
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
        """Add a mission that was told, with its row of the history.

        Args:
            measured: Mission as it was told.
            filled: The same mission, its awareness filled in.
            plan: Plan that it was asked for with.
            trust_map: Trust map that it was planned on.
            extra: Numbers that it was told with.
            **seconds: Seconds of planning and running.
        """
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
        """Everything that no file of a `Result` holds, as JSON can hold it."""
        return {
            "options": self.options,
            "suggested": None if self.suggested is None else plan_to_record(self.suggested),
            "n_missions": len(self.entries),
            "plans": [plan_to_record(entry.plan) for entry in self.entries],
            "rows": [entry.row for entry in self.entries],
            "posterior_after": [e.posterior and e.posterior.after for e in self.entries],
            "failures": self.failures,
            "notes": self.notes,
            "stop_reason": self.stop_reason,
            "versions": VERSIONS | {"numpy": np.__version__},
        }

    @classmethod
    def from_record(
        cls,
        record: dict[str, Any],
        measured: list[Mission],
        extras: list[dict[str, float]],
        kept: Kept | None,
        workspace: Workspace,
    ) -> Self:
        """State of a record, of its missions as they were told, and of a saved result."""
        entries: list[Entry] = []
        if kept is not None:
            n = record["n_missions"]
            maps = [kept.history["trust_map"].isel(iteration=i, drop=True) for i in range(n)]
            plans = [plan_from_record(plan, workspace) for plan in record["plans"]]
            columns = (
                kept.missions, measured, plans, maps, record["rows"], kept.posteriors.kept, extras
            )  # fmt: skip
            entries = [Entry(*values) for values in zip(*columns, strict=True)]
        suggested = record.get("suggested")
        return cls(
            record["options"]["seed"],
            record["options"],
            None if suggested is None else plan_from_record(suggested, workspace),
            entries,
            [Failure.restore(failure) for failure in record["failures"]],
            record["notes"],
            record["stop_reason"],
        )
