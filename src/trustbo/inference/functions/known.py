"""Models of the NumPyro functions that were used in this process."""

from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any

from trustbo.display import joined
from trustbo.errors import TrustboError
from trustbo.inference.functions.function import KIND, FunctionModel

_MOST_KNOWN = 64
"""Number of functions that are remembered, together with their compiled code."""
_OF_RECORD = "constants", "versions"
"""Entries of a record of a function that are compared by name."""
_KNOWN: OrderedDict[str, FunctionModel] = OrderedDict()
"""Models of functions by fingerprint, with the most recently used model last."""


def as_model(function: Callable[..., Any] | FunctionModel) -> FunctionModel:
    """Return the model of a function; the same function always gives the same model.

    Raises TrustboError if the function cannot be a model; see `FunctionModel`.
    """
    model = function if isinstance(function, FunctionModel) else FunctionModel(function)
    known = _KNOWN.get(model.fingerprint)
    if known is not None and known.function == model.function:
        model = known

    _KNOWN[model.fingerprint] = model
    _KNOWN.move_to_end(model.fingerprint)
    if len(_KNOWN) > _MOST_KNOWN:
        _KNOWN.popitem(last=False)
    return model


def model_of_record(
    record: Mapping[str, Any], given: Callable[..., Any] | FunctionModel | None = None
) -> FunctionModel:
    """Return the model that a record describes, if it is given or was used in this process.

    Raises:
        TrustboError: If the function is not known, or if a different one is given.
    """
    if given is not None:
        model = as_model(given)
        if model.record() != dict(record):
            raise TrustboError(
                f"the posterior is of the function {record['name']!r} with the hash "
                f"{record['sha256']}, not of {model.name!r} with the hash {model.fingerprint}"
                f"{_difference(model, record)}. Give the same function, with the same constants, "
                "or fit again."
            )
        return model

    model = _KNOWN.get(record["sha256"])
    if model is None:
        raise TrustboError(
            f"the posterior is of the NumPyro function {record['name']!r}, which is not stored; "
            "give it with model=."
        )
    return model


def _difference(model: FunctionModel, record: Mapping[str, Any]) -> str:
    """State which constants or versions differ from those in a record, or that the code does."""
    if model.name != record["name"]:
        return ""

    names, libraries = (_names_of_changed(model.record(), record, of) for of in _OF_RECORD)
    if libraries and not names:
        return f", as the versions of {joined(libraries)} differ"
    if not names:
        return ", whose code or use of functools.partial differs"
    is_are = "constant" if len(names) == 1 else "constants"
    return f", whose {is_are} {joined(names)} differ{'s' if len(names) == 1 else ''}"


def _names_of_changed(own: Mapping[str, Any], stored: Mapping[str, Any], of: str) -> list[str]:
    """Return the names of the constants or versions that differ between two records."""
    values = own[of], stored.get(of, {})
    names = sorted({**values[0], **values[1]})
    return [name for name in names if values[0].get(name) != values[1].get(name)]


def is_of_function(record: Mapping[str, Any]) -> bool:
    """Return whether a record describes a model that is a function."""
    return record["class"] == KIND
