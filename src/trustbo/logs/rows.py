"""Rows of a table of missions: checked numbers from text or from a frame's values."""

import csv
import gzip
import math
import re
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

from trustbo.data import FEATURES, NOWHERE, Cell
from trustbo.errors import TrustboError
from trustbo.spreadsheet import meant
from trustbo.workspace.grid import Grid

KEYS = ("mission", "bound", "robot", "row", "col")
NUMBERS = ("contact_rate", "contact_time", "duration", "n_ticks", "t0")
TEXTS = ("status", "mission_status")
COLUMNS = (*KEYS, *NUMBERS, *TEXTS)
"""Columns with a fixed meaning; any other is an awareness feature."""
POSITIONS = (("row", "col"), ("x", "y"), ("lon", "lat"))
"""Pairs of columns with the cell, or with a position in it."""
_PREFIX = "awareness_"
_SEPARATORS = ",;\t"
_BLANK = {"", "nan", "none", "null", "<na>", "nat"}


class Row(NamedTuple):
    """Measurements of one robot in one bound."""

    line: int
    """Number of the row, 1 for the first below the header."""
    mission: str
    bound: int
    robot: str
    """Name of the robot; empty if blank, as all texts are."""
    cell: Cell
    numbers: dict[str, float]
    """Values by column of `NUMBERS`; NaN if blank or absent."""
    awareness: tuple[float, ...]
    """Awareness by feature; NaN if blank."""
    status: str
    mission_status: str

    @property
    def is_blank(self) -> bool:
        """Whether the row holds only the planned cell."""
        return not self.status and all(map(math.isnan, (*self.numbers.values(), *self.awareness)))


def read_columns(
    table: Any, ignore: Sequence[str] = (), *, mapped: bool = False
) -> dict[str, list[str]]:
    """Read the columns of a table (see `read_table`) but `ignore` as text, "" if blank.

    Columns of cells or positions are needed where the table is `mapped`, or has any of them.

    TrustboError: no such file, or no CSV; a missing or repeated column; no rows.
    """
    columns = columns_of(table)
    names = list(columns)
    for name in (ignore,) if isinstance(ignore, str) else ignore:
        if columns.pop(name, None) is None:
            raise TrustboError(f"ignore has {name!r}; the table has {', '.join(names)}.")
    place = position_of(columns) or (POSITIONS[0] if mapped else ())
    missing = [n for n in (*KEYS[:3], *place) if n not in columns]
    if "contact_rate" not in columns and not {"contact_time", "duration"} <= columns.keys():
        missing.append("contact_rate (or contact_time and duration)")
    if missing:
        shown = ", ".join(names) or "no columns"
        raise TrustboError(f"the table lacks {', '.join(missing)}; it has {shown}.")
    if not columns["mission"]:
        raise TrustboError("the table has no rows.")
    return columns


def needed_columns(
    table: Any, names: Sequence[str], *, of: str = "", remedy: str = "."
) -> dict[str, list[str]]:
    """Columns of a table, see `columns_of`, which has rows and those of some names.

    TrustboError: one is missing, or there are no rows; `of` names what the table is of, and
    `remedy` is the end of the message.
    """
    columns, what = columns_of(table), f"the table{of}"
    if missing := [name for name in names if name not in columns]:
        there = ", ".join(columns) or "no columns"
        raise TrustboError(f"{what} lacks {', '.join(missing)}; it has {there}{remedy}")
    if not columns[names[0]]:
        raise TrustboError(f"{what} has no rows.")
    return columns


def columns_of(table: Any) -> dict[str, list[str]]:
    """Columns of a CSV file, a frame or a mapping as text, "" if blank.

    TrustboError: no such file, or no CSV; a repeated column, or columns of several lengths.
    """
    names, values = _from_file(Path(table)) if isinstance(table, str | PathLike) else _of(table)
    columns = {n: [_stripped(v) for v in column] for n, column in zip(names, values, strict=True)}
    if len(columns) < len(names):
        raise TrustboError(f"the table has two columns of one name: {', '.join(names)}.")
    return columns


