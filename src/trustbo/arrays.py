"""Checks of arrays and names that a user gives."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from trustbo.errors import ShapeError, TrustboError

_RATING = 10.0  # largest value that may be an answer on a scale from 1


def as_array(what: str, values: ArrayLike) -> np.ndarray:
    """Return an array of floats; ShapeError if these are no numbers."""
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise ShapeError(f"{what} must be an array of numbers; got {values!r}.") from None


def as_names(what: str, given: Iterable[str]) -> tuple[str, ...]:
    """Names as a tuple; TrustboError where one is no text, or repeated."""
    listed = isinstance(given, Iterable) and not isinstance(given, str)
    names = tuple(given) if listed else ()
    if not listed or not all(isinstance(name, str) for name in names):
        raise TrustboError(f"{what} must be a list of names; got {given!r:.60}.")
    if len(set(names)) < len(names):
        raise TrustboError(f"{what} must be distinct names; got {names}.")
    return names


def require_unit_interval(what: str, values: np.ndarray) -> None:
    """Refuse values outside [0, 1], except NaN: TrustboError."""
    bad = (values < 0.0) | (values > 1.0)
    if bad.any():
        index = ", ".join(str(i) for i in np.argwhere(bad)[0])
        rating = (
            "; rating from 1 to n? (rating - 1) / (n - 1)" if np.nanmax(values) <= _RATING else ""
        )
        hint = f" (percent? divide by 100{rating})" if np.nanmin(values) >= 0.0 else ""
        raise TrustboError(f"{what}: [{index}] = {values[bad][0]:g} is outside [0, 1]{hint}.")
