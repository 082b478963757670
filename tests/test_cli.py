"""Commands: what they write, how they fail, and that their help imports nothing heavy."""

import io
import re
import subprocess
import sys

import numpy as np
import pytest
import rasterio
from commands import call
from disks import full_disk
from worlds import hillside

import trustbo as tb
from trustbo.cli import FORMATS, LIMITS, OBJECTIVES, POLICIES
from trustbo.export import WRITERS as ALL_FORMATS


@pytest.fixture(scope="module")
def rasters(tmp_path_factory):
    """A folder with dem.tif and dsm.tif."""
    folder = tmp_path_factory.mktemp("rasters")
    terrain = hillside()
    for name in ("dem", "dsm"):
        terrain[name].astype("float32").rio.to_raster(folder / f"{name}.tif")
    return folder


@pytest.fixture(scope="module")
def flags(rasters):
    files = "--dem", rasters / "dem.tif", "--dsm", rasters / "dsm.tif"
    return ("run", *files, "--start", "2,0", "--goal", "0,2", "--shape", "3,3")


@pytest.fixture(scope="module")
def campaign(flags, tmp_path_factory):
    """Folder of a campaign of two missions."""
    folder = tmp_path_factory.mktemp("campaign") / "mine"
    assert call(*flags, "--missions", 2, "--seed", 1, "--out", folder) == 0
    return folder


def test_run_writes_a_campaign_with_its_report_and_maps(campaign):
    assert {"report.html", "maps.tif", "path.geojson"} <= {f.name for f in campaign.iterdir()}
    assert len(tb.load_result(campaign).missions) == 2


def test_a_resumed_campaign_equals_one_that_was_not_interrupted(campaign, flags, rasters, tmp_path):
    """Also if its start is given by a position in the cell."""
    with rasterio.open(rasters / "dem.tif") as raster:
        left, bottom, _, _ = raster.bounds
    words = [f"x={left + 15.0},y={bottom + 15.0}" if word == "2,0" else word for word in flags]
    assert words != list(flags)
    assert call(*words, "--missions", 1, "--seed", 1, "--quiet", "--out", tmp_path / "two") == 0
    assert call("resume", tmp_path / "two", "--missions", 2, "--quiet") == 0
    one, two = tb.load_result(campaign), tb.load_result(tmp_path / "two")
    assert one.path == two.path
    assert one.plan().value == two.plan().value


def test_an_existing_campaign_is_replaced_only_if_asked_to(campaign, flags, capsys):
    before = sorted(campaign.iterdir())
    assert call(*flags, "--missions", 1, "--out", campaign) == 1
    assert capsys.readouterr().err.count("error: ") == 1
    assert sorted(campaign.iterdir()) == before


def test_export_writes_the_formats_asked_for(campaign, tmp_path, capsys):
    assert call("export", campaign, "--format", "csv", "geojson", "--out", tmp_path) == 0
    written = capsys.readouterr().out.split()
    assert written == [str(tmp_path / "missions.csv"), str(tmp_path / "path.geojson")]


def test_info_describes_and_draws_the_grid(rasters, tmp_path, capsys):
    picture = tmp_path / "grid.png"
    files = rasters / "dem.tif", rasters / "dsm.tif"
    assert call("info", *files, "--shape", "3,3", "--out", picture) == 0
    assert "3 x 3" in capsys.readouterr().out
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_info_on_a_full_disk_leaves_the_figure_as_it_was(rasters, tmp_path, capsys):
    picture = tmp_path / "grid.png"
    picture.write_bytes(b"before")
    files = rasters / "dem.tif", rasters / "dsm.tif"
    with full_disk():
        assert call("info", *files, "--shape", "3,3", "--out", picture) == 1
    assert "grid.png" in capsys.readouterr().err
    assert picture.read_bytes() == b"before"


def test_info_refuses_an_unknown_format_of_the_figure(rasters, tmp_path, capsys):
    files = rasters / "dem.tif", rasters / "dsm.tif"
    assert call("info", *files, "--shape", "3,3", "--out", tmp_path / "grid.xyz") == 1
    assert "xyz" in capsys.readouterr().err


