"""Kernels do not check indices where users run them: here all of them run with checks."""

import json
import os
import runpy
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from numba import njit

from trustbo.kernels import stopwatch

ROOT = Path(__file__).resolve().parents[1]
REACH_EVERY_KERNEL = (
    "workspace/test_difficulty.py",
    "planning/test_search.py",
    "planning/test_planner.py",
    "terrain/test_rays.py",
    "terrain/test_features.py",
    "terrain/test_composite.py",
    "workspace/test_sight.py",
    "workspace/test_routes.py",
    "workspace/test_passable_bounds.py",
    "simulation/test_motion.py",
    "simulation/test_missions.py::test_a_track_begins_after_some_finds_and_ends_after_some_misses",
)
"""Tests that call all kernels between them; a new kernel needs one of its own here."""


def run(words, **environment):
    """Run Python in the repository's root."""
    return subprocess.run(
        [sys.executable, *words], cwd=ROOT, env=os.environ | environment, capture_output=True,
        text=True, check=False,
    )  # fmt: skip


def checked(cache):
    """Settings under which kernels check indices; what is compiled so needs a place of its own."""
    return {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(cache)}


@pytest.mark.slow
def test_every_kernel_keeps_within_its_arrays(tmp_path):
    """Compiled anew with checks, in tests that reach all of them."""
    tests = [f"tests/{name}" for name in REACH_EVERY_KERNEL]
    ended = run(["tests/checked_kernels.py", "-m", "not slow", *tests], **checked(tmp_path))
    assert ended.returncode == 0, ended.stdout[-3000:] + ended.stderr[-3000:]
    found = json.loads(ended.stdout.splitlines()[-1])
    assert found["kernels"] > 20
    assert found["never compiled"] == []


# Some problems have rates without noise.
@pytest.mark.filterwarnings("ignore:(divide by zero|invalid value|Mean of empty):RuntimeWarning")
def test_random_plans_are_the_best_of_all_paths(monkeypatch):
    """Problem by problem against enumeration; `benchmarks/fuzz_plans.py` says how."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    fuzz = runpy.run_path(str(ROOT / "benchmarks" / "fuzz_plans.py"))
    problems = [fuzz["problem_of"](0, index, 2000) for index in range(100)]
    assert [wrong for wrong, _ in (fuzz["faults"](*one) for one in problems) if wrong] == []
    assert sum(best > -float("inf") for *_, best in problems) > 80


@pytest.mark.slow
def test_two_thousand_random_plans_keep_within_their_arrays(tmp_path):
    """Other problems than the hundred above, with kernels that check their indices."""
    words = ["benchmarks/fuzz_plans.py", "-n", "2000", "--first", "100"]
    ended = run(words, **checked(tmp_path))
    assert ended.returncode == 0, ended.stdout[-3000:] + ended.stderr[-3000:]
    assert ended.stdout.splitlines()[-1].startswith("2000 problems, 0 wrong")


def compile_something():
    """Compile and call a kernel that calls another one; return the seconds that this took."""

    @njit
    def inner(x):
        return x + 1.0

    @njit
    def outer(x):
        return inner(x) * inner(2.0 * x)

    started = time.perf_counter()
    outer(1.0)
    return time.perf_counter() - started


def test_a_stopwatch_stands_still_during_compilation():
    with stopwatch() as elapsed:
        compiled = compile_something()
        assert 0.0 < elapsed() < 0.5 * compiled

        before = elapsed()
        time.sleep(0.05)
        assert elapsed() - before >= 0.05


def test_a_stopwatch_runs_while_another_thread_compiles():
    seconds = []
    other = threading.Thread(target=lambda: seconds.append(compile_something()))
    with stopwatch() as elapsed:
        other.start()
        other.join()
        assert elapsed() >= seconds[0]
