"""List tables, figures and notebooks that the present code may not reproduce.

    python scripts/gate.py                     list them; the exit status is 1 if there are any
    python scripts/gate.py run NAME            run the command of NAME, and record that its results
                                               are those of the present code
    python scripts/gate.py run NAME --part COMMAND
                                               the same, but run only a part of it, whose results
                                               were the same as before

`benchmarks/provenance.toml` states how each table, figure and notebook was computed, with which
commit, and the digest of the code that ran; `benchmarks/closures` names that code (see
`closure.py`). An entry is stale if the content of this code is another one now. Code that its
command does not call does not count, and neither do comments, docstrings and layout.

Entries must cover all files in `FILES`, and all tables of results in README and docs, which are the
Markdown tables with a right-aligned column. `docs/terrain.md#size` stands for all tables of a
section, and `docs/terrain.md#size: cells` for those whose first column with a title has this title.
The pages of the evidence are left out, as `benchmarks/tables.py` writes them from stored files.
"""

import argparse
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

import closure
from check_files import tracked

ROOT = Path(__file__).resolve().parents[1]
MANIFEST = "benchmarks/provenance.toml"
CLOSURES = "benchmarks/closures"
FILES = ("benchmarks/reference/*.csv", "docs/figures/*", "notebooks/*.ipynb")
GENERATED = ("docs/evidence.md", "docs/evidence/*.md")


class Entry(NamedTuple):
    """Results that were computed together."""

    name: str
    shows: tuple[str, ...]
    """Files, and sections or tables of pages."""
    run: str
    """Command that computes them."""
    commit: str = ""
    """Commit of the code that computed them, or with which a part was computed again."""
    digest: str = ""
    """Digest of the code that ran; "" if none was recorded."""
    part: str = ""
    """Command that computed a part of them again with this code; "" if all were computed."""


def main() -> None:
    """List stale entries, or compute entries again."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command")
    run = commands.add_parser("run", help="compute an entry, and record the code that ran")
    run.add_argument("name", metavar="NAME")
    run.add_argument("--part", default="", metavar="COMMAND", help="run this command instead")
    given = parser.parse_args()

    if given.command is not None:
        print(f"{given.name}: {record(ROOT, given.name, given.part)}")
        return

    found = list(faults(ROOT))
    print("\n".join(found) or "all tables, figures and notebooks are of the present code")
    entries = [entry for entry in read_manifest(ROOT) if entry.part]
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
        if reason := why_stale(root, entry):
            yield "\n    ".join([f"{entry.name}: {reason}", *entry.shows, f"run: {entry.run}"])


def read_manifest(root: Path) -> list[Entry]:
    """Return the entries of the manifest."""
    tables = tomllib.loads((root / MANIFEST).read_text())
    fields = [name for name in Entry._fields if name not in ("name", "shows")]
    return [
        Entry(name, tuple(table["shows"]), **{k: table[k] for k in fields if k in table})
        for name, table in tables.items()
    ]


def results_of(root: Path) -> Iterator[str]:
    """Yield the tracked files that show results, and the tables of results on pages."""
    for file in tracked(root):
        if any(fnmatch(file, pattern) for pattern in FILES):
            yield file
        elif any(fnmatch(file, pattern) for pattern in GENERATED):
            continue
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
    """Return whether an item of an entry stands for a result; files may be a pattern."""
    if "#" in shown:  # a section or table of a page, whose title may have brackets
        return result == shown or result.startswith(f"{shown}: ")
    return fnmatch(result, shown)


def why_stale(root: Path, entry: Entry) -> str:
    """Return why an entry is stale, or an empty text if it is not."""
    if not entry.digest:
        return "nobody has recorded the code that computed it"

    called = closure.read(file_of(root, entry.name))
    if closure.digest(root, called) == entry.digest:
        return ""
    changed = changes(root, entry.commit, called)
    if not changed:
        return f"code has changed since {entry.commit}"
    more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
    return f"code has changed since {entry.commit}: {changed[0]}{more}"


def changes(root: Path, commit: str, called: closure.Closure) -> list[str]:
    """Return the functions and modules whose content has changed since a commit, if it is known."""
    changed = []
    for file in called:
        of_file = {file: called[file]}
        done = git(root, "show", f"{commit}:{file}", check=False)
        before = closure.functions_of(done) if done else {}
        after = closure.contents(root, of_file)
        names = [name for name in ("", *sorted(called[file])) if name in before]
        changed += [
            f"{file} {name}".rstrip()
            for name in names
            if before[name] != after.get(f"{file}::{name}")
        ]
    return changed


def file_of(root: Path, name: str) -> Path:
    """Return the file with the closure of an entry."""
    return root / CLOSURES / f"{name}.txt"


def record(root: Path, name: str, part: str = "") -> str:
    """Run the command of an entry, or a part, and record the code that ran; return the commit."""
    entries = {entry.name: entry for entry in read_manifest(root)}
    if name not in entries:
        sys.exit(f"{MANIFEST} has no entry {name!r}; it has {', '.join(entries)}")
    code = [f"{folder}/*.py" for folder in closure.FOLDERS]  # not the results of other entries
    if changes_of_code := git(root, "status", "--porcelain", "--", *code).strip():
        sys.exit(f"commit the code of {name} first; changed are\n{changes_of_code}")

    commit = git(root, "rev-parse", "--short=8", "HEAD").strip()
    called = closure.run_traced(root, part or entries[name].run)
    file = file_of(root, name)
    if part:  # which may not call all that the whole does
        called = closure.joined(closure.read(file), called)
    closure.write(file, called, root)
    fields = {"commit": commit, "digest": closure.digest(root, closure.read(file)), "part": part}
    _write_fields(root / MANIFEST, name, fields)
    return commit


def _write_fields(manifest: Path, name: str, fields: dict[str, str]) -> None:
    """Write fields of an entry below its others; empty ones are left out."""
    before, head, after = manifest.read_text().partition(f"[{name}]\n")
    # Comments above the next entry are not a part of this one.
    own, rest = re.match(r"(.*?)(\n*(?:^#.*\n|\n)*^\[.*|\n*\Z)", after, flags=re.M | re.S).groups()
    own = re.sub(rf"^({'|'.join(fields)}) = .*(\n|\Z)", "", own, flags=re.M).rstrip("\n")
    lines = [f"{key} = {json.dumps(value)}" for key, value in fields.items() if value]
    manifest.write_text(before + head + "\n".join([own, *lines]) + rest)


def git(root: Path, *command: str, check: bool = True) -> str:
    """Return what a command of git prints; if it fails, exit, or return "" without `check`."""
    done = subprocess.run(
        ["git", "-C", str(root), *command], capture_output=True, text=True, check=False
    )
    if done.returncode != 0 and check:
        sys.exit(f"git {command[0]} failed: {done.stderr.strip()}")
    return done.stdout if done.returncode == 0 else ""


if __name__ == "__main__":
    main()
