"""Command-line arguments, timing and tables shared by the benchmark scripts."""

import argparse
import csv
import io
import os
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any


def arguments(
    doc: str,
    *,
    quick: str = "",
    data: bool = False,
    names: Iterable[str] = (),
    n: int | None = None,
    seeds: int | None = None,
    out: str = "",
) -> argparse.ArgumentParser:
    """Make a parser with the arguments that scripts share; a script adds its own arguments.

    Args:
        doc: Docstring of the script.
        quick: Help text of --quick; if empty, the script has no such argument.
        data: Whether the script reads data; the default of --data is `TRUSTBO_DATA`.
        names: Parts of the script that can be selected; by default, all of them run.
        n: Default of -n, the number of cases.
        seeds: Default of --seeds, the number of seeds.
        out: Default of --out, the folder of the results.
    """
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if names := list(names):
        parser.add_argument("names", nargs="*", metavar="name", help=f"some of {', '.join(names)}")
        parser.set_defaults(choices=names)
    if n is not None:
        parser.add_argument("-n", type=int, default=n, help=f"number of cases, default {n}")
    if seeds is not None:
        parser.add_argument("--seeds", type=int, default=seeds, help=f"default {seeds}")
    if out:
        parser.add_argument("--out", type=Path, default=Path(out), help=f"default {out}")
    if data:
        parser.add_argument("--data", type=Path, default=os.environ.get("TRUSTBO_DATA"),
                            help="folder of the real terrains")  # fmt: skip
    if quick:
        parser.add_argument("--quick", action="store_true", help=quick)
    parser.add_argument("--store", type=Path, metavar="DIR",
                        help="folder for the tables of the evidence, as CSV")  # fmt: skip
    return parser


def parsed(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Parse the arguments of this process; check the selected names, and make --data a path.

    With --store, tables that have a name are written to this folder. From now on, the script ends
    without a traceback if nothing reads its output any more.
    """
    given = parser.parse_args()
    _end_quietly_without_reader()

    if choices := getattr(given, "choices", None):
        for name in given.names:
            if name not in choices:
                parser.error(f"unknown name {name!r}; choose from {', '.join(choices)}")
        given.names = given.names or choices
    if getattr(given, "data", None) is not None:
        given.data = Path(given.data)
    Table.folder = given.store
    return given


def _end_quietly_without_reader() -> None:
    """End this process with one line if a pipe is broken, as in `python groups.py | head`."""

    def on_error(kind: type[BaseException], error: BaseException, trace: Any) -> None:
        if not issubclass(kind, BrokenPipeError):
            sys.__excepthook__(kind, error, trace)
            return

        # Python writes the rest of its buffer when it exits; see the documentation of `signal`.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        print(f"stopped: {error}", file=sys.stderr)

    sys.excepthook = on_error
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)  # so that it is `print` that fails


# --- timer ---


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Call a function; return the elapsed time in seconds, and the result."""
    started = time.perf_counter()
    result = work()
    return time.perf_counter() - started, result


# --- tables ---


class Table:
    """Markdown table that is printed row by row, and is stored as CSV if it has a name."""

    folder: Path | None = None
    """Folder of stored tables; None to store none."""

    def __init__(self, *columns: str, name: str = "", first: int = 0, others: int = 0) -> None:
        """Print the header; `first` and `others` are the minimum widths of the columns."""
        self.name, self.columns, self.rows = name, columns, []
        self._widths = [first, *(others for _ in columns[1:])]
        self._print(columns)
        self._print(("---", *("---:" for _ in columns[1:])))

    def row(self, *cells: object) -> None:
        """Print a row."""
        self.rows.append(cells)
        self._print(cells)
        if self.name and self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
            with (self.folder / f"{self.name}.csv").open("w", newline="") as stream:
                csv.writer(stream, lineterminator="\n").writerows([self.columns, *self.rows])

    def _print(self, cells: Iterable[object]) -> None:
        texts = [
            f"{cell!s:<{width}}" if i == 0 else f"{cell!s:>{width}}"
            for i, (cell, width) in enumerate(zip(cells, self._widths, strict=True))
        ]
        print(f"| {' | '.join(texts)} |", flush=True)
