"""Folders of campaigns and results: names of files, and atomic replacement of all of them.

A campaign or result that replaces another is first written whole to a hidden folder within its
folder. One renaming makes that the successor, which is read from then on; then its files get their
names in the folder, and the hidden folder goes. Wherever a process dies, a reader finds the one
before or the successor, whole.
"""

import os
import re
import secrets
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from trustbo.errors import DamagedFileError, TrustboError
from trustbo.files import (
    FilePath,
    defer_interrupt,
    folder_to_disk,
    naming_refusal,
    not_ours,
    read_record,
    remove_leftovers,
    require_folder,
    sum_file,
    temporary_name,
)

STATE, RESULT, WORKSPACE, MEASURED = "campaign.json", "result.json", "workspace.nc", "measured.nc"
MISSIONS, HISTORY, TABLE = "missions.nc", "history.nc", "history.csv"
BELIEVED, POSTERIOR = "believed.nc", "posterior.nc"
_NAMES = (MISSIONS, HISTORY, TABLE, BELIEVED, POSTERIOR, MEASURED, WORKSPACE, RESULT, STATE)
"""Names of our files, the records last: what they describe is removed before them."""
POSTERIORS, TICKS = _FOLDERS = ("posteriors", "ticks")
"""Folders of numbered files."""
_NEXT, _NEW, _OLD = ".trustbo-next", ".trustbo-new-", ".trustbo-old-"
_MARKED = re.compile(r"\.trustbo-(new|old)-\w+")
_INPUTS = ("dem.tif", "dsm.tif")
"""Rasters that users put in the folder of a campaign."""


def current(folder: Path) -> Path:
    """Return the folder to read: the successor in it, if there is a whole one, or itself."""
    successor = folder / _NEXT
    return successor if successor.is_dir() and not successor.is_symlink() else folder


def hold(directory: FilePath, remedy: str = "") -> FileLock:
    """Lock a folder, made if need be, and complete or remove interrupted writes.

    TrustboError: another process has locked it.
    """
    folder = require_folder(directory)
    lock = FileLock(folder / ".trustbo.lock", timeout=0)
    with naming_refusal(folder, remedy=remedy):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire()
        except Timeout:
            raise TrustboError(
                f"another campaign is at work in {str(folder)!r}; close it first, or choose "
                "another folder."
            ) from None
        try:
            for room in (folder, *(folder / name for name in _FOLDERS)):
                remove_leftovers(room)
            for left in [f for f in folder.iterdir() if _MARKED.fullmatch(f.name)]:
                _clear(left)
            _put_in_place(folder)
        except BaseException:
            lock.release()
            raise
    return lock


@contextmanager
def replacing(folder: Path) -> Iterator[Path]:
    """Give a new folder to write a campaign or result to, which then replaces that in `folder`.

    `folder` must be locked. It is unchanged if writing fails.
    """
    require_ours(folder)
    with naming_refusal(folder):
        new = Path(tempfile.mkdtemp(prefix=_NEW, dir=folder))
    try:
        yield new
        folder_to_disk(new)
    except BaseException:
        _clear(new)
        raise
    # Ctrl-C waits: a process that went on would write beside a successor that is read.
    with defer_interrupt(), naming_refusal(folder):
        os.rename(new, folder / _NEXT)
        folder_to_disk(folder)
        _put_in_place(folder)


def finish_replacing(folder: Path) -> None:
    """Complete an interrupted replacement, before more is written to a folder."""
    if current(folder) != folder:
        with defer_interrupt(), naming_refusal(folder):
            _put_in_place(folder)


def require_ours(folder: Path, *others: str) -> None:
    """Refuse a folder in which a file of another program has the name of one of ours.

    `others` are names of more files to be written. A link in place of a folder of ours is refused
    too.
    """
    if not folder.is_dir():
        return
    for room in _FOLDERS:
        if (folder / room).is_symlink():
            raise TrustboError(
                f"{str(folder / room)!r} is a link; files are replaced there that may be of "
                "another campaign. Make it a folder, or choose another folder for the campaign."
            )
    written = own_files(folder)
    more = [] if _is_ours(folder) else [folder / name for name in others]
    for file in (*_files(folder), *more):
        if os.path.lexists(file) and file not in written:
            raise not_ours(file)


