"""Results of runs as one Dataset, and tables of it."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.errors import TrustboError, require_choice

_TEXT = ("status", "state", "reason")
_PATHS = ("path", "recommended")
BEFORE = ("regret_before", "lost_before", "p_arrive_before")
"""Variables of the path recommended before the first mission."""
_NOT_AXES = ("key", "seed")
SHOWN = (0, 1, 3, 8, 15)
"""Numbers of missions after which regret is shown."""
FAR, NEAR = 5.0, 1.0
"""Regret in % beyond which a campaign is far off, and within which it is near."""


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
        else:
            missing, kind = ("", object) if name in _TEXT else (np.nan, float)
            values = np.full(shape, missing, dtype=kind)
            for i, j, row in cells:
                values[i, j] = missing if row.get(name) is None else row[name]
            variables[name] = (dims, values.astype(str if name in _TEXT else float))
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
    names = _of_run(dataset)
    return [n for n in names if n not in _NOT_AXES and len(np.unique(dataset[n])) > 1]


def _of_run(dataset: xr.Dataset, by: str | Sequence[str] = ()) -> list[str]:
    """Coordinates `by`, by default all that runs have; TrustboError: an unknown one."""
    names = [str(name) for name, values in dataset.coords.items() if values.dims == ("run",)]
    chosen = [by] if isinstance(by, str) else list(by)
    return [require_choice("coordinate", name, names) for name in chosen] or names


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
    numeric = [str(n) for n, v in dataset.data_vars.items() if v.dims == ("run", "mission")]
    require_choice("variable", variable, [n for n in numeric if n not in _TEXT])
    if by is None:
        by = ["policy", *(name for name in axes_of(dataset) if name != "policy")]
    by = _of_run(dataset, by)
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


def worlds_table(dataset: xr.Dataset, by: str | Sequence[str] = "method") -> pd.DataFrame:
    """Summarise the results of `run_worlds`, with 95 % intervals.

    Intervals are those of a bootstrap over pairs of world and course, which campaigns of the same
    pair enter together.

    Args:
        dataset: Results of `run_worlds`, or `load_study`.
        by: Coordinates of the rows: `method`, `kind`, `world`, `course`.

    Returns:
        Table with columns of two levels, the quantity and `value`, `low` and `high`: the median
        `regret after n` missions in %, the median `lost after n` in bounds more than on the best
        path, both in the world of the next mission; means over campaigns of `regret now` (mean over
        all missions, likewise), `lost while learning` (the same for paths driven, in bounds and in
        the world they were driven in), `lost with failures` (the same, where bounds that fail or
        are not reached keep no contact), `missions to 1 %` (after which the recommended path stays
        within 1 %; one more than were driven if it does not), the share of missions that `arrive`,
        and of campaigns still `far` off, by more than 5 %, in the end, and processor `seconds` of a
        mission.
    """
    by = _of_run(dataset, by)
    numbers, pairs = numbers_of(dataset), _pairs(dataset)
    keys = list(zip(*(dataset[name].values for name in by), strict=True))
    rows = {}
    for key in dict.fromkeys(keys):
        mine = np.array([k == key for k in keys])
        rows[key if len(by) > 1 else key[0]] = bootstrap(
            {name: values[mine] for name, values in numbers.items()}, pairs[mine]
        )
    return _table(rows, by)


def differences(dataset: xr.Dataset, ours: str, by: str | Sequence[str] = ()) -> pd.DataFrame:
    """Compare a method with each other one on the same world, course and seed.

    Args:
        dataset: Results of `run_worlds`, or `load_study`.
        ours: Method that others are subtracted from the results of.
        by: Coordinates of the rows, in addition to the other method: `kind`, `world`, `course`.

    Returns:
        Table as of `worlds_table`: mean over campaigns of `regret after n`, `regret now`,
        `lost while learning`, `lost with failures`, `missions to 1 %`, `arrive` and `seconds` of
        `ours` less those of the other, with 95 % intervals of a bootstrap over pairs of world and
        course (NaN for one pair); and their number, `pairs`. Less is better, but for `arrive`.

    Raises:
        TrustboError: An unknown method or coordinate, or no other method on the same worlds.
    """
    methods = list(dict.fromkeys(dataset["method"].values.tolist()))
    require_choice("method", ours, methods)
    by = _of_run(dataset, by) if by else []
    numbers, pairs = numbers_of(dataset), _pairs(dataset)
    compared = [name for name in numbers if not name.startswith(("lost after", "far"))]
    names = ["world", "course", "seed"]
    cases = list(zip(*(dataset[name].values.tolist() for name in names), strict=True))
    method = dataset["method"].values
    reference = {case: i for i, case in enumerate(cases) if method[i] == ours}
    rows: dict[tuple[Any, ...], list[tuple[int, int]]] = {}
    for i, case in enumerate(cases):
        if method[i] != ours and case in reference:
            key = *(dataset[name].values[i] for name in by), method[i]
            rows.setdefault(key, []).append((reference[case], i))
    if not rows:
        raise TrustboError(f"no other method was run on the worlds of {ours!r}.")
    table = {}
    for key, matched in sorted(rows.items(), key=lambda row: row[0][:-1]):
        one, other = np.array(matched).T
        less = {name: numbers[name][one] - numbers[name][other] for name in compared}
        row = bootstrap(less, pairs[one], middle=np.nanmean)
        if (n_pairs := len(np.unique(pairs[one]))) == 1:
            row |= {(name, limit): np.nan for name in compared for limit in ("low", "high")}
        table[key if by else key[0]] = {("pairs", "value"): float(n_pairs)} | row
    return _table(table, [*by, f"{ours} less"])


def worse_than(table: pd.DataFrame) -> list[str]:
    """Rows and quantities of `differences` in which ours is worse for sure: as lines of text.

    Those whose interval is above 0, or below it for `arrive`.
    """
    lines = []
    for name in dict.fromkeys(str(name) for name, _ in table.columns):
        if name == "pairs":
            continue
        worse = table[name, "high"] < 0.0 if name == "arrive" else table[name, "low"] > 0.0
        rows = [_label(key) for key in table.index[worse.to_numpy()]]
        if rows:
            lines.append(f"worse in {name} than: {'; '.join(rows)}")
    return lines or ["worse than: none"]


def _table(
    rows: Mapping[Any, Mapping[tuple[str, str], float]], levels: Sequence[str]
) -> pd.DataFrame:
    table = pd.DataFrame.from_dict(dict(rows), orient="index")
    table.columns = pd.MultiIndex.from_tuples(table.columns)
    table.index.names = list(levels)
    return table


def _pairs(dataset: xr.Dataset) -> np.ndarray:
    """Pair of world and course of each run."""
    return dataset["world"].values + "/" + dataset["course"].values


def numbers_of(dataset: xr.Dataset) -> dict[str, np.ndarray]:
    """Numbers of each run, shape (run,)."""
    n_missions = dataset.sizes["mission"]
    oracle, driven = dataset["oracle"].values, np.isfinite(dataset["lost_followed"].values)
    # Least contact lost in the world of each mission; results of version 0.2 have one world.
    best, best_followed = (
        dataset[name].values if name in dataset else np.repeat(oracle[:, None], n_missions, 1)
        for name in ("best", "best_followed")
    )
    regret = np.concatenate([dataset["regret_before"].values[:, None], dataset["regret"]], axis=1)
    lost = np.concatenate([dataset["lost_before"].values[:, None], dataset["lost"]], axis=1)
    lost -= np.concatenate([oracle[:, None], best], axis=1)
    after = [n for n in SHOWN if n <= n_missions]
    numbers = {f"regret after {n}": regret[:, n] for n in after}
    numbers |= {f"lost after {n}": lost[:, n] for n in after}
    numbers["regret now"] = np.nanmean(regret, axis=1)
    numbers["lost while learning"] = np.nanmean(dataset["lost_followed"] - best_followed, axis=1)
    if "loss_followed" in dataset:  # not in results of version 0.3
        numbers["lost with failures"] = np.nanmean(dataset["loss_followed"], axis=1)
    numbers[f"missions to {NEAR:g} %"] = _until_near(regret)
    ran = dataset["status"].values != ""
    numbers["arrive"] = (dataset["status"].values == "ok").sum(1) / ran.sum(1)
    numbers["far"] = np.where(regret[:, -1] > FAR, 1.0, 0.0)
    return numbers | {"seconds": dataset["seconds_cpu"].values / driven.sum(1)}


def _until_near(regret: np.ndarray) -> np.ndarray:
    """Missions after which regret, (run, mission), stays near; one more than all if it does not."""
    away = ~(regret <= NEAR)
    last = regret.shape[1] - np.argmax(away[:, ::-1], axis=1)
    return np.where(away.any(1), last, 0).astype(float)


def bootstrap(
    numbers: Mapping[str, np.ndarray],
    clusters: np.ndarray,
    middle: Callable[[np.ndarray], Any] | None = None,
) -> dict[tuple[str, str], float]:
    """Value and 95 % interval of each quantity, by default a median of those after n missions.

    Runs of one cluster enter the bootstrap together, and all quantities have the same draws.
    """
    rng, (names, index) = np.random.default_rng(0), np.unique(clusters, return_inverse=True)
    members = [np.flatnonzero(index == i) for i in range(len(names))]
    drawn = [
        np.concatenate([members[i] for i in rng.integers(len(names), size=len(names))])
        for _ in range(1000)
    ]
    row = {}
    for name, values in numbers.items():
        usual = middle or (np.nanmedian if " after " in name else np.nanmean)
        low, high = np.quantile([usual(values[chosen]) for chosen in drawn], [0.025, 0.975])
        row |= {(name, "value"): float(usual(values)), (name, "low"): low, (name, "high"): high}
    return row


def as_text(table: pd.DataFrame) -> str:
    """Table of `worlds_table` or `differences` in Markdown, each value with its interval."""
    names = list(dict.fromkeys(name for name, _ in table.columns))
    head = [
        " and ".join(table.index.names),
        *(f"{name} (%)" if "regret" in name else name for name in names),
    ]
    lines = [" | ".join(head), " | ".join("---" for _ in head)]
    for key, row in table.iterrows():
        cells = []
        for name in names:
            if name == "pairs":
                cells.append(f"{row[name, 'value']:.0f}")
                continue
            places = 1 if "regret" in name or "missions" in name else 2
            value, low, high = (
                f"{row[name, what]:z.{places}f}" for what in ("value", "low", "high")
            )
            cells.append(f"{value} [{low}, {high}]")
        lines.append(" | ".join([_label(key), *cells]))
    return "\n".join(f"| {line} |" for line in lines)


def _label(key: Any) -> str:
    return ", ".join(map(str, key)) if isinstance(key, tuple) else str(key)
