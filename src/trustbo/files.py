"""Atomic writes, and errors for names of files that cannot be written or read."""

import json
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from trustbo.errors import TrustboError


def write_file(path: str | PathLike[str], write: Callable[[Path], object]) -> None:
    """Write a file atomically: to a temporary name, which is then renamed.

    Ctrl-C takes effect after the write, a second Ctrl-C at once.

    Args:
        path: File to write; its folder is made if it does not exist.
        write: Function that writes to the path it is given, which has the same suffix.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        with _defer_interrupt():
            write(temporary)
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def _defer_interrupt() -> Iterator[None]:
    """Defer the first Ctrl-C; during a write, it can leave the netCDF library locked for ever."""
    then = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(then):
        yield  # Python delivers it to another thread, or it raises nothing
        return
    presses = 0

    def count(number, frame) -> None:
        nonlocal presses
        presses += 1
        if presses > 1:
            then(number, frame)

    signal.signal(signal.SIGINT, count)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, then)
        if presses == 1:
            then(signal.SIGINT, None)


def write_text(path: str | PathLike[str], text: str) -> None:
    """Write a text file atomically."""
    write_file(path, lambda file: file.write_text(text, encoding="utf-8"))


def to_json(record: object) -> str:
    """Return the JSON of a record; NumPy numbers and arrays as lists, other objects as text."""

    def plain(value: Any) -> object:
        return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)

    return json.dumps(record, indent=2, default=plain)


def require_folder(directory: str | PathLike[str]) -> Path:
    """Return a folder, which need not exist yet.

    Raises:
        TrustboError: The name, or that of a folder above it, belongs to a file.
    """
    folder = Path(directory)
    for part in (folder, *folder.parents):
        if part.exists():
            if not part.is_dir():
                raise TrustboError(f"cannot write to {str(folder)!r}: {str(part)!r} is a file.")
            break
    return folder


def require_file(path: str | PathLike[str], *suffixes: str) -> Path:
    """Return a file to write, which may exist already.

    Args:
        path: Name of the file.
        suffixes: Allowed suffixes, in lower case with the dot; none to allow any.

    Raises:
        TrustboError: The suffix is another, a folder has that name, or a file that of its folder.
    """
    file = Path(path)
    if suffixes and file.suffix.lower() not in suffixes:
        raise TrustboError(f"{str(file)!r} must end in {' or '.join(suffixes)}.")
    if file.is_dir():
        raise TrustboError(f"cannot write {str(file)!r}: it is a folder; name a file in it.")
    require_folder(file.parent)
    return file


def read_yaml(file: Path) -> Any:
    """Read a YAML file.

    Raises:
        TrustboError: There is no such file, or it is not YAML.
    """
    import yaml  # loaded only where YAML is read

    try:
        return yaml.safe_load(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise TrustboError(f"cannot read {str(file)!r}: {error.strerror}.") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise TrustboError(f"{str(file)!r} is no YAML: {' '.join(str(error).split())}") from None
