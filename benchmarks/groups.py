"""Paired comparisons of methods by group and kind of world, and comparison with version 0.5.

    python benchmarks/groups.py           # of the stored table
    python benchmarks/groups.py rows.csv  # of another table

The results are from benchmarks/worlds.py. A row (see `rows_of`) is the mean over seeds of one
method on one world and course. `lost` is the contact lost while learning, in bounds per mission;
bounds that fail or are not reached count as fully lost.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from common import Table, arguments, parsed
from scipy import stats
from summary import bootstrap
from world_set import worlds

OURS = "trustbo"
BASELINES = ("running mean", "residual process", "line of sight")
KINDS = ("right", "wall", "bare", "slopes", "aged", "canopy", "shapes", "teams",
         "robots", "days", "foul", "change", "jammer", "physics", "limit")  # fmt: skip
ALIKE = {
    "map right": ("right", "wall", "bare", "slopes", "shapes", "teams"),
    "map wrong": ("aged", "canopy"),
    "robots, weather, changes": ("robots", "days", "foul", "change"),
    "jammers and radio": ("jammer", "physics"),
    "wrong slope limit": ("limit",),
}
"""Kinds of worlds by what differs from the assumptions; each kind is in one group."""
GROUPS = {
    **ALIKE,
    "all but wrong slope limits": KINDS[:-1],
    "all": KINDS,
}
"""Kinds of worlds in each group, keyed by the name of the group."""
LOST = "lost_with_failures"
COLUMNS = ["lost_while_learning", "regret_now", "arrive", LOST, "arrive_first_3", "arrive_later"]
"""Quantities of a row."""
STORED = Path(__file__).parent / "reference" / "worlds_0.6.csv"
BEFORE = Path(__file__).parent / "reference" / "worlds_0.5.csv"
"""Rows of version 0.5."""
NAMES = {
    "case": "method", "lost while learning": "lost_while_learning", "regret now": "regret_now",
    "lost with failures": LOST, "arrive of the first 3": "arrive_first_3",
    "arrive later": "arrive_later",
}  # fmt: skip
"""New column names, keyed by the column names of `numbers_of`."""


def rows_of(numbers: pd.DataFrame) -> pd.DataFrame:
    """Average the results of `numbers_of` over seeds, for each method, world and course."""
    rows = numbers.rename(columns=NAMES)
    labels = ["world", "kind", "course", "method"]
    return rows.groupby(labels, as_index=False)[COLUMNS].mean()


def grounds_of(names: Iterable[str]) -> np.ndarray:
    """Return the terrain of each world; results on the same terrain are not independent."""
    grounds = sorted({world.ground for world in worlds().values()}, key=len, reverse=True)
    return np.array([next((g for g in grounds if n.startswith(g)), n) for n in names])


def paired(rows: pd.DataFrame, methods: Sequence[str], quantity: str = LOST) -> pd.DataFrame:
    """Tabulate a quantity by world, course and kind, with a column for each method."""
    index = ["world", "course", "kind"]
    wide = rows.pivot_table(quantity, index, "method").reindex(columns=list(methods))
    return wide.dropna()


def clustered(values: np.ndarray, clusters: np.ndarray) -> tuple[float, float, float, float]:
    """Compute the mean, its 95 % interval and the p-value of a zero mean, by clustered errors.

    The variance of the mean is G / (G - 1) sum_g (sum_{i in g} (d_i - mean))^2 / n^2 over G
    clusters, and t has G - 1 degrees of freedom (Liang & Zeger 1986). If each cluster has one
    value, this is the t test. With one cluster, the interval and the p-value are NaN.
    """
    mean = float(np.mean(values))
    _, index = np.unique(clusters, return_inverse=True)
    n_clusters = index.max() + 1
    if n_clusters < 2:
        return mean, np.nan, np.nan, np.nan

    sums = np.bincount(index, values - mean)
    se = float(np.sqrt(n_clusters / (n_clusters - 1.0) * (sums**2).sum())) / len(values)
    if se == 0.0:
        return mean, mean, mean, float(mean == 0.0)

    half = float(stats.t.ppf(0.975, n_clusters - 1)) * se
    p = 2.0 * float(stats.t.sf(abs(mean) / se, n_clusters - 1))
    return mean, mean - half, mean + half, p


def holm(p_values: Sequence[float]) -> np.ndarray:
    """Correct p-values for multiple tests by Holm's method; NaN values are not counted as tests."""
    p = np.array(p_values, dtype=float)
    tests = np.flatnonzero(np.isfinite(p))
    order = tests[np.argsort(p[tests], kind="stable")]

    factors = np.arange(len(order), 0, -1)
    corrected = np.full(len(p), np.nan)
    corrected[order] = np.minimum(1.0, np.maximum.accumulate(factors * p[order]))
    return corrected


