"""Results of benchmarks/worlds.py by groups and kinds of worlds, paired, and beside version 0.3.

Rows are means over the seeds of one method on a world and course, see `rows_of`. `lost` is contact
lost while learning in bounds a mission, where a bound that fails or is not reached keeps none.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from common import Table
from scipy import stats

from trustbo.study import worlds
from trustbo.study.summary import bootstrap

OURS, BASELINES = "trustbo", ("running mean", "residual process", "line of sight")
KINDS = ("right", "wall", "bare", "slopes", "aged", "canopy", "shapes", "teams",
         "robots", "days", "foul", "change", "jammer", "physics", "limit")  # fmt: skip
CALM = KINDS[:8]
"""Kinds in which nothing goes wrong: the survey may be wrong, robots and missions are alike."""
WRONG = KINDS[8:]
GROUPS = {
    "all": KINDS,
    "calm": CALM,
    "goes wrong": WRONG,
    "goes wrong, without jammer and physics": tuple(set(WRONG) - {"jammer", "physics"}),
}
"""Kinds of worlds by the name of their group."""
LOST = "lost_with_failures"
COLUMNS = ["lost_while_learning", "regret_now", "arrive", LOST, "arrive_first_3", "arrive_later"]
"""Quantities of a row; the first three are those of version 0.3."""
REFERENCES = [
    Path(__file__).parent / "reference" / name for name in ("worlds_0.3.csv", "limits_0.3.csv")
]
DEAD = "dead-detector"
"""Case of kind `change` that is compared with version 0.3 by name."""


NAMES = {
    "case": "method", "lost while learning": "lost_while_learning", "regret now": "regret_now",
    "lost with failures": LOST, "arrive of the first 3": "arrive_first_3",
    "arrive later": "arrive_later",
}  # fmt: skip
"""Columns of `study.numbers_of` by their names in a row."""


def rows_of(numbers: pd.DataFrame) -> pd.DataFrame:
    """Rows of `study.numbers_of`: a method on a world and course, means over seeds."""
    rows = numbers.rename(columns=NAMES)
    labels = ["world", "kind", "course", "method"]
    return rows.groupby(labels, as_index=False)[COLUMNS].mean()


def references() -> pd.DataFrame:
    """Rows of version 0.3, NaN where it has no such quantity.

    Of kinds other than `limit` its contact lost is without failures, of which trustbo had none.
    """
    return pd.concat([pd.read_csv(file) for file in REFERENCES if file.is_file()])


def grounds_of(names: Iterable[str]) -> np.ndarray:
    """Terrain of each world: worlds of one terrain are no independent evidence."""
    grounds = sorted({world.ground for world in worlds().values()}, key=len, reverse=True)
    return np.array([next((g for g in grounds if n.startswith(g)), n) for n in names])


def paired(rows: pd.DataFrame, methods: Sequence[str], quantity: str = LOST) -> pd.DataFrame:
    """A quantity by world, course and kind, with a column for each method that all rows have."""
    index = ["world", "course", "kind"]
    wide = rows.pivot_table(quantity, index, "method").reindex(columns=list(methods))
    return wide.dropna()


def clustered(values: np.ndarray, clusters: np.ndarray) -> tuple[float, float, float, float]:
    """Mean, ends of its 95 % interval, and p-value of no difference, by clustered errors.

    The variance of the mean is G / (G - 1) sum_g (sum_{i in g} (d_i - mean))^2 / n^2 over G
    clusters, and t has G - 1 degrees of freedom (Liang & Zeger 1986); clusters of one value make
    it the t test. NaN for one cluster.
    """
    mean, (_, index) = float(np.mean(values)), np.unique(clusters, return_inverse=True)
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
    """P-values corrected for their number by Holm's method; NaN are no tests."""
    p = np.array(p_values, dtype=float)
    corrected, tests = np.full(len(p), np.nan), np.flatnonzero(np.isfinite(p))
    order = tests[np.argsort(p[tests], kind="stable")]
    factors = np.arange(len(order), 0, -1)
    corrected[order] = np.minimum(1.0, np.maximum.accumulate(factors * p[order]))
    return corrected


def by_group(rows: pd.DataFrame) -> pd.DataFrame:
    """Means of `lost` by group and method, and trustbo less each other and less the best baseline.

    Intervals, 95 %, are of a bootstrap over terrains, which all worlds of a terrain enter together.
    The best baseline of a group is the one of the smallest mean in it.

    Returns:
        Table with columns group, n (worlds), what, `value`, `low` and `high`.
    """
    methods = [OURS, *(name for name in BASELINES if name in set(rows["method"]))]
    wide, table = paired(rows, methods), []
    for group, kinds in GROUPS.items():
        some = wide[wide.index.get_level_values("kind").isin(kinds)]
        if some.empty:
            continue
        names = some.index.get_level_values("world")
        numbers = {name: some[name].to_numpy() for name in methods}
        best = some[methods[1:]].mean().idxmin() if len(methods) > 1 else None
        numbers |= {f"{OURS} less {name}": numbers[OURS] - numbers[name] for name in methods[1:]}
        if best is not None:
            numbers[f"{OURS} less the best ({best})"] = numbers[OURS] - numbers[best]
        grounds = grounds_of(names)
        found = bootstrap(numbers, grounds, np.mean)
        for name in numbers:
            value, *ends = (found[name, what] for what in ("value", "low", "high"))
            ends = ends if len(set(grounds)) > 1 else [np.nan, np.nan]  # one has no interval
            table.append([group, names.nunique(), name, value, *ends])
    return pd.DataFrame(table, columns=["group", "n", "what", "value", "low", "high"])


