"""The command lines of README and docs run as printed, one after the other, page by page."""

import re
import shlex
import shutil
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
from typer.testing import CliRunner

import trustbo as tb
from trustbo.cli import app

ROOT = Path(__file__).resolve().parents[1]
BLOCKS = re.compile(r"^```(sh|yaml)\n(.*?)^```", flags=re.S | re.M)
SETUP = ("git", "cd", "make", "pip", "python", ".venv/bin/python")  # what CI does to get here


def steps_of(page):
    """What to type, and the files to make before: (command, None) or (name, content)."""
    for kind, text in BLOCKS.findall(page.read_text()):
        if kind == "yaml":
            if name := re.match(r"# (\S+\.yaml)\n", text):
                yield name[1], text
            continue
        for line in text.splitlines():
            words = shlex.split(line, comments=True)
            if words and words[0] not in SETUP:
                yield words, None


PAGES = {
    str(page.relative_to(ROOT)): steps
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
    if (steps := list(steps_of(page))) and any(content is None for _, content in steps)
}

_, STUDY = next(steps_of(ROOT / "docs" / "howto" / "run-a-study.md"))


@pytest.fixture(scope="module")
def terrain():
    """A rectangle, as most people's is."""
    return tb.terrain.synthetic_terrain((100.0, 120.0), seed=3, relief=5.0)


@pytest.fixture(scope="module")
def campaign(terrain, tmp_path_factory):
    """What earlier commands would have left, for pages that begin later."""
    folder = tmp_path_factory.mktemp("campaign") / "mine"
    workspace = tb.Workspace.from_terrain(terrain, (3, 3))
    tb.iterate(
        workspace, (2, 0), (0, 2), n_iterations=2, sampler="exact", checkpoint=folder,
        progress=False,
    )  # fmt: skip
    return folder


def short(yaml):
    """A study of few runs; any other file as it is."""
    return re.sub(r"(seeds|n_iterations): \d+", r"\1: 2", yaml)


def shorter(words, page):
    """Flags that win over those of a command: two missions, and one more when it is resumed.

    README's commands run as printed; those of other pages sample exactly, whatever they say.
    """
    if words[0] == "resume":
        return ["--iterations", "3"] if "--iterations" in words else []
    if words[0] not in ("run", "demo"):
        return []
    return ["--iterations", "2", *(["--sampler", "exact"] if page != "README.md" else [])]


@pytest.mark.usefixtures("blank_figures")  # a run on real terrain, in cli/, draws them
@pytest.mark.parametrize(
    "page",  # every command is on that of the command line, and most on another
    [pytest.param(p, marks=pytest.mark.slow if p == "docs/cli.md" else ()) for p in PAGES],
)
def test_the_commands_of_a_page_run_from_top_to_bottom(
    page, terrain, campaign, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "loky", None)  # studies run here, not in processes of loky
    for name in ("dem", "dsm"):
        terrain[name].astype("float32").rio.to_raster(f"{name}.tif")
    commands = [words for words, content in PAGES[page] if content is None]
    for name in () if commands[0][1] in ("run", "demo", "info") else ("mine", "demo"):
        shutil.copytree(campaign, Path("out") / name, ignore=shutil.ignore_patterns(".lock"))
    Path("config.yaml").write_text(short(STUDY))  # a user's own
    for words, content in PAGES[page]:
        if content is not None:
            Path(words).write_text(short(content))
            continue
        assert words[0].removeprefix(".venv/bin/") == "trustbo", words
        done = CliRunner().invoke(app, [*words[1:], *shorter(words[1:], page)])
        assert done.exit_code == 0, f"{shlex.join(words)}\n{done.output}"
    plt.close("all")


def test_a_newcomer_s_figure_takes_four_commands_of_the_readme():
    block = BLOCKS.search((ROOT / "README.md").read_text())[2]
    commands = [shlex.split(line, comments=True) for line in block.splitlines() if line.strip()]
    assert [words[0] for words in commands] == ["git", "cd", "make", ".venv/bin/trustbo"]
    assert commands[3][1] == "run"
    assert ["--dem", "dem.tif", "--dsm", "dsm.tif"] == commands[3][2:6]


def test_pages_with_commands_are_found():
    assert {"README.md", "docs/cli.md", "docs/howto/export-to-gis-and-ros.md"} <= set(PAGES)
