"""Changes of the world from some mission on, of all robots, of one robot, or of an area.

A change adds d times its profile to the drift of bounds from a mission on: line of sight for all
robots or one of them, a constant for an area, the cells within a radius of its centre. d is in
units of contact: of stationary trust, and of logits where rates are counts, by their line through
contact. Neither the mission nor the area is given: every start and place that the
paths separate is a candidate column, and inference weighs them (`inference.changes`).
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy import sparse

from trustbo.models.effects.effect import Columns, Effect, Independent, Slots
from trustbo.models.effects.fingerprint import fingerprints

Kind = Literal["all", "robot", "area"]
KINDS: tuple[Kind, ...] = ("all", "robot", "area")
RATE = 0.02  # chance of a change in a mission
SHARES = 0.2, 0.4, 0.4  # of the kinds among changes
SDS = 0.5, 0.5, 0.3  # of d by kind
RADII = 0, 1, 2  # cells, of areas
SIDES = 2, 2  # missions that meet the profile before and after a start, at least


@dataclass(frozen=True)
class Change(Effect):
    """Change of one profile from one mission on: an effect without hyperparameters.

    Attributes:
        kind: `"all"`, `"robot"` or `"area"`.
        where: Nothing; the index of the robot; or row, column and radius in cells.
        from_mission: Index of the first mission after the change.
        unit: Stationary trust that is one of contact, see `Family.line_of_sight`.
    """

    kind: Kind
    where: tuple[int, ...]
    from_mission: int
    unit: float = 1.0

    def group(self, slots: Slots) -> Independent:
        """See `Effect.group`."""
        kind, where = KINDS.index(self.kind), np.array([*self.where, 0, 0, 0][:3])
        values = _profile(slots, kind, where) * (slots.mission >= self.from_mission)[:, None]
        return Independent(sparse.csr_array(values.reshape(-1, 1)), "change", SDS[kind] * self.unit)

    def met(self, cells: np.ndarray) -> np.ndarray:
        """Whether bounds into cells (..., 2) belong to the area; all do of other kinds."""
        if self.kind != "area":
            return np.ones(cells.shape[:-1], dtype=bool)
        row, col, radius = self.where
        return _within(cells - np.array([row, col]), radius)

    def __str__(self) -> str:
        """Text of what changed, and from which mission on."""
        what = {
            "all": lambda: "all robots",
            "robot": lambda robot: f"robot {robot}",
            "area": lambda row, col, radius: f"area within {radius} of ({row}, {col})",
        }[self.kind](*self.where)
        return f"{what}, from mission {self.from_mission}"


class Candidates(NamedTuple):
    """Changes that the paths of some missions separate.

    Starts between two missions that meet a profile give equal rates: the columns are profiles in
    one mission each, in runs of one profile, and a change is the sum of a column and all later ones
    of its run. Of changes that are equal at every slot one stands for all, with the sum of their
    prior odds.
    """

    columns: Columns  # (slot, column)
    run: np.ndarray  # (column,), profile
    profile: np.ndarray  # (column, 4): index of the kind, where
    mission: np.ndarray  # (column,)
    earliest: np.ndarray  # (column,), first mission of a start that is equal to this one
    stands_for: np.ndarray  # (column,), candidate; -1 for a start too early or too late
    first: np.ndarray  # (candidate,), column
    log_odds: np.ndarray  # (candidate,), prior odds against no change
    sd: np.ndarray  # (candidate,), of d
    unit: float  # see `Change`

    @classmethod
    def of(cls, slots: Slots, sides: tuple[int, int] = SIDES, unit: float = 1.0) -> "Candidates":
        """Candidates of some slots; areas where places are given.

        `sides`: missions that meet the profile before a start, and from it on, at least; `unit`:
        see `Change`.
        """
        entries, profile, n_profiles = _entries(slots)
        slot, which, value = entries
        mission = np.repeat(slots.mission, slots.y.shape[1])[slot]
        block, column = np.unique(which * slots.n_missions + mission, return_inverse=True)
        run, mission = np.divmod(block, slots.n_missions)
        shape = slots.y.size, len(block)
        columns = sparse.csc_array((value, (slot, column.ravel())), shape=shape)
        first_of_run = np.searchsorted(run, run)
        n_met = np.searchsorted(run, run, side="right") - first_of_run
        before = np.arange(len(run)) - first_of_run
        possible = (before >= sides[0]) & (n_met - before >= sides[1])
        earliest = np.where(before > 0, np.append(-1, mission[:-1]) + 1, 0)
        kind = profile[run, 0]
        odds = RATE / (1.0 - RATE) * np.array(SHARES)[kind] / n_profiles[kind]
        odds *= mission - earliest + 1
        _, scale = np.unique(SDS, return_inverse=True)  # equal changes have equal scales too
        up_to = np.append(np.uint64(0), np.cumsum(fingerprints(columns), dtype=np.uint64))
        sums = up_to[first_of_run + n_met] - up_to[:-1]
        key = (sums + scale.astype(np.uint64)[kind])[possible]
        _, first, same = np.unique(key, return_index=True, return_inverse=True)
        stands_for = np.full(len(run), -1)
        stands_for[possible] = same.ravel()
        first = np.flatnonzero(possible)[first]
        log_odds = np.log(np.bincount(same.ravel(), odds[possible], len(first)))
        sd = np.array(SDS)[kind[first]]
        return cls(
            columns, run, profile[run], mission, earliest, stands_for, first, log_odds, sd, unit
        )  # fmt: skip

    def change(self, candidate: int) -> Change:
        """Change of a candidate; of equal ones that of the smallest area, in its last mission."""
        return self._change_of(self.first[candidate])

    def ties(self, candidate: int) -> list[Change]:
        """Changes that are equal to a candidate's at every slot, except for their start."""
        columns = np.flatnonzero(self.stands_for == candidate)
        return [self._change_of(column) for column in columns if column != self.first[candidate]]

    def _change_of(self, column: np.intp) -> Change:
        kind, *where = self.profile[column].tolist()
        length = {"all": 0, "robot": 1, "area": 3}[KINDS[kind]]
        return Change(KINDS[kind], tuple(where[:length]), int(self.mission[column]), self.unit)


