"""Summaries of campaigns and paired differences between cases, with bootstrap intervals."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

SHOWN = (0, 1, 3, 8, 15)
"""Numbers of missions after which the regret and the loss are reported."""
NEAR = 1.0
"""Regret in % up to which a recommended path counts as nearly optimal."""
_JUDGED = {
    "mission",
    "regret",
    "lost",
    "best",
    "status",
    "contact_rate",
    "driven",
    "best_driven",
    "failed_driven",
    "seconds",
}
"""Columns of `run_grid` that describe a mission; the others are labels of the run."""
_RUN = ["case", "scene", "seed"]
"""Columns that identify a run."""
_FIRST = "regret after 0"
"""First column of `numbers_of` that is a quantity."""
_N_RESAMPLES = 1000
"""Number of bootstrap resamples."""
_ENDS = (0.025, 0.975)
"""Levels of the ends of a 95 % interval."""


def numbers_of(table: pd.DataFrame) -> pd.DataFrame:
    """Summarise each run in a table of `run_grid` whose scenes have a truth.

    `regret after n` (%) and `lost after n` (the loss minus that of the best path, in bounds)
    describe the path recommended after n missions, in the world of the next mission. `regret now`
    is the mean regret. `lost while learning` is the mean loss in the missions minus the loss on the
    best path. `lost with failures` is the same if bounds that fail or are not reached count as
    fully lost. `missions to 1 %` is the number of missions after which the regret stays within 1 %,
    or the number of missions plus one if it never does. `arrive` is the fraction of missions that
    reach the goal; `arrive of the first 3` and `arrive later` are the same fraction for the first
    three missions and for the others. `seconds` is the CPU time per mission. In scenes without a
    truth, quantities that need it are NaN.
    """
    labels = [name for name in table.columns if name not in _JUDGED]
    rows = [_numbers(run) for _, run in table.groupby(_RUN, sort=False, dropna=False)]
    of_runs = table.groupby(_RUN, sort=False, dropna=False)[labels].first()
    return pd.concat([of_runs.reset_index(drop=True), pd.DataFrame(rows)], axis=1)


def _numbers(run: pd.DataFrame) -> dict[str, float]:
    """Summarise one run, given its rows for missions 0, 1, ..."""
    run = run.sort_values("mission")
    driven = run.iloc[1:]
    regret = run["regret"].to_numpy()
    after = [n for n in SHOWN if n < len(run)]
    lost = (run["lost"] - run["best"]).to_numpy()
    arrived = driven["status"] == "ok"
    has_truth = not np.isnan(regret).all()
    far = np.flatnonzero(~(regret <= NEAR))  # also NaN
    n_until_near = far[-1] + 1.0 if len(far) else 0.0

    return {
        **{f"regret after {n}": regret[n] for n in after},
        **{f"lost after {n}": lost[n] for n in after},
        "regret now": np.nanmean(regret) if has_truth else np.nan,
        "lost while learning": (driven["driven"] - driven["best_driven"]).mean(),
        "lost with failures": driven["failed_driven"].mean(),
        f"missions to {NEAR:g} %": n_until_near if has_truth else np.nan,
        "arrive": arrived.mean(),
        "arrive of the first 3": arrived[:3].mean(),
        "arrive later": arrived[3:].mean(),
        "seconds": driven["seconds"].mean(),
    }


def summary(numbers: pd.DataFrame, by: str | Sequence[str] = "case") -> pd.DataFrame:
    """Compute means (medians for "... after n") over runs, with 95 % intervals over scenes.

    Args:
        numbers: Rows of `numbers_of`.
        by: Columns by which the runs are grouped.

    Returns:
        Table with two column levels: the quantity, and its `value`, `low` and `high`. The ends of
        the interval are NaN if there is only one scene.
    """
    by = _columns(by)
    rows = {}
    for key, runs in numbers.groupby(by, sort=False, dropna=False):
        label = key if len(by) > 1 else key[0]  # pyright: ignore[reportIndexIssue]
        rows[label] = bootstrap(_values(runs), runs["scene"].to_numpy())
    return _table(rows, by)


def differences(numbers: pd.DataFrame, ours: str, by: str | Sequence[str] = ()) -> pd.DataFrame:
    """Compare one case with every other case on the same scenes and seeds.

    Args:
        numbers: Rows of `numbers_of`.
        ours: Case from which the other cases are subtracted.
        by: Columns, besides the other case, by which the pairs of runs are grouped.

    Returns:
        Table of the mean differences, `ours` minus the other case, in the format of `summary`, with
        the number of `pairs`, and without "lost after n". Intervals are over scenes; they are NaN
        if there is only one scene.
    """
    by = _columns(by)
    mine = numbers[numbers["case"] == ours]
    pairs = mine.merge(numbers[numbers["case"] != ours], on=["scene", "seed"], suffixes=("", " 2"))
    rows: dict[Any, dict[tuple[str, str], float]] = {}
    names = [name for name in _values(numbers) if not name.startswith("lost after")]
    for key, runs in pairs.groupby([*by, "case 2"], sort=False, dropna=False):
        less = {name: (runs[name] - runs[f"{name} 2"]).to_numpy() for name in names}
        scenes = runs["scene"].to_numpy()

        row = bootstrap(less, scenes, np.nanmean)
        label = key if by else key[0]  # pyright: ignore[reportIndexIssue]
        rows[label] = {("pairs", "value"): float(len(runs))} | row
    return _table(rows, [*by, f"{ours} less"])


def _columns(by: str | Sequence[str]) -> list[str]:
    """Return one or several names of columns as a list."""
    return [by] if isinstance(by, str) else list(by)


def bootstrap(
    numbers: Mapping[str, np.ndarray],
    clusters: np.ndarray,
    middle: Callable[[np.ndarray], Any] | None = None,
) -> dict[tuple[str, str], float]:
    """Compute `middle` (by default, the mean or median as in `summary`) and its 95 % interval.

    The runs of a cluster are resampled together, and all quantities use the same resamples. With
    one cluster, there is no interval: its ends are NaN.
    """
    rng = np.random.default_rng(0)
    names, index = np.unique(clusters, return_inverse=True)

    members = [np.flatnonzero(index == i) for i in range(len(names))]
    drawn = [
        np.concatenate([members[i] for i in rng.integers(len(names), size=len(names))])
        for _ in range(_N_RESAMPLES)
    ]

    row = {}
    for name, values in numbers.items():
        if np.isnan(values).all():  # such as "arrive later" after three missions
            row |= {(name, what): np.nan for what in ("value", "low", "high")}
            continue

        usual = middle or (np.nanmedian if " after " in name else np.nanmean)
        low = high = np.nan
        if len(members) > 1:
            low, high = np.quantile([usual(values[chosen]) for chosen in drawn], _ENDS)
        row[name, "value"] = float(usual(values))
        row[name, "low"] = low
        row[name, "high"] = high
    return row


def _values(numbers: pd.DataFrame) -> dict[str, np.ndarray]:
    """Return the quantities of the runs, which follow the label columns, keyed by name."""
    first = numbers.columns.get_loc(_FIRST)
    return {name: numbers[name].to_numpy(float) for name in numbers.columns[first:]}


def _table(rows: Mapping[Any, Mapping[Any, float]], levels: Sequence[str]) -> pd.DataFrame:
    table = pd.DataFrame.from_dict(dict(rows), orient="index")
    table.columns = pd.MultiIndex.from_tuples(table.columns)
    table.index.names = list(levels)
    return table
