"""Missions as tables in long form, with one row per mission, bound and robot."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from trustbo.arrays import without_rounding
from trustbo.data import (
    FEATURES,
    POST_SETS,
    SHARE_TOLERANCE,
    Cell,
    Mission,
    Station,
    began_at,
    cells_of,
    require_path,
)
from trustbo.errors import TrustboError
from trustbo.logs.columns import Columns, folded, require_one_spelling, require_plain_names
from trustbo.logs.mapping import ColumnMap, of_bounds
from trustbo.logs.positions import with_cells, with_durations
from trustbo.stacking import require_same_team
from trustbo.workspace import Workspace

KEYS = ("mission", "bound", "robot")
RATES = ("contact_rate", "duration", "n_ticks")
POSTS = "posts"
"""Column of the set of posts from which T2 watches the lead's move out of a cell."""
BEGIN = "begin"
"""Column of the time at which a bound began, s."""
COLUMNS = (*KEYS, "row", "col", POSTS, *RATES, "status", BEGIN)
"""Columns with a fixed meaning; other columns may be features of awareness."""
TRUST = ("trust_mean", "trust_sd")
"""Columns of a posterior, which `export.write_csv` adds and `read_table` ignores."""

_NO_FEATURES = ("x", "y", "lon", "lat", "time", "timestamp")
_FURTHER = "every further column is a feature of awareness; drop columns that are not"
_MIN_DECIMALS = 2
"""Rates with fewer decimals are not rounded to the nearest tick."""
_LAST_BITS = 1e-12
"""Differences of rates that are not due to rounded decimals."""


def to_frame(missions: Iterable[Mission]) -> pd.DataFrame:
    """Return a table of missions, numbered from 1, without ticks.

    The table has the columns of `read_table`; `to_csv(file, index=False)` writes it to a file.
    Bound 0 is the start cell and has no measurements. Bounds that were planned but not run are
    blank. A mission without a map has no bound 0.

    Raises:
        TrustboError: The missions have different robots or features, only some of them have a path,
            one has a `scale` or a `map`, for which a table has no column, a feature has the name of
            another column, or the name of a robot or feature would be changed by a CSV file or is a
            formula for spreadsheets.

    Example:
        >>> tb.logs.to_frame(missions).to_csv("log.csv", index=False)
    """
    missions = require_same_team(missions)
    taken = {folded(name) for name in (*COLUMNS, *TRUST, *_NO_FEATURES)}
    bad = [name for name in missions[0].features if folded(name) in taken]
    if bad:
        raise TrustboError(f"features {bad} have names of other columns of a log; rename them.")

    require_plain_names("feature", missions[0].features)
    require_plain_names("robot", missions[0].robots)

    if len({bool(mission.path) for mission in missions}) > 1:
        raise TrustboError("some missions have a path and some do not; write them to two tables.")
    if any(mission.scale or mission.map for mission in missions):
        raise TrustboError(
            "a table has no column for the scale of reports or the map of a mission; use "
            "logs.write_missions."
        )

    rows = [row for j, mission in enumerate(missions, start=1) for row in _rows_of(j, mission)]
    absent = set() if missions[0].path else {"row", "col"}
    if not any(mission.post_sets for mission in missions):
        absent.add(POSTS)
    if np.isnan([mission.began for mission in missions]).all():
        absent.add(BEGIN)
    names = [name for name in COLUMNS if name not in absent]
    return pd.DataFrame(rows, columns=[*names, *missions[0].features])


def _rows_of(j: int, mission: Mission) -> Iterator[dict[str, Any]]:
    """Yield the rows of mission number j."""
    n_run = len(mission.bounds)
    first = 0 if mission.path else 1
    for k in range(first, max(len(mission.path), n_run + 1)):
        for i, robot in enumerate(mission.robots):
            row: dict[str, Any] = dict(zip(KEYS, (j, k, robot), strict=True))
            if mission.path:
                row["row"], row["col"], row[POSTS] = (*mission.stations[k], POST_SETS[0])[:3]
            if 1 <= k <= n_run:
                bound = mission.bounds[k - 1]
                row |= {name: getattr(bound, name)[i] for name in RATES}
                row["status"] = mission.status if k == n_run else bound.status
                row[BEGIN] = mission.began + bound.t0
                row |= dict(zip(mission.features, bound.awareness[i], strict=True))
            yield row


