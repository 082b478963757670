"""Missions of a team of robots, bound by bound."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from trustbo.answers import levels_of
from trustbo.arrays import as_array, as_names, in_order
from trustbo.bound import NOWHERE, STATUSES, Bound, Cell
from trustbo.display import Rows, Summary, joined, number
from trustbo.errors import (
    TrustboError,
    require_cells,
    require_choice,
    require_whole,
)

FEATURES = ("traversability", "visibility")
"""Names of the first two features, z1 and z2 of the paper."""
LINE_OF_SIGHT = "line_of_sight"
"""Name of the predicted contact rate; `line_of_sight_1`, `_2`, ... where several are assumed."""


@dataclass(frozen=True, eq=False, repr=False)
class Mission(Summary):
    """One traversal of a path: the bounds that were run, and the outcome.

    Attributes:
        path: Planned cells, start first, each (row, col); empty in a log without a map.
        bounds: Bounds that were run; bound k enters `path[k]`. There are fewer than planned if the
            mission ended early; the last one then has the status of the mission.
        status: `"ok"` if the mission reached the goal, else the reason that it did not.
        features: Names of the features, in the order of the last axis of `awareness`.
        robots: Names of the overwatching robots.
        scale: Scale of the reports of a person that `contact_rate` holds in place of contact, such
            as `"likert7"`, in missions of `logs.read_reports`; empty in all others.

    Raises:
        TrustboError: Bounds that do not fit the path, or disagree on robots or features; an unknown
            status or scale.
    """

    path: tuple[Cell, ...]
    bounds: tuple[Bound, ...]
    status: str = "ok"
    features: tuple[str, ...] = ()
    robots: tuple[str, ...] = ()
    scale: str = ""

    def __post_init__(self) -> None:
        require_choice("status", self.status, STATUSES)
        if self.scale:
            levels_of(self.scale)
        (self._require_path if self.path else self._require_no_map)()
        shapes = {bound.awareness.shape for bound in self.bounds}
        if len(shapes) != 1:
            raise TrustboError(f"bounds disagree on (robot, feature): {sorted(shapes)}.")
        n_robots, n_features = shapes.pop()
        names = {
            "features": tuple(self.features) or default_features(n_features),
            "robots": tuple(self.robots) or tuple(f"r{i + 1}" for i in range(n_robots)),
        }
        for (name, labels), size in zip(names.items(), (n_features, n_robots), strict=True):
            if len(labels) != size:
                raise TrustboError(f"{name} must be {size} names; got {labels}.")
            object.__setattr__(self, name, labels)

    def _require_path(self) -> None:
        """Refuse bounds that do not fit the path."""
        if not self.bounds or len(self.bounds) > len(self.path) - 1:
            raise TrustboError(
                f"a path of {len(self.path)} cells has {len(self.path) - 1} bounds, and a mission "
                f"at least one; got {len(self.bounds)}."
            )
        if self.status == "ok" and len(self.bounds) < len(self.path) - 1:
            raise TrustboError(
                f'status "ok" says the goal was reached, but only {len(self.bounds)} of '
                f"{len(self.path) - 1} bounds were run; give the status it ended with."
            )
        for k, bound in enumerate(self.bounds, start=1):
            if bound.cell != self.path[k]:
                raise TrustboError(
                    f"bound {k} enters {bound.cell}, but the path has {self.path[k]} there."
                )

    def _require_no_map(self) -> None:
        """Refuse bounds that enter cells in a mission without a path."""
        if not self.bounds:
            raise TrustboError("a mission has at least one bound; got 0.")
        if entered := [bound.cell for bound in self.bounds if bound.cell != NOWHERE]:
            raise TrustboError(
                f"a bound enters {entered[0]}, but the mission has no path; give the path, or "
                f"bounds of cell {NOWHERE}, trustbo.data.NOWHERE."
            )

    @property
    def has_map(self) -> bool:
        """Whether its bounds enter cells of a map."""
        return bool(self.path)

    def _rows(self) -> Rows:
        rates = self.contact_rate
        measured = np.isfinite(rates)
        if self.scale:
            rows = [
                ("trust reported", f"{measured.sum()} times, scale {self.scale}"),
                ("steps", str(len(self.bounds))),
                ("tasks", joined(self.robots)),
                ("inputs", joined(self.features)),
            ]
            return rows
        mean = f"{np.nanmean(rates):.3f}" if measured.any() else "not measured"
        took = self.bounds[-1].t1
        ends = f"{path_text(self.path[:1])} to {path_text(self.path[-1:])}"
        path = f"{ends}, {len(self.path) - 1} bounds planned" if self.path else "none: no map"
        with np.errstate(all="ignore"):
            means = np.where(measured, rates, 0.0).sum(0) / measured.sum(0)
        rows = [
            ("path", path),
            ("outcome", f"{self.status}, {len(self.bounds)} bounds run"),
            ("contact rate", f"{mean} on average; {(~measured).sum()} of {rates.size} missing"),
            *((f"  {name}", f"{rate:.3f}") for name, rate in zip(self.robots, means, strict=True)),
            ("takes", number(took, "s", 4) if took > 0.0 else "not measured"),
        ]
        return rows

    @classmethod
    def from_arrays(
        cls,
        path: Sequence[Cell] | None,
        awareness: ArrayLike,
        contact_rate: ArrayLike,
        duration: ArrayLike | None = None,
        status: str = "ok",
        *,
        failed_at: int | None = None,
        reason: str = "",
        n_ticks: ArrayLike | None = None,
        features: Sequence[str] = (),
        robots: Sequence[str] = (),
    ) -> Self:
        """Make a mission from the arrays of a log.

        A mission that ended early is `from_arrays(path, z, y, failed_at=4, reason="stuck")`.

        Args:
            path: Planned cells, start first; None for a log without a map, whose missions have
                neither plans nor effects of places.
            awareness: Shape (bound, robot, feature), in [0, 1], without a map of any finite values.
            contact_rate: Shape (bound, robot), in [0, 1].
            duration: Shape (bound, robot) or (bound,), s; None where not recorded.
            status: Outcome of the mission.
            failed_at: Number of the bound, from 1, that ended the mission. Nothing may be measured
                after it; where the arrays end before it, nothing was measured of it.
            reason: Outcome of that bound, by default "aborted".
            n_ticks: Number of ticks, shape (bound, robot) or (bound,), of which `contact_rate` is
                the share with contact; None where not recorded.
            features: Names of the features; by default traversability, visibility, z3, ...; a
                workspace with as many features gives z3, ... their names, see `Workspace.in_order`.
            robots: Names of the robots; by default r1, r2, ...

        Raises:
            TrustboError: Axes that do not fit together; a value outside [0, 1]; an unknown status
                or reason; or `failed_at` beyond the path, more than a bound after the arrays,
                before measurements, or together with a status.
        """
        labels = {"robot": robots, "feature": features}
        awareness = in_order("awareness", awareness, ("bound", "robot", "feature"), **labels)
        contact_rate = in_order("contact_rate", contact_rate, ("bound", "robot"), robot=robots)
        z, y = as_array("awareness", awareness), as_array("contact_rate", contact_rate)
        if failed_at is not None or reason:
            n_planned = len(y) if path is None else len(path) - 1
            last, status = _failure(failed_at, reason, status, n_planned)
            measured = {"contact_rate": y, "duration": duration, "n_ticks": n_ticks}
            for name, values in measured.items():
                if values is not None:
                    _require_none_after(last, name, as_array(name, values))
            z, y = _until(last, z), _until(last, y)
            duration, n_ticks = (
                None if values is None else _until(last, as_array(name, values))
                for name, values in (("duration", duration), ("n_ticks", n_ticks))
            )
        if z.ndim == 3 and z.shape[:1] == y.shape[:1] == (0,):
            raise TrustboError(
                "a mission has at least one bound; got 0. If the robots were stopped before "
                'bound 1 ended, tell campaign.fail("stuck", where=cell).'
            )
        if z.ndim != 3 or y.shape != z.shape[:2] or not y.size:
            raise TrustboError(
                "awareness must be (bound, robot, feature) and contact_rate (bound, robot); "
                f"got {z.shape} and {y.shape}."
            )
        seconds, ticks = (
            _per_robot(name, values, y.shape)
            for name, values in (("duration", duration), ("n_ticks", n_ticks))
        )
        cells = () if path is None else require_cells("path", path)
        if path is not None and not cells:
            raise TrustboError("path is empty; give its cells, or None for a log without a map.")
        if cells and len(y) > len(cells) - 1:
            raise TrustboError(
                f"{len(y)} bounds need {len(y) + 1} cells; the path has {len(cells)}."
            )
        longest = np.nanmax(np.where(np.isnan(seconds), 0.0, seconds), axis=1)
        last, starts = len(y) - 1, np.concatenate([[0.0], np.cumsum(longest)])
        statuses = ["ok"] * last + [status]
        entered = cells[1:] or (NOWHERE,) * len(y)
        measured = zip(entered, z, y, seconds, statuses, map(float, starts), ticks, strict=False)
        bounds = tuple(Bound(*values, n_ticks=n) for *values, n in measured)
        named = as_names("features", features), as_names("robots", robots)
        return cls(cells, bounds, status, *named)

    def in_order(
        self, robots: Sequence[str], features: Sequence[str], unmeasured: Sequence[str] = ()
    ) -> Self:
        """The mission with its robots and features in the order of these names.

        Args:
            robots: Names of the robots.
            features: Names of the features.
            unmeasured: Features that the mission may lack; their values are then NaN.

        Raises:
            TrustboError: It has other robots or features.
        """
        if (tuple(robots), tuple(features)) == (self.robots, self.features):
            return self
        lacks = [name for name in features if name in unmeasured and name not in self.features]
        own_features = (*self.features, *lacks)
        for what, names_of, wanted in (
            ("robots", self.robots, robots),
            ("features", own_features, features),
        ):
            if sorted(names_of) != sorted(wanted):
                raise TrustboError(
                    f"the mission has {what} {getattr(self, what)}, not {tuple(wanted)}; give "
                    f"{what}= these names, or use the workspace of this team."
                )
        i, m = (
            [names_of.index(n) for n in names]
            for names_of, names in ((self.robots, robots), (own_features, features))
        )
        bounds = []
        for b in self.bounds:
            optional = {
                "poses": None if b.poses is None else b.poses[:, [0, *(1 + j for j in i)]],
                "contact": None if b.contact is None else b.contact[:, i],
                "states": None if b.states is None else b.states[:, i],
            }
            rates = {n: getattr(b, n)[i] for n in ("contact_rate", "duration", "n_ticks")}
            z = np.pad(b.awareness, ((0, 0), (0, len(lacks))), constant_values=np.nan)
            bounds.append(replace(b, awareness=z[np.ix_(i, m)], **rates, **optional))
        names = {"robots": tuple(robots), "features": tuple(features)}
        return replace(self, bounds=tuple(bounds), **names)

    # Stacked once: every refit reads these of every mission.

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
        array = np.stack([getattr(bound, name) for bound in self.bounds])
        array.flags.writeable = False
        return array


def require_map(what: str, missions: Iterable[Mission]) -> None:
    """Refuse missions of a log without a map: TrustboError."""
    for j, mission in enumerate(missions):
        if not mission.has_map:
            raise TrustboError(
                f"{what} needs the cells of a map, and mission {j} is of a log without one "
                "(path=None); such missions have fits without effects of places, and scores."
            )


def path_text(path: Iterable[Cell]) -> str:
    """Write cells as on the command line: "9,0 8,1"."""
    return " ".join(f"{row},{col}" for row, col in path)


def is_line_of_sight(feature: str) -> bool:
    """Whether a feature is a predicted contact rate."""
    return feature.startswith(LINE_OF_SIGHT)


def default_features(n_features: int) -> tuple[str, ...]:
    """Names of the first features: traversability, visibility, z3, z4, ..."""
    return (*FEATURES, *(f"z{m + 1}" for m in range(2, n_features)))[:n_features]


def _failure(failed_at: int | None, reason: str, status: str, n_bounds: int) -> tuple[int, str]:
    """Bound in which a mission failed, from 1, and its status."""
    if failed_at is None:
        raise TrustboError(
            f"reason={reason!r} needs failed_at=, the number of the bound, from 1, that ended the "
            "mission."
        )
    if (last := require_whole("failed_at", failed_at, 1)) > n_bounds:
        raise TrustboError(f"failed_at = {last}, but the path has {n_bounds} bounds.")
    if status != "ok":
        raise TrustboError(f"status={status!r} is given beside failed_at=; give reason= instead.")
    return last, require_choice("reason", reason or "aborted", STATUSES[1:])


def _until(last: int, values: np.ndarray) -> np.ndarray:
    """Rows of the first `last` bounds; NaN for the last one where the arrays end before it."""
    if not values.ndim:
        return values
    if len(values) < last - 1:
        raise TrustboError(
            f"failed_at = {last}, but the arrays have {len(values)} bounds; give all before it."
        )
    rest = np.full((max(last - len(values), 0), *values.shape[1:]), np.nan)
    return np.concatenate([values[:last], rest])


def _require_none_after(last: int, what: str, values: np.ndarray) -> None:
    """Refuse measurements of bounds after the one that ended the mission: TrustboError."""
    if not values.ndim:
        return
    after = np.isfinite(values[last:])
    later = np.flatnonzero(after.any(tuple(range(1, after.ndim))))
    if later.size:
        raise TrustboError(
            f"failed_at = {last}, but {what} has values of bound {last + 1 + later[0]} too; leave "
            f"the rows after bound {last} out or NaN, or give the bound that really failed."
        )


def _per_robot(what: str, values: ArrayLike | None, shape: tuple[int, ...]) -> np.ndarray:
    """Values per (bound, robot), from values per (bound, robot), per bound, or None."""
    array = as_array(what, np.nan if values is None else values)
    if array.ndim == 1:
        array = array[:, None]
    try:
        return np.broadcast_to(array, shape)
    except ValueError:
        raise TrustboError(f"{what} must be {shape}; got {array.shape}.") from None
