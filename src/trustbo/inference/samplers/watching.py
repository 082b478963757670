"""Progress of a fit: NUTS's chains in a bar with the time they will take, and stages of the rest.

A separate trial run would be discarded, so the trial is the start of the first chain. Its very
first draws, while the step size is still sought, may take a hundred times the usual number of
leapfrog steps: the time of a step is that of all, and their number a draw the median of the trial's
second half. The estimate is a rough one all the same, and the bar corrects it.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Self

import numpy as np

from trustbo.display import progress_bar, say
from trustbo.inference.samplers.settings import NutsSettings

LONG = 10.0
"""Estimated time of a run, s, from which the estimate is printed."""
_TRIAL_DRAWS, _TRIAL_SECONDS = 30, 1.0
_QUICK = 1.0
"""Time, s, until which the stages of a fit are not shown, lest they flicker."""


class Watch:
    """Shows the stages of a fit, and the runs of NUTS that it takes."""

    def __init__(self, show: bool = False, faster: str = "", *, estimates: bool = True) -> None:
        """Show nothing yet.

        Args:
            show: Whether anything is shown.
            faster: Advice on faster alternatives to NUTS, for the estimate.
            estimates: Whether to print an estimate of the time.
        """
        self.faster, self._show, self._estimates = faster, show, estimates
        self._name, self._stage = "NUTS", None
        self._started = time.perf_counter()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end_stages()

    def stage(self, doing: str, *, slow: bool = False) -> None:
        """Show what is being done: in a bar, and in a file once, where it takes long.

        Args:
            doing: Name of the stage.
            slow: Whether it is known to take seconds; others are shown from the first second on.
        """
        seconds = time.perf_counter() - self._started
        if self._stage is None and (slow or seconds > _QUICK):
            self._stage: Any = progress_bar(self._show, bar_format="{desc}", leave=False)
        if self._stage is not None:
            self._stage.set_description_str(f"fit, after {seconds:.0f} s: {doing}")

    def _end_stages(self) -> None:
        if self._stage is not None:
            self._stage.close()
            self._stage = None

    @contextmanager
    def running(self, settings: NutsSettings) -> Iterator[Self]:
        """Show the bar of a run while it lasts."""
        self._end_stages()
        self._settings, self._draws, self._n_divergences = settings, 0, 0
        self._seconds, self._n_steps = 0.0, np.zeros(0)
        self._of_chain, self._estimated = settings.warmup + settings.draws, not self._estimates
        total, label = settings.n_chains * self._of_chain, f"{self._name}, compiling, some 10 s"
        with progress_bar(self._show, total=total, desc=label, unit="draw", leave=False) as bar:
            self._bar = bar
            yield self

    def compiled(self) -> None:
        """Start the clock of the bar."""
        if not self._draws:
            self._bar.unpause()

    def advanced(self, seconds: float, stats: Mapping[str, np.ndarray]) -> None:
        """Show more draws of all chains.

        Args:
            seconds: Time that they took.
            stats: Statistics of each, (chain, draw), `n_steps` and `diverging` among them.
        """
        n_chains, n = stats["n_steps"].shape
        phase = "warm-up" if self._draws < self._settings.warmup else "draws"
        chains = "1 chain" if n_chains == 1 else f"{n_chains} chains"
        self._bar.set_description_str(f"{self._name}, {chains}, {phase}", refresh=False)
        kept = np.arange(self._draws, self._draws + n) >= self._settings.warmup
        self._n_divergences += int((kept & stats["diverging"]).sum())
        steps = f"{stats['n_steps'].mean():.0f} steps a draw"
        divergences = f", {self._n_divergences} divergences" * bool(self._n_divergences)
        self._bar.set_postfix_str(steps + divergences, refresh=False)
        self._bar.update(n_chains * n)
        self._draws += n
        if self._estimated:
            return
        self._seconds += seconds
        self._n_steps = np.append(self._n_steps, stats["n_steps"].mean(0))
        if self._draws >= _TRIAL_DRAWS and self._seconds >= _TRIAL_SECONDS:
            self._estimate()

    def retry(self, settings: NutsSettings, complaints: Sequence[str]) -> None:
        """Print that NUTS runs again, and why."""
        more = f" and {len(complaints) - 1} more" if len(complaints) > 1 else ""
        if self._show:
            say(
                f"{self._name} again, for longer ({settings}, target_accept "
                f"{settings.target_accept:g}): {complaints[0]}{more}."
            )
        self._name, self.faster = "NUTS, second run", ""

    def _estimate(self) -> None:
        usual = float(np.median(self._n_steps[self._draws // 2 :]))
        self._estimated = True
        seconds = self._seconds / self._n_steps.sum() * usual * self._of_chain
        if seconds > LONG and self._show:
            faster = f" Faster: {self.faster}." if self.faster else ""
            say(f"{self._name}: {self._settings}, {about(seconds)}.{faster}")


def about(seconds: float) -> str:
    """Describe a rough time in words."""
    if seconds < 95.0:
        return f"about {max(10, 10 * round(seconds / 10))} s"
    return f"about {round(seconds / 60)} min" if seconds < 5700 else f"about {seconds / 3600:.0f} h"


SILENT = Watch()
