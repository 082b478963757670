"""A plan: a path, its expected trust, value and exactness, and the robots' routes."""

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from trustbo.data import Cell, path_text
from trustbo.display import Rows, Summary
from trustbo.hazard.risk import PathRisk
from trustbo.workspace import Workspace

QUANTILES = (0.05, 0.25, 0.75, 0.95)
"""Quantiles of `Plan.bands`: ends of the 90 % and of the 50 % band."""


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Summary):
    """A path with its expected trust, value and exactness.

    The robots' `stops`, `posts` and `routes`, in CRS metres, are computed on demand from the
    workspace; they are None without a terrain in memory.

    Attributes:
        path: Cells, start first.
        positions: Centres of the cells, shape (cell, 2), x and y in CRS metres.
        length: Length from centre to centre, m.
        trust: Expected trust after each bound, shape (bound, robot).
        bands: Quantiles of expected trust over draws of the parameters, shape (quantile, bound,
            robot), see `QUANTILES`; equal to `trust` where the plan is for one draw.
        value: Value of the objective, to be maximised (see `OBJECTIVES`): for lost_contact, minus
            the expected lost contact, in bounds, with trust capped at 1.
        objective: Name of the objective.
        exact: True if no admissible path is better.
        limit: Upper limit on the value of any admissible path; `value` where exact, NaN for a given
            path.
        revisits: Number of bounds that enter a cell again.
        seconds: Time of the search, s.
        workspace: Workspace of the path.
        risk: Failure probability of each bound, and probability to arrive with its band; None
            without a hazard.
        infeasible: Whether the failure probability of a given path exceeds `max_failure`.
        value_band: Ends of the 90 % band of the value over parameter draws, at the expected failure
            probability and without noise of rates; None where the plan is for one draw.
    """

    path: tuple[Cell, ...]
    positions: np.ndarray
    length: float
    trust: np.ndarray
    bands: np.ndarray
    value: float
    objective: str
    exact: bool
    limit: float
    revisits: int
    seconds: float
    workspace: Workspace
    risk: PathRisk | None = None
    infeasible: bool = False
    value_band: tuple[float, float] | None = None

    def with_draws(self, given: Self) -> Self:
        """Return the plan with the bands of another plan of the same path, for many draws."""
        return replace(self, bands=given.bands, value_band=given.value_band)

    def _rows(self) -> Rows:
        best = "no path is better" if self.exact else f"at most {self.limit:.3g} can be had"
        if np.isnan(self.limit):
            best = "given, or a policy's choice: value and trust are the means"
        within = ""
        if self.value_band is not None:
            within = ", {:.3g} to {:.3g} in 90 % of the draws".format(*self.value_band)
        rows = [
            ("path", f"{path_text(self.path)}: {len(self.path) - 1} bounds, {self.length:.0f} m"),
            ("value", f"{self.value:.3g} ({self.objective})" + within),
            ("best", best),
            ("trust at the goal", f"{self.trust[-1].mean():.3f}, mean of the robots"),
        ]
        if self.p_arrive is not None:
            beyond = "; fails beyond max_failure" if self.infeasible else ""
            rows.append(("arrival probability", f"{self.p_arrive:.3g}{beyond}"))
        if not np.isnan(self.limit):
            rows.append(("search", f"{1e3 * self.seconds:.1f} ms"))
        return rows

    @property
    def p_fail(self) -> np.ndarray | None:
        """Probability that each bound ends the mission, given that it is begun, shape (bound,)."""
        return None if self.risk is None else self.risk.p_fail

    @property
    def p_arrive(self) -> float | None:
        """Probability that the mission reaches the goal, averaged over draws of the risk."""
        return None if self.risk is None else self.risk.p_arrive

    @cached_property
    def stops(self) -> np.ndarray | None:
        """Stops of the lead in the cells of the path, shape (bound + 1, 2)."""
        posts = self.workspace.posts
        return None if posts is None else np.stack([posts.stop(cell) for cell in self.path])

    @cached_property
    def posts(self) -> np.ndarray | None:
        """Overwatch positions of T2 before each bound, shape (bound, robot, 2)."""
        posts, path = self.workspace.posts, self.path
        return None if posts is None else np.stack([*map(posts.watching, path, path[1:])])

    @cached_property
    def routes(self) -> tuple[tuple[np.ndarray | None, ...], ...] | None:
        """Routes of each bound: the lead's, then each of T2's, polylines of shape (point, 2).

        T2 moves to its posts for the next bound, or at the goal to positions around the lead. None
        for a robot without a route.
        """
        posts, path = self.workspace.posts, self.path
        if posts is None:
            return None
        return tuple(map(posts.bound_routes, path, path[1:], [*path[2:], None]))


def plan_to_record(plan: Plan) -> dict[str, Any]:
    """Convert a plan, without its workspace, to plain lists and numbers."""
    values = {f.name: getattr(plan, f.name) for f in fields(plan) if f.name != "workspace"}
    values["risk"] = None if plan.risk is None else plan.risk.to_record()
    return {n: v.tolist() if isinstance(v, np.ndarray) else v for n, v in values.items()}


def plan_from_record(record: dict[str, Any], workspace: Workspace) -> Plan:
    """Convert the record of `plan_to_record` to a plan of a workspace."""
    values: dict[str, Any] = {**record, "workspace": workspace}
    for name in ("positions", "trust", "bands"):
        values[name] = np.array(record[name])
    if record.get("value_band"):
        values["value_band"] = tuple(record["value_band"])
    if record["risk"]:
        values["risk"] = PathRisk.from_record(record["risk"])
    values["path"] = tuple((row, col) for row, col in record["path"])
    return Plan(**values)
