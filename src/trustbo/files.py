"""Atomic writing of files, and errors for files that cannot be read or written."""

import hashlib
import json
import os
import re
import secrets
import signal
import stat
import threading
import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, is_dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from trustbo.errors import TrustboError

FilePath = str | PathLike[str]
TEMPORARY = ".tmp-"
"""Beginning of the names of temporary files."""
_SIDE_FILES = (
    ".aux.xml", ".ovr", ".ovr.aux.xml", ".msk", ".msk.aux.xml", ".msk.ovr", ".msk.ovr.aux.xml",
    ".vat.dbf", ".vat.cpg",
)  # fmt: skip
"""What GDAL and GIS append to the name of a raster to store its statistics, overviews and mask."""


_NAME = re.compile(r"[A-Za-z0-9_\x80-\U0010ffff]([^\x00-\x1f/\x7f]*[^\x00-\x20/\x7f])?")
"""Names of variables and dims that netCDF accepts."""
_LONGEST_NAME = 120
"""Largest number of bytes of a name. NetCDF reads 255, and dims may be made of two names."""


def is_storable(name: str) -> bool:
    """Return whether a variable or dim of a netCDF file can have a name, and keeps it.

    NetCDF changes names that are not in the normal form NFC of Unicode.
    """
    try:
        n_bytes = len(name.encode())
    except UnicodeEncodeError:
        return False
    is_kept = unicodedata.is_normalized("NFC", name)
    return is_kept and n_bytes <= _LONGEST_NAME and _NAME.fullmatch(name) is not None


def to_path(path: FilePath) -> Path:
    """Return a path with `~` expanded.

    Raises:
        TrustboError: The path is not text or a path object, it is empty, or no file can have it.
    """
    text = os.fspath(path) if isinstance(path, str | PathLike) else None
    if not isinstance(text, str):
        raise TrustboError(f"a path must be a text or a pathlib.Path; got {path!r:.60}.")
    if not text or "\0" in text:
        raise TrustboError(f"{text!r:.60} is not a path; give the path of a file or folder.")

    try:
        os.fsencode(text)
        return Path(text).expanduser()
    except UnicodeEncodeError:
        raise TrustboError(f"{text!r:.60} is not a valid path on this system.") from None
    except RuntimeError:
        raise TrustboError(f"{text!r:.60}: the home folder of '~' is unknown.") from None


def write_file(path: FilePath, content: bytes, *, is_raster: bool = False) -> None:
    """Write a whole file or nothing.

    The content is made in memory first: libraries that write to a path may hide that a disk is
    full.

    The file is written under an unused temporary name in its folder, which is created if it does
    not exist, flushed to disk and renamed. If anything fails, the temporary file is removed and an
    existing file is unchanged. A link is followed, and an existing file keeps its permissions.

    Side files of a raster go before the new raster comes: if writing stops in between, the old
    raster without its statistics is left, not the new one with those of the old one.

    Args:
        path: File to write; `~` is the home folder.
        content: Content of the file.
        is_raster: Whether the file is a raster, whose old side files are removed, as GDAL does.

    Raises:
        TrustboError: The file cannot be written.
    """
    given = to_path(path)
    try:
        target = Path(os.path.realpath(given))
        if target.exists() and not target.is_file():
            raise TrustboError(f"cannot write {str(given)!r}: it is not a file.")
        target.parent.mkdir(parents=True, exist_ok=True)
        rasters = {given, target} if is_raster else set()  # GIS look beside a link, too
        side_files = [Path(f"{raster}{ending}") for raster in rasters for ending in _SIDE_FILES]
        _replace(target, content, side_files)
    except OSError as error:
        raise TrustboError(f"cannot write {str(given)!r}: {error.strerror or error}.") from error


