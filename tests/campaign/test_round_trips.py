"""Reading is the inverse of writing, twice round, for every kind of file that is both."""

from dataclasses import fields

import numpy as np
import pytest
from worlds import ModelSimulator

import trustbo as tb
from trustbo.data import Bound
from trustbo.logs import read_missions, read_table, to_frame, write_missions

ENDS = ((1, 0), (0, 1))


@pytest.fixture(scope="module")
def terrain():
    return tb.terrain.synthetic_terrain((60.0, 60.0), resolution=2.0, seed=1, relief=5.0)


@pytest.fixture(scope="module", params=["terrain", "awareness"])
def workspace(request, terrain):
    if request.param == "terrain":
        return tb.Workspace.from_terrain(terrain, (2, 2), tb.Team(2))
    return tb.Workspace.from_awareness(np.random.default_rng(0).uniform(size=(2, 2, 2, 3)))


def rounds(write, read, first, folder):
    """What is read after the first and the second round."""
    found = [first]
    for n in range(2):
        write(found[-1], folder / str(n))
        found.append(read(folder / str(n)))
    return found[1:]


def same_workspace(one, other):
    assert (one.grid, one.team, one.sights) == (other.grid, other.team, other.sights)
    for name in ("awareness", "passable", "terrain", "pixels", "of_bounds"):
        a, b = getattr(one, name), getattr(other, name)
        assert (a is None) == (b is None), name
        assert a is None or a.identical(b), name
    assert one.composites.keys() == other.composites.keys()


def same_missions(ones, others):
    assert len(ones) == len(others)
    for one, other in zip(ones, others, strict=True):
        assert (one.path, one.status, one.robots) == (other.path, other.status, other.robots)
        for a, b in zip(one.bounds, other.bounds, strict=True):
            for name in (field.name for field in fields(Bound)):
                x, y = getattr(a, name), getattr(b, name)
                assert (x is None) == (y is None), name
                if isinstance(x, np.ndarray):
                    np.testing.assert_array_equal(x, y, err_msg=name)


def same_results(one, other):
    same_workspace(one.workspace, other.workspace)
    same_missions(one.missions, other.missions)
    assert one.history.identical(other.history)
    assert one.trust_map.identical(other.trust_map)
    assert (one.path, one.value, one.stop_reason) == (other.path, other.value, other.stop_reason)
    assert one.settings.keys() == other.settings.keys()
    for a, b in zip(one.posteriors, other.posteriors, strict=True):
        assert a.identical(b)


@pytest.fixture(scope="module")
def kept(workspace, tmp_path_factory):
    """Folder of a campaign with two missions, one of them by the robots' simulator."""
    folder = tmp_path_factory.mktemp("kept")
    on_terrain = workspace.terrain is not None
    truth = tb.models.TrustParams(0.6, np.array([0.3, 0.2, 0.1]), 0.05, 0.05, 0.05)
    simulator = None if on_terrain else ModelSimulator(workspace, truth)
    tb.iterate(
        workspace, *ENDS, n_iterations=2, simulator=simulator, checkpoint=folder / "kept",
        sampler="exact", progress=False,
    )  # fmt: skip
    return folder / "kept"


def test_a_result_and_its_workspace(kept, workspace, tmp_path):
    first = tb.load_result(kept)
    same_workspace(workspace, first.workspace)
    for again in rounds(tb.Result.save, tb.load_result, first, tmp_path):
        same_results(first, again)


def test_a_campaign(kept, tmp_path):
    def state(campaign):
        entries = [(e.row, e.extra, e.plan.path) for e in campaign.state.entries]
        return repr((campaign.settings, entries, campaign.state.failures, campaign.state.notes))

    with tb.Campaign.load(kept) as first:
        state_of_first = state(first)
        campaigns = rounds(tb.Campaign.save, tb.Campaign.load, first, tmp_path)
        for again in campaigns:
            assert state(again) == state_of_first
            same_missions(first.state.measured, again.state.measured)
            same_workspace(first.workspace, again.workspace)
            with again:
                pass
    same_results(tb.load_result(kept), tb.load_result(tmp_path / "1"))


def test_a_campaign_on_a_workspace_that_was_read(kept, tmp_path):
    before = tb.load_result(kept).workspace
    with tb.Campaign(before, *ENDS, directory=tmp_path / "next") as campaign:
        same_workspace(before, campaign.workspace)
    with tb.Campaign.load(tmp_path / "next") as again:
        same_workspace(before, again.workspace)


@pytest.mark.parametrize(
    ("write", "read", "name", "exact"),
    [
        (lambda missions, file: write_missions(file, missions), read_missions, "log.nc", True),
        (
            lambda missions, file: to_frame(missions).to_csv(file, index=False),
            read_table,
            "log.csv",
            False,
        ),
    ],
)
def test_missions(kept, tmp_path, write, read, name, exact):
    missions = tb.load_result(kept).missions
    write(missions, tmp_path / f"0{name}")
    once = read(tmp_path / f"0{name}")
    write(once, tmp_path / f"1{name}")
    twice = read(tmp_path / f"1{name}")
    assert [m.path for m in once] == [m.path for m in missions]
    for one, other in zip(missions, once, strict=True):
        np.testing.assert_allclose(one.contact_rate, other.contact_rate, atol=1e-9)
    if exact:
        same_missions(missions, once)
    same_missions(once, twice)


def test_two_files_of_missions_in_a_folder_keep_their_own_ticks(tmp_path, terrain):
    workspace = tb.Workspace.from_terrain(terrain, (2, 2), tb.Team(2))
    simulator = tb.simulation.KinematicSimulator(workspace)
    runs = [[simulator.run([(1, 0), (0, 1)], seed=seed)] for seed in (1, 2)]
    for j, missions in enumerate(runs):
        write_missions(tmp_path / f"log{j}.nc", missions)
    for j, missions in enumerate(runs):
        same_missions(missions, read_missions(tmp_path / f"log{j}.nc"))


def test_terrain_as_rasters(terrain, tmp_path):
    def write(terrain, folder):
        folder.mkdir()
        for name in ("dem", "dsm"):
            terrain[name].rio.to_raster(folder / f"{name}.tif")

    def read(folder):
        return tb.terrain.read_terrain(folder / "dem.tif", folder / "dsm.tif")

    once, twice = rounds(write, read, terrain, tmp_path)
    for name in ("dem", "dsm"):
        np.testing.assert_allclose(once[name], terrain[name])
        np.testing.assert_array_equal(once[name], twice[name])
    assert once.rio.crs == twice.rio.crs == terrain.rio.crs
