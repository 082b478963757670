"""The inputs that a NumPyro function takes, read from the names of its parameters."""

import inspect
from collections.abc import Callable
from difflib import get_close_matches
from typing import Any

from numpyro.primitives import Messenger

from trustbo.display import joined
from trustbo.errors import TrustboError, warn
from trustbo.inference.functions.data import NAMES, RATES

_ALIKE = 0.85
"""Similarity (`difflib`) of a parameter to the name of an input from which a warning is issued."""


def inputs_of(function: Callable[..., Any], name: str) -> tuple[str, ...]:
    """Return the names of a function's inputs; raise TrustboError if they are wrong."""
    inner: Any = function
    while isinstance(inner, Messenger):  # such as `handlers.reparam`
        inner = inner.fn
    parameters = inspect.signature(inner).parameters
    takes = tuple(one for one in parameters if one in NAMES)
    if "observations" not in takes:
        for needed in ("awareness", RATES):
            if needed not in takes:
                raise TrustboError(
                    f"the function {name} must have the parameters awareness and contact_rate; "
                    f"got {name}({', '.join(parameters)}). Other inputs are "
                    f"{joined([one for one in NAMES if one not in ('awareness', RATES)])}."
                )

    unknown = [
        one.name
        for one in parameters.values()
        if one.name not in NAMES
        and one.default is one.empty
        and one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)
    ]
    if unknown:
        raise TrustboError(
            f"the parameter {unknown[0]!r} of the function {name} is not an input of a model; the "
            f"inputs are {joined(list(NAMES))}. Give it a default, or use functools.partial."
        )

    others = [one for one in NAMES if one not in takes]
    for parameter in parameters:
        alike = [] if parameter in takes else get_close_matches(parameter, others, 1, _ALIKE)
        if alike:
            warn(
                f"the parameter {parameter!r} of the function {name} is not an input of a model "
                f"and keeps its default; rename it if the input {alike[0]!r} is meant."
            )
    return takes
