"""Tables of missions: what is written comes back, and whatever is amiss is named."""

import re
from pathlib import Path

import numpy as np
import pytest

import trustbo as tb
from trustbo.data import Mission
from trustbo.errors import ShapeError, TrustboError
from trustbo.logs.table import read_table, write_table

pd = pytest.importorskip("pandas")
PATH = [(2, 0), (1, 1), (0, 2)]


def missions(features=("traversability", "visibility"), robots=("r1", "r2")):
    """One that reached its goal, one that stopped after a bound and measured less."""
    rng = np.random.default_rng(0)
    shape = (2, len(robots), len(features))
    z, ticks = rng.uniform(size=shape), np.full(shape[:2], 7)
    rates = rng.integers(0, 8, shape[:2]) / 7
    names = {"features": features, "robots": robots}
    whole = Mission.from_arrays(
        PATH, z, rates, rng.uniform(1, 9, shape[:2]), n_ticks=ticks, **names
    )
    z[0, 0, 1], rates[0, 1] = np.nan, np.nan
    cut = Mission.from_arrays(PATH, z[:1], rates[:1], status="stuck", **names)
    return [whole, cut]


def assert_same(got, expected):
    assert len(got) == len(expected)
    for mine, other in zip(got, expected, strict=True):
        for name in ("path", "status", "features", "robots"):
            assert getattr(mine, name) == getattr(other, name)
        for name in ("awareness", "contact_rate", "duration", "n_ticks"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(other, name))
        for a, b in zip(mine.bounds, other.bounds, strict=True):
            assert (a.cell, a.status, a.t0) == (b.cell, b.status, b.t0)


def rows(**columns):
    """A table of one mission of one robot: 0,0 to 0,2 in two bounds."""
    table = {
        "mission": [1, 1, 1],
        "bound": [0, 1, 2],
        "robot": ["r1"] * 3,
        "row": [0, 0, 0],
        "col": [0, 1, 2],
        "contact_rate": [None, 0.5, 0.75],
        "visibility": [None, 0.2, 0.3],
    } | columns
    return pd.DataFrame({name: values for name, values in table.items() if values is not None})


def test_what_is_written_comes_back_to_the_last_bit(tmp_path):
    write_table(missions(), tmp_path / "new" / "missions.csv")
    assert_same(read_table(tmp_path / "new" / "missions.csv"), missions())
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["missions.csv"]


def test_a_frame_is_read_as_a_file_is(tmp_path):
    write_table(missions(), tmp_path / "missions.csv")
    frame = pd.read_csv(tmp_path / "missions.csv", dtype=str)
    assert_same(read_table(frame), missions())
    text = ["mission", "robot", "status", "mission_status"]
    frame = frame.astype(dict.fromkeys(frame.columns.difference(text), float))
    assert_same(read_table(frame), missions())
    assert_same(read_table(frame[::-1], robots=["r1", "r2"]), missions()[::-1])


def test_a_feature_may_be_called_as_a_column(tmp_path):
    """`exposure` is a number of ticks, and may be a feature too: of a threat."""
    named = missions(features=("visibility", "exposure"))
    write_table(named, tmp_path / "missions.csv")
    assert_same(read_table(tmp_path / "missions.csv"), named)
    assert_same(read_table(tmp_path / "missions.csv", features=("visibility", "exposure")), named)


def test_robots_and_features_come_in_the_order_asked_for():
    one = read_table(
        rows(
            robot=["b", "b", "a"],
            bound=[0, 1, 1],
            col=[0, 1, 1],
            contact_rate=[None, 0.5, 0.75],
            z3=[None, 0.8, 0.9],
        ),
        robots=["a", "b"],
        features=["z3", "visibility"],
    )[0]
    assert (one.robots, one.features) == (("a", "b"), ("z3", "visibility"))
    np.testing.assert_array_equal(one.contact_rate, [[0.75, 0.5]])
    np.testing.assert_array_equal(one.awareness, [[[0.9, 0.3], [0.8, 0.2]]])


