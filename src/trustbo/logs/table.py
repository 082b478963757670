"""Missions as tables in long form, with one row per mission, bound and robot."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from trustbo.data import FEATURES, NOWHERE, Bound, Mission
from trustbo.errors import TrustboError
from trustbo.logs.columns import Columns, require_one_spelling
from trustbo.stacking import require_same_team
from trustbo.workspace import Workspace

KEYS = ("mission", "bound", "robot")
RATES = ("contact_rate", "duration", "n_ticks")
COLUMNS = (*KEYS, "row", "col", *RATES, "t0", "status", "mission_status")
"""Columns with a fixed meaning; other columns may be features of awareness."""


def to_frame(missions: Sequence[Mission]) -> pd.DataFrame:
    """Table of missions, numbered from 1, without ticks; `to_csv(file, index=False)` writes it.

    It has the columns of `read_table`. Bound 0 is the start cell and has no measurements. Bounds
    that were planned but not run are blank. A mission without a map has no bound 0.

    Raises:
        TrustboError: The missions have different robots or features, only some have a path, or a
            feature has the name of another column.
    """
    require_same_team(missions)
    if taken := {*missions[0].features} & {*COLUMNS, "x", "y"}:
        raise TrustboError(f"features {sorted(taken)} have names of other columns; rename them.")
    if len({mission.has_map for mission in missions}) > 1:
        raise TrustboError("some missions have a path, and some none; write them to two tables.")
    rows = []
    for j, mission in enumerate(missions, start=1):
        n_steps = max(len(mission.path), len(mission.bounds) + 1)
        for k in range(0 if mission.has_map else 1, n_steps):
            bound = mission.bounds[k - 1] if 1 <= k <= len(mission.bounds) else None
            for i, robot in enumerate(mission.robots):
                row: dict[str, Any] = dict(zip(KEYS, (j, k, robot), strict=True))
                if mission.has_map:
                    row["row"], row["col"] = mission.path[k]
                if bound is not None:
                    row |= {name: getattr(bound, name)[i] for name in RATES}
                    row |= {"t0": bound.t0, "status": bound.status}
                    row |= {"mission_status": mission.status}
                    row |= dict(zip(mission.features, bound.awareness[i], strict=True))
                rows.append(row)
    names = [name for name in COLUMNS if missions[0].has_map or name not in ("row", "col")]
    return pd.DataFrame(rows, columns=[*names, *missions[0].features])


def read_table(
    table: Any, workspace: Workspace | None = None, *, features: Sequence[str] | None = None
) -> list[Mission]:
    """Read missions from a table with one row per mission, bound and robot.

    Columns are `mission`; `bound`, 0 for the start cell, which has no measurements; `robot`; the
    cell (`row`, `col`), or a position (`x`, `y`, metres of the workspace's CRS); and
    `contact_rate`. Optional are `duration` (s), `n_ticks`, `t0` (s), `status` of the bound,
    `mission_status` and a column for each feature. A blank means not measured. Bounds after the
    last one with a measurement were planned but not run. Without cells, the log has no map.

    Args:
        table: Path of a CSV file with a header, separated by commas, semicolons or tabs; or a
            DataFrame, or a mapping of columns.
        workspace: Workspace whose robots and features are read, in its order.
        features: Names of the awareness columns. By default the workspace's features, NaN if a
            column is missing; without a workspace, all remaining columns.

    Returns:
        Missions in the order of the table, without ticks.

    Raises:
        TrustboError: A column, bound or robot is missing, a row is repeated, a value has the wrong
            type, rows of one bound disagree, or `Mission` refuses the data.
    """
    columns = Columns(table)
    at_metres = columns.find("row") is None and columns.find("x") is not None
    places = ("x", "y") if at_metres else ("row", "col")
    if workspace is None and at_metres:
        raise TrustboError("cells at x and y need the grid of a workspace; give workspace=.")
    is_mapped = workspace is not None or any(columns.find(name) for name in places)
    columns.require((*KEYS, *(places if is_mapped else ()), "contact_rate"))
    if features is None:
        known = {columns.find(name) for name in (*COLUMNS, "x", "y")}
        rest = [name for name in columns.frame if name not in known] or list(FEATURES)
        features = rest if workspace is None else workspace.features
    else:
        columns.require(features)
    frame = _parsed(columns, features, places if is_mapped else ())
    if at_metres and workspace is not None:
        pairs = frame[["x", "y"]].to_numpy()
        cells = [workspace.grid.locate({"x": x, "y": y}, "position") for x, y in pairs]
        frame["row"], frame["col"] = np.transpose(cells)
    named = frame.loc[frame["robot"] != "", "robot"]
    robots = tuple(dict.fromkeys(named) if workspace is None else workspace.team.names)
    require_one_spelling("the robots of table and workspace", (*robots, *named))
    for row, robot in named[~named.isin(robots)].items():
        raise TrustboError(f"row {row}: robot {robot!r} is not one of {robots}.")
    if (twice := frame.duplicated([*KEYS]).to_numpy()).any():
        row = frame.index[twice][0]
        raise TrustboError(f"row {row} has the mission, bound and robot of another row.")
    missions = []
    for label, rows in frame.groupby("mission", sort=False):
        try:
            missions.append(_mission(rows, tuple(features), robots, is_mapped))
        except TrustboError as error:
            raise TrustboError(f"mission {label}: {error}") from None
    return missions


def _parsed(columns: Columns, features: Sequence[str], places: Sequence[str]) -> pd.DataFrame:
    """Columns with the names and types of this module; NaN or None where blank."""
    values: dict[str, Any] = {name: columns.texts(name) for name in ("mission", "robot")}
    require_one_spelling("column mission", values["mission"])
    if "" in values["mission"]:
        row = columns.frame.index[values["mission"].index("")]
        raise TrustboError(f"row {row}: mission is blank.")
    for name in ("bound", *places):
        values[name] = columns.numbers(name, blank=False, whole=name not in ("x", "y"))
    for name in (*RATES, "t0", *features):
        values[name] = columns.numbers(name, required=False)
    for name in ("status", "mission_status"):
        values[name] = [text or None for text in columns.texts(name, required=False)]
    return pd.DataFrame(values, index=columns.frame.index).astype({"bound": int})


def _mission(
    rows: pd.DataFrame, features: tuple[str, ...], robots: tuple[str, ...], is_mapped: bool
) -> Mission:
    """Make a mission from its rows."""
    of_bound = rows.groupby("bound")
    numbers = rows["bound"].to_numpy(int)
    planned = list(range(0 if is_mapped else 1, int(numbers.max()) + 1))
    if [*of_bound.groups] != planned:
        raise TrustboError(
            f"bounds must be {planned}, from the start cell; got {[*of_bound.groups]}."
        )
    cells = ["row", "col"] if is_mapped else []
    common = of_bound[[*cells, "t0", "status"]]
    for name, differ in (common.nunique() > 1).items():
        if differ.any():
            raise TrustboError(f"rows of bound {differ.idxmax()} disagree on {name}.")
    outcomes = rows["mission_status"].dropna().unique().tolist()
    if len(outcomes) > 1:
        raise TrustboError("rows disagree on mission_status.")
    measured = rows[[*RATES, "t0", "status", *features]].notna().to_numpy().any(axis=1)
    if not measured.any() or numbers[measured].min() < 1:
        raise TrustboError(
            "bounds with a measurement are numbered from 1, and there is one or more."
        )
    n_run = int(numbers[measured].max())
    expected = pd.MultiIndex.from_product([range(1, n_run + 1), robots])
    of_robot = rows.set_index(["bound", "robot"])
    if missing := [pair for pair in expected if pair not in of_robot.index]:
        raise TrustboError("bound {} has no row for {}.".format(*missing[0]))
    values = of_robot.loc[expected, [*RATES, *features]].to_numpy(float)
    values = values.reshape(n_run, len(robots), -1)
    shared = common.first()
    path = tuple((int(r), int(c)) for r, c in np.asarray(shared[cells])) if is_mapped else ()
    bounds: list[Bound] = []
    for k, team in enumerate(values, start=1):
        t0, ended = shared.at[k, "t0"], shared.at[k, "status"]
        t0 = float(t0) if pd.notna(t0) else bounds[-1].t1 if bounds else 0.0
        if bounds and t0 < bounds[-1].t0:
            raise TrustboError(f"bound {k} begins at t0 = {t0:g} s, before bound {k - 1}.")
        rate, duration, n_ticks = team[:, : len(RATES)].T
        cell, z = path[k] if path else NOWHERE, team[:, len(RATES) :]
        ended = str(ended) if pd.notna(ended) else "ok"
        bounds.append(Bound(cell, z, rate, duration, ended, t0, n_ticks=n_ticks))
    outcome = outcomes[0] if outcomes else bounds[-1].status
    return Mission(path, tuple(bounds), outcome, features, robots)
