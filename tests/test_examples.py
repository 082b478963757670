"""Each public class and function has an example in its docstring, and the examples run."""

import ast
import dataclasses
import doctest
import functools
import importlib
import inspect
import io
import re
from contextlib import redirect_stdout
from pathlib import Path
from types import ModuleType

import arviz as az
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import numpyro
import pandas as pd
import pytest
from bags import record
from numpyro import distributions as dist

import trustbo as tb
from trustbo.terrain import FEATURES

API = Path(__file__).resolve().parents[1] / "docs" / "api.md"
START, GOAL = (9, 0), (0, 9)


def public_objects():
    """Classes and functions in `__all__` of the modules that the page api.md lists, by name."""
    modules = re.findall(r"^ +(trustbo[\w.]*)$", API.read_text(), flags=re.M)
    found = {}
    for module in map(importlib.import_module, sorted(modules, key=lambda name: name.count("."))):
        for name in module.__all__:
            value = getattr(module, name)
            if inspect.isclass(value) or inspect.isfunction(value):
                found.setdefault(value, f"{module.__name__}.{name}")
            else:
                assert isinstance(value, ModuleType) or name.isupper(), f"what is {name}?"
    return {name: value for value, name in found.items()}


OBJECTS = public_objects()
SLOW = {
    *("trustbo.Campaign", "trustbo.RegretBound", "trustbo.Result", "trustbo.iterate"),
    *("trustbo.load_result", "trustbo.resume", "trustbo.logs.read_reports"),
    *("trustbo.models.ContactRate", "trustbo.models.HumanTrust", "trustbo.models.PooledTrust"),
    *("trustbo.inference.predict_reports", "trustbo.study.run_grid"),
}
"""Objects whose examples run campaigns or compile models that no other example needs."""
NEEDS = {"trustbo.terrain.read_lidar": "laspy", "trustbo.logs.read_bag": "rosbags"}
"""Packages of the extras, by the object whose example needs them."""


def example_of(value):
    """Section `Example:` of a docstring, which is its last one; empty if there is none."""
    return inspect.getdoc(value).partition("\nExample:\n")[2]


class Prepared:
    """What examples may use without making it; each is made when the first example uses it."""

    az, dataclasses, dist, jnp, np, numpyro, tb = az, dataclasses, dist, jnp, np, numpyro, tb

    @functools.cached_property
    def terrain(self):
        return tb.terrain.synthetic_terrain((150.0, 150.0), seed=3)

    @functools.cached_property
    def workspace(self):
        return tb.Workspace.from_terrain(self.terrain, (10, 10))

    @functools.cached_property
    def simulator(self):
        return tb.simulation.KinematicSimulator(self.workspace)

    @functools.cached_property
    def result(self):
        return tb.iterate(self.workspace, START, GOAL, n_iterations=2, progress=False)

    @functools.cached_property
    def campaign(self):
        return tb.Campaign(self.workspace, START, GOAL)

    @functools.cached_property
    def missions(self):
        return self.result.missions

    @functools.cached_property
    def mission(self):
        return self.missions[0]

    @functools.cached_property
    def path(self):
        return self.mission.path

    @functools.cached_property
    def posterior(self):
        return self.result.posterior

    @functools.cached_property
    def plan(self):
        return self.result.plan()

    @functools.cached_property
    def planner(self):
        return tb.Planner(self.workspace, START, GOAL)

    @functools.cached_property
    def params(self):
        return tb.inference.params_of(self.posterior, self.workspace)

    @functools.cached_property
    def rng(self):
        return np.random.default_rng(0)

    def drive(self, path):
        """Robots that drive a path."""
        return self.simulator.run(path, seed=0)

    def make_scene(self):
        """Scene of a study, whose truth is exact."""
        simulator = tb.simulation.RadioSimulator(self.workspace)
        truth = tb.simulation.Truth.from_simulator(simulator)
        return tb.study.Scene(self.workspace, simulator, START, GOAL, truth=truth)


def write_tables(missions):
    """Write a table, and the same with another name of a column and the file that says so."""
    frame = tb.logs.to_frame(missions)
    frame.to_csv("log.csv", index=False)
    frame.rename(columns={"bound": "leg"}).to_csv("legs.csv", index=False)
    named = [f'{column} = "{column}"' for column in frame if column != "bound"]
    Path("columns.toml").write_text("\n".join(['bound = "leg"', *named]))


