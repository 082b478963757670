"""Reader for user tables, with parsers for names, numbers and times."""

import csv
import io
import re
from collections.abc import Iterable
from decimal import Decimal, InvalidOperation
from os import PathLike
from typing import Any

import numpy as np
import pandas as pd

from trustbo.errors import TrustboError, composed, one_line, see
from trustbo.files import FilePath, read_file
from trustbo.logs.mapping import ColumnMap, mapped, require_columns

_BLANK = ("", "na", "n/a", "#n/a", "#na", "nan", "nat", "none", "null", "<na>")
"""Markers of missing values, in lower case, as written by R, Excel, pandas and SQL."""
_WHOLE = re.compile(r"^(-?\d+)\.0+$")
_THOUSANDS = re.compile(r"\s*[+-]?[1-9]\d{0,2}(,\d{3})+\s*")
_DECIMAL_COMMA = re.compile(r"^\s*([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)\s*$")
_FORMULA = ("=", "+", "-", "@")
"""First characters of cells that spreadsheets evaluate."""

_OTHER_FILES = {
    b"\x1f\x8b": ("a gzip archive", "pandas.read_csv(file)"),
    b"PK\x03\x04": ("an Excel workbook or a zip archive", "pandas.read_excel(file)"),
    b"\xd0\xcf\x11\xe0": ("an Excel workbook", "pandas.read_excel(file)"),
    b"PAR1\x15": ("a Parquet file", "pandas.read_parquet(file)"),
    b"\xff\xfe": ("text in UTF-16", 'pandas.read_csv(file, encoding="utf-16", sep="\\t")'),
}
"""First bytes of files that are not CSV, what they are, and what reads them."""

_DATES = (
    ", and dates in seconds, with one start for both tables: "
    "(pandas.to_datetime(t) - start).dt.total_seconds()"
)
_ROUNDED_DTYPE = 0.1
"""Spacing of float32 values at the time of a log, s, above which such a column is refused."""
_ROUNDED_VALUES = 16.0
"""The same limit for a column of another type in which every value is a float32."""
_LONGEST = 7 * 86_400.0
"""Longest log, s; longer logs have times in milliseconds."""
_LATEST = 1e11
"""Latest time of a log, s; epochs in milliseconds are later."""


