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
def finished(invoke, flags, tmp_path_factory, leave_figures_blank):
    """The folder of a run of two missions, and what it printed; its figures are blank."""
    out = tmp_path_factory.mktemp("runs") / "mine"
    given = *flags, "--max-slope", 40, "--lidar-range", 80, "--iterations", 2, "--seed", 1
    with pytest.MonkeyPatch.context() as patch:
        leave_figures_blank(patch)
        done = invoke("run", *given, "--out", out)
    assert done.exit_code == 0, done.output
    return out, done
