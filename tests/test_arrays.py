"""Labelled arrays are read by their labels, or refused; arrays without labels by place."""

import datetime

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from trustbo.arrays import as_array, as_names, read_labelled, require_numbers
from trustbo.errors import TrustboError

DIMS = ("bound", "robot")
TABLE = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])  # robots b and a
BY_NAME = TABLE[:, ::-1]  # robots a and b


def frame(index=None):
    return pd.DataFrame(TABLE, index=index, columns=["b", "a"])


def rates(values, robots=("a", "b"), **options):
    return read_labelled("rates", values, DIMS, {"robot": robots}, **options)


@pytest.mark.parametrize(
    "values",
    [
        frame(),
        frame().to_dict("list"),
        frame().T.rename_axis("robot"),
        xr.DataArray(TABLE, {"robot": ["b", "a"]}, DIMS),
        xr.DataArray(TABLE.T, {"robot": ["b", "a"]}, DIMS[::-1]),
    ],
    ids=["frame", "dict", "turned frame", "array", "turned array"],
)
def test_robots_are_put_in_order_by_name(values):
    read = rates(values)
    np.testing.assert_array_equal(read.values, BY_NAME)
    assert read.coords == {"robot": ("a", "b")}


def test_names_that_are_not_given_are_those_of_the_labels():
    read = rates(frame(), ())
    np.testing.assert_array_equal(read.values, TABLE)
    assert read.coords == {"robot": ("b", "a")}


def test_arrays_without_labels_are_read_by_place():
    for values in (TABLE, TABLE.tolist(), pd.DataFrame(TABLE), xr.DataArray(TABLE, dims=DIMS)):
        read = rates(values)
        np.testing.assert_array_equal(read.values, TABLE)
        assert read.coords == {}


def test_numbers_that_count_in_order_are_no_names():
    assert rates(xr.DataArray(TABLE, {"robot": [1, 2]}, DIMS)).coords == {}
    assert rates(xr.DataArray(TABLE, {"robot": [2, 1]}, DIMS), ()).coords == {"robot": ("2", "1")}
    with pytest.raises(TrustboError, match="robot"):
        rates(xr.DataArray(TABLE, {"robot": [2, 1]}, DIMS))


@pytest.mark.parametrize("robots", [("a", "c"), ("a", "b", "c"), None])
def test_labels_that_are_not_the_names_are_refused(robots):
    with pytest.raises(TrustboError, match="rates"):
        rates(frame(), robots)


def test_labels_that_are_no_names_are_refused():
    for labels in ([1.5, 2.0], ["a", "a"], [True, False]):
        with pytest.raises(TrustboError, match="rates"):
            rates(xr.DataArray(TABLE, {"robot": labels}, DIMS), ())


def test_bounds_are_put_in_order_by_number():
    turned = [2, 0, 1]
    numbered = frame(pd.Index([1, 2, 3], name="bound")).iloc[turned]
    np.testing.assert_array_equal(rates(numbered).values, BY_NAME)
    array = xr.DataArray(TABLE, {"bound": [0, 1, 2], "robot": ["b", "a"]}, DIMS)
    np.testing.assert_array_equal(rates(array.isel(bound=turned)).values, BY_NAME)


@pytest.mark.parametrize(
    "index",
    [
        pd.Index([1, 3, 4], name="bound"),
        pd.Index([5, 6, 7], name="bound"),
        pd.Index([2, 0, 1]),
        pd.Index([0, 2, 3]),
        pd.Index(["x", "y", "z"]),
        pd.Index(["x", "y", "z"], name="bound"),
        pd.to_datetime(["2026-01-02", "2026-01-01", "2026-01-03"]),
    ],
    ids=["gap", "later", "sorted", "dropped", "text", "text of bounds", "times"],
)
def test_bounds_whose_order_nobody_can_tell_are_refused(index):
    with pytest.raises(TrustboError, match="bound"):
        rates(frame(index))


def test_rows_of_a_longer_table_and_rows_by_time_are_in_order():
    longer = pd.DataFrame(np.vstack([TABLE, TABLE]), columns=["b", "a"])
    for table in (longer.iloc[3:], longer[longer.index >= 3], frame([0.5, 1.5, 3.0])):
        np.testing.assert_array_equal(rates(table).values, BY_NAME)


