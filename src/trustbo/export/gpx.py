"""A path as a GPX 1.1 route, for GPS receivers and phones."""

from xml.etree import ElementTree as ET

import geopandas as gpd
import numpy as np
import xarray as xr

from trustbo.workspace import Workspace

_NAMESPACE = "http://www.topografix.com/GPX/1/1"
_HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'


def gpx_route(frame: gpd.GeoDataFrame, workspace: Workspace, name: str) -> str:
    """Return the XML of a route of that name: points of `path_frame`, in degrees on WGS 84."""
    root = ET.Element("gpx", version="1.1", creator="trustbo", xmlns=_NAMESPACE)
    route = ET.SubElement(root, "rte")
    ET.SubElement(route, "name").text = name
    ET.SubElement(
        route, "desc"
    ).text = "expected trust in each robot after each bound, and its 90 % band"
    heights = _ground(frame, workspace)
    rows = frame.drop(columns="geometry").to_dict("records")
    names = {0: "start", len(rows) - 1: "goal"}
    for row, place, height in zip(rows, frame.geometry, heights, strict=True):
        point = ET.SubElement(route, "rtept", lat=f"{place.y:.8f}", lon=f"{place.x:.8f}")
        # The order is that of the schema.
        if np.isfinite(height):
            ET.SubElement(point, "ele").text = f"{height:.2f}"
        ET.SubElement(point, "name").text = names.get(row["bound"], f"bound {row['bound']}")
        said = "start" if row["bound"] == 0 else _trust(row, workspace.team.names)
        ET.SubElement(point, "desc").text = said
    ET.indent(root)
    return _HEAD + ET.tostring(root, encoding="unicode") + "\n"


def _trust(row: dict, robots: tuple[str, ...]) -> str:
    parts = []
    for robot in robots:
        trust, low, high = (row[f"trust_{robot}{end}"] for end in ("", "_low", "_high"))
        parts.append(f"{robot} {trust:.2f} ({low:.2f} to {high:.2f})")
    return ", ".join(parts)


def _ground(frame: gpd.GeoDataFrame, workspace: Workspace) -> np.ndarray:
    """Height of the ground at the centre of each cell, m; NaN where it is not known."""
    if workspace.terrain is None:
        return np.full(len(frame), np.nan)
    x, y = (xr.DataArray(frame[axis].to_numpy(), dims="cell") for axis in ("x", "y"))
    return workspace.terrain["dem"].sel(x=x, y=y, method="nearest").values