def _replace(target: Path, content: bytes, side_files: Iterable[Path]) -> None:
    """Write a temporary file, remove the side files, and rename the file to the target."""
    temporary = target.with_name(f"{TEMPORARY}{secrets.token_hex(4)}{target.suffix}")
    # Unlike the modules of `tempfile`, this respects the umask.
    descriptor = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
    try:
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(content)

        with temporary.open("rb+") as stream:
            os.fsync(stream.fileno())

        with suppress(OSError):
            temporary.chmod(stat.S_IMODE(target.stat().st_mode))
        for file in side_files:
            file.unlink(missing_ok=True)
        os.replace(temporary, target)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise

    # The file is in place: from here on, nothing may fail.
    sync_folder(target.parent)


def sync_folder(folder: Path) -> None:
    """Flush the names in a folder to disk, so that renamed files survive a loss of power.

    Errors are ignored, as in SQLite: the files are already in place, and not every file system can
    flush a folder.
    """
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def holding_interrupts() -> Iterator[None]:
    """Hold back Ctrl-C until the block ends, so that memory and disk agree.

    Use it for short blocks. Python interrupts the main thread only, so other threads need nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    usual = signal.getsignal(signal.SIGINT)
    if not callable(usual):  # ignored, or handled outside of Python
        yield
        return

    received: list[tuple[Any, ...]] = []
    signal.signal(signal.SIGINT, lambda *args: received.append(args))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)
        if received:
            usual(*received[0])


def read_file(path: FilePath, sha256: str = "") -> bytes:
    """Read a whole file.

    Raises:
        TrustboError: The file is missing or cannot be read, or `sha256` is given and is not the
            hash of its content.
    """
    given = to_path(path)
    try:
        content = given.read_bytes()
    except OSError as error:
        raise TrustboError(f"{str(given)!r} cannot be read: {error.strerror}.") from None

    if sha256 and hash_of(content) != sha256:
        raise TrustboError(
            f"{str(given)!r} is damaged or was replaced: its content is not the recorded one. "
            "Restore the file from a copy."
        )
    return content


def hash_of(content: bytes) -> str:
    """Return the SHA-256 hash of a file's content."""
    return hashlib.sha256(content).hexdigest()


@contextmanager
def interpreting(path: FilePath) -> Iterator[None]:
    """Convert errors caused by unexpected file contents to a TrustboError.

    An error that is already a TrustboError is raised unchanged.
    """
    try:
        yield
    except TrustboError:
        raise
    except Exception as error:  # there are many kinds
        message = " ".join(str(error).split())[:200]
        raise TrustboError(
            f"{str(path)!r} is damaged or has unexpected contents ({message})."
        ) from error


def write_text(path: FilePath, text: str) -> None:
    """Write a text file atomically; see `write_file`."""
    write_file(path, text.encode())


def to_json(record: object) -> str:
    """Convert a record to JSON; NumPy values become numbers or lists, and others text."""

    def plain(value: Any) -> object:
        if isinstance(value, np.ndarray | np.generic):
            return value.tolist()
        if is_dataclass(value) and not isinstance(value, type):
            return {"type": type(value).__name__, **asdict(value)}
        if type(value).__str__ is object.__str__ and type(value).__repr__ is object.__repr__:
            return type(value).__name__  # otherwise, the text would be an address
        return str(value)

    return json.dumps(record, default=plain)


def to_plain(what: str, value: Any) -> Any:
    """Return a value as it would be read back from JSON, with arrays as lists.

    Raises:
        TrustboError: JSON cannot store the value, or changes it.
    """

    def plain(part: Any) -> object:
        if isinstance(part, str | None | bool | int | float):
            return part
        if isinstance(part, list | tuple):
            return [plain(p) for p in part]
        if isinstance(part, dict) and all(isinstance(name, str) for name in part):
            return {name: plain(p) for name, p in part.items()}
        if hasattr(part, "__array__") and np.asarray(part).dtype.kind in "biuf":
            return np.asarray(part).tolist()
        raise TrustboError(
            f"{what}: {part!r:.60} cannot be stored in the folder of a campaign; give numbers, "
            "texts, lists or arrays."
        )

    return plain(value)
