"""A week of a team of real robots at a shell; a simulator writes the logs of the robots."""

import json
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from commands import call

import trustbo as tb
from trustbo.simulation import KinematicSimulator

TEAM = ("alpha", "bravo", "charlie")
CAMP, HILL, BRIDGE = (4, 0), (0, 4), (0, 0)
MAPS = "--dem", "dem.tif", "--dsm", "dsm.tif", "--shape", "5,5"


@pytest.fixture(scope="module")
def ground(tmp_path_factory):
    """Folder with maps; a campaign is begun there."""
    folder = tmp_path_factory.mktemp("shell")
    terrain = tb.terrain.synthetic_terrain(size=(200.0, 200.0), resolution=2.5, seed=4)
    for name in ("dem", "dsm"):
        terrain[name].astype("float32").rio.to_raster(folder / f"{name}.tif")
    maps = "--dem", folder / "dem.tif", "--dsm", folder / "dsm.tif", "--shape", "5,5"
    places = [f"--place={name}={row},{col}" for name, (row, col) in
              {"camp": CAMP, "hill": HILL, "bridge": BRIDGE}.items()]  # fmt: skip
    names = "--names", ",".join(TEAM)
    assert call("new", folder / "week", *maps, "--max-slope", 30, *names, *places) == 0
    return folder


def asked(ground):
    """Plan that is recorded."""
    with tb.Campaign.load(ground / "week", progress=False) as campaign:
        return campaign.state.asked


def drive(ground, seed):
    """Log file of the planned mission, as a team would write it."""
    plan = asked(ground)
    simulator = KinematicSimulator(plan.workspace.whole)
    mission = simulator.run(plan.path, post_sets=plan.post_sets, seed=seed).of_robots(plan.robots)
    file = ground / f"log-{seed}.csv"
    tb.logs.to_frame([mission]).to_csv(file, index=False)
    return file


def test_a_week_at_a_shell_is_that_of_a_campaign_in_python(ground, tmp_path, capsys):
    week = ground / "week"
    assert call("ask", week, "camp", "hill", "--nav2", tmp_path / "nav2",
                "--geojson", tmp_path / "path.geojson") == 0  # fmt: skip
    said = capsys.readouterr().out
    assert "camp to hill, with alpha, bravo, charlie" in said
    assert "price of failure" in said
    poses = json.loads((tmp_path / "nav2" / "waypoints_lead.yaml").read_text())["poses"]
    assert len(poses) == len(asked(ground).path)
    assert call("tell", week, drive(ground, 0)) == 0
    assert "mission 1: camp to hill, ok" in capsys.readouterr().out

    assert call("ask", week, "hill", "bridge", "--robots", "charlie,alpha") == 0
    assert asked(ground).robots == ("alpha", "charlie")
    assert call("tell", week, drive(ground, 1)) == 0

    assert call("ways", week, "bridge", "camp", "--picture", tmp_path / "ways.png") == 0
    said = capsys.readouterr().out
    assert all(name in said for name in ("recommended", "safest", "shortest", "degrees"))
    assert (tmp_path / "ways.png").read_bytes().startswith(b"\x89PNG")
    assert call("ask", week, "bridge", "camp", "--way", 0) == 0
    assert call("fail", week, "stuck", "--where", ",".join(map(str, asked(ground).path[1]))) == 0
    assert call("ask", week, "camp", "bridge") == 0
    assert call("tell", week, drive(ground, 2)) == 0

    right = tb.load_result(week).missions[0]
    right = tb.logs.to_frame([right]).assign(contact_rate=lambda t: 0.5 * t["contact_rate"])
    right.drop(columns="n_ticks").to_csv(ground / "right.csv", index=False)
    assert call("correct", week, 1, ground / "right.csv", "--reason", "another detector") == 0
    assert call("status", week) == 0
    said = capsys.readouterr().out
    assert "corrected, see mission 4: another detector" in said
    assert "from its stop" in said
    assert call("report", week, "--out", tmp_path / "report.html") == 0
    assert call("export", week, "--format", "csv", "--out", tmp_path) == 0

    table = tb.load_result(week).table()
    counted = table[table.index.notna()]
    assert counted["state"].tolist() == ["excluded", "learned", "learned", "learned"]
    assert counted["start"].tolist() == ["camp", "hill", "camp", "camp"]
    assert counted["robots"].tolist()[1] == "alpha, charlie"
    assert np.isclose(counted["contact_rate"].iloc[3], 0.5 * counted["contact_rate"].iloc[0])


def test_what_is_closed_at_a_shell_is_avoided_until_it_is_reopened(ground, capsys):
    week = ground / "week"
    assert call("ask", week, "camp", "hill") == 0
    path = asked(ground).path
    cell, bound = f"{path[2][0]},{path[2][1]}", "camp/" + ",".join(map(str, path[1]))
    capsys.readouterr()
    words = "--reason", "wreck", "--until", "2099-12-03T08:00", "--by", "lead"
    assert call("close", week, cell, bound, *words) == 0
    said = capsys.readouterr().out
    assert "closing 1: " in said
    assert "call trustbo ask again" in said
    assert call("status", week) == 0
    assert "wreck" in capsys.readouterr().out
    assert call("ask", week, "camp", "hill") == 0
    assert path[2] not in asked(ground).path
    assert asked(ground).path[1] != path[1]
    assert call("reopen", week, 1, "--reason", "towed away") == 0
    assert call("ask", week, "camp", "hill") == 0
    assert asked(ground).path == path

    assert call("close", week, "hill", "--reason", "fire", "--until", 99) == 0
    capsys.readouterr()
    assert call("ways", week, "camp", "hill") == 1
    assert "hill (fire)" in capsys.readouterr().err
    assert call("reopen", week, 2, "--reason", "put out") == 0
    assert [one.until for one in tb.load_result(week).state.closings][1] == 99


