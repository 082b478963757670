"""Ways, posts and times of a plan, and a map, as KMZ for Google Earth and phones; by simplekml."""

import tempfile
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import rioxarray  # noqa: F401  (registers the .rio accessor)
import xarray as xr
from PIL import Image, ImageDraw

from trustbo.campaign.result import Result
from trustbo.errors import require_package
from trustbo.export.checks import require_crs, require_maps
from trustbo.export.colours import Colour, of_robot, of_values
from trustbo.export.cot import begin_of, zulu
from trustbo.export.layers import degrees_of, plan_of
from trustbo.export.schedule import schedule_of
from trustbo.files import FilePath, require_file, write_file
from trustbo.planning import Plan

_FINE = 8
"""Pixels of the picture of a map along a cell."""
_LINE = 3
_DOT = 32
"""Side of the mark of a place, pixels."""


def write_kmz(
    path: FilePath,
    plan: Plan | Result,
    cost: xr.DataArray | None = None,
    *,
    start: datetime | None = None,
) -> None:
    """Write what each robot is to do, with times, as KMZ for Google Earth, phones and ATAK.

    A folder for each robot, the lead first, has a line for each way and a placemark for each place,
    which a time slider shows while they are driven and occupied. A map is laid on the ground.

    Args:
        path: .kmz file to write, or to replace.
        plan: Plan, or result whose recommended path is meant, on a terrain in memory.
        cost: Map (row, col) in [0, 1] to lay on the ground, e.g. `Result.maps()["cost"]`.
        start: Start of the mission, with a time zone; by default now.

    Raises:
        ShapeError: The map has other dims or another number of cells.
        TrustboError: simplekml is not installed; no CRS or no terrain in memory; a robot that has
            no way in a bound; a start without a time zone; or the file cannot be written.
    """
    require_simplekml()
    target = require_file(path, ".kmz")
    plan = plan_of(plan)
    require_crs(plan.workspace)
    begin, schedule = begin_of(start), schedule_of(plan)
    picture = None if cost is None else _picture(cost, plan)
    import simplekml

    def span(feature: Any, since: float, until: float) -> None:
        ends = (zulu(begin + timedelta(seconds=float(time))) for time in (since, until))
        feature.timespan.begin, feature.timespan.end = ends

    kml = simplekml.Kml(name="trustbo")
    with tempfile.TemporaryDirectory() as folder:
        # Its own mark: in the field, no server has one.
        mark = kml.addfile(_saved(_dot(), folder, "dot.png"))
        if picture is not None:
            image, box = picture
            overlay = kml.newgroundoverlay(name="cost")
            overlay.icon.href = kml.addfile(_saved(image, folder, "cost.png"))
            for side, value in zip(("west", "south", "east", "north"), box, strict=True):
                setattr(overlay.latlonbox, side, value)
        for i, (robot, stands) in enumerate(schedule.robots.items()):
            here, style = kml.newfolder(name=robot), simplekml.Style()
            style.linestyle.color = style.iconstyle.color = _hex(of_robot(i))
            style.linestyle.width, style.iconstyle.icon.href = _LINE, mark
            for k, stand in enumerate(stands):
                way = degrees_of(plan.workspace, stand.way)
                if k:
                    name = f"{robot} to {stand.name}"
                    line = here.newlinestring(name=name, coords=way.tolist(), tessellate=1)
                    line.style = style
                    span(line, stand.leaves, stand.arrives)
                place = here.newpoint(name=f"{robot} {stand.name}", coords=way[-1:].tolist())
                place.description = f"{stand.hold:.0f} s, from {stand.arrives:.0f} s on"
                place.style = style
                span(place, stand.arrives, stand.until)
        write_file(target, lambda temporary: kml.savekmz(str(temporary)))


def _dot() -> Image.Image:
    """White dot, which takes the colour of a style."""
    image = Image.new("RGBA", (_DOT, _DOT))
    ImageDraw.Draw(image).ellipse((4, 4, _DOT - 5, _DOT - 5), (255, 255, 255, 255), (0, 0, 0, 255))
    return image


def _saved(image: Image.Image, folder: str, name: str) -> str:
    file = Path(folder) / name
    image.save(file)
    return str(file)


def require_simplekml() -> None:
    """Refuse to go on without simplekml: TrustboError."""
    require_package("KMZ needs", "simplekml", "simplekml")


def _picture(cost: xr.DataArray, plan: Plan) -> tuple[Image.Image, tuple[float, ...]]:
    """Picture of a map in degrees, and its west, south, east and north."""
    workspace = plan.workspace
    placed = workspace.grid.place(require_maps(cost.rename("cost"), workspace))["cost"]
    # A grid that is square to the CRS is not square to degrees: finer pixels keep its edges.
    n = _FINE * max(placed.shape)
    fine = placed.rio.reproject("EPSG:4326", shape=(n, n), nodata=np.nan)
    values = fine.values
    colours = np.zeros((*values.shape, 4), np.uint8)
    known = np.isfinite(values)
    colours[known, :3], colours[known, 3] = of_values(values[known]), 160
    return Image.fromarray(colours), fine.rio.bounds()


def _hex(colour: Colour) -> str:
    """Colour of KML: alpha, blue, green, red."""
    return "ff{2:02x}{1:02x}{0:02x}".format(*colour)
