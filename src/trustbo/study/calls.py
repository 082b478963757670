"""Calls of constructors as settings of JSON: `kind` names a public one, other keys its keywords."""

import hashlib
import importlib
import inspect
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

import trustbo
from trustbo import models, simulation, terrain, workspace
from trustbo.errors import TrustboError, require_known, unknown
from trustbo.models.params import Params

FILES = ("dem", "dsm", "points")
"""Keywords that name files; their contents decide the numbers, not their names."""
OF_RUN = "run"
"""Seed that differs between runs: it is the run's seed."""
IMPORTED = '(or give "module:name")'


def random_workspace(
    shape: tuple[int, int] = (10, 10), n_robots: int = 3, n_features: int = 2, seed: int = 0
) -> workspace.Workspace:
    """Workspace without a terrain, with awareness drawn uniformly for each cell.

    Args:
        shape: Rows and columns of the planning grid.
        n_robots: Number of robots, which share their awareness.
        n_features: Number of features.
        seed: Seed of the draw.
    """
    z = np.random.default_rng(seed).uniform(size=(*shape, n_features))
    return workspace.Workspace.from_awareness(np.repeat(z[None], n_robots, axis=0))


def call_of(
    what: str,
    settings: Mapping[str, Any],
    kinds: Iterable[str] = (),
    *,
    given: Iterable[str] = (),
    more: Iterable[str] = (),
) -> dict[str, Any]:
    """Settings of a call, checked against the signature of its constructor.

    Args:
        what: Noun and name of the object, for messages.
        settings: The kind and the keywords, which may be calls themselves.
        kinds: Public names that may be the kind; by default any.
        given: Arguments that are given when it is called.
        more: Further keywords that are not the constructor's.

    Raises:
        TrustboError: An unknown kind, or a keyword that is unknown, missing, or a file that is
            absent.
    """
    kind, kinds = str(settings.get("kind")), tuple(kinds)
    if kinds and ":" not in kind and kind not in kinds:
        raise unknown(f"kind of {what.partition(' ')[0]} {IMPORTED}", kind, kinds)
    keywords = {name: value for name, value in settings.items() if name != "kind"}
    parameters = {n: p for n, p in parameters_of(kind).items() if n not in given}
    variable = [n for n, p in parameters.items() if p.kind in (p.VAR_KEYWORD, p.VAR_POSITIONAL)]
    if not variable:
        require_known(f"setting of {what} ({kind})", keywords, (*parameters, *more))
    required = [n for n, p in parameters.items() if p.default is p.empty and n not in variable]
    if missing := [name for name in required if name not in keywords]:
        raise TrustboError(f"{what} ({kind}) needs {', '.join(missing)}; got {keywords}.")
    return {"kind": kind} | {n: _checked(f"{what}, {n}", n, v) for n, v in keywords.items()}


