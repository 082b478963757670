"""Cover of a path: the share of the time in which nobody sees anybody, and how sure it is.

While the lead drives, it is covered where any robot of T2 sees it; while T2 closes up, where the
lead sees any of them. In a bound of times T_1 and T_2, with chances p_ik that robot i and the lead
see each other at time k of a phase,

    unseen = (T_1 mean_k prod_i (1 - p_ik) + T_2 mean_k prod_i (1 - p'_ik)) / (T_1 + T_2).

The chances are those of the map, see `line_of_sight`, times the contact expected of the robot as a
share of its line of sight: what missions have taught about the robot and the place. That scans of
different robots miss independently, given the place, is the assumption of the simulator too.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Self

import numpy as np

from trustbo.data import Cell
from trustbo.workspace import Workspace

N_DRAWS = 200
"""Draws of trust, at most, that the band is of."""
_LEAST = 0.02
"""Line of sight below which contact is no share of it."""
_BAND = (0.05, 0.95)


class PathCover(NamedTuple):
    """Share of the time in which nobody sees anybody, in [0, 1]."""

    unseen: float
    """Expected, of the whole path."""
    band: tuple[float, float]
    """Ends of the 90 % band over draws of the parameters, of the whole path."""
    by_bound: np.ndarray
    """Expected, of each bound, (bound,)."""

    def to_record(self) -> dict[str, Any]:
        """Convert to plain lists and numbers."""
        return {"unseen": self.unseen, "band": [*self.band], "by_bound": self.by_bound.tolist()}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Self:
        """Convert the record of `to_record` back."""
        low, high = record["band"]
        return cls(record["unseen"], (low, high), np.array(record["by_bound"]))


def cover_along(
    workspace: Workspace, path: tuple[Cell, ...], posts: np.ndarray, draws: np.ndarray
) -> PathCover | None:
    """Cover of a path with T2 at posts (bound, robot, 2), for draws of trust (draw, bound, robot).

    Trust is that expected with T2 at the workspace's posts, as planners expect it. None without a
    terrain in memory or an assumed sight.
    """
    if (table := workspace.watch) is None:
        return None
    some = np.unique(np.linspace(0, len(draws) - 1, min(len(draws), N_DRAWS)).astype(int))
    rule = table.rule(path)
    usual = table.seen_along(path, rule)
    seen = usual if np.array_equal(rule, posts) else table.seen_along(path, posts)
    factor = np.clip(draws[some], 0.0, 1.0) / np.maximum(usual.line_of_sight(), _LEAST)
    unseen = seen.unseen(factor)  # (draw, bound)
    time = seen.lead_time + seen.times.max(1)
    whole = unseen @ time / time.sum()
    low, high = np.quantile(whole, _BAND)
    return PathCover(float(whole.mean()), (float(low), float(high)), unseen.mean(0))
