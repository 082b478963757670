"""Messages for errors of JAX, NumPyro and NumPy in a user's function, which name the function."""

import re
from typing import Any

import numpy as np

from trustbo.errors import TrustboError
from trustbo.inference.functions.data import RATES, Data
from trustbo.models.contact_rate import DriftMismatchError

_OF_SHAPES = re.compile("ncompatible shapes|could not be broadcast|not broadcast")
"""Errors that JAX and NumPy raise if shapes do not match."""
_BY_NAME = re.compile("string indexing|(Tracer|ArrayImpl|ndarray)'?( object)? has no attribute")
"""Errors that arrays raise if they are used like those of xarray or pandas."""
_TRACEBACK = "Traceback (most recent call last):"
_NOT_REASONS = re.compile(r"^(-+$|For simplicity, JAX |See https?://|The stack trace below )")
"""Lines with which JAX ends a message or frames a traceback."""


class explained:  # noqa: N801
    """Context in which the message of an error in a user's function names the function."""

    def __init__(self, who: str, data: Data) -> None:
        self.who = who
        self.data = data

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, DriftMismatchError) and error.drift != np.shape(self.data[RATES]):
            raise TrustboError(wrong_drift(self.who, error.drift, self.data)) from error
        if isinstance(error, TrustboError):
            if self.who not in str(error):
                raise TrustboError(f"{self.who}: {error}") from error
        elif isinstance(error, Exception):
            reason = reason_of(error)
            remedy = ""
            if isinstance(error, NotImplementedError) and not reason:
                remedy = " Give variables proper priors, from which NumPyro can draw."
            if _BY_NAME.search(reason):
                remedy = (
                    ". Inputs are arrays without names; read a feature as "
                    "awareness[..., features.index(name)], with the input features."
                )
            if _OF_SHAPES.search(reason):
                remedy = (
                    f" Awareness has the shape (mission, bound, robot, feature) = "
                    f"{np.shape(self.data['awareness'])}, and the drift must be (mission, bound, "
                    "robot). Use a variable of a mission as variable[:, None, None], and one of a "
                    "robot as it is."
                )
            raise TrustboError(
                f"{self.who} failed with {type(error).__name__}: {reason}{remedy}"
            ) from error


def wrong_drift(who: str, given: tuple[int, ...], data: Data) -> str:
    """Return the message that a drift does not have the shape of the contact rates."""
    remedy = ""
    if given[2] == 1:
        remedy = " Add the axis of the robots: drift + jnp.zeros(awareness.shape[:3])."
    return (
        f"the drift of {who} must have the shape (mission, bound, robot) = "
        f"{np.shape(data[RATES])}, as awareness is (mission, bound, robot, feature) = "
        f"{np.shape(data['awareness'])}; got {given}.{remedy}"
    )


def reason_of(error: Exception) -> str:
    """Return the part of an error's message that states the reason, as one line.

    The first line is the reason, unless it announces the next ones by a colon. If the message
    contains a traceback, as for an error in a callback, the reason is the last line.
    """
    lines = [line.strip() for line in str(error).splitlines()]
    lines = [line for line in lines if line and not _NOT_REASONS.search(line)]
    if not lines:
        return ""
    if any(_TRACEBACK in line for line in lines):
        return lines[-1]

    n = 1
    while n < len(lines) and lines[n - 1].endswith((":", ",", ";")):
        n += 1
    return " ".join(lines[:n])