class Columns:
    """Columns of a table by name, without the extra lines of spreadsheets and surveys.

    The following are skipped: a line `sep=`, columns without a name, empty rows, and the header
    rows of a survey down to the one with ImportId. Column names match regardless of case, and
    spaces match underscores.

    Attributes:
        what: Name of the table in messages, such as "the table of poses".
        frame: Table; blank text cells are None. The index counts rows from 1 below the header.
        unread: Names of the columns that the mapping does not name.
    """

    def __init__(
        self,
        table: Any,
        what: str = "the table",
        *,
        columns: ColumnMap | None = None,
        may_be_empty: bool = False,
    ) -> None:
        """Read a CSV file (commas, semicolons or tabs), or any table that pandas accepts.

        Tables of xarray, polars and pyarrow are converted. With `columns`, only these columns are
        read; see `mapping`. Raises TrustboError if a file or value is not a table, a column is
        repeated, or there are no rows although `may_be_empty` is False.
        """
        self.what = what
        is_file = isinstance(table, str | PathLike)
        frame = _of_file(table) if is_file else _of_value(table, what)
        names = frame.index.names
        if any(names):
            frame = frame.drop(columns=[name for name in names if name in frame]).reset_index()

        frame.columns = [composed(str(name).strip()) for name in frame.columns]
        frame = frame.loc[:, [not re.fullmatch(r"(Unnamed: \d+)?", n) for n in frame.columns]]
        if not frame.columns.is_unique:
            raise TrustboError(f"{what} repeats a column name: {', '.join(frame.columns)}.")

        frame.index = pd.RangeIndex(1, len(frame) + 1)
        spans = frame.select_dtypes("timedelta").columns
        frame[spans] = frame[spans] / pd.Timedelta(seconds=1)
        text = frame.select_dtypes(exclude=["number", "bool"]).columns
        frame[text] = frame[text].astype(object).map(_cell).astype(object)

        # Qualtrics exports repeat the header in prose and then as JSON with "ImportId".
        imports = [i for i, row in frame.iloc[:3].iterrows() if "ImportId" in str(row.tolist())]
        self.frame: pd.DataFrame = frame.loc[max(imports, default=0) + 1 :].dropna(how="all")
        if self.frame.empty and not may_be_empty:
            raise TrustboError(f"{what} has no rows.")

        self.unread: list[str] = []
        if columns is not None:
            given = require_columns(columns)
            read = {one["column"] for one in given.values()}
            self.unread = [name for name in self.frame if name not in read]
            self.frame = mapped(self.frame, given, what)

    def find(self, name: str) -> str | None:
        """Return the name of a column as spelled in the table; None if there is no such column."""
        if name in self.frame:
            return name

        alike = [other for other in self.frame if folded(other) == folded(name)]
        if len(alike) > 1:
            raise TrustboError(f"{self.what} has the columns {', '.join(alike)}; rename one.")
        return alike[0] if alike else None

    def refuse(self, column: str, bad: np.ndarray, why: str) -> None:
        """Raise TrustboError for the first value of a column that is marked in `bad`, (row,)."""
        if bad.any():
            row = self.frame.index[bad][0]
            value = self._cells(column).to_numpy(object)[bad][0]
            raise TrustboError(f"row {row} of {self.what}: {column} = {one_line(value)} {why}.")

    def texts(self, column: str, *, blank: bool = True, required: bool = True) -> list[str]:
        """Return a column as text, "" if blank; floats such as 1.0 become 1.

        Raises TrustboError if a required column is missing (others are then blank), or if a value
        is blank although `blank` is False.
        """
        cells = self._cells(column, required).astype(object)
        if not blank:
            self.refuse(column, cells.isna().to_numpy(), "is blank; leave the row out")
        return ["" if pd.isna(cell) else _WHOLE.sub(r"\1", str(cell)) for cell in cells]

    def numbers(
        self,
        column: str,
        *,
        blank: bool = True,
        whole: bool = False,
        required: bool = True,
        hint: str = "",
    ) -> np.ndarray:
        """Return a column as numbers, (row,); NaN where blank, or if an optional column is missing.

        Args:
            column: Name of the column.
            blank: Whether values may be blank.
            whole: Whether values must be whole numbers.
            required: Whether the column must exist.
            hint: End of the message about a value that is not a number.

        Raises:
            TrustboError: A required column is missing, or a value is not a finite number, is blank
                or is not whole.
        """
        cells = self._cells(column, required)
        parsed = pd.Series(pd.to_numeric(cells, errors="coerce"))
        parsed = np.array(parsed.to_numpy(float, na_value=np.nan))

        # Before pandas 3.1, the last digit of a number that is read from text may be wrong.
        is_text = np.array([isinstance(cell, str) for cell in cells], bool) & np.isfinite(parsed)
        parsed[is_text] = [float(cell) for cell in cells[is_text]]

        self.refuse(
            column,
            ~np.isfinite(parsed) & cells.notna().to_numpy(),
            "is not a finite number; write decimals with a point and thousands without a mark"
            + hint,
        )

        if not blank:
            self.refuse(column, np.isnan(parsed), "is blank")
        if whole:
            self.refuse(column, parsed > np.floor(parsed), "must be a whole number")
        return parsed

    def decimals(self, column: str) -> int:
        """Return the number of decimals with which the values of a column are written."""
        cells = self._cells(column).dropna()
        return max((_decimals(cell) for cell in cells), default=0)

    def _cells(self, column: str, required: bool = True) -> pd.Series:
        name = self.find(column)
        if name is None and required:
            there = ", ".join(self.frame) or "no columns"
            raise TrustboError(
                f"{self.what} lacks {column}; it has {there}. Choose or rename one, and "
                f"{see('howto/your-own-robots')}."
            )
        return pd.Series(np.nan if name is None else self.frame[name], self.frame.index)


def seconds_of(first: Columns, second: Columns) -> list[np.ndarray]:
    """Return the times `t` of two tables, each (row,), in s; the second table may be empty.

    Raises TrustboError if the times are not in seconds, or the tables do not share a clock.
    """
    times = [table.numbers("t", blank=False, hint=_DATES) for table in (first, second)]
    for table, t in zip((first, second), times, strict=True):
        _require_precision(table, t)

    span = _span(times[0])
    if np.ptp(times[0]) > _LONGEST or np.abs(times[0]).max() > _LATEST:
        raise TrustboError(
            f"times of {first.what} are {span}; they must be in seconds (divide milliseconds "
            "by 1000) and span at most 7 days."
        )
    if not times[1].size:
        return times

    inside = ((times[1] >= times[0].min()) & (times[1] <= times[0].max())).mean()
    if inside < 0.5:
        raise TrustboError(
            f"only {inside:.0%} of the times of {second.what} ({_span(times[1])}) are within the "
            f"range of {first.what} ({span}); check the epoch, unit and time zone of both clocks."
        )
    return times


def _span(t: np.ndarray) -> str:
    """Describe the range of times."""
    return f"{t.min():.9g} to {t.max():.9g} s"


def _require_precision(table: Columns, t: np.ndarray) -> None:
    """Raise TrustboError if times were rounded to single precision and lost their seconds."""
    if not t.size:
        return
    single = t.astype(np.float32)
    step = float(np.spacing(np.abs(single).max()))
    is_single = table.frame[table.find("t")].dtype == np.float32
    limit = _ROUNDED_DTYPE if is_single else _ROUNDED_VALUES

    if step > limit and np.array_equal(single, t):
        raise TrustboError(
            f"times of {table.what} ({_span(t)}) are rounded to steps of {step:g} s, because they "
            "were stored as float32; use float64, or subtract the start before the conversion."
        )


