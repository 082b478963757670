"""Identity of functions and other values in files: hashes of their code and their constants."""

import ast
import functools
import inspect
import sys
import textwrap
from collections.abc import Callable, Mapping
from operator import attrgetter
from pathlib import Path
from types import CodeType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from joblib.hashing import NumpyHasher
from numba.core.dispatcher import Dispatcher
from numpyro.distributions.util import lazy_property
from numpyro.primitives import Messenger

_HASH_LENGTH = 16
"""Number of hexadecimal digits of a hash."""
_PLAIN = (type(None), bool, int, float, complex, str, bytes, list, tuple, dict)
"""Kinds of values that joblib hashes by their items."""


def name_of(function: Any) -> str:
    """Return the name of a function, which may be wrapped by `functools.partial` or a handler."""
    inner = _inner_of(function)
    return getattr(function, "__name__", getattr(inner, "__name__", type(inner).__name__))


def fingerprint(value: Any, parts: Mapping[type, Callable[[Any], Any]] | None = None) -> str:
    """Return a hash of a value, and of all code, without comments, and values it refers to.

    A function refers to its defaults, to variables of enclosing functions and to global variables.
    Functions and classes are followed into if they are of the user's files and notebooks, or of the
    module of `value`. Those of other installed packages are identified by their names, and by the
    variables of enclosing functions. Modules are identified by their names, and what pickle
    refuses, such as a lock, by its class. Other values are hashed by joblib.

    Args:
        value: A function, or any other value.
        parts: Functions that return what identifies an object, by the class of the object.
    """
    return _Hasher(value, parts or {}).digest


def constants_of(function: Callable[..., Any]) -> dict[str, str]:
    """Return a short hash of each value that a function refers to, by name; see `fingerprint`.

    These values are arguments of `functools.partial`, defaults, variables of enclosing functions
    and global variables. Those of the functions that `fingerprint` follows into are included.
    """
    constants = _Hasher(function, {}).constants
    return {name: fingerprint(value)[:8] for name, value in constants.items()}


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


class _Hasher(NumpyHasher):
    """Hasher of joblib that reads the code of functions, and what pickle refuses or changes.

    The hash depends neither on the process nor on earlier uses of the objects. Nothing that it
    writes is ever unpickled.

    Attributes:
        digest: Hash of the value.
        constants: Values to which its functions refer, by name.
    """

    def __init__(self, value: Any, parts: Mapping[type, Callable[[Any], Any]]) -> None:
        """Hash a value, and then the functions and classes to which it refers, one by one."""
        super().__init__("sha256")
        self.constants: dict[str, Any] = {}
        self._parts = parts
        self._module = getattr(_inner_of(value), "__module__", None)
        self._found: list[Any] = []

        self.dump(value)
        for one in self._found:  # which grows
            self.dump(self._contents_of(one))
        self._hash.update(self.stream.getvalue())
        self.digest = self._hash.hexdigest()[:_HASH_LENGTH]

    def save(self, obj: Any) -> None:
        """Write a value; methods are written as their functions and objects."""
        if inspect.ismethod(obj):
            self._note({"self": obj.__self__})
            obj = obj.__func__, obj.__self__
        super().save(obj)

    def reducer_override(self, obj: Any) -> Any:
        """Return what is written for a value: a text and further values; see `pickle`."""
        if type(obj) in _PLAIN or obj is str:
            return NotImplemented
        for kind, part_of in self._parts.items():
            if isinstance(obj, kind):
                return str, (kind.__name__,), part_of(obj)

        if inspect.isfunction(obj) or inspect.isclass(obj):
            return str, (self._reference_to(obj),)
        if inspect.ismodule(obj):
            return str, (obj.__name__,)
        if isinstance(obj, functools.partial):
            self._note({f"argument {n}": one for n, one in enumerate(obj.args)} | obj.keywords)
            return str, ("partial",), (obj.func, obj.args, obj.keywords)
        if isinstance(obj, Dispatcher):  # of numba, whose attributes are changed by a call
            return str, ("compiled",), obj.py_func
        if _is_wrapper(obj):
            attributes = {n: one for n, one in vars(obj).items() if not n.startswith("__")}
            return str, ("wrapper",), (type(obj), obj.__wrapped__, attributes)
        if isinstance(obj, set | frozenset):  # whose order differs between processes
            return str, ("set",), sorted(fingerprint(one, self._parts) for one in obj)
        return _of_data(obj)

    def _reference_to(self, value: Any) -> str:
        """Return a name for a function or class, whose contents may be written later."""
        is_named = inspect.isclass(value) or _is_importable(value)
        if is_named and not self._is_own(value.__module__):
            return f"{value.__module__}.{value.__qualname__}"

        found = [k for k, one in enumerate(self._found) if one is value]
        if not found:
            self._found.append(value)
        return f"function or class {found[0] if found else len(self._found) - 1}"

    def _is_own(self, module: str | None) -> bool:
        """Return whether functions and classes of a module are followed into."""
        return module == self._module or _is_of_user(module)

    def _contents_of(self, value: Any) -> tuple[Any, ...]:
        """Return what identifies a function or class that has more than a name."""
        if inspect.isclass(value):
            return value.__qualname__, value.__bases__, _members_of(value)

        # A wrapper that a package puts around a function has the module of this function.
        is_own = self._is_own(value.__globals__.get("__name__"))
        values = _values_of(value) if is_own else _enclosed_by(value)
        self._note(values)
        return _code_of(value) if is_own else value.__qualname__, values

    def _note(self, values: dict[str, Any]) -> None:
        """Add values to the constants, except for functions, classes and modules."""
        for name, one in values.items():
            is_named = inspect.isroutine(one) or inspect.isclass(one) or inspect.ismodule(one)
            if not (is_named or _is_wrapper(one) or isinstance(one, functools.partial)):
                self.constants.setdefault(name, one)


