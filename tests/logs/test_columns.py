"""Columns of users' tables: what spreadsheets, surveys and other tools add, and clocks."""

import gzip
import io

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from trustbo.errors import TrustboError
from trustbo.logs.columns import (
    Columns,
    require_one_spelling,
    require_plain_names,
    seconds_of,
)

EXPECTED = {"who": ["7", "8"], "t": [0.5, np.nan]}


def assert_expected(columns):
    assert columns.texts("who") == EXPECTED["who"]
    np.testing.assert_array_equal(columns.numbers("t"), EXPECTED["t"])


@pytest.mark.parametrize(
    "text",
    [
        "who,t\n7,0.5\n8,NA\n",
        "\ufeffwho;t\r\n7;0,5\r\n8;#N/A\r\n",
        '"sep=;"\nwho;t;;\n7;0,5;;\n8;;;\n;;;\n',
        "who\tt\n7.0\t0,5\n8.0\t\n",
        "who;t\n7;5,0e-1\n8;\n",
        'who;t;note\n7;0,5;"a; b\nand c"\n8;;d\n',
        ",Who, T \n0,7,.5\n1,8,nan\n",
        'who,t\n"a person","s"\n"{""ImportId"":1}","{""ImportId"":2}"\n7,5e-1\n8,\n',
    ],
)
def test_files_of_spreadsheets_and_surveys_are_read(text, tmp_path):
    (tmp_path / "größe.csv").write_text(text, encoding="utf-8", newline="")
    assert_expected(Columns(tmp_path / "größe.csv"))


@pytest.mark.parametrize(
    "table",
    [
        {"who": [7, 8], "t": [0.5, None]},
        {"who": [7.0, "8"], "t": ["0.5", "none"]},
        pd.DataFrame({"who": [7.0, 8.0], "t": [0.5, np.nan]}),
        pd.DataFrame({"t": ["0.5", pd.NA]}, index=pd.Index([7, 8], name="who")),
        pd.DataFrame({"who": [7, 8], "t": [0.5, None]}).set_index("who", drop=False),
        pd.DataFrame({"who": [7, 8], "t": pd.to_timedelta([500, None], unit="ms")}),
        pd.DataFrame({"Unnamed: 0": [0, 1], "who": ["7", "8"], "t": [0.5, np.nan]}),
        np.array([(7, 0.5), (8, np.nan)], dtype=[("who", int), ("t", float)]),
        pd.DataFrame({"who": [7, 8], "t": [0.5, np.nan]}).to_xarray(),
        pd.DataFrame({"who": [7, 8], "t": [0.5, np.nan]}).set_index("who").to_xarray(),
    ],
)
def test_frames_datasets_mappings_and_arrays_are_read(table):
    assert_expected(Columns(table))


@pytest.mark.parametrize(
    "table",
    [
        3,
        None,
        b"who,t",
        {"who": [7, 8], "t": [0.5]},
        {"who": 7, "t": 0.5},
        xr.DataArray([7, 8]),
        ["first.csv", "second.csv"],
        io.StringIO("who,t\n7,0.5\n"),
    ],
)
def test_values_that_are_no_table_are_refused(table):
    with pytest.raises(TrustboError, match="the table"):
        Columns(table)


def test_a_table_may_have_no_rows_where_that_means_something(tmp_path):
    (tmp_path / "none.csv").write_text("who,t\n")
    for table in (tmp_path / "none.csv", {"who": [], "t": []}):
        columns = Columns(table, may_be_empty=True)
        assert columns.texts("who") == []
        assert columns.numbers("t").shape == (0,)


@pytest.mark.parametrize(
    ("cells", "decimals"),
    [(["0.5", "0.429", "", "1"], 3), (["4.29e-1"], 3), ([0.43, np.nan, 1.0], 2), ([1, 0], 0)],
)
def test_decimals_are_those_that_are_written(cells, decimals):
    assert Columns({"t": cells, "who": "a"}).decimals("t") == decimals


@pytest.mark.parametrize("name", ["=cmd|' /C calc'!A0", "+1", "-1", "@a", " a", "NA", "1.0", ""])
def test_names_that_a_table_would_change_are_refused(name):
    require_plain_names("robot", ["a b", "ü-7", "12"])
    with pytest.raises(TrustboError, match="robot"):
        require_plain_names("robot", ["a", name])


