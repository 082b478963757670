"""Display of objects and progress: text in a terminal, and tables and bars in a notebook."""

import sys
import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager
from functools import cache
from html import escape
from typing import Any

from numba.core import event

with warnings.catch_warnings():  # without ipywidgets, notebooks show text bars
    warnings.simplefilter("ignore")
    from tqdm.auto import tqdm

Rows = list[tuple[str, str]]
"""Names of the main properties of an object, and their values with units."""
_WIDTH = 100


class Summary:
    """Base class of objects that are displayed as a list of their main properties."""

    __slots__ = ()

    def _rows(self) -> Rows:
        """Return names and values to display."""
        raise NotImplementedError

    def __repr__(self) -> str:
        rows = self._rows()
        wide = max((len(name) for name, _ in rows), default=0)
        lines = [type(self).__name__, *(f"  {name:<{wide}}  {value}" for name, value in rows)]
        return "\n".join(line if len(line) <= _WIDTH else f"{line[:97]}..." for line in lines)

    def _repr_html_(self) -> str:
        cells = "".join(
            f'<tr><th style="text-align:left">{escape(name)}</th>'
            f'<td style="text-align:left">{escape(value)}</td></tr>'
            for name, value in self._rows()
        )
        return f"<b>{escape(type(self).__name__)}</b><table>{cells}</table>"


def joined(names: Sequence[str]) -> str:
    """Join names: "a, b and c"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def compiling() -> AbstractContextManager[Any]:
    """Print a line when kernels are compiled, which happens once per machine."""
    return event.install_listener("numba:compile", _Announcement())


class _Announcement(event.Listener):
    def on_start(self, event: event.Event) -> None:
        announce()

    def on_end(self, event: event.Event) -> None:
        pass


@cache
def announce() -> None:
    """Announce the first compilation of a process, above the progress bars."""
    tqdm.write("compiling kernels (once, about 30 s)", file=sys.stderr)
