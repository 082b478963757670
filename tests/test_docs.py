"""Examples in README and docs run and print what the page shows; links and figures exist."""

import io
import re
from contextlib import redirect_stdout
from decimal import Decimal
from itertools import zip_longest
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted(
        page
        for page in (ROOT / "docs").rglob("*.md")
        if not {"_build", "generated", "notebooks"} & set(page.relative_to(ROOT).parts)
    ),
]
BLOCK = re.compile(r"^```python\n(.*?)^```(?:\n+```text\n(.*?)^```)?", flags=re.S | re.M)
"""An example, and what the page says that it prints, if it does."""
TOKEN = re.compile(r"[^\W\d]\w*|[+-]?\d+\.?\d*(?:e[+-]?\d+)?|\S|\n")
"""A word, a number, a sign of layout such as a bracket, or the end of a line."""
TERM = re.compile(r"\{term\}`(?:[^<`]*<)?([^>`]+)>?`")
"""A term of the glossary to which a page refers."""
NUMBER, WHOLE = re.compile(r"[+-]?\d"), re.compile(r"[+-]?\d+")


def name_of(page):
    return str(page.relative_to(ROOT))


# Pages that compile models, or draw all figures.
_SLOW = ("howto/run-a-study-in-parallel", "howto/use-arviz", "howto/your-own-model", "inference")
SLOW = {f"docs/{page}.md" for page in _SLOW}
EXAMPLES = [
    pytest.param(page, marks=pytest.mark.slow if name_of(page) in SLOW else (), id=name_of(page))
    for page in PAGES
    if BLOCK.search(page.read_text())
]


@pytest.mark.parametrize("page", EXAMPLES)
def test_the_examples_of_a_page_run_and_print_what_it_shows(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text, namespace = page.read_text(), {"__name__": "__main__"}
    with plt.rc_context():
        for block in BLOCK.finditer(text):
            line = text.count("\n", 0, block.start(1))  # so that an error names the page's line
            with redirect_stdout(io.StringIO()) as printed:
                exec(compile("\n" * line + block[1], name_of(page), "exec"), namespace)
            if block[2] is not None:
                at = f"{name_of(page)}:{text.count('\n', 0, block.start(2)) + 1}"
                found = differences(block[2], printed.getvalue())
                assert found == [], f"{at} is stale: {found}; printed was\n{printed.getvalue()}"
    plt.close("all")


def differences(shown, printed):
    """Pairs of tokens that differ, of what a page shows and of what was printed.

    How wide the blanks are does not matter. Whole numbers are cells and counts, and must be equal;
    others may differ by one in the last digit.
    """
    tokens = (TOKEN.findall(text.strip()) for text in (shown, printed))
    return [(a, b) for a, b in zip_longest(*tokens, fillvalue="") if not alike(a, b)]


def alike(a, b):
    if not (NUMBER.match(a) and NUMBER.match(b)) or (WHOLE.fullmatch(a) and WHOLE.fullmatch(b)):
        return a == b
    one, other = Decimal(a), Decimal(b)
    last = min(one.as_tuple().exponent, other.as_tuple().exponent)  # numpy leaves out zeros: "0.8 "
    return abs(one - other) <= Decimal(1).scaleb(last)


@pytest.mark.parametrize(
    ("shown", "printed", "found"),
    [
        ("[[0.8  0.12]]", "[[ 0.79 0.13]]", []),
        ("x  -0.1\n", "x 0.0", []),
        ("2.5e-4 nan", "2.6e-4 nan", []),
        ("[0.8 ]", "[0.82]", [("0.8", "0.82")]),
        ("-0.22", "0.22", [("-0.22", "0.22")]),
        ("(-3, 4)", "(-4, 5)", [("-3", "-4"), ("4", "5")]),
        ("r1 0.5", "r2 0.5", [("r1", "r2")]),
        ("0.1 0.2", "0.1\n0.2", [("0.2", "\n"), ("", "0.2")]),
        ("0.1", "[0.1]", [("0.1", "["), ("", "0.1"), ("", "]")]),
    ],
)
def test_a_page_is_stale_if_more_than_the_last_digit_differs(shown, printed, found):
    assert differences(shown, printed) == found


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_and_figures_of_a_page_exist(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.S | re.M)
    for target in re.findall(r"\]\(((?!https?:)[^)\s]+)\)", text):
        file, _, section = target.partition("#")
        linked = page.parent / file if file else page
        assert linked.exists(), f"{target} is not there"
        if section:
            assert section in anchors_of(linked.read_text()), f"{target} has no such heading"


def test_pages_to_which_messages_refer_exist():
    sources = [file.read_text() for file in (ROOT / "src").rglob("*.py")]
    pages = [page for text in sources for page in re.findall(r"\bsee\([\"']([^\"']+)", text)]
    assert pages
    for page in pages:
        assert (ROOT / "docs" / f"{page}.md").exists(), f"docs/{page}.md is not there"


def test_terms_to_which_pages_refer_are_in_the_glossary():
    glossary = (ROOT / "docs" / "glossary.md").read_text()
    entries = set(re.findall(r"^([^\s:#].*)$", glossary.partition(":::{glossary}")[2], flags=re.M))
    used = [term for page in PAGES for term in TERM.findall(page.read_text())]
    assert used
    assert [term for term in used if term not in entries] == []


def anchors_of(text):
    """What `#...` may say: the headings as GitHub and MyST write them, and named targets."""
    headings = re.findall(r"^#+ (.+)$", text, flags=re.M)
    slugs = [re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings]
    return {*slugs, *re.findall(r"^\(([\w-]+)\)=$", text, flags=re.M)}
