"""Text in CSV files that a spreadsheet must not run, and that is read back as it was."""

import csv
import io

import numpy as np
import pandas as pd
import pytest

import trustbo as tb
from trustbo.logs import read_table, write_table
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


def test_a_table_of_missions_keeps_names_that_look_like_formulas(tmp_path):
    names = {"robots": ("=r1", "'@r2"), "features": ("+z", "-t")}
    rates = np.array([[0.25, 0.5]])
    mission = tb.Mission.from_arrays([(0, 0), (0, 1)], np.full((1, 2, 2), 0.5), rates, **names)
    write_table([mission], tmp_path / "missions.csv")
    text = (tmp_path / "missions.csv").read_text()
    cells = [c for row in csv.reader(io.StringIO(text)) for c in row]
    assert {"'=r1", "''@r2", "'+z", "'-t"} <= set(cells)
    assert not [cell for cell in cells if cell[:1] in tuple("=+-@")]
    (back,) = read_table(tmp_path / "missions.csv", robots=names["robots"])
    assert (back.robots, back.features) == (names["robots"], names["features"])
    np.testing.assert_array_equal(back.contact_rate, rates)
