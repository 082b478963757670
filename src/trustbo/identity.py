"""Whether two things are the same: hashes of functions, values and maps.

What counts are the code of functions without docstrings, annotations and source files (`bytecode`),
their constants, defaults and closures, and the user's own functions, classes and values to which
they refer. Objects of installed libraries count by module, name and version. A hash depends neither
on the process nor on earlier uses of the objects, and dicts and sets have no order.
"""

import functools
import hashlib
import importlib
import inspect
import random
import sys
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from importlib.util import find_spec, resolve_name
from operator import attrgetter
from pathlib import Path
from types import CodeType, MemberDescriptorType, ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import xarray as xr
from numba.core.dispatcher import Dispatcher
from numba.np.ufunc.dufunc import DUFunc
from numba.np.ufunc.gufunc import GUFunc
from numpyro.distributions.util import lazy_property
from numpyro.primitives import Messenger
from scipy import sparse

from trustbo.bytecode import imports_of, parts_of, reads_of
from trustbo.data import THREAT
from trustbo.fixed import cached_names

_HASH_LENGTH = 16
"""Number of hexadecimal digits of a hash; two are equal by chance with probability 1e-19."""
_SHORT = 8
"""Number of hexadecimal digits of the hash of a constant."""
_ATOMS = (type(None), bool, int, float, complex, str, bytes, type(...), type(NotImplemented))
"""Kinds of values whose text says all."""
_JITTED: Any = type(jax.jit(len))
"""Class of what `jax.jit` returns."""
_CACHES = (
    *weakref.ProxyTypes, weakref.ref, weakref.WeakKeyDictionary, weakref.WeakValueDictionary,
    weakref.WeakSet, np.random.RandomState, random.Random,
)  # fmt: skip
"""Kinds of objects that change when they are used, and that count by their class."""


def fingerprint(value: Any, parts: Mapping[type, Callable[[Any], Any]] | None = None) -> str:
    """Return a hash of a value, and of all code and values to which it refers.

    Args:
        value: A function, or any other value.
        parts: Functions that return what identifies an object, by the class of the object.
    """
    return _Hasher(parts or {}).hash(value).hex()[:_HASH_LENGTH]


def record_of(function: Callable[..., Any]) -> dict[str, Any]:
    """Return what identifies a function in files.

    These are its `fingerprint`, a short hash of each value to which it refers, by name, and the
    versions of Python and of the libraries that it uses. The values are arguments of
    `functools.partial`, defaults, variables of enclosing functions and global variables, also of
    the user's functions that it calls.
    """
    hasher = _Hasher({})
    sha256 = hasher.hash(function).hex()[:_HASH_LENGTH]
    constants = {name: fingerprint(one)[:_SHORT] for name, one in hasher.constants.items()}
    python = f"{sys.version_info.major}.{sys.version_info.minor}"  # other byte code
    return {
        "sha256": sha256,
        "constants": constants,
        "versions": {"python": python, **dict(sorted(hasher.versions.items()))},
    }


def map_name(workspace: Any) -> str:
    """Return a name for the map of a workspace; maps with equal content have equal names.

    The content consists of the grid, the passable cells, the slope limit and the names of the
    features. With a terrain, the heights, the maps of the features and the model of sight are
    added; teams of different size therefore share a map. Without a terrain, the awareness is added.
    If robots stay at home, the map is that of the whole team.
    """
    workspace = workspace.whole
    content = {
        "grid": workspace.grid,
        "features": workspace.features,
        "max_slope": workspace.team.max_slope,
        "sight": workspace.sight,
        "passable": workspace.passable.values,
    }
    if workspace.terrain is None or workspace.pixels is None:
        names = [name for name in workspace.features if name != THREAT]  # threats come and go
        content["awareness"] = workspace.awareness.sel(feature=names).values
    else:
        maps = {"dem": workspace.terrain["dem"], "dsm": workspace.terrain["dsm"]}
        maps |= {str(name): workspace.pixels[name] for name in workspace.pixels}
        content["maps"] = {name: one.values.astype(float) for name, one in maps.items()}
    return fingerprint(content)


def name_of(function: Any) -> str:
    """Return the name of a function, which may be wrapped by `functools.partial` or a handler."""
    inner = _inner_of(function)
    return getattr(function, "__name__", getattr(inner, "__name__", type(inner).__name__))


