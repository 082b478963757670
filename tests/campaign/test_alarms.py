"""Alarms of campaigns in which one robot changes, or nothing does."""

import dataclasses

import numpy as np
import pytest

import trustbo as tb
from trustbo.campaign.alarms import sentences_of
from trustbo.models import HierarchicalTrust
from trustbo.report.summary import facts_of

FROM = 6  # the first mission after the change, from 1


def driven(factor):
    """A campaign of 9 missions, r2's contact multiplied from one of them on; the second is blind.

    Its number is left out of the posterior, and no number after it may shift.
    """
    rng = np.random.default_rng(0)
    sight = rng.uniform(0.3, 1.0, (3, 4, 4, 1))
    features = ["line_of_sight"]
    workspace = tb.Workspace.from_awareness(sight, np.ones((4, 4), bool), features=features)
    campaign = tb.Campaign(workspace, (3, 0), (0, 3), seed=1)
    for number in range(1, 10):
        path = campaign.ask().path
        rows, cols = np.array(path)[1:].T
        z = np.swapaxes(sight[:, rows, cols], 0, 1)
        scale = np.where((np.arange(3) == 1) & (number >= FROM), factor, 0.8)
        rates = np.clip(z[..., 0] * scale + 0.04 * rng.standard_normal(z.shape[:2]), 0.01, 0.99)
        names = {"robots": workspace.team.names, "features": features}
        if number == 2:
            with pytest.warns(UserWarning, match="mission 2 is set aside"):
                campaign.tell(tb.Mission.from_arrays(path, z, np.full_like(rates, np.nan), **names))
        else:
            campaign.tell(tb.Mission.from_arrays(path, z, rates, **names))
    return campaign


@pytest.fixture(scope="module")
def worn():
    return driven(0.3)


def changes_of(card):
    return [text for name, text in card.rows if name == "changes"]


def test_a_robot_that_fails_is_an_alarm_by_its_name_and_the_mission_s_number(worn):
    result = worn.result()
    assert changes_of(result._card()) == []  # a display begins no scan
    (alarm,) = result.alarms.to_dict("records")
    assert (alarm["kind"], alarm["where"], alarm["from_mission"]) == ("robot", "r2", FROM)
    assert alarm["earliest"] == FROM
    assert alarm["change"] == f"r2 from mission {FROM} on"
    assert alarm["probability"] > 0.9
    assert abs(alarm["effect"] + 0.5) < 4.0 * alarm["sd"] + 0.1
    assert worn.alarms.equals(result.alarms)
    (text,) = changes_of(result._card())
    assert text.startswith(f"r2 from mission {FROM} on: less contact, by 0.")
    facts = {fact.name: fact for fact in facts_of(result)}
    assert facts["Changes"].text == text
    assert facts["Changes"].good is False


def test_alarms_are_the_same_from_disk(worn, tmp_path):
    result = worn.result()
    result.save(tmp_path)
    assert tb.load_result(tmp_path).alarms.equals(result.alarms)


def test_nothing_that_changes_is_no_alarm():
    result = driven(0.8).result()
    assert result.alarms.empty
    assert "change" in result.alarms
    assert changes_of(result._card()) == ["none"]
    facts = {fact.name: fact.text for fact in facts_of(result)}
    assert facts["Changes"] == "No change of a robot or an area is more probable than none."


def test_changes_that_cannot_be_weighed_are_refused(worn):
    result = worn.result()
    model = HierarchicalTrust(observation="gaussian")
    missions = [mission for j, mission in enumerate(result.missions) if j != 1]
    other = tb.fit(missions, model, draws=100, progress=False)
    other.attrs["missions"] = [0, *range(2, 9)]
    other["hazard"] = result.posteriors[-1]["hazard"]
    other = dataclasses.replace(result, posteriors=[*result.posteriors[:-1], other])
    with pytest.raises(tb.TrustboError, match=r"weighed under PooledTrust.*got Hierarchical"):
        _ = other.alarms


def test_equal_changes_are_in_the_sentence_of_an_alarm(worn):
    tied = worn.result().alarms.assign(ties="area within 1 of (3, 4) from mission 6 on")
    assert sentences_of(tied)[0].endswith(
        "; or, equal on these paths, area within 1 of (3, 4) from mission 6 on."
    )
