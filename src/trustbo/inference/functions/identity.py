"""Identity of a function in files: its name, and hashes of its code and its constants."""

import ast
import functools
import hashlib
import inspect
import io
import json
import pickle
import textwrap
from collections.abc import Callable
from types import CodeType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from numpyro.distributions import Distribution
from numpyro.primitives import Messenger

from trustbo.models.model import TrustModel
from trustbo.models.record import model_to_record

_HASH_LENGTH = 16
"""Number of hexadecimal digits of a hash."""
_PROTOCOL = 4
"""Pickle protocol of the values that are hashed."""


def name_of(function: Any) -> str:
    """Return the name of a function, which may be wrapped by `functools.partial` or a handler."""
    if isinstance(function, functools.partial) and not hasattr(function, "__name__"):
        return name_of(function.func)
    if isinstance(function, Messenger) and function.fn is not None:
        return name_of(function.fn)
    return getattr(function, "__name__", type(function).__name__)


def fingerprint(function: Callable[..., Any]) -> str:
    """Return a hash of a function's code, without comments, and of the values it refers to.

    Values are defaults, variables of enclosing functions, and global variables. Modules, classes,
    and functions of other modules are identified by their names alone.
    """
    parts: list[str] = []
    _describe(function, parts, {})
    text = "\n".join(parts)
    return hashlib.sha256(text.encode()).hexdigest()[:_HASH_LENGTH]


def constants_of(function: Callable[..., Any]) -> dict[str, str]:
    """Return a short hash of each value that a function refers to, by name; see `fingerprint`.

    These values are arguments of `functools.partial`, defaults, variables of enclosing functions
    and global variables. Those of called functions of the same module are included.
    """
    found: dict[str, str] = {}
    _add_constants(function, found, set())
    return found


def _add_constants(function: Any, found: dict[str, str], seen: set[int]) -> None:
    """Add the values that a function refers to; `seen` contains the ids of earlier functions."""
    if id(function) in seen:
        return
    seen.add(id(function))

    values: dict[str, Any] = {}
    inner: list[Any] = []
    if isinstance(function, functools.partial):
        given = {f"argument {n}": value for n, value in enumerate(function.args)}
        values = {**given, **function.keywords}
        inner = [function.func]
    elif isinstance(function, Messenger):
        inner = [function.fn]
    elif inspect.ismethod(function):
        values = {"self": function.__self__}
        inner = [function.__func__]
    elif inspect.isfunction(function):
        values = _values_of(function)
    elif _is_wrapper(function):
        inner = [function.__wrapped__]

    for name, value in values.items():
        if inspect.isroutine(value) or _is_wrapper(value) or isinstance(value, functools.partial):
            inner.append(value)
            continue
        parts: list[str] = []
        _describe(value, parts, {})
        found.setdefault(name, hashlib.sha256("\n".join(parts).encode()).hexdigest()[:8])
    for one in inner:
        _add_constants(one, found, seen)


def _values_of(function: Any) -> dict[str, Any]:
    """Return the defaults, variables of enclosing functions and globals of a function by name."""
    parameters = inspect.signature(function, follow_wrapped=False).parameters.values()
    values = {one.name: one.default for one in parameters if one.default is not one.empty}
    code = function.__code__
    cells = function.__closure__ or ()
    values |= {n: content_of(cell) for n, cell in zip(code.co_freevars, cells, strict=True)}
    names = sorted(names_in(code) & set(function.__globals__))
    values |= {name: function.__globals__[name] for name in names if _is_own(function, name)}
    return values


