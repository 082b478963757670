"""Kinds of worlds, and the interval of all tables: that of a t test clustered by terrain."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import pandas as pd
from scipy import stats
from world_set import worlds

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


LIMITS = ("limit too high", "limit too low")
"""Names of the parts of the group of wrong slope limits."""


def require_group(name: str) -> None:
    """Raise ValueError if no group, part of one or kind of worlds has this name."""
    if name not in (*GROUPS, *LIMITS, *KINDS):
        raise ValueError(f"there is no group or kind of worlds {name!r}.")


def groups_in(table: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the groups of worlds that a table has, and limits too high and too low apart.

    The table has the columns kind and case.
    """
    is_limit = table["kind"] == "limit"
    is_low = table["case"].str.contains("low")
    limits = dict(zip(LIMITS, (is_limit & ~is_low, is_limit & is_low), strict=True))
    chosen = {}
    for name, kinds in GROUPS.items():
        chosen[name] = table["kind"].isin(kinds)
        if name == "wrong slope limit":
            chosen |= limits
    for name, some in chosen.items():
        if some.any():
            yield name, table[some]


def kinds_in(table: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the kinds of worlds that a table has."""
    for kind in KINDS:
        some = table[table["kind"] == kind]
        if len(some):
            yield kind, some


def grounds_of(names: Iterable[str]) -> np.ndarray:
    """Return the terrain of each world; results on the same terrain are not independent."""
    grounds = sorted({world.ground for world in worlds().values()}, key=len, reverse=True)
    return np.array([next((g for g in grounds if n.startswith(g)), n) for n in names])


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


def over_worlds(values: np.ndarray, names: Iterable[str]) -> tuple[float, float, float, float]:
    """Compute `clustered` of the values of worlds, without those that are NaN."""
    values = np.asarray(values, float)
    known = np.isfinite(values)
    if not known.any():
        return np.nan, np.nan, np.nan, np.nan
    return clustered(values[known], grounds_of(names)[known])


def interval(value: float, low: float, high: float, places: int = 3) -> str:
    """Write a value with its interval; "-" stands for what does not exist."""
    if np.isnan(value):
        return "-"
    if np.isnan(low):
        return f"{value:z.{places}f} [-]"
    return f"{value:z.{places}f} [{low:z.{places}f}, {high:z.{places}f}]"


def holm(p_values: Sequence[float]) -> np.ndarray:
    """Correct p-values for multiple tests by Holm's method; NaN values are not counted as tests."""
    p = np.array(p_values, dtype=float)
    tests = np.flatnonzero(np.isfinite(p))
    order = tests[np.argsort(p[tests], kind="stable")]

    factors = np.arange(len(order), 0, -1)
    corrected = np.full(len(p), np.nan)
    corrected[order] = np.minimum(1.0, np.maximum.accumulate(factors * p[order]))
    return corrected
