"""Tables that users give: one reader, and one parser of names, numbers and times."""

import codecs
import csv
import gzip
import io
import re
import warnings
from collections.abc import Iterable, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from trustbo.errors import TrustboError, one_line

_SEPARATORS = ",;\t"
_BLANK = ("", "na", "n/a", "#n/a", "#na", "nan", "nat", "none", "null", "<na>")
"""Cells without a value, in small letters, as R, Excel, pandas and SQL write them."""
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.IGNORECASE)
_WHOLE = re.compile(r"^(-?\d+)\.0+$")
_DECIMAL_COMMA = re.compile(r"([+-]?\d*),(\d+)")
_ZONE = re.compile(r"(Z|[+-]\d\d:?\d\d)$", re.IGNORECASE)
_LONGEST = 7 * 86_400.0
"""Longest log, s: times that span more are in another unit, or have a stray stamp."""


class Columns:
    """Columns of a table, by name, without what spreadsheets and surveys add to it.

    Left out are a line `sep=`, columns without a name, empty rows, and the header rows of a survey
    down to the one with ImportId. Columns are found in any case, with spaces or underscores.

    Attributes:
        what: The table in messages, such as "the table of poses".
        frame: Values; None in blank cells of text. The index is the row, 1 below the header.
    """

    def __init__(self, table: Any, what: str = "the table") -> None:
        """Read a CSV file, separated by commas, semicolons or tabs; a DataFrame; or a mapping.

        Raises:
            TrustboError: No such file, or no CSV; a repeated column; or no rows.
        """
        self.what = what
        frame = _of_file(Path(table)) if isinstance(table, str | PathLike) else _of_values(table)
        frame.columns = [str(name).strip() for name in frame.columns]
        frame = frame.loc[:, [not re.fullmatch(r"(Unnamed: \d+)?", n) for n in frame.columns]]
        if not frame.columns.is_unique:
            raise TrustboError(f"{what} has two columns of one name: {', '.join(frame.columns)}.")
        frame.index = pd.RangeIndex(1, len(frame) + 1)
        numbers = frame.select_dtypes(["number", "bool", "datetime", "datetimetz"])
        text = frame.drop(columns=numbers).astype(object).map(_cell).astype(object)
        imports = text.iloc[:3].map(lambda cell: "ImportId" in str(cell)).any(axis=1)
        skipped = int(imports[imports].index[-1]) if imports.any() else 0
        self.frame = text.join(numbers)[list(frame)].iloc[skipped:].dropna(how="all")
        if frame.shape[1] and self.frame.empty:
            raise TrustboError(f"{what} has no rows.")

    def find(self, name: str) -> str | None:
        """Name of a column as the table has it; None without such a column."""
        if name in self.frame:
            return name
        alike = [other for other in self.frame if _folded(other) == _folded(name)]
        return alike[0] if len(alike) == 1 else None

    def require(self, names: Iterable[str], remedy: str = "") -> None:
        """Check that columns are there; the TrustboError lists those that the table has."""
        if missing := [name for name in names if self.find(name) is None]:
            there = ", ".join(self.frame) or "no columns"
            raise TrustboError(f"{self.what} lacks {', '.join(missing)}; it has {there}.{remedy}")

    def texts(self, column: str) -> list[str]:
        """Texts of a column, "" if blank; 1.0, which pandas makes of 1 beside a blank, is 1."""
        cells = self._cells(column).astype(object)
        texts = ["" if pd.isna(cell) else str(cell) for cell in cells]
        return [_WHOLE.sub(r"\1", text) for text in texts]

    def names(self, column: str) -> list[str]:
        """Names of robots, people or missions in a column, "" if blank, each in one spelling."""
        names = self.texts(column)
        require_one_spelling(f"column {column} of {self.what}", names)
        return names

    def numbers(self, column: str, *, blank: bool = True) -> np.ndarray:
        """Numbers of a column, (row,); NaN where blank.

        Raises:
            TrustboError: Text that is no number, infinity, or a blank where none may be.
        """
        cells = self._cells(column)
        if cells.dtype == object:
            text = cells.dropna()
            for row, cell in text.items():
                if not _is_number(cell):
                    advice = _advice(cell)
                    raise TrustboError(f"row {row}: {column} = {cell!r} is no number{advice}.")
            cells = text.astype(float).reindex(cells.index)
        values = cells.to_numpy(float, na_value=np.nan)
        for bad, fault in ((np.isinf(values), "is infinite"), (np.isnan(values), "is blank")):
            if bad.any() and not (blank and fault == "is blank"):
                raise TrustboError(
                    f"row {self.frame.index[bad][0]} of {self.what}: {column} {fault}."
                )
        return values

    def whole(self, column: str) -> np.ndarray:
        """Whole numbers of a column, (row,), none of them blank, or TrustboError."""
        values = self.numbers(column, blank=False)
        for row, value in zip(self.frame.index, values, strict=True):
            if not value.is_integer():
                raise TrustboError(f"row {row}: {column} = {value:g} must be a whole number.")
        return values.astype(int)

    def dates(self, column: str) -> pd.DatetimeIndex | None:
        """Dates of a column, in UTC if they have a zone; None for a column of numbers."""
        cells = self._cells(column)
        texts = [str(cell) for cell in cells]
        if cells.dtype.kind != "M" and all(map(_is_number, cells.dropna().astype(str))):
            return None
        zoned = [_ZONE.search(text) is not None for text in texts]
        dates = pd.to_datetime(pd.Index(texts), utc=True, format="ISO8601", errors="coerce")
        bad = np.asarray(dates.isna()) | (np.array(zoned) != zoned[0])
        if bad.any():
            i = int(np.argmax(bad))
            raise TrustboError(
                f"row {cells.index[i]} of {self.what}: {column} = {texts[i]!r} is neither seconds "
                "nor a date such as 2026-11-24T10:00:00.5Z, with a time zone in all rows or none."
            )
        return pd.DatetimeIndex(dates if zoned[0] else dates.tz_localize(None))

    def _cells(self, column: str) -> pd.Series:
        self.require([column])
        return self.frame[self.find(column)]


