"""Write the pages of evidence from stored rows; no number on them is typed by hand.

    python benchmarks/tables.py          # writes the pages
    python benchmarks/tables.py --check  # lists pages that differ from their rows

The pages are docs/evidence.md, those in docs/evidence, and the parts of README and of the paper in
docs/paper that stand between two comments. Their texts are in benchmarks/pages. What stands between
double braces there is the name of a function of `FILLED` and its arguments, separated by bars, such
as `{{ mean | changing | all | trustbo }}`. Rows and tables are those in benchmarks/reference. A
test compares the pages with them.
"""

import contextlib
import io
import re
import sys
import tomllib
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path

import numpy as np
import pandas as pd
from common import arguments, parsed
from contact import METHODS, MISSIONS, REFERENCE, SETTINGS
from groups import grounds_of, groups_in, holm, interval, kinds_in, over_worlds, require_group

ROOT = Path(__file__).parents[1]
TEXTS = Path(__file__).parent / "pages"
STORED = Path(__file__).parent / "reference"
MANIFEST = Path(__file__).parent / "provenance.toml"
DOCS = ROOT / "docs"
PARTS = {"readme.md": Path("../README.md"), "joss.md": Path("paper/paper.md")}
"""Pages of which a part is written, relative to docs, by the name of the text."""
BEGIN = "<!-- evidence: written by benchmarks/tables.py -->"
END = "<!-- end of evidence -->"
OURS = "trustbo"
BASELINES = tuple(name for name in METHODS if name != OURS)
TITLES = {"changing": "Changing courses", "one": "One course"}
_LAST = 4
"""Number of missions at the end that have columns of their own."""
MISSING = "(not computed with this version yet)"
_HOLE = re.compile(r"\{\{(.*?)\}\}", re.S)


# --- contact lost: rows ---


def rows_of(setting: str) -> pd.DataFrame:
    """Return the rows of a setting, with the contact lost in all, the first and last missions."""
    return _rows_in(REFERENCE, setting)


@cache
def _rows_in(folder: Path, setting: str) -> pd.DataFrame:
    """Read the rows of a setting once, although a page shows many numbers of them."""
    files = sorted(folder.glob(f"{setting}_*.csv"))
    if not files:
        raise FileNotFoundError(f"there are no rows of the setting {setting!r} in {folder}.")
    rows = pd.concat([pd.read_csv(file) for file in files], ignore_index=True)
    lost = rows[[f"lost_{k + 1}" for k in range(MISSIONS)]].to_numpy()
    arrived = [[sign == "." for sign in status] for status in rows["status"]]
    return rows.assign(
        lost=lost.mean(1),
        first=lost[:, 0],
        last=lost[:, -_LAST:].mean(1),
        arrive=np.mean(arrived, axis=1),
        arrive_first=[mission[0] for mission in arrived],
    )


def settings() -> list[str]:
    """Return the settings of which there are rows."""
    return [setting for setting in SETTINGS if [*REFERENCE.glob(f"{setting}_*.csv")]]


def of_worlds(rows: pd.DataFrame, quantity: str) -> pd.DataFrame:
    """Tabulate a quantity by world, averaged over courses, with a column for each method."""
    wide = rows.pivot_table(quantity, ["world", "kind", "case"], "method", sort=False).dropna()
    return wide[[name for name in METHODS if name in wide]].reset_index()


def difference(table: pd.DataFrame, other: str) -> tuple[float, float, float, float]:
    """Compute the mean of trustbo minus another method, its 95 % interval and its p value."""
    return over_worlds((table[OURS] - table[other]).to_numpy(), table["world"])


def best_of(table: pd.DataFrame) -> str:
    """Return the baseline that loses least on average."""
    return str(table[[name for name in BASELINES if name in table]].mean().idxmin())


def methods_in(table: pd.DataFrame) -> list[str]:
    """Return the methods that a table has columns for."""
    return [name for name in METHODS if name in table]


# --- contact lost: tables ---


def means(setting: str) -> str:
    """Return the mean of each method by group."""
    table = of_worlds(rows_of(setting), "lost")
    methods = methods_in(table)
    rows = [
        [f"{name} ({len(some)})", *(number(some[method].mean()) for method in methods)]
        for name, some in groups_in(table)
    ]
    return markdown(["group (worlds)", *methods], rows)


