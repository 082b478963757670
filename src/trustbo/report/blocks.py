"""Parts of a page, as plain text and data: sections, tables, pictures."""

from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Table:
    """Table with row names in the first column.

    Attributes:
        caption: Caption, one sentence.
        head: Names of the columns.
        rows: Cells as text, one per column.
        text_columns: Further columns of words after the first; they are set flush left.
    """

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    text_columns: Sequence[int] = ()
    kind: str = field(default="table", init=False)


@dataclass(frozen=True)
class Picture:
    """Figure, and its size on the page.

    Attributes:
        alt: Description for readers who cannot see the figure.
        caption: Caption, one or two sentences.
        uri: Content of the image, as a data URI.
        width: Width, CSS pixels.
        height: Height, CSS pixels.
    """

    alt: str
    caption: str
    uri: str
    width: int
    height: int
    kind: str = field(default="picture", init=False)


@dataclass(frozen=True)
class Section:
    """Section of the page.

    Attributes:
        slug: Anchor of the section.
        title: Heading.
        text: Introduction of one or two sentences, or none.
        blocks: Tables and pictures.
    """

    slug: str
    title: str
    text: str
    blocks: Sequence[Table | Picture]


@dataclass(frozen=True)
class Fact:
    """Statement of the summary.

    Attributes:
        name: Subject, one or two words.
        text: Statement, one or two sentences.
        good: Whether the fact is good; None for a neutral one.
    """

    name: str
    text: str
    good: bool | None = None
