"""Bars that say when kernels are compiled."""

import io
import sys

from numba import njit
from tqdm import tqdm

from trustbo.display.compiling import compiling


def test_a_bar_says_that_a_kernel_is_compiled_and_has_its_name_again_after():
    shown = io.StringIO()
    with tqdm(total=3, desc="missions", file=shown) as bar, compiling(bar):
        assert "compiling" not in shown.getvalue()
        kernel = njit(lambda x: x + 1)
        assert kernel(1) == 2
        assert "missions, compiling once, some 30 s in all:   0%" in shown.getvalue()
        assert bar.desc == "missions"
        said = shown.getvalue().count("compiling")
        assert kernel(1) == 2  # compiled already
        assert shown.getvalue().count("compiling") == said


def test_without_a_bar_one_comes_with_the_first_kernel_in_a_terminal_alone(monkeypatch):
    for is_terminal in (True, False):
        shown = io.StringIO()
        shown.isatty = lambda answer=is_terminal: answer
        monkeypatch.setattr(sys, "stderr", shown)
        with compiling():
            njit(lambda x: x + 1)(1)
        assert ("compiling once, some 30 s in all [" in shown.getvalue()) is is_terminal
