"""Values that cannot be changed in place, as others are computed from them and kept.

NumPy marks arrays as read-only, but pickles and deep copies lose the mark, and xarray's messages
name no remedy. Objects that hold fixed values derive from `Fixed`.
"""

import dataclasses
from functools import cached_property
from typing import Any, ClassVar, NoReturn

import numpy as np
import xarray as xr

from trustbo.errors import TrustboError

_COPY = "change a copy, as from .copy(), and make a new object with dataclasses.replace"


def fixed_array(values: np.ndarray) -> np.ndarray:
    """Return a read-only array: the array itself if nobody can change it, else a copy."""
    if _is_fixed(values):
        return values
    return mark(values.copy())


def mark(values: np.ndarray) -> np.ndarray:
    """Mark a new array, to which there is no other reference, as read-only, and return it."""
    values.flags.writeable = False
    return values


def marked[T](value: T) -> T:
    """Mark the arrays of new maps of xarray as read-only, and return the maps; else the value."""
    variables: list[Any] = []
    if isinstance(value, xr.DataArray):
        variables = [value]
    elif isinstance(value, xr.Dataset):
        variables = [*value.data_vars.values()]
    for variable in variables:
        mark(variable.values)
    return value


def _is_fixed(values: Any) -> bool:
    """Return whether an array and the arrays of which it is a view are read-only."""
    while isinstance(values, np.ndarray):
        if values.flags.writeable:
            return False
        values = values.base
    return True


class FixedArray(xr.DataArray):
    """DataArray of a workspace; assignment to read-only values is refused with the remedy.

    What is computed from it is of this class too, but can be changed.
    """

    __slots__ = ()

    def __setitem__(self, key: Any, value: Any) -> None:
        if not isinstance(key, str) and not self.variable.values.flags.writeable:
            raise TrustboError(
                f"{self.name or 'the array'} is read-only, as plans are computed from it; close "
                "cells and bounds with workspace.closing(...), or change a copy, as from .copy(), "
                "and make a workspace with Workspace.from_awareness."
            )
        super().__setitem__(key, value)

    def __reduce__(self) -> Any:
        """Without what xarray fills in when the array is used."""
        return _array_from, (self.to_dict(data="array"),)


class FixedMaps(xr.Dataset):
    """Dataset of a workspace, whose variables cannot be replaced; copies of it can be changed."""

    __slots__ = ()

    @classmethod
    def _construct_direct(cls, *arguments: Any, **options: Any) -> Any:
        """Make what is computed from it an ordinary Dataset."""
        return xr.Dataset._construct_direct(*arguments, **options)

    def __setitem__(self, key: Any, value: Any) -> NoReturn:
        self._refuse()

    def __delitem__(self, key: Any) -> NoReturn:
        self._refuse()

    def update(self, other: Any) -> NoReturn:
        """Refuse the change."""
        self._refuse()

    def __reduce__(self) -> Any:
        """Without what xarray fills in when the maps are used."""
        return _maps_from, (self.to_dict(data="array"), dict(self.encoding))

    def _refuse(self) -> NoReturn:
        raise TrustboError(
            "the maps of a workspace are read-only, as posts and sight are computed from them; "
            "change a copy of the terrain, as from .copy(deep=True), and make a workspace with "
            "Workspace.from_terrain."
        )


class FixedDict(dict[Any, Any]):
    """Dict that cannot be changed; `|` returns an ordinary dict."""

    def _refuse(self, *arguments: Any, **options: Any) -> NoReturn:
        raise TrustboError(
            "this dict belongs to an object that plans are computed from, and is read-only; name "
            f"places with workspace.with_places(...), or {_COPY}."
        )

    __setitem__: Any = _refuse
    __delitem__: Any = _refuse
    __ior__: Any = _refuse
    clear: Any = _refuse
    pop: Any = _refuse
    popitem: Any = _refuse
    setdefault: Any = _refuse
    update: Any = _refuse

    def __reduce__(self) -> Any:
        return FixedDict, (dict(self),)

    def __deepcopy__(self, memo: Any) -> "FixedDict":
        return self  # names, and frozen values


def fix(value: Any) -> Any:
    """Return a value that cannot be changed in place: read-only, copied where necessary.

    Arrays, also of xarray, dicts and tuples of arrays are made read-only. Other values, such as
    frozen dataclasses, are returned as they are.
    """
    if isinstance(value, np.ndarray):
        return fixed_array(value)
    if isinstance(value, xr.DataArray):
        return _array_of(value)
    if isinstance(value, xr.Dataset):
        return _maps_of(value)
    if type(value) is dict:
        return FixedDict(value)
    if isinstance(value, tuple) and any(isinstance(one, np.ndarray) for one in value):
        fixed = map(fix, value)
        return type(value)(*fixed) if hasattr(value, "_fields") else tuple(fixed)
    return value


def _fixed_variable(variable: xr.Variable) -> xr.Variable:
    """Return a variable of xarray with read-only values."""
    return variable.copy(deep=False, data=fixed_array(variable.values))


def _array_of(array: xr.DataArray) -> xr.DataArray:
    """Return a DataArray with read-only values, which refuses assignment."""
    if isinstance(array, FixedArray) and _is_fixed(array.values):
        return array
    return FixedArray(fixed_array(array.values), array.coords, array.dims, array.name, array.attrs)


def _maps_of(maps: xr.Dataset) -> xr.Dataset:
    """Return a Dataset with read-only values, which refuses other variables."""
    if isinstance(maps, FixedMaps) and all(_is_fixed(v.values) for v in maps.variables.values()):
        return maps

    variables = {name: _fixed_variable(v) for name, v in maps.data_vars.variables.items()}
    fixed = FixedMaps(variables, maps.coords, maps.attrs)
    fixed.encoding = maps.encoding
    return fixed


def _array_from(parts: dict[str, Any]) -> xr.DataArray:
    """Return a read-only DataArray from its pickle."""
    return _array_of(xr.DataArray.from_dict(parts))


def _maps_from(parts: dict[str, Any], encoding: dict[str, Any]) -> xr.Dataset:
    """Return a read-only Dataset from its pickle."""
    maps = xr.Dataset.from_dict(parts)
    maps.encoding = encoding
    return _maps_of(maps)


def cached_names(kind: type, *kinds: type) -> set[str]:
    """Return the names of cached properties of a class, also those of other `kinds`."""
    return {
        name
        for base in kind.__mro__
        for name, one in vars(base).items()
        if isinstance(one, (cached_property, *kinds))
    }


class Uncached:
    """Base class of objects whose pickles leave out what cached properties have computed."""

    __slots__ = ()

    def __getstate__(self) -> dict[str, Any]:
        cached = cached_names(type(self))
        return {name: value for name, value in vars(self).items() if name not in cached}


class Fixed:
    """Base class of frozen dataclasses whose fields cannot be changed in place.

    Pickles and copies hold the fields only: what is computed from them and kept in the object is
    computed again, so that an object has the same pickle before and after use.
    """

    __slots__ = ()
    __dataclass_fields__: ClassVar[dict[str, Any]]

    def _fix(self) -> None:
        """Make the values of the fields read-only; call it in `__post_init__`."""
        for one in dataclasses.fields(self):
            object.__setattr__(self, one.name, fix(getattr(self, one.name)))

    def __getstate__(self) -> dict[str, Any]:
        return {one.name: getattr(self, one.name) for one in dataclasses.fields(self)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            object.__setattr__(self, name, value)
        self._fix()
