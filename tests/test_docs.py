"""The pages' examples run as printed, every public name has an entry and one, links lead on."""

import re
from importlib import import_module
from pathlib import Path
from types import ModuleType

import matplotlib.pyplot as plt
import pytest
import typer

import trustbo
from trustbo.cli import app

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted(
        page
        for page in (ROOT / "docs").rglob("*.md")
        if not {"_build", "notebooks"} & set(page.relative_to(ROOT).parts)
    ),
]
NAMESPACES = (
    "trustbo",
    "trustbo.terrain",
    "trustbo.models",
    "trustbo.planning",
    "trustbo.simulation",
    "trustbo.study",
    "trustbo.plots",
    "trustbo.export",
    "trustbo.report",
)
BLOCK = re.compile(r"^```python\n(.*?)^```", flags=re.S | re.M)


def name_of(page):
    return str(page.relative_to(ROOT))


def page_of(namespace):
    return ROOT / "docs" / "api" / f"{namespace.split('.')[-1]}.md"


@pytest.mark.parametrize("page", [p for p in PAGES if BLOCK.search(p.read_text())], ids=name_of)
def test_the_examples_of_a_page_run_from_top_to_bottom(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text, namespace = page.read_text(), {}
    with plt.rc_context():
        for block in BLOCK.finditer(text):
            line = text.count("\n", 0, block.start(1))  # so that an error names the page's line
            exec(compile("\n" * line + block[1], name_of(page), "exec"), namespace)
    plt.close("all")


@pytest.mark.parametrize("namespace", NAMESPACES)
def test_every_public_name_has_an_entry_and_an_example(namespace):
    module, text = import_module(namespace), page_of(namespace).read_text()
    entries = set(re.findall(r"^\.\. auto\w+:: ([\w.]+)$", text, flags=re.M))
    code = "\n".join(BLOCK.findall(text))
    parts = {name for name in module.__all__ if isinstance(getattr(module, name), ModuleType)}
    parts = {name for name in parts if f"{namespace}.{name}" in NAMESPACES}  # on their own pages
    for name in module.__all__:
        assert name in parts or f"{namespace}.{name}" in entries, f"{name} has no entry"
        assert re.search(rf"\b{name}\b", code), f"{name} has no example"


def test_every_entry_is_public():
    for namespace in NAMESPACES:
        module = import_module(namespace)
        entries = re.findall(r"^\.\. auto\w+:: ([\w.]+)$", page_of(namespace).read_text(), re.M)
        strangers = [e for e in entries if e.removeprefix(f"{namespace}.") not in module.__all__]
        assert [e for e in strangers if e != namespace] == []


@pytest.mark.parametrize("namespace", NAMESPACES)
def test_the_index_of_the_api_leads_to_every_namespace(namespace):
    assert f"](api/{namespace.split('.')[-1]}.md)" in (ROOT / "docs" / "api.md").read_text()


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_and_figures_of_a_page_exist(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.S | re.M)
    for target in re.findall(r"\]\(((?!https?:)[^)\s]+)\)", text):
        file, _, section = target.partition("#")
        linked = page.parent / file if file else page
        assert linked.exists(), f"{target} is not there"
        if section:
            assert section in anchors_of(linked.read_text()), f"{target} has no such heading"


def anchors_of(text):
    """What `#...` may say: the headings as GitHub and MyST write them, and named targets."""
    headings = re.findall(r"^#+ (.+)$", text, flags=re.M)
    slugs = [re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings]
    return {*slugs, *re.findall(r"^\(([\w-]+)\)=$", text, flags=re.M)}


def test_the_table_of_equations_names_what_there_is():
    page = (ROOT / "docs" / "concepts.md").read_text()
    table = page[page.index("| paper |") :].split("\n\n")[0].splitlines()[2:]
    assert len(table) >= 9  # (1) to (6), two figures, the maps
    for row in table:
        paper, _, names, file, tests = [cell.strip() for cell in row.strip("|").split("|")]
        for name in re.findall(r"`tb\.([\w.]+)`", names):
            thing = trustbo
            for part in name.split("."):
                thing = getattr(thing, part)
        assert re.search(r"`tb\.", names), f"{paper}: no public name"
        for source in re.findall(r"`([\w/]+\.py)`", file):
            assert (ROOT / "src" / "trustbo" / source).exists(), source
        tested = re.findall(r"`([\w/]+\.py)::(\w+)`", tests)
        assert tested, f"{paper}: no test"
        for source, test in tested:
            assert f"def {test}(" in (ROOT / "tests" / source).read_text(), test


def test_every_benchmark_is_described():
    page = (ROOT / "docs" / "benchmarks.md").read_text()
    scripts = [script.name for script in (ROOT / "benchmarks").glob("*.py")]
    assert [name for name in scripts if f"python benchmarks/{name}" not in page] == []


def test_the_page_of_the_command_line_has_every_flag_with_its_help():
    page = (ROOT / "docs" / "cli.md").read_text()
    sections = dict(re.findall(r"^## trustbo (\w+)\n(.*?)(?=^## |\Z)", page, flags=re.S | re.M))
    commands = typer.main.get_command(app).commands
    assert set(sections) == set(commands)
    for name, command in commands.items():
        shown = re.findall(r"^\| (`[^|]+`) \| (.*?) \| (.*) \|$", sections[name], flags=re.M)
        texts = {re.findall(r"`(\S+?)[` ]", flags)[0]: text for flags, _, text in shown}
        for option in command.params:
            help_text = re.sub(r"\[/?b\]", "`", option.help)
            flag = option.metavar if option.param_type_name == "argument" else option.opts[0]
            assert texts.pop(flag).replace("[studies](studies.md)", "docs/studies.md") == help_text
        assert texts == {}, f"trustbo {name} has no such flags"
