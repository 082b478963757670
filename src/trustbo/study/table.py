"""Results of runs as one Dataset, and a summary of it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.errors import require_choice

_TEXT = ("status", "state", "reason")
_PATHS = ("path", "recommended")
BEFORE = ("regret_before", "lost_before", "p_arrive_before")
"""Variables of the path recommended before the first mission."""
_NOT_AXES = ("key", "seed")


def to_dataset(
    records: Mapping[str, Mapping[str, Any]], labels: Mapping[str, Mapping[str, Any]]
) -> xr.Dataset:
    """Gather records of runs and their labels, both by key, in a Dataset (run, mission)."""
    runs = list(records.values())
    shape = (len(runs), max(len(run["missions"]) for run in runs))
    cells = [(i, j, row) for i, run in enumerate(runs) for j, row in enumerate(run["missions"])]
    names = dict.fromkeys(name for _, _, row in cells for name in row)
    dims = ("run", "mission")
    longest = max(len(row[name]) for _, _, row in cells for name in _PATHS)
    variables: dict[str, Any] = {}
    for name in names:
        if name in _PATHS:
            steps = np.full((*shape, longest, 2), -1)
            for i, j, row in cells:
                steps[i, j, : len(row[name])] = row[name]
            variables[name] = ((*dims, "step", "axis"), steps)
        elif name in _TEXT:
            words = np.full(shape, "", dtype=object)
            for i, j, row in cells:
                words[i, j] = row.get(name, "")
            variables[name] = (dims, words.astype(str))
        else:
            numbers = np.full(shape, np.nan)
            for i, j, row in cells:
                numbers[i, j] = np.nan if row.get(name) is None else row[name]
            variables[name] = (dims, numbers)
    for name in ("oracle", *BEFORE, "seconds", "seconds_cpu"):
        values = [np.nan if run.get(name) is None else run[name] for run in runs]
        variables[name] = ("run", np.array(values, dtype=float))
    coords: dict[str, Any] = {"mission": np.arange(1, shape[1] + 1), "axis": ["row", "col"]}
    coords["key"] = ("run", list(records))
    for name in labels[next(iter(records))]:
        coords[name] = ("run", _labels([labels[key][name] for key in records]))
    return xr.Dataset(variables, coords)


def axes_of(dataset: xr.Dataset) -> list[str]:
    """Names of the coordinates along which the runs of a study differ, but for seeds."""
    return [
        str(name)
        for name, values in dataset.coords.items()
        if values.dims == ("run",) and name not in _NOT_AXES and len(np.unique(values)) > 1
    ]


def summary(
    dataset: xr.Dataset, by: str | Sequence[str] | None = None, *, variable: str = "regret"
) -> pd.DataFrame:
    """Median and 90 % interval over runs of a variable, after each mission.

    Args:
        dataset: Results of `load_study`.
        by: Coordinates to group runs by; by default policy, and all others along which the study's
            runs differ, but for seeds.
        variable: Variable with dims (run, mission).

    Returns:
        Table indexed by these coordinates and mission: `median`, `low` and `high` (the 5 % and 95 %
        quantiles over runs), and the number of runs, `n`.

    Raises:
        TrustboError: An unknown coordinate or variable.
    """
    of_run = [str(n) for n, c in dataset.coords.items() if c.dims == ("run",)]
    numeric = [str(n) for n, v in dataset.data_vars.items() if v.dims == ("run", "mission")]
    require_choice("variable", variable, [n for n in numeric if n not in _TEXT])
    if by is None:
        by = ["policy", *(name for name in axes_of(dataset) if name != "policy")]
    by = [by] if isinstance(by, str) else list(by)
    for name in by:
        require_choice("coordinate", name, of_run)
    table = dataset[[variable]].to_dataframe().reset_index()
    groups = table.groupby([*by, "mission"], sort=True)[variable]
    return pd.DataFrame(
        {
            "median": groups.median(),
            "low": groups.quantile(0.05),
            "high": groups.quantile(0.95),
            "n": groups.count(),
        }
    )


def _labels(values: list[Any]) -> np.ndarray:
    """Array of numbers; anything else, or a mixture, becomes text."""
    numbers = all(isinstance(value, int | float) for value in values)
    return np.array(values if numbers else [str(value) for value in values])
