"""Run notebooks again, and list the stored numbers that a new run does not reproduce.

    python scripts/compare_notebooks.py [--tolerance 0.05] [notebook ...]

Each notebook runs at full size in a temporary folder, and is not changed. The numbers in the text
outputs of each cell are compared in order. Numbers that differ by more than the tolerance, relative
to the largest number in the same line, are printed with their line. The exit status is 1 if there
are any. Monte Carlo results of another processor differ slightly; check whether the text still
agrees with them, and store the new run if it does not.
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
    """Lines of the results of a cell, without warnings and progress, which go to stderr."""
    texts = [
        output.get("text") or output.get("data", {}).get("text/plain", "")
        for output in cell.get("outputs", [])
        if output.get("name") != "stderr"
    ]
    lines = "\n".join(texts).splitlines()
    return [line for line in lines if line.strip() and not line.startswith("<Figure")]


def moved(before: str, after: str, tolerance: float) -> bool:
    """Whether numbers of a line, or the text between them, differ."""
    if NUMBER.sub("", before).split() != NUMBER.sub("", after).split():
        return True
    pairs = [[float(x) for x in NUMBER.findall(line)] for line in (before, after)]
    limit = tolerance * max(map(abs, pairs[0]), default=0.0)
    return len(pairs[0]) != len(pairs[1]) or any(
        abs(old - new) > limit for old, new in zip(*pairs, strict=True)
    )


def compare(path: Path, tolerance: float) -> int:
    """Run a notebook, print the lines that moved, and return their number."""
    stored = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        client = NotebookClient(
            copy.deepcopy(stored), timeout=None, resources={"metadata": {"path": folder}}
        )
        run = client.execute()
    n_moved = 0
    for k, (old, new) in enumerate(zip(stored.cells, run.cells, strict=True)):
        for before, after in zip_longest(lines_of(old), lines_of(new), fillvalue=""):
            if moved(before, after, tolerance):
                n_moved += 1
                print(f"{path.name}, cell {k}\n  stored: {before}\n  now:    {after}")
    print(f"{path.name}: {n_moved} lines moved", flush=True)
    return n_moved


def main() -> None:
    """Compare all given notebooks, by default those of the repository."""
    parser = argparse.ArgumentParser(description="Run notebooks again.")
    parser.add_argument("notebooks", nargs="*", type=Path, metavar="notebook")
    parser.add_argument("--tolerance", type=float, default=0.05, help="relative, default 0.05")
    given = parser.parse_args()
    notebooks = given.notebooks or sorted((ROOT / "notebooks").glob("*.ipynb"))
    sys.exit(any([compare(path, given.tolerance) > 0 for path in notebooks]))


if __name__ == "__main__":
    main()
