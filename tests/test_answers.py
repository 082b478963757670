"""Reports of trust in missions: shapes, scales, files, and refusals in a line."""

import numpy as np
import pytest

import trustbo as tb
from trustbo.answers import Reports
from trustbo.errors import TrustboError

PATH = [(0, 0), (0, 1), (1, 1)]
RATES = np.array([[0.5, 0.9], [0.2, 1.0]])


def mission(path=PATH):
    return tb.Mission.from_arrays(path, np.full((2, 2, 1), 0.5), RATES)


def test_answers_are_after_the_mission_after_bounds_or_before_too():
    after = mission().with_reports({"r2": 0.25}).reports
    np.testing.assert_array_equal(after.values, [[np.nan] * 2, [np.nan] * 2, [np.nan, 0.25]])
    by_bound = mission().with_reports([[7, 1], [4, np.nan]], scale="likert7", person="ann")
    np.testing.assert_allclose(by_bound.reports.values[1:], [[1.0, 0.0], [0.5, np.nan]])
    np.testing.assert_array_equal(by_bound.reports.answers[1:], [[7, 1], [4, np.nan]])
    whole = mission().with_reports([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])
    np.testing.assert_array_equal(whole.reports.values[0], [0.1, 0.2])
    turned = whole.in_order(("r2", "r1"), whole.features)
    np.testing.assert_array_equal(turned.reports.values[0], [0.2, 0.1])
    assert "by ann" in repr(by_bound)


@pytest.mark.parametrize(
    ("answers", "options", "message"),
    [
        ([0.5, 1.5], {}, r"report about r2 = 1\.5 is outside \[0, 1\]; give its scale"),
        ([50, 60], {}, "report about r1 = 50 is outside .*divide it by 100"),
        ([-0.1, 0.5], {}, r"report about r1 = -0\.1 is outside \[0, 1\]\.$"),
        ([0, 4], {"scale": "likert7"}, "report about r1 = 0 is no whole number from 1 to 7"),
        ([4.5, 4], {"scale": "likert7"}, r"report about r1 = 4\.5 is no whole number"),
        ([np.inf, 4], {"scale": "likert7"}, "report about r1 = inf is no whole number"),
        ([0.5, 0.5], {"scale": "stars"}, 'scale must be "unit", "likert7"'),
        ([0.5, 0.5], {"person": " "}, "person must be a name"),
        ([0.5, 0.5], {"person": 3}, "person must be a name; got 3"),
        ({"r3": 0.5}, {}, "unknown robot 'r3'"),
        ([0.5], {}, r"reports must be \(2,\), of each robot after the mission, .*got \(1,\)"),
        (["high", "low"], {}, "reports must be numbers"),
    ],
)  # fmt: skip
def test_a_bad_answer_is_refused_in_one_line(answers, options, message):
    with pytest.raises(TrustboError, match=message) as caught:
        mission().with_reports(answers, **options)
    assert "\n" not in str(caught.value)


def test_reports_made_by_hand_are_checked_too():
    with pytest.raises(TrustboError, match=r"report \[0, 0\] = 1\.6 is no whole number from 1"):
        Reports(np.array([[0.1]]), scale="likert7")
    with pytest.raises(TrustboError, match=r"reports must be \(3, 2\), \(1 \+ bound, robot\)"):
        tb.Mission(tuple(PATH), mission().bounds, reports=Reports(np.zeros((2, 2))))


@pytest.mark.parametrize("path", [PATH, None])
@pytest.mark.parametrize("scale", ["unit", "likert7"])
def test_reports_are_kept_in_netcdf_and_tables(path, scale, tmp_path):
    answers = [[1, 7], [np.nan, 3], [2, 6]]
    if scale == "unit":
        answers = np.array(answers) / 7.0
    told = [mission(path), mission(path).with_reports(answers, person="ann", scale=scale)]
    tb.logs.write_missions(tmp_path / "missions.nc", told)
    tb.logs.write_table(told, tmp_path / "missions.csv")
    for back in (
        tb.logs.read_missions(tmp_path / "missions.nc"),
        tb.logs.read_table(tmp_path / "missions.csv"),
    ):
        assert back[0].reports is None
        kept = back[1].reports
        assert (kept.person, kept.scale) == ("ann", scale)
        np.testing.assert_array_equal(kept.values, told[1].reports.values)
        np.testing.assert_array_equal(back[1].contact_rate, RATES)


def test_a_table_with_a_bad_report_is_refused():
    rows = {"mission": [1, 1], "bound": [1, 1], "robot": ["a", "b"], "contact_rate": [0.5, 0.6]}
    rows |= {"traversability": [0.5, 0.5], "report": [8, 1]}
    with pytest.raises(TrustboError, match=r"mission 1: report about a = 8 is outside \[0, 1\]"):
        tb.logs.read_table(rows)
    rows |= {"report_scale": ["likert7", "likert9"]}
    with pytest.raises(TrustboError, match="mission 1: rows disagree on report_scale"):
        tb.logs.read_table(rows)


def test_reports_of_missions_are_those_of_persons():
    told = [mission(), mission().with_reports([0.5, 0.6], person="ann"), mission()]
    told.append(mission().with_reports([0.1, 0.2], person="bob"))
    units = tb.logs.reports_of(told)
    assert list(units) == [("ann", "r1"), ("ann", "r2"), ("bob", "r1"), ("bob", "r2")]
    one = units["ann", "r2"]  # who saw three missions, with a step before each
    success = [0.0, 0.9, 1.0] * 3
    np.testing.assert_allclose(one.awareness[:, 0, 0], success)
    np.testing.assert_allclose(one.awareness[:, 0, 1], [0.0, 0.1, 0.0] * 3, atol=1e-12)
    assert np.flatnonzero(np.isfinite(one.contact_rate[:, 0])).tolist() == [5]
    with pytest.raises(TrustboError, match="no mission has reports of trust; give them by"):
        tb.logs.reports_of(told[:1])
    with pytest.raises(TrustboError, match="mission 0 has reports, which carry over"):
        tb.logs.join_missions(told[1:2])
