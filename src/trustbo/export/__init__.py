"""Export of results to files for GIS, robots and tables."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from trustbo.campaign.result import Result
from trustbo.errors import TrustboError, require_choice, require_list
from trustbo.export.gis import write_csv, write_geojson, write_geotiff
from trustbo.export.nav2 import Frame, write_nav2
from trustbo.files import FilePath, to_path
from trustbo.planning import Plan

WRITERS: dict[str, tuple[str, Callable[[Path, Any], None]]] = {
    "geotiff": ("maps.tif", write_geotiff),
    "geojson": ("path.geojson", write_geojson),
    "csv": ("missions.csv", write_csv),
    "nav2": ("nav2", write_nav2),
}
"""File or folder name and writing function of each format."""
_OF_PLANS = ("geojson", "nav2")
"""Formats in which a plan can be written."""
_DEFAULT = ("geotiff", "geojson")


def export_result(
    result: Result | Plan, folder: FilePath, formats: Sequence[str] | None = None
) -> list[Path]:
    """Write a result to a folder in several formats, and return the paths written.

    For a result or a campaign, geojson and nav2 contain the recommended path. To write the next
    path of a campaign, which may differ, pass `campaign.ask()`.

    Args:
        result: Result or campaign; or a plan, which has neither maps nor missions.
        folder: Folder to write to.
        formats: Formats to write, out of geotiff, geojson, csv and nav2; a plan can be written only
            as geojson and nav2. The default is geotiff and geojson, or geojson for a plan.

    Raises:
        TrustboError: A format is unknown or needs a result, or a file cannot be written.

    Example:
        >>> files = tb.export.export_result(result, "field", ["geotiff", "nav2"])
        >>> [file.name for file in files]
        ['maps.tif', 'nav2']
    """
    possible = _OF_PLANS if isinstance(result, Plan) else tuple(WRITERS)
    if formats is None:
        formats = [name for name in _DEFAULT if name in possible]
    names = [
        require_choice("format", name, WRITERS)
        for name in require_list("formats", formats, remedy=f"give some of {', '.join(WRITERS)}")
    ]

    for name in names:
        if name not in possible:
            raise TrustboError(
                f"the format {name!r} needs a result or a campaign; a plan can be written as "
                f"{' and '.join(_OF_PLANS)}."
            )

    written = []
    for name in names:
        file, write = WRITERS[name]
        target = to_path(folder) / file
        write(target, result)
        written.append(target)

    return written


__all__ = [
    "Frame", "export_result", "write_csv", "write_geojson", "write_geotiff", "write_nav2",
]  # fmt: skip
__dir__ = __all__.copy  # tab completion lists only public names
