"""Records of stored runs: what was run, so that a later call recognises it or refuses it."""

import functools
import inspect
import json
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trustbo.campaign.result import Result
from trustbo.errors import TrustboError
from trustbo.files import hash_of, interpreting, read_file, to_json, write_text
from trustbo.inference.functions.identity import content_of, fingerprint, name_of, names_in
from trustbo.models.backend import VERSIONS
from trustbo.models.model import TrustModel
from trustbo.models.record import model_to_record
from trustbo.simulation.protocol import digest
from trustbo.workspace import Workspace
from trustbo.workspace.identity import map_name

_REMEDY = "use another name or folder"
_LENGTH = 16
"""Number of hexadecimal digits of a hash."""
_KNOWN_BY_VERSION = ("builtins", "abc", "typing", "trustbo")
"""Packages whose classes are identified by their names; others may be edited by the user."""


def described(value: Any) -> Any:
    """Return plain values that identify an option, such as a policy, in files.

    Objects other than numbers, texts, models, results and collections of these are identified by
    their name, a hash of their content and hashes of their functions.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, Mapping):
        return {str(name): described(value[name]) for name in sorted(value, key=str)}
    if isinstance(value, list | tuple):
        return [described(one) for one in value]
    if isinstance(value, Result):
        known = (digest(m.path, m.awareness, m.contact_rate) for m in value.missions)
        return {"kind": "Result", "missions": list(known)}

    if isinstance(value, TrustModel):
        return model_to_record(value) | _code_of(type(value))
    if callable(value):
        return {"kind": name_of(value), "sha256": fingerprint(value), **_code_of(type(value))}
    if is_dataclass(value) and not isinstance(value, type):
        settings = {one.name: described(getattr(value, one.name)) for one in fields(value)}
        return {"kind": type(value).__name__, **settings}
    return {"kind": type(value).__name__, "sha256": fingerprint(value)}


def _code_of(kind: type) -> dict[str, list[str]]:
    """Return hashes of the functions of a user's class and of its bases; {} for other classes."""
    own = [one for one in kind.__mro__ if one.__module__.split(".")[0] not in _KNOWN_BY_VERSION]
    functions = [function for part in own for function in _functions_of(part)]
    return {"code": [fingerprint(one) for one in functions]} if functions else {}


def _functions_of(kind: type) -> list[Any]:
    """Return the functions in the definition of a class, without those of its bases."""
    return [one for one in vars(kind).values() if inspect.isfunction(one)]


def describe_scene(scene: Any) -> dict[str, Any]:
    """Return plain values that identify a scene in files, keyed by what they describe."""
    workspace = scene.workspace
    truth = scene.truth
    return {
        "workspace": _describe_workspace(workspace),
        "simulator": _describe_simulator(scene.simulator),
        "start": workspace.locate(scene.start, "start"),
        "goal": workspace.locate(scene.goal, "goal"),
        "truth": None if truth is None else digest(*(v.values for v in truth.bounds.values())),
        "options": described(scene.options),
        "labels": described(scene.labels),
        "judged": described(scene.judged),
    }


def _describe_workspace(workspace: Workspace) -> dict[str, Any]:
    """Return plain values that identify the map, the team and the awareness of a workspace."""
    return {
        "map": map_name(workspace),
        "team": asdict(workspace.team),
        "awareness": digest(workspace.awareness.values),
    }


def _describe_simulator(simulator: Any) -> dict[str, Any]:
    """Return the settings of a simulator, its workspace, and hashes of a user's functions."""
    workspace = getattr(simulator, "workspace", None)
    has_settings = hasattr(simulator, "describe")
    return {
        "settings": simulator.describe() if has_settings else described(simulator),
        "workspace": _describe_workspace(workspace) if isinstance(workspace, Workspace) else None,
        **_code_of(type(simulator)),
    }


def source_of(value: Any) -> str | None:
    """Return a hash of the code of a function and of what it refers to; None for other values.

    Functions and classes of the same module are included; those of other modules are not.
    """
    if not callable(value):
        return None

    classes: list[type] = []
    _add_classes(value, _module_of(value), classes, set())
    functions = [function for kind in classes for function in _functions_of(kind)]
    hashes = [fingerprint(value), *(fingerprint(one) for one in functions)]
    return hash_of(" ".join(hashes).encode())[:_LENGTH]