def methods_in(rows: pd.DataFrame) -> list[str]:
    """Return the methods that are compared: trustbo and the baselines in a table."""
    known = set(rows["method"])
    return [OURS, *(name for name in BASELINES if name in known)]


def by_group(rows: pd.DataFrame) -> pd.DataFrame:
    """Compute means of `lost` by group and method, and the differences of trustbo to baselines.

    The 95 % intervals are from a bootstrap over terrains; worlds on the same terrain are resampled
    together. The best baseline of a group is the baseline with the smallest mean in this group.

    Returns:
        Table with columns group, n (worlds), what, `value`, `low` and `high`.
    """
    methods = methods_in(rows)
    baselines = methods[1:]
    wide = paired(rows, methods)

    table = []
    for group, kinds in GROUPS.items():
        some = wide[wide.index.get_level_values("kind").isin(kinds)]
        if some.empty:
            continue

        numbers = {name: some[name].to_numpy() for name in methods}
        for name in baselines:
            numbers[f"{OURS} minus {name}"] = numbers[OURS] - numbers[name]
        if baselines:
            best = some[baselines].mean().idxmin()
            numbers[f"{OURS} minus the best ({best})"] = numbers[OURS] - numbers[best]

        names = some.index.get_level_values("world")
        found = bootstrap(numbers, grounds_of(names), np.mean)
        for name in numbers:
            value_and_ends = [found[name, what] for what in ("value", "low", "high")]
            table.append([group, names.nunique(), name, *value_and_ends])

    return pd.DataFrame(table, columns=["group", "n", "what", "value", "low", "high"])


def by_kind(rows: pd.DataFrame) -> pd.DataFrame:
    """Compute `lost` of trustbo minus `lost` of the best baseline, for each kind of world.

    Intervals and p-values are from a t test with errors clustered by terrain. `p_holm` is corrected
    for the number of kinds.
    """
    methods = methods_in(rows)
    baselines = methods[1:]
    wide = paired(rows, methods)

    table = []
    for kind in KINDS:
        some = wide[wide.index.get_level_values("kind") == kind]
        if some.empty or not baselines:
            continue

        best = some[baselines].mean().idxmin()
        less = (some[OURS] - some[best]).to_numpy()

        names = some.index.get_level_values("world")
        found = clustered(less, grounds_of(names))
        table.append([kind, names.nunique(), *some[methods].mean(), best, *found])

    head = ["kind", "n", *methods, "best", "value", "low", "high", "p"]
    found = pd.DataFrame(table, columns=head)
    return found.assign(p_holm=holm(found["p"]))


def arrivals(rows: pd.DataFrame) -> pd.DataFrame:
    """Compute the fraction of missions that arrive (all, first three, later) by kind and method."""
    return rows.groupby(["kind", "method"])[["arrive", "arrive_first_3", "arrive_later"]].mean()


def by_limit(rows: pd.DataFrame) -> pd.DataFrame:
    """Average `lost` and the fraction of missions that arrive, by how wrong the slope limit is."""
    limits = rows[rows["kind"] == "limit"]
    case = limits["world"].str.extract(r"-(limit-(?:low-)?\d)$", expand=False).rename("case")
    return limits.groupby([case, limits["method"]])[[LOST, "arrive"]].mean()


def beside(rows: pd.DataFrame, reference: pd.DataFrame) -> pd.DataFrame:
    """Compute the contact lost now minus that of version 0.5, on the same worlds and courses."""
    ours = [table[table["method"] == OURS] for table in (rows, reference)]
    both = ours[0].merge(ours[1], on=["world", "kind", "course"], suffixes=("", "_before"))
    groups = GROUPS | {kind: (kind,) for kind in KINDS}

    table = []
    for name, kinds in groups.items():
        some = both[both["kind"].isin(kinds)]
        if some.empty:
            continue

        less = (some[LOST] - some[f"{LOST}_before"]).to_numpy()
        found = clustered(less, grounds_of(some["world"]))

        means = some[f"{LOST}_before"].mean(), some[LOST].mean()
        regret = some["regret_now_before"].mean(), some["regret_now"].mean()
        arrive = some["arrive_before"].mean(), some["arrive"].mean()
        table.append([name, some["world"].nunique(), *means, *found, *regret, *arrive])

    head = ["what", "n", "0.5", "now", "value", "low", "high", "p"]
    head += ["regret_before", "regret", "arrive_before", "arrive"]
    return pd.DataFrame(table, columns=head)


