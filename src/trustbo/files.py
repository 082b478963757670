"""Atomic writes, and errors for files that cannot be written or read."""

import errno
import json
import os
import re
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, is_dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from trustbo.errors import DamagedFileError, TrustboError

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_REFUSED = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOENT, errno.ENOTDIR, errno.ELOOP)
_LEAST_FREE = 1 << 20
"""Free bytes below which a failed write is blamed on the disk: libraries give no reason."""

FilePath = str | PathLike[str]


def write_file(path: FilePath, write: Callable[[Path], object]) -> None:
    """Write a file atomically: `write` gets a temporary name of the same suffix, then renamed.

    Ctrl-C and SIGTERM take effect after the write, a second one at once. A link of that name is
    replaced by the file, its target is unchanged.

    Args:
        path: File to write; its folder is made if it does not exist.
        write: Function that writes to a given path of the same suffix.

    Raises:
        TrustboError: The disk is full, or the folder may not be written to; a file of that name is
            unchanged.
    """
    path = Path(path)
    with naming_refusal(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_name(path)
    try:
        with defer_interrupt():
            temporary.unlink(missing_ok=True)  # not to write through a link of that name
            write(temporary)
            _to_disk(temporary)
            os.replace(temporary, path)
            _folder_to_disk(path.parent)
    except Exception as error:
        full = isinstance(error, OSError) and error.errno in _FULL
        disk = shutil.disk_usage(path.parent)
        if full or (disk.free < _LEAST_FREE and disk.total > 0):  # /proc reports no free bytes
            raise TrustboError(
                f"the disk is full: {str(path)!r} was not written. What was there before is as it "
                "was; make room and go on, or run the same again."
            ) from error
        with naming_refusal(path.parent, temporary):
            raise
    finally:
        temporary.unlink(missing_ok=True)


def temporary_name(path: Path) -> Path:
    """Temporary name in the folder of a file, with a mark that no other program uses.

    The suffix is the file's: libraries choose a format by it.
    """
    return path.with_name(f".{path.stem}.trustbo-{os.getpid()}{path.suffix}")


def _to_disk(file: Path) -> None:
    """Flush a file's bytes to disk before it is renamed."""
    with file.open("rb+") as stream:
        os.fsync(stream.fileno())


def _folder_to_disk(folder: Path) -> None:
    """Flush a folder's entries to disk, where the system supports it."""
    with suppress(OSError):  # folders cannot be opened everywhere
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


@contextmanager
def naming_refusal(folder: Path, file: Path | None = None) -> Iterator[None]:
    """Convert the system's refusal to write to a folder to a TrustboError with the remedy.

    With `file`, only refusals of that file: others may be read meanwhile.
    """
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            raise TrustboError(
                f"the disk is full: nothing was written to {str(folder)!r}; make room and go on."
            ) from error
        of_others = file is not None and error.filename not in (str(file), file)
        if error.errno not in _REFUSED or of_others:
            raise
        raise TrustboError(
            f"cannot write to {str(folder)!r}: {error.strerror}; give a folder that may be "
            "written to."
        ) from error


@contextmanager
def defer_interrupt() -> Iterator[None]:
    """Defer the first Ctrl-C or SIGTERM: it can leave the netCDF library locked for ever."""
    handlers = {int(n): signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}
    before = {n: then for n, then in handlers.items() if callable(then)}  # others raise nothing
    if threading.current_thread() is not threading.main_thread():
        yield  # Python delivers signals to the main thread
        return
    seen: list[int] = []

    def count(number, frame) -> None:
        seen.append(number)
        if len(seen) > 1:
            before[number](number, frame)

    for number in before:
        signal.signal(number, count)
    try:
        yield
    finally:
        for number, then in before.items():
            signal.signal(number, then)
        if len(seen) == 1:
            before[seen[0]](seen[0], None)


def read_file(path: FilePath) -> bytes:
    """Read a file whole; DamagedFileError if it is missing or cannot be read."""
    path = as_path(path)
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise DamagedFileError(f"{str(path)!r} is missing.") from None
    except OSError as error:
        raise DamagedFileError(f"{str(path)!r} cannot be read: {error.strerror}.") from None


def read_record(path: FilePath) -> dict[str, Any]:
    """Read a JSON file of fields by name.

    Raises:
        DamagedFileError: The file is missing, damaged, no JSON, or holds no fields.
    """
    content = read_file(path)
    try:
        record = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise DamagedFileError(f"{str(path)!r} is damaged: no JSON ({error}).") from None
    if not isinstance(record, dict):
        raise DamagedFileError(f"{str(path)!r} is damaged: no record of fields.")
    return record


@contextmanager
def interpreting(path: FilePath) -> Iterator[None]:
    """Convert errors from unexpected contents of a file to a DamagedFileError.

    A TrustboError passes unchanged.
    """
    try:
        yield
    except TrustboError:
        raise
    except (
        ArithmeticError, AttributeError, LookupError, MemoryError, RecursionError, TypeError,
        ValueError,
    ) as error:  # fmt: skip
        message = " ".join(str(error).split())[:200]
        raise DamagedFileError(
            f"{str(path)!r} is damaged: it does not hold what it should ({message})."
        ) from error


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files of a dead process; no other process may write there.

    Those in the folder itself, by the mark of `temporary_name`; never through a link.
    """
    if folder.is_symlink() or not folder.is_dir():
        return
    for file in folder.iterdir():
        ours = re.fullmatch(r"\..+\.trustbo-\d+(\.[^.]*)?", file.name)
        if ours and file.is_file() and not file.is_symlink():
            file.unlink(missing_ok=True)


def write_text(path: FilePath, text: str) -> None:
    """Write a text file atomically."""
    write_file(path, lambda file: file.write_text(text, encoding="utf-8"))


def to_json(record: object) -> str:
    """Return the JSON of a record; NumPy numbers and arrays as lists, other objects as text."""

    def plain(value: Any) -> object:
        if isinstance(value, np.ndarray | np.generic):
            return value.tolist()
        if is_dataclass(value) and not isinstance(value, type):
            return {"type": type(value).__name__, **asdict(value)}
        if type(value).__str__ is object.__str__ and type(value).__repr__ is object.__repr__:
            return type(value).__name__  # else it would be an address
        return str(value)

    return json.dumps(record, default=plain)


def cache_folder(name: str) -> Path:
    """Folder of that name in the user's cache, `$XDG_CACHE_HOME/trustbo`; it need not exist."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home) / "trustbo" / name


def require_folder(directory: FilePath) -> Path:
    """Return a folder, which need not exist; TrustboError if it or a parent is a file."""
    folder = as_path(directory)
    for part in (folder, *folder.parents):
        if part.exists():
            if not part.is_dir():
                raise TrustboError(f"cannot write to {str(folder)!r}: {str(part)!r} is a file.")
            break
    return folder


def require_file(path: FilePath, *suffixes: str) -> Path:
    """Return a file to write, which may exist already.

    `suffixes` are in lower case with the dot; none allow any. TrustboError: another suffix, a
    folder of that name, or a file of that of its folder.
    """
    file = as_path(path)
    if file.is_dir():
        raise TrustboError(f"cannot write {str(file)!r}: it is a folder; name a file in it.")
    if suffixes and file.suffix.lower() not in suffixes:
        raise TrustboError(f"{str(file)!r} must end in {' or '.join(suffixes)}.")
    require_folder(file.parent)
    return file


def as_path(path: FilePath) -> Path:
    """Return a path; TrustboError if it is neither text nor a path."""
    if not isinstance(path, str | os.PathLike):
        raise TrustboError(f"give the path of a file or folder; got a {type(path).__name__}.")
    return Path(path)


def read_yaml(file: Path) -> Any:
    """Read a YAML file; TrustboError if there is none, or it is not YAML."""
    import yaml  # loaded only where YAML is read

    if not file.exists():
        raise TrustboError(f"cannot read {str(file)!r}: No such file or directory.")
    try:
        return yaml.safe_load(read_file(file).decode("utf-8"))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        if isinstance(error, TrustboError):
            raise
        raise TrustboError(f"{str(file)!r} is no YAML: {' '.join(str(error).split())}") from None
