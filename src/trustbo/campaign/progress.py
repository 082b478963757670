"""Progress of a campaign."""

import logging
from types import TracebackType
from typing import TYPE_CHECKING, Self

from trustbo.campaign.state import LEARNED
from trustbo.display import compiling, progress_bar

if TYPE_CHECKING:
    from trustbo.campaign.campaign import Campaign

_log = logging.getLogger(__name__)


class Progress:
    """Bar of the missions of a campaign while they are run."""

    def __init__(self, campaign: "Campaign", total: int, show: bool) -> None:
        self._campaign, self._total, self._show = campaign, total, show

    def __enter__(self) -> Self:
        done, learner = len(self._campaign.missions), self._campaign.learner
        self._before, learner.progress = learner.progress, self._show
        self._bar = progress_bar(self._show, total=self._total, initial=done, desc="missions")
        self._compiling = compiling()
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

    def step(self) -> None:
        """Show the last mission."""
        report = report_of(self._campaign)
        self._bar.set_postfix_str(report, refresh=False)
        self._bar.update()
        _log.info("mission %d: %s", len(self._campaign.missions), report)


def report_of(campaign: "Campaign") -> str:
    """Describe the last mission in a line."""
    row = campaign.state.entries[-1].row
    regret = f", regret {row['regret']:.1f} %" if "regret" in row else ""
    name, label = ("r_hat", "R-hat") if "r_hat" in row else ("k_hat", "k-hat")
    learned = f"{label} {row[name]:.3f}" if row["state"] == LEARNED else row["state"]
    return f"objective {row['objective']:.3f}{regret}, {learned}, {row['status']}"