def test_info_states_the_slope_limit_and_the_cells_that_are_passable_with_it(
    rasters, tmp_path, capsys
):
    files = rasters / "dem.tif", rasters / "dsm.tif"

    def stated(*words):
        """Degrees, passable cells and all cells in the printed line."""
        assert call("info", *files, "--shape", "3,3", "--out", tmp_path / "grid.png", *words) == 0
        [line] = [x for x in capsys.readouterr().out.splitlines() if x.startswith("slope limit")]
        return [int(number) for number in re.findall(r"\d+", line)]

    terrain = tb.terrain.read_terrain(*files)
    for degrees, words in ((45, ()), (12, ("--max-slope", "12"))):
        robot = tb.Robot(max_slope=np.radians(degrees))
        team = tb.Team(robots=(robot,) * 3, lead=robot)
        workspace = tb.Workspace.from_terrain(terrain, (3, 3), team)
        assert stated(*words) == [degrees, int(workspace.passable.sum()), 9]


@pytest.mark.parametrize(
    "words",
    [
        ("run", "--dem", "absent.tif", "--start", "0,0", "--goal", "1,1"),
        ("resume", "absent"),
        ("export", "absent"),
        ("info", "absent.tif"),
    ],
)
def test_a_missing_file_is_an_error_of_one_line(words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call(*words) == 1
    assert capsys.readouterr().err.startswith("error: ")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_paths_with_letters_that_the_terminal_lacks_are_printed(
    name, campaign, tmp_path, monkeypatch
):
    written = io.BytesIO()
    monkeypatch.setattr(sys, name, io.TextIOWrapper(written, "cp1252", write_through=True))
    folder = tmp_path / "\u9ad8\u5ea6"
    if name == "stdout":
        assert call("export", campaign, "--format", "csv", "--out", folder) == 0
    else:
        assert call("resume", folder) == 1
    assert b"??" in written.getvalue()


def test_an_interrupted_command_says_how_to_resume_a_campaign(campaign, capsys, monkeypatch):
    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(tb, "resume", interrupt)
    monkeypatch.setattr(tb, "load_result", interrupt)
    for command, remedy in (("resume", True), ("export", False)):
        assert call(command, campaign) == 130
        assert (f"trustbo resume {campaign}" in capsys.readouterr().err) is remedy


@pytest.mark.parametrize(
    "changed",
    [
        ("--start", "20,0"), ("--start", "x=1"), ("--shape", "3"), ("--missions", "0"),
        ("--policy", "bold"), ("--robots", "two"), ("--max-slope", "0"), ("--stop-regret", "5"),
    ],
)  # fmt: skip
def test_impossible_values_are_refused_before_anything_is_written(changed, flags, tmp_path, capsys):
    assert call(*flags, *changed, "--out", tmp_path / "out") in (1, 2)  # 2: by argparse
    assert "error: " in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (("--start", "9,0"), "start (9, 0)"),
        (("--goal", "0,9"), "goal (0, 9)"),
        (("--max-slope", "95"), "degrees; got '95'"),
    ],
)
def test_errors_speak_of_the_flag_and_its_unit(changed, said, flags, tmp_path, capsys):
    assert call(*flags, *changed, "--out", tmp_path / "out") in (1, 2)  # 2: by argparse
    assert said in capsys.readouterr().err


def test_the_choices_of_flags_are_names_that_the_package_knows():
    assert set(POLICIES) == set(tb.planning.POLICIES)
    assert set(OBJECTIVES) == set(tb.planning.OBJECTIVES)
    assert set(FORMATS) == set(ALL_FORMATS)
    assert [tb.hazard.Hazard(limit=limit).limit for limit in LIMITS] == [*LIMITS]


def test_help_imports_nothing_heavy():
    code = "import sys; from trustbo.cli import parser; parser().format_help(); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"numpy", "jax", "matplotlib", "xarray"} & set(done.stdout.split())