def _module_of(value: Any) -> str:
    """Return the name of the module of a function, or of the class of an object."""
    if isinstance(value, functools.partial):
        return _module_of(value.func)
    return value.__module__ if inspect.isroutine(value) else type(value).__module__


def _add_classes(value: Any, module: str, found: list[type], seen: set[int]) -> None:
    """Add the classes of a module to which a value refers, also through others, to `found`."""
    if id(value) in seen:
        return
    seen.add(id(value))

    if inspect.isclass(value) and value.__module__ == module:
        found.append(value)
    for one in _used_by(value, module):
        _add_classes(one, module, found, seen)


def _used_by(value: Any, module: str) -> list[Any]:
    """Return the values, functions and classes to which a value of a module refers directly."""
    if isinstance(value, functools.partial):
        return [value.func, *value.args, *value.keywords.values()]
    if isinstance(value, Mapping):
        return list(value.values())
    if isinstance(value, list | tuple):
        return list(value)
    if inspect.ismethod(value):
        return [value.__func__, value.__self__]

    if not (inspect.isfunction(value) or inspect.isclass(value)):
        return [type(value)]
    if value.__module__ != module:
        return []
    if inspect.isclass(value):
        return [*value.__bases__, *_functions_of(value)]

    names = sorted(names_in(value.__code__) & set(value.__globals__))
    enclosed = [content_of(cell) for cell in value.__closure__ or ()]
    return [*(value.__globals__[name] for name in names), *enclosed]


def write_record(
    file: Path, names: Mapping[str, Any], sources: Mapping[str, Any], content: Mapping[str, Any]
) -> None:
    """Write the record of a run beside its table.

    Args:
        file: CSV file of the run.
        names: Names of the run: `case`, `scene`, `seed` and `n_missions`.
        sources: `source_of` the case and the scene.
        content: The options of the `case` and the content of the `scene`, see `described` and
            `describe_scene`.
    """
    record = {"trustbo": VERSIONS["trustbo"], **names, "sources": sources, "content": content}
    write_text(_record_file(file), json.dumps(json.loads(to_json(record)), indent=1))


def read_record(file: Path, names: Mapping[str, Any]) -> dict[str, Any]:
    """Read the record of a stored run.

    Raises:
        TrustboError: There is no record, or it is of another version, case, scene or seed.
    """
    beside = _record_file(file)
    if not beside.exists():
        raise TrustboError(
            f"{str(file)!r} has no record of its options, so it may be of another study or from an "
            "earlier version of trustbo; use another folder, or delete the file to repeat the run."
        )

    content = read_file(beside)
    with interpreting(beside):
        record = dict(json.loads(content))
        version = record["trustbo"]
        stored = {name: record[name] for name in names}
        record = {**record, "sources": dict(record["sources"]), "content": dict(record["content"])}

    if version != VERSIONS["trustbo"]:
        raise TrustboError(
            f"{str(file)!r} was run with trustbo {version}, but this is trustbo "
            f"{VERSIONS['trustbo']}; use another folder."
        )
    for name, value in names.items():
        if stored[name] != value:
            raise TrustboError(
                f"{name} {value!r} would have the same file as the stored {name} {stored[name]!r}, "
                f"{str(file)!r}; {_REMEDY}."
            )
    return record


def _record_file(file: Path) -> Path:
    """Return the path of the record beside the table of a run."""
    return file.with_suffix(".json")


def require_same(what: str, stored: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise TrustboError, which names the differences, unless a stored record is as it is now.

    Args:
        what: Beginning of the message, such as "case 'mine' was run with other options".
        stored: Values of the stored record.
        now: Values of the case or scene.
    """
    now = json.loads(to_json(now))
    differing = [
        name
        for name in dict.fromkeys((*now, *stored))
        if (name in now) != (name in stored) or to_json(now.get(name)) != to_json(stored.get(name))
    ]
    if differing:
        raise TrustboError(f"{what} ({', '.join(differing)}); {_REMEDY}.")
