"""Check which files are tracked and what they contain.

    python scripts/check_files.py

`make lint` runs this script, which takes seconds. It lists

- files outside the folders of the project, or of a kind that does not belong into their folder;
- files that are larger than usual for their kind;
- notebooks that were saved with an error, or whose cells were not run once from top to bottom;
- paths of a single machine, and hosts of package registries.

The exit status is 1 if there are such files.
"""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

TOP_FILES = {
    *(".gitignore", ".pre-commit-config.yaml", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md"),
    *("LICENSE", "Makefile", "README.md", "conftest.py", "constraints.txt", "pyproject.toml"),
}
KINDS = {
    ".ci": {""},
    "benchmarks": {".csv", ".md", ".py", ".toml", ".txt"},
    "docs": {".bib", ".css", ".md", ".png", ".py", ".rst"},
    "examples": {".py", ".sh", ".toml", ".txt"},
    "notebooks": {".ipynb"},
    "scripts": {".py", ".sh"},
    "src": {".html", ".md", ".py", ".pyi", ".tif", ".typed"},
    "tests": {".json", ".md", ".npz", ".py", ".tif", ".yaml"},
}
"""Kinds of files, by the folder in which they may be tracked."""

MOST_KB = {".ipynb": 1000, ".png": 300, ".tif": 250}
"""Largest size in kB of files that are not text alone."""
MOST_KB_OF_TEXT = 100

MACHINE_PATH = re.compile(
    r"(?<![\w.~-])/(?:home|Users|root|work|tmp|mnt|scratch)/\w[^\s\"'`)]*|\b[A-Z]:\\+Users\b"
)
REGISTRY = re.compile(r"index[-_]url|trusted[-_]host|//[^/\s]+/(?:[^/\s]+/)*simple\b", flags=re.I)


def main() -> None:
    """Print all faults of the tracked files."""
    found = list(faults(ROOT))
    print("\n".join(found) or "the tracked files are in order")
    sys.exit(bool(found))


def faults(root: Path) -> Iterator[str]:
    """Yield one line for each fault of a tracked file."""
    for name in tracked(root):
        for fault in faults_of(root, name):
            yield f"{name}: {fault}"


def tracked(root: Path) -> list[str]:
    """Return the tracked files that exist, as paths relative to the root of the repository."""
    command = ["git", "-C", str(root), "ls-files", "-z"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"the files can only be checked in a clone: {done.stderr.strip()}")
    return [name for name in done.stdout.split("\0") if name and (root / name).exists()]


def faults_of(root: Path, name: str) -> Iterator[str]:
    """Yield what is wrong with a file."""
    file = Path(name)
    if len(file.parts) == 1:
        known = name in TOP_FILES
    else:
        known = file.suffix in KINDS.get(file.parts[0], ())
    if not known:
        yield "is not of a kind that belongs here; if it does, add it to scripts/check_files.py"

    content = (root / name).read_bytes()
    most = MOST_KB.get(file.suffix, MOST_KB_OF_TEXT)
    if len(content) > 1000 * most:
        yield f"has {len(content) / 1000:.0f} kB, but files of its kind may have {most} kB"

    try:
        text = content.decode()
    except UnicodeDecodeError:
        return  # images and rasters
    if file.suffix == ".ipynb":
        yield from faults_of_notebook(text)
    for number, line in enumerate(text.splitlines(), start=1):
        if line.lstrip().startswith('"image/'):  # encoded, and may contain anything
            continue
        if found := MACHINE_PATH.search(line):
            yield f"line {number} contains the path {found[0]} of a single machine"
        if found := REGISTRY.search(line):
            yield f"line {number} names a registry of packages ({found[0]})"


def faults_of_notebook(text: str) -> Iterator[str]:
    """Yield stored errors, and whether cells were not run once in order."""
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    for output in (output for cell in cells for output in cell["outputs"]):
        if output["output_type"] == "error":
            yield f"was saved with the error {output['ename']}"

    counts = [cell["execution_count"] for cell in cells if "".join(cell["source"]).strip()]
    if counts != list(range(1, len(counts) + 1)):
        yield f"was not run once from top to bottom; its cells have the numbers {counts}"


if __name__ == "__main__":
    main()
