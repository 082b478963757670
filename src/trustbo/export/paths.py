"""The recommended path, posts and ways as GeoJSON or GeoPackage."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import shapely
from pyproj.exceptions import CRSError
from shapely import LineString

from trustbo.campaign.result import Result
from trustbo.errors import TrustboError, require_choice
from trustbo.export.checks import require_crs, require_names_for_sql
from trustbo.export.layers import bounds_layer, plan_of, posts_layer, ways_layer
from trustbo.files import FilePath, require_file, to_json, write_file, write_text
from trustbo.planning import Plan

_WGS84 = "EPSG:4326"
_NAME = "most trustworthy path"
_LAYERS = {"bounds": bounds_layer, "posts": posts_layer, "ways": ways_layer}


def path_frame(
    plan: Plan | Result, *, layer: str = "bounds", crs: Any = _WGS84
) -> gpd.GeoDataFrame:
    """Return a path as points, one per cell, or the posts or the ways of its bounds.

    ====== ==================================================================================
    bounds Points at the centres of the cells: `bound` (0 for the start), `row`, `col`; for each
           robot the expected trust after the bound, `trust_<robot>`, and its 5 % and 95 %
           quantiles over the posterior, `trust_<robot>_low` and `_high`, NaN for bound 0; where the
           plan has a risk, `p_fail` of the bound, `p_fail_low` and `_high`, `p_fail_<cause>`, and
           `p_arrive`, the chance to get as far; and on a terrain `unseen`, the share of the bound's
           time in which nobody sees anybody.
    posts  Points where T2 stands while the lead runs a bound: `bound` (from 1), `robot`, `row` and
           `col` of the cell, and `lead_x`, `lead_y`, where the lead stops then.
    ways   Lines: `bound` (from 1), `robot` ("lead" first, which drives first), `length_m`.
    ====== ==================================================================================

    `x` and `y` of points are metres in the CRS of the grid, `geometry` is in `crs`. A robot without
    a way in a bound has no line.

    Args:
        plan: Plan, or result whose recommended path is meant.
        layer: "bounds", "posts" or "ways"; the last two need a terrain.
        crs: CRS of the geometry, anything that pyproj accepts; None for that of the grid, if any.

    Raises:
        TrustboError: The layer or `crs` is unknown, the workspace has no CRS or no terrain, or a
            robot is called "lead".
    """
    plan = plan_of(plan)
    make = _LAYERS[require_choice("layer", layer, _LAYERS)]
    if crs is None:
        return make(plan)
    require_crs(plan.workspace)
    try:
        return make(plan).to_crs(crs)
    except CRSError:
        raise TrustboError(f"unknown crs {crs!r}; give e.g. 'EPSG:4326', or None.") from None


def write_path(path: FilePath, plan: Plan | Result) -> None:
    """Write a path, with its posts and ways, in the format of the suffix.

    ======== ========================================================================
    .geojson RFC 7946, longitude and latitude on WGS 84: a LineString from start to
             goal, a Point per cell with its `bound`, `cell` and trust, a Point per
             post, a LineString per way; the property `layer` is "path", "bounds",
             "posts" or "ways".
    .gpkg    GeoPackage: layers `path` (LineString), `bounds` (points), `posts` and
             `ways`, in the terrain's CRS.
    ======== ========================================================================

    Columns and properties are those of `path_frame`; those of the whole path are its name, number
    of bounds, length, value and objective, and the toll on the time in which
    nobody sees anybody, `unseen_toll`, if there is one. Posts and ways are left out where the
    workspace has no terrain in memory.

    Args:
        path: File to write, or to replace.
        plan: Plan, or result whose recommended path is meant.

    Raises:
        TrustboError: The suffix is unknown, the workspace has no CRS, a robot is called "lead", or
            the file cannot be written.
    """
    plan = plan_of(plan)
    file = require_file(path)
    _WRITERS[require_choice("suffix", file.suffix.lower(), _WRITERS)](file, plan)


def _facts(plan: Plan) -> dict[str, object]:
    """Return the properties of the whole path."""
    return {
        "name": _NAME,
        "n_bounds": len(plan.path) - 1,
        "value": float(plan.value),
        "objective": plan.objective,
        "length_m": float(plan.length),
        **({"unseen_toll": plan.unseen_toll} if plan.unseen_toll else {}),
    }


def _write_geojson(file: Path, plan: Plan) -> None:
    bounds = path_frame(plan)
    line = _feature("path", LineString(bounds.geometry.to_list()), _facts(plan))
    features = [line, *_features("bounds", bounds)]
    for layer in _of_terrain(plan):
        features += _features(layer, path_frame(plan, layer=layer))
    write_text(file, to_json({"type": "FeatureCollection", "features": features}))


def _features(layer: str, frame: gpd.GeoDataFrame) -> list[dict[str, object]]:
    """Return features with what is known, and with `cell` for row and column."""
    features = []
    rows = frame.drop(columns=["geometry", *frame.columns.intersection(["x", "y"])])
    for row, place in zip(rows.to_dict("records"), frame.geometry, strict=True):
        if "row" in row:
            row["cell"] = [row.pop("row"), row.pop("col")]
        properties = {name: value for name, value in row.items() if value == value}
        features.append(_feature(layer, place, properties))
    return features


def _feature(layer: str, place: Any, properties: dict[str, object]) -> dict[str, object]:
    # RFC 7946, 11.2: no more digits than the precision; the eighth is a millimetre.
    positions = np.round(shapely.get_coordinates(place), 8).tolist()
    coordinates = positions if place.geom_type == "LineString" else positions[0]
    geometry = {"type": place.geom_type, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": {"layer": layer, **properties}}


def _write_geopackage(file: Path, plan: Plan) -> None:
    workspace = plan.workspace
    require_crs(workspace)
    require_names_for_sql(workspace.team.names)
    bounds = bounds_layer(plan)
    way = LineString(bounds.geometry.to_list())
    layers = {"path": gpd.GeoDataFrame([_facts(plan)], geometry=[way], crs=bounds.crs)}
    layers["bounds"] = bounds
    layers |= {name: _LAYERS[name](plan) for name in _of_terrain(plan)}

    def write(temporary: Path) -> None:
        for name, layer in layers.items():
            mode = "a" if temporary.exists() else "w"
            layer.to_file(temporary, layer=name, driver="GPKG", engine="pyogrio", mode=mode)

    write_file(file, write)


def _of_terrain(plan: Plan) -> tuple[str, ...]:
    """Names of the layers that a plan has on a terrain in memory only."""
    return () if plan.workspace.ground is None else ("posts", "ways")


_WRITERS: dict[str, Callable[[Path, Plan], None]] = {
    ".geojson": _write_geojson,
    ".gpkg": _write_geopackage,
}
