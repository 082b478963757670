"""Damaged files of a campaign: what is wrong, and what can still be read."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from trustbo.errors import DamagedFileError
from trustbo.files import read_checked

MEASURED, FILLED = "measured.nc", "missions.nc"
_TELL = "tell them, in order, to a new campaign in another folder, with other_path=True"


def read_json(file: Path, *fields: str) -> dict[str, Any]:
    """Read a record with these fields.

    Raises:
        DamagedFileError: The file is missing or damaged, or a field is.
    """
    content = read_checked(file)
    try:
        record = json.loads(content)
        missing = [name for name in fields if name not in record]
    except (ValueError, TypeError) as error:
        raise DamagedFileError(f"{str(file)!r} is damaged: no JSON ({error}).") from None
    if missing:
        raise DamagedFileError(f"{str(file)!r} is damaged: it lacks {', '.join(missing)}.")
    return record


@contextmanager
def naming_what_is_left(folder: Path) -> Iterator[None]:
    """Add to the error of a damaged file that the missions as told can be read, if they can."""
    try:
        yield
    except DamagedFileError as error:
        for name, described in ((MEASURED, salvage), (FILLED, _salvage_filled)):
            if str(folder / name) not in str(error) and (folder / name).exists():
                raise DamagedFileError(f"{error} {described(folder / name)}") from None
        raise


def salvage(measured: Path) -> str:
    """Describe the way on where only the missions as told can be read."""
    return (
        "All missions as they were told can be read: trustbo.logs.read_missions("
        f"{str(measured)!r}); {_TELL}."
    )


def _salvage_filled(missions: Path) -> str:
    """Describe the way on where only the missions with awareness filled in can be read."""
    return (
        f"The missions can be read: trustbo.logs.read_missions({str(missions)!r}); {_TELL}. They "
        "are not quite as they were told: awareness that was not measured is filled in there from "
        "the map or the belief. A campaign with awareness='belief' would take it for measured, and "
        "be too sure of its map; with awareness='map' nothing changes."
    )
