"""The recommended path as GeoJSON, GPX, GeoPackage or CSV."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
from pyproj.exceptions import CRSError
from shapely import LineString

from trustbo.campaign.result import Result
from trustbo.errors import ShapeError, TrustboError, require_choice
from trustbo.export.checks import find_crs, require_crs, require_names_for_sql
from trustbo.export.gpx import gpx_route
from trustbo.files import FilePath, require_file, to_json, write_file, write_text
from trustbo.planning import Plan
from trustbo.planning.plan import QUANTILES
from trustbo.workspace import Workspace

_BAND = {"low": QUANTILES.index(0.05), "high": QUANTILES.index(0.95)}
_WGS84 = "EPSG:4326"
_NAME = "most trustworthy path"


def path_frame(
    plan: Plan | Result, workspace: Workspace | None = None, *, crs: Any = _WGS84
) -> gpd.GeoDataFrame:
    """Return a path as points, one per cell.

    Columns are `bound` (0 for the start), `row`, `col`, `x` and `y` (centre of the cell, metres in
    the CRS of the grid); for each robot the expected trust after the bound, `trust_<robot>`, and
    its 5 % and 95 % quantiles over the posterior, `trust_<robot>_low` and `_high`, NaN for bound 0;
    `geometry` in `crs`.

    Args:
        plan: Plan, or result whose recommended path is meant.
        workspace: Workspace of the plan; by default that of the result.
        crs: CRS of the geometry, anything that pyproj accepts; None for that of the grid, if any.

    Raises:
        ShapeError: The plan and the workspace differ in their numbers of robots.
        TrustboError: The workspace has no CRS, `crs` is unknown, or the path leaves the workspace.
    """
    plan, workspace = plan_of(plan, workspace)
    own = find_crs(workspace) if crs is None else require_crs(workspace)
    table = _table(plan, workspace)
    points = gpd.points_from_xy(table["x"], table["y"])
    frame = gpd.GeoDataFrame(table, geometry=points, crs=None if own is None else own.to_wkt())
    if crs is None:
        return frame
    try:
        return frame.to_crs(crs)
    except CRSError:
        raise TrustboError(f"unknown crs {crs!r}; give e.g. 'EPSG:4326', or None.") from None


def write_path(path: FilePath, plan: Plan | Result, workspace: Workspace | None = None) -> None:
    """Write a path in the format of the suffix.

    ======== ========================================================================
    .geojson RFC 7946: a LineString from start to goal, then a Point per cell with
             its `bound`, `cell` and trust; longitude and latitude on WGS 84.
    .gpx     GPX 1.1: a route; its points are named start, bound 1, ..., goal; the
             description is the trust, the elevation that of the ground above the
             datum of the DEM, in metres, if the workspace has a terrain.
    .gpkg    GeoPackage: layers `path` (LineString) and `bounds` (points), in the
             terrain's CRS.
    .csv     The points as a table, with longitude and latitude if there is a CRS.
    ======== ========================================================================

    Args:
        path: File to write, or to replace.
        plan: Plan, or result whose recommended path is meant.
        workspace: Workspace of the plan; by default that of the result. Without a terrain, only a
            table can be written.

    Raises:
        ShapeError: The plan and the workspace differ in their numbers of robots.
        TrustboError: The suffix is unknown, the workspace has no CRS, the path leaves the
            workspace, or the file cannot be written.
    """
    plan, workspace = plan_of(plan, workspace)
    suffix = require_choice("suffix", Path(path).suffix.lower(), _WRITERS)
    _WRITERS[suffix](require_file(path), plan, workspace)


def plan_of(plan: Plan | Result, workspace: Workspace | None) -> tuple[Plan, Workspace]:
    """Return a plan and its workspace.

    ShapeError: they differ in their numbers of robots. TrustboError: no workspace, or the path
    leaves it.
    """
    if isinstance(plan, Result):
        plan, workspace = plan.plan, workspace or plan.workspace
    if workspace is None:
        raise TrustboError("a plan has no workspace; give the workspace too.")
    for k, cell in enumerate(plan.path):
        workspace.require_cell(f"path[{k}]", cell)
    n_robots = plan.trust.shape[1]
    if n_robots != len(workspace.team.names):
        raise ShapeError(f"the plan has {n_robots} robots, the workspace {workspace.team.names}.")
    return plan, workspace


def _table(plan: Plan, workspace: Workspace) -> pd.DataFrame:
    """Return the columns of `path_frame` without the geometry."""
    row, col = np.array(plan.path).T
    x, y = np.array([workspace.grid.center(cell) for cell in plan.path]).T
    columns = {"bound": np.arange(len(row)), "row": row, "col": col, "x": x, "y": y}
    for i, robot in enumerate(workspace.team.names):
        columns[f"trust_{robot}"] = np.insert(plan.trust[:, i], 0, np.nan)
        for end, q in _BAND.items():
            columns[f"trust_{robot}_{end}"] = np.insert(plan.bands[q, :, i], 0, np.nan)
    return pd.DataFrame(columns)


def _facts(plan: Plan) -> dict[str, object]:
    """Return the properties of the whole path."""
    return {
        "name": _NAME,
        "n_bounds": len(plan.path) - 1,
        "value": float(plan.value),
        "objective": plan.objective,
        "length_m": float(plan.length),
    }


def _write_geojson(file: Path, plan: Plan, workspace: Workspace) -> None:
    frame = path_frame(plan, workspace)
    lon, lat = frame.geometry.x, frame.geometry.y
    # RFC 7946, 11.2: no more digits than the precision; the eighth is a millimetre.
    positions = [[round(a, 8), round(b, 8)] for a, b in zip(lon, lat, strict=True)]
    features = [_feature("LineString", positions, _facts(plan))]
    trust = frame.filter(like="trust_").to_dict("records")
    for k, (position, cell, of_robots) in enumerate(zip(positions, plan.path, trust, strict=True)):
        known = {name: value for name, value in of_robots.items() if np.isfinite(value)}
        features.append(_feature("Point", position, {"bound": k, "cell": list(cell), **known}))
    write_text(file, to_json({"type": "FeatureCollection", "features": features}))


def _feature(kind: str, coordinates: list, properties: dict[str, object]) -> dict[str, object]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _write_gpx(file: Path, plan: Plan, workspace: Workspace) -> None:
    write_text(file, gpx_route(path_frame(plan, workspace), workspace, _NAME))


def _write_geopackage(file: Path, plan: Plan, workspace: Workspace) -> None:
    require_crs(workspace)
    require_names_for_sql(workspace.team.names)
    points = path_frame(plan, workspace, crs=None)
    way = LineString(np.column_stack([points["x"], points["y"]]))
    line = gpd.GeoDataFrame([_facts(plan)], geometry=[way], crs=points.crs)

    def write(temporary: Path) -> None:
        line.to_file(temporary, layer="path", driver="GPKG", engine="pyogrio")
        points.to_file(temporary, layer="bounds", driver="GPKG", engine="pyogrio", mode="a")

    write_file(file, write)


def _write_csv(file: Path, plan: Plan, workspace: Workspace) -> None:
    table = _table(plan, workspace)
    if find_crs(workspace) is not None:
        place = path_frame(plan, workspace).geometry
        table.insert(5, "longitude", place.x)
        table.insert(6, "latitude", place.y)
    write_text(file, table.to_csv(index=False, lineterminator="\n"))


_WRITERS: dict[str, Callable[[Path, Plan, Workspace], None]] = {
    ".geojson": _write_geojson,
    ".gpx": _write_gpx,
    ".gpkg": _write_geopackage,
    ".csv": _write_csv,
}
