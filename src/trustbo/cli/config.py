"""Flags from a YAML file, for `--config`."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import typer

from trustbo.cli.errors import fail
from trustbo.errors import TrustboError, unknown

_FILES = ("dem", "dsm")
"""Flags whose paths are relative to the file, not to the working directory."""
_LOCATIONS = ("start", "goal")
"""Flags that may be mappings such as {lon: 174.7, lat: -41.3}."""


def read_config(context: typer.Context, path: Path | None) -> Path | None:
    """Make a file's flags the command's defaults, before its other flags are read."""
    if path is not None:
        names = [str(p.name) for p in context.command.params if p.name != "config"]
        try:
            context.default_map = flags_of(path, names)
        except TrustboError as error:
            fail(error, 2)
    return path


def flags_of(path: Path, names: Collection[str]) -> dict[str, str]:
    """Read flags by name, as they would be typed, from a YAML file with a mapping of long flags.

    Dashes or underscores; `names` are those of all flags, with underscores. TrustboError: no
    such file, no YAML, an unknown flag, or a value of another type.
    """
    flags: dict[str, str] = {}
    for key, value in _read(path).items():
        name = str(key).replace("-", "_")
        if name not in names:
            error = unknown("flag", _flag(name), map(_flag, names))
            raise TrustboError(f"{path}: {error}")
        if name in flags:
            raise TrustboError(f"{path}: {_flag(name)} is given twice; leave one out.")
        text = _typed(path, name, value)
        if text is not None:
            flags[name] = str(path.parent / text) if name in _FILES else text
    return flags


def _read(path: Path) -> Mapping[Any, Any]:
    from trustbo.files import read_yaml

    content = read_yaml(path)
    if content is None:
        return {}
    if not isinstance(content, Mapping):
        raise TrustboError(
            f"{path} must hold flags and their values, e.g. seed: 1; got {content!r}."
        )
    return content


def _typed(path: Path, name: str, value: object) -> str | None:
    """Write a value as it would be typed; None leaves the flag at its default."""
    if isinstance(value, list | tuple) and all(type(item) in (int, float) for item in value):
        return ",".join(str(item) for item in value)  # a cell as YAML writes pairs
    if isinstance(value, Mapping) and name in _LOCATIONS:
        return ",".join(f"{axis}={number}" for axis, number in value.items())
    if value is None or isinstance(value, str | int | float):  # bool is an int
        return None if value is None else str(value)
    raise TrustboError(
        f"{path}: {_flag(name)} must be a number, a name or a pair [row, col]; got {value!r}."
    )


def _flag(name: str) -> str:
    return name.replace("_", "-")
