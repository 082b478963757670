"""Replacement of the campaign in a folder by another one, as one operation.

The new campaign is written to a folder `.trustbo-new-*` inside the campaign's folder. When it is
complete on disk, this folder is renamed to `.trustbo-next`: from then on, the new campaign is the
valid one. The files of the old campaign are then deleted, and the new ones are moved to their
places. If the process dies in between, the next process that opens the folder continues. Only files
that the old campaign lists are deleted.
"""

import json
import os
import re
import secrets
import shutil
from collections.abc import Iterable
from pathlib import Path

from trustbo.campaign.record import (
    MISSIONS,
    POSTERIORS,
    RECORD,
    mission_file,
    record_from_bytes,
)
from trustbo.errors import TrustboError
from trustbo.files import TEMPORARY, interpreting, read_file, sync_folder, to_json, write_text

_NEW = ".trustbo-new-"
_NEXT = ".trustbo-next"
_TO_DELETE = "to-delete.json"
"""File in `_NEXT` that lists the old files; it is removed when they are deleted."""
_TO_MOVE = "to-move.json"
"""File in `_NEXT` that lists the new files; it is removed when they are in place."""
_TEMPORARY = re.compile(re.escape(TEMPORARY) + r"[0-9a-f]{8}\.(nc|json)")
"""Names of the temporary files of `write_file` for the files of a campaign."""


def is_being_replaced(folder: Path) -> bool:
    """Return whether replacing the campaign in a folder is in progress or was interrupted."""
    return (folder / _NEXT / _TO_MOVE).exists()


def has_campaign(folder: Path) -> bool:
    """Return whether a folder contains a campaign."""
    return (folder / RECORD).exists() or is_being_replaced(folder)


def recorded_files(folder: Path) -> list[str]:
    """Return the paths of the files of a campaign in its folder, campaign.json last.

    Missions that are recorded but not in campaign.json yet are included.

    Raises:
        TrustboError: campaign.json cannot be read, or a file or its folder is a link, which would
            be followed.
    """
    record = record_from_bytes(read_file(folder / RECORD), folder / RECORD)
    with interpreting(folder / RECORD):
        names = [str(name) for name in record["files"]]
        n_missions = len(record["rows"])

    while (folder / mission_file(n_missions + 1)).exists():
        n_missions += 1
        names.append(mission_file(n_missions))
    names.append(RECORD)

    for name in names:
        parts = Path(name).parts
        if Path(name).is_absolute() or ".." in parts:
            raise TrustboError(f"{str(folder / RECORD)!r} lists {name!r}, which is outside of it.")
        for k in range(1, len(parts) + 1):
            link = folder.joinpath(*parts[:k])
            if link.is_symlink():
                raise TrustboError(
                    f"{str(link)!r} is a link, and the campaign is not replaced through it; give "
                    "another folder."
                )
    return names


def new_folder(folder: Path) -> Path:
    """Create an empty folder for a new campaign inside the folder of the old one."""
    path = folder / f"{_NEW}{secrets.token_hex(4)}"
    try:
        path.mkdir()
    except OSError as error:
        raise TrustboError(f"cannot create {str(path)!r}: {error.strerror}.") from error
    return path


def commit_replacement(folder: Path, new: Path, old: Iterable[str], files: Iterable[str]) -> None:
    """Make the complete campaign in the folder `new` valid instead of the one in `folder`.

    Args:
        folder: Folder of the campaign.
        new: Folder from `new_folder`, with the new campaign.
        old: Files to delete; see `recorded_files`.
        files: Files of the new campaign, without campaign.json.
    """
    # The record is kept until the end: it is replaced, not deleted.
    write_text(new / _TO_DELETE, to_json([name for name in old if name != RECORD]))
    write_text(new / _TO_MOVE, to_json([*files, RECORD]))
    try:
        os.rename(new, folder / _NEXT)
    except OSError as error:
        raise TrustboError(f"cannot replace {str(folder)!r}: {error.strerror}.") from error
    sync_folder(folder)


def finish_replacement(folder: Path) -> None:
    """Delete the files of the old campaign and move the new ones, if a replacement is unfinished.

    If this fails, it can be called again.
    """
    if not is_being_replaced(folder):
        return
    beside = folder / _NEXT

    try:
        listed = beside / _TO_DELETE
        if listed.exists():
            for name in json.loads(read_file(listed)):
                (folder / name).unlink(missing_ok=True)
            listed.unlink()
            sync_folder(beside)

        for name in json.loads(read_file(beside / _TO_MOVE)):
            if (beside / name).exists():
                (folder / name).parent.mkdir(exist_ok=True)
                os.replace(beside / name, folder / name)
                sync_folder((folder / name).parent)
        (beside / _TO_MOVE).unlink()
    except OSError as error:
        raise TrustboError(
            f"the campaign in {str(folder)!r} could not be replaced completely: {error.strerror}. "
            "Repeat the call when this is mended."
        ) from error

    remove_tree(beside)


def recover(folder: Path) -> None:
    """Finish or discard what processes left in a locked folder when they died."""
    finish_replacement(folder)
    for path in (*folder.glob(f"{_NEW}*"), folder / _NEXT):
        remove_tree(path)

    for place in (folder, folder / MISSIONS, folder / POSTERIORS):
        for path in place.glob(f"{TEMPORARY}*"):
            if _TEMPORARY.fullmatch(path.name):
                path.unlink(missing_ok=True)


def remove_tree(path: Path) -> None:
    """Delete a folder that trustbo made, as far as possible; links are not followed."""
    shutil.rmtree(path, ignore_errors=True)