def differences(setting: str) -> str:
    """Return the differences from each baseline, the best one first, by group."""
    rows = []
    for name, some in groups_in(of_worlds(rows_of(setting), "lost")):
        best = best_of(some)
        others = [other for other in methods_in(some) if other not in (OURS, best)]
        for other in (best, *others):
            *ends, p = difference(some, other)
            label = f"{other} (best)" if other == best else other
            rows.append([f"{name} ({len(some)})", label, interval(*ends), f"{p:.2g}"])
    return markdown(["group (worlds)", "baseline", "difference [95 %]", "p"], rows)


def kinds(setting: str) -> str:
    """Return the means by kind of world, and the differences from the best baseline of each."""
    table = of_worlds(rows_of(setting), "lost")
    methods = methods_in(table)
    rows, p_values = [], []
    for kind, some in kinds_in(table):
        best = best_of(some)
        *ends, p = difference(some, best)
        p_values.append(p)
        means_of = [number(some[method].mean()) for method in methods]
        rows.append([f"{kind} ({len(some)})", *means_of, best, interval(*ends), f"{p:.2g}"])
    for row, p in zip(rows, holm(p_values), strict=True):
        row.append(f"{p:.2g}")
    return markdown(
        ["kind (worlds)", *methods, "best baseline", "difference [95 %]", "p", "p, Holm"], rows
    )


def parts(setting: str) -> str:
    """Return the means of the first mission, and of the last ones, by group."""
    return _pairs(setting, "first", "last", f"first, last {_LAST}", lambda x: number(x))


def arrivals(setting: str) -> str:
    """Return the shares of missions that arrive, of the first ones and of all, by group."""
    return _pairs(setting, "arrive_first", "arrive", "first, all", share)


def _pairs(setting: str, one: str, other: str, title: str, text: Callable[[float], str]) -> str:
    """Return the means of two quantities by group, with a column for each method."""
    rows = rows_of(setting)
    tables = of_worlds(rows, one), of_worlds(rows, other)
    methods = methods_in(tables[0])
    found = []
    for (name, first), (_, second) in zip(*map(groups_in, tables), strict=True):
        cells = [f"{text(first[m].mean())}, {text(second[m].mean())}" for m in methods]
        found.append([f"{name} ({len(first)})", *cells])
    return markdown([title, *methods], found)


# --- contact lost: single numbers ---


def _group(setting: str, group: str, quantity: str = "lost") -> pd.DataFrame:
    """Return the worlds of a group or kind, with a column for each method."""
    require_group(group)
    table = of_worlds(rows_of(setting), quantity)
    found = dict([*groups_in(table), *kinds_in(table)])
    if group not in found:
        raise FileNotFoundError(f"there are no rows of {group!r} in the setting {setting!r}.")
    return found[group]


def mean(setting: str, group: str, method: str) -> str:
    """Return the mean contact lost of a method in a group."""
    return number(_group(setting, group)[method].mean())


def less(setting: str, group: str, other: str) -> str:
    """Return trustbo minus a baseline, or minus the `best` one of the group, with its interval."""
    some = _group(setting, group)
    *ends, p = difference(some, best_of(some) if other == "best" else other)
    return f"{interval(*ends)}, p = {p:.2g}"


def best(setting: str, group: str) -> str:
    """Return the name of the best baseline of a group."""
    return best_of(_group(setting, group))


def arrive(setting: str, group: str, method: str, which: str = "all") -> str:
    """Return the share of missions that arrive, of all or of the `first` ones."""
    column = "arrive_first" if which == "first" else "arrive"
    return share(_group(setting, group, column)[method].mean())


def n_worlds(setting: str, group: str = "all") -> str:
    """Return the number of worlds of a group."""
    return f"{len(_group(setting, group))}"


def n_terrains(setting: str, group: str = "all") -> str:
    """Return the number of terrains of a group."""
    return f"{len(set(grounds_of(_group(setting, group)['world'])))}"


# --- tables of other scripts ---


def stored(name: str, *columns: str) -> str:
    """Return a stored table, or some of its columns."""
    table = _table(name)
    head = list(columns or table.columns)
    return markdown(head, table[head].to_numpy().tolist())


