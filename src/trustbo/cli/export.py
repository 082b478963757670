"""`trustbo export`: a result as files for other programs."""

from trustbo.cli import options
from trustbo.cli.errors import one_line_errors
from trustbo.errors import require_choice


def export(
    folder: options.Folder,
    formats: options.Formats,
    out: options.OutFolder = None,
    resolution: options.ExportResolution = None,
    debug: options.Debug = False,
) -> None:
    """Write a result's maps and path for GIS, GPS units and robots.

    Example: trustbo export out/demo --format geotiff --format gpx
    Everything there is: trustbo export out/demo --format all --out for-the-field
    """
    with one_line_errors(debug):
        from trustbo.export import FORMATS, export_result

        for name in formats:
            require_choice("format", name, (*FORMATS, "all"))
        chosen = tuple(FORMATS) if "all" in formats else tuple(dict.fromkeys(formats))
        from trustbo.result import load_result

        result = load_result(folder)
        for file in export_result(result, out or folder, chosen, resolution=resolution):
            print(file)
