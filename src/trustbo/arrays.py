"""Read arrays of numbers by their dims and labels, from NumPy, xarray, pandas or a dict.

Every argument that may carry names is read here. Labels are used or refused, but never ignored:
robots, features and moves are put in order by name, and bounds, rows and columns by number. Arrays
without labels are read by position.
"""

from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.errors import TrustboError, composed, one_line, require_list, require_order

_NUMERIC = "biufO"
"""Kinds of dtypes that may hold real numbers."""
_TIMES = "mM"
"""Kinds of dtypes of dates and times."""
_NO_NUMBERS = (str, bytes, np.datetime64, np.timedelta64)
"""Types that are not numbers, although `float` converts them."""
_FIRST = {"bound": (0, 1), "row": (0,), "col": (0,)}
"""Numbers with which the labels of each numbered axis may begin."""
_LARGEST = 1e12
"""Largest size of a parameter; trust near 1 added to it keeps four digits."""
_SHARE_ROUNDING = 1e-6
"""Largest distance of a value from [0, 1] that rounding may cause, as in single precision."""
_CHOSEN = ("robot", "feature")
"""Axes whose names the user chooses or leaves out."""

Names = tuple[str, ...]


class Labelled(NamedTuple):
    """Array with its axes in the requested order.

    Attributes:
        values: Numbers, float64. Axes that the argument lacks have length 1.
        coords: Names along the axes that carry names, in the order of `values`.
    """

    values: np.ndarray
    coords: dict[str, Names]


def read_labelled(
    what: str,
    values: Any,
    dims: Sequence[str],
    coords: Mapping[str, Sequence[str] | None] | None = None,
    *,
    partial: bool = False,
) -> Labelled:
    """Read an array by its dims and labels, or by position where it has none.

    Labels are the dims and coordinates of a DataArray, the index and the columns of a DataFrame,
    the index of a Series, or the keys of a dict. Whole numbers that count from 0 or 1 in order say
    no more than the position, and may be given in place of names.

    Args:
        what: Name of the argument in messages.
        values: DataArray, DataFrame, Series, dict, or anything that NumPy takes for an array of
            numbers. Only a DataArray can label more than two axes.
        dims: Axes of the result.
        coords: Names along each axis that carries names, in the order of the result. Empty names
            are taken from the labels; None refuses labels, because there is nothing to compare them
            with. Labels along `bound`, `row` and `col` are numbers. Labels along other axes, such
            as `draw`, do not matter.
        partial: Whether axes may be missing. A DataArray is then aligned by its dims, and an array
            without labels is returned as it is, to be broadcast.

    Raises:
        TrustboError: The dims differ from `dims`, a label is unknown, missing or repeated, or a
            value is not a number.
    """
    names = {} if coords is None else coords
    array = _as_dataarray(what, values, dims, names, partial)
    if array is None:
        return Labelled(as_array(what, values), {})
    wanted = [dim for dim in dims if dim in array.dims] if partial else list(dims)
    if set(array.dims) != set(wanted):
        raise TrustboError(f"{what} must have the dims {tuple(dims)}; got {array.dims}.")

    found: dict[str, Names] = {}
    for dim in wanted:
        if dim not in array.coords:
            continue
        labels = array[dim].values.tolist()
        if dim in names:
            order, known = _by_name(what, dim, labels, tuple(names[dim] or ()))
            if known and names[dim] is None:
                raise TrustboError(
                    f"{what} has the {dim}s {one_line(list(known))}, but there are no names of "
                    f"{dim}s to compare them with; give the values without labels, in order."
                )
            if known:
                found[dim] = known
        elif dim in _FIRST:
            order = _by_number(what, dim, array[dim].values)
        else:
            continue
        array = array.isel({dim: order})

    ordered = as_array(what, array.transpose(*wanted).values)
    missing = tuple(i for i, dim in enumerate(dims) if dim not in wanted)
    return Labelled(np.expand_dims(ordered, missing), found)


