"""Summary of an object for display: its main numbers, and sections that unfold."""

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import NamedTuple

_MOST_LINES = 12
_STYLE = (
    "<style>.tb-card{font:13px/1.45 sans-serif;max-width:64em;margin:.3em 0}"
    ".tb-card table{border-collapse:collapse;margin:.2em 1.2em .2em 0}"
    ".tb-card td{padding:.05em .9em .05em 0;text-align:left;vertical-align:top;border:0;"
    "background:none}.tb-card td:first-child{opacity:.65;white-space:nowrap}"
    ".tb-card summary{cursor:pointer}</style>"
)


class Card(NamedTuple):
    """Summary of an object for display.

    Attributes:
        title: Name of the object, in a line.
        rows: Names and values with their units.
        sections: Rows, or text, that open on a click, by their titles.
    """

    title: str
    rows: Sequence[tuple[str, str]] = ()
    sections: Mapping[str, Sequence[tuple[str, str]]] = {}

    def text(self) -> str:
        """Title and rows, at most 12 lines."""
        shown = list(self.rows)
        if len(shown) > _MOST_LINES - 1:
            more = len(shown) - (_MOST_LINES - 2)
            shown = [*shown[: _MOST_LINES - 2], ("...", f"{more} more")]
        wide = max((len(name) for name, _ in shown), default=0)
        lines = [f"  {name:<{wide}}  {_short(value, 96 - wide)}" for name, value in shown]
        return "\n".join([_short(self.title, 100), *lines])

    def html(self) -> str:
        """Title, table and sections, for a notebook; it takes the page's colours."""
        folded = "".join(
            f"<details><summary>{escape(name)}</summary>{_table(rows)}</details>"
            for name, rows in self.sections.items()
            if rows
        )
        return (
            f'{_STYLE}<div class="tb-card"><b>{escape(self.title)}</b>'
            f"{_table(self.rows)}{folded}</div>"
        )


class Displayed:
    """Object with a summary as its HTML in a notebook and its text in a terminal."""

    __slots__ = ()

    def _card(self) -> Card:
        raise NotImplementedError

    def __repr__(self) -> str:
        return self._card().text()

    def _repr_html_(self) -> str:
        return self._card().html()


def number(value: float, unit: str = "", digits: int = 3) -> str:
    """Write a number with its unit."""
    return f"{value:.{digits}g}{' ' + unit if unit else ''}"


def joined(names: Sequence[str]) -> str:
    """Join names: "a, b and c"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def arrival(mean: float, band: tuple[float, float] | None) -> str:
    """Text of a chance to arrive, its mean and its 90 % band over the posterior.

    The mean is labelled, as a few far worse draws may leave it outside the band.
    """
    if band is None or not math.isfinite(band[0]):
        return _chance(mean)
    low, high = map(_chance, band)
    span = low if low == high or low.startswith("over") else f"{low} to {high}"
    return f"{_chance(mean)} on average, {span} in 90 % of the draws"


def _chance(p: float) -> str:
    """Text of a chance to three decimals, where a value below 1 is not rounded to 1."""
    return "over 0.999" if 0.9995 <= p < 1.0 else f"{p:.3f}"


def _table(rows: Sequence[tuple[str, str]]) -> str:
    cells = "".join(
        f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in rows
    )
    return f"<table>{cells}</table>" if rows else ""


def _short(text: str, width: int) -> str:
    text = " ".join(text.split())
    return text if len(text) <= width else text[: max(width - 3, 1)] + "..."
