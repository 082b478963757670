"""Replacement of the campaign in a folder by another one, as one operation.

The new campaign is written to a folder `.trustbo-new-*` inside the campaign's folder. When it is
complete on disk, this folder is renamed to `.trustbo-next`: from then on, the new campaign is the
valid one. The files of the old campaign are then deleted, and the new ones are moved to their
places, campaign.json last. If the process dies in between, the next process that opens the folder
continues. Only files that the old campaign lists are deleted.
"""

import os
import re
import shutil
import tempfile
from pathlib import Path

from trustbo.campaign.record import MISSIONS, POSTERIORS, RECORD, mission_file, read_record
from trustbo.errors import TrustboError
from trustbo.files import TEMPORARY, sync_folder

_NEW = ".trustbo-new-"
_NEXT = ".trustbo-next"
_TEMPORARY = re.compile(re.escape(TEMPORARY) + r"[0-9a-f]{8}\.(nc|json)")
"""Names of the temporary files of `write_file` for the files of a campaign."""


def is_being_replaced(folder: Path) -> bool:
    """Return whether replacing the campaign in a folder is in progress or was interrupted."""
    return (folder / _NEXT / RECORD).exists()


def has_campaign(folder: Path) -> bool:
    """Return whether a folder contains a campaign."""
    return (folder / RECORD).exists() or is_being_replaced(folder)


def recorded_files(folder: Path) -> dict[str, str]:
    """Return the hash of each file of a campaign by its path in the folder; {} without campaign.

    A mission that was written, but not recorded, before a process died is included.

    Raises:
        TrustboError: campaign.json cannot be read, or a file or its folder is a link, which would
            be followed.
    """
    if not (folder / RECORD).exists():
        return {}
    record = read_record(folder / RECORD)
    files = {**record["files"], mission_file(len(record["exclusions"]) + 1): ""}

    for name in files:
        path = folder / name
        if folder not in path.parents or ".." in path.parts:
            raise TrustboError(f"{str(folder / RECORD)!r} lists {name!r}, which is outside of it.")
        for link in (path, path.parent):
            if link != folder and link.is_symlink():
                raise TrustboError(
                    f"{str(link)!r} is a link, and the campaign is not replaced through it; give "
                    "another folder."
                )
    return files


def new_folder(folder: Path) -> Path:
    """Create an empty folder for a new campaign inside the folder of the old one."""
    try:
        return Path(tempfile.mkdtemp(prefix=_NEW, dir=folder))
    except OSError as error:
        raise TrustboError(f"cannot write in {str(folder)!r}: {error.strerror}.") from error


def put_in_place(folder: Path, new: Path) -> None:
    """Make the complete campaign in the folder `new` valid instead of the one in `folder`."""
    try:
        os.rename(new, folder / _NEXT)
    except OSError as error:
        raise TrustboError(f"cannot replace {str(folder)!r}: {error.strerror}.") from error
    sync_folder(folder)
    _finish(folder)


def _finish(folder: Path) -> None:
    """Delete the files of the old campaign and move the new ones.

    If this fails, it can be called again: the record of the old campaign is replaced last.
    """
    beside = folder / _NEXT
    new = [*read_record(beside / RECORD)["files"], RECORD]
    try:
        for name in recorded_files(folder).keys() - new:
            (folder / name).unlink(missing_ok=True)

        for name in new:
            if (beside / name).exists():
                (folder / name).parent.mkdir(exist_ok=True)
                os.replace(beside / name, folder / name)
                sync_folder((folder / name).parent)
    except OSError as error:
        raise TrustboError(
            f"the campaign in {str(folder)!r} could not be replaced completely: {error.strerror}. "
            "Repeat the call when this is mended."
        ) from error
    remove_tree(beside)


def recover(folder: Path) -> None:
    """Finish or discard what processes left in a locked folder when they died."""
    if is_being_replaced(folder):
        _finish(folder)
    discard(folder)

    for place in (folder, folder / MISSIONS, folder / POSTERIORS):
        for path in place.glob(f"{TEMPORARY}*"):
            if _TEMPORARY.fullmatch(path.name):
                path.unlink(missing_ok=True)


def discard(folder: Path) -> None:
    """Delete the folders of new campaigns that are not in place."""
    for path in (*folder.glob(f"{_NEW}*"), folder / _NEXT):
        remove_tree(path)


def remove_tree(path: Path) -> None:
    """Delete a folder that trustbo made, as far as possible; links are not followed."""
    shutil.rmtree(path, ignore_errors=True)
