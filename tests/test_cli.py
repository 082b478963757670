"""The command line: what it writes, what it refuses, and in which words."""

import json

import numpy as np
import pandas as pd
import pytest
import rasterio
import xarray as xr
from typer.testing import CliRunner

from trustbo.cli import app
from trustbo.terrain import synthetic_terrain


def invoke(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def rasters(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rasters")
    terrain = synthetic_terrain((90.0, 90.0), seed=5, relief=6.0)
    for name in ("dem", "dsm"):
        terrain[name].astype("float32").rio.to_raster(folder / f"{name}.tif")
    return "--dem", folder / "dem.tif", "--dsm", folder / "dsm.tif"


RUN = ("--start", "2,0", "--goal", "0,2", "--shape", "3,3")


@pytest.fixture(scope="module")
def run_folder(rasters, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "mine"
    done = invoke("run", *rasters, *RUN, "--iterations", 2, "--seed", 1, "--out", out)
    assert done.exit_code == 0, done.output
    return out, done


def test_run_writes_every_file_and_says_where(run_folder):
    out, done = run_folder
    names = {path.name for path in out.iterdir()}
    assert names >= {
        "posterior.nc",
        "history.csv",
        "maps.png",
        "terrain.png",
        "trust_map.tif",
        "path.geojson",
        "result.json",
    }
    assert f"results are in {out}/" in done.output
    assert "mission  status  contact  objective  R-hat  path" in done.output
    assert "recommended: 2,0 " in done.output
    assert (out / "maps.png").read_bytes().startswith(b"\x89PNG")


def test_run_s_files_say_the_same(run_folder):
    out, _ = run_folder
    history = pd.read_csv(out / "history.csv")
    assert list(history["iteration"]) == [1, 2]
    record = json.loads((out / "result.json").read_text())
    assert record["settings"]["seed"] == 1
    posterior = xr.open_datatree(out / "posterior.nc")
    assert posterior["log_likelihood"].sizes["mission"] == 2
    posterior.close()
    line = json.loads((out / "path.geojson").read_text())["features"][0]
    assert len(line["geometry"]["coordinates"]) == len(record["path"])


@pytest.mark.parametrize(
    ("name", "epsg", "shape", "ends", "place"),
    [
        ("wellington", 2193, "10,10", ("9,0", "0,9"), (175.40, -40.92)),
        ("tahoe", 32611, "10,10", ("9,0", "0,9"), (-119.93, 39.29)),
        ("bcts", 3005, "20,4", ("19,0", "0,3"), (-127.63, 50.67)),
    ],
)
def test_run_on_real_terrain(name, epsg, shape, ends, place, real_terrain, tmp_path):
    dem, dsm = real_terrain(name)
    done = invoke(
        *("run", "--dem", dem, "--dsm", dsm, "--shape", shape, "--start", ends[0]),
        *("--goal", ends[1], "--iterations", 1, "--out", tmp_path, "--quiet"),
    )
    assert done.exit_code == 0, done.output
    with rasterio.open(tmp_path / "trust_map.tif") as source:
        assert source.crs.to_epsg() == epsg
        assert f"{source.height},{source.width}" == shape
        assert np.isfinite(source.read(1)).any()
    line = json.loads((tmp_path / "path.geojson").read_text())["features"][0]
    coordinates = np.array(line["geometry"]["coordinates"])
    np.testing.assert_allclose(coordinates.mean(0), place, atol=0.02)


def test_demo_runs_on_the_rasters_it_writes(tmp_path):
    done = invoke("demo", "--iterations", 1, "--out", tmp_path / "demo", "--quiet")
    assert done.exit_code == 0, done.output
    assert (tmp_path / "demo" / "dem.tif").exists()
    assert (tmp_path / "demo" / "maps.png").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--start", "9,9"), "start (9, 9) is outside the grid of 3 rows and 3 columns"),
        (("--goal", "2,0"), "start and goal are the same cell (2, 0)"),
        (("--start", "2;0"), "--start must be two whole numbers as 9,0; got '2;0'"),
        (("--policy", "bold"), "unknown policy 'bold'; choose one of greedy, optimistic, thompson"),
        (("--objective", "best"), "unknown objective 'best'; choose one of terminal, mean"),
        (("--iterations", "0"), "n_iterations must be a whole number from 1 on; got 0"),
        (("--sight", "fog"), "unknown sight mode 'fog'; choose one of bare, wall, transmittance"),
        (("--seed", "-1"), "seed must be a whole number from 0 on; got -1"),
        (("--max-slope", "95"), "--max-slope must be between 0 and 90 degrees; got 95"),
        (("--max-slope", "0.1"), "no cell is passable"),
        (("--robots", "0"), "n_robots must be a whole number from 1 on; got 0"),
        (("--max-bounds", "1"), "max_bounds = 1 is below the fewest possible"),
        (("--dsm", "absent.tif"), "dsm: there is no file 'absent.tif'"),
        (("--shape", "100,100"), "needs at least 2 x 2 pixels per cell"),
    ],
)
def test_bad_input_is_one_line_exit_2_and_nothing_written(arguments, message, rasters, tmp_path):
    out = tmp_path / "never"
    done = invoke("run", *rasters, *RUN, "--out", out, *arguments)
    assert done.exit_code == 2
    assert done.stderr.startswith("error: ")
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not out.exists()


def test_demo_writes_nothing_on_bad_input(tmp_path):
    done = invoke("demo", "--policy", "bold", "--out", tmp_path / "never")
    assert done.exit_code == 2
    assert not (tmp_path / "never").exists()


def test_debug_shows_the_traceback(rasters, tmp_path):
    done = invoke("run", *rasters, *RUN, "--policy", "bold", "--out", tmp_path, "--debug")
    assert isinstance(done.exception, ValueError)


def test_help_teaches():
    assert "trustbo run --dem dem.tif" in invoke("run", "--help").output
    for command in ("run", "demo"):
        assert command in invoke("--help").output