def parse_rows(
    columns: Mapping[str, list[str]], features: Sequence[str], grid: Grid | None = None
) -> list[Row]:
    """Parse the rows of a table from the columns of `read_columns`.

    Awareness is NaN for features without a column; positions need the grid of the cells.
    TrustboError: a feature without a column while other columns have no meaning, positions without
    a grid, or a value of the wrong kind.
    """
    wanted = [column_of(name) for name in features]
    missing = [name for name in wanted if name not in columns]
    place = position_of(columns)
    others = [n for n in columns if n not in (*COLUMNS, *place, *wanted)]
    if missing and others:
        raise TrustboError(
            f"the table lacks columns of awareness: {', '.join(missing)}; it has "
            f"{', '.join(others)}. Rename what is awareness; what is not: ignore={(*others,)!r}."
        )
    if grid is None and place and place != POSITIONS[0]:
        raise TrustboError(f"cells from {' and '.join(place)} need the grid: give workspace.")
    blank = [""] * len(columns["mission"])
    names = (*COLUMNS, *place, *wanted)
    return [
        _parse(i + 1, {n: columns.get(n, blank)[i] for n in names}, wanted, place, grid)
        for i in range(len(blank))
    ]


def position_of(columns: Mapping[str, object]) -> tuple[str, ...]:
    """Columns with the cell: the first of `POSITIONS` that the table has.

    Row and col where it has a part of a pair alone, and nothing where it has none: a table without
    is of a log without a map.
    """
    whole = (pair for pair in POSITIONS if columns.keys() >= set(pair))
    parts = (POSITIONS[0] for pair in POSITIONS if columns.keys() & set(pair))
    return next(whole, next(parts, ()))


def features_of(columns: Mapping[str, object]) -> tuple[str, ...]:
    """Features by the names of a table's columns; those of `FEATURES` if it has none."""
    place = position_of(columns)
    others = [name for name in columns if name not in (*COLUMNS, *place)]
    bare = [name.removeprefix(_PREFIX) for name in others]
    features = tuple(b if b in COLUMNS else name for b, name in zip(bare, others, strict=True))
    return features or FEATURES


def column_of(feature: str) -> str:
    """Column of a feature: its name, with a prefix if another column has it."""
    return f"{_PREFIX}{feature}" if feature in COLUMNS else feature


def _parse(
    line: int,
    text: Mapping[str, str],
    wanted: Sequence[str],
    place: Sequence[str],
    grid: Grid | None,
) -> Row:
    numbers = {name: number_of(f"row {line}", name, text[name]) for name in NUMBERS}
    awareness = tuple(_awareness(line, name, text[name], bounded=bool(place)) for name in wanted)
    bound = _whole(line, "bound", text["bound"])
    if not text["mission"]:
        raise TrustboError(f"row {line}: mission is blank.")
    if bound < 0:
        raise TrustboError(f"row {line}: bound = {bound} must be 0, the start cell, or more.")
    if not place:
        row, col = NOWHERE
    elif grid is None or place == POSITIONS[0]:
        row, col = (_whole(line, name, text[name]) for name in place)
    else:
        row, col = _cell_at(line, place, [text[name] for name in place], grid)
    texts = (text[name] for name in TEXTS)
    return Row(line, text["mission"], bound, text["robot"], (row, col), numbers, awareness, *texts)


