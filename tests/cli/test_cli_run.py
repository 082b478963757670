"""`trustbo run` and `demo`: what they write, what they refuse, and in which words."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
import rasterio
import xarray as xr
from rasterio.errors import NotGeoreferencedWarning

import trustbo as tb


def test_run_writes_every_file_and_says_where(finished):
    out, done = finished
    names = {path.name for path in out.iterdir()}
    assert names >= {
        "posterior.nc",
        "history.csv",
        "maps.png",
        "terrain.png",
        "report.html",
        "explore.html",
        "maps.tif",
        "path.geojson",
        "result.json",
        "campaign.json",
    }
    assert "trust_map.tif" not in names
    first = "report.html, explore.html, maps.png, terrain.png, maps.tif"
    assert f"results are in {out}/: {first}" in done.output
    assert "path.geojson,\n" in done.output
    assert "mission  status  contact  objective  k-hat  path" in done.output
    assert "stopped: n_iterations" in done.output
    assert "recommended: 2,0 " in done.output
    assert (out / "maps.png").read_bytes().startswith(b"\x89PNG")


def test_run_s_files_say_the_same(finished):
    out, _ = finished
    history = pd.read_csv(out / "history.csv")
    assert list(history["mission"]) == [1, 2]
    record = json.loads((out / "result.json").read_text())
    assert record["settings"]["seed"] == 1
    posterior = xr.open_datatree(out / "posterior.nc")
    assert posterior["log_likelihood"].sizes["mission"] == 2
    posterior.close()
    line = json.loads((out / "path.geojson").read_text())["features"][0]
    assert len(line["geometry"]["coordinates"]) == len(record["path"])
    assert "after 2 missions" in (out / "report.html").read_text()


@pytest.mark.usefixtures("blank_figures")
def test_run_passes_every_choice_on_and_resume_drives_nothing_again(invoke, flags, tmp_path):
    done = invoke(
        *("run", *flags, "--iterations", 9, "--model", "pooled", "--seed", 4),
        *("--objective", "mean", "--stop-regret", 0.9, "--quiet"),
        *("--out", tmp_path),
    )
    assert done.exit_code == 0, done.output
    record = json.loads((tmp_path / "result.json").read_text())
    chosen = {"seed": 4, "objective": "mean"}
    assert {name: record["settings"][name] for name in chosen} == chosen
    assert record["stop_reason"].startswith("regret_bound: P(regret <= 0.9)")
    assert record["n_missions"] == 3  # the fewest that the rule asks for
    before = tb.load_result(tmp_path)
    (tmp_path / "report.html").unlink()
    # What is done is not driven again, but judged by another rule, and drawn.
    done = invoke("resume", tmp_path, "--stop-regret", 0.8, "--iterations", 3)
    assert done.exit_code == 0, done.output
    assert "all 3 missions are done; for more, give --iterations." in done.output
    again = tb.load_result(tmp_path)
    assert (len(again.missions), again.path) == (3, before.path)
    assert again.stop_reason.startswith("regret_bound: P(regret <= 0.8)")
    np.testing.assert_array_equal(again.trust_map, before.trust_map)
    assert (tmp_path / "report.html").exists()


@pytest.mark.parametrize(
    ("name", "epsg", "shape", "ends", "place"),
    [
        ("wellington", 2193, "10,10", ("9,0", "0,9"), (175.40, -40.92)),
        ("tahoe", 32611, "10,10", ("9,0", "0,9"), (-119.93, 39.29)),
        ("bcts", 3005, "20,4", ("19,0", "0,3"), (-127.63, 50.67)),
    ],
)
@pytest.mark.slow  # test_demo runs on wellington, too
def test_run_on_real_terrain(
    name, epsg, shape, ends, place, invoke, real_terrain, tmp_path, request
):
    dem, dsm = real_terrain(name)
    if name != "bcts":  # which has the largest page, so its figures are drawn
        request.getfixturevalue("blank_figures")
    done = invoke(
        *("run", "--dem", dem, "--dsm", dsm, "--shape", shape, "--start", ends[0]),
        *("--goal", ends[1], "--iterations", 1, "--sampler", "exact", "--out", tmp_path),
        "--quiet",
    )
    assert done.exit_code == 0, done.output
    with rasterio.open(tmp_path / "maps.tif") as source:
        assert source.crs.to_epsg() == epsg
        assert f"{source.height},{source.width}" == shape
        assert np.isfinite(source.read(1)).any()
    line = json.loads((tmp_path / "path.geojson").read_text())["features"][0]
    coordinates = np.array(line["geometry"]["coordinates"])
    np.testing.assert_allclose(coordinates.mean(0), place, atol=0.02)
    assert (tmp_path / "report.html").stat().st_size < 3e6


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_demo_runs_on_the_rasters_it_writes(invoke, tmp_path):
    out = tmp_path / "demo"
    done = invoke("demo", "--iterations", 1, "--sampler", "exact", "--out", out, "--quiet")
    assert done.exit_code == 0, done.output
    assert {"dem.tif", "dsm.tif", "maps.png", "report.html"} <= {p.name for p in out.iterdir()}
    assert "mission  status" not in done.output


def test_a_dem_alone_is_enough_and_its_feet_are_read(invoke, rasters, flags, tmp_path):
    feet = tmp_path / "feet.tif"
    shutil.copy(rasters / "dem.tif", feet)
    with rasterio.open(feet, "r+") as source:
        source.write(source.read() / np.float32(0.3048))
        source.units = ["ft"]
    # A short range, for else nothing would hide the lead; it ends once the workspace is made.
    short = ("--lidar-range", 20, "--max-bounds", 1, "--quiet")
    done = invoke("run", "--dem", feet, *flags[4:], *short, "--out", tmp_path)
    assert "--max-bounds = 1 is below the fewest possible" in done.stderr
    assert done.stderr.count("are converted to metres") == 1
    assert done.stderr.count("no surface (DSM) is given") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("--start", "9,9"),
            "start '9,9' (row 9, column 9) is outside the grid of 3 rows and 3 columns",
        ),
        (("--goal", "2,0"), "start and goal are the same cell (2, 0)"),
        (
            ("--start", "2;0"),
            "start must be two whole numbers (row, col), or a position with names; got '2;0'",
        ),
        (("--policy", "bold"), "unknown policy 'bold'; choose one of greedy, optimistic, thompson"),
        (("--objective", "best"), "unknown objective 'best'; choose one of lost_contact, terminal"),
        (
            ("--model", "own"),
            "unknown model 'own'; choose one of robots, places, pooled, hierarchical, coupled",
        ),
        (("--sampler", "gibbs"), "unknown sampler 'gibbs'; choose one of auto, exact, nuts, joint"),
        (
            ("--observation", "odd"),
            "unknown observation 'odd'; choose one of gaussian, censored",
        ),
        (("--stop-regret", "2"), "--stop-regret must be in (0, 1); got 2.0"),
        (
            ("--model", "coupled", "--observation", "censored"),
            'sampler "exact" cannot treat Coup',
        ),
        (("--iterations", "0"), "--iterations must be a whole number from 1 on; got 0"),
        (("--sight", "fog"), "unknown sight mode 'fog'; choose one of bare, wall, transmittance"),
        (("--seed", "-1"), "seed must be a whole number from 0 on; got -1"),
        (("--max-slope", "95"), "--max-slope must be between 0 and 90 degrees; got 95"),
        (("--max-slope", "0.1"), "no cell is passable"),
        (("--robots", "0"), "--robots must be a whole number from 1 on; got 0"),
        (("--dsm", "absent.tif"), "dsm: there is no file 'absent.tif'"),
        (("--resolution", "60"), "90 x 90 pixels, too few to average 60 x 60 of them"),
        (("--resolution", "0"), "resolution must be positive and finite; got 0.0"),
        (("--shape", "100,100"), "needs at least 2 x 2 pixels per cell"),
    ],
)
def test_bad_input_is_one_line_exit_2_and_nothing_written(
    arguments, message, invoke, flags, tmp_path
):
    out = tmp_path / "never"
    done = invoke("run", *flags, "--out", out, *arguments)
    assert done.exit_code == 2
    assert done.stderr.startswith("error: ")
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not out.exists()


def test_errors_speak_of_the_flags_that_mend_them(invoke, flags, tmp_path):
    """As typed, they do: each remedy is taken, and leads to the next error or to none."""
    heights = np.random.default_rng(0).uniform(100.0, 101.0, (30, 30)).astype("float32")
    heights[3, 4] = 12345.0
    profile = {"height": 30, "width": 30, "count": 1, "dtype": "float32"}
    with (
        pytest.warns(NotGeoreferencedWarning),
        rasterio.open(tmp_path / "bare.tif", "w", "GTiff", **profile) as sink,
    ):
        sink.write(heights, 1)
    out = tmp_path / "never"
    words = ["run", *flags[4:], "--dem", tmp_path / "bare.tif", "--out", out]
    for remedy, said in (
        ([], "pass both --crs and --resolution (metres).\n"),
        (["--crs", "EPSG:32633", "--resolution", 1], "Pass --nodata 12345.0, or set the tag"),
        (
            ["--nodata", "12345.0", "--model", "coupled", "--observation", "censored"],
            "Use --sampler auto.\n",
        ),
    ):
        words += remedy
        done = invoke(*words)
        assert done.exit_code == 2
        assert said in done.stderr, done.stderr
    assert not out.exists()


def test_demo_writes_nothing_on_bad_input(invoke, tmp_path):
    done = invoke("demo", "--policy", "bold", "--out", tmp_path / "never")
    assert done.exit_code == 2
    assert not (tmp_path / "never").exists()


def kept_in(folder):
    """The bytes of all that a campaign left, the files that a run may touch among them."""
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file() and p.name != ".lock"}


@pytest.mark.usefixtures("blank_figures")
def test_a_campaign_is_not_erased_unless_asked_for(invoke, flags, finished, tmp_path):
    out = tmp_path / "mine"
    shutil.copytree(finished[0], out)
    before = kept_in(out)
    for command in (("run", *flags), ("demo",)):
        done = invoke(*command, "--out", out)
        assert done.exit_code == 2
        assert done.stderr == (
            f"error: '{out}' holds a campaign: trustbo resume {out} goes on with it; give another "
            "--out, or --overwrite to replace it.\n"
        )
        assert kept_in(out) == before  # no dem.tif either
    again = ("run", *flags, "--iterations", 1, "--seed", 8, "--out", out, "--overwrite", "--quiet")
    done = invoke(*again)
    assert done.exit_code == 0, done.output
    record = json.loads((out / "result.json").read_text())
    assert (record["n_missions"], record["settings"]["seed"]) == (1, 8)


def test_a_result_saved_in_python_is_not_erased_either(invoke, flags, tmp_path):
    (tmp_path / "result.json").write_text("{}")
    done = invoke("run", *flags, "--out", tmp_path)
    assert done.exit_code == 2
    assert "holds a result; give another --out, or --overwrite to replace it" in done.stderr


@pytest.mark.parametrize("name", ["report.html", "maps.png", "path.geojson", "dem.tif"])
def test_a_folder_in_place_of_a_file_is_named_before_any_work(name, invoke, tmp_path):
    (tmp_path / name).mkdir()
    done = invoke("demo", "--out", tmp_path)
    assert done.exit_code == 2
    assert done.stderr == (
        f"error: cannot write '{tmp_path / name}': it is a folder; name a file in it.\n"
    )
    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_debug_shows_the_traceback(invoke, flags, tmp_path):
    done = invoke("run", *flags, "--policy", "bold", "--out", tmp_path, "--debug")
    assert isinstance(done.exception, ValueError)


def test_the_demo_does_not_replace_a_dem_of_others(invoke, tmp_path):
    (tmp_path / "dem.tif").write_text("mine")
    done = invoke("demo", "--out", tmp_path, "--overwrite")
    assert done.exit_code == 2
    assert "dem.tif' is not that of the demo, and would be replaced; give another" in done.stderr
    assert (tmp_path / "dem.tif").read_text() == "mine"
