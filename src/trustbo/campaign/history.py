"""History of a campaign, mission by mission."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any, NamedTuple, Self

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.data import Mission
from trustbo.planning import Plan
from trustbo.planning.plan import plan_from_record, plan_to_record


class Entry(NamedTuple):
    """One mission that was learned from.

    Attributes:
        mission: Mission, its awareness filled in where it was not measured.
        measured: The same mission as it was told.
        plan: Plan that it was asked for with.
        trust_map: Trust map that it was planned on, dims (row, col).
        row: Numbers of the mission, by name.
        posterior: Posterior after it.
    """

    mission: Mission
    measured: Mission
    plan: Plan
    trust_map: xr.DataArray
    row: dict[str, Any]
    posterior: xr.DataTree


class Learned(NamedTuple):
    """Missions of a saved result, the posterior after each, and `Result.history`."""

    missions: list[Mission]
    posteriors: list[xr.DataTree]
    history: xr.Dataset


@dataclass(eq=False)
class History:
    """Missions that a campaign learned from, those that failed, and the reason of its end.

    Attributes:
        entries: One for each mission learned from.
        failures: Missions given up: number of missions before each, and the reason.
        notes: More for `Result.settings`, by the loop.
        stop_reason: Reason of the end.
    """

    entries: list[Entry] = field(default_factory=list)
    failures: list[tuple[int, str]] = field(default_factory=list)
    notes: dict[str, Any] = field(default_factory=dict)
    stop_reason: str = "interrupted"

    @property
    def missions(self) -> list[Mission]:
        """Missions learned from, their awareness filled in."""
        return [entry.mission for entry in self.entries]

    @property
    def measured(self) -> list[Mission]:
        """Missions learned from, as they were told."""
        return [entry.measured for entry in self.entries]

    @property
    def plans(self) -> list[Plan]:
        """Plan of each mission."""
        return [entry.plan for entry in self.entries]

    @property
    def posteriors(self) -> list[xr.DataTree]:
        """Posterior after each mission."""
        return [entry.posterior for entry in self.entries]

    def to_dataset(self) -> xr.Dataset:
        """`Result.history`; empty before the first mission."""
        if not self.entries:
            return xr.Dataset()
        plans, rows = self.plans, [entry.row for entry in self.entries]
        steps = np.full((len(rows), max(len(plan.path) for plan in plans), 2), -1)
        for i, plan in enumerate(plans):
            steps[i, : len(plan.path)] = plan.path
        # The exact sampler may have fallen back on NUTS, whose diagnostics are others: NaN then.
        names = {name: None for row in rows for name in row}
        scalars = {name: [row.get(name, np.nan) for row in rows] for name in names}
        iteration = xr.DataArray(np.arange(1, len(rows) + 1), dims="iteration", name="iteration")
        trust_maps = [entry.trust_map for entry in self.entries]
        return xr.Dataset(
            {
                **{name: ("iteration", values) for name, values in scalars.items()},
                "path": (("iteration", "step", "axis"), steps),
                "trust_map": xr.concat(trust_maps, dim=iteration),
            },
            {"iteration": iteration, "axis": ["row", "col"]},
        )

    def summary(self) -> pd.DataFrame:
        """Table with one row for each mission: its plan, status and diagnostics."""
        paths = [" ".join(f"{r},{c}" for r, c in plan.path) for plan in self.plans]
        index = pd.RangeIndex(1, len(self.entries) + 1, name="mission")
        table = pd.DataFrame([entry.row for entry in self.entries], index=index)
        return table.assign(n_bounds=[len(m.bounds) for m in self.missions], path=paths)

    def to_state(self) -> dict[str, Any]:
        """Everything that no file of a `Result` holds, as JSON can hold it."""
        return {
            "n_missions": len(self.entries),
            "plans": [plan_to_record(plan) for plan in self.plans],
            "rows": [entry.row for entry in self.entries],
            "failures": self.failures,
            "notes": self.notes,
            "stop_reason": self.stop_reason,
            "versions": {name: version(name) for name in ("trustbo", "numpyro", "jax", "numpy")},
        }

    @classmethod
    def from_state(
        cls, state: dict[str, Any], measured: Sequence[Mission], learned: Learned | None
    ) -> Self:
        """History of a state, of missions as they were told, and of a saved result."""
        entries: list[Entry] = []
        if learned is not None:
            n = state["n_missions"]
            maps = [learned.history["trust_map"].isel(iteration=i, drop=True) for i in range(n)]
            plans = [plan_from_record(record) for record in state["plans"]]
            columns = (
                learned.missions, measured[:n], plans, maps, state["rows"], learned.posteriors,
            )  # fmt: skip
            entries = [Entry(*values) for values in zip(*columns, strict=True)]
        failures = [(after, reason) for after, reason in state["failures"]]
        return cls(entries, failures, state["notes"], state["stop_reason"])
