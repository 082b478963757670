"""State and maps of a live campaign as JSON, for the page and for programs."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from trustbo.answers import answer_of
from trustbo.data import Cell
from trustbo.errors import TrustboError, require_choice, require_known
from trustbo.live.follow import Low
from trustbo.planning.trust_map import cost_of

if TYPE_CHECKING:
    from trustbo.live.session import Live

LAYERS = ("trust", "cost")
_BAND = 1.6449  # sds on both sides, of 90 %
_DIGITS = 4
_COMPASS = "north north-east east south-east south south-west west north-west".split()


def state_of(live: "Live") -> dict[str, Any]:
    """State of a live campaign; `Live.state` has its fields."""
    mission, follower, robots = live.mission, live.follower, live.reader.robots
    low = list(follower.low)
    if mission.running is not None:
        low += follower.low_of(mission.running, mission.k)
    after = [follower.start, *follower.after] if follower.now is not None else []
    ahead = follower.ahead
    return {
        "version": live.version,
        "mission": live.number,
        "phase": _phase(live),
        "to_do": to_do(live),
        "bound": mission.k,
        "path": mission.path,
        "entered": len(mission.bounds),
        "planned": mission.planned,
        "robots": [_robot(live, i) for i in range(len(robots))],
        "trust": [_moments(state.mean, state.sd) for state in after],
        "ahead": [] if ahead is None else _forecast(ahead),
        "rates": [_plain(run.rate) for run in mission.bounds],
        "reports": _plain(answer_of(mission.reports, live.reader.levels)),
        "levels": live.reader.levels,
        "idle": live.n_idle,
        "alarms": [sentence_of(one, robots) for one in low],
        "log": [[round(t, 3), text] for t, text in live.log],
        "filter": follower.reason,
        "n_draws": round(follower.n_draws, 1),
        "trouble": live.trouble,
        "poses": {name: _on_map(live, place) for name, place in live.poses.items()},
        "posts": _posts(live),
    }


def map_of(live: "Live", layer: str, robot: str | None) -> dict[str, Any]:
    """Map of a live campaign; `Live.map` has its fields."""
    require_choice("layer", layer, LAYERS)
    robots, grid = live.reader.robots, live.campaign.workspace.grid
    require_known("robot", [] if robot is None else [robot], robots)
    name = "team" if robot is None else "robots"
    if name not in live.maps:  # searched once a mission
        params = live.campaign.belief.mean()
        planner = live.campaign.planner_now()
        live.maps[name] = planner.trust_map(params, per_robot=robot is not None)
    trust = live.maps[name]
    values = (cost_of(trust) if layer == "cost" else trust).values
    values = values if robot is None else values[robots.index(robot)]
    values = np.where(live.campaign.workspace.passable.values, values, np.nan)
    apart = values.copy()
    apart[live.campaign.planner.start] = np.nan  # assumed there
    known = apart[np.isfinite(apart)]
    return {
        "mission": live.number,
        "layer": layer,
        "robot": robot,
        "shape": grid.shape,
        "cell": [grid.cell_height, grid.cell_width],
        "low": _plain(known.min()) if known.size else 0.0,
        "high": _plain(known.max()) if known.size else 1.0,
        "values": _plain(values),
        "passable": live.campaign.workspace.passable.values.astype(int).tolist(),
    }


def plan_of(live: "Live") -> dict[str, Any]:
    """Plan of the mission that runs: its path, with centres, posts and what is expected."""
    mission, grid, plan = live.mission, live.campaign.workspace.grid, live.plan
    return {
        "mission": live.number,
        "path": mission.path,
        "entered": len(mission.bounds),
        "positions": [list(grid.center(cell)) for cell in mission.path],
        "crs": grid.crs,
        "value": _plain(np.asarray(plan.value)),
        "objective": plan.objective,
        "p_arrive": None if plan.p_arrive is None else _plain(np.asarray(plan.p_arrive)),
    }


def sentence_of(low: Low, robots: Sequence[str]) -> str:
    """Sentence of an alarm of contact."""
    return (
        f"bound {low.bound}, {robots[low.robot]}: contact {low.rate:.2f}, far below the "
        f"{low.expected:.2f} that was expected."
    )


def to_do(live: "Live") -> str:
    """Sentence about what is to be done next."""
    mission = live.mission
    if live.trouble:
        return live.trouble
    if live.job is not None:
        return {
            "learning": f"Wait: mission {live.number} is being learned from.",
            "planning": "Wait: the rest of the path is being planned.",
        }[live.busy_with]
    if mission.running is not None:
        way = _way(live, mission.here, mission.running.cell)
        return f"Bound {mission.k} runs: the lead goes {way}. Then say how it ended."
    if not mission.planned:
        return (
            f"No path leads on from {_text(mission.here)} within the bounds that are left: begin a "
            "bound to a cell by name, or abort the mission."
        )
    left = len(mission.path) - 1 - len(mission.bounds)
    way = _way(live, mission.here, mission.path[mission.k])
    return f"Begin bound {mission.k}, of {left} to go: the lead goes {way}."


def _phase(live: "Live") -> str:
    if live.trouble:
        return "stopped"
    if live.job is not None:
        return live.busy_with
    return "running" if live.mission.running is not None else "ready"


def _robot(live: "Live", i: int) -> dict[str, Any]:
    """Numbers of a robot now."""
    running, follower = live.mission.running, live.follower
    now, ahead = follower.now, follower.ahead
    numbers: dict[str, Any] = {"name": live.reader.robots[i]}
    if now is not None:
        mean, sd = float(now.mean[i]), float(now.sd[i])
        numbers |= {"trust": mean, "low": mean - _BAND * sd, "high": mean + _BAND * sd}
    if running is not None:
        n = int(running.n_ticks[i])
        numbers |= {"n_ticks": n, "rate": running.n_contact[i] / n if n else None}
    if ahead is not None:
        numbers |= {"expected": ahead.rate[0, i], "expected_low": ahead.rate_low[0, i]}
        numbers |= {"expected_high": ahead.rate_high[0, i]}
    return {
        name: round(float(v), _DIGITS) if isinstance(v, float) else v for name, v in numbers.items()
    }


def _moments(mean: np.ndarray, sd: np.ndarray) -> list[list[float]]:
    """Mean and ends of the 90 % band by robot."""
    return _plain(np.stack([mean, mean - _BAND * sd, mean + _BAND * sd], axis=1))


def _forecast(ahead: Any) -> list[Any]:
    return [_moments(mean, sd) for mean, sd in zip(ahead.mean, ahead.sd, strict=True)]


def _posts(live: "Live") -> list[list[float]]:
    """Posts of the robots in the bound that runs or is next, m from the map's lower left corner."""
    mission, workspace = live.mission, live.campaign.workspace
    cell = mission.running.cell if mission.running is not None else None
    if cell is None and mission.planned and len(mission.rest) > 1:
        cell = mission.rest[1]
    if cell is None or workspace.ground is None:
        return []
    n = len(mission.bounds)
    key = mission.here, cell, mission.path[n - 1] if n else None
    if key not in live.posts:
        live.posts.clear()
        try:
            posts = workspace.posts(*key)
        except TrustboError:  # robots went where no bound leads
            posts = None
        live.posts[key] = [] if posts is None else [_on_map(live, p) for p in posts.tolist()]
    return live.posts[key]


def _on_map(live: "Live", place: Sequence[float]) -> list[float]:
    left, bottom = live.campaign.workspace.grid.corner
    return [round(place[0] - left, 2), round(place[1] - bottom, 2)]


def _way(live: "Live", here: Cell, there: Cell) -> str:
    """Cells of a bound, its length and its direction."""
    grid = live.campaign.workspace.grid
    (x0, y0), (x1, y1) = grid.center(here), grid.center(there)
    length = math.hypot(x1 - x0, y1 - y0)
    north = math.degrees(math.atan2(x1 - x0, y1 - y0)) % 360.0
    compass = _COMPASS[round(north / 45.0) % 8]
    return f"from {_text(here)} to {_text(there)}, {length:.0f} m {compass}"


def _text(cell: Cell) -> str:
    return f"{cell[0]},{cell[1]}"


def _plain(values: Any) -> Any:
    """Numbers as nested lists of few digits; None for NaN."""
    array = np.round(np.asarray(values, dtype=float), _DIGITS)
    if np.isfinite(array).all():
        return array.tolist()
    objects = array.astype(object)
    objects[~np.isfinite(array)] = None
    return objects.tolist()
