"""Checks of arrays and names that a user gives."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.errors import TrustboError

_RATING = 10.0  # largest value that may be an answer on a scale from 1


def as_array(what: str, values: ArrayLike) -> np.ndarray:
    """Return an array of floats; TrustboError if these are no numbers."""
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise TrustboError(f"{what} must be an array of numbers; got {values!r}.") from None


def in_order(what: str, values: Any, dims: Sequence[str], **names: Sequence[str]) -> Any:
    """Values in the order of dims, and of the names of some, where these are labelled.

    Labels are the dims and coordinates of a DataArray, or the columns of a DataFrame that are
    texts, of the last dim. TrustboError: labels that are not these names.
    """
    if isinstance(values, pd.DataFrame) and all(isinstance(name, str) for name in values):
        values = xr.DataArray(values.to_numpy(), dims=dims, coords={dims[-1]: list(values)})
    if not isinstance(values, xr.DataArray):
        return values
    if {*values.dims} != {*dims}:
        raise TrustboError(f"{what} must have the dims {tuple(dims)}; got {values.dims}.")
    for dim, given in names.items():
        there = [str(name) for name in values[dim].values] if dim in values.coords else []
        if there and given and sorted(there) != sorted(given):
            raise TrustboError(f"{what} has the {dim}s {there}, not {list(given)}.")
        if there and given:
            values = values.isel({dim: [there.index(name) for name in given]})
    return values.transpose(*dims)


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
