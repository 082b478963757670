"""`trustbo export`: a result as files for other programs."""

import sys
from math import radians
from pathlib import Path

from trustbo.cli.errors import in_flags
from trustbo.errors import TrustboError, require_choice


def export(
    folder: Path,
    formats: list[str],
    out: Path | None = None,
    resolution: float | None = None,
    origin: str = "auto",
    rotation: float = 0.0,
    frame: str = "map",
) -> None:
    """Write a result's maps and path for GIS and robots.

    Example: trustbo export out/demo --format geotiff --format geojson
    All formats: trustbo export out/demo --format all --out for-the-field
    For robots: trustbo export out/demo --format nav2 --format ros_map --out robots

    With all, formats that cannot be written (a place on Earth without a terrain) are
    left out, each with a line that gives the reason; a format asked for by name is an
    error then.
    """
    _require_result(folder)
    from trustbo.campaign.storage import load_result
    from trustbo.export import FORMATS, Frame, export_result
    from trustbo.export.everything import left_out

    for name in formats:
        require_choice("format", name, (*FORMATS, "all"))
    result, target = load_result(folder), out or folder
    place = Frame(origin, radians(rotation), frame)
    chosen, absent = formats, {}
    if "all" in formats:
        reasons = left_out(result, target, frame=place)
        absent = {name: why for name, why in reasons.items() if name not in formats}
        chosen = [name for name in FORMATS if name not in absent]
    files = export_result(result, target, chosen, resolution=resolution, frame=place)
    for name, why in absent.items():
        print(f"left out {name}: {in_flags(why)}", file=sys.stderr)
    for file in files:
        print(file)


def _require_result(folder: Path) -> None:
    """Refuse a folder without a result (TrustboError) before heavy imports."""
    from trustbo.campaign.folder import RESULT

    if not (folder / RESULT).exists():
        raise TrustboError(
            f"{str(folder)!r} holds no result; give the --out of trustbo run or trustbo demo, once "
            "a mission is done."
        )
