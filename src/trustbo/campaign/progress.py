"""Progress of a campaign: a bar in a terminal, lines in a file, a bar and a map in a notebook."""

import logging
import sys
import warnings
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

with warnings.catch_warnings():  # without ipywidgets its bars are of text, which is as good
    warnings.simplefilter("ignore")
    from tqdm.auto import tqdm

from trustbo.campaign.history import LEARNED

if TYPE_CHECKING:
    from trustbo.campaign.campaign import Campaign

_log = logging.getLogger(__name__)


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
    """

    def __init__(self, campaign: "Campaign", total: int, progress: bool | str) -> None:
        """Show nothing yet, and nothing at all if `progress` is False."""
        self._campaign, self._total, self._shown = campaign, total, bool(progress)
        self._notebook = self._shown and in_notebook()
        # Carriage returns are for a terminal; a file gets lines.
        self._lines = self._shown and not self._notebook and not sys.stderr.isatty()
        self._map: Any = None
        if self._notebook and progress is True:
            from IPython.display import display

            self._map = display(campaign, display_id=True)

    def __enter__(self) -> Self:
        done = len(self._campaign.missions)
        silent = not self._shown or self._lines
        self._bar = tqdm(total=self._total, initial=done, desc="missions", disable=silent)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._bar.close()
        if self._map is not None and kind is None:  # the result is what a cell shows afterwards
            self._map.update(_Nothing())

    def step(self) -> None:
        """Show the last mission."""
        number, report = len(self._campaign.missions), report_of(self._campaign)
        self._bar.set_postfix_str(report, refresh=False)
        self._bar.update()
        _log.info("mission %d: %s", number, report)
        if self._lines:
            tqdm.write(f"mission {number}/{self._total}: {report}", file=sys.stderr)
        if self._map is not None:
            self._map.update(self._campaign)


def in_notebook() -> bool:
    """Whether the code runs in a kernel of Jupyter."""
    if "IPython" not in sys.modules:
        return False
    from IPython import get_ipython

    return getattr(get_ipython(), "kernel", None) is not None


def report_of(campaign: "Campaign") -> str:
    """Describe the last mission in a line."""
    row = campaign.log.entries[-1].row
    regret = f", regret {row['regret']:.1f} %" if "regret" in row else ""
    name, label = ("r_hat", "R-hat") if "r_hat" in row else ("k_hat", "k-hat")
    learned = f"{label} {row[name]:.3f}" if row["state"] == LEARNED else row["state"]
    return f"objective {row['objective']:.3f}{regret}, {learned}, {row['status']}"
