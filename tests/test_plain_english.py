"""Docstrings, arguments and help texts begin with a noun or a verb (docs/architecture.md)."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

SOURCE = Path(__file__).parent.parent / "src"
INTERROGATIVES = {
    "as", "how", "of", "what", "whatever", "when", "where", "which", "who", "whose", "why",
}  # fmt: skip
SECTIONS = {"Args:", "Attributes:", "Raises:", "Returns:", "Yields:"}
UNNAMED = {"Returns:", "Yields:"}  # no name stands before the text of their entries


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
