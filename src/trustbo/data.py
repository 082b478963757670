"""Missions of a team of robots, bound by bound."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.display import Rows, Summary, joined
from trustbo.errors import TrustboError, require_cells, require_choice, require_whole

Cell = tuple[int, int]
STATUSES = ("ok", "stuck", "tipped", "timeout", "collision", "lost_contact", "aborted")
NOWHERE: Cell = (-1, -1)
"""Cell of the bounds in a log without a map."""
FEATURES = ("traversability", "visibility")
"""Names of the first two features, z1 and z2 of the paper."""
SHARE_TOLERANCE = 1e-6
"""Largest difference of a contact rate from a multiple of 1 / n_ticks."""
LINE_OF_SIGHT = "line_of_sight"
"""Feature name of the predicted contact rate; `line_of_sight_1`, `_2`, ... if several."""


@dataclass(frozen=True, eq=False)
class Bound:
    """Measurements of one bound, one row per overwatching robot.

    Attributes:
        cell: Planning cell entered, (row, col); `NOWHERE` in a log without a map.
        awareness: Situational awareness, shape (robot, feature), in [0, 1], or any finite values in
            a log without a map; NaN where not measured.
        contact_rate: Fraction of time in contact, shape (robot,); NaN where not measured.
        duration: Running time of the bound, shape (robot,), s; NaN where not recorded.
        status: Outcome of the bound, `"ok"` or the reason that ended the mission.
        t0: Start of the bound, s since the mission's start.
        poses: Shape (tick, 1 + robot, 3), the lead first: x and y in CRS metres, heading in rad
            from east, anticlockwise. None where not recorded.
        contact: Contact of each robot at each tick, shape (tick, robot). None where not recorded.
        n_ticks: Number of ticks over which `contact_rate` is averaged, shape (robot,); NaN where
            not recorded.

    Raises:
        TrustboError: The arrays disagree on the number of robots, a value is outside [0, 1], a
            duration is not positive, n_ticks is not a positive whole number, a rate is not a
            multiple of 1 / n_ticks, or the status is unknown.
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

    def __post_init__(self) -> None:
        for name in ("awareness", "contact_rate", "duration", "n_ticks"):
            given = getattr(self, name)
            values = np.full(len(self.awareness), np.nan) if given is None else given
            object.__setattr__(self, name, as_array(name, values))
        if self.awareness.ndim != 2 or not self.awareness.size:
            raise TrustboError(
                "awareness of a bound must have shape (robot, feature) without zeros; got "
                f"{self.awareness.shape}. If you have no features, give one feature that is 0."
            )
        per_robot = self.awareness.shape[:1]
        for name in ("contact_rate", "duration"):
            if (shape := getattr(self, name).shape) != per_robot:
                raise TrustboError(f"{name} of a bound must be {per_robot}; got shape {shape}.")
        require_choice("status", self.status, STATUSES)
        mapped = self.cell != NOWHERE
        where = f"the bound into cell {self.cell}" if mapped else "a bound without a map"
        require_unit_interval(f"contact_rate of {where}", self.contact_rate)
        if mapped:
            require_unit_interval(f"awareness of {where}", self.awareness)
        elif np.isinf(self.awareness).any():
            raise TrustboError(f"awareness of {where} must be finite, or NaN where not measured.")
        for i in np.flatnonzero(self.duration <= 0.0):
            raise TrustboError(f"duration[{i}] = {self.duration[i]:g} s must be positive.")
        require_shares(self.contact_rate, self.n_ticks)

    @property
    def t1(self) -> float:
        """End of the bound, s since the mission's start."""
        return self.t0 + float(np.nanmax(self.duration, initial=0.0))