def _inner_of(value: Any) -> Any:
    """Return the function inside of partial functions, handlers and wrappers such as `jax.jit`."""
    if isinstance(value, functools.partial):
        return _inner_of(value.func)
    if isinstance(value, Messenger) and value.fn is not None:
        return _inner_of(value.fn)
    wrapped = getattr(value, "__wrapped__", None) if _is_wrapper(value) else None
    return value if wrapped is None else _inner_of(wrapped)


def _is_wrapper(value: Any) -> bool:
    """Return whether a value is an object that wraps a function, such as that of `jax.jit`."""
    is_object = not isinstance(value, type) and not inspect.isfunction(value)
    return is_object and callable(getattr(value, "__wrapped__", None))


def _sha(*parts: str | bytes) -> bytes:
    """Return the hash of texts and hashes, with their lengths."""
    found = hashlib.sha256()
    for part in parts:
        content = part if isinstance(part, bytes) else part.encode(errors="surrogatepass")
        found.update(len(content).to_bytes(8))
        found.update(content)
    return found.digest()


class _Hasher:
    """Hashes of values from those of their parts.

    Attributes:
        constants: Values to which the functions found so far refer, by name.
        versions: Versions of the libraries found so far.
    """

    def __init__(self, parts: Mapping[type, Callable[[Any], Any]]) -> None:
        self.constants: dict[str, Any] = {}
        self.versions: dict[str, str] = {}
        self._parts = parts
        self._known: dict[int, tuple[Any, bytes]] = {}  # by id, with the value, which keeps the id
        self._begun: dict[int, int] = {}  # depth of the values that are being hashed, by id

    def hash(self, value: Any) -> bytes:
        """Return the hash of a value; a value within itself counts by its depth."""
        if type(value) in _ATOMS:
            return _sha(type(value).__name__, repr(value))
        if id(value) in self._known:
            return self._known[id(value)][1]
        if id(value) in self._begun:
            return _sha("above", str(self._begun[id(value)]))

        self._begun[id(value)] = len(self._begun)
        found = self._hash(value)
        del self._begun[id(value)]
        self._known[id(value)] = value, found
        return found

    def _hash(self, value: Any) -> bytes:
        """Return the hash of a value that has parts."""
        kind = type(value)
        if kind in (tuple, list):
            return _sha(kind.__name__, *map(self.hash, value))
        if kind is dict:
            items = [self.hash(name) + self.hash(one) for name, one in value.items()]
            return _sha("dict", *sorted(items))
        if kind in (set, frozenset):
            return _sha("set", *sorted(map(self.hash, value)))
        if kind in (np.ndarray, np.memmap) and not value.dtype.hasobject:
            content = np.ascontiguousarray(value).tobytes()
            return _sha("array", str(value.dtype), str(value.shape), content)

        label, content = self._content_of(value)
        return _sha(label, self.hash(content))

    def _content_of(self, value: Any) -> tuple[str, Any]:
        """Return the kind of a value, and a simpler value that identifies it."""
        if issubclass(type(value), _CACHES):  # isinstance would look through a proxy
            return "cache", type(value).__qualname__
        for kind, part_of in self._parts.items():
            if isinstance(value, kind):
                return f"part of {kind.__name__}", part_of(value)

        if isinstance(value, _JITTED):  # which forgets its attributes in other processes
            state = value.__getstate__()
            return "jitted", (state["fun"], state["static_argnames"])
        if name := _library_name(value):
            return "of a library", (name, self._version_of(name))
        if inspect.ismodule(value):
            return "module", (value.__name__, self._version_of(value.__name__))
        if inspect.isclass(value):
            return "class", (value.__qualname__, type(value), value.__bases__, _members_of(value))
        return self._content_of_callable(value) or _content_of_data(value)

    def _content_of_callable(self, value: Any) -> tuple[str, Any] | None:
        """Return what identifies a function, a method or a wrapper of these; None for others."""
        if inspect.isfunction(value):
            return "function", self._content_of_function(value)
        if inspect.ismethod(value):
            self._note({"self": value.__self__})
            return "method", (value.__func__, value.__self__)
        if isinstance(value, functools.partial):
            self._note({f"argument {n}": one for n, one in enumerate(value.args)} | value.keywords)
            return "partial", (value.func, value.args, value.keywords)
        if isinstance(value, Dispatcher):  # of numba, whose attributes are changed by a call
            return "compiled", (value.py_func, value.targetoptions)
        if isinstance(value, DUFunc | GUFunc):
            return "vectorised", value._dispatcher  # pyright: ignore[reportAttributeAccessIssue]
        if isinstance(value, np.vectorize):
            return "vectorised", (value.pyfunc, value.otypes, value.excluded, value.signature)
        if _is_wrapper(value):
            attributes = {n: one for n, one in vars(value).items() if not n.startswith("__")}
            return "wrapper", (type(value), value.__wrapped__, attributes)
        return None

    def _content_of_function(self, function: Any) -> Any:
        """Return what identifies a function: its code, and what it refers to."""
        module = function.__globals__.get("__name__")
        values = {"defaults": _defaults_of(function), "enclosed": _enclosed_by(function)}
        if _is_of_user(module):
            values["read"] = self._read_by(function, values["enclosed"])
            values["attributes"] = {
                name: one for name, one in vars(function).items() if name != "__wrapped__"
            }
            code = function.__code__
        else:  # such as a wrapper that a library puts around a function
            code = f"{module}.{function.__qualname__}", self._version_of(module)

        for of_kind in values.values():
            self._note(of_kind)
        return code, values

    def _read_by(self, function: Any, enclosed: Mapping[str, Any]) -> dict[str, Any]:
        """Return the global values that a function reads, and what it imports, by name.

        Of the user's modules, these are the attributes that are read.
        """
        found: dict[str, Any] = {}
        for name, attributes, is_global in reads_of(function.__code__):
            space = function.__globals__ if is_global else enclosed
            if name not in space:  # built-in, or of an inner function
                continue
            if is_global or inspect.ismodule(space[name]):
                path, value = _followed(name, space[name], attributes)
                found[path] = value

        package = function.__globals__.get("__package__") or ""
        for name, level, names, attributes in imports_of(function.__code__):
            module = _imported(name, level, package)
            of_module = _attributes_of(module, names or attributes)
            for one in list(of_module.values()):  # such as a module of a package
                of_module |= _attributes_of(one, attributes)
            found |= {name: module, **of_module}
        return found

    def _note(self, values: Mapping[str, Any]) -> None:
        """Add values to the constants, except for functions, classes and modules."""
        for name, one in values.items():
            is_named = inspect.isroutine(one) or inspect.isclass(one) or inspect.ismodule(one)
            if not (is_named or _is_wrapper(one) or isinstance(one, functools.partial)):
                self.constants.setdefault(name, one)

    def _version_of(self, module: str) -> str:
        """Return the version of the library of a module, and note it; "" if it has none."""
        library = module.partition(".")[0]
        found = _installed(library)
        if found:
            self.versions[library] = found
        return found


