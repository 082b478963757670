"""First screen of the report while a campaign runs: a page that reloads itself."""

import time
from types import TracebackType
from typing import Self

from trustbo.campaign.campaign import Campaign
from trustbo.campaign.result import Result
from trustbo.data import Mission
from trustbo.files import FilePath, require_file, write_text
from trustbo.report import tables
from trustbo.report.blocks import Drawing, Fact, Section
from trustbo.report.numbers import counted
from trustbo.report.page import render, write_report
from trustbo.report.summary import facts_of

_REFRESH = 5
"""Seconds between two reloads of the page."""


class LivePage:
    """Page of a running campaign: a callback that rewrites it after each mission.

    The file is replaced as a whole, so that there is a page to be read at any time, after a crash
    too: it states its mission and time, and the meaning if that is long ago.
    """

    def __init__(self, path: FilePath, total: int) -> None:
        """Prepare the page.

        Args:
            path: HTML file to write, or to replace.
            total: Number of missions in all.
        """
        self.path, self.total = require_file(path, ".html", ".htm"), total
        self._campaign: Campaign | None = None

    def __enter__(self) -> Self:
        self._write("No mission is done yet")
        return self

    def __call__(self, campaign: Campaign, mission: Mission | None = None) -> None:
        """Renew the page."""
        self._campaign = campaign
        self._write("Under way")

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if kind is not None:
            self._write("It was interrupted", refresh=0)

    def finish(self, result: Result) -> None:
        """Replace the page by the final report."""
        write_report(self.path, result)

    def _write(self, state: str, *, refresh: int = _REFRESH) -> None:
        campaign, n, facts, sections = self._campaign, 0, [], []
        if campaign is not None:
            result, n = campaign.result(), len(campaign.missions)
            facts = facts_of(result, campaign.recommend())[:-1]  # except for the reason of the end
            sections = _sections(result)
        now = time.strftime("%H:%M on %d %B %Y")
        status = f"{state}: as of mission {n} of {self.total}, at {now}."
        if refresh:
            status += f" {_if_long_ago(campaign)}"
        title = f"A campaign after {counted(n, 'mission')} of {self.total}"
        page = render(title, [Fact("State", status), *facts], sections, refresh=refresh)
        write_text(self.path, page)


def _if_long_ago(campaign: Campaign | None) -> str:
    """Sentence for the page of a killed run, which no process renews any more."""
    last = {} if campaign is None else campaign.state.entries[-1].row
    seconds = sum(value for name, value in last.items() if name.startswith("seconds_"))
    took = f", of which the last took {max(seconds, 1.0):.0f} s" if last else ""
    return (
        f"This page is renewed after each mission{took}. If its time is long ago, the run has "
        "died: trustbo resume, or trustbo.resume in Python, goes on and takes the page over."
    )


def _sections(result: Result) -> list[Section]:
    """Sections of the first screen, drawn without figures that take seconds."""
    area, rates = (draw() for draw in result._card().pictures)
    path = (
        "Expected trust now, from dark to yellow, and the path recommended now, from circle to "
        "star. Grey cells are impassable, or the start, whose trust is assumed."
    )
    contact = "Mean contact rate that each mission measured."
    table = tables.history_table(result)
    return [
        Section("maps", "Trust map", "", [Drawing(path, area)]),
        Section("history", "The campaign", "", [Drawing(contact, rates), table]),
    ]
