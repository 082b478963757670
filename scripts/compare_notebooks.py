"""Run notebooks again, and list stored numbers that the new run does not reproduce.

    python scripts/compare_notebooks.py [--tolerance 0.05] [notebook ...]

Each notebook runs at full size in a temporary folder, and its file is not changed. The script
compares the numbers in the text outputs of each cell in order. It prints lines in which a number
differs by more than the tolerance, relative to the largest number in the line. The exit status is 1
if there are such lines. Monte Carlo results differ slightly between processors. Check whether the
text of the notebook agrees with the new results, and store the new run if it does not.
"""

import argparse
import copy
import re
import sys
import tempfile
from itertools import zip_longest
from pathlib import Path

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[1]
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?(?![\w.]*\w)")


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
    pairs = [[float(x) for x in NUMBER.findall(line)] for line in (before, after)]
    limit = tolerance * max(map(abs, pairs[0]), default=0.0)
    return len(pairs[0]) != len(pairs[1]) or any(
        abs(old - new) > limit for old, new in zip(*pairs, strict=True)
    )


def compare(path: Path, tolerance: float) -> int:
    """Run a notebook, print the lines that differ, and return how many there are."""
    stored = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        client = NotebookClient(
            copy.deepcopy(stored), timeout=None, resources={"metadata": {"path": folder}}
        )
        run = client.execute()
    n_different = 0
    for k, (old, new) in enumerate(zip(stored.cells, run.cells, strict=True)):
        for before, after in zip_longest(lines_of(old), lines_of(new), fillvalue=""):
            if differ(before, after, tolerance):
                n_different += 1
                print(f"{path.name}, cell {k}\n  stored: {before}\n  now:    {after}")
    print(f"{path.name}: {n_different} lines differ", flush=True)
    return n_different


def main() -> None:
    """Compare the given notebooks; by default, all notebooks of the repository."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("notebooks", nargs="*", type=Path, metavar="notebook")
    parser.add_argument("--tolerance", type=float, default=0.05, help="relative (default 0.05)")
    given = parser.parse_args()
    notebooks = given.notebooks or sorted((ROOT / "notebooks").glob("*.ipynb"))
    sys.exit(any([compare(path, given.tolerance) > 0 for path in notebooks]))


if __name__ == "__main__":
    main()
