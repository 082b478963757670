"""Trials of bounds: how often each bound was begun and how often it ended a mission.

Whether a bound is completed depends on the next way (see `workspace.difficulty`), so bounds are
counted with their next ways. If robots turned back after a failure, or the log ends there, the path
does not show the next way that was planned. Such a trial is shared equally by all next ways.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple, Self

import numpy as np

from trustbo.data import POST_SETS, Cell, Mission, Station, cells_of
from trustbo.errors import TrustboError, require_list
from trustbo.stacking import list_of_missions
from trustbo.workspace.moves import pairs_along

CAUSES = ("stuck", "tipped", "timeout", "collision", "lost_contact")
"""Statuses of bounds that failed; aborted bounds and missions do not count as failures."""
UNKNOWN = -1
"""Index of a next way that is not known."""


class LostMission(NamedTuple):
    """A failed mission without any measurements.

    Attributes:
        path: Planned cells, beginning with the start, each (row, col) or (row, col, name).
        where: Cell that the team failed to enter, or None if unknown. If the path enters this
            cell more than once, the first of these bounds failed.
    """

    path: tuple[Station, ...]
    where: Cell | None = None


class Trials(NamedTuple):
    """Trials of attempted bounds, which are sufficient statistics of the hazard model.

    Attributes:
        bounds: Distinct bounds in lexicographic order, shape (bound, 4). The columns are the way,
            the row and column of the cell entered, and the next way, which is the number of ways at
            the end of a path and `UNKNOWN` if it is not known; see `workspace.moves`. After
            `of_units`, they are the move, the row, the column and the first option of the unit.
        n: Number of times that each bound is known to have been completed or to have failed, shape
            (bound,). It is a fraction if trials are shared by several next ways; see
            `with_known_next`.
        failed: Number of failures among the trials in `n`, shape (bound,).
        lost: Planned bounds of each mission lost at an unknown place, as indices into `bounds`.
    """

    bounds: np.ndarray
    n: np.ndarray
    failed: np.ndarray
    lost: tuple[np.ndarray, ...]

    @classmethod
    def from_missions(
        cls,
        missions: Iterable[Mission],
        lost: Iterable[LostMission] = (),
        goals: Sequence[Cell | None] | None = None,
        n_posts: int = 1,
    ) -> Self:
        """Count the trials in measured missions and in lost missions.

        The last bound of a failed mission counts as a failure, and so does each earlier bound that
        failed. An aborted bound is not counted. If the robots turn back during a bound, they drive
        only a part of the bound that leads back, so this bound is counted only if it fails.

        Args:
            missions: Measured missions.
            lost: Failed missions without measurements.
            goals: Last cell of the planned path of each measured mission, or None where it is not
                known; by default, none is known. A path that ends in another cell at a bound that
                failed has an unknown next way.
            n_posts: Number of sets of posts. Other sets in paths count as the standard one.

        Raises:
            TrustboError: If a path skips cells or does not enter `where`.
        """
        lost = require_list("lost", lost, LostMission, "give a list of LostMission")
        missions = list_of_missions(missions)
        goals = [None] * len(missions) if goals is None else goals
        of_missions = zip(missions, goals, strict=True)

        known = [_reported(mission, goal, n_posts) for mission, goal in of_missions]
        known += [_located(mission, n_posts) for mission in lost if mission.where is not None]
        unknown = [_pairs_along(one.path, n_posts) for one in lost if one.where is None]

        met = [tried for tried, _ in known] + unknown
        rows = np.concatenate([np.empty((0, 4), int), *met])
        bounds, index = np.unique(rows, axis=0, return_inverse=True)
        paths = np.split(index, np.cumsum([len(part) for part in met])[:-1]) if met else []

        n, failed = np.zeros((2, len(bounds)))
        for path, (_, fails) in zip(paths, known, strict=False):
            np.add.at(n, path, 1.0)
            np.add.at(failed, path, fails)
        return cls(bounds, n, failed, tuple(paths[len(known) :]))

    def with_known_next(self, exists: np.ndarray) -> Self:
        """Share each trial with an unknown next way equally among the next ways that exist.

        Args:
            exists: Whether each bound exists and can be followed by the next way, shape (way, row,
                col, next_way).
        """
        is_unknown = self.bounds[:, 3] == UNKNOWN
        if not is_unknown.any():
            return self

        source = [np.flatnonzero(~is_unknown)]
        after = [self.bounds[~is_unknown, 3]]
        share = [np.ones(len(source[0]))]
        for row in np.flatnonzero(is_unknown):
            ways = np.flatnonzero(exists[*self.bounds[row, :3]])
            if not ways.size:  # the bound is not on the map
                ways = np.array([exists.shape[-1] - 1])
            source.append(np.full(len(ways), row))
            after.append(ways)
            share.append(np.full(len(ways), 1.0 / len(ways)))

        of_row = np.concatenate(source)
        shares = np.concatenate(share)
        rows = np.column_stack([self.bounds[of_row, :3], np.concatenate(after)])
        bounds, index = np.unique(rows, axis=0, return_inverse=True)
        n = np.bincount(index, shares * self.n[of_row], len(bounds))
        failed = np.bincount(index, shares * self.failed[of_row], len(bounds))

        # The bounds of lost missions have known next ways, which come first in `rows`.
        place = np.zeros(len(self.bounds), int)
        place[of_row[: len(source[0])]] = index[: len(source[0])]
        return type(self)(bounds, n, failed, tuple(place[path] for path in self.lost))

    def of_units(self, units: np.ndarray) -> Self:
        """Add up the trials of each unit, whose bounds pass or fail together.

        Args:
            units: Unit of each bound, shape (bound, 4); see `Difficulty.units_of`.
        """
        bounds, index = np.unique(units, axis=0, return_inverse=True)
        n = np.bincount(index, self.n, len(bounds))
        failed = np.bincount(index, self.failed, len(bounds))
        return type(self)(bounds, n, failed, tuple(index[path] for path in self.lost))


def _pairs_along(path: Sequence[Station], n_posts: int) -> np.ndarray:
    """Return ways and next ways, (bound, 4); a set of posts that is not offered is the standard."""
    offered = POST_SETS[:n_posts]
    stations = [station if station[-1] in offered else station[:2] for station in path]
    return pairs_along(stations, n_posts)


def _reported(mission: Mission, goal: Cell | None, n_posts: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds that were completed or failed, (bound, 4), and whether each one failed."""
    path = mission.path
    statuses = mission.statuses

    fails = np.array([status in CAUSES for status in statuses])
    is_known = fails.copy()
    for k, status in enumerate(statuses):
        goes_back = k > 0 and statuses[k - 1] != "ok" and path[k + 1] == path[k - 1]
        if status == "ok" and not goes_back:
            is_known[k] = True

    # A path contains the planned cells after the last bound, unless the log ends there or the
    # mission was replanned. Robots that turn back after a failure did not plan to.
    tried = _pairs_along(mission.stations[: len(statuses) + 2], n_posts)[: len(statuses)]
    for k in np.flatnonzero(fails):
        is_last = k + 2 == len(path)
        turns_back = not is_last and path[k + 2] == path[k]
        if turns_back or (is_last and path[k + 1] != goal):
            tried[k, 3] = UNKNOWN

    return tried[is_known], fails[is_known]


def _located(mission: LostMission, n_posts: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds of a lost mission up to `where`, and whether each one failed."""
    cells = cells_of(mission.path)
    if mission.where not in cells[1:]:
        raise TrustboError(f"where must be a cell that the path enters; got {mission}.")

    n = cells.index(mission.where, 1)
    return _pairs_along(mission.path[: n + 2], n_posts)[:n], np.arange(1, n + 1) == n
