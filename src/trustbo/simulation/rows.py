"""Rows of a table of missions: from text, or a frame's values, to numbers that were checked."""

import csv
import math
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

from trustbo.data import Cell
from trustbo.errors import TrustboError

KEYS = ("mission", "bound", "robot", "row", "col")
NUMBERS = ("contact_rate", "contact_time", "duration", "exposure", "t0")
COLUMNS = (*KEYS, *NUMBERS, "status", "mission_status")
"""The columns with a meaning of their own; any other is an awareness feature."""
_PREFIX = "awareness_"
_BLANK = {"", "nan", "none", "null", "<na>", "nat"}


class Row(NamedTuple):
    """What one robot measured in one bound."""

    line: int
    """The first row below the header is 1."""
    mission: str
    bound: int
    robot: str
    """Empty where blank, as both statuses are."""
    cell: Cell
    numbers: dict[str, float]
    """By column of `NUMBERS`; NaN where blank or absent."""
    awareness: tuple[float, ...]
    """By feature; NaN where blank."""
    status: str
    mission_status: str

    @property
    def is_blank(self) -> bool:
        """Whether the row says only which cell was planned."""
        return not self.status and all(map(math.isnan, (*self.numbers.values(), *self.awareness)))


def read_columns(table: Any) -> dict[str, list[str]]:
    """Columns of a CSV file, a frame or a mapping as text, "" where blank.

    Raises:
        TrustboError: No such file, or none of CSV; a missing or repeated column; no rows.
    """
    names, values = _from_file(Path(table)) if isinstance(table, str | PathLike) else _of(table)
    columns = {n: [_stripped(v) for v in column] for n, column in zip(names, values, strict=True)}
    if len(columns) < len(names):
        raise TrustboError(f"the table has two columns of one name: {', '.join(names)}.")
    missing = [name for name in KEYS if name not in columns]
    if "contact_rate" not in columns and not {"contact_time", "duration"} <= columns.keys():
        missing.append("contact_rate (or contact_time and duration)")
    if missing:
        raise TrustboError(f"the table lacks {', '.join(missing)}; it has {', '.join(names)}.")
    if not columns["mission"]:
        raise TrustboError("the table has no rows.")
    return columns


def parse_rows(columns: Mapping[str, list[str]], features: Sequence[str]) -> list[Row]:
    """Rows of a table.

    Args:
        columns: As `read_columns` gives them.
        features: Names of the awareness features.

    Raises:
        TrustboError: A feature without a column, or a value of the wrong kind.
    """
    wanted = [column_of(name) for name in features]
    missing = [name for name in wanted if name not in columns]
    if missing or not wanted:
        raise TrustboError(
            f"the table lacks columns of awareness: {', '.join(missing) or 'it has none'}; leave "
            "blank what was not measured."
        )
    blank = [""] * len(columns["mission"])
    return [
        _parse(i + 1, {name: columns.get(name, blank)[i] for name in (*COLUMNS, *wanted)}, wanted)
        for i in range(len(blank))
    ]


def features_of(columns: Mapping[str, object]) -> tuple[str, ...]:
    """Features that a table's columns are named after, where nobody says which."""
    others = [name for name in columns if name not in COLUMNS]
    bare = [name.removeprefix(_PREFIX) for name in others]
    return tuple(b if b in COLUMNS else name for b, name in zip(bare, others, strict=True))


def column_of(feature: str) -> str:
    """The column of a feature: its name, prefixed where that is a column of its own."""
    return f"{_PREFIX}{feature}" if feature in COLUMNS else feature


def _parse(line: int, text: Mapping[str, str], wanted: Sequence[str]) -> Row:
    numbers = {name: _number(line, name, text[name]) for name in NUMBERS}
    awareness = tuple(_number(line, name, text[name]) for name in wanted)
    bound, row, col = (_whole(line, name, text[name]) for name in ("bound", "row", "col"))
    if not text["mission"]:
        raise TrustboError(f"row {line}: mission is blank.")
    if bound < 0:
        raise TrustboError(f"row {line}: bound = {bound} must be 0, the start cell, or more.")
    names = (text["status"], text["mission_status"])
    return Row(line, text["mission"], bound, text["robot"], (row, col), numbers, awareness, *names)


def _from_file(file: Path) -> tuple[list[str], list[list[str]]]:
    if not file.is_file():
        raise TrustboError(f"there is no file {str(file)!r}; give a CSV file.")
    try:
        with file.open(newline="", encoding="utf-8-sig") as stream:
            header, *rows = [line for line in csv.reader(stream) if line] or [[]]
    except (csv.Error, UnicodeDecodeError) as error:
        raise TrustboError(f"{str(file)!r} cannot be read as CSV in UTF-8: {error}.") from None
    for i, row in enumerate(rows, start=1):
        if len(row) != len(header):
            raise TrustboError(f"row {i} has {len(row)} values, the header {len(header)}.")
    return [name.strip() for name in header], [[row[j] for row in rows] for j in range(len(header))]


def _of(table: Any) -> tuple[list[str], list[list[object]]]:
    names = list(table) if isinstance(table, Mapping) else getattr(table, "columns", None)
    if names is None:
        raise TrustboError(f"give the path of a CSV file or a DataFrame; got {table!r}.")
    columns = [list(table[name]) for name in names]
    lengths = {len(column) for column in columns}
    if len(lengths) > 1:
        raise TrustboError(f"columns must have one length; got {sorted(lengths)}.")
    return [str(name).strip() for name in names], columns


def _number(line: int, name: str, text: str) -> float:
    try:
        return float(text) if text else math.nan
    except ValueError:
        hint = "" if name in COLUMNS else "; if it is no awareness feature, name those: features"
        raise TrustboError(f"row {line}: {name} = {text!r} is no number{hint}.") from None


def _whole(line: int, name: str, text: str) -> int:
    number = _number(line, name, text)
    if not number.is_integer():
        raise TrustboError(f"row {line}: {name} = {text!r} must be a whole number.")
    return int(number)


def _stripped(value: object) -> str:
    text = str(value).strip()
    return "" if text.lower() in _BLANK else text
