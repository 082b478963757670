"""Missions of a team of robots, bound by bound."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from trustbo.arrays import as_names, default_robots, read_labelled, without_rounding
from trustbo.display import Rows, Summary, joined
from trustbo.errors import (
    TrustboError,
    require_cells,
    require_choice,
    require_finite,
    require_kind,
    require_list,
    require_order,
    require_pair,
    require_whole,
)

Cell = tuple[int, int]
STATUSES = ("ok", "stuck", "tipped", "timeout", "collision", "lost_contact", "aborted")
NOWHERE: Cell = (-1, -1)
"""Cell of the bounds in a log without a map."""
FEATURES = ("traversability", "visibility")
"""Names of the first two features, z1 and z2 of the paper."""
SHARE_TOLERANCE = 1e-6
"""Largest difference of a contact rate from a multiple of 1 / n_ticks."""
_USUAL_LEVELS = 7
"""Number of levels of the scales "likert" and "ordinal"."""
LINE_OF_SIGHT = "line_of_sight"
"""Feature name of the predicted contact rate; `line_of_sight_1`, `_2`, ... for several."""


@dataclass(frozen=True, eq=False, repr=False)
class Bound:
    """Measurements of one bound, one row per overwatching robot.

    The measurements are copied, so the given arrays may be used again.

    Attributes:
        cell: Planning cell entered, (row, col); `NOWHERE` in a log without a map.
        awareness: Situational awareness, shape (robot, feature), in [0, 1], or any finite values in
            a log without a map; NaN where not measured.
        contact_rate: Fraction of time in contact, shape (robot,); NaN where not measured.
        duration: Running time of the bound, shape (robot,), s; NaN where not recorded.
        status: Outcome of the bound, `"ok"` or the reason why the lead did not complete it.
        t0: Start of the bound, s since the mission's start.
        poses: Shape (tick, 1 + robot, 3), the lead first: x and y in CRS metres, heading in rad
            from east, anticlockwise. None where not recorded.
        contact: Whether each robot has contact at each tick, shape (tick, robot), at the ticks of
            `poses`. None where not recorded.
        n_ticks: Number of ticks over which `contact_rate` is averaged, shape (robot,); NaN where
            not recorded.

    Raises:
        TrustboError: The arrays disagree on the number of robots or ticks, a value is outside
            [0, 1], a duration is infinite or not positive, n_ticks is not a positive whole number,
            a rate is not a multiple of 1 / n_ticks, contact at a tick is neither True nor False, or
            the status is unknown.

    Example:
        >>> bound = mission.bounds[0]
        >>> bound.cell == mission.path[1], bound.status
        (True, 'ok')
        >>> bound.contact_rate, bound.t1 - bound.t0  # of each robot; in seconds
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
        object.__setattr__(self, "cell", require_pair("the cell of a bound", self.cell))
        object.__setattr__(self, "t0", require_finite("t0 of a bound", self.t0))
        object.__setattr__(self, "awareness", _unnamed("awareness", self.awareness))
        if self.awareness.ndim != 2 or not self.awareness.size:
            raise TrustboError(
                "awareness of a bound must have shape (robot, feature) without zeros; got "
                f"{self.awareness.shape}. If you have no features, give one feature that is 0."
            )
        for name in ("contact_rate", "duration", "n_ticks"):
            given = getattr(self, name)
            values = np.full(len(self.awareness), np.nan) if given is None else given
            object.__setattr__(self, name, _unnamed(name, values))

        per_robot = self.awareness.shape[:1]
        for name in ("contact_rate", "duration"):
            shape = getattr(self, name).shape
            if shape != per_robot:
                raise TrustboError(f"{name} of a bound must be {per_robot}; got shape {shape}.")

        require_choice("status", self.status, STATUSES)

        mapped = self.cell != NOWHERE
        where = f"the bound into cell {self.cell}" if mapped else "a bound without a map"
        rates = require_unit_interval(f"contact_rate of {where}", self.contact_rate)
        object.__setattr__(self, "contact_rate", rates)
        if mapped:
            z = require_unit_interval(f"awareness of {where}", self.awareness)
            object.__setattr__(self, "awareness", z)
        elif np.isinf(self.awareness).any():
            raise TrustboError(f"awareness of {where} must be finite, or NaN where not measured.")

        is_bad = (self.duration <= 0.0) | np.isinf(self.duration)
        if is_bad.any():
            i = np.flatnonzero(is_bad)[0]
            raise TrustboError(
                f"duration[{i}] = {self.duration[i]:g} s must be positive and finite."
            )

        ticks = require_shares(self.contact_rate, self.n_ticks)
        object.__setattr__(self, "n_ticks", ticks)
        _require_recorded(len(self.awareness), self.poses, self.contact)
        for name in ("poses", "contact"):
            values = getattr(self, name)
            object.__setattr__(self, name, None if values is None else np.array(values))

    def __repr__(self) -> str:
        rates = ", ".join(f"{rate:.3f}" for rate in self.contact_rate)
        seconds = np.nanmax(self.duration, initial=0.0)
        duration = f", duration={seconds:.4g} s" if seconds else ""
        place = "no map" if self.cell == NOWHERE else f"cell={self.cell}"
        return f"Bound({place}, status={self.status!r}, contact_rate=[{rates}]{duration})"

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
            are fewer bounds than planned, and the last one has the status of the mission. If the
            mission continued after a bound that failed, the next bound starts in the cell of the
            failed bound; a lead that did not stay there has first driven a bound back to the
            previous cell.
        status: `"ok"` if the mission reached the goal; otherwise, the reason why it did not.
        features: Names of the features, in the order of the last axis of `awareness`.
        robots: Names of the overwatching robots.
        scale: Scale of a person's trust reports, such as `"likert7"`, if `contact_rate` holds such
            reports instead of contact (see `logs.read_reports`); empty in all other missions.
        map: Name of the map to which the cells belong, if it is not the workspace of the missions
            that are fitted together. Places on different maps have independent effects.

    Raises:
        TrustboError: The bounds do not fit the path, or disagree on robots or features, the last
            bound failed although the status is "ok", or the status or the scale is unknown.

    Example:
        >>> rates = np.array([[0.9, 1.0], [0.4, 0.8]])  # (bound, robot)
        >>> unmeasured = np.full((2, 2, 2), np.nan)  # awareness, (bound, robot, feature)
        >>> mission = tb.Mission.from_arrays([(2, 0), (1, 0), (0, 1)], unmeasured, rates)
        >>> mission.bounds[1].cell
        (0, 1)
    """

    path: tuple[Cell, ...]
    bounds: tuple[Bound, ...]
    status: str = "ok"
    features: tuple[str, ...] = ()
    robots: tuple[str, ...] = ()
    scale: str = ""
    map: str = ""

    def __post_init__(self) -> None:
        require_choice("status", self.status, STATUSES)
        require_kind("path", self.path, Sequence, "give the cells in a tuple; () without a map")
        object.__setattr__(self, "path", require_cells("path", self.path))
        for bound in require_kind("bounds", self.bounds, Sequence, "give the bounds in a tuple"):
            require_kind("bounds", bound, Bound, "give a tuple of Bound")
        object.__setattr__(self, "bounds", tuple(self.bounds))

        self._require_fit()

        shapes = {bound.awareness.shape for bound in self.bounds}
        if len(shapes) > 1:
            raise TrustboError(f"bounds disagree on (robot, feature): {sorted(shapes)}.")
        n_robots, n_features = shapes.pop()

        usual_names = {
            "features": default_features(n_features),
            "robots": default_robots(n_robots),
        }
        for name, usual in usual_names.items():
            labels = as_names(name, getattr(self, name)) or usual
            if len(labels) != len(usual):
                raise TrustboError(f"{name} must be {len(usual)} names; got {labels}.")
            object.__setattr__(self, name, labels)

        if not isinstance(self.scale, str) or self.scale:
            levels_of(self.scale)

    def _require_fit(self) -> None:
        """Raise TrustboError unless the bounds and the status fit the path."""
        n_run = len(self.bounds)
        n_planned = len(self.path) - 1
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
        if self.status == "ok" and self.bounds[-1].status != "ok":
            raise TrustboError(
                'status "ok" means that the goal was reached, but the status of the last bound is '
                f"{self.bounds[-1].status!r}; give this status to the mission."
            )

        _require_counted(self.path)
        for k, bound in enumerate(self.bounds, start=1):
            expected = self.path[k] if self.path else NOWHERE
            if bound.cell != expected:
                there = "there is no path" if expected == NOWHERE else f"the path has {expected}"
                raise TrustboError(f"bound {k} enters {bound.cell}, but {there}.")

    def _rows(self) -> Rows:
        rates = self.contact_rate
        took = self.bounds[-1].t1
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
        status: str | Sequence[str] = "ok",
        *,
        n_ticks: ArrayLike | None = None,
        features: Sequence[str] = (),
        robots: Sequence[str] = (),
    ) -> Self:
        """Make a mission from the arrays of a log.

        A mission that ended early has fewer bounds than planned, and a status:
        `from_arrays(path, z, y, status="stuck")`. A bound that was not measured is a row of NaN.

        Arrays may carry labels: the dims and coordinates of a DataArray, the columns and index of a
        DataFrame or Series, or the keys of a dict. Robots and features are put in order by name,
        and bounds by number.

        Args:
            path: Planned cells, start first; None for a log without a map, which supports neither
                planning nor place effects.
            awareness: Situational awareness, shape (bound, robot, feature), in [0, 1]; any finite
                values in a log without a map.
            contact_rate: Contact rates, shape (bound, robot), in [0, 1].
            duration: Running times in seconds, shape (bound, robot) or (bound,), or one number for
                each robot by name; None if not recorded.
            status: Outcome of the mission, or the outcome of each bound if the mission continued
                after a bound that failed.
            n_ticks: Number of ticks over which `contact_rate` is averaged, shape (bound, robot) or
                (bound,); None if not recorded.
            features: Names of the features; by default those of the labels, or traversability,
                visibility, z3, ... (a workspace with the same number of features renames z3, ...).
            robots: Names of the robots; by default those of the labels, or r1, r2, ...

        Raises:
            TrustboError: The axes or labels do not fit together, a value is outside [0, 1], or the
                status is unknown.
        """
        names = {"robot": as_names("robots", robots), "feature": as_names("features", features)}
        z = _read(names, "awareness", awareness, ("bound", "robot", "feature"))
        y = _read(names, "contact_rate", contact_rate, ("bound", "robot"))
        if z.ndim != 3 or y.shape != z.shape[:2] or not len(y):
            raise TrustboError(
                "awareness must be (bound, robot, feature) and contact_rate (bound, robot), with "
                f"at least one bound; got {z.shape} and {y.shape}."
            )

        known = names["robot"] or default_robots(y.shape[1])
        seconds = _per_robot("duration", duration, known, y.shape)
        ticks = _per_robot("n_ticks", n_ticks, known, y.shape)

        cells = () if path is None else require_cells("path", path)
        if path is not None and len(cells) <= len(y):
            raise TrustboError(
                f"{len(y)} bounds need a path of at least {len(y) + 1} cells; got {len(cells)}. "
                "Give None for a log without a map."
            )

        if isinstance(status, str):
            statuses = [*["ok"] * (len(y) - 1), status]
        else:
            remedy = "give one text, or a list with one for each bound"
            statuses = require_list("status", require_order("statuses", status), str, remedy)
        if len(statuses) != len(y):
            raise TrustboError(
                f"status must be one text or {len(y)}, one for each bound; got {len(statuses)}."
            )

        ends = np.cumsum(np.nan_to_num(seconds).max(axis=1)).tolist()
        starts = [0.0, *ends]
        bounds = []
        for k in range(len(y)):
            bound = Bound(
                cells[k + 1] if cells else NOWHERE,
                awareness=z[k],
                contact_rate=y[k],
                duration=seconds[k],
                status=statuses[k],
                t0=starts[k],
                n_ticks=ticks[k],
            )
            bounds.append(bound)

        return cls(cells, tuple(bounds), statuses[-1], names["feature"], names["robot"])

    def with_awareness(self, awareness: np.ndarray) -> Self:
        """Return the mission with another awareness, shape (bound, robot, feature)."""
        names = {"robot": self.robots, "feature": self.features}
        read = read_labelled("awareness", awareness, ("bound", "robot", "feature"), names)
        bounds = zip(self.bounds, read.values, strict=True)
        return replace(self, bounds=tuple(_with_awareness(bound, z) for bound, z in bounds))

    def in_order(
        self, robots: Sequence[str], features: Sequence[str], unmeasured: Sequence[str]
    ) -> Self:
        """Return the mission with its robots and features in the order of these names.

        Args:
            robots: Names of the robots.
            features: Names of the features.
            unmeasured: Features that may be missing from the mission; their values are then NaN.

        Raises:
            TrustboError: The mission has other robots or features.
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
        i = [own["robots"].index(name) for name in robots]
        m = [own["features"].index(name) for name in features]

        bounds = []
        for bound in self.bounds:
            z = np.pad(bound.awareness, ((0, 0), (0, len(lacks))), constant_values=np.nan)
            changes = {"awareness": z[np.ix_(i, m)]}
            for name in ("contact_rate", "duration", "n_ticks"):
                changes[name] = getattr(bound, name)[i]
            if bound.contact is not None:
                changes["contact"] = bound.contact[:, i]
            if bound.poses is not None:
                changes["poses"] = bound.poses[:, [0, *(1 + j for j in i)]]  # the lead is first
            bounds.append(replace(bound, **changes))

        return replace(self, bounds=tuple(bounds), **names)

    def with_robots(self, robots: Sequence[str]) -> Self:
        """Return the mission with these robots, which include its own; added robots have no rates.

        The awareness of added robots is 0, which has no influence because they have no rates. Poses
        and contact at each tick are left out.
        """
        if tuple(robots) == self.robots:
            return self
        where = [robots.index(name) for name in self.robots]

        bounds = []
        for bound in self.bounds:
            changes: dict[str, Any] = {"poses": None, "contact": None}
            for name in ("awareness", "contact_rate", "duration", "n_ticks"):
                own = getattr(bound, name)
                fill = 0.0 if name == "awareness" else np.nan
                changes[name] = np.full((len(robots), *own.shape[1:]), fill)
                changes[name][where] = own
            bounds.append(replace(bound, **changes))

        return replace(self, bounds=tuple(bounds), robots=tuple(robots))

    def has_same_data(self, other: "Mission") -> bool:
        """Return whether another mission has the same path, outcome and measurements."""
        about = ("path", "status", "features", "robots", "scale", "map")
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

    @property
    def statuses(self) -> list[str]:
        """Status of each bound; that of the last bound is the status of the mission."""
        return [*(bound.status for bound in self.bounds[:-1]), self.status]

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
        """Stack an array of the bounds; cached, because every refit reads all missions."""
        array = np.stack([getattr(bound, name) for bound in self.bounds])
        array.flags.writeable = False
        return array


