"""Files are written whole or not at all."""

import json
import os
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np


def write_file(path: str | PathLike[str], write: Callable[[Path], object]) -> None:
    """Write a file whole or not at all: to a temporary name, then renamed.

    Args:
        path: The file; its folder is made if need be.
        write: Writes to the path it is given, which has the same suffix.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        write(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: str | PathLike[str], text: str) -> None:
    """Write a text file whole or not at all."""
    write_file(path, lambda file: file.write_text(text, encoding="utf-8"))


def to_json(record: object) -> str:
    """JSON of a record that may hold NumPy's numbers and arrays; anything else as its text."""

    def plain(value: Any) -> object:
        return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)

    return json.dumps(record, indent=2, default=plain)
