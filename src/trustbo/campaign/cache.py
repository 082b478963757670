"""Properties that are cached until the missions of a campaign change."""

from collections.abc import Callable
from typing import Any, Self, overload

from trustbo.fixed import marked


class computed[T]:  # noqa: N801  (used as a decorator, like `property`)
    """Property that is computed on first access, one thread at a time; maps are read-only.

    The object needs two attributes: `_turn`, a reentrant lock between threads, and `_computed`, a
    dictionary of the values. To compute all properties again, clear this dictionary.
    """

    def __init__(self, compute: Callable[[Any], T]) -> None:
        self._compute = compute
        self._name = compute.__name__
        self.__doc__ = compute.__doc__

    @overload
    def __get__(self, instance: None, owner: type) -> Self: ...
    @overload
    def __get__(self, instance: object, owner: type) -> T: ...
    def __get__(self, instance: Any, owner: type) -> Self | T:
        """Return the value for an object."""
        if instance is None:
            return self
        with instance._turn:
            if self._name not in instance._computed:
                instance._computed[self._name] = marked(self._compute(instance))
            return instance._computed[self._name]