def report_groups(rows: pd.DataFrame) -> None:
    """Print Markdown tables by group and kind, of arrivals, and compared with version 0.5."""
    print_groups(by_group(rows))
    print_kinds(by_kind(rows))
    print_arrivals(arrivals(rows), methods_in(rows))

    limits = by_limit(rows)
    if not limits.empty:
        print_limits(limits, methods_in(rows))

    compared = beside(rows, pd.read_csv(BEFORE))
    if not compared.empty:
        print_compared(compared)


def print_groups(groups: pd.DataFrame) -> None:
    """Print the table of `by_group`."""
    print("\n**Lost while learning, with failures**: bounds per mission, by group\n")
    table = Table("group (worlds)", "method", "lost [95 % by terrain]")
    for row in groups.itertuples():
        table.row(f"{row.group} ({row.n})", row.what, interval(row, 3))


def print_kinds(kinds: pd.DataFrame) -> None:
    """Print the table of `by_kind`."""
    print(f"\n**{OURS} minus the best baseline of each kind**\n")
    methods = [name for name in (OURS, *BASELINES) if name in kinds]
    table = Table("kind (worlds)", *methods, "best", "difference [95 %]", "p", "p, Holm")
    for _, row in kinds.iterrows():
        means = [f"{row[name]:.3f}" for name in methods]
        p_values = [f"{row[name]:.3g}" for name in ("p", "p_holm")]
        table.row(f"{row['kind']} ({row['n']})", *means, row["best"], interval(row, 3), *p_values)


def print_arrivals(home: pd.DataFrame, methods: Sequence[str]) -> None:
    """Print the table of `arrivals`; for wrong slope limits, also of early and later missions."""
    print("\n**Missions that arrive**: fraction of all missions\n")
    table = Table("kind", *methods)
    present = [kind for kind in KINDS if kind in home.index.levels[0]]
    for kind in present:
        table.row(kind, *(f"{home.loc[(kind, name), 'arrive']:.3f}" for name in methods))

    if "limit" not in present:
        return
    parts = {"first three": "arrive_first_3", "from the fourth on": "arrive_later"}
    for part, column in parts.items():
        cells = [f"{home.loc[('limit', name), column]:.3f}" for name in methods]
        table.row(f"limit, {part}", *cells)


def print_limits(limits: pd.DataFrame, methods: Sequence[str]) -> None:
    """Print the table of `by_limit`."""
    print("\n**Wrong slope limits**: lost, and fraction of missions that arrive\n")
    table = Table("limit", *(f"{name}: lost, arrive" for name in methods))
    for case in limits.index.levels[0]:
        found = [limits.loc[(case, name)] for name in methods]
        table.row(case, *(f"{one[LOST]:.3f}, {one['arrive']:.3f}" for one in found))


def print_compared(compared: pd.DataFrame) -> None:
    """Print the table of `beside`."""
    print(f"\n**{OURS} compared with version 0.5**: lost on the same worlds and courses\n")
    table = Table(
        "worlds", "0.5", "now", "difference [95 %]", "p", "final regret (%), 0.5", "now",
        "arrive, 0.5", "now",
    )  # fmt: skip

    pairs = ("0.5", "now"), ("regret_before", "regret"), ("arrive_before", "arrive")
    for _, row in compared.iterrows():
        means, regret, arrive = ([f"{row[name]:.3f}" for name in pair] for pair in pairs)
        what = f"{row['what']} ({row['n']})"
        table.row(what, *means, interval(row, 3), f"{row['p']:.3g}", *regret, *arrive)


def interval(row: object, places: int) -> str:
    """Format a value with its interval; "-" stands for what does not exist.

    Worlds on one terrain give no interval.
    """
    value, low, high = (
        row[name] if isinstance(row, pd.Series) else getattr(row, name)
        for name in ("value", "low", "high")
    )
    if np.isnan(value):
        return "-"
    if np.isnan(low):
        return f"{value:z.{places}f} [-]"

    return f"{value:z.{places}f} [{low:z.{places}f}, {high:z.{places}f}]"


if __name__ == "__main__":
    parser = arguments(__doc__ or "")
    parser.add_argument("file", nargs="?", type=Path, default=STORED, metavar="FILE",
                        help="table of rows, by default worlds_0.6.csv")  # fmt: skip
    given = parsed(parser)
    if not given.file.exists():
        parser.error(f"there is no file {given.file}")

    report_groups(pd.read_csv(given.file))
