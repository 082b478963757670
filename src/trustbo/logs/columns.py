"""Reader for user tables, with parsers for names, numbers and times."""

import csv
import io
import re
from collections.abc import Iterable
from os import PathLike
from typing import Any

import numpy as np
import pandas as pd

from trustbo.errors import TrustboError, one_line
from trustbo.files import FilePath, read_file

_BLANK = ("", "na", "n/a", "#n/a", "#na", "nan", "nat", "none", "null", "<na>")
"""Markers of missing values, in lower case, as written by R, Excel, pandas and SQL."""
_WHOLE = re.compile(r"^(-?\d+)\.0+$")
_THOUSANDS = re.compile(r"\s*[+-]?[1-9]\d{0,2}(,\d{3})+\s*")
_DECIMAL_COMMA = re.compile(r"^\s*([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)\s*$")


class Columns:
    """Columns of a table by name, without the extra lines of spreadsheets and surveys.

    The following are skipped: a line `sep=`, columns without a name, empty rows, and the header
    rows of a survey down to the one with ImportId. Column names match regardless of case, and
    spaces match underscores.

    Attributes:
        what: Name of the table in messages, such as "the table of poses".
        frame: Table; blank text cells are None. The index counts rows from 1 below the header.
    """

    def __init__(self, table: Any, what: str = "the table") -> None:
        """Read a CSV file (commas, semicolons or tabs), or any table that pandas accepts.

        Raises TrustboError if a file is not a table, a column is repeated, or there are no rows.
        """
        self.what = what
        frame = _of_file(table) if isinstance(table, str | PathLike) else pd.DataFrame(table).copy()
        if any(names := frame.index.names):
            frame = frame.drop(columns=[name for name in names if name in frame]).reset_index()
        frame.columns = [str(name).strip() for name in frame.columns]
        frame = frame.loc[:, [not re.fullmatch(r"(Unnamed: \d+)?", n) for n in frame.columns]]
        if not frame.columns.is_unique:
            raise TrustboError(f"{what} repeats a column name: {', '.join(frame.columns)}.")
        frame.index = pd.RangeIndex(1, len(frame) + 1)
        spans = frame.select_dtypes("timedelta").columns
        frame[spans] = frame[spans] / pd.Timedelta(seconds=1)
        text = frame.select_dtypes(exclude=["number", "bool"]).columns
        frame[text] = frame[text].astype(object).map(_cell).astype(object)
        imports = [i for i, row in frame.iloc[:3].iterrows() if "ImportId" in str(row.tolist())]
        self.frame = frame.loc[max(imports, default=0) + 1 :].dropna(how="all")
        if self.frame.empty:
            raise TrustboError(f"{what} has no rows.")

    def find(self, name: str) -> str | None:
        """Return the name of a column as spelled in the table; None if there is no such column."""
        if name in self.frame:
            return name
        alike = [other for other in self.frame if _folded(other) == _folded(name)]
        if len(alike) > 1:
            raise TrustboError(f"{self.what} has the columns {', '.join(alike)}; rename one.")
        return alike[0] if alike else None

    def refuse(self, column: str, bad: np.ndarray, why: str) -> None:
        """Raise TrustboError for the first value of a column that is marked in `bad`, (row,)."""
        if bad.any():
            row, value = self.frame.index[bad][0], self._cells(column).to_numpy(object)[bad][0]
            raise TrustboError(f"row {row} of {self.what}: {column} = {one_line(value)} {why}.")

    def texts(self, column: str, *, blank: bool = True, required: bool = True) -> list[str]:
        """Return a column as text, "" if blank; floats such as 1.0 become 1.

        Raises TrustboError if a required column is missing (others are then blank), or if a value
        is blank although `blank` is False.
        """
        cells = self._cells(column, required).astype(object)
        self.refuse(column, cells.isna().to_numpy() & (not blank), "is blank; leave the row out")
        return ["" if pd.isna(cell) else _WHOLE.sub(r"\1", str(cell)) for cell in cells]

    def numbers(
        self, column: str, *, blank: bool = True, whole: bool = False, required: bool = True
    ) -> np.ndarray:
        """Return a column as numbers, (row,); NaN where blank, or if an optional column is missing.

        Raises TrustboError if a required column is missing, or if a value is not a finite number,
        is blank although `blank` is False, or is not whole although `whole` is True.
        """
        cells = self._cells(column, required)
        parsed = pd.Series(pd.to_numeric(cells, errors="coerce")).to_numpy(float, na_value=np.nan)
        self.refuse(
            column,
            ~np.isfinite(parsed) & cells.notna().to_numpy(),
            "is not a finite number; write decimals with a point, thousands without a mark, dates "
            "in seconds, and words as numbers: frame[column].map({'agree': 6})",
        )
        self.refuse(column, np.isnan(parsed) & (not blank), "is blank")
        self.refuse(column, whole & (parsed > np.floor(parsed)), "must be a whole number")
        return cells.to_numpy(float, na_value=np.nan)

    def _cells(self, column: str, required: bool = True) -> pd.Series:
        name = self.find(column)
        if name is None and required:
            there = ", ".join(self.frame) or "no columns"
            raise TrustboError(f"{self.what} lacks {column}; it has {there}. Choose or rename one.")
        return pd.Series(np.nan, self.frame.index) if name is None else self.frame[name]