def levels_of(scale: object) -> int:
    """Return the number of levels of a scale; 0 for "unit".

    Raises TrustboError unless it is "unit", or "likertN" or "ordinalN" with N of at least 2.
    """
    text = scale if isinstance(scale, str) else ""
    if text == "unit":
        return 0

    found = re.fullmatch(r"(likert|ordinal)(\d*)", text)
    if found is None:
        raise TrustboError(
            'scale must be "unit", "likertN" or "ordinalN", where N is the number of levels; got '
            f"{scale!r}."
        )
    n_levels = int(found[2] or _USUAL_LEVELS)
    return require_whole("levels of a scale", n_levels, 2)


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


def require_shares(rate: np.ndarray, ticks: np.ndarray) -> np.ndarray:
    """Return ticks, NaN where no tick and no rate was counted.

    Raises TrustboError for ticks that are not whole and rates that are not multiples of 1 / ticks.
    """
    if ticks.shape != rate.shape:
        raise TrustboError(f"n_ticks of a bound must be {rate.shape}; got shape {ticks.shape}.")

    ticks = np.where((ticks == 0.0) & np.isnan(rate), np.nan, ticks)
    is_whole = np.isfinite(ticks) & (ticks == np.round(ticks))
    is_bad = ~np.isnan(ticks) & ~(is_whole & (ticks >= 1.0))
    if is_bad.any():
        i = np.flatnonzero(is_bad)[0]
        raise TrustboError(f"n_ticks[{i}] = {ticks[i]:g} must be a whole number of ticks.")

    off = np.abs(rate * ticks - np.round(rate * ticks)) > SHARE_TOLERANCE * ticks
    if off.any():
        i = np.flatnonzero(off)[0]
        raise TrustboError(
            f"contact_rate[{i}] = {rate[i]:g} is not a multiple of 1 / {ticks[i]:g} (n_ticks); "
            "give all decimals, or leave n_ticks out."
        )
    return ticks


