"""What a campaign has been through, mission by mission."""

from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any, Self

import pandas as pd
import xarray as xr

from trustbo.data import Mission
from trustbo.planning import Plan
from trustbo.planning.plan import plan_from_record, plan_to_record
from trustbo.result import Learned, build_history


@dataclass(eq=False)
class Logbook:
    """One entry per mission learned from, in lists of equal length; and what happened besides.

    Attributes:
        missions: The missions, awareness filled in where it was not measured.
        measured: The same as they were told.
        plans: The plan each was asked for with.
        maps: The trust map each was planned on, dims (row, col).
        rows: Numbers of each for the history.
        posteriors: The posterior after each.
        failures: Missions given up without any bound: after how many missions, and why.
        notes: More for `Result.settings`.
        stop_reason: Why it ended.
    """

    missions: list[Mission] = field(default_factory=list)
    measured: list[Mission] = field(default_factory=list)
    plans: list[Plan] = field(default_factory=list)
    maps: list[xr.DataArray] = field(default_factory=list)
    rows: list[dict[str, Any]] = field(default_factory=list)
    posteriors: list[xr.DataTree] = field(default_factory=list)
    failures: list[tuple[int, str]] = field(default_factory=list)
    notes: dict[str, Any] = field(default_factory=dict)
    stop_reason: str = "interrupted"

    def history(self) -> xr.Dataset:
        """What `Result.history` holds; empty before the first mission."""
        return build_history(self.rows, self.plans, self.maps) if self.rows else xr.Dataset()

    def summary(self) -> pd.DataFrame:
        """One row per mission: what was planned, how it ended, what was learned."""
        paths = [" ".join(f"{r},{c}" for r, c in plan.path) for plan in self.plans]
        index = pd.RangeIndex(1, len(self.rows) + 1, name="mission")
        table = pd.DataFrame(self.rows, index=index)
        return table.assign(n_bounds=[len(m.bounds) for m in self.missions], path=paths)

    def to_state(self) -> dict[str, Any]:
        """What is in no file of a `Result`, as JSON can hold it."""
        return {
            "n_missions": len(self.missions),
            "plans": [plan_to_record(plan) for plan in self.plans],
            "rows": self.rows,
            "failures": self.failures,
            "notes": self.notes,
            "stop_reason": self.stop_reason,
            "versions": {name: version(name) for name in ("trustbo", "numpyro", "jax", "numpy")},
        }

    @classmethod
    def from_state(
        cls, state: dict[str, Any], measured: list[Mission], learned: Learned | None
    ) -> Self:
        """The logbook again, of missions as they were told and of what was learned from them."""
        n = state["n_missions"]
        maps, missions, posteriors = [], [], []
        if learned is not None:
            missions, posteriors, history = learned
            maps = [history["trust_map"].isel(iteration=i, drop=True) for i in range(n)]
        return cls(
            list(missions),
            measured[:n],
            [plan_from_record(record) for record in state["plans"]],
            maps,
            state["rows"],
            list(posteriors),
            [(after, reason) for after, reason in state["failures"]],
            state["notes"],
            state["stop_reason"],
        )
