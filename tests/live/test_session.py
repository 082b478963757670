"""A live campaign: what it tells the campaign, what it shows, and that it goes on after a kill."""

import json
import shutil

import numpy as np
import pytest

import trustbo as tb
from trustbo.errors import DamagedFileError, TrustboError
from trustbo.inference import TrustFilter
from trustbo.live import Live
from trustbo.live.session import FOLDER

RNG_SEED = 3


def ticks_of(n, seed=RNG_SEED):
    """Contacts of n bounds of 20 ticks with three robots, one of which sometimes did not look."""
    rng = np.random.default_rng(seed)
    contact = (rng.uniform(size=(n, 20, 3)) < 0.8).astype(float)
    contact[:, ::5, 2] = np.nan
    return contact


def lines_of(path, contact, *, end="ok"):
    """Lines of a mission that goes along a path; times are 0.1 s apart."""
    t = 0.0
    for k, ticks in enumerate(contact, start=1):
        yield {"bound": k, "cell": list(path[k]), "t": t}
        for tick in ticks:
            t = round(t + 0.1, 3)
            yield {"contact": [None if np.isnan(v) else int(v) for v in tick], "t": t}
        yield {"status": end if k == len(contact) else "ok", "t": t}


def tell(live, lines):
    for line in lines:
        live.tell(json.dumps(line))


def telling(live, path=None):
    """Tell it a whole mission, along the path that is planned as it goes."""
    number = live.number
    contact = ticks_of(40)
    while live.number == number:
        k = live.mission.k
        live.tell(json.dumps({"bound": k, "t": 3.0 * k}))
        for i, tick in enumerate(contact[k]):
            values = [None if np.isnan(v) else int(v) for v in tick]
            live.tell(json.dumps({"contact": values, "t": 3.0 * k + 0.1 * i}))
        live.tell(json.dumps({"status": "ok", "t": 3.0 * k + 2.0}))


def comparable(state):
    """State without what a fresh process counts anew."""
    return {k: v for k, v in state.items() if k not in ("version", "log", "idle", "poses")}


def test_a_mission_is_told_as_it_was_measured(folder):
    with Live(folder, replan=False) as live:
        path = live.mission.path
        contact = ticks_of(len(path) - 1)
        tell(live, lines_of(path, contact))
        assert live.number == 3
        told = live.campaign.state.measured[-1]
    np.testing.assert_array_equal(told.n_ticks, (~np.isnan(contact)).sum(1))
    np.testing.assert_allclose(told.contact_rate, np.nanmean(contact, axis=1), rtol=1e-12)
    np.testing.assert_allclose(told.duration, 2.0, rtol=1e-9)
    assert (told.path, told.status) == (path, "ok")
    loaded = tb.Campaign.load(folder)
    with loaded:
        assert len(loaded.missions) == 2
        assert loaded.state.entries[1].row["state"] == "learned"


def test_trust_is_that_of_a_filter_that_took_whole_bounds(folder):
    with tb.Campaign.load(folder) as campaign:
        path = campaign.ask().path
        known = campaign.known_along(path)
        by_bound = TrustFilter(
            tb.inference.params_of(campaign.state.last_tree, day=True), 3,
            observation=campaign.learner.observation,
        )  # fmt: skip
        contact = ticks_of(3)
        for k in range(2):
            now = by_bound.update(
                known[k], np.nanmean(contact[k], 0), path[k : k + 2], n_ticks=[20, 20, 16]
            )
        ahead = by_bound.predict(known[2:], path[2:])
    with Live(folder, replan=False) as live:
        tell(live, lines_of(path, contact[:2]))
        state = live.state()
    assert state["phase"] == "ready"
    assert state["entered"] == 2
    shown = np.array(state["trust"][-1])
    np.testing.assert_allclose(shown[:, 0], now.mean, atol=6e-5)  # of four digits
    np.testing.assert_allclose(shown[:, 2] - shown[:, 1], 2 * 1.6449 * now.sd, atol=2e-4)
    np.testing.assert_allclose(np.array(state["ahead"])[:, :, 0], ahead.mean, atol=6e-5)
    assert [robot["expected"] for robot in state["robots"]] == pytest.approx(
        ahead.rate[0], abs=6e-5
    )