def write_files(text, prepared):
    """Write the files that an example reads to the working directory."""
    files = re.findall(r'"(\w+(?:\.\w+)?)"', text)
    for name in files:
        if name in ("dem.tif", "dsm.tif"):
            prepared.terrain[Path(name).stem].rio.to_raster(name)
        elif name == "missions.nc":
            tb.logs.write_missions(name, prepared.missions)
        elif name in ("log.csv", "legs.csv"):
            write_tables(prepared.missions)
        elif name == "log.bag":
            record(prepared.missions, Path(name))
        elif name == "points.laz":
            write_points(name)
        elif name == "poses.csv":
            write_tracks(name, "detections.csv")
        elif name == "answers.csv":
            write_answers(name)
        elif name == "hills":
            hills = {"start": START, "goal": GOAL, "n_iterations": 1, "progress": False}
            tb.iterate(prepared.workspace, directory=name, **hills).close()


def write_points(name):
    """Write lidar points of flat ground in zone 33 of UTM."""
    laspy = pytest.importorskip("laspy", reason="needs the extra lidar")
    import pyproj

    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.header.add_crs(pyproj.CRS.from_user_input("EPSG:32633"))
    east, north = np.meshgrid(np.arange(0.0, 20.0, 0.5), np.arange(0.0, 20.0, 0.5))
    las.x, las.y = 500_000.0 + east.ravel(), 5_000_000.0 + north.ravel()
    las.z = np.full(east.size, 100.0)
    las.classification = np.full(east.size, 2, np.uint8)
    las.write(name)


def write_tracks(poses, detections):
    """Write tracks of two robots that meet and detect each other for a minute."""
    t = np.arange(0.0, 61.0)
    spot = pd.DataFrame({"t": t, "robot": "spot", "x": t, "y": 0.0})
    husky = pd.DataFrame({"t": t, "robot": "husky", "x": 60.0 - t, "y": 5.0})
    pd.concat([spot, husky]).to_csv(poses, index=False)
    saw = pd.DataFrame({"t": t, "watcher": "spot", "seen": "husky"})
    was_seen = saw.rename(columns={"watcher": "seen", "seen": "watcher"})
    pd.concat([saw, was_seen]).to_csv(detections, index=False)


def write_answers(name):
    """Write the answers of twenty persons, on a scale from 1 to 7."""
    rng, rows = np.random.default_rng(1), []
    for person in range(20):
        trust = 0.6 + 0.1 * rng.standard_normal()
        for step in range(6):
            outcome = "" if step == 0 else str(int(rng.random() < 0.6))
            trust += {"": 0.0, "1": 0.05, "0": -0.2}[outcome]
            rows.append((person, step, outcome, np.clip(round(1 + 6 * trust), 1, 7)))
    columns = ["person", "step", "outcome", "report"]
    pd.DataFrame(rows, columns=columns).to_csv(name, index=False)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("prepared"))
        yield Prepared()


def test_each_public_object_has_an_example():
    without = [name for name, value in OBJECTS.items() if not example_of(value)]
    assert OBJECTS
    assert without == [], f"{len(OBJECTS) - len(without)} of {len(OBJECTS)} have one"


EXAMPLES = [
    pytest.param(name, marks=pytest.mark.slow if name in SLOW else ())
    for name, value in OBJECTS.items()
    if example_of(value)
]


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_example_of_a_public_object_runs(name, prepared, tmp_path, monkeypatch):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    monkeypatch.chdir(tmp_path)
    text = example_of(OBJECTS[name])
    statements = doctest.DocTestParser().get_examples(text)
    assert statements, f"the example of {name} has no statement"
    write_files(text, prepared)

    nodes = [node for one in statements for node in ast.walk(ast.parse(one.source))]
    used = {node.id for node in nodes if isinstance(node, ast.Name)}
    namespace = {known: getattr(prepared, known) for known in used if hasattr(Prepared, known)}
    features = set(FEATURES)
    try:
        for one in statements:
            with redirect_stdout(io.StringIO()) as printed:
                exec(compile(one.source, name, "single"), namespace)
            if one.want:
                assert printed.getvalue().split() == one.want.split(), f"{name}: {one.source}"
    finally:
        plt.close("all")
        for added in FEATURES.keys() - features:
            del FEATURES[added]