def in_order(what: str, group: xr.Dataset, names: Mapping[str, Sequence[Any] | None]) -> xr.Dataset:
    """Return a dataset whose labelled axes are in order; other axes are unchanged.

    Args:
        what: Name of the dataset in messages.
        group: Dataset.
        names: Labels along each axis in order, of which the dataset may lack some; None for an axis
            whose labels are numbers, to be put in order.

    Raises:
        TrustboError: If a label is unknown or repeated.
    """
    order = {}
    for axis, index in group.indexes.items():
        if axis not in names:
            continue
        ranks = index.to_numpy()
        if names[str(axis)] is not None:
            labels = [str(label) for label in index]
            known = [str(name) for name in names[str(axis)] or ()]
            ranks = pd.Index(known).get_indexer(labels)  # pyright: ignore[reportArgumentType]
            if len(set(labels)) < len(labels) or (ranks < 0).any():
                kind = str(axis).removesuffix("_")  # of the second axis of a matrix
                raise TrustboError(
                    f"{what} has the {kind}s {', '.join(labels)}, not {', '.join(known)}; rename "
                    "them, or leave out those that are not among these."
                )
        if (ranks[1:] < ranks[:-1]).any():
            order[axis] = np.argsort(ranks, kind="stable")
    return group.isel(order) if order else group


def as_array(what: str, values: ArrayLike) -> np.ndarray:
    """Return an array of floats, NaN where masked, without regard to labels.

    Raises TrustboError for values that are not real numbers: text, dates, complex numbers, ragged
    lists.
    """
    hint = ""
    try:
        masked = np.ma.isMaskedArray(values)
        raw = np.ma.asarray(values) if masked else np.asarray(_with_nan(values))
        if raw.dtype.kind in _TIMES:
            hint = " Give seconds: divide times by numpy.timedelta64(1, 's')."
        if raw.dtype.kind not in _NUMERIC:
            raise TypeError
        if raw.dtype.kind == "O" and any(isinstance(v, _NO_NUMBERS) for v in raw.ravel().tolist()):
            raise TypeError
        if masked:
            return np.ma.filled(np.ma.asarray(raw, dtype=float), np.nan)
        return np.asarray(raw, dtype=float)
    except (TypeError, ValueError, OverflowError):
        shown = one_line(values)
        raise TrustboError(f"{what} must be an array of numbers; got {shown}.{hint}") from None


def require_numbers(what: str, values: ArrayLike, *, missing: bool = False) -> np.ndarray:
    """Return an array of numbers that double precision can tell apart when added to trust.

    Raises TrustboError for infinite values, values beyond 1e12 and, unless `missing`, NaN.
    """
    array = as_array(what, values)
    low = np.fmin.reduce(array, axis=None, initial=0.0)  # avoids a copy of large arrays

    high = np.fmax.reduce(array, axis=None, initial=0.0)
    if max(-low, high) > _LARGEST or (not missing and np.isnan(array.sum())):
        is_bad = (array > _LARGEST) | (array < -_LARGEST)
        if not missing:
            is_bad |= np.isnan(array)
        bad = array[is_bad].flat[0]
        raise TrustboError(
            f"{what} must be finite and at most {_LARGEST:g} in size; got {bad:g}. Trust and its "
            "parameters are of the order of 1."
        )
    return array


def without_rounding(values: np.ndarray) -> np.ndarray:
    """Move values that rounding has put outside [0, 1], such as 1.0000001, to 0 or 1.

    Other values outside [0, 1] are unchanged.
    """
    outside = (values < 0.0) | (values > 1.0)
    if not outside.any():
        return values

    nearest = np.clip(values, 0.0, 1.0)
    return np.where(np.abs(values - nearest) <= _SHARE_ROUNDING, nearest, values)


def evenly_spaced(n: int, n_kept: int) -> np.ndarray:
    """Return evenly spaced indices of n entries; of all entries, if `n_kept` is n or more."""
    return np.linspace(0, n - 1, min(n, n_kept)).astype(int)


