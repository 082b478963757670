"""History of a campaign, mission by mission: as a dataset, and as a table."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.campaign.failures import Failure
from trustbo.campaign.state import Entry
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
    # The exact sampler may have fallen back on NUTS, whose diagnostics are others: NaN then.
    names = {name: None for row in rows for name in row}
    scalars = {name: [row.get(name, np.nan) for row in rows] for name in names}
    trust_map = entries[0].trust_map
    # Older campaigns have numbers by names that are those of axes.
    axes = {*map(str, trust_map.coords), *map(str, trust_map.dims), "axis", "step", "iteration"}
    scalars = {f"told_{n}" if n in axes else n: values for n, values in scalars.items()}
    maps = np.stack([entry.trust_map.values for entry in entries])
    return xr.Dataset(
        {
            **{
                name: ("iteration", values, {"units": "%"} if name == "regret" else {})
                for name, values in scalars.items()
            },
            "path": (("iteration", "step", "axis"), steps),
            "trust_map": (("iteration", "row", "col"), maps, trust_map.attrs),
        },
        {
            "iteration": np.arange(1, len(rows) + 1),
            "axis": ["row", "col"],
            **trust_map.coords,
        },
    )


def table_of(
    history: xr.Dataset, missions: Sequence[Mission], failures: Sequence[Failure] = ()
) -> pd.DataFrame:
    """Table with a row for each mission of a history, labelled by its number, from 1.

    Columns are the scalars of `Result.history`, `n_bounds`, the number of bounds that were run, the
    cell `where` one failed, and the `path` as text, "9,0 8,1"; first those of the outcome, then
    diagnostics and seconds. A mission given up without a report has a row too, without a number,
    after the missions told before it.
    """
    reasons = {f.after: f.reason for f in failures if f.told}
    columns: dict[str, Any] = {
        str(n): a.values.tolist() for n, a in history.data_vars.items() if a.dims == ("iteration",)
    }
    if missions:
        states = columns.get("reason", [""] * len(missions))
        columns |= {
            "reason": [said or reasons.get(n, "") for n, said in enumerate(states, start=1)],
            "where": ["" if m.status == "ok" else path_text([m.bounds[-1].cell]) for m in missions],
            "n_bounds": [len(mission.bounds) for mission in missions],
            "path": [path_text(p[p[:, 0] >= 0].tolist()) for p in history["path"].values],
        }
    told = zip(*columns.values(), strict=True)
    rows: list[tuple[int | None, dict[str, Any]]] = [
        (n, dict(zip(columns, row, strict=True))) for n, row in enumerate(told, start=1)
    ]
    lost = [failure for failure in failures if not failure.told]
    for failure in reversed(lost):  # a later one does not move the place of those before
        rows.insert(failure.after, (None, _row_of(failure)))
    names = [name for name in _FIRST if name in columns or lost]
    names += [name for name in columns if name not in names]
    numbers = [number for number, _ in rows]
    index = pd.Index(numbers, dtype="Int64", name="mission") if lost else None
    if index is None:
        index = pd.RangeIndex(1, len(missions) + 1, name="mission")
    return pd.DataFrame([row for _, row in rows], index, names)


def _row_of(failure: Failure) -> dict[str, Any]:
    """Row of a mission that was given up without a report, as far as it is known."""
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
