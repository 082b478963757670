"""Layers of a plan as tables: its bounds, the posts of T2, and the ways of all robots."""

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

from trustbo.campaign.result import Result
from trustbo.errors import TrustboError, require_kind
from trustbo.export.checks import LEAD, find_crs, require_lead_apart
from trustbo.planning import Plan
from trustbo.planning.plan import QUANTILES

_BAND = {"low": QUANTILES.index(0.05), "high": QUANTILES.index(0.95)}
_LEAST = 1e-6
"""Least probability in tables; a smaller one is 0."""


def plan_of(plan: Plan | Result) -> Plan:
    """Return a plan, or that of a result; TrustboError: a robot is called as the lead."""
    remedy = "give a Plan, as Campaign.ask returns it, or a Result"
    plan = plan.plan if isinstance(plan, Result) else plan
    require_kind("plan", plan, Plan, remedy)
    require_lead_apart(plan.workspace.team.names)
    return plan


def bounds_layer(plan: Plan) -> gpd.GeoDataFrame:
    """Return a point for each cell, the centre, with the trust after the bound into it.

    Where the plan has a risk, also with the bound's chance to fail.
    """
    row, col = np.array(plan.path).T
    x, y = np.array([plan.workspace.grid.center(cell) for cell in plan.path]).T
    columns = {"bound": np.arange(len(row)), "row": row, "col": col, "x": x, "y": y}
    for i, robot in enumerate(plan.workspace.team.names):
        columns[f"trust_{robot}"] = np.insert(plan.trust[:, i], 0, np.nan)
        for end, q in _BAND.items():
            columns[f"trust_{robot}_{end}"] = np.insert(plan.bands[q, :, i], 0, np.nan)
    if plan.risk is not None:
        chances = {"p_fail": plan.risk.p_fail}
        ends = zip(_BAND, plan.risk.p_fail_band, strict=True)
        chances |= {f"p_fail_{end}": p for end, p in ends}
        chances |= {f"p_fail_{cause}": p for cause, p in plan.risk.by_cause.items()}
        seen = {name: np.where(p < _LEAST, 0.0, p) for name, p in chances.items()}
        columns |= {name: np.insert(p, 0, np.nan) for name, p in seen.items()}
        columns["p_arrive"] = np.insert(plan.risk.p_reach, 0, 1.0)
    return _frame(plan, columns, x, y)


def posts_layer(plan: Plan) -> gpd.GeoDataFrame:
    """Return a point for each bound and robot of T2: where it stands, and what it watches."""
    posts, stops = _required(plan, plan.posts), _required(plan, plan.stops)
    n_bounds, n_robots = posts.shape[:2]
    (row, col), (x, y) = np.array(plan.path[:-1]).T, posts.reshape(-1, 2).T
    lead_x, lead_y = stops[1:].T
    of_bound = {
        "bound": np.arange(1, n_bounds + 1), "row": row, "col": col, "lead_x": lead_x,
        "lead_y": lead_y,
    }  # fmt: skip
    columns = {name: np.repeat(values, n_robots) for name, values in of_bound.items()}
    columns |= {"robot": np.tile(plan.workspace.team.names, n_bounds), "x": x, "y": y}
    order = ("bound", "robot", "row", "col", "x", "y", "lead_x", "lead_y")
    return _frame(plan, {name: columns[name] for name in order}, x, y)


def ways_layer(plan: Plan) -> gpd.GeoDataFrame:
    """Return a line for each bound and robot, the lead first; none for a robot without a way."""
    names = (LEAD, *plan.workspace.team.names)
    rows = [
        (k, robot, shapely.LineString(way))
        for k, ways in enumerate(_required(plan, plan.ways), start=1)
        for robot, way in zip(names, ways, strict=True)
        if way is not None
    ]
    bound, robot, lines = zip(*rows, strict=True) if rows else ((), (), ())
    lengths = [line.length for line in lines]
    table = pd.DataFrame({"bound": bound, "robot": robot, "length_m": lengths})
    return gpd.GeoDataFrame(table, geometry=list(lines), crs=_crs(plan))


def complete_routes(plan: Plan) -> dict[str, list[np.ndarray]]:
    """Return the ways of each robot, bound by bound, the lead first.

    TrustboError: a robot that has no way in a bound, or no terrain in memory.
    """
    names = (LEAD, *plan.workspace.team.names)
    routes: dict[str, list[np.ndarray]] = {robot: [] for robot in names}
    for k, ways in enumerate(_required(plan, plan.ways), start=1):
        for robot, way in zip(names, ways, strict=True):
            if way is None:
                raise TrustboError(
                    f"{robot} has no way in bound {k}, so that it cannot be sent along the path; "
                    "plan another, or give it a larger max_slope."
                )
            routes[robot].append(way)
    return routes


def _required[T](plan: Plan, values: T | None) -> T:
    if values is None:
        raise TrustboError(
            "a plan has posts and ways where its workspace was made from a terrain in memory; use "
            "Workspace.from_terrain."
        )
    return values


def _frame(plan: Plan, columns: dict, x: np.ndarray, y: np.ndarray) -> gpd.GeoDataFrame:
    points = gpd.points_from_xy(x, y)
    return gpd.GeoDataFrame(pd.DataFrame(columns), geometry=points, crs=_crs(plan))


def _crs(plan: Plan) -> str | None:
    crs = find_crs(plan.workspace)
    return None if crs is None else crs.to_wkt()