@pytest.mark.parametrize("value", ["1_10", "1,5", "inf", "0x10", "one", "10:02", "1.234,5"])
def test_text_that_is_no_number_is_refused_with_its_row(value):
    with pytest.raises(TrustboError, match="row 2"):
        Columns({"t": ["1.0", value]}).numbers("t")


def test_commas_that_may_separate_thousands_are_refused(tmp_path):
    (tmp_path / "a.tsv").write_text("t\tx\n1,020\t1,020\n12,500\t0,98\n")
    table = Columns(tmp_path / "a.tsv")
    np.testing.assert_array_equal(table.numbers("x"), [1.02, 0.98])
    with pytest.raises(TrustboError, match=r"row 1.*1,020"):
        table.numbers("t")


def test_text_in_utf_16_and_open_files_are_named(tmp_path):
    (tmp_path / "a.csv").write_text("who\tt\n7\t1\n", encoding="utf-16")
    with pytest.raises(TrustboError, match="UTF-16"):
        Columns(tmp_path / "a.csv")
    with pytest.raises(TrustboError, match="open file"):
        Columns(io.StringIO("who,t\n7,1\n"))


def test_accents_are_composed():
    table = Columns({"e\u0301tat": ["re\u0301ussi"]})
    assert table.texts("\u00e9tat") == ["r\u00e9ussi"]


def test_optional_columns_that_differ_only_in_case_are_refused():
    with pytest.raises(TrustboError, match="Status"):
        Columns({"t": [1.0], "Status": ["ok"], "STATUS": ["stuck"]}).texts("status", required=False)


@pytest.mark.parametrize(
    "content", [b"who,t\n7\n", b"who,t\n7,1,2\n", b"who,who\n7,1\n", b"who,t\n",
                b"PK\x03\xff", b"a\xe9,t\n1,2\n", b'who,t\n7,"1\n8,2\n',
                b'who,t\n7,"1\n8,2\n9,3"\n', gzip.compress(b"who,t\n7,1\n", mtime=0),
                b"PK\x03\x04\x14",
                b"\xd0\xcf\x11\xe0", b"PAR1\x15"],
)  # fmt: skip
def test_files_that_are_no_table_are_refused(content, tmp_path):
    (tmp_path / "bad.csv").write_bytes(content)
    with pytest.raises(TrustboError):
        Columns(tmp_path / "bad.csv")
    with pytest.raises(TrustboError):
        Columns(tmp_path / "none.csv")


@pytest.mark.parametrize("names", [["a", "A"], ["1", "01"], ["r 1", "r_1"]])
def test_one_name_in_two_spellings_is_refused(names):
    with pytest.raises(TrustboError, match="who"):
        require_one_spelling("who", names)


def of(*times):
    return Columns({"t": list(times)}, "the table")


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (of(0.0, 3.0), of(1.7e9, 1.7e9 + 3.0)),
        (of(0.0, 1e6, 2e6), of(0.0)),
        (of(1.7e12, 1.7e12 + 1.0), of(1.7e12)),
        (of(0.0, 5.0, 1.7e9), of(1.0)),
        (of("2026-11-24T10:00", "2026-11-24T12:00"), of("2026-11-24T11:00Z")),
        (of("2026-11-24T10:00Z", "2026-11-24T10:01Z"), of(3.0)),
        (of("2026-11-24T10:00Z", "2026-11-24T10:01"), of("2026-11-24T10:00Z")),
        (of("24.11.2026 10:00", "24.11.2026 10:01"), of("2026-11-24T10:00Z")),
        (of(1.7e9, 1.7e9 + 1.0), of(*np.float32([1.7e9]))),
        (of(*np.float32([1.7e9, 1.7e9 + 300.0])), of(1.7e9 + 1.0)),
        (of("1699999488", "1700000000"), of(1.7e9 - 1.0)),  # written from float32
    ],
)
def test_clocks_that_cannot_be_one_are_refused(first, second):
    with pytest.raises(TrustboError):
        seconds_of(first, second)


def test_times_in_float32_are_read_where_it_holds_their_seconds():
    t = np.float32([0.0, 0.5, 119.25])
    np.testing.assert_array_equal(seconds_of(of(*t), of(*t[1:]))[1], t[1:])
    whole = of(1.7e9, 1.7e9 + 1.0, 1.7e9 + 2.0)
    np.testing.assert_array_equal(seconds_of(whole, whole)[0], 1.7e9 + np.arange(3.0))
