"""Export of results to files for GIS, robots and tables."""

from collections.abc import Callable, Sequence
from pathlib import Path

from trustbo.campaign.result import Result
from trustbo.errors import require_choice, require_list
from trustbo.export.gis import write_csv, write_geojson, write_geotiff
from trustbo.export.nav2 import Frame, write_nav2
from trustbo.files import FilePath, to_path

WRITERS: dict[str, tuple[str, Callable[[Path, Result], None]]] = {
    "geotiff": ("maps.tif", write_geotiff),
    "geojson": ("path.geojson", write_geojson),
    "csv": ("missions.csv", write_csv),
    "nav2": ("nav2", write_nav2),
}
"""File or folder name and writing function of each format."""


def export_result(
    result: Result, folder: FilePath, formats: Sequence[str] = ("geotiff", "geojson")
) -> list[Path]:
    """Write a result to a folder in several formats, and return the paths written.

    The formats are geotiff, geojson, csv and nav2. Raises TrustboError if a format is unknown, or a
    file cannot be written.

    Example:
        >>> files = tb.export.export_result(result, "field", ["geotiff", "nav2"])
        >>> [file.name for file in files]
        ['maps.tif', 'nav2']
    """
    names = [
        require_choice("format", name, WRITERS)
        for name in require_list("formats", formats, remedy=f"give some of {', '.join(WRITERS)}")
    ]

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
