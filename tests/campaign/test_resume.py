"""A campaign on disk: nothing is lost, nobody else interferes, and what was begun goes on."""

import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from worlds import ModelSimulator, begin, moments_of, random_cells, resume_or_begin

import trustbo as tb
from trustbo.models import PooledTrust, Priors

ENDS = ((3, 0), (0, 3))


@pytest.fixture
def workspace():
    return random_cells()


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """Result of a campaign of n missions, and a function that copies its folder; run once."""
    kept = {}

    def begun(n):
        if n not in kept:
            folder = tmp_path_factory.mktemp("begun") / "campaign"
            kept[n] = begin(random_cells(), folder, n), partial(shutil.copytree, folder)
        return kept[n]

    return begun


def same(a, b):
    """Posteriors, paths and history, but for the seconds."""
    assert len(a.missions) == len(b.missions)
    for one, other in zip(a.posteriors, b.posteriors, strict=True):
        for name in one["posterior"].data_vars:
            np.testing.assert_array_equal(
                one["posterior"][name].values, other["posterior"][name].values
            )
    for group in ("log_likelihood", "latent"):
        for name, array in a.posterior[group].to_dataset().items():
            np.testing.assert_array_equal(array.values, b.posterior[group][name].values)
    assert a.path == b.path
    assert a.value == b.value
    np.testing.assert_array_equal(a.trust_map.values, b.trust_map.values)
    assert set(a.history.data_vars) == set(b.history.data_vars)
    for name in a.history.data_vars:
        if not name.startswith("seconds"):
            np.testing.assert_array_equal(a.history[name].values, b.history[name].values)
    for one, other in zip(a.missions, b.missions, strict=True):
        np.testing.assert_array_equal(one.awareness, other.awareness)
        np.testing.assert_array_equal(one.contact_rate, other.contact_rate)


