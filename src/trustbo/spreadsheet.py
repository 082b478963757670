"""Cells of CSV files: text that a spreadsheet would run as a formula is written as text.

A spreadsheet evaluates a cell that begins with `=`, `+`, `-`, `@`, a tab or a line end. Such text
gets a single quote before it (OWASP, CSV injection), and so does text that begins with quotes and
then one of these, so that reading is the inverse of writing. Numbers, such as -0.5, stay numbers.
"""

import csv
import io
import re
from collections.abc import Iterable, Sequence
from typing import Any

import pandas as pd

_RUNS = re.compile("'*[=+\\-@\t\r\n\N{FULLWIDTH EQUALS SIGN}\N{FULLWIDTH PLUS SIGN}"
                   "\N{FULLWIDTH HYPHEN-MINUS}\N{FULLWIDTH COMMERCIAL AT}]")  # fmt: skip


def harmless(text: str) -> str:
    """Escape the text of a cell for writing."""
    return f"'{text}" if _RUNS.match(text) and not _is_number(text) else text


def meant(cell: str) -> str:
    """Invert `harmless`."""
    return cell[1:] if cell.startswith("'") and _RUNS.match(cell) else cell


def rows_as_csv(rows: Iterable[Sequence[object]]) -> str:
    """Rows of a table as the text of a CSV file."""
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerows([harmless(str(cell)) for cell in row] for row in rows)
    return stream.getvalue()


def frame_as_csv(table: pd.DataFrame, *, index: bool = True) -> str:
    """Table of pandas as the text of a CSV file, its header and index too."""
    made = table.rename(columns=_safe, index=_safe).map(_safe)
    made.index.names = [_safe(name) for name in table.index.names]
    return str(made.to_csv(index=index, lineterminator="\n"))


def _safe(value: Any) -> Any:
    return harmless(value) if isinstance(value, str) else value


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
