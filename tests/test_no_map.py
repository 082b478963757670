"""Missions of logs without a map: files, fits, scores, and what refuses them."""

import json

import numpy as np
import pytest

import trustbo as tb
from trustbo.data import NOWHERE, Mission
from trustbo.errors import TrustboError
from trustbo.inference.stored import missions_of
from trustbo.logs import read_missions, read_table, to_frame, write_missions
from trustbo.models import PlaceEffect, PooledTrust, RobotEffect
from trustbo.models.record import model_from_record


@pytest.fixture(scope="module")
def missions():
    rng = np.random.default_rng(0)
    made = []
    for n in (6, 9, 7):
        y = rng.uniform(size=(n, 2))
        y[0, 1] = np.nan
        z = 3.0 * rng.normal(size=(n, 2, 2))  # of any values
        made.append(Mission.from_arrays(None, z, y, features=("expected", "range")))
    return made


@pytest.fixture(scope="module")
def posterior(missions):
    return tb.fit(missions, PooledTrust(effects=RobotEffect()), draws=50, progress=False)


def equal(found, expected):
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert one.path == other.path == ()
        assert {bound.cell for bound in one.bounds} == {NOWHERE}
        assert (one.features, one.robots) == (other.features, other.robots)
        np.testing.assert_array_equal(one.awareness, other.awareness)
        np.testing.assert_array_equal(one.contact_rate, other.contact_rate)


def test_files_and_posteriors_give_them_back(missions, posterior, tmp_path):
    write_missions(tmp_path / "missions.nc", missions)
    equal(read_missions(tmp_path / "missions.nc"), missions)
    equal(read_table(to_frame(missions)), missions)
    equal(missions_of(posterior), missions)
    assert "no map" in repr(missions[0])


def test_the_default_model_has_effects_of_places_where_missions_have_places(missions):
    z, y = np.random.default_rng(1).uniform(0.3, 0.9, (2, 3, 2, 2))
    whole, jumps = [(0, 0), (0, 1), (1, 2), (1, 3)], [(0, 0), (0, 1), (2, 3), (1, 3)]
    for given, places in (
        (missions, ()),
        ([Mission.from_arrays(jumps, z, y[..., 0])], ()),
        ([Mission.from_arrays(whole, z, y[..., 0])], (PlaceEffect(),)),  # no line of sight
    ):
        posterior = tb.fit(given, draws=50, latent=False, check=False, progress=False)
        model = model_from_record(json.loads(posterior.attrs["model_record"]))
        assert model.effects == (*places, RobotEffect())


def test_they_have_fits_and_scores(missions, posterior):
    table = tb.inference.score(posterior, missions)
    assert int(table["n"]) == sum(2 * n - 1 for n in (6, 9, 7))


def test_a_robot_that_stands_out_is_found_without_places():
    rng = np.random.default_rng(1)
    missions = []
    for j in range(6):
        z = rng.uniform(size=(8, 3, 1))
        y = 0.8 * z[..., 0] + 0.1 + 0.03 * rng.normal(size=(8, 3))
        y[:, 1] -= 0.5 * z[:, 1, 0] * (j >= 3)  # robot 2, index 1, from mission 3 on
        given = z, np.clip(y, 0.0, 1.0)
        missions.append(Mission.from_arrays(None, *given, features=["line_of_sight"]))
    found = tb.check(tb.fit(missions, PooledTrust(effects=RobotEffect())))
    assert found.table.loc["robots", "stands_out"]
    assert found.table.loc["robots", "label"] == "r2"
    odd = found.robots[found.robots["stands_out"]]
    assert set(odd["robot"]) == {"r2"}
    assert set(odd["mission"]) == {4, 5, 6}


def test_what_needs_a_map_refuses_them_in_a_sentence(missions, posterior):
    z = np.full((2, 3, 3, 2), 0.5)
    workspace = tb.Workspace.from_awareness(z, features=missions[0].features)
    for call in (
        lambda: tb.fit(missions, PooledTrust(effects=PlaceEffect())),
        lambda: tb.fit(missions, PooledTrust(), workspace=workspace),
        lambda: tb.simulation.ReplaySimulator(missions),
        lambda: tb.Campaign(workspace, (0, 0), (2, 2)).tell(missions[0]),
    ):
        with pytest.raises(TrustboError, match="needs the cells of a map, but mission 0"):
            call()


def test_a_path_is_given_or_not():
    z, y = np.zeros((2, 1, 1)), np.zeros((2, 1))
    with pytest.raises(TrustboError, match="path"):
        Mission.from_arrays([], z, y)
    with pytest.raises(TrustboError, match="awareness"):
        Mission.from_arrays(None, z + np.inf, y)
    with pytest.raises(TrustboError, match="at least one"):
        Mission.from_arrays(None, z[:0], y[:0])
    failed = Mission.from_arrays(None, z, y, status="stuck")
    assert failed.status == failed.bounds[-1].status == "stuck"