def cell(name: str, row: str, column: str) -> str:
    """Return a cell of a stored table, by the text of its first column."""
    table = _table(name)
    [found] = table.loc[table[table.columns[0]] == row, column]
    return str(found)


def total(name: str, column: str) -> str:
    """Return the sum of a column of whole numbers of a stored table."""
    return f"{_table(name)[column].astype(int).sum()}"


def _table(name: str) -> pd.DataFrame:
    """Read a stored table as texts; columns with the same title are told apart by a number."""
    return pd.read_csv(STORED / "tables" / f"{name}.csv", dtype=str, keep_default_na=False)


def reported(script: str, *files: str) -> str:
    """Return what the `report` of a script prints for stored rows."""
    module = import_module(script)
    rows = [pd.read_csv(STORED / file) for file in files or (f"{script}.csv",)]
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        module.report(*rows)
    return printed.getvalue().strip()


def commit(name: str) -> str:
    """Return the name of an entry of the manifest, and its commit."""
    entry = tomllib.loads(MANIFEST.read_text())[name]
    return f"`{name}`, {entry.get('commit', 'unknown')}"


def source(name: str) -> str:
    """Return with which command and commit an entry of the manifest was computed."""
    entry = tomllib.loads(MANIFEST.read_text())[name]
    part = f"; a part was run again: `{entry['part']}`" if "part" in entry else ""
    return f"Computed by `{entry['run']}` at commit {entry.get('commit', 'unknown')}{part}."


def figure(name: str, alt: str) -> str:
    """Return a figure of docs/figures for light and for dark pages."""
    parts = []
    for suffix, page in (("", "light"), ("-dark", "dark")):
        file = Path("figures", f"{name}{suffix}.png")
        if not (DOCS / file).exists():
            raise FileNotFoundError(f"there is no figure {file}.")
        parts.append(f"```{{image}} {file}\n:alt: {alt}\n:class: only-{page}\n```")
    return "\n".join(parts)


# --- text ---


def number(value: float) -> str:
    """Write a number of bounds."""
    return f"{value:z.3f}"


def share(value: float) -> str:
    """Write a share."""
    return f"{value:.1%}".replace("%", " %")


def markdown(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table."""
    rule = ["---", *("---:" for _ in head[1:])]
    titles = [re.sub(r"\.\d+$", "", title) for title in head]  # pandas numbers equal titles
    lines = [titles, rule, *([str(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


FILLED: dict[str, Callable[..., str]] = {
    "means": means, "differences": differences, "kinds": kinds, "parts": parts,
    "arrivals": arrivals, "mean": mean, "less": less, "best": best, "arrive": arrive,
    "worlds": n_worlds, "terrains": n_terrains, "stored": stored, "cell": cell,
    "reported": reported, "source": source,
    "commit": commit, "total": total, "figure": figure,
}  # fmt: skip
"""Functions that texts of pages can call."""


def filled(text: str) -> str:
    """Return the text of a page with what its functions return, or `MISSING`."""

    def fill(hole: re.Match[str]) -> str:
        name, *given = (part.strip() for part in hole[1].split("|"))
        try:
            return FILLED[name](*given)
        except FileNotFoundError:
            return MISSING

    return _HOLE.sub(fill, text)


def pages() -> Iterator[tuple[Path, str]]:
    """Yield the path of each page, relative to docs, and its text."""
    for file in sorted(TEXTS.rglob("*.md")):
        text = filled(file.read_text())
        page = PARTS.get(file.name)
        if page is None:
            yield file.relative_to(TEXTS), text
        else:
            yield page, between_marks((DOCS / page).read_text(), text)


def between_marks(page: str, text: str) -> str:
    """Return a page with this text between the comments that mark its evidence."""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    return f"{before}{begin}\n{text}{end}{after}"


def stale(folder: Path = DOCS) -> list[str]:
    """Return the pages that differ from their rows."""
    return [
        str(page)
        for page, text in pages()
        if not (folder / page).exists() or (folder / page).read_text() != text
    ]


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--check", action="store_true", help="list pages that are stale")
    given = parsed(parser)
    if given.check:
        found = stale()
        print("\n".join(found) or "all pages are those of their rows")
        sys.exit(bool(found))

    for page, text in pages():
        (DOCS / page).parent.mkdir(parents=True, exist_ok=True)
        (DOCS / page).write_text(text)


if __name__ == "__main__":
    main()
