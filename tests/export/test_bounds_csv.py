"""The table of bounds, read by the csv module."""

import csv

import numpy as np
import pytest

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.export import write_csv


def test_there_is_a_row_per_mission_bound_and_robot(result, tmp_path):
    write_csv(tmp_path / "bounds.csv", result)
    with (tmp_path / "bounds.csv").open(newline="", encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if row["bound"] != "0"]
    assert len(rows) == 3 * sum(len(mission.bounds) for mission in result.missions)
    latent = result.posterior["latent"]
    for row in rows:
        mission = result.missions[int(row["mission"]) - 1]
        bound = mission.bounds[int(row["bound"]) - 1]
        i = mission.robots.index(row["robot"])
        assert (int(row["row"]), int(row["col"])) == bound.cell
        assert (row["status"], row["mission_status"]) == (bound.status, mission.status)
        for name in ("contact_rate", "duration", "n_ticks"):
            assert float(row[name]) == getattr(bound, name)[i]
        z = [float(row[name]) for name in ("traversability", "visibility", "line_of_sight")]
        np.testing.assert_array_equal(z, bound.awareness[i])
        place = {
            "mission": int(row["mission"]) - 1,
            "bound": int(row["bound"]),
            "robot": row["robot"],
        }
        for name in ("trust_mean", "trust_sd"):
            assert float(row[name]) == float(latent[name].sel(place))
    assert len({(row["mission"], row["bound"], row["robot"]) for row in rows}) == len(rows)


def test_trust_is_blank_in_missions_that_the_last_posterior_is_not_of(result, tmp_path):
    campaign = tb.Campaign(result.workspace, (2, 0), (0, 3), sampler="exact", seed=3)
    for _ in campaign.run(n_iterations=2):
        pass
    campaign.exclude(1, "its log was of another hill")
    without = campaign.result()
    write_csv(tmp_path / "bounds.csv", without)
    with (tmp_path / "bounds.csv").open(newline="", encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if row["bound"] != "0"]
    assert {row["mission"]: row["trust_sd"] != "" for row in rows} == {"1": False, "2": True}
    last = without.posterior["latent"]["trust_mean"].values[0]
    found = [float(row["trust_mean"]) for row in rows if row["mission"] == "2"]
    np.testing.assert_array_equal(found, last.ravel())


def test_a_folder_is_no_table(result, tmp_path):
    with pytest.raises(TrustboError, match="it is a folder; name a file in it"):
        write_csv(tmp_path, result)
    assert list(tmp_path.iterdir()) == []