def seconds_of(first: Columns, second: Columns) -> list[np.ndarray]:
    """Return the times `t` of two tables, each (row,), in s.

    Raises TrustboError if the times are not in seconds, or the tables do not share a clock.
    """
    times = [table.numbers("t", blank=False) for table in (first, second)]
    spans = [f"{t.min():.9g} to {t.max():.9g} s" for t in times]
    if np.ptp(times[0]) > 7 * 86_400.0 or np.abs(times[0]).max() > 1e11:
        raise TrustboError(
            f"times of {first.what} are {spans[0]}; they must be in seconds (divide milliseconds "
            "by 1000) and span at most 7 days."
        )
    inside = ((times[1] >= times[0].min()) & (times[1] <= times[0].max())).mean()
    if inside < 0.5:
        raise TrustboError(
            f"only {inside:.0%} of the times of {second.what} ({spans[1]}) are within the range of "
            f"{first.what} ({spans[0]}); check the epoch, unit and time zone of both clocks."
        )
    return times


def require_one_spelling(what: str, names: Iterable[str]) -> None:
    """Raise TrustboError if two names differ only by case, spaces or leading zeros."""
    spelled: dict[str, str] = {}
    for name in dict.fromkeys(names):
        if (other := spelled.setdefault(_folded(name), name)) != name:
            raise TrustboError(f"{what}: {other!r} and {name!r} look alike; use one spelling.")


def _folded(name: str) -> str:
    """Return a name in lower case, without leading zeros and with uniform spaces."""
    spaced = re.sub(r"[\s_-]+", " ", name.casefold()).strip()
    return re.sub(r"(?<![\d.])0+(?=\d)", "", spaced)


def _cell(value: object) -> str | None:
    """Return the text of a cell; None if it is blank."""
    text = str(value).strip()
    return None if text.lower() in _BLANK else text


def _of_file(file: FilePath) -> pd.DataFrame:
    """Read the cells of a CSV file as text; decimal commas need a separator other than a comma."""
    try:
        text = read_file(file).decode("utf-8-sig")
        first, _, rest = text.partition("\n")
        separator = max(",;\t", key=first.count)
        if named := re.fullmatch(r'"?sep=(.)"?\s*', first, re.IGNORECASE):
            separator, text = named[1], rest
        lines = [*csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise TrustboError(
            f"{str(file)!r} cannot be read as CSV in UTF-8: {error}. Close its quotes and save it "
            'as UTF-8, or give a DataFrame, such as pandas.read_csv(file, encoding="cp1252").'
        ) from None
    header, *rows = [line for line in lines if line] or [[]]
    n = len(header)
    for i, row in enumerate(rows, start=1):
        if len(row) < n or any(cell.strip() for cell in row[n:]):
            raise TrustboError(f"row {i} of {str(file)!r} has {len(row)} values, the header {n}.")
        hidden = [line for cell in row for line in cell.splitlines()[1:]]
        if any(line.count(separator) >= n - 1 > 0 for line in hidden):
            raise TrustboError(f"a quote in row {i} of {str(file)!r} is closed in a later row.")
    frame = pd.DataFrame([row[:n] for row in rows], columns=header, dtype=object)
    for name in frame if separator != "," else ():
        commas = [text for text in frame[name] if "," in text]
        if not all(map(_THOUSANDS.fullmatch, commas)):  # else `numbers` refuses them
            frame[name] = frame[name].replace(_DECIMAL_COMMA, r"\1.\2", regex=True)
    return frame