def test_rows_and_columns_of_a_map_count_from_0():
    cells = xr.DataArray(TABLE, {"row": [2, 1, 0], "col": [0, 1]}, ("row", "col"))
    read = read_labelled("map", cells, ("row", "col"))
    np.testing.assert_array_equal(read.values, TABLE[::-1])
    for other in ([1, 2, 3], [300.0, 200.0, 100.0], ["a", "b", "c"]):
        with pytest.raises(TrustboError, match="row"):
            read_labelled("map", cells.assign_coords(row=other), ("row", "col"))


def test_axes_may_be_missing_where_values_are_broadcast():
    of_robots = {"b": 1.0, "a": 2.0}
    for values in (of_robots, pd.Series(of_robots), xr.DataArray([2.0, 1.0], dims="robot")):
        np.testing.assert_array_equal(rates(values, partial=True).values, [[2.0, 1.0]])
    of_bounds = rates(pd.Series([1.0, 2.0, 3.0]), partial=True)
    np.testing.assert_array_equal(of_bounds.values, [[1.0], [2.0], [3.0]])
    with pytest.raises(TrustboError, match="dims"):
        rates(pd.Series(of_robots))


def test_tables_that_cannot_hold_the_axes_are_refused():
    dims = ("bound", "robot", "feature")
    for values in (
        frame(),
        frame().to_xarray(),
        frame().set_index(["a", "b"]),
        {"a": [1.0], "b": [1.0, 2.0]},
    ):
        with pytest.raises(TrustboError, match="awareness"):
            read_labelled("awareness", values, dims, {"robot": (), "feature": ()})


@pytest.mark.parametrize(
    "values",
    [
        "3",
        b"3",
        ["1", "2"],
        [1.0, "2"],
        1j,
        np.ones(2, complex),
        np.array(["2026-01-01"], "M8[D]"),
        np.array([3], "m8[s]"),
        [datetime.timedelta(seconds=3)],
        pd.to_timedelta([3.0], unit="s"),
        pd.Series(pd.to_timedelta([3.0], unit="s")),
        [[1.0], [1.0, 2.0]],
        10**400,
        {"a": 1.0},
        object(),
    ],
    ids=lambda values: type(values).__name__,
)
def test_what_is_not_a_number_is_refused(values):
    with pytest.raises(TrustboError, match="speed"):
        as_array("speed", values)


@pytest.mark.parametrize(
    "values",
    [
        [1, None],
        np.ma.masked_array([1.0, 7.0], [False, True]),
        pd.Series([1, None], dtype="Int64"),
        np.array([1.0, np.nan], dtype=np.float32),
        np.array([1.0, np.nan], dtype=">f8"),
        np.array([1.0, np.nan], dtype=object),
    ],
    ids=["None", "masked", "pandas", "float32", "big-endian", "object"],
)
def test_missing_values_of_any_library_are_nan(values):
    np.testing.assert_array_equal(as_array("rates", values), [1.0, np.nan])


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan, 1e24, -1e24])
def test_parameters_must_be_finite_and_of_a_size_that_trust_can_feel(value):
    with pytest.raises(TrustboError, match="beta0"):
        require_numbers("beta0", [0.5, value])
    np.testing.assert_array_equal(require_numbers("beta0", np.float32(0.5)), 0.5)


@pytest.mark.parametrize("names", ["abc", None, 3, (1, 2, 3), (None, 1.5, "c"), ("a", "a")])
def test_names_are_different_texts(names):
    with pytest.raises(TrustboError, match="names"):
        as_names("names", names)
    assert as_names("names", np.array(["a", "b"])) == ("a", "b")


def test_reversed_columns_without_names_are_refused():
    table = pd.DataFrame([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    names = {"robot": ("r1", "r2", "r3")}
    np.testing.assert_array_equal(
        read_labelled("x", table, ("bound", "robot"), names).values, table
    )
    with pytest.raises(TrustboError, match="robot"):
        read_labelled("x", table.iloc[:, ::-1], ("bound", "robot"), names)
