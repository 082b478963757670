"""Write the pages of docs/evidence from stored rows; no number on them is typed by hand.

    python benchmarks/tables.py          # writes the pages
    python benchmarks/tables.py --check  # lists pages that differ from their rows

Rows are those in benchmarks/reference. A test compares the pages with them.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from common import arguments, parsed
from contact import METHODS, MISSIONS, REFERENCE, SETTINGS
from groups import GROUPS, KINDS, clustered, grounds_of

PAGES = Path(__file__).parents[1] / "docs" / "evidence"
OURS = "trustbo"
BASELINES = tuple(name for name in METHODS if name != OURS)
TITLES = {"changing": "Changing courses", "one": "One course"}
_LAST = 4
"""Number of missions at the end that have columns of their own."""


# --- rows ---


def rows_of(setting: str) -> pd.DataFrame:
    """Read the rows of a setting, with the contact lost in all, the first and the last missions."""
    files = sorted(REFERENCE.glob(f"{setting}_*.csv"))
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


def of_worlds(rows: pd.DataFrame, quantity: str) -> pd.DataFrame:
    """Tabulate a quantity by world, averaged over courses, with a column for each method."""
    wide = rows.pivot_table(quantity, ["world", "kind", "case"], "method", sort=False).dropna()
    return wide[[name for name in METHODS if name in wide]].reset_index()


def groups_in(table: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the groups of worlds, with limits too high and too low apart, and the kinds."""
    is_limit = table["kind"] == "limit"
    is_low = table["case"].str.contains("low")
    chosen = {name: table["kind"].isin(kinds) for name, kinds in GROUPS.items()}
    chosen |= {"limit too high": is_limit & ~is_low, "limit too low": is_limit & is_low}
    chosen |= {f"kind {kind}": table["kind"] == kind for kind in KINDS if kind != "limit"}
    for name, some in chosen.items():
        if some.any():
            yield name, table[some]


def difference(table: pd.DataFrame, other: str) -> tuple[float, float, float, float]:
    """Compute the mean of trustbo minus another method, its 95 % interval and its p value.

    The t test is clustered by terrain.
    """
    less = (table[OURS] - table[other]).to_numpy()
    return clustered(less, grounds_of(table["world"]))


def best_of(table: pd.DataFrame) -> str:
    """Return the baseline that loses least on average."""
    return str(table[[name for name in BASELINES if name in table]].mean().idxmin())


# --- pages ---


def contact() -> str:
    """Return the page of contact lost."""
    parts = [
        "# Contact lost",
        "Written by `python benchmarks/tables.py` from the rows of `benchmarks/contact.py`, which "
        "describes the settings, methods and measure. Contact lost is in bounds per mission, with "
        "bounds that failed or were not reached as fully lost. Differences are trustbo minus the "
        "baseline, so negative ones are in favour of trustbo; intervals and p values are those of "
        "a t test clustered by terrain. The best baseline of a row is the one that loses least on "
        "its worlds.",
    ]
    for setting in SETTINGS:
        rows = rows_of(setting)
        lost = of_worlds(rows, "lost")
        n_terrains = len(set(grounds_of(lost["world"])))
        parts += [
            f"## {TITLES[setting]}",
            f"{len(lost)} worlds on {n_terrains} terrains, {len(SETTINGS[setting])} campaigns of "
            f"{MISSIONS} missions in each world and method.",
            means(lost),
            "### Differences",
            differences(lost),
            "### First and last missions",
            means_of_parts(rows),
            "### Arrivals",
            arrivals(rows),
        ]
    return "\n\n".join(parts) + "\n"


def means(table: pd.DataFrame) -> str:
    """Return the mean of each method by group."""
    methods = [name for name in METHODS if name in table]
    rows = [
        [f"{name} ({len(some)})", *(number(some[method].mean()) for method in methods)]
        for name, some in groups_in(table)
    ]
    return markdown(["group (worlds)", *methods], rows)


def differences(table: pd.DataFrame) -> str:
    """Return the differences from each baseline, and from the best one, by group."""
    rows = []
    for name, some in groups_in(table):
        best = best_of(some)
        for other in [best, *(b for b in BASELINES if b in some and b != best)]:
            value, low, high, p = difference(some, other)
            label = f"{other} (best)" if other == best else other
            interval = f"{number(value)} [{number(low)}, {number(high)}]"
            rows.append([f"{name} ({len(some)})", label, interval, f"{p:.2g}"])
    return markdown(["group (worlds)", "baseline", "difference [95 %]", "p"], rows)


def means_of_parts(rows: pd.DataFrame) -> str:
    """Return the means of the first mission, and of the last ones, by group."""
    cell = lambda first, last: f"{number(first)}, {number(last)}"  # noqa: E731
    return pairs(rows, "first", "last", f"first, last {_LAST}", cell)


def arrivals(rows: pd.DataFrame) -> str:
    """Return the shares of missions that arrive, of the first ones and of all, by group."""
    cell = lambda first, every: f"{first:.0%}, {every:.1%}"  # noqa: E731
    return pairs(rows, "arrive_first", "arrive", "first, all", cell)


def pairs(
    rows: pd.DataFrame, one: str, other: str, title: str, cell: Callable[[float, float], str]
) -> str:
    """Return the means of two quantities by group, with a column for each method."""
    tables = of_worlds(rows, one), of_worlds(rows, other)
    methods = [name for name in METHODS if name in tables[0]]
    found = []
    for (name, first), (_, second) in zip(*map(groups_in, tables), strict=True):
        cells = [cell(first[m].mean(), second[m].mean()) for m in methods]
        found.append([f"{name} ({len(first)})", *cells])
    return markdown([title, *methods], found)


def number(value: float) -> str:
    """Write a number of bounds."""
    return f"{value:z.3f}"


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    rule = ["---", *("---:" for _ in head[1:])]
    return "\n".join(f"| {' | '.join(row)} |" for row in [head, rule, *rows])


WRITERS: dict[str, Callable[[], str]] = {"contact": contact}
"""Functions that return the pages, by name."""


def stale(folder: Path = PAGES) -> list[str]:
    """Return the names of pages that differ from their rows."""
    return [
        name
        for name, write in WRITERS.items()
        if not (folder / f"{name}.md").exists() or (folder / f"{name}.md").read_text() != write()
    ]


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--check", action="store_true", help="list pages that are stale")
    given = parsed(parser)
    if given.check:
        found = stale()
        print("\n".join(found) or "all pages are those of their rows")
        sys.exit(bool(found))

    PAGES.mkdir(parents=True, exist_ok=True)
    for name, write in WRITERS.items():
        (PAGES / f"{name}.md").write_text(write())


if __name__ == "__main__":
    main()
