"""Missions of a team of robots, bound by bound."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from trustbo.arrays import as_names, default_robots, read_labelled, some_of, without_rounding
from trustbo.display import Rows, Summary, joined
from trustbo.errors import (
    TrustboError,
    require_cells,
    require_choice,
    require_finite,
    require_list,
    require_order,
    require_positive,
    require_whole,
)
from trustbo.fixed import Fixed, fixed_array

Cell = tuple[int, int]
Station = tuple[Any, ...]
"""Cell of a path, (row, col), or (row, col, name) with the set of posts for the move out of it."""
POST_SETS = ("standard", "far", "route")
"""Names of the sets of posts from which T2 can watch the lead's move out of a cell.

A cell of a path without a name means the first set.
"""
STATUSES = ("ok", "stuck", "tipped", "timeout", "collision", "lost_contact", "aborted")
NOWHERE: Cell = (-1, -1)
"""Cell of the bounds in a log without a map."""
FEATURES = ("traversability", "visibility")
"""Names of the first two features, z1 and z2 of the paper."""
SHARE_TOLERANCE = 1e-6
"""Largest difference of a contact rate from a multiple of 1 / n_ticks."""
_EARLIEST = 1e9
"""Time from which on a clock counts as Unix time, s; others count from some start."""
_USUAL_LEVELS = 7
"""Number of levels of the scales "likert" and "ordinal"."""
LINE_OF_SIGHT = "line_of_sight"
"""Feature name of the predicted contact rate; `line_of_sight_1`, `_2`, ... for several."""
THREAT = "threat"
"""Feature name of the exposure to a threat, from 0 to 1; see `Workspace.with_threat`."""
MEASURED = ("awareness", "contact_rate", "duration", "n_ticks")
"""Names of the arrays of a mission, which have the axes bound and robot."""
_DIMS = ("bound", "robot", "feature")
"""Axes of awareness, in order; the other arrays have the first two."""
OF_BOUNDS = (*MEASURED, "bound_status", "starts", "poses", "contact")
"""What a mission holds of each bound, in the order of the attributes of `Bound` after the cell."""


class Sighting(NamedTuple):
    """Place at which a robot saw a threat during a mission, such as a jammer.

    Attributes:
        x: Easting in CRS metres.
        y: Northing in CRS metres.
        sd: Standard deviation of the place in each direction, m.
        robot: Name of the robot that saw it; empty if unknown.
        t: Time since the mission's start, s; NaN if unknown.

    Example:
        >>> mission = dataclasses.replace(mission, sightings=[tb.Sighting(1748100.0, 5427300.0)])
    """

    x: float
    y: float
    sd: float = 20.0
    robot: str = ""
    t: float = np.nan


@dataclass(frozen=True, eq=False, repr=False)
class Bound:
    """Measurements of one bound, one row per overwatching robot: an entry of `Mission.bounds`.

    `Mission` checks the values.

    Attributes:
        cell: Planning cell entered, (row, col); `NOWHERE` in a log without a map.
        awareness: Situational awareness, shape (robot, feature), in [0, 1], or any finite values in
            a log without a map; NaN where not measured.
        contact_rate: Fraction of time in contact, shape (robot,); NaN where not measured.
        duration: Running time of the bound, shape (robot,), s; NaN where not recorded.
        n_ticks: Number of ticks over which `contact_rate` is averaged, shape (robot,); NaN where
            not recorded.
        status: Outcome of the bound, `"ok"` or the reason why the lead did not complete it.
        t0: Start of the bound, s since the mission's start.
        poses: Shape (tick, 1 + robot, 3), the lead first: x and y in CRS metres, heading in rad
            from east, anticlockwise. None where not recorded.
        contact: Whether each robot has contact at each tick, shape (tick, robot), at the ticks of
            `poses`. None where not recorded.

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
    n_ticks: np.ndarray
    status: str = "ok"
    t0: float = 0.0
    poses: np.ndarray | None = None
    contact: np.ndarray | None = None

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
class Mission(Fixed, Summary):
    """One traversal of a path: the measurements of the bounds that were run, and the outcome.

    `from_arrays` makes a mission of the arrays of a log, which may carry labels. The arrays of a
    mission are read-only copies of those given.

    Bound k enters `path[k]`. If the mission ended early, there are fewer bounds than planned, and
    the last one has the status of the mission. If the mission continued after a bound that failed,
    the next bound starts in the cell of the failed bound; a lead that did not stay there has first
    driven a bound back to the previous cell.

    Attributes:
        path: Planned cells (row, col), start first; empty in a log without a map. If stations are
            given, as in `stations`, they are split into cells and `post_sets`.
        awareness: Situational awareness, shape (bound, robot, feature), in [0, 1], or any finite
            values in a log without a map; NaN where not measured.
        contact_rate: Fraction of time in contact, shape (bound, robot); NaN where not measured.
        duration: Running times, shape (bound, robot), s; NaN where not recorded.
        n_ticks: Number of ticks over which `contact_rate` is averaged, shape (bound, robot); NaN
            where not recorded.
        starts: Start of each bound, s since the mission's start.
        bound_status: Outcome of each bound, `"ok"` or the reason why the lead did not complete it.
        status: `"ok"` if the mission reached the goal; otherwise, the reason why it did not.
        features: Names of the features, in the order of the last axis of `awareness`.
        robots: Names of the overwatching robots.
        scale: Scale of a person's trust reports, such as `"likert7"`, if `contact_rate` holds such
            reports instead of contact (see `logs.read_reports`); empty in all other missions.
        map: Name of the map to which the cells belong, if it is not the workspace of the missions
            that are fitted together. Places on different maps have independent effects.
        poses: Poses of the team at the ticks of each bound, as in `Bound`; None where not recorded.
        contact: Contact at the ticks of each bound, as in `Bound`; None where not recorded.
        sightings: Places at which robots saw a threat; see `planning.threat_map`.
        post_sets: Name of the set of posts from which T2 watched each bound of `path` (see
            `Workspace.from_terrain`); empty if all are standard.
        began: Time at which the mission began, in seconds since 1970-01-01 UTC; NaN if unknown.

    Raises:
        TrustboError: The bounds do not fit the path, the arrays disagree on the number of bounds,
            robots or ticks, a value is outside [0, 1], a duration is infinite or not positive,
            n_ticks is not a positive whole number, a rate is not a multiple of 1 / n_ticks, contact
            at a tick is neither True nor False, the last bound failed although the status is "ok",
            or a status or the scale is unknown.

    Example:
        >>> rates = np.array([[0.9, 1.0], [0.4, 0.8]])  # (bound, robot)
        >>> unmeasured = np.full((2, 2, 2), np.nan)  # awareness, (bound, robot, feature)
        >>> mission = tb.Mission.from_arrays([(2, 0), (1, 0), (0, 1)], unmeasured, rates)
        >>> mission.bounds[1].cell
        (0, 1)
    """

    path: tuple[Cell, ...]
    awareness: np.ndarray
    contact_rate: np.ndarray
    duration: np.ndarray
    n_ticks: np.ndarray
    starts: tuple[float, ...]
    bound_status: tuple[str, ...]
    status: str = "ok"
    features: tuple[str, ...] = ()
    robots: tuple[str, ...] = ()
    scale: str = ""
    map: str = ""
    poses: tuple[np.ndarray | None, ...] = ()
    contact: tuple[np.ndarray | None, ...] = ()
    sightings: tuple[Sighting, ...] = ()
    post_sets: tuple[str, ...] = ()
    began: float = np.nan

    def __post_init__(self) -> None:
        for status in (self.status, *self.bound_status):
            require_choice("status", status, STATUSES)
        if not isinstance(self.scale, str) or self.scale:
            levels_of(self.scale)

        path, post_sets = split_path(self.path, self.post_sets)
        kept: dict[str, Any] = {
            "path": path,
            "post_sets": post_sets,
            "bound_status": tuple(self.bound_status),
            "sightings": _require_sightings(self.sightings),
            "began": np.nan if np.isnan(self.began) else require_finite("began", self.began),
        }
        kept |= self._measurements() | self._ticks()

        _, n_robots, n_features = self.awareness.shape
        usual_names = {
            "features": default_features(n_features),
            "robots": default_robots(n_robots),
        }
        for name, usual in usual_names.items():
            kept[name] = as_names(name, getattr(self, name)) or usual
            if len(kept[name]) != len(usual):
                raise TrustboError(f"{name} must be {len(usual)} names; got {kept[name]}.")

        for name, value in kept.items():
            object.__setattr__(self, name, value)
        self._require_fit()

    def _measurements(self) -> dict[str, Any]:
        """Check and copy the arrays; a message names the first bound whose values are wrong."""
        given = [getattr(self, name) for name in MEASURED]
        _require_axes(*given)

        mapped = len(self.path) > 0
        try:
            checked = _checked("the bounds", mapped, *given)
        except TrustboError:
            for k, of_bound in enumerate(zip(*given, strict=True)):
                _checked(self._name_of(k), mapped, *of_bound)
            raise
        return {n: _own(values, float) for n, values in zip(MEASURED, checked, strict=True)}

    def _ticks(self) -> dict[str, Any]:
        """Check and copy the start of each bound, and the poses and contact at its ticks."""
        n_bounds, n_robots = self.contact_rate.shape
        unknown = (None,) * n_bounds
        poses = self.poses or unknown
        contact = self.contact or unknown

        for k, of_bound in enumerate(
            zip(poses, contact, self.starts, self.bound_status, strict=True)
        ):
            _require_recorded(self._name_of(k), n_robots, *of_bound[:2])

        return {
            "starts": tuple(require_finite("starts of bounds", t0) for t0 in self.starts),
            "poses": tuple(_own(values, float) for values in poses),
            "contact": tuple(_own(values, bool) for values in contact),
        }

    def _require_fit(self) -> None:
        """Raise TrustboError unless the bounds and the status fit the path."""
        n_run = len(self.contact_rate)
        n_planned = len(self.path) - 1
        if self.path and n_run > n_planned:
            raise TrustboError(
                f"{n_run} bounds need a path of at least {n_run + 1} cells; got {len(self.path)}. "
                "Give None for a log without a map."
            )

        last = self.bound_status[-1]
        if self.status == "ok" and (n_run < n_planned or last != "ok"):
            of_planned = f" of {n_planned}" if self.path else ""
            raise TrustboError(
                f'status "ok" means that the goal was reached, but {n_run}{of_planned} bounds were '
                f"run, and the last one has the status {last!r}; give the status of the mission."
            )

        if min(map(min, self.path), default=0) < 0:  # would be read from the other end
            raise TrustboError(
                f"rows and columns are counted from 0, but the path is {self.path}; give path=None "
                "for a log without a map."
            )

    def _name_of(self, k: int) -> str:
        """Return what messages call bound k, counted from 0."""
        mapped = len(self.path) > k + 1
        return f"the bound into cell {self.path[k + 1]}" if mapped else f"bound {k + 1}"

    def _rows(self) -> Rows:
        rates = self.contact_rate
        took = self.bounds[-1].t1
        planned = f"{path_text(self.path[:1])} to {path_text(self.path[-1:])}"
        measured = "trust reported" if self.scale else "contact rate"
        by_robot = zip(self.robots, pd.DataFrame(rates).mean(), strict=True)

        return [
            ("path", planned if self.path else "none: no map"),
            ("outcome", f"{self.status}, {len(rates)} bounds run"),
            (measured, f"{np.isnan(rates).sum()} missing"),
            *((f"  {name}", f"{rate:.3f}") for name, rate in by_robot),
            ("features", joined(self.features)),
            ("takes", f"{took:.4g} s" if took else "not measured"),
            *([] if np.isnan(self.began) else [("began", str(date_of(self.began)))]),
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
        post_sets: Sequence[str] = (),
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
            post_sets: Name of the set of posts for each bound of the path; by default, all are
                standard.

        Raises:
            TrustboError: The axes or labels do not fit together, a value is outside [0, 1], or the
                status is unknown.
        """
        names = {"robot": as_names("robots", robots), "feature": as_names("features", features)}
        z = read_labelled("awareness", awareness, _DIMS, names)
        names |= z.coords

        y = read_labelled("contact_rate", contact_rate, _DIMS[:2], names)
        names |= y.coords
        _require_axes(z.values, y.values)

        shape = y.values.shape
        known = names["robot"] or default_robots(shape[1])
        seconds = _per_robot("duration", duration, known, shape)
        ticks = _per_robot("n_ticks", n_ticks, known, shape)

        cells = () if path is None else require_path("path", path)
        if path is not None and not cells:
            raise TrustboError("path must contain cells; give None for a log without a map.")

        if isinstance(status, str):
            statuses = [*["ok"] * (shape[0] - 1), status]
        else:
            remedy = "give one text, or a list with one for each bound"
            statuses = require_list("status", require_order("statuses", status), str, remedy)
        if len(statuses) != shape[0]:
            raise TrustboError(
                f"status must be one text or {shape[0]}, one for each bound; got {len(statuses)}."
            )

        ends = np.cumsum(np.nan_to_num(seconds).max(axis=1)).tolist()
        return cls(
            cells,
            z.values,
            y.values,
            seconds,
            ticks,
            starts=(0.0, *ends[:-1]),
            bound_status=tuple(statuses),
            status=statuses[-1],
            features=names["feature"],
            robots=names["robot"],
            post_sets=tuple(post_sets),
        )

    def with_awareness(self, awareness: np.ndarray) -> Self:
        """Return the mission with another awareness, shape (bound, robot, feature)."""
        names = {"robot": self.robots, "feature": self.features}
        return replace(self, awareness=read_labelled("awareness", awareness, _DIMS, names).values)

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
        if (tuple(robots), tuple(features)) == (self.robots, self.features):
            return self

        lacks = {*unmeasured} - {*self.features}
        own = (*self.features, *lacks.intersection(features))
        for what, known, wanted in (
            ("robots", self.robots, robots),
            ("features", own, features),
        ):
            if sorted(known) != sorted(wanted):
                raise TrustboError(
                    f"the mission has {what} {getattr(self, what)}, not {tuple(wanted)}; rename "
                    "them, or use a workspace with these names."
                )

        return self._selected(robots, features)

    def of_robots(self, names: Iterable[str]) -> Self:
        """Return the mission with some of its robots only, in the order of this mission.

        Poses keep the lead. What the other robots measured is left out.

        Args:
            names: Names of the robots, in any order.

        Raises:
            TrustboError: A name is unknown or repeated, or there are no names.

        Example:
            >>> mission.of_robots(["r1", "r3"]).robots
            ('r1', 'r3')
        """
        members = some_of("robots", names, self.robots)
        if len(members) == len(self.robots):
            return self
        return self._selected([self.robots[i] for i in members], self.features)

    def _selected(self, robots: Sequence[str], features: Sequence[str]) -> Self:
        """Return the mission with some of its robots, and with ticks; see `_on_axes`."""
        i = [self.robots.index(name) for name in robots]
        members = [0, *(1 + j for j in i)]  # the lead is first
        return replace(
            self._on_axes(robots, features, np.nan),
            poses=tuple(None if values is None else values[:, members] for values in self.poses),
            contact=tuple(None if values is None else values[:, i] for values in self.contact),
        )

    def with_robots(self, robots: Sequence[str]) -> Self:
        """Return the mission with these robots, which include its own; added robots have no rates.

        The awareness of added robots is 0, which has no influence because they have no rates. Poses
        and contact at each tick are left out.
        """
        if tuple(robots) == self.robots:
            return self
        return self._on_axes(robots, self.features, 0.0)

    def _on_axes(self, robots: Sequence[str], features: Sequence[str], unknown: float) -> Self:
        """Return the mission with these axes, without ticks; awareness it lacks is `unknown`."""
        i = pd.Index(self.robots).get_indexer(list(robots))  # -1, the last in `wider`, if absent
        m = pd.Index(self.features).get_indexer(list(features))
        changes = {}
        for name in MEASURED:
            values = getattr(self, name)
            fill = unknown if name == "awareness" else np.nan
            margin = [(0, 0), (0, 1), (0, 1)][: values.ndim]

            wider = np.pad(values, margin, constant_values=fill)[:, i]
            changes[name] = wider[..., m] if name == "awareness" else wider

        names = {"robots": tuple(robots), "features": tuple(features)}
        return replace(self, **names, **changes, poses=(), contact=())

    def has_same_data(self, other: "Mission") -> bool:
        """Return whether another mission has the same path, outcome, measurements and date."""
        about = (
            "path",
            "post_sets",
            "status",
            "bound_status",
            "features",
            "robots",
            "scale",
            "map",
        )
        if any(getattr(self, name) != getattr(other, name) for name in about):
            return False
        if abs(self.began - other.began) > 0.0:  # not if one is unknown
            return False
        return all(
            np.array_equal(getattr(self, name), getattr(other, name), equal_nan=True)
            for name in MEASURED
        )

    @property
    def statuses(self) -> list[str]:
        """Status of each bound; that of the last bound is the status of the mission."""
        return [*self.bound_status[:-1], self.status]

    @cached_property
    def stations(self) -> tuple[Station, ...]:
        """Path as cells (row, col), or (row, col, name) if a bound has another set than standard.

        The name belongs to the lead's move out of the cell. Functions that take a path also take
        stations.
        """
        return stations_of(self.path, self.post_sets)

    @property
    def driven(self) -> tuple[Cell, ...]:
        """Cells of the path that were entered, start first; empty in a log without a map."""
        return self.path[: len(self.contact_rate) + 1]

    @property
    def driven_stations(self) -> tuple[Station, ...]:
        """Stations of the path that were entered; see `driven`."""
        return self.stations[: len(self.contact_rate) + 1]

    @cached_property
    def bounds(self) -> tuple[Bound, ...]:
        """Bounds that were run, whose arrays are views of those of the mission."""
        cells = self.driven[1:] or (NOWHERE,) * len(self.contact_rate)
        columns = (getattr(self, name) for name in OF_BOUNDS)

        return tuple(Bound(*values) for values in zip(cells, *columns, strict=True))


def _require_sightings(given: Any) -> tuple[Sighting, ...]:
    """Return sightings with places as floats; raises TrustboError if one is not a place."""
    found = []
    for k, one in enumerate(require_list("sightings", given, tuple, "give Sighting(x, y)")):
        sighting = Sighting(*one)
        what = f"sightings[{k}]"
        numbers = {name: require_finite(f"{what}.{name}", getattr(sighting, name)) for name in "xy"}
        sd = require_positive(f"{what}.sd", sighting.sd)
        found.append(sighting._replace(sd=sd, **numbers))
    return tuple(found)


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


def require_path(what: str, value: object) -> tuple[Station, ...]:
    """Return the cells of a path; raises TrustboError if a cell or a set of posts is invalid."""
    return require_cells(what, value, POST_SETS)


def split_path(
    path: object, post_sets: Sequence[str] = ()
) -> tuple[tuple[Cell, ...], tuple[str, ...]]:
    """Return the cells of a path, and the name of the set of posts of each of its bounds.

    The names are those of stations in the path or, if it has none, `post_sets`. The result has no
    names if all sets are standard.

    Raises:
        TrustboError: A cell or a name is invalid, or the number of names is not that of bounds.
    """
    stations = require_path("path", path)
    cells = tuple(cells_of(stations))
    names = tuple(station[2] if len(station) > 2 else POST_SETS[0] for station in stations[:-1])
    if post_sets and stations == cells:
        remedy = "give one name for each bound of the path"
        names = tuple(require_list("post_sets", post_sets, str, remedy))
        for k, name in enumerate(names):
            require_choice(f"post_sets[{k}]", name, POST_SETS)
        n_bounds = max(0, len(cells) - 1)
        if len(names) != n_bounds:
            raise TrustboError(
                f"post_sets must be {n_bounds} names, one for each bound of the path; got "
                f"{len(names)}."
            )
    return cells, names if any(name != POST_SETS[0] for name in names) else ()


def stations_of(cells: Sequence[Cell], post_sets: Sequence[str]) -> tuple[Station, ...]:
    """Return the stations of a path of cells and of the names of its sets of posts."""
    if not post_sets:
        return tuple(cells)
    of_moves = zip(cells, post_sets, strict=False)  # no move leads out of the last cell
    return require_path("path", [*((*cell, name) for cell, name in of_moves), cells[-1]])


def cells_of(path: Iterable[Station]) -> list[Cell]:
    """Return the cells of a path, (row, col), without the sets of posts."""
    return [station[:2] for station in path]


def path_text(path: Iterable[Station]) -> str:
    """Write cells as on the command line: "9,0 8,1"; sets of posts in stations are left out."""
    return " ".join(",".join(map(str, station[:2])) for station in path)


def is_predicted(feature: str) -> bool:
    """Return whether a feature is computed from the map and never measured by robots."""
    return is_line_of_sight(feature) or feature == THREAT


def is_line_of_sight(feature: str) -> bool:
    """Return whether a feature is a predicted contact rate."""
    return feature.startswith(LINE_OF_SIGHT)


def sight_columns(features: Sequence[str]) -> list[int]:
    """Return the indices of the features that are predicted contact rates."""
    return [m for m, name in enumerate(features) if is_line_of_sight(name)]


def began_at(t: float) -> float:
    """Return a time of a log, s, if it is Unix time, or NaN if the clock has another start."""
    return float(t) if t >= _EARLIEST else np.nan


def date_of(began: float) -> datetime:
    """Return the date of a time in seconds since 1970, to the second, in UTC."""
    return datetime.fromtimestamp(began, UTC).replace(microsecond=0)


def default_features(n_features: int) -> tuple[str, ...]:
    """Return default names of features: traversability, visibility, z3, z4, ..."""
    return (*FEATURES, *(f"z{m + 1}" for m in range(2, n_features)))[:n_features]


def require_shares(rate: np.ndarray, ticks: np.ndarray, where: str = "a bound") -> np.ndarray:
    """Return ticks, NaN where no tick and no rate was counted; `where` is for messages.

    Raises TrustboError for ticks that are not whole and rates that are not multiples of 1 / ticks.
    """
    if ticks.shape != rate.shape:
        raise TrustboError(f"n_ticks of {where} must be {rate.shape}; got shape {ticks.shape}.")

    ticks = np.where((ticks == 0.0) & np.isnan(rate), np.nan, ticks)
    is_whole = np.isfinite(ticks) & (ticks == np.round(ticks))
    is_bad = ~np.isnan(ticks) & ~(is_whole & (ticks >= 1.0))
    if is_bad.any():
        raise TrustboError(
            f"n_ticks of {where}: {_first(is_bad, ticks)} must be a whole number of ticks."
        )

    off = np.abs(rate * ticks - np.round(rate * ticks)) > SHARE_TOLERANCE * ticks
    if off.any():
        raise TrustboError(
            f"contact_rate of {where}: {_first(off, rate)} is not a multiple of "
            f"1 / {ticks[off][0]:g} (n_ticks); give all decimals, or leave n_ticks out."
        )
    return ticks


def require_unit_interval(what: str, values: np.ndarray) -> np.ndarray:
    """Return values in [0, 1] or NaN, without rounding; raises TrustboError for values outside."""
    values = without_rounding(values)
    bad = (values < 0.0) | (values > 1.0)
    if bad.any():
        scaled = "percent? divide by 100; rating from 1 to n? (rating - 1) / (n - 1)"
        hint = f" ({scaled})" if np.nanmin(values) >= 0.0 else ""
        raise TrustboError(f"{what}: {_first(bad, values)} is outside [0, 1]{hint}.")
    return values


def _first(is_bad: np.ndarray, values: np.ndarray) -> str:
    """Write the index of the first bad value, and the value."""
    index = np.argwhere(is_bad)[0]
    return f"[{', '.join(map(str, index))}] = {values[tuple(index)]:g}"


def _require_axes(awareness: np.ndarray, *others: np.ndarray) -> None:
    """Raise TrustboError unless the other arrays have the bounds and robots of awareness."""
    shapes = {values.shape for values in others}
    if awareness.ndim != 3 or not awareness.size or shapes != {awareness.shape[:2]}:
        texts = " and ".join(map(str, (awareness.shape, *shapes)))
        raise TrustboError(
            "awareness must be (bound, robot, feature) and contact_rate (bound, robot), with at "
            f"least one bound; got {texts}. If you have no features, give one feature that is 0."
        )


def _checked(
    where: str,
    mapped: bool,
    awareness: np.ndarray,
    contact_rate: np.ndarray,
    duration: np.ndarray,
    n_ticks: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Return measurements without the errors of rounding, and NaN for ticks of nothing.

    The arrays are of one bound or of several, named `where` in messages.
    """
    rates = require_unit_interval(f"contact_rate of {where}", contact_rate)
    if mapped:
        awareness = require_unit_interval(f"awareness of {where}", awareness)
    elif np.isinf(awareness).any():
        raise TrustboError(f"awareness of {where} must be finite, or NaN where not measured.")

    is_bad = (duration <= 0.0) | np.isinf(duration)
    if is_bad.any():
        raise TrustboError(
            f"duration of {where}: {_first(is_bad, duration)} s must be positive and finite."
        )
    return awareness, rates, duration, require_shares(rates, n_ticks, where)


def _require_recorded(where: str, n_robots: int, poses: Any, contact: Any) -> None:
    """Raise TrustboError unless poses and contact of a bound have the same ticks and robots."""
    axes = {"poses": (1 + n_robots, 3), "contact": (n_robots,)}
    given = {"poses": poses, "contact": contact}
    shapes = {name: np.shape(values) for name, values in given.items() if values is not None}
    for name, shape in shapes.items():
        if shape[1:] != axes[name]:
            raise TrustboError(f"{name} of {where} must be (tick, *{axes[name]}); got {shape}.")

    if len({shape[0] for shape in shapes.values()}) > 1:
        raise TrustboError(
            f"poses of {where} have {len(poses)} ticks, but contact has {len(contact)}; give both "
            "at the same times."
        )
    if contact is not None and not np.isin(contact, (0, 1)).all():
        raise TrustboError(
            f"contact of {where} must be True or False at each tick; give contact=None if it was "
            "not measured at some ticks, and the contact_rate of the others."
        )


def _own(values: Any, dtype: type) -> Any:
    """Return a read-only copy; None, and an array that is such a copy, as they are."""
    return None if values is None else fixed_array(np.asarray(values, dtype))


def _per_robot(what: str, given: Any, robots: Sequence[str], shape: tuple[int, ...]) -> np.ndarray:
    """Read one number, or values (bound,) or (bound, robot), as an array (bound, robot)."""
    if given is None:
        return np.full(shape, np.nan)
    values = read_labelled(what, given, _DIMS[:2], {"robot": robots}, partial=True).values
    try:
        return np.broadcast_to(values[:, None] if values.ndim == 1 else values, shape)
    except ValueError:
        raise TrustboError(f"{what} must be {shape}; got {values.shape}.") from None
