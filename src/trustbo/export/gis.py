"""Files for GIS: maps as GeoTIFF, plans as GeoJSON, and missions as CSV."""

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
import rioxarray  # noqa: F401  (registers the .rio accessor)
import shapely
import xarray as xr
from rasterio.io import MemoryFile
from shapely import affinity

from trustbo.campaign.result import Result
from trustbo.data import POST_SETS
from trustbo.errors import TrustboError, require_kind
from trustbo.export.bands import bands_of, north_up
from trustbo.files import FilePath, to_path, write_file, write_text
from trustbo.logs.table import to_frame
from trustbo.planning import Plan
from trustbo.terrain.place import converted
from trustbo.workspace.moves import cells_along, posts_along

_NO_CRS = "this export needs a CRS; make the workspace with Workspace.from_terrain."
LAYERS = ("path", "bounds", "places", "closed", "posts", "routes")
"""Layers of a plan in GeoJSON."""
_TIFF = (".tif", ".tiff")
"""Suffixes of a GeoTIFF."""


def write_geotiff(path: FilePath, maps: Result | xr.Dataset) -> None:
    """Write maps of the planning cells as the bands of a GeoTIFF in the terrain's CRS.

    Bands are float32 with nodata NaN, and their descriptions are the variable names. Maps of
    several robots have a band for each, such as "trust_mean r1". North is at the top, and the
    pixels are where the coordinates `x` and `y` of the maps are, also after xarray has selected or
    averaged cells. Files in which a GIS stored statistics, overviews or masks of an older raster of
    that name are removed.

    Args:
        path: .tif or .tiff file to write or replace.
        maps: Result or campaign, or maps such as `Result.maps()` or `Result.robot_maps()`. Before
            the first mission, the maps are those of the prior.

    Raises:
        TrustboError: `maps` is a plan, which has no maps of all cells; `maps` has no CRS, or no
            coordinates at equal distances; a variable is not a map of numbers; or the file cannot
            be written.

    Example:
        >>> tb.export.write_geotiff("maps.tif", result.maps())
    """
    maps = maps.maps() if isinstance(maps, Result) else maps
    require_kind("maps", maps, xr.Dataset, "give a result or a campaign, or its maps()")
    target = to_path(path)
    if target.suffix.lower() not in _TIFF:
        raise TrustboError(f"{str(target)!r} must end in {' or '.join(_TIFF)}.")

    if maps.rio.crs is None:
        raise TrustboError(f"{_NO_CRS[:-1]}, or open a file of maps with decode_coords='all'.")
    placed, transform = north_up(maps)
    bands = bands_of(placed)

    profile = {
        "driver": "GTiff", "interleave": "band", "height": placed.sizes["y"],
        "width": placed.sizes["x"], "count": len(bands), "dtype": "float32",
        "nodata": np.nan, "crs": maps.rio.crs, "transform": transform,
        "compress": "deflate",
    }  # fmt: skip

    # In memory, because rasterio raises no error if it closes a file on a full disk.
    with MemoryFile() as memory:
        with memory.open(**profile) as raster:
            for i, (name, values) in enumerate(bands, start=1):
                raster.write(values.values.astype(np.float32), i)
                raster.set_band_description(i, name)
                if "long_name" in values.attrs:
                    raster.update_tags(i, long_name=str(values.attrs["long_name"]))
        content = memory.read()

    write_file(target, content, is_raster=True)


def write_geojson(path: FilePath, plan: Plan | Result) -> None:
    """Write a path as GeoJSON (RFC 7946), in longitude and latitude (WGS 84).

    For a result or a campaign, this is the recommended path, the best one under the posterior mean.
    To write the next path of a campaign, which may differ, pass `campaign.ask()`.

    The file contains a LineString of the path through the lead's stops and a Point for each stop
    or, without a terrain, for the centre of each cell. The properties of a stop are the trust of
    each robot with its 90 % interval, and the failure probability. With a terrain, there is also a
    Point for each post and a LineString for each route. The property `layer` is "path", "bounds",
    "places" (with names), "closed" (with reasons), "posts" or "routes". Bounds, posts and routes
    have the property `driven`: true if the bound had been driven when the mission was replanned.
    Lines are cut where they cross the 180th meridian.

    Args:
        path: File to write or replace. A path without an ending, such as "field", is a folder with
            a file for each layer, "field/path.geojson", so that a GIS can give each a style.
        plan: Plan, such as one from `Campaign.ask`, `Campaign.replan` or `Follower.replan`; or a
            result or campaign, whose recommended path is written.

    Raises:
        TrustboError: The workspace has no CRS, or the file cannot be written.

    Example:
        >>> tb.export.write_geojson("path.geojson", result.plan())
    """
    name = "recommended path" if isinstance(plan, Result) else "planned path"
    plan = plan.plan() if isinstance(plan, Result) else plan
    require_kind("plan", plan, Plan, "give a Plan, for example from Campaign.ask, or a Result")
    facts = {"name": name, "n_bounds": len(plan.path) - 1, "n_driven": plan.n_driven}
    facts |= {"value": float(plan.value), "objective": plan.objective}
    stops = plan.positions if plan.stops is None else plan.stops
    facts |= {"length_m": shapely.LineString(stops).length}
    features = [_feature(plan, "path", stops, facts)]

    rows = plan.to_frame().loc[:, "driven":].to_dict("records")
    cells = cells_along(plan.path).tolist()
    for k, (cell, place, row) in enumerate(zip(cells, stops, rows, strict=True)):
        known = {name: value for name, value in row.items() if pd.notna(value)}
        features.append(_feature(plan, "bounds", place, {"bound": k, **known, "cell": cell}))

    features += [*_of_ground(plan), *_of_robots(plan)]
    target = to_path(path)
    files = {target: features}
    if not target.suffix:
        files = {target / f"{layer}.geojson": [] for layer in LAYERS}
        for one in features:
            files[target / f"{one['properties']['layer']}.geojson"].append(one)
    for file, of_file in files.items():
        write_text(file, json.dumps({"type": "FeatureCollection", "features": of_file}))