def _describe(value: Any, parts: list[str], seen: dict[int, int]) -> None:
    """Add texts that identify a value to `parts`; `seen` numbers the functions so far."""
    if isinstance(value, TrustModel):
        parts.append(json.dumps(model_to_record(value), sort_keys=True))
    elif inspect.ismethod(value):
        _describe(value.__self__, parts, seen)
        _describe(value.__func__, parts, seen)
    elif inspect.isfunction(value):
        _describe_function(value, parts, seen)
    elif isinstance(value, functools.partial):
        for one in (value.func, value.args, value.keywords):
            _describe(one, parts, seen)
    elif isinstance(value, np.ndarray | jax.Array):
        is_key = isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key)
        array = np.asarray(jax.random.key_data(value) if is_key else value)
        if array.dtype.hasobject:  # its bytes are addresses in memory
            _describe(array.tolist(), parts, seen)
        else:
            digest = hashlib.sha256(array.tobytes()).hexdigest()
            parts.append(f"{array.dtype} {array.shape} {digest}")
    elif isinstance(value, list | tuple | dict):
        _describe_items(value, parts, seen)
    elif _is_wrapper(value) or isinstance(value, Distribution | Messenger):
        _describe_object(value, parts, seen)
    else:
        _describe_other(value, parts, seen)


def _describe_items(value: Any, parts: list[str], seen: dict[int, int]) -> None:
    """Describe the items of a list, a tuple or a dict."""
    parts.append(f"{type(value).__name__} {len(value)}")
    if isinstance(value, dict):
        parts.extend(map(str, value))
        value = value.values()
    for one in value:
        _describe(one, parts, seen)


def _describe_function(
    function: Callable[..., Any], parts: list[str], seen: dict[int, int]
) -> None:
    """Describe the code of a function and the values that it refers to."""
    if id(function) in seen:  # a recursive function, or a function that is used twice
        parts.append(f"function {seen[id(function)]}")
        return

    seen[id(function)] = len(seen)
    parts.append(_code_of(function))
    defaults = function.__defaults__ or ()
    by_keyword = function.__kwdefaults__ or {}
    enclosed = [content_of(cell) for cell in function.__closure__ or ()]
    for one in (*defaults, *by_keyword.values(), *enclosed):
        _describe(one, parts, seen)
    for name in sorted(names_in(function.__code__)):
        _describe_global(function, name, parts, seen)


def names_in(code: CodeType) -> set[str]:
    """Return the names of globals and attributes in a code, including its inner functions."""
    inner = [names_in(one) for one in code.co_consts if isinstance(one, CodeType)]
    return {*code.co_names}.union(*inner)


def _describe_global(
    function: Callable[..., Any], name: str, parts: list[str], seen: dict[int, int]
) -> None:
    """Describe a global variable that a function refers to; see `fingerprint`."""
    if name not in function.__globals__ or not _is_own(function, name):
        return

    value = function.__globals__[name]
    if not _is_function(value):
        parts.append(name)
    _describe(value, parts, seen)


def _is_own(function: Any, name: str) -> bool:
    """Return whether a global is a value, or a function of the same module as `function`."""
    value = function.__globals__[name]
    if inspect.ismodule(value) or inspect.isclass(value):
        return False
    return not _is_function(value) or getattr(value, "__module__", None) == function.__module__


def _is_function(value: Any) -> bool:
    """Return whether a value is a function, or wraps one."""
    return inspect.isroutine(value) or _is_wrapper(value)


def _is_wrapper(value: Any) -> bool:
    """Return whether a value wraps a function, such as `jax.jit`."""
    return not isinstance(value, type) and callable(getattr(value, "__wrapped__", None))


def _describe_object(value: Any, parts: list[str], seen: dict[int, int]) -> None:
    """Describe an object by its class and attributes, and by the function that it wraps."""
    parts.append(_kind_of(value))
    if _is_wrapper(value):
        _describe(value.__wrapped__, parts, seen)
    attributes = vars(value) if hasattr(value, "__dict__") else {}
    _describe({n: v for n, v in attributes.items() if not n.startswith("__")}, parts, seen)


def _describe_other(value: Any, parts: list[str], seen: dict[int, int]) -> None:
    """Describe a value by its pickle or, if it cannot be pickled, by its attributes.

    Pickle refers to the class of an object by name, so the code of `__call__` is added.
    """
    content = io.BytesIO()
    try:  # the text must be the same in other processes
        _Pickler(content, protocol=_PROTOCOL).dump(value)
        parts.append(hashlib.sha256(content.getvalue()).hexdigest())
    except Exception:
        _describe_attributes(value, parts, seen)

    call = getattr(type(value), "__call__", None)  # noqa: B004
    if inspect.isfunction(call):
        _describe(call, parts, seen)


