"""Summary of the benchmark of the paper's method, from rows made by hand."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

FILE = Path(__file__).resolve().parents[2] / "benchmarks" / "paper.py"


@pytest.fixture(scope="module")
def paper():
    spec = importlib.util.spec_from_file_location("benchmark_of_the_paper", FILE)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def rows(method, regrets, lost):
    return pd.DataFrame(
        {
            "world": "synthetic-0", "kind": "right", "course": "sw-ne", "method": method,
            "mission": range(len(regrets)), "regret": regrets, "lost": [np.nan, *lost],
            "n_cells": range(len(regrets)), "sd": [np.nan, *np.full(len(lost), 0.1)],
            "seconds": 1.0,
        }
    )  # fmt: skip


@pytest.mark.parametrize(
    ("regrets", "missions"),
    [([3.0, 9.0, 4.0], 2.0), ([9.0, 9.0, 9.0], 3.0), ([1.0, 2.0, 3.0], 0.0)],
)
def test_the_regret_must_stay_below_5_percent(paper, regrets, missions):
    numbers = paper.summarised(rows("greedy, mean", regrets, [0.2, 0.4]), 2)
    assert numbers["missions to 5 %"].tolist() == [missions]
    assert numbers["lost per mission"].tolist() == pytest.approx([0.3])
    assert numbers["regret after"].tolist() == [regrets[-1]]


def test_differences_are_of_pairs(paper, capsys):
    every = pd.concat(
        rows(f"{policy}, {objective}", [9.0, 8.0, regret], [lost, lost])
        for objective in ("(6)", "mean")
        for policy, regret, lost in (
            ("greedy", 1.0, 0.2),
            ("random", 4.0, 0.5),
            ("prior only", 9.0, 0.4),
        )
    )
    paper.report(paper.summarised(every, 2), 2)
    lines = capsys.readouterr().out.splitlines()
    found = next(line for line in lines if line.startswith("| greedy, mean minus random, mean"))
    assert "-0.300" in found
    assert "-3.000" in found