def warn_of_others(folder: Path) -> None:
    """Warn of other files in a folder that held no campaign or result before."""
    if not folder.is_dir() or _is_ours(folder):
        return
    ours = {f.relative_to(folder).parts[0] for f in own_files(folder)} | set(_INPUTS)
    names = sorted(f.name for f in folder.iterdir())
    names = [name for name in names if name not in ours and not name.startswith(".")]
    if names:
        listed = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
        warnings.warn(
            f"{str(folder)!r} holds other files too ({listed}); they are left as they are.",
            stacklevel=2,
        )


def own_files(folder: Path) -> list[Path]:
    """Files of a campaign or result in a folder that this library wrote, its records last.

    Our names in a folder of ours; numbered ones if they have a sum, or a record counts them.
    """
    ours, counted = _is_ours(folder), _counted(folder)

    def is_ours(file: Path) -> bool:
        if file.parent == folder:
            return ours
        return sum_file(file).is_file() or (file.parent.name, file.name) in counted

    return [file for file in _files(folder) if file.is_file() and is_ours(file)]


def _files(folder: Path) -> list[Path]:
    """Names of ours in a folder, numbered ones that are there and others that may be."""
    numbered = []
    for room in (folder / name for name in _FOLDERS):
        if room.is_dir() and not room.is_symlink():
            numbered += [f for f in sorted(room.iterdir()) if re.fullmatch(r"\d{4,}\.nc", f.name)]
    return [*numbered, *(folder / name for name in _NAMES)]


def _is_ours(folder: Path) -> bool:
    """Whether a folder holds a campaign or result, be it damaged, or one whose writing died."""
    names = (folder / name for name in (STATE, RESULT, WORKSPACE, MEASURED))
    return any(f.is_file() and sum_file(f).is_file() for f in names) or bool(_records(folder))


def _records(folder: Path) -> list[dict[str, Any]]:
    """Records in a folder that can be read, of a campaign or a result."""
    records = []
    for name in (STATE, RESULT):
        with suppress(DamagedFileError):
            record = read_record(folder / name)
            if isinstance(record, dict) and {"n_missions", "stop_reason"} <= record.keys():
                records.append(record)
    return records


def _counted(folder: Path) -> set[tuple[str, str]]:
    """Folder and file name of the posteriors that the records of a folder count."""
    files = set()
    for record in _records(folder):
        with suppress(TypeError):  # of a damaged record
            numbers = [n for n in record.get("posterior_after", ()) if isinstance(n, int)]
            files |= {(POSTERIORS, f"{after:04d}.nc") for after in numbers}
    return files


def _put_in_place(folder: Path) -> None:
    """Move the files of a successor to the folder; also after an interruption."""
    successor = current(folder)
    if successor == folder:
        return
    written = [f for ours in own_files(successor) for f in (ours, sum_file(ours)) if f.is_file()]
    files = [file.relative_to(successor) for file in written]
    for file in own_files(folder):
        if file.relative_to(folder) not in files:
            file.unlink(missing_ok=True)
            sum_file(file).unlink(missing_ok=True)
    for name in files:
        _link(successor / name, folder / name)
    folder_to_disk(folder)
    # It is read no longer once it has another name.
    old = folder / f"{_OLD}{secrets.token_hex(4)}"
    os.rename(successor, old)
    folder_to_disk(folder)
    _clear(old)


def _link(source: Path, target: Path) -> None:
    """Give a file another name, replacing a file of that name; copy it if links are refused."""
    if os.path.lexists(target) and os.path.samestat(source.lstat(), target.lstat()):
        return
    target.parent.mkdir(exist_ok=True)
    temporary = temporary_name(target)
    temporary.unlink(missing_ok=True)
    try:
        os.link(source, temporary)
    except OSError:
        shutil.copyfile(source, temporary)
    os.replace(temporary, target)


def _clear(folder: Path) -> None:
    """Remove our files from a hidden folder of ours, and the folder if it is empty then."""
    if folder.is_symlink() or not folder.is_dir():
        return
    for room in (*(folder / name for name in _FOLDERS), folder):
        if room.is_symlink() or not room.is_dir():
            continue
        remove_leftovers(room)
        ours = {f for file in _files(folder) for f in (file, sum_file(file)) if f.parent == room}
        ours |= {f for f in room.glob(".*.sha256") if re.fullmatch(r"\.\d+\.nc\.sha256", f.name)}
        for file in ours:
            file.unlink(missing_ok=True)
        with suppress(OSError):  # not empty
            room.rmdir()
