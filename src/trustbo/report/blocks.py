"""What a page consists of: sections of tables and pictures, as plain text and data."""

from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Table:
    """A table; its first column names the rows.

    Attributes:
        caption: What it shows, in a sentence.
        head: Names of the columns.
        rows: Cells as text, as many in each row as there are columns.
        text_columns: The columns, besides the first, that hold words: they are set flush left.
    """

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    text_columns: Sequence[int] = ()
    kind: str = field(default="table", init=False)


@dataclass(frozen=True)
class Image:
    """A drawing and the size it is meant to be seen at.

    Attributes:
        uri: All of it, as a data URI.
        width: CSS pixels.
        height: CSS pixels.
    """

    uri: str
    width: int
    height: int


@dataclass(frozen=True)
class Picture:
    """A figure, drawn for a wide page and again for a phone.

    Attributes:
        alt: What is seen, for those who do not see it.
        caption: What it shows, in a sentence or two.
        wide: For pages.
        narrow: For phones, with fewer panels in a row: text stays readable.
    """

    alt: str
    caption: str
    wide: Image
    narrow: Image
    kind: str = field(default="picture", init=False)


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes:
        slug: Its anchor.
        title: Its heading.
        text: A sentence or two before its blocks, or nothing.
        blocks: Tables and pictures.
    """

    slug: str
    title: str
    text: str
    blocks: Sequence[Table | Picture]


@dataclass(frozen=True)
class Fact:
    """One thing that the summary says.

    Attributes:
        name: What it is about, in a word or two.
        text: One or two sentences.
        good: Whether it is as it should be; None where there is nothing to judge.
    """

    name: str
    text: str
    good: bool | None = None