def test_a_rate_may_be_given_as_a_time():
    table = rows(contact_rate=None, contact_time=[None, 3.0, 4.0], duration=[None, 12.0, 4.0])
    one = read_table(table)[0]
    np.testing.assert_array_equal(one.contact_rate, [[0.25], [1.0]])
    assert [bound.t0 for bound in one.bounds] == [0.0, 12.0]
    assert read_table(table.assign(t0=[None, 5.0, 20.0]))[0].bounds[1].t0 == 20.0


def test_awareness_need_not_be_in_the_table():
    workspace = tb.Workspace.from_awareness(
        np.full((1, 3, 3, 3), 0.5), features=("slope", "visibility", "z3")
    )
    bare = rows(visibility=None)
    for one, features in (
        (read_table(bare)[0], ("traversability", "visibility")),
        (read_table(bare, features=("slope",))[0], ("slope",)),
        (read_table(bare, workspace)[0], ("slope", "visibility", "z3")),
    ):
        assert one.features == features
        assert np.isnan(one.awareness).all()
    (partly,) = read_table(rows(), workspace)
    np.testing.assert_array_equal(partly.awareness[:, 0, 1], [0.2, 0.3])
    assert np.isnan(partly.awareness[..., [0, 2]]).all()
    with pytest.raises(TrustboError, match=r"slope, z3; it has slop\. Rename .*: ignore=\('slop',"):
        read_table(rows(slop=[None, 0.4, 0.5]), workspace)


def test_columns_that_are_no_awareness_are_left_out_by_name():
    table = rows(battery=[None, 0.875, 0.85], timestamp=["10:01", "10:02", "10:03"])
    (one,) = read_table(table, ignore=("battery", "timestamp"))
    assert one.features == ("visibility",)
    (one,) = read_table(table.drop(columns="timestamp"), ignore="battery")
    assert one.features == ("visibility",)
    with pytest.raises(TrustboError, match="ignore has 'batery'; the table has mission, bound,"):
        read_table(table, ignore=("batery",))


@pytest.mark.parametrize(("separator", "decimal"), [(";", "."), (";", ","), ("\t", ".")])
def test_semicolons_and_tabs_separate_as_commas_do(separator, decimal, tmp_path):
    write_table(missions(), tmp_path / "missions.csv")
    frame = pd.read_csv(tmp_path / "missions.csv", dtype={"status": str})
    frame.to_csv(tmp_path / "other.csv", sep=separator, decimal=decimal, index=False)
    assert_same(read_table(tmp_path / "other.csv"), missions())


@pytest.mark.parametrize("columns", [("x", "y"), ("lon", "lat")])
def test_positions_become_cells(columns):
    terrain = tb.terrain.synthetic_terrain((90.0, 90.0), seed=5)
    workspace = tb.Workspace.from_terrain(terrain, (3, 3), tb.Team(1))
    at = workspace.grid.center if columns[0] == "x" else workspace.grid.lonlat
    positions = dict(zip(columns, zip(*map(at, PATH), strict=True), strict=True))
    table = rows(row=None, col=None, **positions)
    assert read_table(table, workspace)[0].path == tuple(PATH)
    swapped = dict(zip(columns, reversed(positions.values()), strict=True))
    message = rf"row 1: {columns[0]} = .* is no position on .* grid; swapped\? .* in cell \(2, 0\)"
    with pytest.raises(TrustboError, match=message):
        read_table(rows(row=None, col=None, **swapped), workspace)
    for far in (0.0, 1e9, None):
        away = {name: [far] * 3 for name in columns}
        with pytest.raises(TrustboError, match=r"row 1: .* is no position on .* grid, x \d"):
            read_table(rows(row=None, col=None, **away), workspace)
    if columns[0] == "lon":
        bare = tb.Workspace.from_awareness(np.full((1, 3, 3, 2), 0.5))
        with pytest.raises(TrustboError, match=r"row 1: lon = .* no coordinate reference system"):
            read_table(table, bare)


def test_the_start_may_be_given_where_bound_0_is_missing():
    table = rows().drop(index=0)
    assert read_table(table, start=(1, 0))[0].path == ((1, 0), (0, 1), (0, 2))
    with pytest.raises(TrustboError, match=r"mission 1 has no row of bound 0, its start cell"):
        read_table(table)


