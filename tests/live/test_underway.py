"""The mission that runs, as a fold of events."""

import numpy as np
import pytest

from trustbo.errors import TrustboError
from trustbo.live.underway import Underway, ticks_event

PATH = ((3, 0), (2, 0), (1, 1), (0, 2))
ROBOTS, FEATURES = ("r1", "r2"), ("a", "b")


def folded(*events, path=PATH):
    mission = Underway((4, 4), 2, path, path[-1])
    for event in events:
        mission = mission.after(event)
    return mission


def begin(k, cell, t=0.0):
    return {"event": "begin", "bound": k, "cell": list(cell), "t": t}


def tick(signs, t=None):
    return {"event": "ticks", "c": signs, "t": t}


def end(status="ok", t=None):
    return {"event": "end", "status": status, "t": t}


def test_ticks_are_counts_of_the_bound_that_runs():
    mission = folded(
        begin(1, (2, 0), 5.0), tick("1-", 6.0), tick("01", 7.0),
        {"event": "ticks", "contact": [3, 0], "n": [10, 5], "t": 8.0}, end(),
        begin(2, (1, 1), 9.0), tick("11", 9.5), end("stuck", 12.0),
    )  # fmt: skip
    told = mission.to_mission(FEATURES, ROBOTS)
    assert mission.status == told.status == "stuck"
    np.testing.assert_array_equal(told.n_ticks, [[12, 6], [1, 1]])
    np.testing.assert_allclose(told.contact_rate, [[4 / 12, 1 / 6], [1.0, 1.0]])
    np.testing.assert_array_equal(told.duration, [[3.0, 3.0], [3.0, 3.0]])
    assert [bound.t0 for bound in told.bounds] == [0.0, 4.0]
    assert told.path == PATH


def test_the_mission_is_over_at_the_end_of_its_path():
    events = [event for k in (1, 2, 3) for event in (begin(k, PATH[k]), tick("11"), end())]
    mission = folded(*events)
    assert mission.status == "ok"
    assert mission.to_mission(FEATURES, ROBOTS).status == "ok"
    with pytest.raises(TrustboError, match="the mission is over: ok"):
        mission.after(begin(4, (0, 1)))


def test_a_bound_to_another_cell_leaves_no_plan_until_there_is_a_route():
    mission = folded(begin(1, (2, 1)), end())
    assert not mission.planned
    assert mission.path == ((3, 0), (2, 1))
    routed = mission.after({"event": "route", "path": [[2, 1], [1, 2], [0, 2]]})
    assert routed.planned
    assert routed.path == ((3, 0), (2, 1), (1, 2), (0, 2))
    without = folded(
        begin(1, (2, 1)), end(), begin(2, (1, 1)), end(), begin(3, (0, 2)), end(), path=PATH
    )
    assert without.status == "ok"  # at the goal, with no plan that led there
    assert without.path == ((3, 0), (2, 1), (1, 1), (0, 2))


def test_before_it_begins_a_mission_may_get_another_path():
    mission = folded({"event": "route", "path": [[0, 0], [0, 1]]}, begin(1, (0, 1)), end())
    assert mission.status == "ok"
    assert mission.path == ((0, 0), (0, 1))


def test_a_failure_between_two_bounds_is_of_the_next_bound():
    told = folded(begin(1, (2, 0)), tick("11"), end(), end("tipped")).to_mission(FEATURES, ROBOTS)
    assert [bound.status for bound in told.bounds] == ["ok", "tipped"]
    assert told.bounds[1].cell == (1, 1)
    assert np.isnan(told.contact_rate[1]).all()
    aborted = folded(begin(1, (2, 0)), tick("11"), end(), end("aborted"))
    told = aborted.to_mission(FEATURES, ROBOTS)
    assert (told.status, len(told.bounds), told.bounds[0].status) == ("aborted", 1, "ok")
    assert folded(end("aborted")).to_mission(FEATURES, ROBOTS) is None


def test_awareness_of_the_last_bound_counts_until_the_next_begins():
    first = {"event": "awareness", "values": [[0.1, None], [None, None]]}
    second = {"event": "awareness", "values": [[0.2, None], [None, 0.4]]}
    mission = folded(begin(1, (2, 0)), first, end(), second)
    np.testing.assert_array_equal(mission.bounds[0].awareness, [[0.2, np.nan], [np.nan, 0.4]])


@pytest.mark.parametrize(
    ("events", "reason"),
    [
        ([begin(2, (1, 1))], "bound 2 cannot begin: bound 1 is next"),
        ([begin(1, (2, 0)), begin(1, (2, 0))], "bound 1 runs"),
        ([begin(1, (0, 0))], r"no bound leads from \(3, 0\) to \(0, 0\)"),
        ([begin(1, (4, 0))], "outside the grid of 4 rows"),
        ([tick("11")], "no bound runs: ticks belong to none"),
        ([begin(1, (2, 0)), tick("111")], "ticks of 3 robots; there are 2"),
        ([end()], "no bound runs: begin bound 1 first"),
        ([begin(1, (2, 0)), {"event": "route", "path": [[2, 0], [1, 1]]}], "bound 1 runs"),
        ([begin(1, (2, 0)), end(), {"event": "route", "path": [[1, 1], [0, 2]]}], "the team is at"),
        ([{"event": "route", "path": [[3, 0]]}], "a path is of two cells or more"),
        ([{"event": "awareness", "values": [[0.0, 0.0]]}], "no bound has begun"),
        ([{"event": "party"}], "unknown event 'party'"),
    ],
)
def test_an_event_that_cannot_follow_is_refused(events, reason):
    mission = folded(*events[:-1])
    with pytest.raises(TrustboError, match=reason):
        mission.after(events[-1])


@pytest.mark.parametrize("n_ticks", [[1, 0, 1], [4, 0, 9]])
def test_an_event_of_ticks_holds_their_counts(n_ticks):
    contacts, ticks = np.array([1, 0, 0]), np.array(n_ticks)
    mission = Underway((4, 4), 3, PATH, PATH[-1]).after(begin(1, (2, 0)))
    running = mission.after(ticks_event(contacts, ticks, 1.0)).running
    np.testing.assert_array_equal(running.n_contact, contacts)
    np.testing.assert_array_equal(running.n_ticks, ticks)


def report(values, person="operator"):
    return {"event": "report", "values": values, "person": person}


def test_reports_are_before_the_mission_or_after_the_bound_that_runs_or_ran():
    mission = folded(
        report([0.5, None]), report([None, 0.4]), begin(1, PATH[1]), report([0.6, None]), end(),
        report([0.7, None]), begin(2, PATH[2]), end("stuck"),
    )  # fmt: skip
    told = mission.to_mission(FEATURES, ROBOTS)
    nan = np.nan
    np.testing.assert_array_equal(told.reports.values, [[0.5, 0.4], [0.7, nan], [nan, nan]])
    assert folded(begin(1, PATH[1]), end("stuck")).to_mission(FEATURES, ROBOTS).reports is None
    with pytest.raises(TrustboError, match="operator reports in this mission; ann may in the next"):
        folded(report([0.5, None]), report([0.5, None], "ann"))
    assert folded(report([0.5, None], "ann")).person == "ann"
