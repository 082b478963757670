"""Errors that trustbo raises for invalid input; each is also a ValueError."""

import contextlib
import math
import operator
import sys
import unicodedata
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

_NOT_CALLERS = str(Path(__file__).parent), contextlib.__file__.removesuffix(".py")
"""Code that no warning points at: the package, and the decorators of its functions.

Python does not skip a file if the prefix is its whole name.
"""


class TrustboError(ValueError):
    """Error for invalid input; the message names the value and the remedy.

    Example:
        >>> try:
        ...     tb.Robot(speed=-1.0)
        ... except tb.TrustboError as error:
        ...     print(error)
    """


class PosteriorError(TrustboError):
    """Error for a posterior whose diagnostics exceed their limits.

    Attributes:
        posterior: Rejected posterior (ArviZ DataTree), for inspection.
        reason: Message without the remedy.

    Example:
        >>> try:
        ...     posterior = tb.fit(missions)
        ... except tb.PosteriorError as error:
        ...     print(error.reason)
        ...     posterior = error.posterior  # for inspection
    """

    def __init__(self, reason: str, posterior: object = None, remedy: str = "") -> None:
        super().__init__(f"{reason} {remedy}".rstrip())
        self.posterior = posterior
        self.reason = reason.rstrip(".")


def warn(message: str) -> None:
    """Issue a UserWarning that points at the line outside of trustbo that made the call."""
    warnings.warn(message, stacklevel=2, skip_file_prefixes=_NOT_CALLERS)


def require_docstrings() -> None:
    """Raise TrustboError under `python -OO`, where libraries fail that append to docstrings."""
    if sys.flags.optimize >= 2:
        raise TrustboError(
            "ArviZ, which trustbo needs, does not run under python -OO (PYTHONOPTIMIZE=2), which "
            "removes docstrings; use -O, or neither."
        )


def require_choice(what: str, value: object, choices: Iterable[str]) -> str:
    """Return `value` if it is among `choices`; otherwise, raise a TrustboError that lists them."""
    choices = tuple(choices)
    if isinstance(value, str) and composed(value) in choices:
        return composed(value)
    if not isinstance(value, str) or value not in choices:
        raise TrustboError(f"unknown {what} {value!r}; choose one of {', '.join(choices)}.")
    return value


MANY = 10**7
"""Largest number of draws, missions, robots or other things that an argument can ask for."""
_LARGEST = 2**63 - 1
"""Largest number that fits in an int64."""
_SHOWN = 60
"""Number of characters of a value that a message shows."""


def require_whole(what: str, value: object, minimum: int, maximum: int = _LARGEST) -> int:
    """Return `value` as an int; raises TrustboError unless it is whole and within the limits."""
    try:
        number = operator.index(value)  # pyright: ignore[reportArgumentType]
    except TypeError:
        number = None

    if number is None or isinstance(value, bool) or number < minimum:
        raise TrustboError(
            f"{what} must be a whole number of at least {minimum}; got {one_line(value)}."
        )
    if number > maximum:
        raise TrustboError(f"{what} must be at most {maximum}; got {one_line(value)}.")
    return number


def require_count(what: str, value: object) -> int:
    """Return a number of things as an int; raises TrustboError unless it is from 1 to `MANY`."""
    return require_whole(what, value, 1, MANY)


def require_finite(what: str, value: Any) -> float:
    """Return `value` as a float; raises TrustboError unless it is a finite real number."""
    number = _number(value)
    if not math.isfinite(number):
        raise TrustboError(f"{what} must be a finite number; got {one_line(value)}.")
    return number


def require_positive(what: str, value: Any, *, or_zero: bool = False) -> float:
    """Return `value` as a float; raises TrustboError unless it is a positive, finite number."""
    number = _number(value)
    if not 0.0 <= number < math.inf or (number == 0.0 and not or_zero):
        least = "0 or more, and" if or_zero else "positive and"
        raise TrustboError(f"{what} must be {least} finite; got {one_line(value)}.")
    return number


def require_share(what: str, value: Any, *, ends: bool = True) -> float:
    """Return `value` as a float; raises TrustboError unless it is in [0, 1].

    Without `ends`, 0 and 1 are also refused.
    """
    number = _number(value)
    is_inside = 0.0 <= number <= 1.0 if ends else 0.0 < number < 1.0
    if not is_inside:
        interval = "[0, 1]" if ends else "(0, 1)"
        raise TrustboError(f"{what} must be in {interval}; got {one_line(value)}.")
    return number


def _number(value: Any) -> float:
    """Return one real number of Python, NumPy or JAX as a float; NaN for anything else."""
    is_text = isinstance(value, str | bytes | bytearray)  # `float` would read it
    kind = getattr(getattr(value, "dtype", None), "kind", "f")
    if is_text or kind not in "biuf" or getattr(value, "ndim", 0):
        return math.nan

    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def require_position(what: str, value: Any) -> tuple[float, float]:
    """Return a position x and y as floats; raises TrustboError unless both are finite."""
    try:
        x, y = value
    except (TypeError, ValueError):
        raise TrustboError(f"{what} must be two numbers, x and y; got {one_line(value)}.") from None

    return require_finite(f"x of {what}", x), require_finite(f"y of {what}", y)


