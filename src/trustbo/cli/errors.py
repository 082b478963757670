"""Errors of commands: one line and an exit code, without a traceback."""

import re
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import NoReturn

import typer

from trustbo.errors import PosteriorError, TrustboError

FAILED, BAD_INPUT, REFUSED, INTERRUPTED = 1, 2, 3, 130
"""Exit codes; the epilog of the program explains them."""
_CLICK = typer.Context.__mro__[1].__module__.rpartition(".")[0]  # wherever typer keeps it
_ALIASES = {"n_iterations": "iterations", "n_robots": "robots", "RegretBound.eps": "stop_regret"}
"""Names in Python whose flags are called otherwise."""


@contextmanager
def one_line_errors(debug: bool, campaign: Path | None = None) -> Iterator[None]:
    """Print an error in one line (with `debug`, its traceback), and each warning in a line.

    After an interrupt or a refused posterior, the way to resume the `campaign` is printed, by its
    folder. SIGTERM ends a command as Ctrl-C does.
    """
    main = threading.current_thread() is threading.main_thread()  # others cannot set handlers
    before = signal.signal(signal.SIGTERM, signal.default_int_handler) if main else None

    def show(message, category, filename, lineno, file=None, line=None) -> None:
        print(f"warning: {in_flags(str(message))}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.showwarning = show
        warnings.simplefilter("default", UserWarning)
        try:
            yield
        except (KeyboardInterrupt, SystemError) as error:  # numba makes the former the latter
            if KeyboardInterrupt not in (type(error), type(error.__cause__)):
                raise
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
        finally:
            if main:
                signal.signal(signal.SIGTERM, before)


def fail(error: Exception, code: int, hint: str = "") -> NoReturn:
    """End a command with an error in one line, and maybe a hint in another."""
    complain(in_flags(str(error)), hint)
    raise typer.Exit(code)


def in_flags(text: str) -> str:
    """Write the names of Python's arguments as the flags of the command that runs.

    `crs=` and, with its value, `nodata=-1.0`; names with underscores also alone.
    """
    context = import_module(f"{_CLICK}.globals").get_current_context(silent=True)
    options = () if context is None else context.command.params
    flags = {p.name: p.opts[-1] for p in options if p.param_type_name == "option"}
    flags |= {name: flags[flag] for name, flag in _ALIASES.items() if flag in flags}
    for name, flag in flags.items():
        alone = r"|(?![\w=/'\"])" if {"_", "."} & set(name) else ""
        word = rf"(?<![\w./'\"-]){re.escape(name)}(?:=(['\"]?)([\w.+:-]*\w)\1|=(?=\W|$){alone})"
        text = re.sub(word, lambda m, to=flag: f"{to} {m[2]}" if m[2] else to, text)
    return text


def complain(error: str, hint: str = "") -> None:
    """Print an error in one line, and a hint in another."""
    print(f"error: {error}", file=sys.stderr)
    if hint:
        print(f"hint: {hint}", file=sys.stderr)


def _way_on(campaign: Path | None) -> str:
    if campaign is None:
        return "the same command runs the rest."
    from trustbo.campaign.folder import STATE

    if (campaign / STATE).exists():
        return f"all missions so far are kept: trustbo resume {campaign} goes on."
    return "nothing was begun yet."


def _after_refusal(campaign: Path | None) -> str:
    from trustbo.campaign.folder import MEASURED

    kept = "" if campaign is None else f"the measured missions are kept in {campaign / MEASURED}. "
    return (
        f"{kept}Run again with a model of fewer parameters (--model pooled), longer paths (more "
        "cells: --shape), or another --seed, and another --out or --overwrite."
    )