def _cell_at(line: int, place: Sequence[str], texts: Sequence[str], grid: Grid) -> Cell:
    """Cell at a position, (x, y) or (lon, lat)."""
    a, b = (number_of(f"row {line}", name, text) for name, text in zip(place, texts, strict=True))
    find = grid.cell_at if place[0] == "x" else grid.cell_at_lonlat
    where = f"row {line}: {place[0]} = {texts[0]}, {place[1]} = {texts[1]}"
    try:
        return find(a, b)
    except Exception as error:  # off the grid; or NaN, infinite, or GDAL refuses it
        if place[0] != "x" and grid.crs is None:
            raise TrustboError(f"{where}: {error}") from None
    try:
        hint = f"; swapped? ({b:g}, {a:g}) is in cell {find(b, a)}"
    except Exception:  # as above
        (west, south), (rows, cols) = grid.corner, grid.shape
        east, north = west + cols * grid.cell_width, south + rows * grid.cell_height
        hint = f", x {west:g} to {east:g}, y {south:g} to {north:g} m in its CRS"
    raise TrustboError(f"{where} is no position on the workspace's grid{hint}.")


def _from_file(file: Path) -> tuple[list[str], list[list[str]]]:
    if not file.is_file():
        raise TrustboError(f"there is no file {str(file)!r}; give a CSV file.")
    try:
        opener = gzip.open if file.suffix == ".gz" else open
        with opener(file, "rt", newline="", encoding="utf-8-sig") as stream:
            first = stream.readline()
            stream.seek(0)
            separator = max(_SEPARATORS, key=first.count)
            header, *rows = [line for line in csv.reader(stream, delimiter=separator) if line] or [
                []
            ]
    except (csv.Error, UnicodeDecodeError, EOFError, gzip.BadGzipFile) as error:
        raise TrustboError(
            f"{str(file)!r} cannot be read as CSV in UTF-8: {error}. Save it as UTF-8, or give a "
            'DataFrame, such as pandas.read_csv(file, sep=";", encoding="cp1252").'
        ) from None
    for i, row in enumerate(rows, start=1):
        if len(row) != len(header):
            raise TrustboError(f"row {i} has {len(row)} values, the header {len(header)}.")
    if separator == ";":  # spreadsheets write it where the decimal sign is a comma
        rows = [[re.sub(r"^([+-]?\d+),(\d+)$", r"\1.\2", text) for text in row] for row in rows]
    rows = [[meant(text) for text in row] for row in rows]
    names = [meant(name.strip()) for name in header]
    return names, [[row[j] for row in rows] for j in range(len(names))]


def _of(table: Any) -> tuple[list[str], list[list[object]]]:
    names = list(table) if isinstance(table, Mapping) else getattr(table, "columns", None)
    if names is None:  # a structured array of NumPy
        names = getattr(getattr(table, "dtype", None), "names", None)
    if names is None:
        raise TrustboError(f"give the path of a CSV file or a DataFrame; got {table!r}.")
    columns = [list(table[name]) for name in names]
    lengths = {len(column) for column in columns}
    if len(lengths) > 1:
        raise TrustboError(f"columns must have one length; got {sorted(lengths)}.")
    return [str(name).strip() for name in names], columns


def _awareness(line: int, name: str, text: str, *, bounded: bool) -> float:
    hint = f"; if it is no awareness feature: ignore=({name!r},)"
    number = number_of(f"row {line}", name, text, hint)
    if bounded and (number < 0.0 or number > 1.0):
        raise TrustboError(f"row {line}: {name} = {text} is outside [0, 1]{hint}.")
    return number


def number_of(where: str, name: str, text: str, hint: str = "") -> float:
    """Number of a text, NaN if blank; TrustboError, which names the place, if it is none."""
    try:
        number = float(text) if text else math.nan
    except ValueError:
        number = math.inf
    if math.isinf(number):
        raise TrustboError(f"{where}: {name} = {text!r} is no number{hint}.")
    return number


def _whole(line: int, name: str, text: str) -> int:
    number = number_of(f"row {line}", name, text)
    if not number.is_integer():
        raise TrustboError(f"row {line}: {name} = {text!r} must be a whole number.")
    return int(number)


def _stripped(value: object) -> str:
    text = str(value).strip()
    return "" if text.lower() in _BLANK else text
