"""Arguments, timer, tables and kept records of the benchmark scripts."""

import argparse
import csv
import json
import os
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from trustbo.study.world import World


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
    """Parser of the arguments that scripts share; a script adds those that it alone has.

    Args:
        doc: Docstring of the script.
        quick: Effect of --quick; without it, the script has no short trial.
        data: Whether the script reads real terrains; --data is `TRUSTBO_DATA` by default.
        names: Parts of the script that can be chosen; all by default.
        n: Default of -n, the number of cases.
        seeds: Default of --seeds.
        out: Default of --out, where results are kept.
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
    return parser


def parsed(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Arguments of this call, with the chosen names checked and the data as a folder."""
    given = parser.parse_args()
    if choices := getattr(given, "choices", None):
        for name in given.names:
            if name not in choices:
                parser.error(f"unknown name {name!r}; choose some of {', '.join(choices)}")
        given.names = given.names or choices
    if getattr(given, "data", None) is not None:
        given.data = Path(given.data)
    return given


# --- timer ---


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of a call, and its result."""
    started = time.perf_counter()
    result = work()
    return time.perf_counter() - started, result


def median_seconds(work: Callable[[], object], n: int = 5) -> float:
    """Median seconds of n calls, after one that compiles."""
    work()
    return statistics.median(timed(work)[0] for _ in range(n))


def median_processor_seconds(work: Callable[[], object], n: int = 3) -> float:
    """The same of processor seconds, which other work on the machine lengthens less."""
    work()
    seconds = []
    for _ in range(n):
        started = time.process_time()
        work()
        seconds.append(time.process_time() - started)
    return statistics.median(seconds)


def verdict(met: bool) -> str:
    """Word for a target that is met or missed."""
    return "yes" if met else "NO"


def faster(theirs: float, ours: float, least: float | None = None) -> str:
    """Ratio of two times and, where there is a target, whether it is met."""
    text = f"{theirs / ours:.1f} x"
    return (
        text if least is None else f"{text} (target {least:g} x: {verdict(theirs >= least * ours)})"
    )


# --- tables ---


class Table:
    """Markdown table, printed row by row; it can be written as CSV."""

    def __init__(self, *columns: str, first: int = 0, others: int = 0) -> None:
        """Print the head; `first` and `others` are the least widths of the columns."""
        self.columns, self.rows = columns, []
        self._widths = [first, *(others for _ in columns[1:])]
        self._print(columns)
        self._print(("---", *("---:" for _ in columns[1:])))

    def row(self, *cells: object) -> None:
        """Print a row."""
        self.rows.append(cells)
        self._print(cells)

    def write(self, file: Path) -> None:
        """Write the table as CSV."""
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("w", newline="") as stream:
            csv.writer(stream).writerows([self.columns, *self.rows])

    def _print(self, cells: Iterable[object]) -> None:
        texts = [
            f"{cell!s:<{width}}" if i == 0 else f"{cell!s:>{width}}"
            for i, (cell, width) in enumerate(zip(cells, self._widths, strict=True))
        ]
        print(f"| {' | '.join(texts)} |", flush=True)


# --- records that a script goes on from ---


def read_records(file: Path) -> list[Any]:
    """Records that a file of JSON lines has so far; none where there is no file."""
    return [json.loads(line) for line in file.open()] if file.exists() else []


def add_record(file: Path, record: object) -> None:
    """Append a record to a file of JSON lines."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a") as stream:
        stream.write(json.dumps(record) + "\n")


def records_of(
    file: Path,
    worlds: "Iterable[World]",
    courses: Sequence[str],
    n: int,
    measure: "Callable[[World, str, int], dict[str, Any]]",
) -> list[dict[str, Any]]:
    """Records of a campaign of n missions for each course and world; what is kept is not redone.

    Args:
        file: File of JSON lines, of records with "world", "course" and "n".
        worlds: Worlds.
        courses: Names of courses.
        n: Missions of a campaign.
        measure: Drives one campaign; its record.
    """
    names = {world.name: world for world in worlds}
    done = {(r["world"], r["course"], r["n"]) for r in read_records(file)}
    for course in courses:
        for name, world in names.items():
            if (name, course, n) not in done:
                add_record(file, measure(world, course, n))
                print(f"{name}, {course}", flush=True)
    return [
        r for r in read_records(file)
        if r["n"] == n and r["world"] in names and r["course"] in courses
    ]  # fmt: skip