def _with_awareness(bound: Bound, awareness: np.ndarray) -> Bound:
    """Return a bound with another awareness; both share the ticks, which take most memory."""
    changed = replace(bound, awareness=awareness, poses=None, contact=None)
    object.__setattr__(changed, "poses", bound.poses)
    object.__setattr__(changed, "contact", bound.contact)
    return changed


def _require_recorded(n_robots: int, poses: Any, contact: Any) -> None:
    """Raise TrustboError unless poses and contact of a bound have the same ticks and robots."""
    shapes = {"poses": (1 + n_robots, 3), "contact": (n_robots,)}
    n_ticks = set()
    for name, values in (("poses", poses), ("contact", contact)):
        if values is None:
            continue
        shape = np.shape(values)
        if not shape or shape[1:] != shapes[name]:
            raise TrustboError(f"{name} of a bound must be (tick, *{shapes[name]}); got {shape}.")
        n_ticks.add(shape[0])

    if len(n_ticks) > 1:
        raise TrustboError(
            f"poses of a bound have {len(poses)} ticks, but contact has {len(contact)}; give both "
            "at the same times."
        )
    if contact is not None and not np.isin(contact, (0, 1)).all():
        raise TrustboError(
            "contact of a bound must be True or False at each tick; give contact=None if it was "
            "not measured at some ticks, and the contact_rate of the others."
        )


