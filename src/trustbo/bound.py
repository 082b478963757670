"""Measurements of one bound."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from trustbo.arrays import as_array, require_unit_interval
from trustbo.display import Rows, Summary, number
from trustbo.errors import TrustboError, require_choice

Cell = tuple[int, int]
Status = Literal["ok", "stuck", "tipped", "timeout", "collision", "lost_contact", "aborted"]
STATUSES: tuple[str, ...] = get_args(Status)
NOWHERE: Cell = (-1, -1)
"""Cell of a bound of a log without a map."""


@dataclass(frozen=True, eq=False, repr=False)
class Bound(Summary):
    """Measurements of one bound, one row per overwatching robot.

    Attributes:
        cell: Planning cell entered, (row, col); `NOWHERE` in a log without a map.
        awareness: Situational awareness, shape (robot, feature), in [0, 1], or of any finite values
            in a log without a map; NaN where not measured.
        contact_rate: Share of the running time in contact, shape (robot,); NaN where not measured.
        duration: Running time of the bound, shape (robot,), s; NaN where not recorded.
        status: Outcome of the bound, `"ok"` or the reason that ended the mission.
        t0: Start of the bound, s since the mission's start.
        poses: Shape (tick, 1 + robot, 3), the lead first: x and y in CRS metres, heading in rad
            from east, anticlockwise. None where not recorded.
        contact: Contact of each robot at each tick, shape (tick, robot). None where not recorded.
        n_ticks: Number of ticks, shape (robot,), of which `contact_rate` is the share with contact;
            NaN where not recorded.
        states: Motion and sensing of each robot, shape (tick, robot, state): share of its speed on
            level ground, pitch and roll (rad), mean range of returns (m), share of clear beams.
            None where not recorded.

    Raises:
        TrustboError: The arrays disagree on the number of robots; a value outside [0, 1], a
            duration that is not positive, an n_ticks below 1, a rate that is not a share of the
            ticks, or an unknown status.
    """

    cell: Cell
    awareness: np.ndarray
    contact_rate: np.ndarray
    duration: np.ndarray
    status: str = "ok"
    t0: float = 0.0
    poses: np.ndarray | None = None
    contact: np.ndarray | None = None
    n_ticks: np.ndarray = None  # pyright: ignore[reportAssignmentType]
    states: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name, n_axes in (("awareness", 2), ("contact_rate", 1), ("duration", 1)):
            array = as_array(name, getattr(self, name))
            if array.ndim != n_axes:
                axes = "(robot, feature)" if n_axes == 2 else "(robot,)"
                raise TrustboError(f"{name} of a bound must be {axes}; got shape {array.shape}.")
            object.__setattr__(self, name, array)
        lengths = [len(self.awareness), len(self.contact_rate), len(self.duration)]
        if len(set(lengths)) != 1:
            raise TrustboError(
                "awareness, contact_rate and duration must have one row per robot; "
                f"got {lengths[0]}, {lengths[1]}, {lengths[2]}."
            )
        if not self.awareness.size:
            raise TrustboError(
                "a bound is of one robot and one feature at least; got awareness of shape "
                f"{self.awareness.shape}. Without features, give one that is 0 everywhere."
            )
        require_choice("status", self.status, STATUSES)
        ticks = np.full(lengths[0], np.nan) if self.n_ticks is None else self.n_ticks
        object.__setattr__(self, "n_ticks", as_array("n_ticks", ticks))
        mapped = self.cell != NOWHERE
        where = f"the bound into cell {self.cell}" if mapped else "a bound of no map"
        require_unit_interval(f"contact_rate of {where}", self.contact_rate)
        if mapped:
            require_unit_interval(f"awareness of {where}", self.awareness)
        elif np.isinf(self.awareness).any():
            raise TrustboError(f"awareness of {where} must be finite, or NaN where not measured.")
        if (self.duration <= 0).any():
            robot = int(np.argmax(self.duration <= 0))
            raise TrustboError(f"duration[{robot}] = {self.duration[robot]:g} s must be positive.")
        require_shares(self.contact_rate, self.n_ticks)

    @property
    def contact_time(self) -> np.ndarray:
        """Time in contact with the lead, shape (robot,), s."""
        return self.contact_rate * self.duration

    @property
    def t1(self) -> float:
        """End of the bound, s since the mission's start."""
        return self.t0 + float(np.nanmax(self.duration, initial=0.0))

    def _rows(self) -> Rows:
        return [
            ("cell", str(self.cell) if self.cell != NOWHERE else "none: no map"),
            ("status", self.status),
            ("contact rate", np.array2string(self.contact_rate, precision=2)),
            ("duration", f"{np.array2string(self.duration, precision=1)} s"),
            ("begins", number(self.t0, "s", 4)),
        ]


def require_shares(rate: np.ndarray, ticks: np.ndarray) -> None:
    """Refuse ticks that are not whole, and rates that are not a share of them; both (robot,)."""
    if ticks.shape != rate.shape:
        raise TrustboError(f"n_ticks of a bound must be {rate.shape}; got shape {ticks.shape}.")
    for i in np.flatnonzero((ticks < 1.0) | (ticks != np.round(ticks)) & ~np.isnan(ticks)):
        raise TrustboError(f"n_ticks[{i}] = {ticks[i]:g} must be a whole number of ticks.")
    off = np.abs(rate * ticks - np.round(rate * ticks)) > 1e-6 * ticks
    for i in np.flatnonzero(off):
        raise TrustboError(
            f"contact_rate[{i}] = {rate[i]:g} is no share of {ticks[i]:g} ticks (n_ticks)."
        )