def test_bounds_that_were_planned_but_not_run_are_part_of_the_path():
    table = rows(
        contact_rate=[None, 0.5, None],
        visibility=[None, 0.5, None],
        status=["", "tipped", ""],
        robot=[None, "r1", None],
    )
    one = read_table(table)[0]
    assert (len(one.path), len(one.bounds), one.status) == (3, 1, "tipped")
    with pytest.raises(TrustboError, match='mission 1: status "ok" says the goal was reached'):
        read_table(table.drop(columns="status"))
    assert read_table(table.assign(mission_status="aborted", status=""))[0].status == "aborted"


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"row": None}, r"the table lacks row; it has mission, bound, robot, col"),
        (
            {"contact_rate": [None, 5.0, 6.0]},
            r"= 5 is outside .* ratings from 1 to n into .rating - 1",
        ),
        ({"contact_rate": None}, r"lacks contact_rate \(or contact_time and duration\)"),
        ({"bound": [0, 1, 3]}, r"mission 1 has bounds \[0, 1, 3\], but no bound 2"),
        ({"bound": [0, 1, 1]}, r"bound 1, robot 'r1' is there twice, in rows 2 and 3"),
        ({"bound": [0, 1, -1]}, r"row 3: bound = -1 must be 0, the start cell, or more"),
        ({"bound": [0, 1, 1.5]}, r"row 3: bound = '1\.5' must be a whole number"),
        ({"col": [0, 1, "east"]}, r"row 3: col = 'east' is no number"),
        ({"col": [0, 1, 2.5]}, r"row 3: col = '2\.5' must be a whole number"),
        ({"row": [0, None, 0]}, r"row 2: row = '' must be a whole number"),
        (
            {"contact_rate": [None, 0.5, 1.5]},
            r"mission 1, bound 2: contact_rate .* 1\.5 is outside",
        ),
        (
            {"contact_rate": [0.1, 0.5, 0.5]},
            r"row 1: bound 0 is the start cell and measures nothing",
        ),
        ({"visibility": [None, -0.1, 0.5]}, r"row 2: visibility = -0\.1 is outside \[0, 1\]"),
        (
            {"contact_rate": [None, 40.0, 100.0]},
            r"bound 1: contact_rate = 40 is outside \[0, 1\]; divide percentages by 100",
        ),
        (
            {"battery": [None, 87.5, 85.0]},
            r"row 2: battery = 87\.5 is outside .* awareness feature: ignore=\('battery',\)",
        ),
        (
            {"timestamp": [None, "10:02:33", "10:03:01"]},
            r"row 2: timestamp = '10:02:33' is no number; .*: ignore=\('timestamp',\)",
        ),
        (
            {"t0": [None, 20.0, 5.0]},
            r"mission 1, bound 2: time goes backwards, t0 = 5 s after 20 s; number the bounds",
        ),
        ({"duration": [None, "inf", 4.0]}, r"row 2: duration = 'inf' is no number"),
        (
            {"row": None, "x": [0.5] * 3, "y": [0.5] * 3},
            r"cells from x and y need the grid: give workspace",
        ),
        (
            {"status": ["", "ok", "fine"]},
            r"mission 1, bound 2: unknown status 'fine'; choose one of",
        ),
        (
            {"mission_status": ["ok", "lost_contact", "ok"]},
            r"disagree on mission_status: ok and lost",
        ),
        ({"n_ticks": [None, 3, 4]}, r"bound 1: contact_rate\[0\] = 0\.5 is no share of 3 ticks"),
        ({"duration": [None, 0.0, 4.0]}, r"bound 1: duration\[0\] = 0 s must be positive"),
        ({"mission": [1, None, 1]}, r"row 2: mission is blank"),
        ({"robot": ["r1", "r1", "r2"]}, r"mission 1, bound 1 has no row for robot 'r2'"),
        (
            {"note": ["", "a tree", ""]},
            r"note = 'a tree' is no number; if it is no awareness feature",
        ),
        (
            {"contact_rate": [None] * 3, "visibility": [None] * 3},
            r"mission 1 measured nothing: no bound of it has a value",
        ),
        (
            {"contact_time": [None, 9.0, 1.0], "duration": [None, 4.0, 4.0]},
            r"mission 1, bound 1: contact_time = 9 s exceeds duration = 4 s",
        ),
        (
            {"contact_time": [None, 1.0, 3.0], "duration": [None, 4.0, 4.0]},
            r"contact_rate = 0\.5 of 4 s is not contact_time = 1 s; give one",
        ),
    ],
)
def test_what_is_amiss_is_named(columns, message):
    with pytest.raises(TrustboError, match=message):
        read_table(rows(**columns))


