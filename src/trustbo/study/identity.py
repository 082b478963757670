"""Hashes of cases and scenes, by which stored runs of other code or values are recognised."""

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import xarray as xr
from joblib.hashing import NumpyHasher

from trustbo.campaign.result import Result
from trustbo.errors import TrustboError


def identity_of(name: str, value: Any) -> str:
    """Return a hash of a named case or scene, and of all values and code to which it refers.

    Functions and classes of the user's files are identified by their byte code, which has no
    comments, and those of installed packages by their names and the values that they enclose.

    Raises:
        TrustboError: A value cannot be pickled.
    """
    try:
        return str(_Hasher("sha256").hash((name, value)))
    except Exception as error:  # pickling may raise any error
        raise TrustboError(
            f"{name!r} contains a value that cannot be compared with stored runs "
            f"({type(error).__name__}: {error}); make such values in the function of the scene."
        ) from error


class _Hasher(NumpyHasher):
    """Hasher of joblib that also covers code, and leaves out what objects cache after a use."""

    def reducer_override(self, value: Any) -> Any:
        """Return how a value is stored, in the form of `__reduce__`."""
        if isinstance(value, ModuleType):
            return str, (value.__name__,)
        if isinstance(value, CodeType):
            return list, ([value.co_code, value.co_names, value.co_consts],)
        if isinstance(value, frozenset):  # such as a constant; the order differs between processes
            return list, (sorted(value, key=repr),)
        if isinstance(value, Result):
            return list, (value.missions,)
        if isinstance(value, xr.DataArray | xr.Dataset):  # without what accessors have cached
            return dict, (value.to_dict(data="array"),)
        if isinstance(value, FunctionType | type) and _is_editable(value):
            return str, (value.__qualname__,), _used_by(value)
        if isinstance(value, FunctionType):
            return str, (f"{value.__module__}.{value.__qualname__}",), _enclosed(value)

        wrapped = getattr(value, "__wrapped__", None)  # such as that of `jax.jit`
        return _without_cache(value) if wrapped is None else (list, ([type(value), wrapped],))


def _is_editable(value: Callable[..., Any]) -> bool:
    """Return whether a function or class is of a file or notebook of the user."""
    module = value.__module__ or "__main__"
    package = module.partition(".")[0]
    file = getattr(sys.modules.get(module), "__file__", None) or ""
    is_installed = not {"site-packages", "dist-packages"}.isdisjoint(Path(file).parts)
    is_known = is_installed or package in {"trustbo", *sys.stdlib_module_names}
    return module == "__main__" or not is_known


def _used_by(value: Any) -> list[Any]:
    """Return the code and the values to which a function, or the functions of a class, refer."""
    if isinstance(value, type):
        constants = {
            name: one
            for name, one in vars(value).items()
            if isinstance(one, int | float | str) and not name.startswith("__")
        }
        functions = [one for one in vars(value).values() if isinstance(one, FunctionType)]
        return [value.__bases__, constants, functions]

    names = sorted(_names_in(value.__code__) & set(value.__globals__))
    of_globals = {name: value.__globals__[name] for name in names}
    defaults = (value.__defaults__, value.__kwdefaults__)
    return [value.__code__, defaults, _enclosed(value), of_globals]


def _enclosed(function: FunctionType) -> list[Any]:
    """Return the values of the variables of the functions that enclose a function."""
    return [cell.cell_contents for cell in function.__closure__ or ()]


def _names_in(code: CodeType) -> set[str]:
    """Return the names of globals and attributes in a code, including its inner functions."""
    inner = [_names_in(one) for one in code.co_consts if isinstance(one, CodeType)]
    return {*code.co_names}.union(*inner)


def _without_cache(value: Any) -> Any:
    """Reduce an object without its values of `functools.cached_property`, if its class has any."""
    kind = type(value)
    cached = {
        name
        for base in kind.__mro__
        for name, one in vars(base).items()
        if isinstance(one, functools.cached_property)
    }
    if not cached:
        return NotImplemented

    make, arguments, state, *_ = value.__reduce_ex__(2)
    return make, arguments, {name: one for name, one in state.items() if name not in cached}
