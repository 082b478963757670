"""Folder of a study: its table of runs, and a file for each run that has ended or failed."""

import json
import math
from pathlib import Path
from typing import Any

from trustbo.errors import TrustboError
from trustbo.files import FilePath, require_folder, write_text
from trustbo.study.run import Run


class Store:
    """Reads and writes a study's folder; each file is written whole or not at all."""

    def __init__(self, directory: FilePath) -> None:
        """Use a folder, which need not exist yet; TrustboError if its name belongs to a file."""
        self.folder = require_folder(directory)

    def write_study(self, settings: dict[str, Any], runs: list[Run]) -> None:
        """Write `study.json`: the settings, and the table of runs by key."""
        table = {run.key: run.labels for run in runs}
        self._write("study.json", {"study": settings, "runs": table})

    def table(self) -> dict[str, dict[str, Any]]:
        """Read the labels of each run, by key; TrustboError if the folder holds no study."""
        file = self.folder / "study.json"
        if not file.is_file():
            raise TrustboError(
                f"{str(self.folder)!r} holds no study; give a folder that run_study wrote to."
            )
        return json.loads(file.read_text(encoding="utf-8"))["runs"]

    def has(self, key: str) -> bool:
        """Whether the run has ended."""
        return self._run(key).is_file()

    def write(self, run: Run, record: dict[str, Any]) -> None:
        """Write the record of a run: to `runs/`, or to `failed/` if it holds an error."""
        failed = "error" in record
        own = {"key": run.key, "labels": run.labels, "identity": run.identity, **record}
        self._write(f"{'failed' if failed else 'runs'}/{run.key}.json", own)
        if not failed:
            self._failure(run.key).unlink(missing_ok=True)

    def read(self, key: str) -> dict[str, Any]:
        """Read the record of a run that has ended."""
        return json.loads(self._run(key).read_text(encoding="utf-8"))

    def failure(self, key: str) -> dict[str, Any] | None:
        """Read the record of a run that failed; None if it did not."""
        file = self._failure(key)
        return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else None

    def _run(self, key: str) -> Path:
        return self.folder / "runs" / f"{key}.json"

    def _failure(self, key: str) -> Path:
        return self.folder / "failed" / f"{key}.json"

    def _write(self, name: str, record: dict[str, Any]) -> None:
        text = json.dumps(_plain(record), indent=1, allow_nan=False, default=str)
        write_text(self.folder / name, text)


def _plain(value: Any) -> Any:
    """Replace NaN by null, as JSON has no NaN."""
    if isinstance(value, dict):
        return {str(name): _plain(v) for name, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