def test_rows_of_one_bound_must_agree():
    both = pd.concat([rows(), rows(robot=["r2"] * 3, row=[0, 1, 0])])
    with pytest.raises(
        TrustboError, match=r"bound 1: rows disagree on cell: \(0, 1\) and \(1, 1\)"
    ):
        read_table(both)
    with pytest.raises(TrustboError, match=r"row 1: robot 'r1' is not one of \('r2',\)"):
        read_table(both, robots=["r2"])
    message = r"lacks columns of awareness: slope; it has visibility\. .*: ignore=\('visibility',\)"
    with pytest.raises(TrustboError, match=message):
        read_table(both, features=["slope"])


def test_files_that_are_no_table_are_named(tmp_path):
    with pytest.raises(TrustboError, match=r"there is no file '.*none\.csv'; give a CSV file"):
        read_table(tmp_path / "none.csv")
    with pytest.raises(TrustboError, match="give the path of a CSV file or a DataFrame; got 3"):
        read_table(3)
    file = tmp_path / "bad.csv"
    for text, message in (
        ("", "the table lacks mission, bound, robot, contact_rate"),
        (
            "mission;bound\n1;2\n",
            r"lacks robot, contact_rate .* has mission, bound\.",
        ),
        ("mission,bound\n1,2,3\n", "row 1 has 3 values, the header 2"),
        ("mission,mission\n1,2\n", "two columns of one name: mission, mission"),
        ("mission,bound,robot,row,col,contact_rate,visibility\n", "the table has no rows"),
    ):
        file.write_text(text)
        with pytest.raises(TrustboError, match=message):
            read_table(file)
    file.write_bytes(b"mission\n\xff\xfe")
    with pytest.raises(TrustboError, match=r"bad\.csv' cannot be read as CSV in UTF-8"):
        read_table(file)
    with pytest.raises(TrustboError, match=r"columns must have one length; got \[1, 2\]"):
        read_table({"mission": [1], "bound": [1, 2]})


def test_only_missions_of_one_team_make_a_table(tmp_path):
    with pytest.raises(ShapeError, match=r"mission 1 has robots \('a', 'b'\) and features"):
        write_table([*missions(), *missions(robots=("a", "b"))][1::2], tmp_path / "missions.csv")
    for nothing in ([], missions()[0]):
        with pytest.raises(ShapeError, match=r"give at least one|must be a list of missions"):
            write_table(nothing, tmp_path / "missions.csv")
    assert list(tmp_path.iterdir()) == []


def test_the_how_to_says_which_columns_are_required(tmp_path):
    page = Path(__file__).resolve().parents[2] / "docs" / "howto" / "your-own-robots.md"
    told = re.findall(r"^\| (`\w+`.*?) \| (yes|no|instead) \|", page.read_text(), flags=re.M)
    said = {name: word for names, word in told for name in re.findall(r"`(\w+)`", names)}
    assert said["mission"] == "yes"
    assert said["contact_time"] == said["x"] == "instead"
    write_table(missions(), tmp_path / "missions.csv")
    table = pd.read_csv(tmp_path / "missions.csv")
    for column in table.columns:
        part = table.drop(columns=column)
        if said.get(column, "no") == "no":
            assert len(read_table(part)) == 2
        else:
            with pytest.raises(TrustboError, match=column):
                read_table(part)