@dataclass(frozen=True, eq=False, repr=False)
class Mission(Summary):
    """One traversal of a path: the bounds that were run, and the outcome.

    Attributes:
        path: Planned cells, start first, each (row, col); empty in a log without a map.
        bounds: Bounds that were run; bound k enters `path[k]`. If the mission ended early, there
            are fewer bounds than planned, and the last one has the status of the mission.
        status: `"ok"` if the mission reached the goal, else the reason why it did not.
        features: Names of the features, in the order of the last axis of `awareness`.
        robots: Names of the overwatching robots.
        scale: Scale of a person's trust reports, such as `"likert7"`, if `contact_rate` holds such
            reports instead of contact (see `logs.read_reports`); empty in all other missions.

    Raises:
        TrustboError: The bounds do not fit the path, or disagree on robots or features, or the
            status or the scale is unknown.
    """

    path: tuple[Cell, ...]
    bounds: tuple[Bound, ...]
    status: str = "ok"
    features: tuple[str, ...] = ()
    robots: tuple[str, ...] = ()
    scale: str = ""

    def __post_init__(self) -> None:
        require_choice("status", self.status, STATUSES)
        n_run, n_planned = len(self.bounds), len(self.path) - 1
        if not n_run or (self.path and n_run > n_planned):
            most = f" and at most {n_planned} on its path" if self.path else ""
            raise TrustboError(
                f"a mission has at least one bound{most}; got {n_run}. If no bound was run, use "
                "`Campaign.fail`."
            )
        if self.status == "ok" and n_run < n_planned:
            raise TrustboError(
                f'status "ok" means that the goal was reached, but only {n_run} of {n_planned} '
                "bounds were run; give the status of the last one."
            )
        for k, bound in enumerate(self.bounds, start=1):
            if bound.cell != (expected := self.path[k] if self.path else NOWHERE):
                there = "there is no path" if expected == NOWHERE else f"the path has {expected}"
                raise TrustboError(f"bound {k} enters {bound.cell}, but {there}.")
        shapes = {bound.awareness.shape for bound in self.bounds}
        if len(shapes) > 1:
            raise TrustboError(f"bounds disagree on (robot, feature): {sorted(shapes)}.")
        n_robots, n_features = shapes.pop()
        robots = tuple(f"r{i + 1}" for i in range(n_robots))
        for name, usual in (("features", default_features(n_features)), ("robots", robots)):
            labels = tuple(getattr(self, name)) or usual
            if len(labels) != len(usual):
                raise TrustboError(f"{name} must be {len(usual)} names; got {labels}.")
            object.__setattr__(self, name, labels)
        if self.scale:
            levels_of(self.scale)

    def _rows(self) -> Rows:
        rates, took = self.contact_rate, self.bounds[-1].t1
        planned = f"{path_text(self.path[:1])} to {path_text(self.path[-1:])}"
        measured = "trust reported" if self.scale else "contact rate"
        by_robot = zip(self.robots, pd.DataFrame(rates).mean(), strict=True)
        return [
            ("path", planned if self.path else "none: no map"),
            ("outcome", f"{self.status}, {len(self.bounds)} bounds run"),
            (measured, f"{np.isnan(rates).sum()} missing"),
            *((f"  {name}", f"{rate:.3f}") for name, rate in by_robot),
            ("features", joined(self.features)),
            ("takes", f"{took:.4g} s" if took else "not measured"),
        ]

    @classmethod
    def from_arrays(
        cls,
        path: Sequence[Cell] | None,
        awareness: ArrayLike,
        contact_rate: ArrayLike,
        duration: ArrayLike | None = None,
        status: str = "ok",
        *,
        n_ticks: ArrayLike | None = None,
        features: Sequence[str] = (),
        robots: Sequence[str] = (),
    ) -> Self:
        """Make a mission from the arrays of a log.

        A mission that ended early has fewer bounds than planned, and a status:
        `from_arrays(path, z, y, status="stuck")`. A bound that was not measured is a row of NaN.

        Args:
            path: Planned cells, start first; None for a log without a map, which supports neither
                planning nor place effects.
            awareness: Shape (bound, robot, feature), in [0, 1]; any finite values in a log without
                a map.
            contact_rate: Shape (bound, robot), in [0, 1].
            duration: Shape (bound, robot) or (bound,), s; None where not recorded.
            status: Outcome of the mission.
            n_ticks: Number of ticks over which `contact_rate` is averaged, shape (bound, robot) or
                (bound,); None where not recorded.
            features: Names of the features; by default traversability, visibility, z3, ... (a
                workspace with the same number of features renames z3, ...).
            robots: Names of the robots; by default r1, r2, ...

        Raises:
            TrustboError: The axes do not fit together, a value is outside [0, 1], or the status is
                unknown.
        """
        labels = {"robot": robots, "feature": features}
        z = _labelled("awareness", awareness, ("bound", "robot", "feature"), **labels)
        y = _labelled("contact_rate", contact_rate, ("bound", "robot"), robot=robots)
        if z.ndim != 3 or y.shape != z.shape[:2]:
            raise TrustboError(
                "awareness must be (bound, robot, feature) and contact_rate (bound, robot); "
                f"got {z.shape} and {y.shape}."
            )
        seconds, ticks = _per_robot("duration", duration, y), _per_robot("n_ticks", n_ticks, y)
        cells = () if path is None else require_cells("path", path)
        if path is not None and len(cells) <= len(y):
            raise TrustboError(
                f"{len(y)} bounds need a path of at least {len(y) + 1} cells; got {len(cells)}. "
                "Give None for a log without a map."
            )
        ends = np.cumsum(np.nan_to_num(seconds).max(axis=1)).tolist()
        entered, statuses = cells[1:] or (NOWHERE,) * len(y), ["ok"] * (len(y) - 1) + [status]
        measured = zip(entered, z, y, seconds, statuses, [0.0, *ends], ticks, strict=False)
        bounds = tuple(Bound(*values, n_ticks=n) for *values, n in measured)
        named = as_names("features", features), as_names("robots", robots)
        return cls(cells, bounds, status, *named)

    def with_awareness(self, awareness: np.ndarray) -> Self:
        """Return the mission with another awareness, shape (bound, robot, feature)."""
        bounds = zip(self.bounds, awareness, strict=True)
        return replace(self, bounds=tuple(replace(bound, awareness=z) for bound, z in bounds))

    def in_order(
        self, robots: Sequence[str], features: Sequence[str], unmeasured: Sequence[str]
    ) -> Self:
        """Return the mission with its robots and features in the order of these names.

        Features in `unmeasured` may be missing from the mission; their values are then NaN. Raises
        TrustboError if the mission has other robots or features.
        """
        names = {"robots": tuple(robots), "features": tuple(features)}
        if names == {"robots": self.robots, "features": self.features}:
            return self
        lacks = [name for name in features if name in unmeasured and name not in self.features]
        own = {"robots": self.robots, "features": (*self.features, *lacks)}
        for what, wanted in names.items():
            if sorted(own[what]) != sorted(wanted):
                raise TrustboError(
                    f"the mission has {what} {getattr(self, what)}, not {wanted}; rename them, or "
                    "use a workspace with these names."
                )
        i, m = ([own[what].index(name) for name in wanted] for what, wanted in names.items())
        bounds = []
        for b in self.bounds:
            z = np.pad(b.awareness, ((0, 0), (0, len(lacks))), constant_values=np.nan)
            per_robot = {n: getattr(b, n)[i] for n in ("contact_rate", "duration", "n_ticks")}
            if b.contact is not None:
                per_robot["contact"] = b.contact[:, i]
            if b.poses is not None:
                per_robot["poses"] = b.poses[:, [0, *(1 + j for j in i)]]
            bounds.append(replace(b, awareness=z[np.ix_(i, m)], **per_robot))
        return replace(self, bounds=tuple(bounds), **names)

    def has_same_data(self, other: "Mission") -> bool:
        """Return whether another mission has the same path, outcome and measurements."""
        about = ("path", "status", "features", "robots", "scale")
        if any(getattr(self, name) != getattr(other, name) for name in about):
            return False
        if [bound.status for bound in self.bounds] != [bound.status for bound in other.bounds]:
            return False
        measured = ("awareness", "contact_rate", "duration", "n_ticks")
        return all(
            np.array_equal(getattr(self, name), getattr(other, name), equal_nan=True)
            for name in measured
        )

    @cached_property
    def awareness(self) -> np.ndarray:
        """Measured awareness, shape (bound, robot, feature)."""
        return self._stacked("awareness")

    @cached_property
    def contact_rate(self) -> np.ndarray:
        """Contact rates, shape (bound, robot)."""
        return self._stacked("contact_rate")

    @cached_property
    def duration(self) -> np.ndarray:
        """Running times, shape (bound, robot), s."""
        return self._stacked("duration")

    @cached_property
    def n_ticks(self) -> np.ndarray:
        """Ticks, shape (bound, robot); NaN where not recorded."""
        return self._stacked("n_ticks")

    def _stacked(self, name: str) -> np.ndarray:
        """Stack an array of the bounds; cached, as every refit reads those of every mission."""
        array = np.stack([getattr(bound, name) for bound in self.bounds])
        array.flags.writeable = False
        return array


