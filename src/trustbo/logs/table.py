"""Missions as a table in long form: one row per mission, bound and robot; columns in `read_table`.

A table without places is of a log without a map: features are of any values. A blank
means "not measured". Bounds after the last one with a measurement were planned, not run. A feature
with the name of one of these columns takes the prefix `awareness_`, e.g.
`awareness_status`.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from trustbo.data import NOWHERE, Bound, Cell, Mission
from trustbo.errors import TrustboError, require_pair
from trustbo.files import FilePath, write_text
from trustbo.logs.rows import KEYS, Row, column_of, features_of, parse_rows, read_columns
from trustbo.spreadsheet import rows_as_csv
from trustbo.stacking import require_same_team
from trustbo.workspace import Workspace


def read_table(
    table: Any,
    workspace: Workspace | None = None,
    *,
    start: Cell | None = None,
    features: Sequence[str] | None = None,
    robots: Sequence[str] | None = None,
    ignore: Sequence[str] = (),
) -> list[Mission]:
    """Read missions from a table in long form.

    Required columns are `mission`, `bound`, `robot`, the cell (`row` and `col`, or `x` and `y`, or
    `lon` and `lat`) and the contact (`contact_rate`, or `contact_time` and `duration`). Optional
    ones are `duration`, `t0`, `n_ticks`, `status`, `mission_status` and a column for each awareness
    feature: docs/howto/your-own-robots.md. Bound 0 is the start cell, without measurements. A table
    without a cell is of a log without a map.

    Args:
        table: Path of a CSV file with a header, separated by commas, semicolons or tabs, or a
            DataFrame (or a mapping of columns).
        workspace: Workspace with the robots and features to read, in its order, and the grid of
            columns `x` and `y` (CRS metres) or `lon` and `lat` (degrees) instead of row and col.
        start: Start cell of missions without a row of bound 0.
        features: Names of the awareness features, NaN for those without a column; by default the
            workspace's, else all columns without another meaning, else traversability and
            visibility.
        robots: Names of the robots in order; by default the workspace's, else those of the rows.
        ignore: Columns to leave out, such as `("timestamp", "battery")`.

    Returns:
        Missions in the order of the table, without ticks (poses and contacts).

    Raises:
        TrustboError: A missing file, column, bound or robot; a repeated row; a value of the wrong
            kind; a position off the grid; time that goes backwards; rows of one bound that
            disagree; or what `Mission` refuses.
    """
    mapped = workspace is not None or start is not None
    columns = read_columns(table, ignore, mapped=mapped)
    if workspace is not None:
        features = workspace.features if features is None else features
        robots = workspace.team.names if robots is None else robots
    names = features_of(columns) if features is None else tuple(features)
    rows = parse_rows(columns, names, None if workspace is None else workspace.grid)
    team = tuple(dict.fromkeys(r.robot for r in rows if r.robot)) if robots is None else robots
    missions: dict[str, dict[int, dict[str, Row]]] = {}
    for row in rows:
        if row.robot and row.robot not in team:
            raise TrustboError(f"row {row.line}: robot {row.robot!r} is not one of {tuple(team)}.")
        of_bound = missions.setdefault(row.mission, {}).setdefault(row.bound, {})
        if row.robot in of_bound:
            raise TrustboError(
                f"mission {row.mission}, bound {row.bound}, robot {row.robot!r} is there twice, in "
                f"rows {of_bound[row.robot].line} and {row.line}."
            )
        of_bound[row.robot] = row
    return [
        _mission(label, rows_of, start, names, tuple(team)) for label, rows_of in missions.items()
    ]


def write_table(missions: Sequence[Mission], path: FilePath) -> None:
    """Write missions, numbered from 1, without their ticks, as a CSV file for `read_table`.

    The file is written whole or not at all. ShapeError: no missions, or missions that disagree on
    robots or features. TrustboError: some have a path and others none.
    """
    require_same_team(missions)
    features = [column_of(name) for name in missions[0].features]
    measured = ["contact_rate", "duration", "n_ticks", "t0", "status", "mission_status", *features]
    mapped = [mission.has_map for mission in missions]
    if any(mapped) and not all(mapped):
        raise TrustboError(
            f"mission {mapped.index(False)} has no path, and others have; write these apart."
        )
    keys = KEYS if all(mapped) else KEYS[:3]
    lines: list[list[object]] = [[*keys, *measured]]
    for j, mission in enumerate(missions):
        steps = mission.path or [()] * (len(mission.bounds) + 1)
        for k, cell in enumerate(steps):
            if not k and not mission.has_map:
                continue
            bound = mission.bounds[k - 1] if 1 <= k <= len(mission.bounds) else None
            for i, robot in enumerate(mission.robots):
                cells: list[object] = [""] * len(measured)
                if bound is not None:
                    rates = (bound.contact_rate[i], bound.duration[i], bound.n_ticks[i], bound.t0)
                    cells = [*map(_text, rates), bound.status, mission.status]
                    cells += map(_text, bound.awareness[i])
                lines.append([j + 1, k, robot, *cell, *cells])

    write_text(path, rows_as_csv(lines))


def _mission(
    label: str,
    rows: dict[int, dict[str, Row]],
    start: Cell | None,
    features: tuple[str, ...],
    team: tuple[str, ...],
) -> Mission:
    """Make one mission from its rows, by bound and robot."""
    mapped = any(row.cell != NOWHERE for robots in rows.values() for row in robots.values())
    cells = _cells(label, rows, start) if mapped else ()
    run = [k for k in rows if k and not all(row.is_blank for row in rows[k].values())]
    if not run:
        raise TrustboError(f"mission {label} measured nothing: no bound of it has a value.")
    bounds: list[Bound] = []
    for k in range(1, max(run) + 1):
        if k not in rows:
            raise TrustboError(f"mission {label} has bounds {sorted(rows)}, but no bound {k}.")
        t0, cell = bounds[-1].t1 if bounds else 0.0, cells[k] if cells else NOWHERE
        bound = _bound(f"mission {label}, bound {k}", cell, rows[k], team, t0)
        if bounds and bound.t0 < bounds[-1].t0:
            raise TrustboError(
                f"mission {label}, bound {k}: time goes backwards, t0 = {bound.t0:.9g} s after "
                f"{bounds[-1].t0:.9g} s; number the bounds in the order they were run."
            )
        bounds.append(bound)
    statuses = [row.mission_status for robots in rows.values() for row in robots.values()]
    status = _agreed(f"mission {label}", "mission_status", statuses) or bounds[-1].status
    try:
        return Mission(cells, tuple(bounds), status, features, team)
    except TrustboError as error:
        raise TrustboError(f"mission {label}: {error}") from None


def _cells(label: str, rows: dict[int, dict[str, Row]], start: Cell | None) -> tuple[Cell, ...]:
    """Path of a mission from its rows."""
    if 0 not in rows and start is None:
        raise TrustboError(
            f"mission {label} has no row of bound 0, its start cell; add one, or give "
            "start=(row, col)."
        )
    for row in rows.get(0, {}).values():
        if not (math.isnan(row.numbers["contact_rate"]) and math.isnan(row.numbers["duration"])):
            raise TrustboError(
                f"row {row.line}: bound 0 is the start cell and measures nothing; number the "
                "bounds from 1."
            )
    cells = [] if 0 in rows else [require_pair("start", start)]
    for k in range(len(cells), max(rows) + 1):
        if k not in rows:
            raise TrustboError(f"mission {label} has bounds {sorted(rows)}, but no bound {k}.")
        of_bound = [row.cell for row in rows[k].values()]
        cells.append(_agreed(f"mission {label}, bound {k}", "cell", of_bound))
    return tuple(cells)


def _bound(where: str, cell: Cell, rows: dict[str, Row], team: tuple[str, ...], t0: float) -> Bound:
    """Make one bound from its rows, by robot; `t0` is for rows without a start time."""
    for robot in team:
        if robot not in rows:
            raise TrustboError(f"{where} has no row for robot {robot!r}.")
    team_rows = [rows[robot] for robot in team]
    starts = [row.numbers["t0"] for row in team_rows if not math.isnan(row.numbers["t0"])]
    began = _agreed(where, "t0", starts) if starts else t0
    status = _agreed(where, "status", [row.status for row in team_rows]) or "ok"
    awareness = np.array([row.awareness for row in team_rows])
    duration, n_ticks = (
        np.array([row.numbers[n] for row in team_rows]) for n in ("duration", "n_ticks")
    )
    try:
        rate = np.array([_rate(row) for row in team_rows])
        return Bound(cell, awareness, rate, duration, status, began, n_ticks=n_ticks)
    except TrustboError as error:
        raise TrustboError(f"{where}: {error}") from None


def _rate(row: Row) -> float:
    """Contact rate, which may be given as a time; both must agree."""
    rate, time, total = (row.numbers[n] for n in ("contact_rate", "contact_time", "duration"))
    if time > total:
        raise TrustboError(f"contact_time = {time:g} s exceeds duration = {total:g} s.")
    if rate > 1.0:
        raise TrustboError(
            f"contact_rate = {rate:g} is outside [0, 1]; divide percentages by 100, and "
            "turn ratings from 1 to n into (rating - 1) / (n - 1)."
        )
    if math.isnan(rate):
        return time / total if total else math.nan  # Bound refuses a duration of 0
    if abs(rate * total - time) > 1e-6 * total:
        raise TrustboError(
            f"contact_rate = {rate:g} of {total:g} s is not contact_time = {time:g} s; give one."
        )
    return rate


def _agreed(where: str, what: str, values: Sequence[Any]) -> Any:
    """Common value of all rows that are not blank; "" if all are."""
    distinct = list(dict.fromkeys(value for value in values if value != ""))
    if len(distinct) > 1:
        raise TrustboError(f"{where}: rows disagree on {what}: {distinct[0]} and {distinct[1]}.")
    return distinct[0] if distinct else ""


def _text(number: float) -> str:
    return "" if math.isnan(number) else repr(float(number))
