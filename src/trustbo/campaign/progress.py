"""Progress of a campaign: a bar in a terminal, lines in a file, a bar and a map in a notebook."""

import logging
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from trustbo.campaign.state import LEARNED
from trustbo.display.bars import FILE, NOTEBOOK, bar_in, place_of, say
from trustbo.display.compiling import compiling
from trustbo.errors import require_choice

if TYPE_CHECKING:
    from trustbo.campaign.campaign import Campaign

_log = logging.getLogger(__name__)


class Progress:
    """Shows the missions of a campaign while they are run.

    See `iterate` for `progress`. The campaign that a notebook shows is gone at the end.
    """

    def __init__(self, campaign: "Campaign", total: int, progress: bool | str) -> None:
        """Show nothing yet, and nothing at all if `progress` is False."""
        if isinstance(progress, str):
            require_choice("progress", progress, ("bar",))
        self._campaign, self._total = campaign, total
        self._place = place_of(bool(progress))
        self._map: Any = None
        if self._place == NOTEBOOK and progress is True:
            from IPython.display import display

            self._map = display(campaign, display_id=True)

    def __enter__(self) -> Self:
        done = len(self._campaign.missions)
        learner = self._campaign.learner
        self._before, learner.progress = learner.progress, bool(self._place)
        self._bar = bar_in(self._place, total=self._total, initial=done, desc="missions")
        self._compiling = compiling(self._bar)
        self._compiling.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._compiling.__exit__(None, None, None)
        self._bar.close()
        self._campaign.learner.progress = self._before
        if self._map is not None and kind is None:  # the result is what a cell shows afterwards
            self._map.update({"text/plain": "", "text/html": ""}, raw=True)

    def step(self) -> None:
        """Show the last mission."""
        number, report = len(self._campaign.missions), report_of(self._campaign)
        self._bar.set_postfix_str(report, refresh=False)
        self._bar.update()
        _log.info("mission %d: %s", number, report)
        if self._place == FILE:
            say(FILE, f"mission {number}/{self._total}: {report}")
        if self._map is not None:
            self._map.update(self._campaign)


def report_of(campaign: "Campaign") -> str:
    """Describe the last mission in a line."""
    row = campaign.state.entries[-1].row
    regret = f", regret {row['regret']:.1f} %" if "regret" in row else ""
    name, label = ("r_hat", "R-hat") if "r_hat" in row else ("k_hat", "k-hat")
    learned = f"{label} {row[name]:.3f}" if row["state"] == LEARNED else row["state"]
    return f"objective {row['objective']:.3f}{regret}, {learned}, {row['status']}"
