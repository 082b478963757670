"""Journal of the mission that runs: JSON lines, each in the file before the next is taken."""

import json
import os
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from trustbo.errors import DamagedFileError
from trustbo.files import folder_to_disk, naming_refusal, read_file, require_folder, to_json


class Journal:
    """Lines that are appended to a file, and read back after the process ended.

    A line that was written outlives a kill of the process; after `sync` it outlives the machine's.
    The last line may have been torn by a power cut, and is then removed when the file is opened.

    Attributes:
        path: File of the lines.
        records: Records of the lines that the file had when it was opened.
        written: Number of lines written so far.
        synced: Number of lines that are on the disk.
    """

    def __init__(self, path: Path) -> None:
        """Open a file for appending, made with its folder if need be.

        Raises:
            DamagedFileError: A line other than the last is no JSON object.
            TrustboError: The folder may not be written to.
        """
        self.path = path
        require_folder(path.parent)
        with naming_refusal(path.parent):
            path.parent.mkdir(parents=True, exist_ok=True)
            self.records, whole = _read(path)
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
            os.ftruncate(self._file, whole)
            os.fsync(self._file)
        folder_to_disk(path.parent)
        self._size, self._open, self._lock = whole, True, threading.Lock()
        self.written = self.synced = len(self.records)

    def write(self, record: dict[str, Any]) -> None:
        """Append a line; TrustboError: the disk is full, and the file is unchanged."""
        line = to_json(record).encode() + b"\n"
        with naming_refusal(self.path.parent):
            try:
                done = os.write(self._file, line)
                while done < len(line):
                    done += os.write(self._file, line[done:])
            except OSError:
                with suppress(OSError):
                    os.ftruncate(self._file, self._size)  # no half of a line before the next
                raise
        self._size += len(line)
        self.written += 1

    def sync(self) -> None:
        """Flush the lines written so far to the disk; may be called from another thread."""
        with self._lock:
            written = self.written
            if self._open and self.synced < written:
                os.fsync(self._file)
                self.synced = written

    def close(self) -> None:
        """Flush and close the file."""
        self.sync()
        with self._lock:
            if self._open:
                os.close(self._file)
            self._open = False


def _read(path: Path) -> tuple[list[dict[str, Any]], int]:
    """Records of a file, and the bytes of its whole lines."""
    if not path.exists():
        return [], 0
    content = read_file(path)
    whole = content.rfind(b"\n") + 1
    records = []
    for number, line in enumerate(content[:whole].splitlines(), start=1):
        try:
            record = json.loads(line)
        except (ValueError, RecursionError):
            record = None
        if not isinstance(record, dict):
            raise DamagedFileError(
                f"{str(path)!r} is damaged: line {number} is no JSON object. The campaign is "
                "whole; move the file away to give up the mission that it holds."
            )
        records.append(record)
    return records, whole