def require_unit_interval(what: str, values: np.ndarray) -> np.ndarray:
    """Return values in [0, 1] or NaN, without rounding; raises TrustboError for values outside."""
    values = without_rounding(values)
    bad = (values < 0.0) | (values > 1.0)
    if bad.any():
        index = ", ".join(str(i) for i in np.argwhere(bad)[0])
        scaled = "percent? divide by 100; rating from 1 to n? (rating - 1) / (n - 1)"
        hint = f" ({scaled})" if np.nanmin(values) >= 0.0 else ""
        raise TrustboError(f"{what}: [{index}] = {values[bad][0]:g} is outside [0, 1]{hint}.")
    return values


def _require_counted(path: Iterable[Cell]) -> None:
    """Raise TrustboError for negative rows or columns, which would be read from the other end."""
    for cell in path:
        if min(cell) < 0:
            raise TrustboError(
                f"the path enters {tuple(cell)}, but rows and columns are counted from 0; give "
                "path=None for a log without a map."
            )


def _unnamed(what: str, values: Any) -> np.ndarray:
    """Copy an array of a bound, whose robots and features have no names."""
    dims = ("robot", "feature") if what == "awareness" else ("robot",)
    return np.array(read_labelled(f"{what} of a bound", values, dims, dict.fromkeys(dims)).values)


def _read(
    names: dict[str, tuple[str, ...]], what: str, values: Any, dims: Sequence[str]
) -> np.ndarray:
    """Read an array in the order of `names`; names that are not known come from its labels."""
    coords = {dim: names[dim] for dim in dims if dim in names}
    read = read_labelled(what, values, dims, coords)
    names |= read.coords
    return read.values


def _per_robot(what: str, given: Any, robots: Sequence[str], shape: tuple[int, ...]) -> np.ndarray:
    """Read one number, or values (bound,) or (bound, robot), as an array (bound, robot)."""
    if given is None:
        return np.full(shape, np.nan)
    dims = ("bound", "robot")
    coords = {"robot": robots}
    values = read_labelled(what, given, dims, coords, partial=True).values
    try:
        return np.broadcast_to(values[:, None] if values.ndim == 1 else values, shape)
    except ValueError:
        raise TrustboError(f"{what} must be {shape}; got {values.shape}.") from None