def test_killed_after_a_message_of_each_kind_it_goes_on_with_the_same_state(folder, tmp_path):
    """A copy of the folder is what a kill leaves: nothing waits in the process to be written."""
    copies = []
    with Live(folder) as live:
        path = live.mission.path
        lines = list(lines_of(path, ticks_of(2)[:, :4], end="ok"))
        lines[4:4] = [{"awareness": {"r1": [0.5, 0.25]}}]
        for n, line in enumerate(lines):
            live.tell(json.dumps(line))
            if n not in (0, 3, 4, 6, len(lines) - 1):
                continue
            copy = tmp_path / f"killed{n}"
            shutil.copytree(folder, copy, ignore=shutil.ignore_patterns(".trustbo.lock"))
            copies.append((copy, comparable(live.state())))
        assert live.mission.k == 3
    for copy, state in copies:
        with Live(copy) as again:
            again.settle()
            assert comparable(again.state()) == state


@pytest.mark.parametrize("moment", ["ended", "measured"])
def test_killed_while_it_learned_it_learns_the_mission_once(folder, tmp_path, moment):
    with Live(folder, replan=False) as live:
        lines = list(lines_of(live.mission.path, ticks_of(len(live.mission.path) - 1)))
        tell(live, lines[:-1])
        assert live.take(live.reader.read(json.dumps(lines[-1])))
        assert live.state()["phase"] == "learning"
        shutil.copytree(folder, tmp_path / "ended")
        live.settle()
        whole = live.campaign.state.measured[-1], live.state()
        if moment == "measured":  # it was recorded, and its journal is still there
            shutil.copytree(folder, tmp_path / "measured")
    with Live(tmp_path / moment) as again:
        again.settle()
        assert again.number == 3
        assert len(again.campaign.missions) == 2
        np.testing.assert_array_equal(
            again.campaign.state.measured[-1].contact_rate, whole[0].contact_rate
        )
        assert comparable(again.state()) == comparable(whole[1])


def test_the_rest_is_planned_anew_after_each_bound_and_kept_if_asked_for(folder):
    with Live(folder) as live:
        first = live.mission.path
        telling(live)
        mission = live.campaign.state.measured[-1]
        assert mission.status == "ok"
        assert mission.path[-1] == first[-1]
        assert live.campaign.state.entries[-1].plan.path == first
    kept = (folder / FOLDER / "0002.jsonl").read_text()
    events = [json.loads(line) for line in kept.splitlines()]
    ends = [e for e in events if e["event"] == "end"]
    assert len(ends) == len(mission.bounds)


def test_robots_that_went_elsewhere_are_planned_for_from_there(folder):
    with Live(folder) as live:
        start, planned = live.mission.path[:2]
        others = [(start[0] + i, start[1] + j) for i in (-1, 0) for j in (0, 1)]
        other = next(c for c in others if c not in (start, planned))
        tell(live, [{"bound": 1, "cell": other}, {"contact": [1, 1, 1]}, {"status": "ok"}])
        assert live.mission.path[:2] == (start, other)
        assert live.mission.planned
        assert live.mission.path[-1] == (0, 3)
        telling(live)
        assert live.campaign.state.measured[-1].path[1] == other


def test_a_mission_that_failed_is_told_with_its_reason(folder):
    with Live(folder) as live:
        path = live.mission.path
        tell(live, list(lines_of(path, ticks_of(2), end="stuck")))
        told = live.campaign.state.measured[-1]
        assert (told.status, len(told.bounds), told.bounds[1].status) == ("stuck", 2, "stuck")
        assert live.number == 3
        # Nothing was measured: given up, with the cell that it failed to enter.
        path = live.mission.path
        tell(live, [{"bound": 1}, {"status": "tipped"}])
        failure = live.campaign.state.failures[-1]
        assert (failure.reason, failure.where, failure.reported) == ("tipped", path[1], False)
        live.tell('{"status": "aborted", "mission": 4, "note": "rain"}')
        assert live.number == 5
        assert len(live.campaign.missions) == 2
        assert [f.reason for f in live.campaign.state.failures] == ["tipped", "aborted"]
    with Live(folder) as again:
        assert again.number == 5


