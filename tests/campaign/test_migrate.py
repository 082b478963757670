"""Records of older versions, converted to those of this one."""

import pytest

from trustbo.campaign.migrate import migrate_notes, migrate_result, migrate_state
from trustbo.campaign.options import arguments_of
from trustbo.campaign.stopping import rules_of
from trustbo.errors import TrustboError

STATE = {
    "n_missions": 2,
    "options": {"seed": 3},
    "rows": [{"status": "ok"}, {"status": "stuck"}],
    "failures": [[1, "rain"], [2, "stuck", [[0, 0], [0, 1]], [0, 1]]],
    "notes": {"replan": "bound"},
}


def test_missions_of_version_0_1_are_learned_each_with_its_posterior():
    record = migrate_state(STATE)
    assert [row["state"] for row in record["rows"]] == ["learned", "learned"]
    assert record["posterior_after"] == [1, 2]


def test_failures_without_path_or_report_have_all_five_fields():
    assert migrate_state(STATE)["failures"] == [
        [1, "rain", [], None, False],
        [2, "stuck", [[0, 0], [0, 1]], [0, 1], False],
    ]


def test_replanning_of_version_0_1_becomes_an_option_and_the_tilt_of_0_2_goes():
    assert migrate_state(STATE)["options"]["replan"] == "bound"
    tilted = STATE | {"options": {"replan": "mission", "hazard": {"log_tilt": 1.0, "cause": 0.1}}}
    options = migrate_state(tilted)["options"]
    assert options == {"replan": "mission", "hazard": {"cause": 0.1}}


def test_a_campaign_of_matched_moments_is_refused_and_the_others_are_refit():
    assert "update" not in migrate_state(STATE | {"options": {"update": "refit"}})["options"]
    with pytest.raises(TrustboError, match="was the last version to have: its result can be"):
        migrate_state(STATE | {"options": {"update": "moment_matched"}})


def test_the_rule_seconds_of_version_0_2_is_a_time_limit():
    rules = [{"rule": "Seconds", "own": False, "limit": 60.0}, {"rule": "bold", "own": True}]
    stop = migrate_state(STATE | {"notes": {"stop": rules}})["notes"]["stop"]
    assert rules_of(stop[:1])[0].limit == 60.0
    assert stop == [{"rule": "TimeLimit", "own": False, "limit": 60.0}, rules[1]]


def test_a_record_of_this_version_stays_as_it_is():
    record = migrate_state(STATE)
    assert migrate_state(record) == record
    result = migrate_result({"n_missions": 1, "settings": {"failure_cost": 2.0}})
    assert result["settings"] == {"failure_cost": 2.0, "max_failure": None, "unseen_cost": 0.0}
    assert migrate_result(result) == result


def test_a_simulator_of_version_0_1_is_known_by_its_name_of_now():
    now = {"simulator": "ReplaySimulator", "missions": [[1], [2]], "tick": 0.5}
    assert migrate_notes({"simulator": "ReplayBackend", "missions": 2}, now) == now
    before = migrate_notes({"simulator": "ReplayBackend", "missions": 3, "stop": []}, now)
    assert before == {"simulator": "ReplaySimulator", "missions": 3, "stop": []}


def test_a_policy_of_ones_own_has_to_be_given_again():
    record = {"start": [0, 0], "goal": [1, 1], "policy": "bold", "own_policy": True}
    with pytest.raises(TrustboError, match="'bold'"):
        arguments_of(record, None)


def test_a_simulator_of_version_0_2_had_no_events():
    before = {"simulator": "KinematicSimulator", "tick": 0.5, "stop": []}
    assert migrate_notes(before, {**before, "events": []}) == {**before, "events": []}
    assert migrate_notes(before, before) == before
    later = {**before, "events": [{"event": "Dust", "detection": 0.5}]}
    assert migrate_notes(before, later)["events"] == []  # refused: it is another simulator
    assert migrate_notes(later, later) == later
