"""Calls of public constructors as plain settings: the kind is a name, the rest its keywords."""

import hashlib
import importlib
import inspect
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

import trustbo
from trustbo import models, simulation, terrain, workspace
from trustbo.errors import TrustboError
from trustbo.models.params import Params

FILES = ("dem", "dsm", "points")
"""Keywords that name files; their contents decide the numbers, not their names."""
EACH_RUN = "run"
"""Seed that differs between runs: it is the run's seed."""


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


@dataclass(frozen=True)
class Call:
    """Constructor and keywords, which may be calls themselves.

    Attributes:
        kind: Public name, `"module:name"`, or `""` for a plain mapping.
        keywords: Pairs of name and value.
    """

    kind: str
    keywords: tuple[tuple[str, Any], ...]

    def make(self, **given: Any) -> Any:
        """Call the constructor."""
        keywords = {name: _made(value) for name, value in self.keywords}
        if not self.kind:
            return keywords
        made = constructor(self.kind)(**given, **keywords)
        if isinstance(made, Params):  # YAML has lists for arrays
            lists = {n: np.asarray(v, float) for n, v in keywords.items() if isinstance(v, tuple)}
            made = made._replace(**lists)  # pyright: ignore[reportArgumentType]
        return made

    def at(self, seed: int) -> "Call":
        """Call of the run with this seed."""
        return Call(self.kind, tuple((name, _seeded(name, v, seed)) for name, v in self.keywords))

    def get(self, name: str, default: Any = None) -> Any:
        """Value of a keyword."""
        return dict(self.keywords).get(name, default)

    def settings(self) -> dict[str, Any]:
        """Settings as JSON can hold them."""
        kind = {"kind": self.kind} if self.kind else {}
        return kind | {name: _plain(value) for name, value in self.keywords}

    def identity(self) -> dict[str, Any]:
        """Settings that decide the numbers: without defaults, which belong to the version."""
        kept = {n: v for n, v in self.keywords if not self._is_default(n, v)}
        return {"kind": self.kind} | {
            name: _digest(value) if name in FILES else _plain(value, identity=True)
            for name, value in kept.items()
        }

    def _is_default(self, name: str, value: Any) -> bool:
        parameter = _parameters(self.kind).get(name) if self.kind else None
        default = None if parameter is None else parameter.default
        plain = isinstance(default, str | int | float | tuple | None)
        return parameter is not None and plain and default == value


def constructor(kind: str) -> Callable[..., Any]:
    """Public constructor of this name, or object of a `"module:name"`.

    Raises:
        TrustboError: There is none.
    """
    if ":" in kind:
        return imported("kind", kind)
    name, _, method = kind.partition(".")
    public = _public()
    made = getattr(public[name], name) if name in public else None
    made = getattr(made, method, None) if method else made
    if not callable(made):
        raise TrustboError(
            f"unknown kind {kind!r}{_meant(kind, public)}; give the name of a public "
            'constructor, such as Team, or "module:name" of your own.'
        )
    return made


def call_of(
    what: str,
    settings: Mapping[str, Any],
    kinds: Iterable[str] = (),
    *,
    given: Iterable[str] = (),
    more: Iterable[str] = (),
) -> Call:
    """Call with these settings, checked against the signature of its constructor.

    Args:
        what: Noun and name of what is made, for messages.
        settings: The kind and the keywords.
        kinds: Public names that may be the kind; by default any.
        given: Arguments that are given when it is called.
        more: Further keywords that are not the constructor's.

    Raises:
        TrustboError: An unknown kind, or a keyword that is unknown, missing, or a file that is
            absent.
    """
    keywords, kinds = dict(settings), tuple(kinds)
    kind = keywords.pop("kind", None)
    if not isinstance(kind, str) or (kinds and ":" not in kind and kind not in kinds):
        noun = what.partition(" ")[0]
        raise TrustboError(
            f"unknown kind of {noun} {kind!r}{_meant(str(kind), kinds)}; choose one of "
            f'{", ".join(kinds)}, or give "module:name" of your own.'
        )
    named = {n: p for n, p in _parameters(kind).items() if n not in given}
    variable = [n for n, p in named.items() if p.kind in (p.VAR_KEYWORD, p.VAR_POSITIONAL)]
    for name in () if variable else keywords:
        require_known(f"setting of {what} ({kind})", name, (*named, *more))
    missing = [
        name
        for name, p in named.items()
        if p.default is p.empty and name not in (*variable, *keywords)
    ]
    if missing:
        raise TrustboError(f"{what} ({kind}) needs {', '.join(missing)}; got {dict(keywords)}.")
    return Call(kind, tuple((n, _frozen(f"{what}, {n}", n, v)) for n, v in keywords.items()))