def by_kind(rows: pd.DataFrame) -> pd.DataFrame:
    """Trustbo's `lost` less that of the best baseline of each kind, with p-values.

    Intervals and p-values are of the t test with errors clustered by terrain; `p_holm` are
    corrected for the number of kinds.
    """
    methods = [OURS, *(name for name in BASELINES if name in set(rows["method"]))]
    wide, table = paired(rows, methods), []
    for kind in KINDS:
        some = wide[wide.index.get_level_values("kind") == kind]
        if some.empty or len(methods) < 2:
            continue
        names = some.index.get_level_values("world")
        best = some[methods[1:]].mean().idxmin()
        less = (some[OURS] - some[best]).to_numpy()
        found = clustered(less, grounds_of(names))
        table.append([kind, names.nunique(), *some[methods].mean(), best, *found])
    head = ["kind", "n", *methods, "best", "value", "low", "high", "p"]
    found = pd.DataFrame(table, columns=head)
    return found.assign(p_holm=holm(found["p"]))


def arrivals(rows: pd.DataFrame) -> pd.DataFrame:
    """Share of missions that arrive by kind and method, of all, the first three and the others."""
    return rows.groupby(["kind", "method"])[["arrive", "arrive_first_3", "arrive_later"]].mean()


def beside(rows: pd.DataFrame, reference: pd.DataFrame) -> pd.DataFrame:
    """Trustbo's contact lost now less that of version 0.3, on the same worlds and courses.

    With failures where the reference has them, that is of kind `limit`; else without.
    """
    ours = [table[table["method"] == OURS] for table in (rows, reference)]
    both = ours[0].merge(ours[1], on=["world", "kind", "course"], suffixes=("", "_0.3"))
    old = both[f"{LOST}_0.3"] if f"{LOST}_0.3" in both else pd.Series(np.nan, both.index)
    known = old.notna()
    both["now"] = both[LOST].where(known, both["lost_while_learning"])
    both["before"] = old.where(known, both["lost_while_learning_0.3"])
    table = []
    selected = {name: (kinds, "") for name, kinds in GROUPS.items()}
    selected |= {kind: ((kind,), "") for kind in KINDS}
    selected[f"change: {DEAD}"] = ("change",), DEAD
    for name, (kinds, case) in selected.items():
        some = both[both["kind"].isin(kinds) & both["world"].str.endswith(case)]
        if some.empty:
            continue
        less = (some["now"] - some["before"]).to_numpy()
        found = clustered(less, grounds_of(some["world"]))
        arrive = some["arrive_0.3"].mean(), some["arrive"].mean()
        means = some["before"].mean(), some["now"].mean()
        table.append([name, some["world"].nunique(), *means, *found, *arrive])
    head = ["what", "n", "0.3", "now", "value", "low", "high", "p", "home_0.3", "home"]
    return pd.DataFrame(table, columns=head)


def report_groups(rows: pd.DataFrame) -> None:
    """Print the tables by group and kind, of arrivals, and beside version 0.3, in Markdown."""
    print("\n**Lost while learning, with failures**: bounds a mission, by group\n")
    groups = by_group(rows)
    table = Table("group (worlds)", "method", "lost [95 % by terrain]")
    for row in groups.itertuples():
        table.row(f"{row.group} ({row.n})", row.what, interval(row, 3))
    print(f"\n**{OURS} less the best baseline of each kind**\n")
    kinds = by_kind(rows)
    methods = [name for name in (OURS, *BASELINES) if name in kinds]
    table = Table("kind (worlds)", *methods, "best", "difference [95 %]", "p", "p, Holm")
    for _, row in kinds.iterrows():
        means = [f"{row[name]:.3f}" for name in methods]
        p_values = [f"{row[name]:.3g}" for name in ("p", "p_holm")]
        table.row(f"{row['kind']} ({row['n']})", *means, row["best"], interval(row, 3), *p_values)
    print("\n**Missions that arrive**: share of all\n")
    home = arrivals(rows)
    methods = [name for name in (OURS, *BASELINES) if name in set(rows["method"])]
    table = Table("kind", *methods)
    for kind in (k for k in KINDS if k in home.index.levels[0]):
        table.row(kind, *(f"{home.loc[(kind, name), 'arrive']:.3f}" for name in methods))
    if "limit" in home.index.levels[0]:
        for part, column in (
            ("first three", "arrive_first_3"),
            ("from the fourth on", "arrive_later"),
        ):
            cells = [f"{home.loc[('limit', name), column]:.3f}" for name in methods]
            table.row(f"limit, {part}", *cells)
    reference = references()
    if (compared := beside(rows, reference)).empty:
        return
    print(f"\n**{OURS} beside version 0.3**: lost on the same worlds and courses\n")
    table = Table("worlds", "0.3", "now", "difference [95 %]", "p", "home, 0.3", "home")
    for _, row in compared.iterrows():
        means = [f"{row[name]:.3f}" for name in ("0.3", "now")]
        home_of = [f"{row[name]:.3f}" for name in ("home_0.3", "home")]
        what = f"{row['what']} ({row['n']})"
        table.row(what, *means, interval(row, 3), f"{row['p']:.3g}", *home_of)


def interval(row: object, places: int) -> str:
    """Value and its interval."""
    value, low, high = (
        row[name] if isinstance(row, pd.Series) else getattr(row, name)
        for name in ("value", "low", "high")
    )
    return f"{value:z.{places}f} [{low:z.{places}f}, {high:z.{places}f}]"
