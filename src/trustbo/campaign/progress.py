"""Progress of a campaign: a bar in a terminal, lines in a file, a bar and a map in a notebook."""

import logging
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from trustbo.campaign.state import LEARNED
from trustbo.display.bars import FILE, NOTEBOOK, bar_in, place_of, say
from trustbo.errors import TrustboError, require_choice

if TYPE_CHECKING:
    from trustbo.campaign.campaign import Campaign

_log = logging.getLogger(__name__)
PAGE, PAGE_ALONE = "page", "page_alone"
_KINDS = ("bar", PAGE, PAGE_ALONE)
_NOT_ENDED = b'<meta name="trustbo-campaign" content="not ended">'
"""Line in the head of the page of a campaign that did not end."""


class _Nothing:
    """Empty output of a cell."""

    def __repr__(self) -> str:
        return ""

    def _repr_html_(self) -> str:
        return ""


class Progress:
    """Shows the missions of a campaign while they are run.

    Under `progress=True` a notebook also shows the campaign itself, its map of trust and the
    contact of its missions, renewed after each and gone at the end; `"bar"` leaves it out.
    `"page"` keeps a page of it in the campaign's folder, which becomes the report, and
    `"page_alone"` shows nothing else.
    """

    def __init__(self, campaign: "Campaign", total: int, progress: bool | str) -> None:
        """Show nothing yet, and nothing at all if `progress` is False."""
        if isinstance(progress, str):
            require_choice("progress", progress, _KINDS)
        self._campaign, self._total = campaign, total
        self._place = place_of(bool(progress) and progress != PAGE_ALONE)
        self._map: Any = None
        self._page: Any = None
        if progress in (PAGE, PAGE_ALONE):
            live = import_module("trustbo.report.live")  # by name: it lies above
            self._page = live.LivePage(_page_of(campaign), total)
        if self._place == NOTEBOOK and progress is True:
            from IPython.display import display

            self._map = display(campaign, display_id=True)

    def __enter__(self) -> Self:
        done = len(self._campaign.missions)
        learner = self._campaign.learner
        self._before, learner.progress = learner.progress, bool(self._place)
        if self._page is not None:
            if done:
                self._page(self._campaign)
            else:
                self._page.__enter__()
            say(self._place, f"follow the campaign at {self._page.path.resolve().as_uri()}")
        self._bar = bar_in(self._place, total=self._total, initial=done, desc="missions")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._bar.close()
        self._campaign.learner.progress = self._before
        if self._map is not None and kind is None:  # the result is what a cell shows afterwards
            self._map.update(_Nothing())
        if self._page is not None:
            self._page.__exit__(kind, error, at)
            if kind is None:
                self._page.finish(self._campaign.result())

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
        if self._page is not None:
            self._page(self._campaign)


def page_in(folder: Path) -> Path:
    """Page of the campaign that is kept in a folder."""
    return folder / "report.html"


def _page_of(campaign: "Campaign") -> Path:
    """Page in the folder that a campaign is kept in; TrustboError if there is none."""
    if campaign.storage is None:
        raise TrustboError(
            "a page is report.html in the campaign's folder; give directory=, or checkpoint= to "
            "iterate."
        )
    return page_in(campaign.storage.path)


def continued(progress: bool | str, folder: Path) -> bool | str:
    """Progress of a campaign that goes on, with its page, if the run before left one not ended."""
    page = page_in(folder)
    if progress in (PAGE, PAGE_ALONE) or not page.is_file():
        return progress
    with page.open("rb") as file:
        if _NOT_ENDED not in file.read(2000):
            return progress
    return PAGE if progress else PAGE_ALONE


def report_of(campaign: "Campaign") -> str:
    """Describe the last mission in a line."""
    row = campaign.state.entries[-1].row
    regret = f", regret {row['regret']:.1f} %" if "regret" in row else ""
    name, label = ("r_hat", "R-hat") if "r_hat" in row else ("k_hat", "k-hat")
    learned = f"{label} {row[name]:.3f}" if row["state"] == LEARNED else row["state"]
    return f"objective {row['objective']:.3f}{regret}, {learned}, {row['status']}"
