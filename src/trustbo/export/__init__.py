"""Results as files for other programs: GIS, robots, tables."""

from collections.abc import Callable, Sequence
from pathlib import Path

from trustbo.campaign.result import Result
from trustbo.errors import require_choice
from trustbo.export.gis import write_csv, write_geojson, write_geotiff
from trustbo.export.nav2 import Frame, write_nav2
from trustbo.files import FilePath, require_folder

WRITERS: dict[str, Callable[[Path, Result], None]] = {
    "geotiff": write_geotiff,
    "geojson": write_geojson,
    "csv": write_csv,
    "nav2": write_nav2,
}
"""Writers of a result to a path, by format."""
_FILES = {"geotiff": "maps.tif", "geojson": "path.geojson", "csv": "missions.csv", "nav2": "nav2"}
"""Names of what `export_result` writes to a folder, by format."""


def export_result(
    result: Result, folder: FilePath, formats: Sequence[str] = ("geotiff", "geojson")
) -> list[Path]:
    """Write a result to a folder in several formats, keys of `WRITERS`; return what was written."""
    target = require_folder(folder)
    chosen = [require_choice("format", name, WRITERS) for name in formats]
    for name in chosen:
        WRITERS[name](target / _FILES[name], result)
    return [target / _FILES[name] for name in chosen]


__all__ = [
    "WRITERS", "Frame", "export_result", "write_csv", "write_geojson", "write_geotiff",
    "write_nav2",
]  # fmt: skip
__dir__ = __all__.copy  # completion lists public names alone
