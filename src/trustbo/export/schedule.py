"""Times at which robots drive and stand on a plan, from its ways and their speeds on the slope.

In a bound the lead drives first, from a stop to the next, while T2 watches from its posts; then T2
closes up. The next bound begins when the last of T2 stands. In alternate bounding they drive by
turns.
"""

from typing import NamedTuple

import numpy as np
import shapely

from trustbo.errors import TrustboError
from trustbo.export.checks import LEAD
from trustbo.export.layers import routes_of
from trustbo.planning import Plan
from trustbo.workspace.routes import at_times


class Stand(NamedTuple):
    """Place where a robot stands, and the way that led there."""

    way: np.ndarray
    """Way from the last place, (point, 2) in CRS metres, thinned; of the first place, it alone."""
    name: str
    """Name of the place: "start", "stop 1", ..., "post 1", ..., "goal"."""
    bound: int
    """Bound that the lead drives meanwhile, or drives next, from 1; 0 at the goal."""
    leaves: float
    """Time at which the robot sets out for the place, s after the start of the mission."""
    arrives: float
    """Time at which it is there, s."""
    until: float
    """Time until which it stays there, s; at the goal, when the last robot is there."""

    @property
    def place(self) -> np.ndarray:
        """Position of the place, (2,) in CRS metres."""
        return self.way[-1]

    @property
    def hold(self) -> float:
        """Time that the robot stands there, s."""
        return self.until - self.arrives


class Schedule(NamedTuple):
    """Times of a plan, s after its start."""

    robots: dict[str, list[Stand]]
    """Places of each robot in order, the lead first."""
    begins: np.ndarray
    """Begin of each bound, and the end of the last, (bound + 1,)."""


def schedule_of(plan: Plan) -> Schedule:
    """Compute the times of a plan.

    TrustboError: no terrain in memory, or a robot without a way in a bound.
    """
    names, ways = (LEAD, *plan.workspace.team.names), complete_routes(plan)
    surface, team = plan.workspace.surface, plan.workspace.team
    assert surface is not None  # noqa: S101  # there are ways
    n_bounds = len(plan.path) - 1
    times = np.empty((len(names), n_bounds))
    for i, (robot, name) in enumerate(zip((team.lead, *team.robots), names, strict=True)):
        flat, ends = np.concatenate(ways[name]), np.cumsum([0, *map(len, ways[name])])
        times[i] = at_times(surface, robot, np.ascontiguousarray(flat), ends, 1)[1]
    t2_time = times[1:].max(0)
    begins = np.concatenate([[0.0], np.cumsum(times[0] + t2_time)])
    first = plan.lead_first
    sets_out = begins[:-1] + np.where(first, 0.0, t2_time)  # the lead
    stops = begins[:-1] + np.where(first, times[0], 0.0)  # T2 sets out
    leaves = {name: stops for name in names[1:]} | {LEAD: sets_out}
    near = 0.5 * min(surface.pixel)
    robots = {}
    for i, name in enumerate(names):
        what = "start" if name == LEAD else "post 1"
        robots[name] = [Stand(ways[name][0][:1], what, 1, 0.0, 0.0, 0.0)]
        for k, way in enumerate(ways[name]):
            if (way[0] == way[-1]).all() and k < n_bounds - 1:
                continue  # it stands while the others pass
            robots[name][-1] = robots[name][-1]._replace(until=leaves[name][k])
            what = f"stop {k + 1}" if name == LEAD else f"post {k + 2}"
            what, bound = ("goal", 0) if k == n_bounds - 1 else (what, k + 2)
            arrives = leaves[name][k] + times[i, k]
            stand = Stand(_thinned(way, near), what, bound, leaves[name][k], arrives, begins[-1])
            robots[name].append(stand)
    return Schedule(robots, begins)


def complete_routes(plan: Plan) -> dict[str, list[np.ndarray]]:
    """Return the ways of each robot, bound by bound, the lead first.

    TrustboError: a robot that has no way in a bound, or no terrain in memory.
    """
    ways = routes_of(plan)
    for robot, of_robot in ways.items():
        if len(of_robot) < len(plan.path) - 1:
            raise TrustboError(
                f"{robot} has no way in bound {len(of_robot) + 1}, so that it cannot be sent along "
                "the path; plan another, or give it a larger max_slope."
            )
    return ways


def _thinned(way: np.ndarray, near: float) -> np.ndarray:
    return shapely.get_coordinates(shapely.LineString(way).simplify(near))
