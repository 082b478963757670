"""Names of version 0.2 that have moved: they still work, with a warning."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module


def moved(room: str, names: Mapping[str, Sequence[str]]) -> Callable[[str], object]:
    """Make the `__getattr__` of a module for names that it had, listed by their new modules."""

    def find(name: str) -> object:
        module = next((module for module, given in names.items() if name in given), None)
        if module is None:
            raise AttributeError(f"module {room!r} has no attribute {name!r}")
        message = f"{room}.{name} is {module}.{name} since version 0.3; the old name will go."
        warnings.warn(message, FutureWarning, stacklevel=2)
        return getattr(import_module(module), name)

    return find
