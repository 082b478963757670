"""The pages' examples run and print what is shown, every public name has one, links lead on."""

import ast
import io
import re
import subprocess
import sys
import threading
import tomllib
import zlib
from contextlib import redirect_stdout
from decimal import Decimal
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib import import_module
from itertools import zip_longest
from pathlib import Path
from types import ModuleType

import matplotlib.pyplot as plt
import pytest
import typer

import trustbo
from trustbo.cli import app
from trustbo.errors import TrustboError
from trustbo.inference.samplers.choice import resolve_sampler
from trustbo.models import CoupledTrust, HierarchicalTrust, PlaceEffect, PooledTrust

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
    "trustbo.workspace",
    "trustbo.logs",
    "trustbo.models",
    "trustbo.inference",
    "trustbo.hazard",
    "trustbo.criticism",
    "trustbo.planning",
    "trustbo.simulation",
    "trustbo.paper",
    "trustbo.study",
    "trustbo.plots",
    "trustbo.export",
    "trustbo.report",
)
BLOCK = re.compile(r"^```python\n(.*?)^```(?:\n+```text\n(.*?)^```)?", flags=re.S | re.M)
"""An example, and what the page says that it prints, if it does."""
TOKEN = re.compile(r"[^\W\d]\w*|[+-]?\d+\.?\d*(?:e[+-]?\d+)?|\S|\n")
"""A word, a number, a sign of layout such as a bracket, or the end of a line."""
NUMBER, WHOLE = re.compile(r"[+-]?\d"), re.compile(r"[+-]?\d+")


def name_of(page):
    return str(page.relative_to(ROOT))


def page_of(namespace):
    return ROOT / "docs" / "api" / f"{namespace.split('.')[-1]}.md"


# All figures; programs that compile for this alone; campaigns of many missions; README's again.
_SLOW = ("api/plots", "gallery", "howto/use-arviz", "howto/your-own-model", "howto/compare-models",
         "howto/criticise", "api/models", "index")  # fmt: skip
SLOW = {f"docs/{page}.md" for page in _SLOW}
EXAMPLES = [
    pytest.param(page, marks=pytest.mark.slow if name_of(page) in SLOW else (), id=name_of(page))
    for page in PAGES
    if BLOCK.search(page.read_text())
]


@pytest.mark.parametrize("page", EXAMPLES)
def test_the_examples_of_a_page_run_and_print_what_it_says(page, tmp_path, monkeypatch, request):
    monkeypatch.chdir(tmp_path)
    if page == page_of("report"):  # whose figures its own tests draw
        request.getfixturevalue("blank_figures")
    text, namespace = page.read_text(), {}
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


@pytest.mark.parametrize("namespace", NAMESPACES)
def test_every_public_name_has_an_entry_and_an_example(namespace):
    module, text = import_module(namespace), page_of(namespace).read_text()
    entries = set(re.findall(r"^\.\. (?:auto\w+|py:data):: ([\w.]+)$", text, flags=re.M))
    used = names_used("\n".join(block[1] for block in BLOCK.finditer(text)))
    parts = {name for name in module.__all__ if isinstance(getattr(module, name), ModuleType)}
    parts = {name for name in parts if f"{namespace}.{name}" in NAMESPACES}  # on their own pages
    for name in module.__all__:
        assert name in parts or f"{namespace}.{name}" in entries, f"{name} has no entry"
        at_top = getattr(trustbo, name, None) is getattr(module, name)  # also named there
        names = {f"{namespace}.{name}"} | ({f"trustbo.{name}"} if at_top else set())
        assert names & used, f"{name} has no example"


def names_used(code):
    """Full names of what code uses; to import a thing, or to write of it, is not to use it."""
    tree, imported = ast.parse(code), {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imported |= {alias.asname: alias.name for alias in node.names if alias.asname}
        elif isinstance(node, ast.ImportFrom):
            imported |= {a.asname or a.name: f"{node.module}.{a.name}" for a in node.names}
    loaded = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Load)
    ]
    roots = (ast.unparse(node).partition(".") for node in loaded)
    return {f"{imported.get(root, root)}{dot}{rest}" for root, dot, rest in roots}


