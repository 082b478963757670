"""One small campaign, run by the command line, for all commands."""

import pytest
from typer.testing import CliRunner
from worlds import hillside

from trustbo.cli import app

RUN = ("--start", "2,0", "--goal", "0,2", "--shape", "3,3", "--sampler", "exact")


@pytest.fixture(scope="session")
def invoke():
    """Run the program in this process; its exit code and what it printed."""

    def call(*arguments):
        return CliRunner().invoke(app, [str(a) for a in arguments])

    return call


@pytest.fixture(scope="session")
def rasters(tmp_path_factory):
    """A folder with dem.tif and dsm.tif."""
    folder = tmp_path_factory.mktemp("rasters")
    terrain = hillside()
    for name in ("dem", "dsm"):
        terrain[name].astype("float32").rio.to_raster(folder / f"{name}.tif")
    return folder


@pytest.fixture(scope="session")
def flags(rasters):
    """The flags of a run on these rasters."""
    return ("--dem", rasters / "dem.tif", "--dsm", rasters / "dsm.tif", *RUN)


@pytest.fixture(scope="session")
def finished(invoke, rasters, tmp_path_factory, leave_figures_blank):
    """The folder of a run of two missions, and what it printed; its figures are blank.

    Its flags are in a file, but for two, which are given in spite of it, and --out.
    """
    out = tmp_path_factory.mktemp("runs") / "mine"
    (rasters / "mission.yaml").write_text(
        "dem: dem.tif\ndsm: dsm.tif\nstart: [2, 0]\ngoal: 0,2\nshape: 3,3\nsampler: exact\n"
        "iterations: 5\nmax-slope: 40\nlidar_range: 80\nseed: 3\nmax-failure: 0.5\n"
        "failure-cost: 2.5\n"
    )
    given = "--config", rasters / "mission.yaml", "--iterations", 2, "--seed", 1
    with pytest.MonkeyPatch.context() as patch:
        leave_figures_blank(patch)
        patch.chdir(out.parent)  # rasters are found beside the file
        done = invoke("run", *given, "--out", out)
    assert done.exit_code == 0, done.output
    return out, done
