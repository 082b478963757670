"""Word of compilation: kernels are compiled once on a machine, and then kept on its disk."""

from collections.abc import Iterator
from contextlib import contextmanager

from numba.core import event

from trustbo.display.bars import Ticker, bar_in, place_of, tqdm

_WORD = "compiling once, some 30 s in all"


@contextmanager
def compiling(bar: tqdm | None = None) -> Iterator[None]:
    """Show while kernels are compiled that they are; nothing where they need not be.

    Args:
        bar: Bar to show it in; by default one that comes with the first kernel.
    """
    listener = _Listener(bar)
    try:
        with event.install_listener("numba:compile", listener):
            yield
    finally:
        listener.close()


class _Listener(event.Listener):
    """Listener of numba's compilations, which may be nested, and come from several threads."""

    def __init__(self, bar: tqdm | None) -> None:
        self._bar, self._own, self._depth = bar, bar is None, 0

    def on_start(self, event: event.Event) -> None:
        if self._bar is None:
            self._bar = bar_in(place_of(True), bar_format="{desc} [{elapsed}]", leave=False)
        self._depth += 1
        if self._depth == 1 and not self._bar.disable:
            self._before = self._bar.desc.removesuffix(": ")
            name = f"{self._before}, " if self._before else ""
            self._bar.set_description_str(f"{name}{_WORD}")
            self._ticker = Ticker(self._bar)

    def on_end(self, event: event.Event) -> None:
        self._depth -= 1
        if self._depth == 0 and self._bar is not None and not self._bar.disable:
            self._ticker.stop()
            self._bar.set_description_str(self._before, refresh=False)

    def close(self) -> None:
        if self._own and self._bar is not None:
            self._bar.close()