@functools.cache
def _is_of_user(module: str | None) -> bool:
    """Return whether a module is a file or notebook of the user, and not of a package."""
    if module is None or module == "__main__":
        return True

    package = module.partition(".")[0]
    if package in {"trustbo", *sys.stdlib_module_names}:
        return False

    # Modules inside of a compiled library have no file.
    files = [getattr(sys.modules.get(name), "__file__", None) for name in (module, package)]
    folders = {part for file in files for part in Path(file or "").parts}
    return folders.isdisjoint({"site-packages", "dist-packages"})


def _is_importable(function: Any) -> bool:
    """Return whether a function is what its module has under the name of the function."""
    try:
        return attrgetter(function.__qualname__)(sys.modules.get(function.__module__)) is function
    except AttributeError:
        return False


def _of_data(value: Any) -> Any:
    """Return what is written for a value that is no function; see `_Hasher.reducer_override`."""
    if isinstance(value, CodeType):
        return str, (value.co_code.hex(),), (value.co_names, value.co_consts)
    if isinstance(value, property):
        return str, ("property",), (value.fget, value.fset, value.fdel)
    if isinstance(value, jax.Array):
        is_key = jnp.issubdtype(value.dtype, jax.dtypes.prng_key)
        return str, ("array",), np.asarray(jax.random.key_data(value) if is_key else value)
    if isinstance(value, np.ndarray):  # of objects; others do not come here
        return str, ("objects",), value.tolist()
    if isinstance(value, xr.DataArray | xr.Dataset):  # without the accessors used so far
        return str, ("xarray",), value.to_dict(data="array")
    return _taken_apart(value)


def _taken_apart(value: Any) -> Any:
    """Return how pickle takes an object apart, without its cached properties.

    An object that pickle refuses, such as a lock, is identified by its class.
    """
    kind = type(value)
    try:
        reduced = value.__reduce_ex__(4)
    except Exception:  # of many types
        return str, (f"{kind.__module__}.{kind.__qualname__}",)
    if isinstance(reduced, str):
        return str, (f"{kind.__qualname__} {reduced}",)
    if len(reduced) < 3 or not isinstance(reduced[2], dict):
        return reduced

    cached = {
        name
        for base in kind.__mro__
        for name, one in vars(base).items()
        if isinstance(one, functools.cached_property | lazy_property)
    }
    state = {name: one for name, one in reduced[2].items() if name not in cached}
    return (*reduced[:2], state, *reduced[3:])


def _values_of(function: Any) -> dict[str, Any]:
    """Return the defaults, variables of enclosing functions and globals of a function by name."""
    parameters = inspect.signature(function, follow_wrapped=False).parameters.values()
    defaults = {one.name: one.default for one in parameters if one.default is not one.empty}
    of_globals = {
        name: function.__globals__[name]
        for name in sorted(_names_in(function.__code__))
        if name in function.__globals__
    }
    return defaults | _enclosed_by(function) | of_globals


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
        if inspect.isfunction(one) or not name.startswith("__")
    }


def _names_in(code: CodeType) -> set[str]:
    """Return the names of globals and attributes in a code, including its inner functions."""
    inner = [_names_in(one) for one in code.co_consts if isinstance(one, CodeType)]
    return {*code.co_names}.union(*inner)


def _code_of(function: Callable[..., Any]) -> str | CodeType:
    """Return the code of a function without comments, or its byte code if there is no source.

    Lambdas have no source of their own, because several can be in one line.
    """
    if function.__name__ == "<lambda>":
        return function.__code__
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    except (OSError, TypeError, SyntaxError):
        return function.__code__
    return ast.unparse(tree)
