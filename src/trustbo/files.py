"""Files are written whole or not at all."""

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


def write_file(path: str | PathLike[str], write: Callable[[Path], object]) -> None:
    """Write a file whole or not at all: to a temporary name, then renamed.

    Ctrl-C takes effect after it, a second one at once.

    Args:
        path: The file; its folder is made if need be.
        write: Writes to the path it is given, which has the same suffix.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        with _put_off_interrupt():
            write(temporary)
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def _put_off_interrupt() -> Iterator[None]:
    """Let the first Ctrl-C wait; in the midst of a write, it may leave netCDF locked for ever."""
    then = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(then):
        yield  # it comes elsewhere, or is no exception
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
    """Write a text file whole or not at all."""
    write_file(path, lambda file: file.write_text(text, encoding="utf-8"))


def to_json(record: object) -> str:
    """JSON of a record that may hold NumPy's numbers and arrays; anything else as its text."""

    def plain(value: Any) -> object:
        return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)

    return json.dumps(record, indent=2, default=plain)