def read_table(
    table: Any,
    *,
    columns: ColumnMap | None = None,
    workspace: Workspace | None = None,
    path: Sequence[Station] | None = None,
) -> list[Mission]:
    """Read missions, without ticks, from a table with one row per mission, bound and robot.

    The columns are `mission`; `bound` (0 for the start cell, which has no measurements); `robot`;
    the cell (`row`, `col`); and `contact_rate`. Optional columns are `duration` (s), `n_ticks`,
    `status`, and `posts`, the set of posts from which T2 watches the lead's move out of the cell.
    Other columns are features; without such columns, the features are `traversability` and
    `visibility`, which then count as not measured. The status of the last bound is that of the
    mission. An earlier bound has a status other than "ok" if it failed and the mission continued. A
    blank means "not measured", and a blank status means "ok". Bounds after the last one with a
    measurement were planned but not run. A table without `row` and `col` is a log without a map. If
    rates have been rounded, each one is read as the nearest multiple of 1 / n_ticks within half a
    unit of the column's last decimal.

    With a workspace, positions may stand for cells: `x` and `y` in metres, `lon` and `lat` in
    degrees, or `place`, the name of a place. A position within 5 m of a stop (in small cells, a
    quarter of a side) is in the cell of this stop. Times `begin` and `end`, in seconds or as dates,
    may stand for `duration`. Times `begin` since 1970 also say when the mission began.

    Args:
        table: Path of a CSV file (commas, semicolons or tabs), a DataFrame, or a mapping of lists.
        columns: Names of the table's columns, keyed by the names above. A value is a name, or has
            `column`, `unit` (%, s, ms, us, ns, min, h, m, cm, km, ft, or date) and, for dates,
            `zone`, such as `"America/Los_Angeles"`; the default zone is UTC. Other columns of the
            table are then ignored, and so are names that only `read_tracks` knows, such as `t`.
        workspace: Map of the cells in which positions lie.
        path: Planned path, such as `campaign.ask().path`, whose first cell is the start of missions
            with bounds that are numbered from 1.

    Returns:
        Missions in the order of the table.

    Raises:
        TrustboError: A column, bound or robot is missing, a row is repeated, a value has the wrong
            type, a position is outside the workspace, a mapping of columns is invalid, rows of one
            bound disagree on its cell, or `Mission` rejects the data.

    Example:
        >>> missions = tb.logs.read_table("log.csv")
        >>> columns = tb.logs.read_columns("columns.toml")  # names and units of another table
        >>> missions = tb.logs.read_table("legs.csv", columns=columns)
        >>> posterior = tb.fit(missions, workspace=workspace)
    """
    given = Columns(table, columns=None if columns is None else of_bounds(columns))
    with_cells(given, workspace)
    with_durations(given)
    known = [given.find(name) for name in (*COLUMNS, *TRUST)]
    features = [name for name in given.frame if name not in known] or list(FEATURES)
    odd = {*_NO_FEATURES} & {*map(str.lower, features)}
    if odd:
        raise TrustboError(
            f"{sorted(odd)} are no features; drop them, and give cells as row, col, or pass "
            "workspace= for positions."
        )

    frame = _parsed(given, features)
    robots = tuple(name for name in frame["robot"].unique() if name)
    require_one_spelling("column robot", robots)
    given.refuse("bound", frame.duplicated([*KEYS]).to_numpy(), "is repeated for its robot")
    nameless = (frame["robot"] == "") & frame["contact_rate"].notna()
    given.refuse("contact_rate", nameless.to_numpy(), "has no robot; 'NA' and 'none' are blank")
    if path is not None:
        frame = _with_start(frame, cells_of(require_path("path", path))[0])

    missions = []
    for label, rows in frame.groupby("mission", sort=False):
        try:
            missions.append(_mission(rows, features, robots))
        except TrustboError as error:
            raise TrustboError(f"mission {label}: {error}") from None
    return missions


def _with_start(frame: pd.DataFrame, start: Cell) -> pd.DataFrame:
    """Return a table in which missions with bounds from 1 on also have bound 0, in a cell."""
    of_mission = frame.groupby("mission", sort=False)
    lacks = (of_mission["bound"].transform("min") == 1) & ("row" in frame)
    first = frame.loc[lacks & (frame["bound"] == 1)].copy()
    measured = [name for name in frame if name not in (*KEYS, "row", "col", POSTS, "status")]
    first[measured] = np.nan
    first = first.assign(bound=0, row=start[0], col=start[1], status="", **{POSTS: POST_SETS[0]})
    return pd.concat([first, frame]) if len(first) else frame


def _parsed(columns: Columns, features: Sequence[str]) -> pd.DataFrame:
    """Return the columns with the names and types of this module; NaN or "" where blank."""
    values: dict[str, Any] = {"mission": columns.texts("mission", blank=False)}
    require_one_spelling("column mission", values["mission"])
    values["robot"] = columns.texts("robot")
    values[POSTS] = [text or POST_SETS[0] for text in columns.texts(POSTS, required=False)]
    values["status"] = [text.lower() for text in columns.texts("status", required=False)]

    is_mapped = any(columns.find(name) for name in ("row", "col"))
    for name in ("bound", "row", "col") if is_mapped else ("bound",):
        values[name] = columns.numbers(name, blank=False, whole=True).astype(int)
    for name in RATES:
        values[name] = columns.numbers(name, required=name == "contact_rate")
    for name in features:
        numbers = columns.numbers(name, required=False, hint=f"; {_FURTHER}")
        values[name] = without_rounding(numbers) if is_mapped else numbers

    values[BEGIN] = columns.numbers(BEGIN, required=False)

    _refuse_shares_outside(columns, "contact_rate", values["contact_rate"], "divide percent by 100")
    if is_mapped:
        _refuse_misplaced_values(columns, features, values)
    if columns.find("n_ticks"):
        values["contact_rate"] = _to_ticks(columns, values["contact_rate"], values["n_ticks"])
    return pd.DataFrame(values, index=columns.frame.index)


