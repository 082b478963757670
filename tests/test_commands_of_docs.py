"""The command lines of README and docs run as printed, one after the other, page by page."""

import re
import shlex
import shutil
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
from typer.testing import CliRunner

import trustbo as tb
from trustbo.cli import app

ROOT = Path(__file__).resolve().parents[1]
BLOCKS = re.compile(r"^```sh\n(.*?)^```", flags=re.S | re.M)
SETUP = ("git", "cd", "make", "pip", "python", ".venv/bin/python")  # what CI does to get here


def commands_of(page):
    """Words of each command that a page shows."""
    lines = "\n".join(BLOCKS.findall(page.read_text())).splitlines()
    commands = [shlex.split(line, comments=True) for line in lines]
    return [words for words in commands if words and words[0] not in SETUP]


PAGES = {
    str(page.relative_to(ROOT)): commands
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
    if (commands := commands_of(page))
}


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
    for name in ("dem", "dsm"):
        terrain[name].astype("float32").rio.to_raster(f"{name}.tif")
    commands = PAGES[page]
    for name in () if commands[0][1] in ("run", "demo", "info") else ("mine", "demo"):
        shutil.copytree(campaign, Path("out") / name, ignore=shutil.ignore_patterns(".lock"))
    for words in commands:
        assert words[0].removeprefix(".venv/bin/") == "trustbo", words
        done = CliRunner().invoke(app, [*words[1:], *shorter(words[1:], page)])
        assert done.exit_code == 0, f"{shlex.join(words)}\n{done.output}"
    plt.close("all")


def test_a_newcomer_s_figure_takes_four_commands_of_the_readme():
    block = BLOCKS.search((ROOT / "README.md").read_text())[1]
    commands = [shlex.split(line, comments=True) for line in block.splitlines() if line.strip()]
    assert [words[0] for words in commands] == ["git", "cd", "make", ".venv/bin/trustbo"]
    assert commands[3][1] == "run"
    assert ["--dem", "dem.tif", "--dsm", "dsm.tif"] == commands[3][2:6]


def test_pages_with_commands_are_found():
    assert {"README.md", "docs/cli.md", "docs/howto/export-to-gis-and-ros.md"} <= set(PAGES)
