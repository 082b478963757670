"""Tables of people's reports: what they become, and what is refused."""

import numpy as np
import pandas as pd
import pytest

from trustbo.errors import TrustboError
from trustbo.logs import read_reports

GOOD = {
    "person": ["ann", "ann", "ann", "bob", "bob"],
    "step": [0, 1, 2, 0, 1],
    "outcome": ["", 1, 0, "", "Failure"],
    "load": [0.0, 0.25, 0.75, 0.0, 0.5],
    "report": [4, 5, "", 3, 1],
}


def read(given, **options):
    return read_reports(given, **({"outcome": "outcome", "scale": "likert7"} | options))


def test_a_person_is_a_mission_and_outcomes_are_inputs():
    ann, bob = read(GOOD, inputs=["load"])
    assert (ann.path, ann.scale) == ((), "likert7")
    assert ann.features == ("success", "failure", "load")
    np.testing.assert_allclose(ann.awareness[:, 0], [[0, 0, 0], [1, 0, 0.25], [0, 1, 0.75]])
    np.testing.assert_allclose(ann.contact_rate[:, 0], [0.5, 4 / 6, np.nan])
    np.testing.assert_allclose(bob.contact_rate[:, 0], [2 / 6, 0.0])
    assert (ann.n_ticks == 6.0).all()
    other = read(pd.DataFrame(GOOD)[::-1], inputs=["load"])
    np.testing.assert_array_equal(other[1].contact_rate, ann.contact_rate)
    np.testing.assert_array_equal(other[1].awareness, ann.awareness)
    (first, _) = read_reports(pd.DataFrame(GOOD).assign(report=0.5), inputs=["load"])
    assert first.features == ("load",)
    assert np.isnan(first.n_ticks).all()


@pytest.mark.parametrize(
    ("changes", "options"),
    [
        ({"report": [4, 5, "", 3, 8]}, {}),
        ({"report": [4, 5.5, "", 3, 1]}, {}),
        ({"report": [4, "high", "", 3, 1]}, {}),
        ({}, {"scale": "unit"}),
        ({}, {"scale": "stars"}),
        ({"report": [4, 5, "", "", ""]}, {}),
        ({"step": [0, 1, 1, 0, 1]}, {}),
        ({"step": [0, 1, "", 0, 1]}, {}),
        ({"person": ["ann", "ann", "", "bob", "bob"]}, {}),
        ({"person": ["ann", "ann", "Ann", "bob", "bob"]}, {}),
        ({"outcome": ["", "maybe", 0, "", 1]}, {}),
        ({}, {"outcome": None}),
        ({}, {"outcome": "result"}),
        ({"load": ["", 1, 0, 0, 1]}, {"inputs": ["load"]}),
    ],
)
def test_an_odd_table_is_refused_in_one_line(changes, options):
    with pytest.raises(TrustboError) as caught:
        read(GOOD | changes, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("inputs", [["failure"], ["load", "load"], ["load", "Load"]])
def test_features_with_one_name_are_refused(inputs):
    with pytest.raises(TrustboError, match="inputs"):
        read(GOOD | {"failure": [3.0, 1.0, 4.0, 1.0, 5.0]}, inputs=inputs)
