"""Settings of every test, and fixtures that several rooms share."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import jax
import matplotlib as mpl
import pytest

from trustbo.terrain.examples import EXAMPLE_FILES

mpl.use("Agg")
signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs in the background ignore it
jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_collection_modifyitems(items):
    """Put the models' tests in the middle, where the second of two workers begins.

    In a fresh clone it then compiles what the first does not need; else both compile the same.
    """
    models = [item for item in items if "tests/models/" in item.nodeid]
    others = [item for item in items if "tests/models/" not in item.nodeid]
    half = min(len(items) // 2, len(others))
    items[:] = [*others[:half], *models, *others[half:]]


@pytest.fixture(scope="session", autouse=True)
def _scratch_folder(tmp_path_factory):
    """Run the tests in a temporary folder, as faulty code may write to a relative path."""
    if "TRUSTBO_DATA" in os.environ:
        os.environ["TRUSTBO_DATA"] = str(Path(os.environ["TRUSTBO_DATA"]).absolute())

    before = Path.cwd()
    os.chdir(tmp_path_factory.mktemp("scratch"))
    yield
    os.chdir(before)


LISTENER = """
import contextlib, io, json, sys, traceback
names = {}
for line in sys.stdin:
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        try:
            exec(json.loads(line), names)
        except BaseException:
            traceback.print_exc(file=printed)
    print(json.dumps(printed.getvalue()), flush=True)
"""


@pytest.fixture(scope="session")
def elsewhere():
    """Run code in another process and return what it prints, or its traceback.

    All tests share the process and its global names, as it takes long to import the package.
    """
    command = [sys.executable, "-W", "ignore", "-c", LISTENER]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes) as process:

        def run(code):
            process.stdin.write(json.dumps(code) + "\n")
            process.stdin.flush()
            return json.loads(process.stdout.readline())

        yield run
        process.stdin.close()


@pytest.fixture(scope="session")
def real_data():
    """The folder of real surveys (CONTRIBUTING says what is in it), without which tests skip."""
    if "TRUSTBO_DATA" not in os.environ:
        pytest.skip("set TRUSTBO_DATA to a folder of real surveys; see CONTRIBUTING.md")
    folder = Path(os.environ["TRUSTBO_DATA"])
    assert folder.is_dir(), f"TRUSTBO_DATA={folder} is no folder"
    return folder


@pytest.fixture(scope="session")
def real_terrain(request):
    """Paths of a real DEM and DSM by name; that of the package needs no other data."""

    def paths(name):
        if name == "wellington":
            return EXAMPLE_FILES
        folder = request.getfixturevalue("real_data") / name
        return folder / "dem.tif", folder / "dsm.tif"

    return paths
