"""Tables of people's reports: what they become, and one line for each that is odd."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from trustbo.errors import TrustboError
from trustbo.logs import (
    read_azevedo_sa,
    read_du,
    read_missions,
    read_reports,
    read_soh,
    write_missions,
)

GOOD = {
    "person": ["ann", "ann", "ann", "bob", "bob"],
    "step": [0, 1, 2, 0, 1],
    "outcome": ["", 1, 0, "", "failure"],
    "demand": ["", 0.25, 0.75, "", 0.5],
    "report": [4, 5, "", 3, 1],
}


def table(**changes):
    return GOOD | changes


def read(given, **options):
    return read_reports(given, **({"outcome": "outcome", "scale": "likert7"} | options))


def test_a_person_is_a_mission_and_outcomes_are_inputs(tmp_path):
    ann, bob = read(table(), demand="demand")
    assert ann.path == ()
    assert ann.features == ("success", "failure", "success_demand", "failure_demand")
    np.testing.assert_allclose(ann.awareness[:, 0],
                               [[0, 0, 0, 0], [1, 0, 0.25, 0], [0, 1, 0, 0.25]])  # fmt: skip
    np.testing.assert_allclose(ann.contact_rate[:, 0], [0.5, 4 / 6, np.nan])
    np.testing.assert_allclose(bob.contact_rate[:, 0], [2 / 6, 0.0])
    assert (ann.n_ticks == 6.0).all()
    frame = pd.DataFrame(table())
    frame.sample(frac=1.0, random_state=0).sort_values("person").to_csv(
        tmp_path / "answers.csv", index=False
    )
    other = read(tmp_path / "answers.csv", demand="demand")
    np.testing.assert_array_equal(other[0].contact_rate, ann.contact_rate)
    np.testing.assert_array_equal(read(frame, demand="demand")[1].awareness, bob.awareness)
    records = frame.drop(columns=["outcome", "demand"]).assign(report=0.5, load=0.3)
    records = records.to_records(index=False)
    (first, _) = read_reports(np.asarray(records), inputs=["load"])
    assert first.features == ("load",)
    assert np.isnan(first.n_ticks).all()


def test_missions_keep_that_they_are_reports_and_show_it(tmp_path):
    people = read(table())
    assert [one.scale for one in people] == ["likert7", "likert7"]
    assert "Reports of a person" in repr(people[0])
    assert "contact" not in repr(people[0])
    write_missions(tmp_path / "people.nc", people)
    assert [one.scale for one in read_missions(tmp_path / "people.nc")] == ["likert7", "likert7"]
    with pytest.raises(TrustboError, match='scale must be "unit"'):
        replace(people[0], scale="stars")


def test_an_input_of_another_unit_is_refused_with_the_row():
    good = table(age=[0.2, 0.2, 0.2, -1.1, -1.1])
    assert read(good, inputs=["age"])[1].awareness[0, 0, -1] == -1.1
    with pytest.raises(TrustboError, match=r"row 4: age = 61 is beyond 10; .*centre and scale"):
        read(table(age=[9, 9, 9, 61, 61]), inputs=["age"])


def test_tasks_are_rows_with_what_was_seen_at_the_step():
    rows = {
        "person": ["a"] * 4,
        "step": [1, 1, 2, 2],
        "about": ["cook", "drive", "cook", "drive"],
        "outcome": ["", "", 1, 1],
        "report": [0.2, 0.4, 0.6, ""],
    }
    (one,) = read_reports(rows, outcome="outcome", task="about")
    assert one.robots == ("cook", "drive")
    assert one.features == ("task_cook", "task_drive", "success", "failure")
    np.testing.assert_allclose(one.awareness[1], [[1, 0, 1, 0], [0, 1, 1, 0]])
    np.testing.assert_allclose(one.contact_rate, [[0.2, 0.4], [0.6, np.nan]])


@pytest.mark.parametrize(
    ("changes", "options", "message"),
    [
        ({"report": [4, 5, "", 3, 8]}, {}, "row 5: report = 8 is no whole number from 1 to 7"),
        ({"report": [4, 5, "", 3, 0]}, {}, "row 5: report = 0 is no whole number from 1 to 7"),
        ({"report": [4, 5.5, "", 3, 1]}, {}, "row 2: report = 5.5 is no whole number from 1 to 7"),
        ({"report": [4, "high", "", 3, 1]}, {}, "row 2: report = 'high' is no number"),
        ({"report": [4, "inf", "", 3, 1]}, {}, "row 2: report = 'inf' is no number"),
        ({}, {"scale": "unit"}, r'4 is outside \[0, 1\]; give its scale, .*"likert7"'),
        ({"report": [50, 60, 1, 2, 3]}, {"scale": "unit"}, r"50 is outside .*divide it by 100"),
        ({"report": [-1, 0, 1, 0, 0]}, {"scale": "unit"}, r"row 1: report = -1 is outside"),
        ({}, {"scale": "stars"}, 'scale must be "unit", "likert7" or'),
        ({}, {"scale": 7}, 'scale must be "unit", "likert7".*got 7'),
        ({}, {"scale": "likert1"}, "levels of a scale must be .* got 1"),
        ({"report": [4, 5, "", "", ""]}, {}, "person bob has no report"),
        ({"step": [0, 1, 1, 0, 1]}, {}, "person ann, step 1 is there twice, in rows 2 and 3"),
        ({"step": [0, 1, "", 0, 1]}, {}, "row 3: step is blank"),
        ({"step": [0, 1, "last", 0, 1]}, {}, "row 3: step = 'last' is no number"),
        ({"person": ["ann", "ann", "", "bob", "bob"]}, {}, "row 3: person is blank"),
        ({"outcome": ["", "maybe", 0, "", 1]}, {}, "row 2: outcome = 'maybe' is no outcome"),
        ({"outcome": ["", 2, 0, "", 1]}, {}, "row 2: outcome = '2' is no outcome"),
        ({"demand": ["", 3, 0, "", 1]}, {"demand": "demand"}, "row 2: demand = '3' must be in"),
        ({"demand": ["", "", 0, "", 1]}, {"demand": "demand"}, "row 2: demand = '' must be in"),
        ({}, {"demand": "demand", "outcome": None}, "demand='demand' scales outcomes"),
        ({}, {"outcome": None}, "reports need what was seen: give outcome=, a column, or inputs="),
        ({}, {"outcome": "result"}, r'lacks result; it has .*read_reports\(table, outcome="'),
        ({}, {"report": "trust"}, r"lacks trust; it has person, step"),
        ({}, {"person": "participant"}, r'lacks participant.*person="\.\.\."'),
        ({}, {"inputs": ["load"]}, r'lacks load.*inputs="\.\.\."'),
        ({}, {"inputs": ["demand"]}, "row 1: demand is blank; an input must be known"),
        ({}, {"inputs": ["report"]}, "one column has two meanings"),
        ({name: [] for name in GOOD}, {}, "the table has no rows"),
        ({"step": [0, 1]}, {}, r"columns must have one length; got \[2, 5\]"),
        ({"about": ["x", "x", "", "x", "x"]}, {"task": "about"}, "row 3: about is blank"),
        ({"about": ["x"] * 5, "step": [0, 0, 1, 0, 1]}, {"task": "about"},
         "person ann, step 0 and about x is there twice"),
    ],
)  # fmt: skip
def test_an_odd_table_is_refused_in_one_line(changes, options, message):
    with pytest.raises(TrustboError, match=message) as caught:
        read(table(**changes), **options)
    assert "\n" not in str(caught.value)


def test_what_is_no_table_is_refused(tmp_path):
    with pytest.raises(TrustboError, match=r"there is no file .*nobody.csv"):
        read(tmp_path / "nobody.csv")
    with pytest.raises(TrustboError, match="give the path of a CSV file or a DataFrame; got 5"):
        read(5)
    (tmp_path / "image.csv").write_bytes(b"\xff\xd8\xff\xe0")
    with pytest.raises(TrustboError, match="cannot be read as CSV in UTF-8"):
        read(tmp_path / "image.csv")


def test_the_three_studies_are_read_from_their_columns(tmp_path):
    (tmp_path / "soh.csv").write_text(
        "person,C1_rating,D1_rating,E1_rating,A_rating,B_rating,C2_rating,D2_rating,E2_rating,"
        "A_ID,B_ID,C_ID,D_ID,E_ID,B_SF\np1,4,7,4,6,6,7,7,5,1,5,3,2,9,1\n"
    )
    (soh,) = read_soh(tmp_path / "soh.csv")
    assert soh.robots == ("A", "B", "C", "D", "E")
    np.testing.assert_allclose(soh.contact_rate[1, 2:] * 6 + 1, [7, 7, 5])
    assert np.isnan(soh.contact_rate[1, :2]).all()
    np.testing.assert_allclose(soh.awareness[1, :, 14], [1, 1, 1, 1, 0])  # E is of the other kind
    assert soh.awareness[0, 4, 8] == 1.0  # task 9
    (tmp_path / "azevedo.csv").write_text(
        "person,step,success,sensing,processing,asked_sensing,asked_processing,trust\n"
        "p0,1,0,0.1,0.9,0.9,0.8,0.047426\np0,2,1,0.9,0.9,0.9,0.8,0.5\n"
    )
    (azevedo,) = read_azevedo_sa(tmp_path / "azevedo.csv")
    np.testing.assert_allclose(azevedo.contact_rate[:, 0], [0.0, 0.5])
    np.testing.assert_allclose(azevedo.awareness[:, 0, :4], [[0, 1, 0, 0.5], [1, 0, 1, 0]])
    (tmp_path / "du.csv").write_text(
        "person,step,trust_before,trust_after,state,task_result\nq,1,.65,.6,1,-5\nq,2,.6,.7,0,5\n"
    )
    (du,) = read_du(tmp_path / "du.csv")
    np.testing.assert_allclose(du.contact_rate[:, 0], [0.65, 0.6, 0.7])
    np.testing.assert_allclose(du.awareness[:, 0], [[0, 0], [0, 1], [1, 0]])
    (events,) = read_du(tmp_path / "du.csv", events=True)
    assert events.awareness[1, 0, events.features.index("failure_high_1")] == 1.0
    for reader in (read_soh, read_azevedo_sa, read_du):
        with pytest.raises(TrustboError, match=r"the table lacks .*: is it the study's\?"):
            reader({"person": ["p"]})
