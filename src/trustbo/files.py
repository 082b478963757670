"""Atomic writing of files, and errors for files that cannot be read."""

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from trustbo.errors import TrustboError

FilePath = str | PathLike[str]


def write_file(path: FilePath, write: Callable[[Path], object]) -> None:
    """Write a file under a temporary name with the same suffix, flush it to disk, and rename it.

    Args:
        path: File to write; its folder is created if it does not exist.
        write: Function that writes to a given path.

    Raises:
        TrustboError: The file cannot be written; an existing file is left unchanged.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(temporary)
        with temporary.open("rb+") as stream:
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise TrustboError(f"cannot write {str(path)!r}: {error.strerror or error}.") from error


def read_file(path: FilePath) -> bytes:
    """Read a whole file; raises TrustboError if it is missing or cannot be read."""
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise TrustboError(f"{str(path)!r} cannot be read: {error.strerror}.") from None


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
    """Write a text file atomically."""
    write_file(path, lambda file: file.write_text(text, encoding="utf-8"))


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