def seconds_of(first: Columns, second: Columns, column: str = "t") -> tuple[np.ndarray, np.ndarray]:
    """Times of two tables by one clock, each (row,), s; those of dates since the first date.

    Raises:
        TrustboError: Numbers that cannot be seconds; dates in one table alone, or of which one
            table alone has a time zone; or clocks by which no time of the second is of the first.
    """
    dates = [table.dates(column) for table in (first, second)]
    a, b = dates
    if a is None and b is None:
        times = [table.numbers(column, blank=False) for table in (first, second)]
    elif a is None or b is None or (a.tz is None) != (b.tz is None):
        kinds = ["numbers" if d is None else "dates" + " with a zone" * (d.tz is not None)
                 for d in dates]  # fmt: skip
        raise TrustboError(
            f"{first.what} has times as {kinds[0]} and {second.what} as {kinds[1]}: clocks that "
            "cannot be compared; write both as dates in UTC, or both in seconds."
        )
    else:
        times = [pd.TimedeltaIndex(d - a.min()).total_seconds().to_numpy(float) for d in (a, b)]
    for table, t in zip((first, second), times, strict=True):
        if np.ptp(t) > _LONGEST or np.abs(t).max() > 1e11:
            raise TrustboError(
                f"times of {table.what} are from {t.min():.9g} to {t.max():.9g}, which as seconds "
                f"span {np.ptp(t) / 86_400.0:.3g} days; the unit is the second (divide "
                "milliseconds by 1000), and a log spans a week at most."
            )
    start, end = times[0].min(), times[0].max()
    inside = ((times[1] >= start) & (times[1] <= end)).mean()
    if inside < 0.5:
        message = (
            f"{inside:.0%} of the times of {second.what}, {times[1].min():.9g} to "
            f"{times[1].max():.9g} s, lie in those of {first.what}, {start:.9g} to {end:.9g} s: do "
            "the clocks differ in zero, unit or time zone?"
        )
        if not inside:
            raise TrustboError(message)
        warnings.warn(message, stacklevel=3)
    return times[0], times[1]