def require_switch(what: str, value: Any) -> bool:
    """Return `value` as a bool; raises TrustboError unless it is True or False.

    Texts such as "False", from a form or an environment variable, would count as true.
    """
    kind = getattr(getattr(value, "dtype", None), "kind", "")
    if isinstance(value, bool) or (kind == "b" and value.ndim == 0):  # also of NumPy and JAX
        return bool(value)
    raise TrustboError(f"{what} must be True or False; got {one_line(value)}.")


def require_kind(what: str, value: Any, kind: Any, remedy: str) -> Any:
    """Return `value` if it is an instance of `kind`; otherwise raise a TrustboError."""
    if not isinstance(value, kind):
        raise TrustboError(f"{what}: got {type(value).__name__} {one_line(value)}; {remedy}.")
    return value


def composed(name: str) -> str:
    """Return a name with composed letters (Unicode NFC).

    An accented letter may be one character or two, as in names of files on macOS; the two forms
    look alike.
    """
    return unicodedata.normalize("NFC", name)


def see(page: str) -> str:
    """Refer to a page of the documentation, by its path in `docs/` without the ending."""
    return f"see docs/{page}.md"


def one_line(value: object) -> str:
    """Format a value for a one-line message: the first 60 characters of its repr."""
    words = " ".join(repr(value).split())
    return words[:_SHOWN]


def require_list(what: str, value: Any, kind: Any = object, remedy: str = "") -> list[Any]:
    """Return the entries of a list as a new list; raises TrustboError if one is of another kind.

    Any iterable counts as a list, except for text and dicts, which are iterable by accident.
    """
    advice = remedy or "give a list"
    try:
        entries = None if isinstance(value, str | bytes | Mapping) else list(value)
    except TypeError:  # also arrays without axes
        entries = None

    if entries is None:
        raise TrustboError(f"{what} must be a list; got {one_line(value)}; {advice}.")
    return [require_kind(f"{what}[{k}]", entry, kind, advice) for k, entry in enumerate(entries)]


def require_order(what: str, value: Any) -> Any:
    """Return `value` unless it is a set, whose order differs between runs of Python."""
    if isinstance(value, set | frozenset):
        raise TrustboError(f"{what} need an order; got the set {one_line(value)}; give a list.")
    return value


def require_tuple(what: str, value: Any, n: int) -> tuple[float, ...]:
    """Return n numbers as floats, such as a mean and an sd; raises TrustboError unless finite."""
    numbers = require_list(what, value, remedy=f"give {n} numbers")
    if len(numbers) != n:
        raise TrustboError(f"{what} must be {n} numbers; got {one_line(value)}.")
    return tuple(require_finite(f"{what}[{k}]", number) for k, number in enumerate(numbers))


def require_cells(
    what: str, value: object, posts: Sequence[str] = ()
) -> tuple[tuple[Any, ...], ...]:
    """Return cells (row, col) in order, such as a path; raises TrustboError if any is invalid.

    With `posts`, the names of sets of posts, a cell may be (row, col, name); the first name is
    left out of the result.
    """
    cells = require_list(what, value, remedy="give cells (row, col)")
    return tuple(_require_cell(f"{what}[{k}]", cell, posts) for k, cell in enumerate(cells))


def _require_cell(what: str, value: Any, posts: Sequence[str]) -> tuple[Any, ...]:
    """Return a cell (row, col), or (row, col, name) with the name of a set in `posts`."""
    is_named = isinstance(value, tuple | list) and len(value) == 3 and isinstance(value[2], str)
    if not (posts and is_named):
        return require_pair(what, value)
    name = require_choice(f"the posts of {what}", value[2], posts)
    cell = require_pair(what, value[:2])
    return cell if name == posts[0] else (*cell, name)


def require_pair(what: str, value: object) -> tuple[int, int]:
    """Return two whole numbers, such as a cell (row, col), as ints, or raise TrustboError."""
    try:
        first, second = (operator.index(i) for i in value)  # pyright: ignore[reportGeneralTypeIssues]
    except (TypeError, ValueError):
        raise TrustboError(
            f"{what} must be two whole numbers (row, col); got {one_line(value)}."
        ) from None
    return first, second


def require_bounds(what: str, value: object) -> tuple[tuple[tuple[int, int], ...], ...]:
    """Return bounds as pairs of cells (left, entered); raises TrustboError for other values."""
    remedy = "give pairs of neighbouring cells, such as [((2, 1), (1, 1))]"
    pairs = []
    for k, bound in enumerate(require_list(what, value, remedy=remedy)):
        cells = require_cells(f"{what}[{k}]", bound)
        if len(cells) != 2:
            raise TrustboError(f"{what}[{k}] must be two cells; got {one_line(bound)}.")
        pairs.append(cells)
    return tuple(pairs)