def test_ticks_between_bounds_count_for_none(folder):
    with Live(folder) as live:
        tell(live, [{"contact": [1, 1, 1]}, {"bound": 1}])
        assert live.mission.running.n_ticks.tolist() == [0, 0, 0]
        tell(live, [{"contact": [0, 1, None]}, {"status": "ok"}, {"contact": [1, 1, 1]}])
        assert live.n_idle == 1
        assert live.mission.bounds[0].n_ticks.tolist() == [1, 1, 0]


def test_a_marker_ends_the_bound_before_and_a_new_mission_the_one_before(folder):
    with Live(folder, replan=False) as live:
        path = live.mission.path
        tell(live, [{"bound": 0, "cell": list(path[0])}, {"bound": 1, "t": 1.0}])
        tell(live, [{"contact": [1, 1, 0], "t": 3.0}, {"bound": 2, "t": 4.0}])
        assert live.mission.bounds[0].status == "ok"
        assert live.mission.bounds[0].last == 3.0
        tell(live, [{"contact": [1, 0, 0], "t": 5.0}, {"bound": 0, "t": 6.0}])
        assert live.number == 3
        assert live.campaign.state.measured[-1].status == "aborted"
        assert len(live.campaign.state.measured[-1].bounds) == 2


READY = [
    ({"status": "ok"}, "no bound runs: begin bound 1"),
    ({"bound": 3}, "bound 3 cannot begin: bound 1 is next"),
    ({"status": "stuck"}, 'no bound of mission 2 has begun.*"mission": 2'),
    ({"status": "stuck", "mission": 1}, "mission 2 runs, not 1"),
    ({"bound": 0, "cell": [0, 0]}, r"the mission starts at \(3, 0\), not at \(0, 0\)"),
    ({"bound": 1, "cell": [0, 0]}, "no bound leads from"),
    ({"awareness": [[0, 0]] * 3}, "no bound has begun"),
]
RUNNING = [
    ({"bound": 3}, "bound 3 cannot begin: bound 1 runs"),
    ({"bound": 1}, "bound 1 cannot begin: bound 1 runs"),
    ({"bound": 2, "cell": [0, 3]}, "no bound leads from"),
]


def test_a_message_that_cannot_be_is_refused_and_changes_nothing(folder):
    with Live(folder) as live:
        for refused in (READY, RUNNING):
            before, kept = comparable(live.state()), live.journal.path.read_bytes()
            for line, reason in refused:
                with pytest.raises(TrustboError, match=reason):
                    live.tell(json.dumps(line))
            assert comparable(live.state()) == before
            assert live.journal.path.read_bytes() == kept
            if refused is READY:
                live.tell('{"bound": 1}')


def test_a_mission_that_the_campaign_refuses_is_kept_aside_and_another_begins(folder):
    with Live(folder, replan=False) as live:
        path = live.mission.path
        lines = list(lines_of(path, ticks_of(len(path) - 1)))
        tell(live, lines)
        tell(live, [{"bound": 0, "cell": list(path[0]), "path": [list(c) for c in path]}])
        tell(live, lines)  # the same again, number by number
        assert live.number == 3
        assert "mission 3 is not recorded: this mission was told already" in live.log[-1][1]
        assert len(live.campaign.missions) == 2
        assert len(list(live.journal.path.parent.glob("0003.refused-*.jsonl"))) == 1
        assert live.state()["phase"] == "ready"


