"""Reader of user tables, with parsers of names, numbers and times."""

import io
import re
import warnings
from collections.abc import Iterable
from os import PathLike
from typing import Any

import numpy as np
import pandas as pd

from trustbo.errors import TrustboError, one_line
from trustbo.files import FilePath, read_file

_SEPARATORS = ",;\t"
_BLANK = ("", "na", "n/a", "#n/a", "#na", "nan", "nat", "none", "null", "<na>")
"""Markers of missing values, in lower case, as written by R, Excel, pandas and SQL."""
_WHOLE = re.compile(r"^(-?\d+)\.0+$")
_DECIMAL_COMMA = re.compile(r"^\s*([+-]?\d*),(\d+)\s*$")
_ZONE = r":.*(?:Z|[+-]\d\d(?::?\d\d)?)$"
"""End of a date with a time zone."""
_LONGEST = 7 * 86_400.0
"""Longest log, s: a longer span means another unit, or an outlier."""


class Columns:
    """Columns of a table by name, without the extra lines of spreadsheets and surveys.

    These are skipped: a line `sep=`, columns without a name, empty rows, and the header rows of a
    survey down to the one with ImportId.

    Attributes:
        what: Name of the table in messages, such as "the table of poses".
        frame: Values; None in blank cells of text. The index is the row, 1 below the header.
    """

    def __init__(self, table: Any, what: str = "the table") -> None:
        """Read a CSV file (commas, semicolons or tabs), or any columns that pandas accepts.

        Raises:
            TrustboError: The file does not exist or is not a table, a column is repeated, or there
                are no rows.
        """
        self.what = what
        frame = _of_file(table) if isinstance(table, str | PathLike) else _of_values(table)
        frame.columns = [str(name).strip() for name in frame.columns]
        frame = frame.loc[:, [not re.fullmatch(r"(Unnamed: \d+)?", n) for n in frame.columns]]
        if not frame.columns.is_unique:
            raise TrustboError(f"{what} repeats a column name: {', '.join(frame.columns)}.")
        frame.index = pd.RangeIndex(1, len(frame) + 1)
        text = [name for name in frame if frame[name].dtype.kind not in "biufM"]
        frame = frame.assign(**{n: frame[n].astype(object).map(_cell).astype(object) for n in text})
        imports = [i for i, row in frame.iloc[:3].iterrows() if "ImportId" in str(row.tolist())]
        self.frame = frame.loc[max(imports, default=0) + 1 :].dropna(how="all")
        if self.frame.empty:
            raise TrustboError(f"{what} has no rows.")

    def texts(self, column: str, *, required: bool = True) -> list[str]:
        """Return a column as text, "" if blank; floats such as 1.0 become 1.

        All are blank if a column that is not `required` is missing.
        """
        cells = self.cells(column, required).astype(object)
        return ["" if pd.isna(cell) else _WHOLE.sub(r"\1", str(cell)) for cell in cells]

    def numbers(
        self, column: str, *, blank: bool = True, whole: bool = False, required: bool = True
    ) -> np.ndarray:
        """Return a column as numbers, (row,); NaN where blank, or if an optional column is missing.

        Raises:
            TrustboError: A value is not a number or is infinite, blank without `blank`, or not
                whole with `whole`.
        """
        cells = self.cells(column, required)
        values = _numbers(cells).to_numpy(float, na_value=np.nan)
        there = cells.notna().to_numpy()
        faults = {
            "is not a finite number; write decimals with a point, and map words to numbers: "
            "frame[column].map({'agree': 6})": np.isinf(values) | np.isnan(values) & there,
            "is blank": np.isnan(values) & (not blank),
            "must be a whole number": whole & (values > np.floor(values)),
        }
        for fault, bad in faults.items():
            if bad.any():
                row, value = self.frame.index[bad][0], one_line(cells.iloc[int(np.argmax(bad))])
                raise TrustboError(f"row {row} of {self.what}: {column} = {value} {fault}.")
        return values

    def cells(self, column: str, required: bool = True) -> pd.Series:
        """Return a column as it is; NaN if one that is not `required` is missing."""
        if column in self.frame:
            return self.frame[column]
        if required:
            there = ", ".join(self.frame)
            raise TrustboError(f"{self.what} has no column {column!r} among {there}; rename one.")
        return pd.Series(np.nan, index=self.frame.index)


