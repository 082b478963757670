"""Folder of a study: its table of runs, and a file for each run that has ended or failed."""

import json
import math
import os
from pathlib import Path
from typing import Any

from trustbo.errors import DamagedFileError, TrustboError
from trustbo.files import FilePath, read_record, require_file, require_folder, write_text


class Store:
    """Reads and writes a study's folder; each file is written whole or not at all."""

    def __init__(self, directory: FilePath) -> None:
        """Use a folder, which need not exist yet; TrustboError if its name belongs to a file."""
        self.folder = require_folder(directory)

    def require_free(self, *names: str) -> None:
        """Refuse a folder where tables or figures would replace files of another program.

        Raises:
            TrustboError: One of these names is taken, by a folder, or in a folder without a study.
        """
        for name in names:
            file = require_file(self.folder / name)
            if file.exists() and not (self.folder / "study.json").is_file():
                raise TrustboError(
                    f"{str(file)!r} would be replaced; move it, or choose another folder."
                )

    def write_study(self, settings: dict[str, Any], table: dict[str, dict[str, Any]]) -> None:
        """Write `study.json`: the settings, and the labels of each run by key."""
        if os.path.lexists(self.folder / "study.json"):
            self.table()  # refuses a file of another program
        self._write("study.json", {"study": settings, "runs": table})

    def table(self) -> dict[str, dict[str, Any]]:
        """Read the labels of each run, by key; TrustboError if the folder holds no study."""
        file = self.folder / "study.json"
        if not file.is_file():
            raise TrustboError(
                f"{str(self.folder)!r} holds no study; give a folder that run_study wrote to."
            )
        runs = _read(file).get("runs")
        if not isinstance(runs, dict) or not all(isinstance(one, dict) for one in runs.values()):
            raise DamagedFileError(f"{str(file)!r} is damaged, or of no study: it has no runs.")
        return {key: _now_named(labels) for key, labels in runs.items()}

    def has(self, key: str) -> bool:
        """Whether the run has ended."""
        return self._run(key).is_file()

    def write(self, key: str, record: dict[str, Any]) -> None:
        """Write the record of a run: to `runs/`, or to `failed/` if it holds an error."""
        failed = "error" in record
        self._write(f"{'failed' if failed else 'runs'}/{key}.json", {"key": key, **record})
        if not failed:
            self._failure(key).unlink(missing_ok=True)

    def read(self, key: str) -> dict[str, Any]:
        """Read the record of a run that has ended."""
        return _read(self._run(key))

    def failure(self, key: str) -> dict[str, Any] | None:
        """Read the record of a run that failed; None if it did not."""
        file = self._failure(key)
        return _read(file) if file.is_file() else None

    def _run(self, key: str) -> Path:
        return self.folder / "runs" / f"{key}.json"

    def _failure(self, key: str) -> Path:
        return self.folder / "failed" / f"{key}.json"

    def _write(self, name: str, record: dict[str, Any]) -> None:
        text = json.dumps(_plain(record), indent=1, allow_nan=False, default=str)
        write_text(self.folder / name, text)


def _now_named(labels: dict[str, Any]) -> dict[str, Any]:
    """Labels of version 0.2 under the names of this one."""
    return {"method" if name == "contender" else name: label for name, label in labels.items()}


def _read(file: Path) -> dict[str, Any]:
    return read_record(file)


def _plain(value: Any) -> Any:
    """Replace NaN by null, as JSON has no NaN."""
    if isinstance(value, dict):
        return {str(name): _plain(v) for name, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