def test_a_name_in_a_comment_an_import_or_of_something_else_is_not_used():
    code = "import trustbo as tb\nfrom trustbo import a, b\nb.c(d=1)  # tb.e\nmine.f = tb.g.h"
    used = {"b", "b.c", "g", "g.h"}
    assert names_used(code) == {"mine", "trustbo", *(f"trustbo.{name}" for name in used)}


def test_every_entry_is_public():
    for namespace in NAMESPACES:
        module = import_module(namespace)
        entries = re.findall(
            r"^\.\. (?:auto\w+|py:data):: ([\w.]+)$", page_of(namespace).read_text(), re.M
        )
        below = [e.removeprefix(f"{namespace}.") for e in entries if e != namespace]
        strangers = [name for name in below if name.partition(".")[0] not in module.__all__]
        # What calls return has an entry by its module, and is no name of the package.
        returned = [name for name in strangers if "." in name]
        assert [name for name in strangers if name not in returned] == []
        for name in returned:
            part, _, leaf = name.rpartition(".")
            assert hasattr(import_module(f"{namespace}.{part}"), leaf)


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


ARCHITECTURE = (ROOT / "docs" / "architecture.md").read_text()
CODE = [
    *(ROOT / name for name in ("pyproject.toml", "Makefile", "README.md", "CONTRIBUTING.md")),
    *(
        file
        for folder in ("src", "tests", "scripts", "benchmarks", "docs")
        for pattern in ("*.py", "*.md")
        for file in sorted((ROOT / folder).rglob(pattern))
    ),
]
OUTSIDE = re.compile(r"\b(?:DES[I]GN|ST[Y]LE)\b")
"""Design and style papers that are not in the repository; docs/architecture.md has what holds."""


def test_code_cites_only_documents_of_the_repository():
    for file in CODE:
        text = file.read_text(encoding="utf-8")
        assert not (found := OUTSIDE.search(text)), f"{name_of(file)} cites {found[0]}"
        for page in re.findall(r"(?<![\w/])docs/[\w/-]+\.md", text):
            assert (ROOT / page).is_file(), f"{name_of(file)} cites {page}"


def test_the_architecture_names_every_room_in_the_order_of_imports():
    table = ARCHITECTURE.split("| room | content |")[1].split("\n\n")[0]
    rows = [re.findall(r"`(\w+)(?:/|\.py)`", row.split("|")[1]) for row in table.splitlines()[2:]]
    config = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    layers = [layer.split(" | ") for layer in config["contracts"][0]["layers"]]
    assert [sorted(row) for row in rows] == [sorted(names) for names in layers[1:]]  # __main__


def test_the_architecture_names_files_that_there_are_and_no_walk_opens_one_twice():
    files = [f"/{f.relative_to(ROOT)}" for f in CODE]
    for name in re.findall(r"`([\w/]+\.(?:py|md))`", ARCHITECTURE):
        assert any(file.endswith(f"/{name}") for file in files), name
    table = ARCHITECTURE.split("| argument | files, each opened once |")[1].split("\n\n")[0]
    walks = [re.findall(r"`([\w/]+\.py)`", row) for row in table.splitlines()[2:]]
    assert len(walks) == 4
    for walk in walks:
        assert len(walk) == len(set(walk)) > 5


def sampler_of(model):
    try:
        return resolve_sampler(model, "auto")[0]
    except TrustboError:
        return "refused"


def test_the_architecture_says_which_sampler_auto_takes():
    place = PlaceEffect()
    models = {
        "`PooledTrust`, `HierarchicalTrust`": (PooledTrust, HierarchicalTrust),
        "the same, places": (
            partial(PooledTrust, place=place),
            partial(HierarchicalTrust, place=place),
        ),
        "`CoupledTrust`, none": (partial(CoupledTrust, inter_robot="none"),),
        "`CoupledTrust`, none, places": (partial(CoupledTrust, inter_robot="none", place=place),),
        "`CoupledTrust`": (CoupledTrust,),
    }
    table = ARCHITECTURE.split("| model | gaussian |")[1].split("\n\n")[0].splitlines()
    families = [("gaussian",), ("censored", "beta_binomial")]
    for row in table[2:]:
        name, *said = (cell.strip() for cell in row.strip("|").split("|"))
        for model in models.pop(name):
            for expected, some in zip(said, families, strict=True):
                for family in some:
                    assert sampler_of(model(observation=family)) == expected, name
    assert models == {}