def levels_of(scale: object) -> int:
    """Return the number of levels of a scale; 0 for "unit".

    Raises TrustboError unless it is "unit", or "likertN" or "ordinalN" with N of at least 2.
    """
    found = re.fullmatch(r"(likert|ordinal)(\d*)", scale) if isinstance(scale, str) else None
    if scale != "unit" and found is None:
        raise TrustboError(
            'scale must be "unit", "likertN" or "ordinalN", where N is the number of levels; got '
            f"{scale!r}."
        )
    return 0 if found is None else require_whole("levels of a scale", int(found[2] or 7), 2)


def require_map(what: str, missions: Iterable[Mission]) -> None:
    """Raise TrustboError for missions of a log without a map."""
    for j, mission in enumerate(missions):
        if not mission.path:
            raise TrustboError(
                f"{what} needs the cells of a map, but mission {j} has none (path=None); missions "
                "without a map can only be fitted (without place effects) and scored."
            )


def path_text(path: Iterable[Cell]) -> str:
    """Write cells as on the command line: "9,0 8,1"."""
    return " ".join(f"{row},{col}" for row, col in path)


def is_line_of_sight(feature: str) -> bool:
    """Return whether a feature is a predicted contact rate."""
    return feature.startswith(LINE_OF_SIGHT)


