"""Tables with columns of other names and units: what `columns=` says, and its TOML file.

A mapping gives, for the names of columns in trustbo, those of a user's table:

    {"mission": "run", "contact_rate": {"column": "contact_pct", "unit": "%"}}

The file has the same as TOML: `mission = "run"`, and
`contact_rate = {column = "contact_pct", unit = "%"}`.
"""

import tomllib
from collections.abc import Mapping
from decimal import Decimal, InvalidOperation
from typing import Any
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import pandas as pd

from trustbo.errors import TrustboError, one_line, require_choice
from trustbo.files import FilePath, read_file

type ColumnMap = Mapping[str, str | Mapping[str, str]]
"""Columns of a table, keyed by their names in trustbo; see `mapped`."""

_FACTORS = {
    "%": "0.01",
    "ns": "1e-9",
    "us": "1e-6",
    "ms": "1e-3",
    "s": "1",
    "min": "60",
    "h": "3600",
    "cm": "0.01",
    "m": "1",
    "km": "1000",
    "ft": "0.3048",
}
"""Factors to shares, seconds and metres, as exact decimals."""
_DATE = "date"
_UNITS = (*_FACTORS, _DATE)
_KEYS = ("column", "unit", "zone")
_OF_TRACKS = ("t", "heading", "watcher", "seen", "detected")
"""Names that only tables of poses and of detections have."""


def read_columns(file: FilePath) -> dict[str, dict[str, str]]:
    """Read names and units of columns from a TOML file, for `columns=` of other readers.

    The file has lines such as `mission = "run"` and, with a unit or a time zone,
    `contact_rate = {column = "contact_pct", unit = "%"}`; see `read_table`.

    Returns:
        What is said about each column, keyed by its name in trustbo.

    Raises:
        TrustboError: The file is no TOML file, or a unit or time zone is unknown.

    Example:
        >>> columns = tb.logs.read_columns("columns.toml")
        >>> missions = tb.logs.read_table("legs.csv", columns=columns)
    """
    try:
        found = tomllib.loads(read_file(file).decode("utf-8-sig"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise TrustboError(
            f"{str(file)!r} is not a TOML file: {one_line(str(error))}. It has lines such as "
            'mission = "run" and contact_rate = {column = "contact_pct", unit = "%"}.'
        ) from None
    return require_columns(found)


def require_columns(columns: object) -> dict[str, dict[str, str]]:
    """Return a mapping of columns with a column, a unit and a zone for each name.

    Raises TrustboError if a name, column, unit or time zone is invalid.
    """
    if not isinstance(columns, Mapping) or not columns:
        raise TrustboError(
            'columns must be a mapping such as {"mission": "run"}, from names in trustbo to those '
            f"of the table; got {one_line(columns)}."
        )
    return {str(name): _required(str(name), column) for name, column in columns.items()}


def of_bounds(columns: ColumnMap) -> dict[str, dict[str, str]]:
    """Return a mapping for a table of bounds, without the columns of poses and detections."""
    given = require_columns(columns)
    return {name: one for name, one in given.items() if name not in _OF_TRACKS}


def _required(name: str, value: Any) -> dict[str, str]:
    """Return what is said about one column, with all keys."""
    given = {"column": value} if isinstance(value, str) else value
    is_valid = isinstance(given, Mapping) and {"column"} <= {*given} <= {*_KEYS}
    if not is_valid or not all(isinstance(text, str) for text in given.values()):
        raise TrustboError(
            f"columns[{name!r}] must be the name of a column, or have column and, if needed, unit "
            f"and zone; got {one_line(value)}."
        )

    full = {"unit": "", "zone": "", **given}
    if full["unit"]:
        require_choice(f"the unit of columns[{name!r}]", full["unit"], _UNITS)
    if full["zone"]:
        if full["unit"] != _DATE:
            raise TrustboError(f'columns[{name!r}] has a zone, so its unit must be "date".')
        try:
            ZoneInfo(full["zone"])
        except (ZoneInfoNotFoundError, ValueError, OSError):
            raise TrustboError(
                f"the zone of columns[{name!r}] must be a time zone such as "
                f"'America/Los_Angeles' or 'UTC'; got {full['zone']!r}."
            ) from None
    return full


def mapped(frame: Any, columns: dict[str, dict[str, str]], what: str) -> pd.DataFrame:
    """Return a DataFrame whose columns have the names and units of trustbo.

    Columns that are not in the mapping are left out.

    Raises TrustboError if the table lacks a column, or a date cannot be read.
    """
    for name, one in columns.items():
        if one["column"] not in frame:
            raise TrustboError(
                f"{what} lacks {one['column']}, which columns= names for {name}; it has "
                f"{', '.join(map(str, frame)) or 'no columns'}."
            )

    found = {name: _converted(frame[one["column"]], one, what) for name, one in columns.items()}
    return pd.DataFrame(found, index=frame.index)


def _converted(cells: pd.Series, one: dict[str, str], what: str) -> pd.Series:
    """Return a column in seconds, metres or shares; text that is no number stays as it is."""
    if one["unit"] == _DATE:
        return _seconds(cells, one, what)

    factor = Decimal(_FACTORS[one["unit"] or "s"])
    return cells if factor == 1 else cells.astype(object).map(lambda cell: _times(cell, factor))


def _times(cell: Any, factor: Decimal) -> Any:
    """Return a number times a factor as text, without rounding; other cells stay as they are."""
    try:
        return cell if pd.isna(cell) else str(Decimal(str(cell)) * factor)
    except InvalidOperation:
        return cell


def _seconds(cells: pd.Series, one: dict[str, str], what: str) -> pd.Series:
    """Return dates as seconds since 1970 in UTC; without a zone, dates that have none are UTC."""
    blank = cells.isna() | (cells.astype(str).str.strip() == "")
    zone = ZoneInfo(one["zone"] or "UTC")

    def second(cell: Any) -> float:
        date = pd.Timestamp(cell)
        return (date if date.tzinfo else date.tz_localize(zone)).timestamp()  # pyright: ignore[reportAttributeAccessIssue]

    seconds = []
    for row, cell in cells.items():
        try:
            seconds.append(float("nan") if blank[row] else second(cell))
        except (ValueError, TypeError, OverflowError) as error:
            raise TrustboError(
                f"row {row} of {what}: {one['column']} = {one_line(cell)} is not a date in the "
                f"zone {zone.key} ({one_line(str(error))}); write dates as 2026-05-04T09:30:00."
            ) from None
    return pd.Series(seconds, cells.index)