def test_pages_count_the_rows_of_the_table_of_calibration():
    n = (ROOT / "docs/calibration.md").read_text(encoding="utf-8").count("| not rejected |")
    for page in ("README.md", "docs/claims.md"):
        assert f"calibration of {n} models" in (ROOT / page).read_text(encoding="utf-8")


def test_every_benchmark_is_described():
    page = (ROOT / "docs" / "benchmarks.md").read_text()
    scripts = {script.name for script in (ROOT / "benchmarks").glob("*.py")} - {
        "common.py",
        "groups.py",
        "sbc_places.py",
    }
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
            assert texts.pop(flag) == help_text
        assert texts == {}, f"trustbo {name} has no such flags"


def test_the_page_on_planning_says_which_path_every_objective_prefers():
    text = (ROOT / "docs" / "planning.md").read_text()
    table = text.split("| objective | prefers | take it when |")[1].split("\n\n")[0]
    rows = re.findall(r"^\| `(\w+)` \| (.{20,}) \| (.{20,}) \|$", table, flags=re.M)
    assert [name for name, *_ in rows] == list(trustbo.planning.OBJECTIVES)


def inventory(*names):
    """An inventory as Sphinx writes it, of classes."""
    lines = "".join(f"{name} py:class 1 api.html#$ -\n" for name in names)
    head = "# Sphinx inventory version 2\n# Project: other\n# Version: 1\n# zlib-compressed.\n"
    return head.encode() + zlib.compress(lines.encode())


def built(folder, projects, page):
    """HTML of a page, built with warnings as errors; Sphinx cannot be asked twice in a process."""
    (folder / "docs").mkdir()
    (folder / "docs" / "index.rst").write_text(page)
    (folder / "docs" / "conf.py").write_text(
        f"import sys\nsys.path.insert(0, {str(ROOT / 'docs' / 'extensions')!r})\n"
        "extensions = ['other_projects', 'sphinx.ext.autodoc']\n"
        f"autodoc_typehints_format = 'short'\nother_projects = {projects!r}\n"
    )
    command = [sys.executable, "-m", "sphinx", "-W", "-q", "docs", "site"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return (folder / "site" / "index.html").read_text()


def test_signatures_link_to_other_projects_where_these_can_be_reached(tmp_path):
    """One has its inventory, one has none, and one is behind no network: no warning of any."""
    pytest.importorskip("sphinx", reason="needs the extra docs")
    (tmp_path / "objects.inv").write_bytes(inventory("xarray.DataTree"))
    page = (
        "Title\n=====\n\n.. autofunction:: trustbo.inference.complete\n\n"
        ".. automethod:: trustbo.Result.table\n"
    )
    files = partial(SimpleHTTPRequestHandler, directory=tmp_path)
    with ThreadingHTTPServer(("127.0.0.1", 0), files) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        here = f"http://127.0.0.1:{server.server_port}/"
        projects = {"xarray": here, "none": f"{here}none/", "pandas": "http://127.0.0.1:9/"}
        html = built(tmp_path, projects, page)
        server.shutdown()
    # The annotation's name is xarray.core.datatree.DataTree.
    assert f'href="{here}api.html#xarray.DataTree"' in html
    assert "DataFrame" in html
    assert "127.0.0.1:9/" not in html


@pytest.mark.parametrize("namespace", [n for n in NAMESPACES if n != "trustbo.paper"])
def test_a_page_of_the_api_opens_with_calls_to_make(namespace):
    """Verbs, such as `fit`, before classes and the fields of their parameters."""
    head = page_of(namespace).read_text().partition("\n```")[0]
    calls = re.findall(r"^\| \{py:obj\}`tb\.?\S* <([\w.]+)>` \| [a-z].* \|$", head, flags=re.M)
    assert head.count("\n|") == len(calls) + 2, "a row is not as the others"
    for call in calls:
        thing = import_module(namespace)
        for part in call.removeprefix(f"{namespace}.").split("."):
            thing = getattr(thing, part)
        assert callable(thing)
        assert not isinstance(thing, type), f"{call} is a class"