def joined_draws(array: xr.DataArray, axes: Sequence[Any] = (...,)) -> np.ndarray:
    """Return draws (draw, ...) with chains joined and with the other axes in the order `axes`.

    New draws and draws that are read from a file get the same memory layout. Sums then have the
    same rounding errors, which makes a resumed campaign bit-identical. Effects are stored in single
    precision, but computations are in double precision.
    """
    values = np.ascontiguousarray(array.transpose("chain", "draw", *axes).values)
    if values.dtype == np.float32:
        values = values.astype(np.float64)
    return values.reshape(values.shape[0] * values.shape[1], *values.shape[2:])  # also for 0 draws


def as_names(what: str, given: Iterable[str], n: int | None = None) -> Names:
    """Return names as a tuple; raises TrustboError if one is not a string or is repeated.

    They must have an order, so a set is refused. If `n` is given, there must be none or `n` of
    them.
    """
    names = tuple(require_list(what, require_order(what, given), str, "give a list of names"))
    if len(set(names)) < len(names) or (names and n not in (None, len(names))):
        many = "" if n is None else f"{n} "
        raise TrustboError(f"{what} must be {many}different names; got {names}.")
    return tuple(composed(str(name)) for name in names)  # NumPy's strings become Python's


def some_of(what: str, given: Iterable[str], known: Sequence[str]) -> list[int]:
    """Return the positions of given names among known ones, in increasing order.

    Raises TrustboError if a name is unknown or repeated, or if there are no names.
    """
    names = as_names(what, given)
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        got = repr(unknown[0]) if unknown else "no names"
        raise TrustboError(f"{what} must be some of {', '.join(known)}; got {got}.")
    return [i for i, name in enumerate(known) if name in names]


def default_robots(n_robots: int) -> Names:
    """Return default names of robots: r1, r2, ..."""
    return tuple(f"r{i + 1}" for i in range(n_robots))


def _with_nan(values: Any) -> Any:
    """Replace pandas' missing values, which NumPy does not know, with NaN."""
    if not isinstance(values, pd.DataFrame | pd.Series | pd.Index):
        return values
    plain = values.to_numpy()
    return plain if plain.dtype.kind in _TIMES else values.to_numpy(dtype=object, na_value=np.nan)


def _as_dataarray(
    what: str,
    values: Any,
    dims: Sequence[str],
    names: Mapping[str, Sequence[str] | None],
    partial: bool,
) -> xr.DataArray | None:
    """Return labelled values as a DataArray, or None if they carry no labels."""
    if isinstance(values, xr.DataArray):
        return values
    if isinstance(values, xr.Dataset | xr.DataTree):
        kind = type(values).__name__
        first = dims[-1]
        raise TrustboError(f"{what} must be one array with the axis {first}; got a {kind}.")
    if isinstance(values, Mapping):
        values = _as_table(what, values)
    if not isinstance(values, pd.Series | pd.DataFrame):
        return None

    axes = _axes_of(what, values, dims, names, partial)
    coords = {}
    for dim, index in axes.items():
        if dim in _FIRST and index.name != dim:
            _by_number(what, dim, index.to_numpy(), in_order=True)
        elif not (isinstance(index, pd.RangeIndex) and index.step > 0):
            coords[dim] = index.to_numpy()
    return xr.DataArray(_with_nan(values), coords, tuple(axes))


def _as_table(what: str, values: Mapping[Any, Any]) -> pd.Series | pd.DataFrame:
    """Convert a dict of numbers to a Series, and a dict of columns to a DataFrame."""
    try:
        if all(np.ndim(value) == 0 for value in values.values()):
            return pd.Series(dict(values))
        return pd.DataFrame(dict(values))
    except (TypeError, ValueError):
        raise TrustboError(
            f"{what} must hold one number, or one list of numbers of the same length, for each "
            f"key; got {one_line(values)}."
        ) from None