@pytest.mark.slow  # several fits
def test_contact_far_below_what_was_expected_is_an_alarm(tmp_path):
    """Two bounds as expected, then one robot sees nothing, and the others what was expected."""
    workspace = tb.Workspace.from_awareness(np.random.default_rng(0).uniform(size=(3, 4, 4, 2)))
    truth = tb.models.TrustParams(0.6, np.array([0.2, 0.1]), 0.15, 0.02, 0.02)
    campaign = tb.Campaign(workspace, (3, 0), (0, 3), sampler="exact", directory=tmp_path / "c")
    for _ in campaign.run(tb.simulation.ModelSimulator(workspace, truth), 4):
        pass
    with Live(campaign) as live:
        for k, factors in ((1, (1, 1, 1)), (2, (1, 1, 1)), (3, (1, 1, 0))):
            expected = [robot["expected"] for robot in live.state()["robots"]]
            counts = np.rint(np.multiply(expected, factors) * 100).astype(int).tolist()
            tell(live, [{"bound": k}, {"contact": counts, "ticks": 100}])
            alarms = live.state()["alarms"]
            assert len(alarms) == (k == 3)
            if k < 3:
                live.tell('{"status": "ok"}')
        assert "bound 3, r3: contact 0.00, far below the" in alarms[0]


def test_maps_are_those_of_the_planner(folder):
    with Live(folder) as live:
        planner, mean = live.campaign.planner_now(), live.campaign.belief.mean()
        trust = planner.trust_map(mean, per_robot=True).values
        shown = live.map("trust", "r2")
        np.testing.assert_allclose(np.array(shown["values"], dtype=float), trust[1], atol=6e-5)
        cost = np.array(live.map("cost")["values"], dtype=float)
        np.testing.assert_allclose(cost, planner.cost_map(mean).values, atol=6e-5)
        with pytest.raises(TrustboError, match="unknown robot 'r9'"):
            live.map("trust", "r9")
        with pytest.raises(TrustboError, match="unknown layer 'x'"):
            live.map("x")


@pytest.mark.slow  # several fits
def test_before_the_first_mission_trust_is_that_of_the_prior(tmp_path):
    workspace = tb.Workspace.from_awareness(np.full((3, 3, 3, 2), 0.5))
    campaign = tb.Campaign(workspace, (2, 0), (0, 2), sampler="exact", directory=tmp_path / "c")
    with Live(campaign) as live:
        robot = live.state()["robots"][0]
        assert robot["low"] < robot["trust"] < robot["high"]
        telling(live)
        assert live.number == 2
        assert live.campaign.posterior is not None


def test_what_cannot_be_opened_is_named(folder, tmp_path):
    with pytest.raises(TrustboError, match="holds no campaign"):
        Live(tmp_path / "none")
    workspace = tb.Workspace.from_awareness(np.full((3, 3, 3, 2), 0.5))
    with pytest.raises(TrustboError, match="a live campaign writes to a folder"):
        Live(tb.Campaign(workspace, (2, 0), (0, 2), sampler="exact"))
    with Live(folder) as live, pytest.raises(TrustboError, match="another campaign is at work"):
        Live(folder)
    with live.journal.path.open("a") as journal:
        journal.write('{"event": "end", "status": "ok"}\n')
    with pytest.raises(
        DamagedFileError, match=r"line 2 cannot follow those before \(no bound runs"
    ):
        Live(folder)
    with tb.Campaign.load(folder) as campaign:  # it was not left locked
        assert len(campaign.missions) == 1


def test_reports_are_in_the_journal_then_in_the_mission_and_stay_after_a_kill(folder, tmp_path):
    with Live(folder) as live:
        live.tell('{"report": {"r1": 0.5}, "person": "ann"}')
        live.tell('{"bound": 1}')
        live.tell('{"report": {"r1": 0.75, "r3": 0.25}, "person": "ann"}')
        journal = (folder / FOLDER / "0002.jsonl").read_text().splitlines()
        assert json.loads(journal[-1]) == {
            "event": "report", "values": [0.75, None, 0.25], "person": "ann",
        }  # fmt: skip
        shutil.copytree(folder, tmp_path / "killed")
        assert live.state()["reports"] == [[0.5, None, None], [0.75, None, 0.25]]
        live.tell('{"contact": [1, 1, 1]}')
        live.tell('{"status": "stuck"}')
        told = live.campaign.state.measured[-1].reports
        assert (told.person, told.scale) == ("ann", "unit")
        np.testing.assert_array_equal(told.values[1], [0.75, np.nan, 0.25])
    with Live(tmp_path / "killed") as again:
        assert again.state()["reports"][1] == [0.75, None, 0.25]