def _checked(what: str, name: str, value: Any) -> Any:
    """Value of a keyword as JSON can hold it; files by absolute names."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        if "kind" in value:
            return call_of(what, value)
        return {str(n): _checked(what, str(n), v) for n, v in value.items()}
    if isinstance(value, list | tuple):
        return [_checked(what, name, v) for v in value]
    if name == "seed" and isinstance(value, str) and value != OF_RUN:
        raise TrustboError(f'{what} (or "{OF_RUN}") must be a whole number; got {value!r}.')
    if name in FILES and isinstance(value, str | os.PathLike):
        file = Path(value).absolute()
        if not file.is_file():
            raise TrustboError(f"{name}: there is no file {str(file)!r}.")
        return str(file)
    return value


def made(settings: Any, **given: Any) -> Any:
    """Object of a call, or a value with the calls in it made; lists are tuples."""
    if isinstance(settings, list | tuple):
        return tuple(made(one) for one in settings)
    if not isinstance(settings, Mapping):
        return settings
    keywords = {name: made(value) for name, value in settings.items() if name != "kind"}
    if "kind" not in settings:
        return keywords
    result = constructor(settings["kind"])(**given, **keywords)
    if isinstance(result, Params):  # settings have lists for arrays
        arrays = {n: np.asarray(v, float) for n, v in keywords.items() if isinstance(v, tuple)}
        result = result._replace(**arrays)  # pyright: ignore[reportArgumentType]
    return result


def seeded(settings: Any, seed: int) -> Any:
    """Settings of the run with this seed."""
    if not isinstance(settings, Mapping):
        return settings
    return {
        name: seed if name == "seed" and value == OF_RUN else seeded(value, seed)
        for name, value in settings.items()
    }


def identity(settings: Any) -> Any:
    """Settings that decide the numbers: without defaults, which belong to the version."""
    if isinstance(settings, list | tuple):
        return [identity(one) for one in settings]
    if not isinstance(settings, Mapping):
        return settings
    kind = settings.get("kind", "")
    parameters = parameters_of(kind) if kind else {}
    kept = {"kind": kind}
    for name, value in settings.items():
        default = parameters[name].default if name in parameters else inspect.Parameter.empty
        plain = isinstance(default, str | int | float | tuple | None)
        if name != "kind" and not (plain and default == made(value)):
            kept[name] = _digests(value) if name in FILES else identity(value)
    return kept


def constructor(kind: str) -> Callable[..., Any]:
    """Public constructor of this name, or object of a `"module:name"`.

    Raises:
        TrustboError: There is none.
    """
    if ":" in kind:
        return imported("kind", kind)
    rooms = {name: room for room in (simulation, models, workspace, terrain, trustbo)
             for name in room.__all__} | {"random_workspace": sys.modules[__name__]}  # fmt: skip
    name, _, method = kind.partition(".")
    public = getattr(rooms[name], name) if name in rooms else None
    public = getattr(public, method, None) if method else public
    if not callable(public):
        raise unknown(f"kind {IMPORTED}", kind, [one for one in rooms if one[0].isupper()])
    return public


def parameters_of(kind: str) -> Mapping[str, inspect.Parameter]:
    """Parameters of a constructor by name."""
    return inspect.signature(constructor(kind)).parameters


def imported(what: str, source: str) -> Any:
    """Object of a `"module:name"`; TrustboError: there is no such module or name."""
    module, _, name = source.partition(":")
    if os.getcwd() not in sys.path:  # where a program runs, there are the user's modules
        sys.path.append(os.getcwd())
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise TrustboError(f"{what} {source!r} cannot be imported: {error}.") from None


def identity_of(given: Any) -> Any:
    """Name of an object, with a hash of a function's code or of an object's state, for JSON."""
    if given is None or isinstance(given, str):
        return given
    if isinstance(given, partial):
        return [identity_of(given.func), repr(given.args), repr(sorted(given.keywords.items()))]
    kind = given if hasattr(given, "__qualname__") else type(given)
    state: Any = ""
    if isinstance(given, type):
        with suppress(OSError):  # without a file, the name has to do
            state = inspect.getsource(given)
    elif (code := getattr(given, "__code__", None)) is not None:
        # Constants that are code or objects have addresses, which differ between processes.
        plain = [c for c in code.co_consts if isinstance(c, str | int | float | tuple | None)]
        state = repr((code.co_code, plain, code.co_names, given.__defaults__))
    else:
        state = repr(sorted(getattr(given, "__dict__", {}).items()))
    return f"{kind.__module__}:{kind.__qualname__} {_hash(state)}"


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _digests(files: Any) -> list[Any]:
    listed = files if isinstance(files, list) else [files]
    return [digest(file) if isinstance(file, str) else file for file in listed]


@lru_cache(maxsize=64)
def digest(path: str) -> str:
    """Hash of a file's contents."""
    with open(path, "rb") as file:
        return "sha256:" + hashlib.file_digest(file, "sha256").hexdigest()
