"""Display of objects and progress, as text in a terminal and as HTML in a notebook."""

import io
import sys
import textwrap
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import Any

with warnings.catch_warnings():  # tqdm warns if ipywidgets is missing
    warnings.simplefilter("ignore")
    from tqdm.auto import tqdm

Rows = list[tuple[str, str]]
"""Names and values, with units, of the main properties of an object."""
_WIDTH = 100
_MAX_LINES = 3  # per property
_PATIENCE = 1.5  # seconds of work before a progress bar or a line appears
_wanted: ContextVar[bool] = ContextVar("wanted", default=True)
"""Whether progress is shown; see `with_progress`."""


class Summary:
    """Base class of objects whose text and HTML display lists their main properties."""

    __slots__ = ()

    def _rows(self) -> Rows:
        """Return the names and values to display."""
        raise NotImplementedError

    def __repr__(self) -> str:
        rows = self._rows()
        wide = max((len(name) for name, _ in rows), default=0)
        lines = [type(self).__name__]
        for name, value in rows:
            lines += textwrap.wrap(
                " ".join(value.split()),
                _WIDTH,
                initial_indent=f"  {name:<{wide}}  ",
                subsequent_indent=" " * (wide + 4),
                max_lines=_MAX_LINES,
                break_on_hyphens=False,
                placeholder="...",
            ) or [f"  {name}"]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return render("summary.html", name=type(self).__name__, rows=self._rows())


def render(template: str, **values: Any) -> str:
    """Fill in a template of the folder `templates`; its values are escaped."""
    return _environment().get_template(template).render(values)


@cache
def _environment() -> Any:
    from jinja2 import Environment, PackageLoader  # only objects in notebooks and reports need it

    return Environment(
        loader=PackageLoader("trustbo"),
        autoescape=True,
        trim_blocks=True,
        keep_trailing_newline=True,
    )


def joined(names: Sequence[str]) -> str:
    """Join one or more names: "a, b and c"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


@contextmanager
def with_progress(wanted: bool) -> Iterator[None]:
    """Show progress in the block only if it is wanted."""
    before = _wanted.set(_wanted.get() and wanted)
    try:
        yield
    finally:
        _wanted.reset(before)


def slow_bar(name: str, unit: str, shown: bool, *, total: int | None = None) -> tqdm:
    """Make a progress bar that appears only if the work takes longer than `_PATIENCE`."""
    return bar(shown, desc=name, unit=unit, total=total, delay=_PATIENCE, leave=False)


def bar(shown: bool, **options: Any) -> tqdm:
    """Make a progress bar, unless nobody sees it; see `shows_bars`."""
    # tqdm reads sys.stderr also for a bar that it does not show.
    file = sys.stderr if _has_stderr() else io.StringIO()
    return tqdm(disable=not (shown and _wanted.get() and shows_bars()), file=file, **options)


def shows_bars() -> bool:
    """Return whether this is a terminal or a notebook; a log file would get all states of a bar."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython else None
    is_notebook = type(shell).__name__ == "ZMQInteractiveShell"
    return is_notebook or (_has_stderr() and sys.stderr.isatty())


def _has_stderr() -> bool:
    """Return whether there is a standard error; services and `2>&-` have none, or a closed one."""
    return sys.stderr is not None and not getattr(sys.stderr, "closed", False)


@contextmanager
def refreshing(shown: tqdm, step: int = 0) -> Iterator[None]:
    """Update a progress bar by `step` each second, also while compiled code runs."""
    if shown.disable:
        yield
        return

    done = threading.Event()

    def refresh() -> None:
        while not done.wait(1.0):
            if step:
                shown.update(step)
            if not shown.delay:
                shown.refresh()

    thread = threading.Thread(target=refresh, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


@contextmanager
def announced(text: str) -> Iterator[None]:
    """Print a line if the block takes longer than `_PATIENCE`; each text is printed once."""
    if not _wanted.get():
        yield
        return

    timer = threading.Timer(_PATIENCE, say_once, [text])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@cache
def say_once(text: str) -> None:
    """Print a line to stderr, once per process."""
    say(text)


def say(text: str) -> None:
    """Print a line to stderr, above any progress bar; nothing without a stderr."""
    if not _has_stderr():
        return
    tqdm.write(text, file=sys.stderr)
