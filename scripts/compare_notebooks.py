"""Run notebooks again, and list stored numbers and numbers in their text that do not agree.

    python scripts/compare_notebooks.py [--tolerance 0.05] [notebook ...]

Each notebook runs at full size in a temporary folder, and its file is not changed. `make gate` runs
this script, whose exit status is 1 if it lists anything.

Outputs: the script compares the numbers in the text outputs of each cell in order. It prints lines
in which a number differs by more than the tolerance. The tolerance of whole numbers is relative to
the number, and that of other numbers is relative to the largest of these in the line. Monte Carlo
results differ slightly between processors. Check whether the text of the notebook agrees with the
new results, and store the new run if it does not.

Text: each number in a Markdown cell must be a number that the new run prints, or a number in the
code, when both are rounded to the digits of the text. Signs do not count, and "40 %" also agrees
with 0.4. Addresses of links, arXiv numbers and numbers in words ("eight missions") are not checked.
A number that can only be read from a figure is listed: print it.
"""

import argparse
import copy
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from decimal import Decimal
from itertools import zip_longest
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

ROOT = Path(__file__).resolve().parents[1]
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?(?![\w.]*\w)")
NO_RESULT = re.compile(r"\]\([^)]*\)|https?://\S+|arXiv[:\s]\s*[\d.]+|(?<=\d) (?=\d{3}\b)")
"""Parts of a text whose numbers are no results, and the blank in 50 000."""


def lines_of(cell: nbformat.NotebookNode) -> list[str]:
    """Return the lines of the results of a cell, without stderr (warnings and progress bars)."""
    texts = [
        output.get("text") or output.get("data", {}).get("text/plain", "")
        for output in cell.get("outputs", [])
        if output.get("name") != "stderr"
    ]
    lines = "\n".join(texts).splitlines()
    return [line for line in lines if line.strip() and not line.startswith("<Figure")]


def differ(before: str, after: str, tolerance: float) -> bool:
    """Return whether the numbers of two lines, or the text between the numbers, differ."""
    if NUMBER.sub("", before).split() != NUMBER.sub("", after).split():
        return True

    old = NUMBER.findall(before)
    new = NUMBER.findall(after)
    if len(old) != len(new):
        return True
    largest = max((abs(float(x)) for x in old if not is_whole(x)), default=0.0)
    for x, y in zip(old, new, strict=True):
        scale = abs(float(x)) if is_whole(x) else largest
        if abs(float(x) - float(y)) > tolerance * scale:
            return True
    return False


def is_whole(number: str) -> bool:
    """Return whether a number has no decimal point, such as a count or the index of a row."""
    return number.lstrip("+-").isdecimal()


def unshown(notebook: nbformat.NotebookNode) -> Iterator[tuple[str, str]]:
    """Yield each number of the text that no output and no code contains, with its line."""
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    texts = [text for cell in code for text in (cell.source, *lines_of(cell))]
    shown = [abs(float(x)) for text in texts for x in NUMBER.findall(text)]

    for cell in notebook.cells:
        if cell.cell_type != "markdown":
            continue
        for line in NO_RESULT.sub("", cell.source).splitlines():
            for found in NUMBER.finditer(line):
                is_percent = line[found.end() :].lstrip().startswith("%")
                values = shown + [100.0 * x for x in shown] if is_percent else shown
                if not any(agrees(found[0], x) for x in values):
                    yield found[0], line


def agrees(number: str, value: float) -> bool:
    """Return whether a positive value, rounded to the digits of a number in a text, is equal."""
    half = 0.5 * 10.0 ** Decimal(number).as_tuple().exponent
    return abs(abs(float(number)) - value) <= half * (1.0 + 1e-9)


def compare(path: Path, tolerance: float) -> int:
    """Run a notebook, print the lines that do not agree, and return how many there are."""
    stored = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        client = NotebookClient(
            copy.deepcopy(stored), timeout=None, resources={"metadata": {"path": folder}}
        )
        try:
            run = client.execute()
        except CellExecutionError as error:
            print(f"{path.name} fails: {error}", flush=True)
            return 1

    n_different = 0
    for k, (old, new) in enumerate(zip(stored.cells, run.cells, strict=True)):
        for before, after in zip_longest(lines_of(old), lines_of(new), fillvalue=""):
            if differ(before, after, tolerance):
                n_different += 1
                print(f"{path.name}, cell {k}\n  stored: {before}\n  now:    {after}")
    n_unshown = 0
    for number, line in unshown(run):
        n_unshown += 1
        print(f"{path.name}: nothing shows the number {number} of the text\n  {line}")
    print(f"{path.name}: {n_different} lines differ, {n_unshown} numbers not shown", flush=True)
    return n_different + n_unshown


def main() -> None:
    """Compare the given notebooks; by default, all notebooks of the repository."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("notebooks", nargs="*", type=Path, metavar="notebook")
    parser.add_argument("--tolerance", type=float, default=0.05, help="relative (default 0.05)")
    given = parser.parse_args()

    os.environ.pop("TRUSTBO_FAST", None)  # which makes notebooks run fewer missions
    notebooks = given.notebooks or sorted((ROOT / "notebooks").glob("*.ipynb"))
    sys.exit(any([compare(path, given.tolerance) > 0 for path in notebooks]))


if __name__ == "__main__":
    main()
