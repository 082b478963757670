"""The errors trustbo raises for input it refuses; each is also a ValueError."""

from collections.abc import Iterable


class TrustboError(ValueError):
    """Input that trustbo refuses: the message names the value and the remedy."""


class ShapeError(TrustboError):
    """Arrays whose axes do not fit together."""


class TerrainError(TrustboError):
    """A raster that cannot serve as terrain."""


class PosteriorError(TrustboError):
    """A posterior whose diagnostics say it must not be used.

    Attributes:
        posterior: The refused posterior (ArviZ DataTree), for inspection.
    """

    def __init__(self, message: str, posterior: object = None) -> None:
        super().__init__(message)
        self.posterior = posterior


def require_choice(what: str, value: object, choices: Iterable[str]) -> str:
    """Return `value` if it is one of `choices`; else an error that lists them.

    Raises:
        TrustboError: `value` is not among the choices.
    """
    choices = tuple(choices)
    if not isinstance(value, str) or value not in choices:
        raise TrustboError(f"unknown {what} {value!r}; choose one of {', '.join(choices)}.")
    return value