def seconds_of(first: Columns, second: Columns) -> list[np.ndarray]:
    """Return times `t` of two tables on one clock, each (row,), s, from the first date if dates.

    Raises:
        TrustboError: Times are neither all numbers nor all dates, numbers cannot be seconds, some
            dates have no time zone, or the times of the two tables do not overlap.
    """
    tables = first, second
    texts = pd.concat([table.cells("t").astype(str) for table in tables])
    if _numbers(texts).notna().any():
        times = [table.numbers("t", blank=False) for table in tables]
    else:
        dates = pd.Series(pd.to_datetime(texts, format="ISO8601", utc=True, errors="coerce"))
        zoned = texts.str.contains(_ZONE, na=False)
        bad = (dates.isna() | (zoned != zoned.iloc[0])).to_numpy()
        if bad.any():
            raise TrustboError(
                f"t = {one_line(texts.to_numpy()[bad][0])}: give the times of both tables in "
                "seconds, or as dates such as 2026-11-24T10:00:00.5Z, all with a time zone or none."
            )
        n = len(first.frame)
        times = np.split((dates - dates.iloc[:n].min()).dt.total_seconds().to_numpy(), [n])
    spans = [f"{t.min():.9g} to {t.max():.9g} s" for t in times]
    for table, t, span in zip(tables, times, spans, strict=True):
        if np.ptp(t) > _LONGEST or np.abs(t).max() > 1e11:
            raise TrustboError(
                f"times of {table.what} are {span}; they must be in seconds (divide milliseconds "
                "by 1000) and span at most 7 days."
            )
    inside = ((times[1] >= times[0].min()) & (times[1] <= times[0].max())).mean()
    message = (
        f"{inside:.0%} of the times of {second.what}, {spans[1]}, are within those of "
        f"{first.what}, {spans[0]}; check the zero, the unit and the time zone of both clocks."
    )
    if not inside:
        raise TrustboError(message)
    if inside < 0.5:
        warnings.warn(message, stacklevel=4)
    return times


def require_one_spelling(what: str, names: Iterable[str]) -> None:
    """Raise TrustboError if two names differ only by case, spaces or leading zeros."""
    spelled: dict[str, str] = {}
    for name in dict.fromkeys(names):
        folded = re.sub(r"[\s_-]+", " ", name.casefold()).strip()
        folded = re.sub(r"(?<![\d.])0+(?=\d)", "", folded)
        if (other := spelled.setdefault(folded, name)) != name:
            raise TrustboError(
                f"{what}: {other!r} and {name!r} look alike: use one spelling, or names that "
                "differ by more than case, spaces or leading zeros."
            )


def _cell(value: object) -> str | None:
    """Return the text of a cell, None if blank."""
    text = str(value).strip()
    return None if text.lower() in _BLANK else text


def _numbers(cells: pd.Series) -> pd.Series:
    """Convert cells to numbers; NaN for a cell that is not a number."""
    return pd.Series(pd.to_numeric(cells, errors="coerce"))


def _of_values(table: Any) -> pd.DataFrame:
    """Make a DataFrame from a DataFrame, a mapping of columns or a structured array."""
    try:
        frame = pd.DataFrame(table)
    except (TypeError, ValueError) as error:
        raise TrustboError(
            f"give the path of a CSV file or a DataFrame; got {one_line(table)}: {error}."
        ) from None
    return frame.reset_index() if any(frame.index.names) else frame.copy()


def _of_file(file: FilePath) -> pd.DataFrame:
    """Read the cells of a CSV file as text; decimal commas need a separator other than a comma."""
    try:
        text = read_file(file).decode("utf-8-sig")
        first, _, rest = text.partition("\n")
        separator = max(_SEPARATORS, key=first.count)
        if named := re.fullmatch(r'"?sep=(.)"?\s*', first, re.IGNORECASE):
            separator, text = named[1], rest
        as_text: Any = {"header": None, "dtype": str, "na_filter": False}
        cells = pd.read_csv(io.StringIO(text), sep=separator, **as_text)
    except (UnicodeDecodeError, pd.errors.EmptyDataError, pd.errors.ParserError) as error:
        raise TrustboError(
            f"{str(file)!r} cannot be read as CSV in UTF-8: {' '.join(str(error).split())}. Save "
            'it as UTF-8, or give a DataFrame, such as pandas.read_csv(file, encoding="cp1252").'
        ) from None
    frame = cells[1:].set_axis(cells.iloc[0], axis=1)
    return frame if separator == "," else frame.replace(_DECIMAL_COMMA, r"\1.\2", regex=True)
