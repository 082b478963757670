"""Plain English in docstrings (docs/architecture.md): their openings, and words of the field."""

import ast
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

SOURCE = Path(__file__).parent.parent / "src"
INTERROGATIVES = {
    "as", "how", "of", "what", "whatever", "when", "where", "which", "who", "whose", "why",
}  # fmt: skip
SECTIONS = {"Args:", "Attributes:", "Raises:", "Returns:", "Yields:"}
UNNAMED = {"Returns:", "Yields:"}  # no name stands before the text of their entries

PLAIN = {  # a word of ours, and the field's words for it
    r"whoever|whomever": "the caller, users",
    r"whatever": "any, for any",
    r"told": "recorded, passed, measured",
    r"tells?|telling": "identifies, distinguishes, states, prints",
    r"worth": "equivalent, value; of a component of a model: ablation",
    r"besides?": "next to, in the same folder; in addition to",
    r"(?:one's|its|their|your|user's|users') own": "separate, custom, default",
    r"laws?(?! of total)": "distribution, conditional, prior; of a kernel: loss",
    r"looks?|looked|looking": "inspect, expand around, recentre; of a lidar: scan",
    r"says?|said": "states, gives, records, shows",
    r"knows?": "has, records, identifies",
    r"contenders?|entrants?|outsiders?": "method, baseline",
    r"cards?": "summary, repr",
    r"set aside": "excluded",
    r"as (?:it|they) (?:is|are|was|were)(?! not)": "unchanged",
    r"beyond what": "that ... does not explain",
}
LEFT = {}  # to be reworded: only ever fewer


def openings_of(file: Path) -> Iterator[tuple[int, str]]:
    """Line and text of each docstring, entry of its sections, and help text."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            for statement in node.body:  # the docstring, and those of attributes
                if isinstance(statement, ast.Expr):
                    yield from _parts(statement.value)
        elif isinstance(node, ast.keyword) and node.arg == "help":
            yield from _text(node.value)


def _parts(node: ast.expr) -> Iterator[tuple[int, str]]:
    section, indent = "", 0
    for line, text in _text(node):
        for i, row in enumerate(text.splitlines()):
            depth, words = len(row) - len(row.lstrip()), row.strip()
            if i == 0:
                yield line, words
            elif words in SECTIONS:
                section, indent = words, depth + 4
            elif section and words and depth == indent:
                entry = words if section in UNNAMED else re.sub(r"^[\w.*, ]+: ", "", words)
                yield line + i, entry
                section = "" if section in UNNAMED else section
            elif section and words and depth < indent:
                section = ""


def _text(node: ast.expr) -> Iterator[tuple[int, str]]:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.lineno, node.value


def private_words(file: Path) -> Iterator[tuple[int, str, str]]:
    """Line and word of each word of `PLAIN` in a docstring, and plain words for it."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            for statement in node.body:
                if isinstance(statement, ast.Expr):
                    for line, text in _text(statement.value):
                        yield from _private(line, text)


def _private(first: int, text: str) -> Iterator[tuple[int, str, str]]:
    # Of the same length: code in backticks and names of entries are no words.
    text = re.sub(r"`[^`]*`", lambda code: re.sub(r"[^\n]", "x", code[0]), text)
    text = re.sub(r"(?m)^( +)([\w*, ]+):(?= )", lambda entry: " " * len(entry[0]), text)
    for words, plain in PLAIN.items():
        pattern = words.replace(" ", r"\s+")
        for match in re.finditer(rf"\b(?:{pattern})\b", text, re.IGNORECASE):
            word = " ".join(match[0].split())
            yield first + text.count("\n", 0, match.start()), word, plain


def is_interrogative(text: str) -> bool:
    first = re.match(r"\W*(\w+)", text)
    return first is not None and first[1].lower() in INTERROGATIVES


def test_no_docstring_argument_or_help_text_begins_with_an_interrogative():
    found = [
        f"{file.relative_to(SOURCE)}:{line}: {text}"
        for file in sorted(SOURCE.rglob("*.py"))
        for line, text in openings_of(file)
        if is_interrogative(text)
    ]
    assert not found, "\n" + "\n".join(found)


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ('"""What it is."""', [1]),
        ('class A:\n    x: int\n    """Whose x."""', [3]),
        ('def f(a):\n    """F.\n\n    Args:\n        a: How many.\n    """', [5]),
        (
            'def f():\n    """F.\n\n    Returns:\n        Where it is:\n        of whom.\n    """',
            [5],
        ),
        ('def f():\n    """F.\n\n    Raises:\n        TypeError: When bad.\n    """', [5]),
        ('def f(a):\n    """Whether it is.\n\n    Args:\n        a: Length.\n    """', []),
        ('x = option(help="Which one.")', [1]),
    ],
)
def test_each_kind_of_opening_is_found(tmp_path, text, lines):
    file = tmp_path / "module.py"
    file.write_text(text)
    assert [line for line, said in openings_of(file) if is_interrogative(said)] == lines


def test_docstrings_have_the_words_of_the_field():
    found = [
        (room_of(file), f"{file.relative_to(SOURCE)}:{line}: {word} ({plain})")
        for file in sorted(SOURCE.rglob("*.py"))
        for line, word, plain in private_words(file)
    ]
    number = Counter(room for room, _ in found)
    grown = {room for room, n in number.items() if n > LEFT.get(room, 0)}
    assert not grown, "\n" + "\n".join(line for room, line in found if room in grown)


def room_of(file: Path) -> str:
    return file.relative_to(SOURCE / "trustbo").parts[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('"""Draws; whoever takes them judges k-hat."""', [(1, "whoever")]),
        ('def f():\n    """F.\n\n    Value as it\n    is.\n    """', [(4, "as it is")]),
        ('class A:\n    x: int\n    """Robots with effects of their own."""', [(3, "their own")]),
        ('def f(a):\n    """F.\n\n    Args:\n        worth: Its worth.\n    """', [(5, "worth")]),
        ('"""Data given to `Campaign.tell`, and the law of total variance."""', []),
    ],
)
def test_each_private_word_is_found(tmp_path, text, words):
    file = tmp_path / "module.py"
    file.write_text(text)
    assert [(line, word) for line, word, _ in private_words(file)] == words
