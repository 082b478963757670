"""How commands end: in one line and an exit code, without a traceback."""

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import typer

from trustbo.errors import PosteriorError, TrustboError

FAILED, BAD_INPUT, REFUSED, INTERRUPTED = 1, 2, 3, 130
"""Exit codes; see the program's epilog."""


@contextmanager
def one_line_errors(debug: bool, campaign: Path | None = None) -> Iterator[None]:
    """Say what went wrong in one line, and how to go on; warnings in a line each.

    Args:
        debug: Show the traceback of an error instead.
        campaign: The folder of the campaign that is at work, if one is.
    """

    def show(message, category, filename, lineno, file=None, line=None) -> None:
        print(f"warning: {message}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.showwarning = show
        warnings.simplefilter("default", UserWarning)
        try:
            yield
        except KeyboardInterrupt:
            print(f"\ninterrupted; {_way_on(campaign)}", file=sys.stderr)
            raise typer.Exit(INTERRUPTED) from None
        except PosteriorError as error:
            if debug:
                raise
            fail(error, REFUSED, _after_refusal(campaign))
        except (TrustboError, OSError) as error:
            if debug:
                raise
            fail(error, BAD_INPUT)


def fail(error: Exception, code: int, hint: str = "") -> NoReturn:
    """End a command with an error in one line, and maybe a hint in another."""
    complain(str(error), hint)
    raise typer.Exit(code)


def complain(error: str, hint: str = "") -> None:
    """Say what is wrong in one line, and in another what may help."""
    print(f"error: {error}", file=sys.stderr)
    if hint:
        print(f"hint: {hint}", file=sys.stderr)


def _way_on(campaign: Path | None) -> str:
    if campaign is None:
        return "the same command goes on with what is left."
    if (campaign / "campaign.json").exists():
        return f"all missions so far are kept: trustbo resume {campaign} goes on."
    return "nothing was begun yet."


def _after_refusal(campaign: Path | None) -> str:
    kept = "" if campaign is None else f"what was measured is kept in {campaign / 'measured.nc'}. "
    return (
        f"{kept}Run again with a model that asks less of so few data (--model pooled), longer "
        "paths (more cells: --shape), or another --seed, and another --out or --overwrite."
    )
