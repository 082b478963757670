"""Tables of the benchmark of worlds, of results made by hand."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from summary import differences, summary

FILE = Path(__file__).resolve().parents[2] / "benchmarks" / "worlds.py"


@pytest.fixture(scope="module")
def benchmark():
    """The script; its name is also that of a module of these tests."""
    spec = spec_from_file_location("benchmark_of_worlds", FILE)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def numbers(scenes):
    """Runs of two methods; "trustbo" takes longer, and loses less contact."""
    rows = [
        {
            "case": case, "scene": scene, "seed": 0, "regret after 0": 10.0, "regret now": 5.0,
            "lost while learning": lost, "arrive": 1.0, "arrive later": np.nan, "seconds": seconds,
        }
        for scene in scenes
        for case, lost, seconds in (("trustbo", 0.1, 2.0), ("other", 0.3, 0.5))
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_with_one_scene_there_is_no_interval(benchmark):
    for table in (summary(numbers("a")), differences(numbers("a"), "trustbo")):
        text = benchmark.as_text(table, ["lost while learning", "arrive later"])
        assert "[-]" in text
        assert "nan" not in text


def test_quantities_in_which_a_method_is_worse_are_explained(benchmark):
    lines = benchmark.worse_than(differences(numbers("abc"), "trustbo"))
    assert lines == [f"- {benchmark.ABOUT['seconds']}: worse than other"]
    assert benchmark.worse_than(differences(numbers("a"), "trustbo")) == ["- nowhere"]
