"""Tables with names, units, positions and times of their own."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import trustbo as tb
from trustbo.errors import TrustboError

TEAM = ("alpha", "bravo")
PATH = ((3, 0), (2, 1), (1, 2), (0, 3))
ZONE = "America/Los_Angeles"
COLUMNS = {
    "mission": "run",
    "bound": "leg",
    "robot": "vehicle",
    "x": "utm_e",
    "y": "utm_n",
    "contact_rate": {"column": "contact_pct", "unit": "%"},
    "begin": {"column": "leg_start", "unit": "date", "zone": ZONE},
    "end": {"column": "leg_end", "unit": "date", "zone": ZONE},
    "status": "outcome",
}


@pytest.fixture(scope="module")
def field():
    z = np.full((2, 4, 4, 2), 0.5)
    workspace = tb.Workspace.from_awareness(z, cell_size=20.0, team=tb.Team(2, names=TEAM))
    return workspace.with_places({"camp": PATH[0], "hill": PATH[-1]})


def legs(field):
    """Table of legs as a team writes it: local time, percent, and positions in metres."""
    rows = []
    start = pd.Timestamp("2026-05-04 09:30:00")
    for k, cell in enumerate(PATH[1:], start=1):
        x, y = field.grid.center(cell)
        begin = start + pd.Timedelta(minutes=k)
        for i, name in enumerate(TEAM):
            rows.append({"run": "monday", "leg": k, "vehicle": name, "utm_e": x + 3.0,
                         "utm_n": y - 4.0, "contact_pct": 95.4 - 10.3 * i - k,
                         "leg_start": str(begin), "leg_end": str(begin + pd.Timedelta(seconds=48)),
                         "outcome": "OK", "note": "dust"})  # fmt: skip
    return pd.DataFrame(rows)


def test_a_table_of_legs_is_read_with_its_own_names_and_units(field, tmp_path):
    table = legs(field)
    table.to_csv(tmp_path / "legs.csv", index=False)
    for source in (table, tmp_path / "legs.csv"):
        (one,) = tb.logs.read_table(source, columns=COLUMNS, workspace=field, path=PATH)
        assert (one.path, one.robots, one.status) == (PATH, TEAM, "ok")
        by_hand = table.pivot(index="leg", columns="vehicle", values="contact_pct") / 100.0
        np.testing.assert_allclose(one.contact_rate, by_hand, atol=1e-12)
        np.testing.assert_array_equal(one.duration, 48.0)
        assert one.features == field.features  # and not the note


def test_a_start_in_the_table_is_kept(field):
    table = legs(field)
    first = table.iloc[:2].assign(leg=0, utm_e=10.0, utm_n=10.0, contact_pct="", leg_start="",
                                  leg_end="")  # fmt: skip
    (one,) = tb.logs.read_table(pd.concat([first, table]), columns=COLUMNS, workspace=field)
    assert one.path == PATH


@pytest.mark.parametrize("kind", ["degrees", "places"])
def test_positions_may_be_degrees_or_places(kind):
    workspace = tb.Workspace.from_terrain(tb.terrain.example(), (4, 4), n_posts=1)
    cells = [(3, 0), (2, 1)]
    robots = workspace.team.names
    table = {"mission": 1, "bound": np.repeat([0, 1], 3), "robot": [*robots] * 2,
             "contact_rate": [np.nan] * 3 + [0.5] * 3}  # fmt: skip
    if kind == "places":
        workspace = workspace.with_places({"camp": cells[0], "hill": cells[1]})
        table["place"] = np.repeat(["camp", "hill"], 3)
    else:
        from pyproj import Transformer

        to_degrees = Transformer.from_crs(workspace.grid.crs, "EPSG:4326", always_xy=True)
        degrees = [to_degrees.transform(*workspace.grid.center(cell)) for cell in cells]
        table["lon"], table["lat"] = np.repeat(degrees, 3, axis=0).T
    (one,) = tb.logs.read_table(table, workspace=workspace)
    assert one.path == tuple(cells)


def test_a_day_in_which_clocks_change_has_its_true_duration(field):
    table = legs(field).assign(leg_start="2026-11-01 00:59:00", leg_end="2026-11-01 03:01:00")
    (one,) = tb.logs.read_table(table, columns=COLUMNS, workspace=field, path=PATH)
    np.testing.assert_array_equal(one.duration, 3.0 * 3600.0 + 120.0)  # 01:00 comes twice


@pytest.mark.parametrize(
    ("columns", "match"),
    [
        ({"contact_rate": {"column": "contact_pct", "unit": "percent"}}, "unit.*'percent'.*%"),
        ({"contact_rate": {"unit": "%"}}, "contact_rate.*have column"),
        ({"contact_rate": 3}, "contact_rate.*3"),
        ({"begin": {"column": "leg_start", "unit": "date", "zone": "PST8"}}, "zone.*'PST8'"),
        ({"begin": {"column": "leg_start", "zone": ZONE}}, 'unit must be "date"'),
        ({"end": {"column": "note", "unit": "date"}}, "row 1 .*note = 'dust' is not a date"),
        ({"begin": "leg_end", "end": "leg_start"}, "leg_|begin|end"),
        ({"contact_rate": "contact_pct"}, "outside.*percent"),
        ({"x": "leg_x"}, "lacks leg_x, which .* names for x; it has run"),
        ({"mission": "Run"}, "lacks Run"),
    ],
)
def test_a_wrong_mapping_is_one_sentence(field, columns, match):
    with pytest.raises(TrustboError, match=match) as caught:
        tb.logs.read_table(legs(field), columns=COLUMNS | columns, workspace=field, path=PATH)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("columns", [{}, [("mission", "run")], "run", {"mission": "a"}])
def test_a_mapping_that_names_no_column_is_refused(field, columns):
    with pytest.raises(TrustboError, match="columns"):
        tb.logs.read_table(legs(field), columns=columns)


def test_dates_say_when_a_mission_and_its_bounds_began(field, tmp_path):
    [mission] = tb.logs.read_table(legs(field), columns=COLUMNS, workspace=field, path=PATH)
    begins = [pd.Timestamp(leg, tz=ZONE) for leg in legs(field).groupby("leg")["leg_start"].min()]
    assert mission.began == begins[0].timestamp()
    np.testing.assert_allclose(mission.starts, [(t - begins[0]).total_seconds() for t in begins])
    assert str(begins[0].tz_convert("UTC").floor("s")) in str(mission)

    tb.logs.to_frame([mission]).to_csv(tmp_path / "again.csv", index=False)
    tb.logs.write_missions(tmp_path / "again.nc", [mission])
    [of_table] = tb.logs.read_table(tmp_path / "again.csv")
    [of_file] = tb.logs.read_missions(tmp_path / "again.nc")
    for again in (of_table, of_file):
        assert again.began == mission.began
        np.testing.assert_allclose(again.starts, mission.starts, atol=1e-6)

    later = replace(mission, began=mission.began + 3600.0)
    assert not later.has_same_data(mission)
    assert replace(mission, began=np.nan).has_same_data(mission)


def test_positions_outside_the_ground_are_named_with_their_row(field):
    table = legs(field)
    table.loc[3, "utm_e"] = 900.0
    with pytest.raises(TrustboError, match=r"row 4 of the table: .*900.* outside the grid"):
        tb.logs.read_table(table, columns=COLUMNS, workspace=field, path=PATH)


def test_a_file_of_columns_says_the_same(field, tmp_path):
    file = tmp_path / "columns.toml"
    file.write_text(
        'mission = "run"\nbound = "leg"\nrobot = "vehicle"\nx = "utm_e"\ny = "utm_n"\n'
        'contact_rate = {column = "contact_pct", unit = "%"}\nstatus = "outcome"\n'
        f'begin = {{column = "leg_start", unit = "date", zone = "{ZONE}"}}\n'
        f'end = {{column = "leg_end", unit = "date", zone = "{ZONE}"}}\n'
    )
    columns = tb.logs.read_columns(file)
    one, other = (
        tb.logs.read_table(legs(field), columns=given, workspace=field, path=PATH)[0]
        for given in (columns, COLUMNS)
    )
    assert one.has_same_data(other)
    file.write_text("mission = run")
    with pytest.raises(TrustboError, match="not a TOML file"):
        tb.logs.read_columns(file)


def test_tracks_have_units_degrees_and_scans_of_their_own():
    workspace = tb.Workspace.from_terrain(
        tb.terrain.example(), (4, 4), team=tb.Team(2, names=TEAM), n_posts=1
    )
    from pyproj import Transformer

    stops = [np.array(workspace.posts.stop(cell)) for cell in ((3, 0), (2, 1))]
    t = np.arange(0.0, 90.0)
    way = np.clip((t - 10.0) / 50.0, 0.0, 1.0)[:, None]
    xy = (1.0 - way) * stops[0] + way * stops[1]
    lon, lat = Transformer.from_crs(workspace.grid.crs, "EPSG:4326", always_xy=True).transform(
        *xy.T
    )
    poses = pd.concat([pd.DataFrame({"stamp": t * 1000.0, "id": name, "longitude": lon,
                                     "latitude": lat}) for name in ("lead", *TEAM)])  # fmt: skip
    found = np.arange(len(t)) % 4 != 0
    scans = pd.concat([pd.DataFrame({"stamp": t * 1000.0, "by": name, "of": "lead", "hit": found})
                       for name in TEAM])  # fmt: skip
    columns = {"t": {"column": "stamp", "unit": "ms"}, "robot": "id", "lon": "longitude",
               "lat": "latitude", "watcher": "by", "seen": "of", "detected": "hit"}  # fmt: skip
    options = {"path": [(3, 0), (2, 1)]}
    [one] = tb.logs.read_tracks(poses, scans, workspace, columns=columns, **options)

    plain = pd.concat([pd.DataFrame({"t": t, "robot": name, "x": xy[:, 0], "y": xy[:, 1]})
                       for name in ("lead", *TEAM)])  # fmt: skip
    seen = pd.concat([pd.DataFrame({"t": t[found], "watcher": name, "seen": "lead"})
                      for name in TEAM])  # fmt: skip
    [other] = tb.logs.read_tracks(plain, seen, workspace, **options)
    np.testing.assert_array_equal(one.contact_rate, other.contact_rate)
    assert one.status == "ok"

    del columns["detected"]
    with pytest.raises(TrustboError, match="hit"):
        tb.logs.read_tracks(poses, scans, workspace, columns=columns, **options)
