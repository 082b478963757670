"""List tables, figures and notebooks that the present code may not reproduce.

    python scripts/gate.py              list them; the exit status is 1 if there are any
    python scripts/gate.py stamp NAME   record that NAME was computed with the present commit
    python scripts/gate.py same NAME --part COMMAND
                                        record that COMMAND, a part of NAME, gives the same results
                                        as before the change of the code

`benchmarks/provenance.toml` states from which commit each table, figure and notebook comes, and
which code it measures. An entry is stale if this code has changed since the commit. Changes of
comments, docstrings and the layout of Python code do not count: the syntax trees are compared. All
other files count if any byte has changed.

Entries must cover all files in `FILES`, and all tables of results in README and docs, which are the
Markdown tables with a right-aligned column. `docs/worlds.md#the-tables` stands for all tables of a
section, and `docs/worlds.md#the-tables: kind (worlds)` for those whose first column, of the columns
with a title, has this title.
"""

import argparse
import ast
import functools
import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from fnmatch import fnmatch
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from check_files import tracked

ROOT = Path(__file__).resolve().parents[1]
MANIFEST = "benchmarks/provenance.toml"
FILES = ("benchmarks/reference/*.csv", "docs/figures/*", "notebooks/*.ipynb")
UNKNOWN = "unknown"


class Entry(NamedTuple):
    """Results that were computed together."""

    name: str
    shows: tuple[str, ...]
    """Files, and sections or tables of pages."""
    run: str
    """Command that computes them."""
    commit: str
    code: tuple[str, ...]
    """Pathspecs of git; empty for results of earlier versions, which do not become stale."""
    same: str = ""
    """Later commit with which a part of them was computed again, and equal; "" if there is none."""
    part: str = ""
    """Command that computes this part."""

    @property
    def checked(self) -> str:
        """Last commit that gives these results, as far as it was checked."""
        return self.same or self.commit