def _describe_attributes(value: Any, parts: list[str], seen: dict[int, int]) -> None:
    """Describe an object by its class and attributes; without attributes, such as a lock, by class.

    An attribute that cannot be pickled, such as `jnp.tanh` or a lambda, must not hide the others.
    """
    if id(value) in seen:  # an object that refers to itself
        parts.append(f"object {seen[id(value)]}")
        return

    seen[id(value)] = len(seen)
    parts.append(_kind_of(value))
    cached = _cached_names(type(value))
    attributes = {name: one for name, one in _attributes_of(value).items() if name not in cached}
    _describe(attributes, parts, seen)


def _attributes_of(value: Any) -> dict[str, Any]:
    """Return the attributes of an object by name, including those in slots."""
    slots = [getattr(kind, "__slots__", ()) for kind in type(value).__mro__]
    names = [name for some in slots for name in ([some] if isinstance(some, str) else some)]
    of_slots = {name: getattr(value, name) for name in sorted(names) if hasattr(value, name)}
    return {**of_slots, **getattr(value, "__dict__", {})}


def _cached_names(kind: type) -> set[str]:
    """Return the names of the attributes in which a class caches properties."""
    return {
        name
        for base in kind.__mro__
        for name, one in vars(base).items()
        if isinstance(one, functools.cached_property)
    }


class _Pickler(pickle.Pickler):
    """Pickler whose output depends neither on the process nor on earlier uses of the objects.

    The order of strings in a set differs between processes, so the items of a set are stored in the
    order of their texts. Values of `functools.cached_property` and the accessors of xarray are left
    out, because an object, such as a workspace, has them only after its first use.
    """

    def persistent_id(self, value: Any) -> Any:
        """Return the replacement of a set; None for other values."""
        return _sorted_texts(value) if isinstance(value, set | frozenset) else None

    def reducer_override(self, value: Any) -> Any:
        """Return how an object is stored without cached values, if its class has any."""
        if isinstance(value, xr.DataArray | xr.Dataset):
            return dict, (value.to_dict(data="array"),)

        cached = _cached_names(type(value))
        if not cached:
            return NotImplemented

        reduced = value.__reduce_ex__(_PROTOCOL)
        if isinstance(reduced, str) or len(reduced) < 3 or not isinstance(reduced[2], dict):
            return reduced
        state = {name: one for name, one in reduced[2].items() if name not in cached}
        return (*reduced[:2], state, *reduced[3:])


def _sorted_texts(items: set[Any] | frozenset[Any]) -> list[str]:
    """Return the texts of the items of a set, sorted; see `_describe`."""
    texts = []
    for one in items:
        parts: list[str] = []
        _describe(one, parts, {})
        texts.append("\n".join(parts))
    return sorted(texts)


def _code_of(function: Callable[..., Any]) -> str:
    """Return the code of a function without comments, or its byte code if there is no source.

    Lambdas have no source of their own, because several can be in one line.
    """
    if function.__name__ == "<lambda>":
        return _byte_code_of(function.__code__)
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    except (OSError, TypeError, SyntaxError):
        return _byte_code_of(function.__code__)
    return ast.unparse(tree)


def _byte_code_of(code: CodeType) -> str:
    """Return a byte code as text, which is the same in all processes."""
    constants = [_constant(one) for one in code.co_consts]
    return f"{code.co_code.hex()} {constants} {code.co_names!r}"


def _constant(value: Any) -> str:
    """Return a constant of a byte code as text, which is the same in all processes."""
    if isinstance(value, CodeType):
        return _byte_code_of(value)
    if isinstance(value, tuple):
        return f"({', '.join(map(_constant, value))})"
    if isinstance(value, frozenset):
        return f"{{{', '.join(sorted(map(_constant, value)))}}}"
    return repr(value)


def content_of(cell: Any) -> Any:
    """Return the value of a variable of an enclosing function, or None if it is not set."""
    try:
        return cell.cell_contents
    except ValueError:
        return None


def _kind_of(value: Any) -> str:
    """Return the module and name of the class of a value."""
    return f"{type(value).__module__}.{type(value).__qualname__}"
