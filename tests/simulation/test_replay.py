"""Replayed missions: each once, on the path asked for, with what they measured."""

import numpy as np
import pytest
import xarray as xr
from worlds import ModelSimulator, hillside, random_cells

import trustbo as tb
from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.logs.table import to_frame
from trustbo.simulation.replay import ReplaySimulator

ENDS = ((3, 0), (0, 3))
LEFT, MIDDLE = [(2, 0), (1, 0), (0, 0)], [(2, 0), (1, 1), (0, 0)]
AROUND = [(2, 0), (1, 1), (0, 1), (0, 0)]


def mission(path, rate=0.5, n_bounds=None, status="ok"):
    n = n_bounds or len(path) - 1
    return Mission.from_arrays(path, np.full((n, 1, 2), 0.5), np.full((n, 1), rate), status=status)


@pytest.fixture(scope="module")
def workspace():
    return random_cells()


def run(workspace, **options):
    options = {"n_iterations": 2, "sampler": "exact", "progress": False} | options
    return tb.iterate(workspace, *ENDS, **options)


@pytest.fixture(scope="module")
def recorded(workspace):
    return run(workspace, simulator=ModelSimulator(workspace))


def assert_same_result(again, recorded):
    assert again.path == recorded.path
    for a, b in zip(again.posteriors, recorded.posteriors, strict=True):
        xr.testing.assert_equal(a, b)


def test_a_path_is_replayed_in_the_order_it_was_recorded():
    replay = ReplaySimulator([mission(LEFT, 0.1), mission(MIDDLE, 0.2), mission(LEFT, 0.3)])
    assert [m.contact_rate[0, 0] for m in replay.remaining] == [0.1, 0.2, 0.3]
    rates = [replay.run(path, seed=0).contact_rate[0, 0] for path in (LEFT, LEFT, MIDDLE)]
    assert rates == [0.1, 0.3, 0.2]
    assert replay.remaining == ()
    replay.rewind()
    assert replay.run(np.array(LEFT), seed=1).contact_rate[0, 0] == 0.1


def test_a_path_that_was_never_recorded_is_refused_with_the_nearest():
    replay = ReplaySimulator([mission(LEFT), mission(MIDDLE), mission(AROUND)])
    message = (
        r"path 2,0 1,1 1,2 0,0 was never recorded\. Nearest of 3 left: "
        r"mission 2, 2 of 3 bounds agree: 2,0 1,1 0,1 0,0; mission 1, 1 of 3"
    )
    with pytest.raises(TrustboError, match=message):
        replay.run([(2, 0), (1, 1), (1, 2), (0, 0)], seed=0)
    replay.run(LEFT, seed=0)
    with pytest.raises(TrustboError, match=r"was recorded, but as mission 0, replayed by now"):
        replay.run(LEFT, seed=0)
    for path in (MIDDLE, AROUND):
        replay.run(path, seed=0)
    with pytest.raises(TrustboError, match=r"all 3 missions are replayed; rewind\(\) starts over"):
        replay.run(LEFT[:2], seed=0)


def test_or_all_are_replayed_in_their_order_whatever_the_path():
    missions = [mission(LEFT), mission(MIDDLE), mission(AROUND)]
    replay = ReplaySimulator(missions, on_missing="next")
    assert [replay.run(AROUND, seed=0) for _ in range(3)] == missions
    with pytest.raises(TrustboError, match="all 3 missions are replayed"):
        replay.run(AROUND, seed=0)


def test_a_campaign_learns_from_a_log_whatever_it_would_have_run(workspace, recorded):
    replay = ReplaySimulator(recorded.missions, on_missing="next")
    result = run(workspace, simulator=replay, seed=7, policy="random")
    assert [m.path for m in result.missions] != [
        tuple((int(r), int(c)) for r, c in path if r >= 0) for path in result.history["path"].values
    ]
    # The same missions, so the same posterior but for the sampler's seed.
    ours, theirs = (r.posterior["posterior"]["beta0"] for r in (result, recorded))
    assert abs(float(ours.mean() - theirs.mean())) < 0.1 * float(theirs.std())
    assert result.settings["on_missing"] == "next"
    assert result.settings["recorded_missions"] == 2


def test_a_replayed_table_gives_the_posterior_of_the_run_that_wrote_it(
    workspace, recorded, tmp_path
):
    """Exactly: text keeps every bit, and plans, hence paths, follow from the posteriors."""
    to_frame(recorded.missions).to_csv(tmp_path / "missions.csv", index=False)
    replay = ReplaySimulator.from_table(tmp_path / "missions.csv")
    assert_same_result(run(workspace, simulator=replay), recorded)


def test_a_replayed_result_gives_its_posterior_again(workspace, recorded, tmp_path):
    recorded.save(tmp_path)
    for path in (tmp_path, tmp_path / "missions.nc"):
        replay = ReplaySimulator.from_netcdf(path)
        assert_same_result(run(workspace, simulator=replay), recorded)


@pytest.mark.parametrize("with_states", [False, True])
def test_a_saved_mission_comes_back_with_its_ticks(with_states, tmp_path):
    terrain = hillside()
    workspace = tb.Workspace.from_terrain(terrain, (3, 3))
    simulator = tb.simulation.KinematicSimulator(workspace, record_states=with_states)
    result = tb.iterate(
        workspace,
        (2, 0),
        (0, 2),
        simulator=simulator,
        n_iterations=1,
        sampler="exact",
        progress=False,
    )
    result.save(tmp_path)
    back = ReplaySimulator.from_netcdf(tmp_path).missions[0]
    for a, b in zip(back.bounds, result.missions[0].bounds, strict=True):
        assert (a.cell, a.t0, a.status) == (b.cell, b.t0, b.status)
        for name in ("poses", "contact", "awareness", "contact_rate", "duration", "n_ticks"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        np.testing.assert_array_equal(a.states, b.states)
        assert (a.states is not None) == with_states


def test_bad_input_is_named(tmp_path):
    for nothing in ([], mission(LEFT)):
        with pytest.raises(TrustboError, match="give a list of at least one mission"):
            ReplaySimulator(nothing)
    with pytest.raises(TrustboError, match="mission 0 must be a Mission; got 'log'"):
        ReplaySimulator(["log"])
    with pytest.raises(TrustboError, match="unknown on_missing 'skip'; choose one of error, next"):
        ReplaySimulator([mission(LEFT)], on_missing="skip")
    with pytest.raises(TrustboError, match=r"path\[0\] must be two whole numbers"):
        ReplaySimulator([mission(LEFT)]).run([(0.5, 1)], seed=0)
    with pytest.raises(TrustboError, match=r"missions\.nc' is missing"):
        ReplaySimulator.from_netcdf(tmp_path)
    xr.Dataset({"a": 1}).to_netcdf(tmp_path / "other.nc")
    (tmp_path / "text.nc").write_text("text")
    for name, said in (("other.nc", "holds no missions"), ("text.nc", "is damaged, or no netCDF")):
        with pytest.raises(TrustboError, match=f"{name}' {said}"):
            ReplaySimulator.from_netcdf(tmp_path / name)