@functools.cache
def _installed(library: str) -> str:
    """Return the version of an installed library; "" for others and for Python's own modules."""
    if library in sys.stdlib_module_names or _is_of_user(library):
        return ""
    try:
        return version(library)
    except PackageNotFoundError:  # such as sklearn of scikit-learn
        names = packages_distributions().get(library, [])
        return version(names[0]) if names else ""


@functools.cache
def _is_of_user(module: str | None) -> bool:
    """Return whether a module is a file or notebook of the user, and not of a library."""
    if module is None or module == "__main__":
        return True

    library = module.partition(".")[0]
    if library in {"trustbo", *sys.stdlib_module_names}:
        return False

    # Modules inside of a compiled library have no file.
    files = [getattr(sys.modules.get(name), "__file__", None) for name in (module, library)]
    if library not in sys.modules:
        with suppress(ImportError, ValueError):
            spec = find_spec(library)
            files.append(spec and spec.origin)
    folders = {part for file in files for part in Path(file or "").parts}
    return folders.isdisjoint({"site-packages", "dist-packages"})


def _library_name(value: Any) -> str:
    """Return the module and name under which a library has a value; "" if it has no such name."""
    try:
        module, name = value.__module__, value.__qualname__
        is_named = isinstance(module, str) and not _is_of_user(module)
        if is_named and attrgetter(name)(sys.modules[module]) is value:
            return f"{module}.{name}"
    except (AttributeError, KeyError, TypeError):
        pass
    return ""


def _imported(name: str, level: int, package: str) -> Any:
    """Return a module that a function imports, or None if it cannot be imported."""
    with suppress(Exception):  # of many types, as this runs code of the user
        name = resolve_name("." * level + name, package) if level else name
        if _is_of_user(name):
            return importlib.import_module(name)
        return sys.modules.get(name) or ModuleType(name)  # libraries count by name and version
    return None


