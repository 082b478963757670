"""Studies: the same numbers wherever they run, resumed, and refused before work starts."""

import json
import multiprocessing
import os
import signal
import sys
import threading
import time
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray as xr
from distributed import Client, LocalCluster

import trustbo as tb
from trustbo import study
from trustbo.study import executors, experiment
from trustbo.study.configuration import read_study

DATA = Path(__file__).parents[1] / "data"
TRUTH = {"beta0": 0.6, "beta": [0.3, 0.2], "b": 0.05, "delta_w": 0.05, "delta_v": 0.05}
CONFIG = {
    "terrains": {"cells": {"kind": "random_workspace", "shape": [5, 5], "seed": "run"}},
    "simulators": {"truth": {"kind": "ModelSimulator", "params": {"kind": "TrustParams", **TRUTH}}},
    "policies": ["greedy", "random"],
    "samplers": ["exact"],
    "seeds": 3,
    "n_iterations": 2,
}


def run(folder, executor="serial", **changes):
    return study.run_study(CONFIG | changes, folder, executor, progress=False, n_workers=2)


def keys(**changes):
    return [one.key for one in runs_of(CONFIG | changes)]


def runs_of(settings):
    return study.Study.of(settings).experiment().runs()


def assert_same(a, b):
    """All but the clock, to the last bit."""
    names = [name for name in a if not name.startswith("seconds")]
    xr.testing.assert_identical(a[names], b[names])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("studies") / "serial"


@pytest.fixture(scope="module")
def serial(folder):
    return run(folder)


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    # Locks of cores of their own, and sets of names in another order than here.
    environment = {"TMPDIR": str(tmp_path_factory.mktemp("locks")), "PYTHONHASHSEED": "7"}
    options = {"n_workers": 2, "threads_per_worker": 1, "memory_limit": 0, "env": environment}
    with LocalCluster(dashboard_address=None, **options) as cluster, Client(cluster) as client:
        yield client


@pytest.fixture
def counted(monkeypatch):
    """The runs that were run here, serially."""
    seen, execute = [], experiment.execute

    def count(one, caller):
        seen.append(str(one))
        return execute(one, caller)

    monkeypatch.setattr(experiment, "execute", count)
    return seen


# --- the table of runs ---


@pytest.mark.slow  # processes start for long
def test_a_key_is_the_same_in_another_process(client):
    table = f"__import__('trustbo').study.Study.of({CONFIG!r}).experiment().runs()"
    assert client.submit(eval, f"[run.key for run in {table}]").result() == keys()
    assert len(set(keys())) == 6


def test_a_key_depends_on_what_decides_the_numbers_and_on_nothing_else():
    cells, truth = CONFIG["terrains"]["cells"], CONFIG["simulators"]["truth"]
    same = {
        "terrains": {"renamed": cells | {"shape": (5, 5), "n_robots": 3, "start": None}},
        "simulators": {"renamed": truth | {"n_ticks": None}},
        "objectives": "lost_contact",
        "seeds": [0, 1, 2],
    }
    assert keys(**same) == keys()
    assert keys(seeds=4)[:6] == keys()
    for change in (
        {"terrains": {"cells": cells | {"n_robots": 2}}},
        {"simulators": {"truth": truth | {"params": truth["params"] | {"b": 0.06}}}},
        {"models": {"PooledTrust": {"observation": "censored"}}},
        {"objectives": ["mean"]},
        {"options": {"max_bounds": "shortest+1"}},
        {"n_iterations": 3},
    ):
        assert not set(keys(**change)) & set(keys())


def test_every_option_is_crossed_with_every_other():
    table = runs_of(
        CONFIG
        | {
            "objectives": ["terminal", "mean"],
            "models": ["pooled", "hierarchical"],
            "samplers": "nuts",
            "options": {"failure_cost": [0.0, 0.1], "max_bounds": "shortest+1"},
        }
    )
    assert len(table) == 3 * 2 * 2 * 2 * 2
    assert len({one.key for one in table}) == len(table)
    assert {one.labels["failure_cost"] for one in table[:16]} == {0.0, 0.1}


