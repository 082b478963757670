"""Missions from time-stamped records, such as a robot's log."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trustbo.data import Bound, Cell, Mission
from trustbo.errors import TrustboError

_NEVER = np.iinfo(np.int64).max
_NS = 1e9  # in a second


class Series(NamedTuple):
    """Values and their times of recording, ascending."""

    time: np.ndarray  # (record,), ns
    value: np.ndarray  # (record, ...)

    def between(self, after: int, until: int) -> "Series":
        """Records later than `after`, up to and including `until`."""
        first, last = np.searchsorted(self.time, (after, until), side="right")
        return Series(self.time[first:last], self.value[first:last])


class Marker(NamedTuple):
    """Start of a bound; bound 0 is the start of a mission, in its start cell."""

    time: int
    """ns."""
    bound: int
    cell: Cell
    path: tuple[Cell, ...] = ()
    """Planned path, start first, if recorded in bound 0."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Records of a team, by one clock.

    A bound lasts from its marker to the first status after it, else to the last contact record of
    any robot before the next marker. A record at the time of the next marker belongs to the bound
    before.

    Attributes:
        markers: Starts of bounds.
        status: Statuses of bounds; the last of a mission is the mission's.
        contact: Contact of each robot at its ticks, if above 0.5; NaN where it was not measured.
        awareness: Awareness of each robot, shape (record, feature); the last of a bound counts.
        poses: Poses of the lead, then of each robot: x, y and heading, shape (record, 3). Empty if
            not recorded.
        states: States of each robot, shape (record, state). Empty if not recorded.
    """

    markers: Sequence[Marker]
    status: Series
    contact: Sequence[Series]
    awareness: Sequence[Series]
    poses: Sequence[Series] = ()
    states: Sequence[Series] = ()

    def missions(self, features: tuple[str, ...], robots: tuple[str, ...]) -> list[Mission]:
        """Missions of the records; one without bounds is left out.

        TrustboError: markers out of order, or what `Mission` refuses.
        """
        markers = sorted(self.markers, key=lambda marker: (marker.time, marker.bound))
        starts = [i for i, marker in enumerate(markers) if marker.bound == 0]
        if not starts or starts[0] > 0:
            raise TrustboError(
                "a recording begins with the marker of bound 0, the start cell; "
                f"this one has bounds {[marker.bound for marker in markers]}."
            )
        missions = []
        for first, end in zip(starts, [*starts[1:], len(markers)], strict=True):
            until = markers[end].time if end < len(markers) else _NEVER
            if end - first > 1:
                try:
                    missions.append(self._mission(markers[first:end], until, features, robots))
                except TrustboError as error:
                    raise TrustboError(f"mission {len(missions)}: {error}") from None
        return missions

    def _mission(
        self,
        markers: Sequence[Marker],
        until: int,
        features: tuple[str, ...],
        robots: tuple[str, ...],
    ) -> Mission:
        start, cells = markers[0], tuple(marker.cell for marker in markers)
        for k, marker in enumerate(markers):
            if marker.bound != k:
                raise TrustboError(f"bound {marker.bound} follows bound {k - 1}.")
        path = start.path or cells
        if path[0] != cells[0]:
            raise TrustboError(f"it starts in {cells[0]}, but its path in {path[0]}.")
        poses = [_continuous(series, start.time, until) for series in self.poses]
        ends = [*(marker.time for marker in markers[2:]), until]
        bounds = []
        for marker, end in zip(markers[1:], ends, strict=True):
            try:
                bounds.append(self._bound(marker, end, start.time, poses, len(features)))
            except TrustboError as error:
                raise TrustboError(f"bound {marker.bound}: {error}") from None
        statuses = self.status.between(markers[-1].time, until).value
        status = str(statuses[-1]) if len(statuses) else "ok"
        if status == "ok" and len(bounds) < len(path) - 1:
            status = "aborted"  # no record of the reason
        return Mission(path, tuple(bounds), status, features, robots)

    def _bound(
        self, marker: Marker, until: int, start: int, poses: Sequence[Series], n_features: int
    ) -> Bound:
        statuses = self.status.between(marker.time, until)
        end = int(statuses.time[0]) if len(statuses.time) else until
        contacts = [series.between(marker.time, end) for series in self.contact]
        if not len(statuses.time):
            end = max((int(c.time[-1]) for c in contacts if len(c.time)), default=marker.time)
        recorded = [~np.isnan(c.value) for c in contacts]  # an unmeasured contact is no tick
        contacts = [
            Series(c.time[mask], c.value[mask] > 0.5)
            for c, mask in zip(contacts, recorded, strict=True)
        ]
        n_ticks = np.array([len(c.time) for c in contacts])
        ticks = contacts[int(np.argmax(n_ticks))].time
        measured = [series.between(marker.time, until).value for series in self.awareness]
        unknown = np.full(n_features, np.nan)
        moved = [series.between(marker.time, end) for series in self.states]
        kept = len(moved) == len(contacts) and all(len(series.time) for series in moved)
        seconds = (end - marker.time) / _NS if end > marker.time else np.nan
        return Bound(
            marker.cell,
            np.stack([values[-1] if len(values) else unknown for values in measured]),
            np.array([c.value.mean() if len(c.value) else np.nan for c in contacts]),
            np.full(len(contacts), seconds),
            str(statuses.value[0]) if len(statuses.time) else "ok",
            (marker.time - start) / _NS,
            np.stack([_held(series, ticks) for series in poses], axis=1) if poses else None,
            np.stack([_aligned(c, ticks) for c in contacts], axis=1) if n_ticks.all() else None,
            np.where(n_ticks > 0, n_ticks, np.nan),
            np.stack([_held(series, ticks) for series in moved], axis=1) if kept else None,
        )


def _aligned(contact: Series, ticks: np.ndarray) -> np.ndarray:
    """Contact tick by tick: in order if there are as many records, else the last at each tick."""
    if len(contact.time) == len(ticks):
        return contact.value
    return contact.value[np.maximum(np.searchsorted(contact.time, ticks, side="right") - 1, 0)]


def _held(series: Series, ticks: np.ndarray) -> np.ndarray:
    """Latest record at each tick, shape (tick, ...); NaN before the first."""
    last = np.searchsorted(series.time, ticks, side="right") - 1
    padded = np.concatenate([np.full((1, *series.value.shape[1:]), np.nan), series.value])
    return padded[last + 1]


def _continuous(poses: Series, start: int, until: int) -> Series:
    """Poses of a mission, and the last before it; headings without jumps from its start on."""
    first, last = np.searchsorted(poses.time, (start, until), side="right")
    values = poses.value[max(first - 1, 0) : last].copy()
    kept = slice(min(first, 1), None)
    values[kept, 2] = np.unwrap(values[kept, 2])
    return Series(poses.time[max(first - 1, 0) : last], values)