def test_mud_at_a_shell_teaches_no_slope(ground, capsys):
    week = ground / "week"
    before = float(tb.load_result(week).hazard["failures"].sum())
    assert call("ask", week, "camp", "hill") == 0
    where = ",".join(map(str, asked(ground).path[1]))
    assert call("fail", week, "mud", "--where", where) == 0
    assert call("ask", week, "camp", "hill") == 0
    log = pd.read_csv(drive(ground, 7))
    log = log[log["bound"] <= 2]
    log.loc[log["bound"] == 2, "status"] = "stuck"
    log.to_csv(ground / "mud.csv", index=False)
    assert call("tell", week, ground / "mud.csv", "--cause", "mud") == 0
    result = tb.load_result(week)
    assert result.table()["reason"].tolist()[-2:] == ["mud", "mud (stuck)"]
    assert float(result.hazard["failures"].sum()) == before


@pytest.mark.parametrize(
    "words",
    [
        ("ask", "week", "camp", "nowhere"),
        ("ask", "week", "camp", "hill", "--robots", "delta"),
        ("ask", "week", "camp", "hill", "--way", "9"),
        ("tell", "week", "absent.csv"),
        ("tell", "week", "dem.tif"),
        ("fail", "week", ""),
        ("correct", "week", "9", "right.csv", "--reason", "none"),
        ("close", "week", "9,9", "--reason", "wreck"),
        ("close", "week", "0,0/2,2", "--reason", "wreck"),
        ("close", "week", "1,1", "--reason", "wreck", "--until", "yesterday"),
        ("close", "week", "1,1", "--reason", "wreck", "--until", "1"),
        ("reopen", "week", "9", "--reason", "open"),
        ("status", "absent"),
        ("ways", "week", "camp", "camp"),
        ("ways", "week", "camp", "hill", "--picture", "ways.unknown"),
        ("resume", "week"),
        ("new", "week", *MAPS),
        ("new", "other", *MAPS, "--place", "camp=50,50"),
        ("new", "other", *MAPS, "--place", "camp=somewhere"),
    ],
)
def test_wrong_input_is_one_sentence_and_records_nothing(words, ground, capsys, monkeypatch):
    monkeypatch.chdir(ground)
    before = {file: file.read_bytes() for file in (ground / "week").rglob("*") if file.is_file()}
    capsys.readouterr()
    assert call(*words) == 1
    errors = [x for x in capsys.readouterr().err.splitlines() if x.startswith("error: ")]
    assert len(errors) == 1
    after = {file: file.read_bytes() for file in (ground / "week").rglob("*") if file.is_file()}
    assert after == before
    assert not (ground / "other").exists()


def test_a_second_process_is_refused(ground):
    words = sys.executable, "-m", "trustbo", "ask", str(ground / "week"), "camp", "hill"
    with tb.Campaign.load(ground / "week", progress=False):
        done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "another campaign is using" in done.stderr


def test_a_log_with_names_and_units_of_its_own_is_told_as_it_is(ground, tmp_path, capsys):
    """The mapping is given once, with the ground; the log begins with leg 1 and has positions."""
    mapping = tmp_path / "columns.toml"
    mapping.write_text(
        'mission = "run"\nbound = "leg"\nrobot = "vehicle"\nx = "utm_e"\ny = "utm_n"\n'
        'contact_rate = {column = "contact_pct", unit = "%"}\n'
    )
    maps = [ground / part if part.endswith(".tif") else part for part in MAPS]
    names = "--names", ",".join(TEAM)
    folder = tmp_path / "legs"
    wrong = tmp_path / "wrong.toml"
    wrong.write_text('contact_rate = {column = "contact_pct", unit = "percent"}')
    assert call("new", folder, *maps, *names, "--columns", wrong) == 1
    assert not folder.exists()
    assert call("new", folder, *maps, "--max-slope", 30, *names, "--columns", mapping) == 0
    assert call("ask", folder, "4,0", "0,4") == 0

    with tb.Campaign.load(folder, progress=False) as campaign:
        plan = campaign.state.asked
    rows = ["run,leg,vehicle,utm_e,utm_n,contact_pct,note"]
    for k, cell in enumerate(plan.path[1:], start=1):
        x, y = plan.workspace.posts.stop(cell)
        rows += [f"monday,{k},{name},{x:.2f},{y:.2f},{90.5 - k},dust" for name in TEAM]
    (tmp_path / "legs.csv").write_text("\n".join(rows))
    assert call("tell", folder, tmp_path / "legs.csv") == 0
    assert "mission 1: 4,0 to 0,4, ok" in capsys.readouterr().out
    with tb.Campaign.load(folder, progress=False) as campaign:
        rates = campaign.missions[0].contact_rate[:, 0]
        np.testing.assert_allclose(rates, [(90.5 - k) / 100 for k in range(1, len(plan.path))])
