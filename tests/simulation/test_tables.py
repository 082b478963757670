"""Tables of missions: what is written comes back, and whatever is amiss is named."""

import numpy as np
import pytest

from trustbo.data import Mission
from trustbo.errors import ShapeError, TrustboError
from trustbo.simulation.tables import read_table, write_table

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
        PATH, z, rates, rng.uniform(1, 9, shape[:2]), exposure=ticks, **names
    )
    z[0, 0, 1], rates[0, 1] = np.nan, np.nan
    cut = Mission.from_arrays(PATH, z[:1], rates[:1], status="stuck", **names)
    return [whole, cut]


def assert_same(got, expected):
    assert len(got) == len(expected)
    for mine, other in zip(got, expected, strict=True):
        for name in ("path", "status", "features", "robots"):
            assert getattr(mine, name) == getattr(other, name)
        for name in ("awareness", "contact_rate", "duration", "exposure"):
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
        ({"contact_rate": None}, r"lacks contact_rate \(or contact_time and duration\)"),
        ({"visibility": None}, r"lacks columns of awareness: it has none"),
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
        ({"visibility": [None, -0.1, 0.5]}, r"mission 1, bound 1: awareness .* -0\.1 is outside"),
        (
            {"status": ["", "ok", "fine"]},
            r"mission 1, bound 2: unknown status 'fine'; choose one of",
        ),
        (
            {"mission_status": ["ok", "lost_contact", "ok"]},
            r"disagree on mission_status: ok and lost",
        ),
        ({"exposure": [None, 3, 4]}, r"bound 1: contact_rate\[0\] = 0\.5 is no share of 3 ticks"),
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
    with pytest.raises(TrustboError, match="lacks columns of awareness: slope"):
        read_table(both, features=["slope"])


def test_files_that_are_no_table_are_named(tmp_path):
    with pytest.raises(TrustboError, match=r"there is no file '.*none\.csv'; give a CSV file"):
        read_table(tmp_path / "none.csv")
    with pytest.raises(TrustboError, match="give the path of a CSV file or a DataFrame; got 3"):
        read_table(3)
    file = tmp_path / "bad.csv"
    for text, message in (
        ("", "the table lacks mission, bound, robot, row, col, contact_rate"),
        ("mission;bound\n1;2\n", "the table lacks mission"),
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