@pytest.mark.parametrize("every", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_whichever_write_it_dies_at_it_comes_to_the_same(workspace, tmp_path, monkeypatch, every):
    """Every state of the folder that a kill can leave, or the last before each file changes."""
    copies = [tmp_path / "moment0"]
    with monkeypatch.context() as patch:
        names = moments_of(tmp_path / "whole", copies, patch)
        whole = begin(workspace, tmp_path / "whole", 2)
    copies[0].mkdir()  # and when nothing is there yet
    assert len(copies) == len(names) > 20
    # Of the first and the second mission alike: a file is one whatever its number.
    kinds = [name and (re.sub(r"\d+", "N", name[0]), name[1]) for name in names]
    last = list(dict(zip(kinds, copies, strict=True)).values())
    assert len(last) > 8, last
    for folder in copies if every else last:
        resume_or_begin(workspace, folder, 2)
        same(tb.load_result(folder), whole)


PROGRAM = """
import sys
sys.path.insert(0, {tests!r})
from worlds import random_cells, resume_or_begin
resume_or_begin(random_cells(), {folder!r}, 8)
"""


@pytest.mark.slow  # processes start for long; in one, it dies at every write
def test_killed_twice_it_comes_to_the_same(workspace, tmp_path):
    whole = begin(workspace, tmp_path / "whole", 8)
    assert {"places", "hazard"} <= set(whole.posterior.children)  # effects and failures, too
    folder, tests = tmp_path / "killed", Path(__file__).parents[1]
    program = PROGRAM.format(tests=str(tests), folder=str(folder))
    command = [sys.executable, "-W", "ignore", "-c", program]
    for seed in (1, 2):
        # Sets of names are in another order in each process, and in this one.
        process = subprocess.Popen(command, env=os.environ | {"PYTHONHASHSEED": str(seed)})
        _wait_for_work(process, folder)
        time.sleep(random.Random(seed).uniform(0.0, 0.25))
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    resume_or_begin(workspace, folder, 8)
    same(tb.load_result(folder), whole)


def _wait_for_work(process, folder):
    """Until it has written: a process that still imports has nothing to lose."""

    def stamp():
        files = [folder / "measured.nc", folder / "campaign.json"]
        return [f.stat().st_mtime_ns if f.exists() else 0 for f in files]

    before = stamp()
    while stamp() == before and process.poll() is None:
        time.sleep(0.005)


def test_a_mission_told_but_not_learned_from_is_not_lost(workspace, begun, tmp_path, monkeypatch):
    simulator = ModelSimulator(workspace, blind=True)
    whole, _ = begun(2)
    campaign = tb.Campaign(
        workspace, *ENDS, sampler="exact", policy="thompson",
        directory=tmp_path / "half",
    )  # fmt: skip
    campaign.tell(simulator.run(campaign.ask().path, seed=campaign.seed_of("mission")))
    mission = simulator.run(campaign.ask().path, seed=campaign.seed_of("mission"))

    def die(*args, **kwargs):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("trustbo.campaign.learning.fit", die)
        with pytest.raises(KeyboardInterrupt):
            campaign.tell(mission)
    with campaign:
        pass
    again = tb.Campaign.load(tmp_path / "half")
    assert len(again.missions) == 2
    assert again.state.numbers("told") == []
    np.testing.assert_array_equal(
        again.posterior["posterior"]["beta"].values, whole.posterior["posterior"]["beta"].values
    )


def test_a_folder_is_for_one_campaign_at_a_time(workspace, tmp_path):
    with tb.Campaign(workspace, *ENDS, directory=tmp_path):
        with pytest.raises(tb.TrustboError, match="another campaign is at work in"):
            tb.Campaign.load(tmp_path)
    with pytest.raises(tb.TrustboError, match="holds a campaign already: go on with it by"):
        tb.Campaign(workspace, *ENDS, directory=tmp_path)
    with tb.Campaign.load(tmp_path):
        pass
    with pytest.raises(tb.TrustboError, match="holds no campaign"):
        tb.Campaign.load(tmp_path / "nothing")
    assert not (tmp_path / "nothing").exists()


@pytest.mark.slow  # a process starts for long
def test_another_process_is_kept_out_of_a_folder_too(workspace, tmp_path):
    with tb.Campaign(workspace, *ENDS, directory=tmp_path):
        code = f"import trustbo; trustbo.Campaign.load({str(tmp_path)!r})"
        other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert "another campaign is at work in" in other.stderr


def test_saving_is_a_copy_and_loading_goes_on(workspace, tmp_path):
    simulator = ModelSimulator(workspace)
    campaign = tb.Campaign(workspace, *ENDS, sampler="exact", policy="random", seed=3)
    campaign.tell(simulator.run(campaign.ask().path, seed=0))
    campaign.fail("rain")
    operator = campaign.suggest([(3, 0), (2, 1), (1, 2), (0, 3)])
    assert campaign.ask().path == operator.path
    campaign.save(tmp_path)
    with tb.Campaign.load(tmp_path) as again:
        again.save(tmp_path)  # into the folder it is kept in
        assert again.ask().path == operator.path
        assert [f[:2] for f in again.state.failures] == [(1, "rain")]
        assert again.settings == campaign.settings
        assert (
            again.table()
            .drop(columns=[c for c in again.table() if "seconds" in c])
            .equals(campaign.table().drop(columns=[c for c in campaign.table() if "seconds" in c]))
        )
        for each in (campaign, again):
            each.tell(simulator.run(operator.path, seed=1))
            each.ask()
    same(campaign.result(), again.result())
    assert campaign.ask().path == again.ask().path


def test_what_is_your_own_is_asked_for_again(workspace, tmp_path):
    def straight(key, draws, planner):
        return planner.evaluate([(3, 0), (2, 1), (1, 2), (0, 3)], draws.mean())

    model = PooledTrust(priors=Priors(x0_mean=0.4))
    with tb.Campaign(workspace, *ENDS, model=model, policy=straight, directory=tmp_path):
        pass
    with pytest.raises(tb.TrustboError, match=r"policy was your own .'straight'.; give it again"):
        tb.Campaign.load(tmp_path, model=model)
    with pytest.raises(tb.TrustboError, match="has priors of its own, or is your own; give it"):
        tb.Campaign.load(tmp_path, policy=straight)
    with pytest.raises(tb.TrustboError, match=r"the campaign's model is .* the one given is"):
        tb.Campaign.load(tmp_path, policy=straight, model=PooledTrust())
    with tb.Campaign.load(tmp_path, policy=straight, model=model) as again:
        assert again.ask().path == ((3, 0), (2, 1), (1, 2), (0, 3))


def test_resuming_with_another_simulator_is_refused(workspace, begun, tmp_path):
    class Other(ModelSimulator):
        pass

    _, copy_to = begun(2)
    folder = copy_to(tmp_path / "short")
    with pytest.raises(tb.TrustboError, match="begun with simulator = 'ModelSimulator', not 'Ot"):
        tb.resume(folder, simulator=Other(workspace), progress=False)


def test_a_finished_campaign_goes_on_if_asked_to(workspace, begun, tmp_path):
    (_, copy_to), (long, _) = begun(2), begun(3)
    simulator = ModelSimulator(workspace, blind=True)
    folder = copy_to(tmp_path / "short")
    same(tb.resume(folder, simulator=simulator, n_iterations=3, progress=False), long)


def test_nothing_half_written_is_read(workspace, begun, tmp_path):
    """Whatever of the last mission's files is there already, the state decides."""
    whole, copy_to = begun(3)
    copy_to(tmp_path, dirs_exist_ok=True)
    state = json.loads((tmp_path / "campaign.json").read_text())
    state["n_missions"] = 2
    for name in ("plans", "rows", "posteriors"):
        state[name] = state[name][:2]
    (tmp_path / "campaign.json").write_text(json.dumps(state))
    simulator = ModelSimulator(workspace, blind=True)
    again = tb.resume(tmp_path, simulator=simulator, n_iterations=3, progress=False)
    same(again, whole)


def test_failing_keeps_the_bounds_there_are(workspace):
    campaign = tb.Campaign(workspace, *ENDS, sampler="exact", policy="random")
    first = campaign.ask()
    assert campaign.fail("the lead lost its map") is None
    assert campaign.missions == []
    paths = {first.path}
    for _ in range(6):
        paths.add(campaign.ask().path)
        campaign.fail("again")
    assert len(paths) > 1  # another try may be another path
    part = ModelSimulator(workspace, fail_at=2).run(campaign.ask().path, seed=0)
    posterior = campaign.fail("tipped", replace(part))
    np.testing.assert_array_equal(posterior["posterior"]["b"], campaign.posterior["posterior"]["b"])
    assert len(campaign.missions[0].bounds) == 2
    assert campaign.state.failures[-1] == (1, "tipped", (), None, True)


def test_options_are_checked_recorded_and_given_as_one_object(workspace, tmp_path):
    with pytest.raises(tb.TrustboError, match="unknown option 'conectivity'; did you mean conn"):
        tb.iterate(workspace, *ENDS, conectivity=4)
    with pytest.raises(tb.TrustboError, match="unknown option 'polcy'; did you mean policy"):
        tb.Campaign(workspace, *ENDS, polcy="random")
    options = tb.CampaignOptions(team="min", initial="prior_draw", connectivity=4)
    with pytest.raises(tb.TrustboError, match=r"or options one by one; got options=.* and draws"):
        tb.Campaign(workspace, *ENDS, options=options, draws=500)
    with pytest.raises(tb.TrustboError, match="callbacks must be callables; got 3"):
        tb.CampaignOptions(callbacks=[3])
    with tb.Campaign(workspace, *ENDS, sampler="exact", options=options, directory=tmp_path):
        pass
    with pytest.raises(tb.TrustboError, match="unknown option of one's own 'team'"):
        tb.Campaign.load(tmp_path, team="mean")
    with tb.Campaign.load(tmp_path, callbacks=[print]) as again:
        assert again.options == replace(options, callbacks=(print,))
        assert again.planner.team == again.settings["team"] == "min"