def _attributes_of(module: Any, names: tuple[str, ...]) -> dict[str, Any]:
    """Return attributes of a module of the user by name, without those that it does not have."""
    if not inspect.ismodule(module) or not _is_of_user(module.__name__):
        return {}
    found = vars(module)
    return {f"{module.__name__}.{name}": found[name] for name in names if name in found}


def _followed(name: str, value: Any, attributes: tuple[str, ...]) -> tuple[str, Any]:
    """Return an attribute of the user's modules, and its name, after following its path."""
    for attribute in attributes:
        if not inspect.ismodule(value) or not _is_of_user(value.__name__):
            break
        if not hasattr(value, attribute):
            break
        name, value = f"{name}.{attribute}", getattr(value, attribute)
    return name, value


def _defaults_of(function: Any) -> dict[str, Any]:
    """Return the defaults of a function by the names of its arguments."""
    names = function.__code__.co_varnames[: function.__code__.co_argcount]
    values = function.__defaults__ or ()
    found = dict(zip(names[len(names) - len(values) :], values, strict=True))
    return found | (function.__kwdefaults__ or {})


def _enclosed_by(function: Any) -> dict[str, Any]:
    """Return the variables of enclosing functions to which a function refers by name."""
    values = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        try:
            values[name] = cell.cell_contents
        except ValueError:  # it is not set yet
            values[name] = None
    return values


def _members_of(kind: type) -> dict[str, Any]:
    """Return the functions and attributes of a class, without what Python adds to it."""
    return {
        name: one
        for name, one in vars(kind).items()
        if inspect.isfunction(one) or _is_wrapper(one) or not name.startswith("__")
    }


def _content_of_data(value: Any) -> tuple[str, Any]:
    """Return the kind of a value that is no function, and what identifies it."""
    if isinstance(value, CodeType):
        return "code", parts_of(value)
    if isinstance(value, property):
        return "property", (value.fget, value.fset, value.fdel)
    if isinstance(value, MemberDescriptorType):
        return "slot", value.__name__
    if isinstance(value, np.random.Generator):  # its seed, as its state changes with each draw
        seed: Any = value.bit_generator.seed_seq
        return "generator", (type(value.bit_generator), seed.entropy, seed.spawn_key)
    return _content_of_table(value) or _taken_apart(value)


def _content_of_table(value: Any) -> tuple[str, Any] | None:
    """Return what identifies arrays and tables of several libraries; None for other values."""
    kind = type(value)
    if isinstance(value, jax.Array):
        is_key = jnp.issubdtype(value.dtype, jax.dtypes.prng_key)
        array = np.asarray(jax.random.key_data(value) if is_key else value)
        return "array of JAX", (str(value.dtype), array)
    if kind is np.ndarray:  # of objects
        return "objects", (value.shape, value.tolist())
    if isinstance(value, xr.DataArray | xr.Dataset):  # without the accessors used so far
        return "xarray", value.to_dict(data="array")
    if isinstance(value, xr.DataTree):
        return "tree", {group.path: group.to_dataset(inherit=False) for group in value.subtree}
    if isinstance(value, pd.DataFrame):  # whose columns are stored together once it is used
        return "table", [value.index, *(column for _, column in value.items())]
    if isinstance(value, sparse.sparray | sparse.spmatrix):
        entries = sparse.coo_array(value)
        entries.sum_duplicates()
        return kind.__qualname__, (entries.shape, *entries.coords, entries.data)
    return None


def _taken_apart(value: Any) -> tuple[str, Any]:
    """Return how pickle takes an object apart, without its cached properties.

    An object that pickle refuses, such as a lock, is identified by its class.
    """
    kind = type(value)
    try:
        reduced = value.__reduce_ex__(4)
    except Exception:  # of many types
        return "class only", f"{kind.__module__}.{kind.__qualname__}"
    if isinstance(reduced, str):
        return "named", (kind, reduced)

    make, arguments, state, items, pairs = (*reduced, None, None, None)[:5]
    if isinstance(state, dict):
        left_out = {*cached_names(kind, lazy_property), "__doc__"}
        state = {name: one for name, one in state.items() if name not in left_out}
    return "object", (make, arguments, state, [*(items or ())], [*(pairs or ())])