def _axes_of(
    what: str,
    table: pd.Series | pd.DataFrame,
    dims: Sequence[str],
    names: Mapping[str, Sequence[str] | None],
    partial: bool,
) -> dict[str, pd.Index]:
    """Return the index and any columns of a table, keyed by the axis that each stands for.

    A Series has the axis given by its labels or by the name of its index, or else the first axis. A
    DataFrame has the last two axes, in order unless the names of its index and columns say
    otherwise.
    """
    if any(isinstance(axis, pd.MultiIndex) for axis in table.axes):
        raise TrustboError(
            f"{what} has labels of several levels; give a DataArray with the dims {tuple(dims)}."
        )

    if isinstance(table, pd.Series):
        texts = {composed(str(label)) for label in table.index}
        usual = str(table.index.name) if table.index.name in dims else dims[0]
        named = (dim for dim in dims if texts == set(names.get(dim) or ()))
        return {next(named, usual): table.index}

    if len(dims) < 2 or (len(dims) > 2 and not partial):
        raise TrustboError(
            f"{what} must have the axes {tuple(dims)}, but a table has two; give a DataArray with "
            "these dims."
        )

    first, second = dims[-2:]
    if table.index.name == second or table.columns.name == first:
        first, second = second, first
    return {first: table.index, second: table.columns}


def _by_name(what: str, dim: str, labels: list[Any], names: Names) -> tuple[list[int], Names]:
    """Return the position of each name among the labels, and the names; () if labels count."""
    texts = [composed(str(label)) for label in labels]
    if sorted(texts) == sorted(names):
        return [texts.index(name) for name in names], names

    # Whole numbers in order say no more than the position.
    position = list(range(len(labels)))
    whole = [isinstance(label, Integral) and not isinstance(label, bool) for label in labels]
    if dim in _CHOSEN and all(whole) and labels in (position, [k + 1 for k in position]):
        return position, ()

    if not all(
        isinstance(label, str) or is_whole for label, is_whole in zip(labels, whole, strict=True)
    ):
        raise TrustboError(f"{what} has the {dim} labels {one_line(labels)}; give names.")
    if names:
        raise TrustboError(
            f"{what} has the {dim}s {one_line(texts)}, not {one_line(list(names))}; rename them."
        )
    return position, as_names(f"the {dim}s of {what}", texts)


def _by_number(what: str, dim: str, labels: np.ndarray, *, in_order: bool = False) -> np.ndarray:
    """Return the position of each number, from the first to the last, if none is missing.

    With `in_order`, the numbers must be in order: those of an index without a name, for which
    nobody can tell after a sort by another column whether the rows or the index are in order.
    Increasing times of bounds also are in order.
    """
    firsts = _FIRST[dim]
    remedy = f"drop_vars({dim!r})"
    order = np.arange(len(labels))
    if in_order:
        remedy = "reset_index(drop=True)"
        if dim == "bound":  # rows cut from the table of several missions
            firsts = (*firsts, *labels[:1])
    elif labels.dtype.kind in "iuf":
        order = np.argsort(labels, kind="stable")

    ordered = labels[order]
    is_number = labels.dtype.kind in "iuf"
    counts = any(
        is_number and (ordered == first + np.arange(len(labels))).all() for first in firsts
    )
    if counts or not len(labels) or (dim == "bound" and _are_times(labels)):
        return order

    starts = " or ".join(str(first) for first in _FIRST[dim])
    raise TrustboError(
        f"{what} has the {dim} labels {one_line(labels.tolist())}; they must be the numbers from "
        f"{starts} without gaps, with NaN where nothing was measured. If the values are in order, "
        f"use {remedy}."
    )


def _are_times(labels: np.ndarray) -> bool:
    """Return whether labels are increasing times of bounds rather than numbers of bounds."""
    is_whole = labels.dtype.kind == "f" and (labels == np.round(labels)).all()
    return bool(labels.dtype.kind in "fmM" and not is_whole and (labels[1:] > labels[:-1]).all())