def default_features(n_features: int) -> tuple[str, ...]:
    """Return default names of features: traversability, visibility, z3, z4, ..."""
    return (*FEATURES, *(f"z{m + 1}" for m in range(2, n_features)))[:n_features]


def require_shares(rate: np.ndarray, ticks: np.ndarray) -> None:
    """Reject ticks that are not whole and rates that are not multiples of 1 / ticks."""
    if ticks.shape != rate.shape:
        raise TrustboError(f"n_ticks of a bound must be {rate.shape}; got shape {ticks.shape}.")
    for i in np.flatnonzero((ticks < 1.0) | (ticks != np.round(ticks)) & ~np.isnan(ticks)):
        raise TrustboError(f"n_ticks[{i}] = {ticks[i]:g} must be a whole number of ticks.")
    off = np.abs(rate * ticks - np.round(rate * ticks)) > SHARE_TOLERANCE * ticks
    for i in np.flatnonzero(off):
        raise TrustboError(
            f"contact_rate[{i}] = {rate[i]:g} is not a multiple of 1 / {ticks[i]:g} (n_ticks); "
            "give all decimals, or leave n_ticks out."
        )


def as_array(what: str, values: ArrayLike) -> np.ndarray:
    """Return an array of floats, NaN where masked; raises TrustboError for other values."""
    try:
        if np.ma.isMaskedArray(values):
            return np.ma.filled(np.ma.asarray(values, dtype=float), np.nan)
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise TrustboError(f"{what} must be an array of numbers; got {values!r:.60}.") from None


def as_names(what: str, given: Iterable[str]) -> tuple[str, ...]:
    """Return names as a tuple; raises TrustboError if one is not a string or is repeated."""
    listed = isinstance(given, Iterable) and not isinstance(given, str)
    names = tuple(given) if listed else ()
    if not listed or not all(isinstance(name, str) for name in names):
        raise TrustboError(f"{what} must be a list of names; got {given!r:.60}.")
    if len(set(names)) < len(names):
        raise TrustboError(f"{what} must be different names; got {names}.")
    return names


def require_unit_interval(what: str, values: np.ndarray) -> None:
    """Raise TrustboError for values outside [0, 1]; NaN is allowed."""
    bad = (values < 0.0) | (values > 1.0)
    if bad.any():
        index = ", ".join(str(i) for i in np.argwhere(bad)[0])
        scaled = "percent? divide by 100; rating from 1 to n? (rating - 1) / (n - 1)"
        hint = f" ({scaled})" if np.nanmin(values) >= 0.0 else ""
        raise TrustboError(f"{what}: [{index}] = {values[bad][0]:g} is outside [0, 1]{hint}.")


def _labelled(what: str, values: Any, dims: Sequence[str], **names: Sequence[str]) -> np.ndarray:
    """Return an array with its dims, and the names along some of them, in the given order.

    Labels are the dims and coordinates of a DataArray, or the column names of a DataFrame for the
    last dim, if they are strings. Raises TrustboError if they are not the given dims or names.
    """
    if isinstance(values, pd.DataFrame) and all(isinstance(name, str) for name in values):
        numbers = values.to_numpy(dtype=object, na_value=np.nan)  # also pd.NA
        values = xr.DataArray(numbers, dims=dims, coords={dims[-1]: list(values)})
    if not isinstance(values, xr.DataArray):
        return as_array(what, values)
    if {*values.dims} != {*dims}:
        raise TrustboError(f"{what} must have the dims {tuple(dims)}; got {values.dims}.")
    for dim, given in names.items():
        there = [str(name) for name in values[dim].values] if dim in values.coords else []
        if there and given and sorted(there) != sorted(given):
            raise TrustboError(f"{what} has the {dim}s {there}, not {list(given)}.")
        if there and given:
            values = values.isel({dim: [there.index(name) for name in given]})
    return as_array(what, values.transpose(*dims))


def _per_robot(what: str, given: ArrayLike | None, rates: np.ndarray) -> np.ndarray:
    """Broadcast one number, or values (bound,) or (bound, robot), to (bound, robot)."""
    values = as_array(what, np.nan if given is None else given)
    try:
        return np.broadcast_to(values[:, None] if values.ndim == 1 else values, rates.shape)
    except ValueError:
        raise TrustboError(f"{what} must be {rates.shape}; got {values.shape}.") from None