def test_a_file_s_content_decides_and_not_its_name(tmp_path):
    terrain = tb.terrain.synthetic_terrain((40.0, 40.0), seed=1)
    for place in ("a", "b"):
        (tmp_path / place).mkdir()
        for name in ("dem", "dsm"):
            terrain[name].rio.to_raster(tmp_path / place / f"{name}.tif")
    table = [
        "terrains:\n  hill: {kind: read_terrain, dem: dem.tif, dsm: dsm.tif, shape: [2, 2]}\n",
        "terrains:\n  hill: {kind: read_terrain, dem: dem.tif, dsm: dem.tif, shape: [2, 2]}\n",
    ]
    found = []
    for i, (place, text) in enumerate((("a", table[0]), ("b", table[0]), ("b", table[1]))):
        file = tmp_path / place / f"{i}.yaml"
        file.write_text(text)
        found.append(read_study(file).experiment().runs()[0].key)
    assert found[0] == found[1] != found[2]


def test_a_constructor_of_the_user_is_named_with_its_module(serial, tmp_path, monkeypatch):
    (tmp_path / "my_grids.py").write_text(
        "from trustbo.study.calls import random_workspace\n"
        "def grid(side, seed=0):\n    return random_workspace((side, side), seed=seed)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    mine = {"kind": "my_grids:grid", "side": 5, "seed": "run"}
    assert_same(run(tmp_path / "out", terrains={"cells": mine}).drop_vars("key"),
                serial.drop_vars("key"))  # fmt: skip
    with pytest.raises(tb.TrustboError, match=r"'cells' \(my_grids:grid\) 'sid'; did you mean s"):
        run(tmp_path / "out", terrains={"cells": {"kind": "my_grids:grid", "sid": 5}})


# --- where they run ---


@pytest.mark.slow  # processes start for long; dask's tests are of the same code
def test_loky_gives_the_same_numbers_though_a_worker_dies(serial, tmp_path):
    with killing_a_worker(tmp_path):
        assert_same(run(tmp_path, "loky"), serial)


@pytest.mark.slow  # processes start for long
def test_dask_gives_the_same_numbers_on_a_core_for_each_worker(serial, client, tmp_path):
    assert_same(run(tmp_path, client), serial)
    pinned = [tuple(cores) for cores in client.run(os.sched_getaffinity, 0).values()]
    if len(os.sched_getaffinity(0)) > 1:
        assert len(set(pinned)) == 2
        assert {len(cores) for cores in pinned} == {1}


@pytest.mark.slow  # processes start for long
def test_dask_gives_the_same_numbers_though_a_worker_dies(client, tmp_path_factory):
    calm, hurt = (tmp_path_factory.mktemp(name) for name in ("calm", "hurt"))
    more = {"models": ["places"], "seeds": 5, "n_iterations": 3}
    with killing_a_worker(hurt):
        result = run(hurt, client.scheduler.address, **more)
    assert result.attrs == {"n_runs": 10, "n_failed": 0}
    assert_same(result, run(calm, client, **more))


@contextmanager
def killing_a_worker(folder):
    """SIGKILL the worker that ended the first run, when that has been written."""
    killed = []

    def kill():
        for _ in range(1200):
            if files := list((folder / "runs").glob("[!.]*.json")):
                killed.append(json.loads(files[0].read_text())["process"])
                os.kill(killed[0], signal.SIGKILL)
                return
            time.sleep(0.05)

    thread = threading.Thread(target=kill)
    thread.start()
    yield
    thread.join()
    assert killed[0] != os.getpid()


@pytest.fixture
def no_cache():
    """JAX without the cache of compiled programs that the tests share."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    jax.config.update(names[0], None)
    yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.mark.usefixtures("no_cache")
def test_workers_keep_compiled_code_in_the_user_s_cache_unless_told_where(monkeypatch, tmp_path):
    for name in ("a", "b"):  # the second finds what the first set
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / name))
        executors.keep_compiled_code()
        assert jax.config.jax_compilation_cache_dir == str(tmp_path / "a" / "trustbo" / "jax")


@pytest.mark.usefixtures("no_cache")
def test_threads_and_the_caller_s_process_are_left_as_they_are(serial, tmp_path):
    before = os.sched_getaffinity(0), jax.config.jax_compilation_cache_dir
    with ThreadPoolExecutor(1) as pool:
        assert_same(run(tmp_path, pool), serial)
    assert (os.sched_getaffinity(0), jax.config.jax_compilation_cache_dir) == before


def test_runs_of_a_pool_that_is_broken_are_failures(tmp_path):
    class Broken(ThreadPoolExecutor):
        def submit(self, *arguments):
            raise BrokenExecutor

    with (
        Broken() as pool,
        pytest.raises(tb.TrustboError, match=r"6 of 6 runs failed.*lost: the wo"),
    ):
        run(tmp_path, pool)


def test_executors_that_cannot_be_are_refused(tmp_path):
    with (
        ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as pool,
        pytest.raises(tb.TrustboError, match="the executor forks, which JAX does not survive"),
    ):
        run(tmp_path, pool)
    with pytest.raises(
        tb.TrustboError, match=r"unknown executor .* 'cluster'; choose one of serial"
    ):
        run(tmp_path, "cluster")
    with pytest.raises(tb.TrustboError, match="executor must be one of serial, loky, dask, an"):
        run(tmp_path, 3)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "package"), [("loky", "loky"), ("dask", "distributed")])
def test_an_executor_that_is_not_installed_names_its_extra(name, package, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    message = rf"executor '{name}' needs {package}: .* pip install {package}; or take"
    with pytest.raises(tb.TrustboError, match=message):
        run(tmp_path, name)
    assert not list(tmp_path.iterdir())


# --- resuming, and failing ---


def test_a_study_goes_on_where_it_stopped(serial, tmp_path, counted, monkeypatch):
    class StoppedError(Exception):
        pass

    counting = experiment.execute

    def stop_after_two(one, caller):
        if len(counted) == 2:
            raise StoppedError
        return counting(one, caller)

    monkeypatch.setattr(experiment, "execute", stop_after_two)
    with pytest.raises(StoppedError):
        run(tmp_path)
    monkeypatch.setattr(experiment, "execute", counting)
    assert len(counted) == 2
    partial = study.load_study(tmp_path)
    assert partial.sizes["run"] == 2
    assert partial.attrs == {"n_runs": 6, "n_failed": 0}
    assert_same(run(tmp_path), serial)
    assert len(counted) == 6
    assert_same(run(tmp_path), serial)
    assert len(counted) == 6
    # More seeds are run by themselves; fewer are read without what is there besides.
    assert run(tmp_path, seeds=4).sizes["run"] == 8
    assert len(counted) == 8
    assert_same(run(tmp_path), serial)


def test_a_worker_of_another_version_is_an_error(tmp_path, monkeypatch):
    def execute(one, caller):
        return {"missions": [], "versions": {"trustbo": "0.0.7"}}

    monkeypatch.setattr(experiment, "execute", execute)
    with pytest.raises(tb.TrustboError, match=r"the worker has trustbo 0\.0\.7, and the study"):
        run(tmp_path)


# --- what comes out ---


def test_kinematic_runs_know_their_regret_if_asked_to(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    hill = {"kind": "synthetic_terrain", "size": [90, 90], "relief": 6, "shape": [3, 3], "seed": 5}
    result = run(
        tmp_path,
        terrains={"hill": hill},
        simulators="KinematicSimulator",
        seeds=1,
        policies="greedy",
        n_iterations=1,
    )
    assert result["regret"].isnull().all()
    assert result["simulator"].item() == "KinematicSimulator"
    known = {"kind": "KinematicSimulator", "known_truth": True}
    changes = {"terrains": {"hill": hill}, "simulators": {"known": known}, "seeds": 1}
    result = run(tmp_path / "known", policies="greedy", **changes)
    assert (result["regret"] >= 0.0).all()
    assert len(list((tmp_path / "cache" / "trustbo" / "truth").glob("*.nc"))) == 1


def test_missions_that_a_rule_spared_are_missing(tmp_path):
    result = run(
        tmp_path,
        seeds=2,
        policies="greedy",
        n_iterations=4,
        options={"stop": {"eps": 0.9, "delta": 0.5, "patience": 1, "min_missions": 1}},
    )
    assert result.sizes["mission"] < 4


def test_a_study_is_kept_in_files_that_netcdf_and_json_read(serial, folder, tmp_path):
    assert_same(study.load_study(folder), serial)
    serial.to_netcdf(tmp_path / "study.nc")
    one = json.loads((folder / "runs" / f"{serial['key'].values[0]}.json").read_text())
    assert one["labels"]["policy"] == "greedy"
    assert one["identity"]["trustbo"] == tb.__version__
    assert len(one["missions"]) == 2
    kept = json.loads((folder / "study.json").read_text())
    assert [r.key for r in runs_of(kept["study"])] == keys()
    with pytest.raises(tb.TrustboError, match="holds no study"):
        study.load_study(tmp_path)


# --- what is refused ---


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"policy": "greedy"},
            r"unknown setting of a study 'policy'; did you mean policies\?",
        ),
        ({"policies": ["gredy"]}, "unknown policy 'gredy'; choose one of greedy"),
        ({"policies": ["greedy", "greedy"]}, "policies must be at least one, and distinct"),
        ({"policies": []}, "policies must be at least one"),
        ({"objectives": ["best"]}, "unknown objective 'best'; choose one of lost_contact"),
        ({"seeds": -1}, "seeds .* must be a whole number from 1 on; got -1"),
        ({"seeds": [0, "a"]}, "seed must be a whole number from 0 on; got 'a'"),
        ({"n_iterations": 0}, "n_iterations must be a whole number from 1 on; got 0"),
        (
            {"terrains": {"a": {"shape": [5, 5]}}},
            r"kind of terrain \(or give \"module:name\"\) 'a'; choose one of synth",
        ),
        (
            {"terrains": {"a": {"kind": "SynteticTerrain"}}},
            "kind of terrain .* 'SynteticTerrain'; did you mean synthetic_terrain",
        ),
        (
            {"terrains": {"a": {"kind": "example", "shap": [5, 5]}}},
            r"of terrain 'a' \(example\) 'shap'; did you mean shape",
        ),
        (
            {"models": {"a": {"kind": "PooledTrust", "place": {"kind": "PlaceEfect"}}}},
            "model 'a': unknown kind .* 'PlaceEfect'; did you mean PlaceEffect",
        ),
        (
            {"models": {"a": {"kind": "PooledTrust", "place": {"kind": "PlaceEffect", "cell": 1}}}},
            r"setting of model 'a', place \(PlaceEffect\) 'cell'; did you mean cells",
        ),
        ({"simulators": {"a": {"kind": "nowhere:Simulator"}}}, "'nowhere:Simulator' cannot be imp"),
        (
            {"simulators": {"KinematicSimulator": {"known_truth": 1}}},
            "simulator 'KinematicSimulator': known_truth must be true or false; got 1",
        ),
        ({"terrains": {}}, "a study needs at least one terrain"),
        ({"terrains": 5}, "terrains must be distinct names of kinds"),
        ({"terrains": {"random": 5}}, "terrain 'random' must be a mapping of settings; got 5"),
        ({"terrains": {"random": {"zoom": 3}}}, "unknown setting of terrain 'random' .*'zoom'; ch"),
        ({"terrains": {"random": {"shape": 5}}}, r"terrain 'random': shape must be two whole num"),
        ({"terrains": {"random": {"seed": "each"}}}, "seed .* must be a whole number; got 'each'"),
        ({"terrains": {"read_terrain": {}}}, r"terrain 'read_terrain' \(read_terrain\) needs dem"),
        ({"terrains": {"files": {"dem": "x", "dsm": "y"}}}, "dem: there is no file '.*x'"),
        ({"terrains": {"read_lidar": {"points": ["x.laz"]}}}, "points: there is no file '.*x.laz'"),
        ({"terrains": {"random": {"shape": [5, 5], "goal": [0, 9]}}}, r"goal \(0, 9\) is outside"),
        ({"simulators": {"model": {"beta0": 0.5}}}, "needs beta, b, delta_w, delta_v; got"),
        ({"simulators": {"model": TRUTH | {"beta": [1]}}}, "the run seed=0, terrain=.*feature"),
        ({"simulators": "kinematic"}, "the run seed=0, terrain=cells.*needs a terrain"),
        ({"models": {"pooled": {"observation": "odd"}}}, "model 'pooled': unknown observation"),
        (
            {"models": {"pooled": {"priors": "mine"}}},
            "model 'pooled': .*priors .*'mine'",
        ),
        (
            {"models": {"coupled": {"observation": "censored"}}},
            "model 'coupled': sampler \"exact\" cannot treat",
        ),
        ({"options": {"seed": 3}}, "unknown option 'seed'; choose one of .*initial"),
        ({"options": {"max_failure": float("nan")}}, "option 'max_failure' must be a number, a n"),
        ({"options": {"draws": 0}}, "the run seed=0.*draws"),
        ({"options": {"stop": {"epsilon": 1}}}, "the run seed=0.*epsilon"),
    ],
)
def test_a_study_that_cannot_be_is_refused_before_anything_is_run(change, message, tmp_path):
    with pytest.raises(tb.TrustboError, match=message):
        run(tmp_path, **change)
    assert not list(tmp_path.iterdir())


def test_yaml_that_cannot_be_is_refused(tmp_path):
    with pytest.raises(tb.TrustboError, match=r"cannot read '.*none.yaml': No such file"):
        read_study(tmp_path / "none.yaml")
    for text, message in (
        ("terrains: [", "is no YAML: while parsing"),
        ("- terrains", "a study is a Study or a mapping"),
        ("policies: [greedy]", "a study needs terrains"),
        ("terrains: [random]\npolicies: [gredy]", "odd.yaml: unknown policy 'gredy'"),
    ):
        (tmp_path / "odd.yaml").write_text(text)
        with pytest.raises(tb.TrustboError, match=message):
            read_study(tmp_path / "odd.yaml")


# --- the command ---

YAML = """
terrains:
  cells: {kind: random_workspace, shape: [5, 5], seed: run}
simulators:
  truth:
    kind: ModelSimulator
    params: {kind: TrustParams, beta0: 0.6, beta: [0.3, 0.2], b: 0.05, delta_w: 0.05, delta_v: 0.05}
policies: [greedy, random]
samplers: [exact]
seeds: 3
n_iterations: 2
"""


def test_a_study_is_read_from_yaml_and_its_names_are_checked(serial, tmp_path):
    (tmp_path / "config.yaml").write_text(YAML)
    assert_same(study.run_study(tmp_path / "config.yaml", tmp_path / "out", "serial"), serial)
    (tmp_path / "config.yaml").write_text(YAML.replace("greedy", "gredy"))
    with pytest.raises(tb.TrustboError, match="unknown policy 'gredy'"):
        study.run_study(tmp_path / "config.yaml", tmp_path / "other", "serial")


# --- the simulator ---


def test_the_model_s_simulator_draws_from_the_model():
    rng = np.random.default_rng(0)
    workspace = tb.Workspace.from_awareness(rng.uniform(size=(3, 4, 4, 2)))
    truth = tb.models.TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)
    simulator = tb.simulation.ModelSimulator(workspace, truth)
    path = [(3, 0), (2, 1), (1, 2), (0, 3)]
    rates = np.array([simulator.run(path, seed=s).contact_rate for s in range(400)])
    z = np.swapaxes(workspace.awareness.values[:, [2, 1, 0], [1, 2, 3]], 0, 1)
    expected = tb.planning.roll_trust(truth, z)
    # 5 standard errors of a mean of 400, whose sd is below 0.35; few rates are cut to [0, 1].
    np.testing.assert_allclose(rates[:, 1:].mean(0), expected[1:], atol=5 * 0.35 / 20)
    again = simulator.run(path, seed=3)
    np.testing.assert_array_equal(again.contact_rate, rates[3])
    np.testing.assert_array_equal(again.awareness, z)
    assert simulator.describe()["truth"]["beta"] == [0.3, 0.2]
