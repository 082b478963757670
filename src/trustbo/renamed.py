"""Names of an earlier version, which still work, with a warning."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from operator import attrgetter
from typing import Any


def former(old: str, module: str, name: str) -> Any:
    """Object that an earlier version had as `old`, from its module of today; FutureWarning."""
    message = f"{old} is {module}.{name} since version 0.3; the old name will go."
    warnings.warn(message, FutureWarning, stacklevel=3)
    return attrgetter(name)(import_module(module))


def moved(room: str, names: Mapping[str, Sequence[str]]) -> Callable[[str], object]:
    """Make the `__getattr__` of a room that was the place of names, by their modules of today."""

    def look_up(name: str) -> object:
        module = next((module for module, given in names.items() if name in given), None)
        if module is None:
            raise AttributeError(f"module {room!r} has no attribute {name!r}")
        return former(f"{room}.{name}", module, name)

    return look_up


class Former:
    """Attribute that an earlier version had: its value of today, with a FutureWarning."""

    def __init__(self, now: str, value: Callable[[Any], Any]) -> None:
        """Take the name of today, and a function of the object that has the attribute."""
        self._now, self._value = now, value

    def __set_name__(self, owner: type, name: str) -> None:
        self._old = f"{owner.__name__}.{name}"

    def __get__(self, instance: Any, owner: type) -> Any:
        if instance is None:
            return self
        message = f"{self._old} is {self._now} since version 0.3; the old name will go."
        warnings.warn(message, FutureWarning, stacklevel=2)
        return self._value(instance)
