"""Bars and lines that show progress: in a terminal, in a notebook, or in a file."""

import sys
import threading
import warnings
from typing import Any

with warnings.catch_warnings():  # without ipywidgets its bars are of text, which is as good
    warnings.simplefilter("ignore")
    from tqdm.auto import tqdm

NOWHERE, TERMINAL, NOTEBOOK, FILE = "", "terminal", "notebook", "file"
"""Places to show progress; a file gets lines only, as carriage returns need a terminal."""


def place_of(progress: bool) -> str:
    """Place to show progress; `NOWHERE` without progress."""
    if not progress:
        return NOWHERE
    if in_notebook():
        return NOTEBOOK
    return TERMINAL if sys.stderr.isatty() else FILE


def in_notebook() -> bool:
    """Whether the code runs in a kernel of Jupyter."""
    if "IPython" not in sys.modules:
        return False
    from IPython import get_ipython

    return getattr(get_ipython(), "kernel", None) is not None


def bar_in(place: str, **options: Any) -> tqdm:
    """Bar in a terminal or a notebook; in other places it is not shown.

    In a notebook without ipywidgets bars are of text, and share a line: there is no way up. What
    comes by stderr is set off there as if it were an error.
    """
    if place == NOTEBOOK:
        options |= {"position": 0, "file": sys.stdout}
    return tqdm(disable=place not in (TERMINAL, NOTEBOOK), **options)


class Ticker(threading.Thread):
    """Refreshes a bar each second, so that its clock runs while nothing advances it."""

    def __init__(self, bar: tqdm) -> None:
        """Start, until `stop`."""
        super().__init__(daemon=True)
        self._bar, self._over = bar, threading.Event()
        self.start()

    def run(self) -> None:
        """Refresh the bar."""
        while not self._over.wait(1.0):
            self._bar.refresh()

    def stop(self) -> None:
        """Leave the bar alone from now on."""
        self._over.set()
        self.join()


def say(place: str, line: str) -> None:
    """Print a line above the bars."""
    if place:
        tqdm.write(line, file=sys.stdout if place == NOTEBOOK else sys.stderr)