def cells_of(slots: Slots) -> np.ndarray:
    """Row and column of the cell entered at each slot (chain, bound, 2), -1 where there is none."""
    if slots.places is None:
        return np.full((*slots.y.shape, 2), -1)
    unit = slots.places.unit[slots.mission, : slots.y.shape[1], 0]
    return np.where(unit[..., None] >= 0, slots.places.units[unit, 2:], -1)


def _profile(slots: Slots, kind: int, where: np.ndarray) -> np.ndarray:
    """Profile (chain, bound) of a kind in all missions."""
    if KINDS[kind] == "area":
        cells = cells_of(slots)
        return 1.0 * (_within(cells - where[:2], where[2]) & (cells[..., 0] >= 0))
    return slots.line_of_sight * ((kind == 0) | (slots.robot == where[0]))[:, None]


def _within(gap: np.ndarray, radius: int | np.ndarray) -> np.ndarray:
    """Whether gaps (..., 2) are within a radius: 1, 5 and 21 cells for 0, 1 and 2."""
    return (gap**2).sum(-1) <= (radius + 0.25) ** 2


def _entries(slots: Slots) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray]:
    """Slot, profile and value of all profiles' entries that are not 0.

    Further the profiles (profile, 4), those of robots first, then areas from small to large; and
    the number of profiles of each kind, areas anywhere on the grid among them.
    """
    n_robots, K = slots.n_robots, slots.y.shape[1]
    seen = ~np.isnan(slots.y)
    ahead = (np.cumsum(seen[:, ::-1], axis=1)[:, ::-1] > 0).ravel()  # up to the last rate
    sight = slots.line_of_sight.ravel()
    lit = np.flatnonzero(ahead & (sight != 0.0))
    slot, value = [lit, lit], [sight[lit], sight[lit]]
    which = [np.zeros_like(lit), 1 + slots.robot[lit // K]]
    profile = [np.zeros((1, 4), dtype=int), np.zeros((n_robots, 4), dtype=int)]
    profile[1][:, :2] = np.column_stack([np.ones(n_robots), np.arange(n_robots)])
    n_profiles = np.array([1, n_robots, 1])
    cells = cells_of(slots).reshape(-1, 2)
    there = np.flatnonzero(ahead & (cells[:, 0] >= 0))
    if slots.places is not None and len(there):
        rows, cols = slots.places.shape
        centres = np.stack(np.meshgrid(np.arange(rows), np.arange(cols), indexing="ij"), axis=-1)
        centres = centres.reshape(-1, 2)
        met, index = np.unique(cells[there], axis=0, return_inverse=True)
        n_profiles[2] = len(RADII) * len(centres)
        start = 1 + n_robots
        for radius in RADII:
            inside = sparse.csr_array(_within(met[:, None] - centres, radius).astype(float))
            entry = inside[index.ravel()].tocoo()
            slot.append(there[entry.row])
            which.append(start + entry.col)
            value.append(entry.data)
            kind, size = np.full((2, len(centres), 1), [[[2]], [[radius]]])
            profile.append(np.concatenate([kind, centres, size], axis=1))
            start += len(centres)
    entries = tuple(np.concatenate(parts) for parts in (slot, which, value))
    return entries, np.concatenate(profile), n_profiles