def require_plain_names(what: str, names: Iterable[str]) -> None:
    """Raise TrustboError for a name that a table cannot hold, or that a spreadsheet evaluates."""
    for name in names:
        if name.startswith(_FORMULA):
            raise TrustboError(f"{what} {name!r}: spreadsheets take it for a formula; rename it.")
        if _cell(name) != name or _WHOLE.match(name):
            raise TrustboError(f"{what} {name!r} would be read as blank or changed; rename it.")


def require_one_spelling(what: str, names: Iterable[str]) -> None:
    """Raise TrustboError if two names differ only by case, spaces or leading zeros."""
    spelled: dict[str, str] = {}
    for name in dict.fromkeys(names):
        other = spelled.setdefault(folded(name), name)
        if other != name:
            raise TrustboError(f"{what}: {other!r} and {name!r} look alike; use one spelling.")


def folded(name: str) -> str:
    """Return a name in lower case, without leading zeros and with uniform spaces."""
    spaced = re.sub(r"[\s_-]+", " ", name.casefold()).strip()
    return re.sub(r"(?<![\d.])0+(?=\d)", "", spaced)


def _cell(value: object) -> str | None:
    """Return the text of a cell; None if it is blank."""
    text = composed(str(value).strip())
    return None if text.lower() in _BLANK else text


def _decimals(cell: Any) -> int:
    """Return the number of decimals of a number, or of its text; 0 if there are none."""
    try:
        exponent = Decimal(str(cell)).as_tuple().exponent
    except InvalidOperation:
        return 0
    return max(-exponent, 0) if isinstance(exponent, int) else 0


def _of_value(table: Any, what: str) -> pd.DataFrame:
    """Convert a table in memory; xarray has `to_dataframe`, polars and pyarrow `to_pandas`."""
    if hasattr(table, "read"):
        raise TrustboError(f"{what} is an open file; give its path, or pandas.read_csv(file).")

    try:
        if not isinstance(table, pd.DataFrame):
            convert = getattr(table, "to_dataframe", None) or getattr(table, "to_pandas", None)
            table = convert() if callable(convert) else table
        frame = pd.DataFrame(table).copy()
    except Exception as error:  # each library raises its own types of errors
        raise TrustboError(
            f"{what} cannot be made from {type(table).__name__} {one_line(table)} "
            f"({one_line(str(error))}); give the path of a CSV file, a DataFrame, or a mapping of "
            "columns of one length."
        ) from None

    if isinstance(table, list | tuple) and any(isinstance(one, str | PathLike) for one in table):
        raise TrustboError(
            f"{what} must be one table; got the list {one_line(table)}. Join the files: "
            "pandas.concat(map(pandas.read_csv, files))."
        )

    return frame.rename_axis(None) if frame.index.names == ["index"] else frame


def _of_file(file: FilePath) -> pd.DataFrame:
    """Read the cells of a CSV file as text; decimal commas need a separator other than a comma."""
    content = read_file(file)
    for start, (kind, reader) in _OTHER_FILES.items():
        if content.startswith(start):
            raise TrustboError(f"{str(file)!r} is {kind}, not a CSV file; give {reader}.")

    try:
        text = content.decode("utf-8-sig")
        first, _, rest = text.partition("\n")
        separator = max(",;\t", key=first.count)
        if named := re.fullmatch(r'"?sep=(.)"?\s*', first, re.IGNORECASE):
            separator = named[1]
            text = rest
        lines = [*csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise TrustboError(
            f"{str(file)!r} cannot be read as CSV in UTF-8: {error}. Close its quotes and save it "
            'as UTF-8, or give a DataFrame, such as pandas.read_csv(file, encoding="cp1252").'
        ) from None

    filled = [line for line in lines if line]
    header, *rows = filled or [[]]
    frame = _rectangle(file, header, rows, separator)
    if separator == ",":
        return frame

    for name in frame:
        commas = [text for text in frame[name] if "," in text]
        if not all(map(_THOUSANDS.fullmatch, commas)):  # otherwise, `numbers` refuses them
            frame[name] = frame[name].replace(_DECIMAL_COMMA, r"\1.\2", regex=True)

    return frame


def _rectangle(
    file: FilePath, header: list[str], rows: list[list[str]], separator: str
) -> pd.DataFrame:
    """Return rows as a table; raises TrustboError for rows that are shifted or hold other rows."""
    n = len(header)
    for i, row in enumerate(rows, start=1):
        if len(row) < n or any(cell.strip() for cell in row[n:]):
            raise TrustboError(f"row {i} of {str(file)!r} has {len(row)} values, the header {n}.")

        hidden = [line for cell in row for line in cell.splitlines()[1:]]
        if any(line.count(separator) >= n - 1 > 0 for line in hidden):
            raise TrustboError(f"a quote in row {i} of {str(file)!r} is closed in a later row.")

    return pd.DataFrame([row[:n] for row in rows], columns=header, dtype=object)
