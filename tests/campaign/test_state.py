"""Seeds of a campaign: one for each purpose, mission, failure and exclusion."""

import numpy as np

from trustbo.campaign.state import EXCLUDED, LEARNED, Entry, Failure, State

STREAMS = ("policy", "fit", "mission", "prior", "hazard", "exclude")


def state_of(n_missions, seed=7):
    rows = [{"state": LEARNED, "reason": ""} for _ in range(n_missions)]
    return State({"seed": seed}, [Entry(None, None, None, None, row) for row in rows])


def test_seeds_without_exclusions_are_those_of_seed_stream_and_mission():
    state = state_of(3)
    for stream, number in {"policy": 0, "fit": 1, "mission": 2, "hazard": 5}.items():
        expected = np.random.SeedSequence([7, number, 3]).generate_state(1)[0]
        assert state.seed_of(stream) == expected
    state.failures.append(Failure(3, "stuck"))
    assert state.seed_of("policy") == np.random.SeedSequence([7, 0, 3, 1]).generate_state(1)[0]


def test_no_two_fits_have_one_seed():
    state = state_of(3)
    seeds = [state.seed_of(stream) for stream in STREAMS]
    for entry in state.entries[:2]:
        entry.become(EXCLUDED, "windy")
        seeds.append(state.seed_of("exclude"))
    state.entries.append(state_of(1).entries[0])
    seeds.append(state.seed_of("fit"))
    assert len(set(seeds)) == len(seeds)