def main() -> None:
    """List stale entries, or stamp entries."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command")
    stamped = commands.add_parser("stamp", help="write the present commit into entries")
    same = commands.add_parser("same", help="record that a part was computed again, and is equal")
    for command in (stamped, same):
        command.add_argument("names", nargs="+", metavar="NAME")
    stamped.set_defaults(part="")
    same.add_argument("--part", required=True, metavar="COMMAND", help="what was run")
    given = parser.parse_args()

    if given.command is not None:
        for name in given.names:
            print(f"{name}: {stamp(ROOT, name, given.part)}")
        return

    found = list(faults(ROOT))
    print("\n".join(found) or "all tables, figures and notebooks are of the present code")
    entries = [entry for entry in read_manifest(ROOT) if entry.same]
    for part in dict.fromkeys(entry.part for entry in entries):
        names = [entry.name for entry in entries if entry.part == part]
        print(f"of {', '.join(names)}, only a part was run again: {part}")
    sys.exit(bool(found))


def faults(root: Path) -> Iterator[str]:
    """Yield one line for each entry that is stale, and for each result without an entry."""
    entries = read_manifest(root)
    results = list(results_of(root))
    for result in results:
        if not any(covers(shown, result) for entry in entries for shown in entry.shows):
            yield f"{result}: has no commit; add it to {MANIFEST}"

    for entry in entries:
        for shown in entry.shows:
            if not any(covers(shown, result) for result in results):
                yield f"{entry.name}: {shown} does not exist"
        for path in entry.code:
            if not git(root, "ls-files", "--", path):
                yield f"{entry.name}: there is no code in {path}"
        if reason := why_stale(root, entry):
            yield "\n    ".join([f"{entry.name}: {reason}", *entry.shows, f"run: {entry.run}"])


def read_manifest(root: Path) -> list[Entry]:
    """Return the entries of the manifest, in whose code the names of groups are replaced."""
    tables = tomllib.loads((root / MANIFEST).read_text())
    groups = tables.pop("code")
    return [
        Entry(
            name=name,
            shows=tuple(table["shows"]),
            run=table["run"],
            commit=table["commit"],
            code=tuple(path for item in table["code"] for path in groups.get(item, [item])),
            same=table.get("same", ""),
            part=table.get("part", ""),
        )
        for name, table in tables.items()
    ]


def results_of(root: Path) -> Iterator[str]:
    """Yield the tracked files that show results, and the tables of results on pages."""
    for file in tracked(root):
        if any(fnmatch(file, pattern) for pattern in FILES):
            yield file
        elif file == "README.md" or fnmatch(file, "docs/*.md"):
            yield from tables_of(file, (root / file).read_text())


def tables_of(page: str, text: str) -> Iterator[str]:
    """Yield the tables of results of a page, as page, section and title of the first column."""
    section = ""
    prose = re.sub(r"^```.*?^```", "", text, flags=re.S | re.M)
    for head, rule in pairwise(prose.splitlines()):
        if head.startswith("#"):
            section = re.sub(r"[^\w\- ]", "", head.lstrip("# ").lower()).replace(" ", "-")
        if re.fullmatch(r"\|[\s:|-]+-:\s*\|[\s:|-]*", rule):
            titles = [title.strip() for title in head.split("|") if title.strip()]
            yield f"{page}#{section}: {titles[0]}"


def covers(shown: str, result: str) -> bool:
    """Return whether an item of an entry stands for a result."""
    return result == shown or result.startswith(f"{shown}: ")


def why_stale(root: Path, entry: Entry) -> str:
    """Return why an entry is stale, or an empty text if it is not."""
    if entry.commit == UNKNOWN:
        return "nobody has recorded with which commit it was computed"

    in_history = subprocess.run(
        ["git", "-C", str(root), "merge-base", "--is-ancestor", entry.checked, "HEAD"],
        capture_output=True,
        check=False,
    )
    if in_history.returncode != 0:
        return (
            f"commit {entry.checked} is not in the history of HEAD; compute it again, or fetch the "
            "whole history if this is a shallow clone"
        )

    changed = [] if not entry.code else changed_files(root, entry)
    if not changed:
        return ""
    more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
    return f"code has changed since {entry.checked}: {changed[0]}{more}"


def changed_files(root: Path, entry: Entry) -> list[str]:
    """Return the files of an entry whose code differs between its commit and the working tree."""
    command = ("diff", "--name-only", "--no-renames", "-z", entry.checked, "--", *entry.code)
    names = git(root, *command).split("\0")
    return [name for name in names if name and not same_code(root, entry.checked, name)]


@functools.cache
def same_code(root: Path, commit: str, name: str) -> bool:
    """Return whether a file that has changed since a commit has the same code as before."""
    file = root / name
    was_there = bool(git(root, "ls-tree", "--name-only", commit, "--", name))
    if file.suffix != ".py" or not file.exists() or not was_there:
        return False
    return code_of(git(root, "show", f"{commit}:{name}")) == code_of(file.read_text())


def code_of(text: str) -> str:
    """Return the syntax tree of Python code without docstrings."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):  # also texts below constants and fields, which describe them
            node.body = [part for part in body if not is_text(part)]
    return ast.dump(tree)


def is_text(node: ast.AST) -> bool:
    """Return whether a statement is a text alone."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def stamp(root: Path, name: str, part: str = "") -> str:
    """Write the present commit into an entry of the manifest, and return the commit.

    If only a `part` was computed again, the entry keeps the commit of its results.
    """
    entries = {entry.name: entry for entry in read_manifest(root)}
    if name not in entries:
        sys.exit(f"{MANIFEST} has no entry {name!r}; it has {', '.join(entries)}")
    code = entries[name].code
    changes = git(root, "status", "--porcelain", "--", *code) if code else ""
    if changes:
        sys.exit(f"commit the code of {name} first, and compute it again; changed are\n{changes}")

    commit = git(root, "rev-parse", "--short=8", "HEAD").strip()
    before, head, after = (root / MANIFEST).read_text().partition(f"[{name}]\n")
    own, rest = re.match(r"(.*?)(^\[.*|\Z)", after, flags=re.S | re.M).groups()
    own = re.sub(r"^(same|part) = .*\n", "", own, flags=re.M)
    lines = f'commit = "{commit}"'
    if part:
        lines = f'commit = "{entries[name].commit}"\nsame = "{commit}"\npart = {json.dumps(part)}'
    own = re.sub(r'^commit = ".*"(?: *#.*)?$', lambda _: lines, own, count=1, flags=re.M)
    (root / MANIFEST).write_text(before + head + own + rest)
    return commit


def git(root: Path, *command: str) -> str:
    """Return what a command of git prints."""
    done = subprocess.run(
        ["git", "-C", str(root), *command], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        sys.exit(f"git {command[0]} failed: {done.stderr.strip()}")
    return done.stdout


if __name__ == "__main__":
    main()
