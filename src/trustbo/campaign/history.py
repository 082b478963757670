"""History of a campaign, mission by mission: as a dataset, and as a table."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.campaign.state import Entry, Failure
from trustbo.data import Mission, path_text

GIVEN_UP = "given up"
"""State of a mission without a report, in tables."""
_FIRST = (
    "status", "state", "reason", "where", "contact_rate", "objective", "n_bounds", "path_changed",
    "path",
)  # fmt: skip
"""First columns of a table of missions."""


def history_of(entries: Sequence[Entry]) -> xr.Dataset:
    """Dataset as `Result.history`; empty before the first mission."""
    if not entries:
        return xr.Dataset()
    plans, rows = [entry.plan for entry in entries], [entry.row for entry in entries]
    steps = np.full((len(rows), max(len(plan.path) for plan in plans), 2), -1)
    for i, plan in enumerate(plans):
        steps[i, : len(plan.path)] = plan.path
    trust_map = entries[0].trust_map
    variables: dict[str, Any] = {}
    for name in {name: None for row in rows for name in row}:
        # The exact sampler may have fallen back on NUTS, whose diagnostics are others: NaN then.
        values = [row.get(name, np.nan) for row in rows]
        units = {"units": "%"} if name == "regret" else {}
        variables[name] = "iteration", values, units
    variables["path"] = ("iteration", "step", "axis"), steps
    maps = np.stack([entry.trust_map.values for entry in entries])
    variables["trust_map"] = ("iteration", "row", "col"), maps, trust_map.attrs
    coords = {"iteration": np.arange(1, len(rows) + 1), "axis": ["row", "col"]}
    return xr.Dataset(variables, coords | dict(trust_map.coords))


def table_of(
    history: xr.Dataset, missions: Sequence[Mission], failures: Sequence[Failure] = ()
) -> pd.DataFrame:
    """Table with a row for each mission, see `Result.table`.

    A mission given up without a report follows the missions recorded before it.
    """
    reasons = {f.after: f.reason for f in failures if f.reported}
    columns: dict[str, Any] = {
        str(n): a.values.tolist() for n, a in history.data_vars.items() if a.dims == ("iteration",)
    }
    if missions:
        stated = columns.get("reason", [""] * len(missions))
        columns |= {
            "reason": [reason or reasons.get(n, "") for n, reason in enumerate(stated, start=1)],
            "where": ["" if m.status == "ok" else path_text([m.bounds[-1].cell]) for m in missions],
            "n_bounds": [len(mission.bounds) for mission in missions],
            "path": [path_text(p[p[:, 0] >= 0].tolist()) for p in history["path"].values],
        }
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    numbers: list[int | None] = list(range(1, len(rows) + 1))
    lost = [failure for failure in failures if not failure.reported]
    for failure in reversed(lost):  # a later one does not move the place of those before
        rows.insert(failure.after, _row_of(failure))
        numbers.insert(failure.after, None)
    names = [name for name in _FIRST if name in columns or lost]
    names += [name for name in columns if name not in names]
    index = pd.RangeIndex(1, len(missions) + 1, name="mission")
    if lost:
        index = pd.Index(numbers, dtype="Int64", name="mission")
    return pd.DataFrame(rows, index, names)


def _row_of(failure: Failure) -> dict[str, Any]:
    """Row of a mission that was given up without a report."""
    path, where = list(failure.path), failure.where
    return {
        "status": failure.reason if failure.path else "aborted",
        "state": GIVEN_UP,
        "reason": failure.reason,
        "where": "" if where is None else path_text([where]),
        "contact_rate": np.nan,
        "objective": np.nan,
        "n_bounds": np.nan if where is None else path.index(where, 1),
        "path_changed": False,
        "path": path_text(path),
    }
