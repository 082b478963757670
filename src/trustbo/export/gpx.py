"""A path and the ways of all robots as GPX 1.1 routes, for GPS receivers and phones."""

from xml.etree import ElementTree as ET

import geopandas as gpd
import numpy as np
import shapely
import xarray as xr

from trustbo.export.checks import LEAD, require_crs
from trustbo.export.layers import bounds_layer, routes_of
from trustbo.planning import Plan

_NAMESPACE = "http://www.topografix.com/GPX/1/1"
_HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'


def gpx_routes(plan: Plan, name: str) -> str:
    """Return the XML of a route of that name, and of one for each robot, the lead first.

    The first follows the centres of the cells; the others, with a terrain in memory only, the
    robots' ways, thinned by at most half a pixel. TrustboError: the workspace has no CRS.
    """
    root = ET.Element("gpx", version="1.1", creator="trustbo", xmlns=_NAMESPACE)
    centers = bounds_layer(plan).drop(columns="geometry")
    rows = centers.to_dict("records")
    descriptions = ["start", *(_trust(row, plan.workspace.team.names) for row in rows[1:])]
    about = "expected trust in each robot after each bound, and its 90 % band"
    place = centers[["x", "y"]].to_numpy()
    _add(root, plan, name, about, place, list(zip(_ends(plan), descriptions, strict=True)))
    if (surface := plan.workspace.surface) is not None:
        near = 0.5 * min(surface.pixel)
        for robot, ways in routes_of(plan).items():
            _add(root, plan, robot, *_route(plan, robot, ways, near))
    ET.indent(root)
    return _HEAD + ET.tostring(root, encoding="unicode") + "\n"


def _route(
    plan: Plan, robot: str, ways: list[np.ndarray], near: float
) -> tuple[str, np.ndarray, list[tuple[str, str]]]:
    """Return the description of a robot's route, its points (point, 2), and their labels."""
    n_bounds, names = len(plan.path) - 1, (LEAD, *plan.workspace.team.names)
    cells = [f"cell {row}, {col}" for row, col in plan.path]
    stops = [(end, f"waypoint of {cell}") for end, cell in zip(_ends(plan), cells, strict=True)]
    about = "ways of the lead; it stops at points with a name, while the others close up"
    first = plan.waypoints
    if robot != LEAD:
        watches = [f"watches the lead go to {cell}" for cell in cells[1:]]
        posts = [f"post {k}" for k in range(1, n_bounds + 1)]
        stops = [*zip(posts, watches, strict=True), ("goal", "around the lead")]
        about = f"ways of {robot}; it watches the lead from points with a name"
        first = plan.posts[:, names.index(robot) - 1] if plan.posts is not None else None
    assert first is not None  # noqa: S101  # there is a terrain
    points, texts = [first[0]], stops[:1]
    for way, stop in zip(ways, stops[1:], strict=False):
        thin = shapely.get_coordinates(shapely.LineString(way).simplify(near))
        points += list(thin[1:])
        texts += [("", "")] * (len(thin) - 2) + [stop]
    if len(ways) < n_bounds:
        about += f"; it has no way in bound {len(ways) + 1}"
    return about, np.array(points), texts


def _add(
    root: ET.Element,
    plan: Plan,
    name: str,
    about: str,
    place: np.ndarray,
    texts: list[tuple[str, str]],
) -> None:
    """Add a route through places (point, 2) in CRS metres, with the name and text of each."""
    route = ET.SubElement(root, "rte")
    ET.SubElement(route, "name").text = name
    ET.SubElement(route, "desc").text = about
    crs = require_crs(plan.workspace).to_wkt()
    degrees = gpd.points_from_xy(*place.T, crs=crs).to_crs("EPSG:4326")
    heights = _ground(place, plan.workspace.terrain)
    for point, height, (stop, text) in zip(degrees, heights, texts, strict=True):
        element = ET.SubElement(route, "rtept", lat=f"{point.y:.8f}", lon=f"{point.x:.8f}")
        # The order is that of the schema.
        if np.isfinite(height):
            ET.SubElement(element, "ele").text = f"{height:.2f}"
        if stop:
            ET.SubElement(element, "name").text = stop
            ET.SubElement(element, "desc").text = text


def _ends(plan: Plan) -> list[str]:
    """Names of the cells of a path."""
    return ["start", *(f"bound {k}" for k in range(1, len(plan.path) - 1)), "goal"]


def _trust(row: dict, robots: tuple[str, ...]) -> str:
    parts = []
    for robot in robots:
        trust, low, high = (row[f"trust_{robot}{end}"] for end in ("", "_low", "_high"))
        parts.append(f"{robot} {trust:.2f} ({low:.2f} to {high:.2f})")
    return ", ".join(parts)


def _ground(place: np.ndarray, terrain: xr.Dataset | None) -> np.ndarray:
    """Height of the ground at places (point, 2), m; NaN where it is not known."""
    if terrain is None:
        return np.full(len(place), np.nan)
    x, y = (xr.DataArray(values, dims="point") for values in place.T)
    return terrain["dem"].sel(x=x, y=y, method="nearest").values