def require_one_spelling(what: str, names: Iterable[str]) -> None:
    """Refuse two names that differ by case, spaces or leading zeros alone: TrustboError."""
    spelled: dict[str, str] = {}
    for name in dict.fromkeys(names):
        other = spelled.setdefault(_folded(name), name)
        if other != name:
            raise TrustboError(
                f"{what} has {other!r} and {name!r}: write what is one name alike, and let names "
                "of two differ by more than case, spaces or zeros."
            )


def _folded(name: str) -> str:
    """Name without case, leading zeros and kinds of spaces."""
    spaced = re.sub(r"[\s_-]+", " ", name.casefold()).strip()
    return re.sub(r"(?<![\d.])0+(?=\d)", "", spaced)


def _cell(value: object) -> str | None:
    """Text of a cell, None if blank."""
    text = str(value).strip()
    return None if text.lower() in _BLANK else text


def _is_number(text: str) -> bool:
    return _NUMBER.fullmatch(text) is not None


def _advice(text: str) -> str:
    if _DECIMAL_COMMA.fullmatch(text):
        return ": write decimals with a point, not a comma"
    if _NUMBER.match(text) or text.replace(" ", "").isalpha():
        return "; map words to numbers first, such as frame[column].map({'agree': 6})"
    return "; is the row a second header, or the column another?"


def _of_values(table: Any) -> pd.DataFrame:
    """Copy of a DataFrame, or a frame of a mapping of columns or a structured array."""
    if isinstance(table, pd.DataFrame):
        return table.reset_index() if any(table.index.names) else table.copy()
    names = list(table) if isinstance(table, Mapping) else getattr(table, "columns", None)
    if names is None:
        names = getattr(getattr(table, "dtype", None), "names", None)
    if names is None:
        raise TrustboError(f"give the path of a CSV file or a DataFrame; got {one_line(table)}.")
    columns = {str(name): list(table[name]) for name in names}
    if len({len(column) for column in columns.values()}) > 1:
        lengths = {name: len(column) for name, column in columns.items()}
        raise TrustboError(f"columns must have one length; got {lengths}.")
    return pd.DataFrame(columns)


def _of_file(file: Path) -> pd.DataFrame:
    """Cells of a CSV file as text; commas of decimals where other signs separate columns."""
    if not file.is_file():
        raise TrustboError(f"there is no file {str(file)!r}; give a CSV file.")
    try:
        content = file.read_bytes()
        content = gzip.decompress(content) if file.suffix == ".gz" else content
        wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        text = content.decode("utf-16" if wide else "utf-8-sig")
        first, _, rest = text.partition("\n")
        separator = max(_SEPARATORS, key=first.count)
        if named := re.fullmatch(r'"?sep=(.)"?\s*', first, re.IGNORECASE):
            separator, text = named[1], rest
        lines = [*csv.reader(io.StringIO(text, newline=""), delimiter=separator)]
    except (OSError, EOFError, UnicodeDecodeError, csv.Error) as error:
        raise TrustboError(
            f"{str(file)!r} cannot be read as CSV in UTF-8: {error}. Save it as UTF-8, or give a "
            'DataFrame, such as pandas.read_csv(file, encoding="cp1252").'
        ) from None
    header, *rows = [line for line in lines if line] or [[]]
    for i, row in enumerate(rows, start=1):
        if len(row) < len(header) or any(cell.strip() for cell in row[len(header) :]):
            raise TrustboError(
                f"row {i} of {str(file)!r} has {len(row)} values, the header {len(header)}."
            )
        if separator != ",":
            row[:] = [_DECIMAL_COMMA.sub(r"\1.\2", c) if _DECIMAL_COMMA.fullmatch(c.strip()) else c
                      for c in row]  # fmt: skip
    return pd.DataFrame([row[: len(header)] for row in rows], columns=header, dtype=object)
