"""Overwatch maps of a path's bounds as the bands of a GeoTIFF."""

from itertools import pairwise
from typing import Any

import numpy as np
import rasterio
from rasterio.transform import from_origin

from trustbo.data import path_text
from trustbo.errors import TrustboError
from trustbo.export.checks import require_crs
from trustbo.files import FilePath, require_file, write_file
from trustbo.planning import Plan
from trustbo.workspace import Workspace


def write_overwatch(path: FilePath, plan: Plan, *, robot: str | None = None) -> None:
    """Write how much of each bound one would see from each point, a band for each bound.

    Bands are float32, named after their bounds, at the points of `Workspace.overwatch_map`; NaN,
    the nodata value, is where robots cannot stand, and far from the bound.

    Args:
        path: .tif or .tiff file to write, or to replace.
        plan: Plan on a terrain in memory.
        robot: Name of the robot that watches; by default the first of the team.

    Raises:
        TrustboError: The workspace has no terrain in memory or no assumed sight, an unknown robot,
            or the file cannot be written.
    """
    workspace = plan.workspace
    crs, target = require_crs(workspace), require_file(path, ".tif", ".tiff")
    require_overwatch(workspace)
    maps = [workspace.overwatch_map(bound, robot=robot) for bound in pairwise(plan.path)]
    known = [one for one in maps if one is not None]
    step = [abs(float(known[0][axis][1] - known[0][axis][0])) for axis in ("y", "x")]
    top, left = max(float(m["y"].max()) for m in known), min(float(m["x"].min()) for m in known)
    bottom = min(float(m["y"].min()) for m in known)
    right = max(float(m["x"].max()) for m in known)
    y = np.arange(top, bottom - 0.5 * step[0], -step[0])
    x = np.arange(left, right + 0.5 * step[1], step[1])
    layout: dict[str, Any] = {"driver": "GTiff", "interleave": "band", "compress": "deflate"}

    def write(file: Any) -> None:
        with rasterio.open(
            file, "w", **layout, height=len(y), width=len(x), count=len(known), dtype="float32",
            nodata=np.nan, crs=crs,
            transform=from_origin(left - 0.5 * step[1], top + 0.5 * step[0], step[1], step[0]),
        ) as raster:  # fmt: skip
            for k, (bound, seen) in enumerate(zip(pairwise(plan.path), known, strict=True), 1):
                same = {"method": "nearest", "tolerance": 0.1 * min(step)}  # of one lattice
                band = seen.drop_vars("spatial_ref", errors="ignore").reindex(y=y, x=x, **same)
                raster.write(band.values.astype(np.float32), k)
                raster.set_band_description(k, f"bound {k}: {path_text(bound)}")
                raster.update_tags(k, long_name=str(seen.attrs["long_name"]))

    write_file(target, write)


def require_overwatch(workspace: Workspace) -> None:
    """Refuse a workspace without what overwatch maps are computed from: TrustboError."""
    if workspace.watch is None:
        raise TrustboError(
            "overwatch maps need a terrain in memory and an assumed sight; make the workspace with "
            "Workspace.from_terrain."
        )