def takes(kind: str, name: str) -> bool:
    """Whether a constructor takes a keyword."""
    return name in _parameters(kind)


def require_known(what: str, name: object, choices: Iterable[str]) -> None:
    """Refuse an unknown name (TrustboError), with the choice that it resembles."""
    choices = tuple(choices)
    if name not in choices:
        meant = _meant(str(name), choices)
        raise TrustboError(f"unknown {what} {name!r}{meant}; choose one of {', '.join(choices)}.")


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
    if isinstance(given, type):
        with suppress(OSError):  # without a file, the name has to do
            return f"{kind.__module__}:{kind.__qualname__} {_hash(inspect.getsource(given))}"
        state: Any = ""
    elif (code := getattr(given, "__code__", None)) is not None:
        # Constants that are code or objects have addresses, which differ between processes.
        plain = [c for c in code.co_consts if isinstance(c, str | int | float | tuple | None)]
        state = code.co_code, plain, code.co_names, given.__defaults__
    else:
        state = sorted(getattr(given, "__dict__", {}).items())
    return f"{kind.__module__}:{kind.__qualname__} {_hash(repr(state))}"


@lru_cache(maxsize=1)
def _public() -> dict[str, Any]:
    """Modules of the public names, which are looked up when they are needed."""
    rooms = (simulation, models, workspace, terrain, trustbo)
    names = {name: room for room in rooms for name in room.__all__}
    return names | {"random_workspace": sys.modules[__name__]}


def _parameters(kind: str) -> Mapping[str, inspect.Parameter]:
    return inspect.signature(constructor(kind)).parameters


def _meant(name: str, choices: Iterable[str]) -> str:
    by_lower = {one.lower(): one for one in choices}
    close = get_close_matches(name.lower(), by_lower, 1)
    return f" (did you mean {by_lower[close[0]]!r}?)" if close else ""


def _frozen(what: str, name: str, value: Any) -> Any:
    """Value that can be hashed: lists as tuples, mappings as calls."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        if "kind" in value:
            return call_of(what, value)
        return Call("", tuple((str(n), _frozen(what, str(n), v)) for n, v in value.items()))
    if isinstance(value, list | tuple):
        return tuple(_frozen(what, "", v) for v in value)
    if name == "seed" and isinstance(value, str) and value != EACH_RUN:
        raise TrustboError(f'{what} (or "{EACH_RUN}") must be a whole number; got {value!r}.')
    if name in FILES and isinstance(value, str | os.PathLike):
        file = Path(value).absolute()
        if not file.is_file():
            raise TrustboError(f"{name}: there is no file {str(file)!r}.")
        return str(file)
    return value


def _made(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(map(_made, value))
    return value.make() if isinstance(value, Call) else value


def _seeded(name: str, value: Any, seed: int) -> Any:
    if isinstance(value, Call):
        return value.at(seed)
    return seed if name == "seed" and value == EACH_RUN else value


def _plain(value: Any, *, identity: bool = False) -> Any:
    if isinstance(value, tuple):
        return [_plain(one, identity=identity) for one in value]
    if isinstance(value, Call):
        return value.identity() if identity else value.settings()
    return value


def _digest(value: Any) -> Any:
    files = value if isinstance(value, tuple) else (value,)
    return [digest(file) if isinstance(file, str) else file for file in files]


@lru_cache(maxsize=64)
def digest(path: str) -> str:
    """Hash of a file's contents."""
    with open(path, "rb") as file:
        return "sha256:" + hashlib.file_digest(file, "sha256").hexdigest()


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]