def _of_ground(plan: Plan) -> Iterator[dict[str, Any]]:
    """Yield the features of places, and of closed cells and bounds."""
    workspace = plan.workspace
    for place, position in workspace.places.items():
        about = {"name": place, "cell": workspace.locate(place)}
        if workspace.posts is not None:
            about["from_stop_m"] = workspace.from_stop(place)
        yield _feature(plan, "places", np.array(position), about)

    for closed, reason in workspace.closed.items():
        row, col = np.array(closed).T
        shape = np.stack([workspace.grid.x[col], workspace.grid.y[row]], 1)
        about = {"reason": reason, "cells": [list(cell) for cell in closed]}
        yield _feature(plan, "closed", shape if len(shape) > 1 else shape[0], about)


def _of_robots(plan: Plan) -> Iterator[dict[str, Any]]:
    """Yield the features of posts and routes; there are none without a terrain."""
    team = plan.workspace.team
    cells = cells_along(plan.path).tolist()
    sets = posts_along(plan.stations)
    for k, (cell, places) in enumerate(zip(cells, _of(plan.posts), strict=False), start=1):
        for robot, place in zip(team.names, places, strict=True):
            about = {"bound": k, "robot": robot, "driven": k <= plan.n_driven, "cell": cell}
            if plan.workspace.n_posts > 1:
                about["posts"] = POST_SETS[sets[k - 1]]
            yield _feature(plan, "posts", place, about)

    for k, routes in enumerate(_of(plan.routes), start=1):
        for robot, route in zip(team.members, routes, strict=True):
            if route is not None:
                about = {"bound": k, "robot": robot, "driven": k <= plan.n_driven}
                about |= {"length_m": shapely.LineString(route).length}
                yield _feature(plan, "routes", route, about)


def write_csv(path: FilePath, result: Result) -> None:
    """Write a table with one row for each mission, bound and robot.

    The table has the columns of `logs.to_frame`, and `trust_mean` and `trust_sd`: the mean and
    standard deviation of latent trust under the last posterior. Missing measurements are blank, and
    so is the trust in missions that are not in the last posterior. Missions of earlier campaigns on
    this map come first, with the negative numbers of `Result.table`.

    Args:
        path: File to write or replace.
        result: Result of a campaign, or the campaign.

    Raises:
        TrustboError: `result` is a plan, which has no missions; there is no posterior yet; or the
            file cannot be written.

    Example:
        >>> tb.export.write_csv("missions.csv", result)
    """
    require_kind("result", result, Result, "give a result or a campaign")
    latent = result.posterior["latent"].to_dataset()[["trust_mean", "trust_sd"]]

    earlier = result.state.earlier_here
    missions = [result.state.earlier.missions[i] for i in earlier.values()]
    labels = [*earlier, *range(1, len(result.missions) + 1)]
    table = to_frame([*missions, *result.missions])
    table["mission"] = np.array(labels)[table["mission"] - 1]

    # The posterior lacks missions that are excluded or not learned from yet.
    label = latent["mission"].values
    numbered = latent.assign_coords(mission=np.where(label < 0, label, label + 1))
    keys = ["mission", "bound", "robot"]
    trust = numbered.to_dataframe(dim_order=keys)[["trust_mean", "trust_sd"]]
    write_text(path, table.join(trust, on=keys).to_csv(index=False, lineterminator="\n"))


def _of(values: Any) -> Any:
    """Return posts or routes of a plan; an empty tuple if the plan has no terrain."""
    return () if values is None else values


def _feature(plan: Plan, layer: str, places: np.ndarray, about: dict[str, Any]) -> dict[str, Any]:
    """Make a GeoJSON Point at a position (2,) or LineString of positions (point, 2), CRS metres."""
    crs = plan.workspace.grid.crs
    if crs is None:
        raise TrustboError(_NO_CRS)

    lon, lat = converted(crs, "EPSG:4326", *np.atleast_2d(places).T)
    shape = shapely.Point(lon[0], lat[0])
    if places.ndim == 2:
        shape = cut_at_180(shapely.LineString(np.column_stack([np.unwrap(lon, period=360.0), lat])))

    # RFC 7946, 11.2: no needless digits; the eighth decimal is about a millimetre.
    rounded = shapely.transform(shape, lambda values: np.round(values, 8))
    geometry = json.loads(shapely.to_geojson(rounded))
    return {"type": "Feature", "geometry": geometry, "properties": {"layer": layer, **about}}


def cut_at_180(line: shapely.LineString) -> shapely.Geometry:
    """Cut a line at longitude 180 degrees (RFC 7946, 3.1.9); its longitudes must not jump."""
    west, _, east, _ = line.bounds
    if -180.0 <= west and east <= 180.0:
        return line

    parts = []
    for turn in (-360.0, 0.0, 360.0):
        part = line.intersection(shapely.box(turn - 180.0, -90.0, turn + 180.0, 90.0))
        parts += [affinity.translate(one, -turn) for one in shapely.get_parts(part)
                  if one.geom_type == "LineString" and not one.is_empty]  # fmt: skip

    return shapely.MultiLineString(parts)
