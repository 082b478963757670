"""Text in CSV files that a spreadsheet must not run, and that is read back as it was."""

import csv
import io

import numpy as np
import pandas as pd
import pytest

from trustbo.spreadsheet import frame_as_csv, harmless, meant

FORMULAS = ['=HYPERLINK("http://x")', "+1+cmd|' /C calc'!A0", "-2+3", "@SUM(A1)", "\t=1", "\r=1",
            "\uff1d1+1", "-", "="]  # fmt: skip


@pytest.mark.parametrize("text", FORMULAS)
def test_a_formula_is_written_as_text_and_read_as_it_was(text):
    assert harmless(text) == f"'{text}"
    for name in (text, f"'{text}", f"''{text}"):
        assert meant(harmless(name)) == name


@pytest.mark.parametrize(
    "text", ["-0.5", "+1e-3", "-inf", "nan", "12", "r1", "'quoted'", "a=b", ""]
)
def test_numbers_and_other_text_stay_as_they_are(text):
    assert harmless(text) == text == meant(text)


def test_a_frame_is_harmless_in_its_header_its_index_and_its_cells():
    table = pd.DataFrame({"=a": ["@b", 'say "x", y'], "n": [-0.5, np.nan]}, index=["+i", "j"])
    text = frame_as_csv(table)
    assert list(csv.reader(io.StringIO(text))) == [
        ["", "'=a", "n"], ["'+i", "'@b", "-0.5"], ["j", 'say "x", y', ""],
    ]  # fmt: skip