def _refuse_shares_outside(columns: Columns, name: str, values: np.ndarray, remedy: str) -> None:
    """Raise TrustboError for values outside [0, 1] that are not due to rounding."""
    shares = without_rounding(values)
    columns.refuse(name, (shares < 0.0) | (shares > 1.0), f"is outside [0, 1]; {remedy}")


def _refuse_misplaced_values(
    columns: Columns, features: Sequence[str], values: dict[str, Any]
) -> None:
    """Raise TrustboError for features outside [0, 1], and for values at the start cell."""
    for name in features:
        _refuse_shares_outside(
            columns, name, values[name], f"{_FURTHER}, and divide percent by 100"
        )

    for name in (*RATES, *features):
        at_start = (values["bound"] == 0) & ~np.isnan(values[name])
        hint = f"; {_FURTHER}" if name in features else ""
        columns.refuse(name, at_start, f"must be blank at bound 0, the start cell{hint}")


def _to_ticks(columns: Columns, rate: np.ndarray, n_ticks: np.ndarray) -> np.ndarray:
    """Return rates, (row,); those that were rounded become multiples of 1 / n_ticks."""
    unit = 0.1 ** max(columns.decimals("contact_rate"), _MIN_DECIMALS)
    n = np.where(n_ticks >= 1.0, n_ticks, np.nan)  # `Mission` rejects others
    nearest = np.round(rate * n) / n
    off = np.abs(rate - nearest)
    most = 0.5 * unit * (1.0 + 1e-9)

    columns.refuse(
        "contact_rate",
        off > max(most, SHARE_TOLERANCE),
        "is not a multiple of 1 / n_ticks; write more decimals, correct n_ticks, or leave out the "
        "column n_ticks",
    )
    is_rounded = (off > _LAST_BITS) & (off <= most)
    return np.where(is_rounded, nearest, rate)


def _mission(rows: pd.DataFrame, features: Sequence[str], robots: tuple[str, ...]) -> Mission:
    """Make a mission from its rows."""
    cells = rows.filter(["bound", "row", "col", POSTS]).drop_duplicates().sort_values("bound")
    is_mapped = "row" in cells
    numbers = cells["bound"].tolist()
    first = 0 if is_mapped else 1
    if numbers != [*range(first, first + len(numbers))]:
        raise TrustboError(
            f"bounds must be numbered {first}, {first + 1}, ... (0 is the start cell) and have "
            f"one cell (row, col) each; got {numbers}."
        )

    values = rows.set_index([*KEYS[1:]])[[*RATES, *features]]
    status = rows["status"]

    # Loggers that always write a status write "ok" for the start, where nothing is measured.
    has_status = (status != "") & ((status != "ok") | (rows["bound"] > 0))
    measured = rows.loc[values.notna().to_numpy().any(axis=1) | has_status, "bound"]
    if measured.empty or measured.min() < 1:
        raise TrustboError(
            "bounds with a rate, feature or status must be numbered from 1; got none or 0."
        )

    n_run = int(measured.max())
    statuses = ["ok"] * n_run
    failed = rows.loc[~status.isin(["", "ok"])]
    if (failed["bound"] < 1).any():
        raise TrustboError("the start cell, bound 0, must not have a status other than ok.")
    for k, of_bound in failed.groupby("bound")["status"]:
        if of_bound.nunique() > 1:
            raise TrustboError(f"bound {k} has the statuses {sorted(of_bound.unique())}; give one.")
        statuses[int(k) - 1] = of_bound.iloc[0]  # pyright: ignore[reportArgumentType]

    expected = pd.MultiIndex.from_product([range(1, n_run + 1), robots])
    missing = expected.difference(values.index)
    if len(missing):
        k, robot = missing[0]
        raise TrustboError(f"bound {k} has no row for {robot}; add it, with blank values.")

    arrays = values.loc[expected].to_numpy(float).reshape(n_run, len(robots), -1)
    rate, duration, n_ticks = np.moveaxis(arrays[..., : len(RATES)], -1, 0)

    mission = Mission.from_arrays(
        [*cells[["row", "col", POSTS]].itertuples(index=False, name=None)] if is_mapped else None,
        arrays[..., len(RATES) :],
        rate,
        duration,
        status=statuses,
        n_ticks=n_ticks,
        features=features,
        robots=robots,
    )
    begins = rows.loc[rows["bound"].between(1, n_run)].groupby("bound")[BEGIN].min().to_numpy()
    if np.isnan(begins).any():
        return mission

    starts = (begins - begins[0]).tolist()
    return replace(mission, starts=tuple(starts), began=began_at(begins[0]))
