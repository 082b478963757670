"""A plan: a path with its expected trust and value, and the routes of the robots."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple, Self

import numpy as np
import pandas as pd

from trustbo.data import (
    POST_SETS,
    Cell,
    Station,
    cells_of,
    path_text,
    split_path,
    stations_of,
)
from trustbo.display import Rows, Summary, joined
from trustbo.errors import require_switch
from trustbo.fixed import Fixed, fixed_array, mark
from trustbo.hazard.path_risk import PathRisk
from trustbo.workspace import Workspace
from trustbo.workspace.closed import closed_text
from trustbo.workspace.moves import cells_along, posts_along

QUANTILES = (0.05, 0.25, 0.75, 0.95)
"""Quantile levels of `Plan.bands`: the ends of the 90 % and the 50 % bands."""
_ROUNDING = 1e-9  # relative; the draws of a path and of a single bound are averaged differently


class PastFailure(NamedTuple):
    """Failure of a past mission in a bound into a cell that a plan enters.

    A failure counts for the bound that failed, followed by the same next move, with the same sets
    of posts. A plan may therefore enter the same cell from another side, leave it in another
    direction, or have other posts.
    """

    bound: int
    """Number of the plan's bound into this cell, from 1."""
    mission: int | None
    """Number of the mission that failed; None if it has none, as after `Campaign.fail`."""
    status: str
    """Status of the bound that failed, such as "tipped"."""
    way: tuple[Station, ...]
    """The cell left and the cell entered in the bound that failed, and the cell after them, if any,
    with the sets of posts as in `Plan.stations`. If the planned next move is not known, the cell
    after them is that of the plan."""
    p_fail: float
    """Posterior mean probability that a bound on this way fails; compare `Plan.p_fail`."""


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Fixed, Summary):
    """A path, its expected trust and value, and whether it is provably optimal.

    The properties `stops`, `posts` and `routes` are computed on demand, in CRS metres. If the
    workspace has no terrain, these properties are None.

    Attributes:
        path: Cells (row, col) from start to goal.
        trust: Expected trust after each bound, shape (bound, robot).
        bands: Quantiles of expected trust over the parameter draws, shape (quantile, bound, robot),
            for the levels in `QUANTILES`. With one draw, the bands equal `trust`.
        value: Value of the objective (see `OBJECTIVES`); larger values are better. For
            lost_contact, the value is minus the expected lost contact, with trust capped at 1.
        objective: Name of the objective.
        exact: Whether the search proved that no admissible path is better.
        limit: Upper limit on the value of any admissible path. The limit equals `value` if `exact`
            is True, and is NaN if the path was given.
        seconds: Duration of the search in seconds, without the compilation of kernels.
        workspace: Workspace of the path.
        risk: Failure probability of each bound, and arrival probability with its 90 % band; None if
            the planner has no risk.
        infeasible: Whether the failure probability of the path exceeds `max_failure`.
        blocked: Pairs of cells between which the team cannot drive a bound in this mission; see
            `Campaign.replan`.
        n_driven: Number of bounds of the path before `path[n_driven]`, the cell in which the team
            was when the mission was replanned; otherwise 0. The way back after a bound that failed
            counts as driven.
        abandoned: Planned paths of this mission on which a bound failed, before it was replanned,
            as in `stations`.
        value_band: Ends of the 90 % band of the value over the draws, computed with the mean
            failure probability; None with one draw. `value` may lie outside the band, because it
            limits trust to 1.
        past_failures: Failures of past missions at known bounds into the cells that this path
            enters, as named tuples with the fields `bound`, `mission`, `status`, `way` and
            `p_fail`; only the plans of campaigns have them.
        post_sets: Name of the set of posts from which T2 watches each bound (see
            `Workspace.from_terrain`); empty if all are standard.
        price_of_failure: Expected cost of failure in bounds, which the value includes; see
            `Planner`. 0 if failures have no cost.

    Example:
        >>> plan = tb.Planner(workspace, (9, 0), (0, 9)).plan(posterior)
        >>> plan.path[0], plan.path[-1], plan.exact
        ((9, 0), (0, 9), True)
        >>> plan.trust.mean(axis=0)  # of each robot
    """

    path: tuple[Cell, ...]
    trust: np.ndarray
    bands: np.ndarray
    value: float
    objective: str
    exact: bool
    limit: float
    seconds: float
    workspace: Workspace
    risk: PathRisk | None = None
    infeasible: bool = False
    value_band: tuple[float, float] | None = None
    blocked: tuple[tuple[Cell, ...], ...] = ()
    n_driven: int = 0
    abandoned: tuple[tuple[Station, ...], ...] = ()
    past_failures: tuple[PastFailure, ...] = ()
    post_sets: tuple[str, ...] = ()
    price_of_failure: float = 0.0

    def __post_init__(self) -> None:
        require_switch("exact", self.exact)
        require_switch("infeasible", self.infeasible)
        path, post_sets = split_path(self.path, self.post_sets)
        object.__setattr__(self, "path", path)
        object.__setattr__(self, "post_sets", post_sets)
        self._fix()

    def with_draws(self, given: Self) -> Self:
        """Return this plan with the bands of `given`, a plan for the same path and many draws."""
        return replace(self, bands=given.bands, value_band=given.value_band)

    def _rows(self) -> Rows:
        best = "no path is better" if self.exact else f"no path exceeds {self.limit:z.3g}"
        if np.isnan(self.limit):
            best = "not known: the path was given or chosen by a policy"

        rows = [
            ("path", f"{path_text(self.path)}: {len(self.path) - 1} bounds, {self.length:.0f} m"),
            *([("posts", sets_text(self.post_sets))] if self.post_sets else []),
            ("value", f"{self.value:z.3g} ({self.objective}){in_draws(self.value_band)}"),
            *([("parts", self.parts)] if self.parts else []),
            ("best", best),
            ("trust at the goal", f"{self.trust[-1].mean():.3f}, mean of the robots"),
        ]

        if self.workspace.within is not None:
            rows.insert(1, ("robots", f"{', '.join(self.robots)}; the others stay at home"))
        if self.p_arrive is not None:
            beyond = "; the failure probability exceeds max_failure" if self.infeasible else ""
            rows.append(("arrival probability", f"{self.p_arrive:.3g}{beyond}"))
        if self.workspace.closed:
            closed = closed_text(self.workspace.closed, self.workspace.name_of)
            rows.append(("closed", closed))
        if self.past_failures:
            rows.append(("past failures", "; ".join(past_failures_of(self))))
        if not np.isnan(self.limit):
            rows.append(("search", f"{1e3 * self.seconds:.1f} ms"))

        return rows

    def to_frame(self) -> pd.DataFrame:
        """Return a table with one row for each cell, labelled by the bound that enters it, from 0.

        The columns are:

        - `cell`: cell as text, such as "9,0".
        - `x`, `y`: stop of the lead or, without a terrain, centre of the cell, in CRS metres.
        - `posts`: set of posts from which T2 watches the lead's move out of the cell; left out if
          the workspace has one set.
        - `trust`, `trust_low`, `trust_high`: expected trust after the bound and the ends of its
          90 % interval, means of the robots.
        - `driven`: whether the bound had been driven when the mission was replanned.
        - `trust_r1`, `trust_r1_low`, `trust_r1_high`: the same as `trust`, of the robot r1; and so
          on.
        - `p_fail`: probability that the bound, once begun, ends the mission; left out if the
          planner has no risk.

        At the start, the columns from `trust` on are missing.

        Example:
            >>> campaign.ask().to_frame().to_csv("path.csv")
        """
        of_bounds = self._trust_columns("trust", np.s_[:])
        of_bounds["driven"] = np.arange(1, len(self.path)) <= self.n_driven
        for i, robot in enumerate(self.workspace.team.names):
            of_bounds |= self._trust_columns(f"trust_{robot}", np.s_[i : i + 1])
        if self.p_fail is not None:
            of_bounds["p_fail"] = self.p_fail

        places = self.positions if self.stops is None else self.stops
        table = pd.DataFrame(places, columns=["x", "y"]).rename_axis("bound")
        table.insert(0, "cell", [path_text([cell]) for cell in self.path])
        if self.workspace.n_posts > 1:
            table["posts"] = [*map(POST_SETS.__getitem__, posts_along(self.stations)), ""]
        return table.join(pd.DataFrame(of_bounds, index=table.index[1:]))

    def _trust_columns(self, name: str, robots: slice) -> dict[str, np.ndarray]:
        """Return the mean trust of some robots and its 90 % interval, keyed by column."""
        values = {name: self.trust, f"{name}_low": self.bands[0], f"{name}_high": self.bands[-1]}
        return {column: value[:, robots].mean(1) for column, value in values.items()}

    @cached_property
    def stations(self) -> tuple[Station, ...]:
        """Path as cells (row, col), or (row, col, name) if a bound has another set than standard.

        The name belongs to the lead's move out of the cell. Functions that take a path also take
        stations.
        """
        return stations_of(self.path, self.post_sets)

    @property
    def start(self) -> Cell:
        """First cell of the path."""
        return self.path[0]

    @property
    def goal(self) -> Cell:
        """Last cell of the path."""
        return self.path[-1]

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the robots of T2 that take part, in the order of `trust`."""
        return self.workspace.team.names

    @cached_property
    def positions(self) -> np.ndarray:
        """CRS coordinates x and y of the cell centres, shape (cell, 2), in metres."""
        grid = self.workspace.grid
        rows, cols = cells_along(self.path).T
        return mark(np.stack([grid.x[cols], grid.y[rows]], axis=1))

    @property
    def contact_lost(self) -> float | None:
        """Expected contact lost in bounds, with bound costs, if no bound fails.

        It is None if the objective is not lost_contact. The value of a plan is minus the sum of
        this and `price_of_failure`.
        """
        if self.objective != "lost_contact":
            return None
        return -self.value - self.price_of_failure

    @property
    def parts(self) -> str:
        """Parts of the value as text: contact lost and, if it has one, the price of failure."""
        if self.contact_lost is None:
            return ""
        text = f"{self.contact_lost:.2f} of {len(self.path) - 1} bounds of contact lost"
        if self.price_of_failure:
            text += f", price of failure {self.price_of_failure:.2f} bounds"
        return text

    @property
    def length(self) -> float:
        """Length of the line through the cell centres, in metres."""
        return float(np.hypot(*np.diff(self.positions, axis=0).T).sum())

    @property
    def revisits(self) -> int:
        """Number of bounds that enter a cell that the path has already visited."""
        return len(self.path) - len(set(self.path))

    @property
    def is_replanned(self) -> bool:
        """Whether bounds had been driven, or were blocked, when a campaign made this plan."""
        return self.n_driven > 0 or bool(self.blocked)

    @property
    def p_fail(self) -> np.ndarray | None:
        """Probability that each bound, once begun, ends the mission, shape (bound,), or None."""
        return None if self.risk is None else self.risk.p_fail

    @property
    def p_arrive(self) -> float | None:
        """Probability of reaching the goal, averaged over the draws of the risk, or None."""
        return None if self.risk is None else self.risk.p_arrive

    @cached_property
    def stops(self) -> np.ndarray | None:
        """Position at which the lead stops in each cell of the path, shape (bound + 1, 2)."""
        posts = self.workspace.posts
        if posts is None:
            return None
        return mark(np.stack([posts.stop(cell) for cell in self.path]))

    @cached_property
    def posts(self) -> np.ndarray | None:
        """Overwatch positions of T2 before each bound, shape (bound, robot, 2)."""
        posts = self.workspace.posts
        if posts is None:
            return None
        return mark(np.stack([posts.watching(*bound) for bound in pairwise(self.stations)]))

    @cached_property
    def routes(self) -> tuple[tuple[np.ndarray | None, ...], ...] | None:
        """Routes of the lead and of each robot of T2 in each bound, each with shape (point, 2).

        The lead comes first. T2 moves to its posts for the next bound or, at the goal, to positions
        around the lead. An entry is None if the robot has no route.
        """
        posts = self.workspace.posts
        if posts is None:
            return None

        path = self.stations
        onward = [*path[2:], None]  # T2 moves to its posts for the bound to this cell
        routes = map(posts.bound_routes, path, path[1:], onward)
        return tuple(
            tuple(None if way is None else fixed_array(way) for way in ways) for ways in routes
        )


def sets_text(post_sets: Sequence[str]) -> str:
    """Describe the sets of posts of bounds, such as "far in bounds 2 and 3, else standard"."""
    texts = []
    for name in POST_SETS[1:]:
        bounds = [str(k) for k, of_bound in enumerate(post_sets, 1) if of_bound == name]
        if bounds:
            texts.append(f"{name} in bound{'s' * (len(bounds) > 1)} {joined(bounds)}")
    rest = ", else " + POST_SETS[0] if POST_SETS[0] in post_sets else ""
    return "; ".join(texts) + rest


def in_draws(band: tuple[float, float] | None, sign: float = 1.0) -> str:
    """Describe the 90 % band of a value times `sign`, after the value; empty without a band."""
    if band is None:
        return ""
    low, high = sorted(sign * end for end in band)
    return f", {low:z.3g} to {high:z.3g} in 90 % of the draws"


def past_failures_of(plan: Plan) -> list[str]:
    """Describe the past failures of a plan, one text for each of its bounds.

    The texts compare the failure probability of the plan's bound with that of each way that failed.
    """
    p_fail = plan.p_fail
    if p_fail is None:
        return []

    # Failures of the plan's own way come first, as None.
    ways: dict[int, dict[Any, list[PastFailure]]] = {}
    for failure in plan.past_failures:
        k = failure.bound
        same = failure.way[0][:2] == plan.path[k - 1] and math.isclose(
            failure.p_fail, p_fail[k - 1], rel_tol=_ROUNDING
        )
        way = None if same else (failure.way, failure.p_fail)
        ways.setdefault(k, {None: []}).setdefault(way, []).append(failure)

    texts = []
    for k, of_bound in ways.items():
        left, entered = plan.path[k - 1 : k + 1]
        text = f"bound {k} enters {path_text([entered])} from {path_text([left])} with failure "
        text += f"probability {p_fail[k - 1]:.2g}{_when(of_bound.pop(None))}"
        for (way, failed), failures in of_bound.items():
            failed_left, _, *after = cells_of(way)
            side = f"from {path_text([failed_left])}"
            if failed_left == left:
                same_next = after == [*plan.path[k + 1 : k + 2]]
                side = "with other posts" if same_next else "before another next move"
            text += f"; {side}, it is {failed:.2g}{_when(failures)}"
        texts.append(text)
    return texts


def _when(failures: Sequence[PastFailure]) -> str:
    """Describe when failures happened, such as " (tipped in mission 3)"; empty without any."""
    texts = []
    for status in dict.fromkeys(failure.status for failure in failures):
        of_status = [failure.mission for failure in failures if failure.status == status]
        numbers = [str(number) for number in of_status if number is not None]
        plural = "missions" if len(numbers) > 1 else "mission"
        texts.append(f"{status} in {plural} {joined(numbers)}" if numbers else status)
    return f" ({', '.join(texts)})" if texts else ""


def plan_to_record(plan: Plan) -> dict[str, Any]:
    """Convert a plan to plain lists and numbers, with robots and closings for its workspace."""
    values = {f.name: getattr(plan, f.name) for f in fields(plan) if f.name != "workspace"}
    values["risk"] = None if plan.risk is None else plan.risk.to_record()
    values["robots"] = list(plan.robots)
    values["closed"] = [*plan.workspace.closed.items()]
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in values.items()
    }


def plan_from_record(record: dict[str, Any], workspace: Workspace) -> Plan:
    """Restore a plan of a workspace from a record made by `plan_to_record`.

    Without the key `robots`, all robots of the workspace take part; without `closed`, nothing is
    closed but what the workspace closes.
    """
    values = {name: as_tuples(value) for name, value in record.items()}
    workspace = workspace.with_closed(dict(values.pop("closed", workspace.closed.items())))
    workspace = workspace.of_robots(values.pop("robots", workspace.team.names))
    values |= {name: np.array(record[name]) for name in ("trust", "bands")}
    values["risk"] = record["risk"] and PathRisk.from_record(record["risk"])
    values["past_failures"] = tuple(
        PastFailure(*failure) for failure in values.get("past_failures", ())
    )
    return Plan(**values, workspace=workspace)


def as_tuples(value: Any) -> Any:
    """Convert lists, also within lists, to tuples."""
    return tuple(map(as_tuples, value)) if isinstance(value, list | tuple) else value
