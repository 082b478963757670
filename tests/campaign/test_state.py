"""Seeds of a campaign: one for each purpose, mission, failure and exclusion."""

from dataclasses import replace

import numpy as np
import pytest

from trustbo.campaign.state import Entry, Exclusion, Failure, State
from trustbo.data import Mission

STREAMS = ("policy", "fit", "mission", "prior", "hazard", "exclude")


def entry_of(exclusion=None):
    mission = Mission.from_arrays([(0, 0), (0, 1)], np.full((1, 1, 1), 0.5), np.full((1, 1), 0.5))
    return Entry(None, mission, mission, None, exclusion)


def state_of(n_missions, seed=7):
    return State({"seed": seed}, tuple(entry_of() for _ in range(n_missions)))


def exclude(state, j):
    entries = list(state.entries)
    entries[j] = replace(entries[j], exclusion=Exclusion(len(entries), "windy"))
    return replace(state, entries=tuple(entries))


def test_seeds_without_exclusions_are_those_of_seed_stream_and_mission():
    state = state_of(3)
    for stream, number in {"policy": 0, "fit": 1, "mission": 2, "hazard": 5}.items():
        expected = np.random.SeedSequence([7, number, 3]).generate_state(1)[0]
        assert state.seed_of(stream) == expected
    state = replace(state, failures=(Failure(3, "stuck"),))
    assert state.seed_of("policy") == np.random.SeedSequence([7, 0, 3, 1]).generate_state(1)[0]


def test_no_two_fits_have_one_seed():
    state = state_of(3)
    seeds = [state.seed_of(stream) for stream in STREAMS]
    for j in (0, 1):
        state = exclude(state, j)
        seeds.append(state.seed_of("exclude"))
    state = replace(state, entries=(*state.entries, entry_of()))
    seeds.append(state.seed_of("fit"))
    assert len(set(seeds)) == len(seeds)


@pytest.mark.parametrize("n_failures", [0, 1])
def test_the_seed_of_a_fit_depends_on_the_last_change_alone(n_failures):
    """A mission is learned with the seed from before it, also if a process died in between."""
    before = replace(state_of(3), failures=(Failure(3, "stuck"),) * n_failures)
    told = replace(before, entries=(*before.entries, entry_of()))
    assert told.seed_of_fit == before.seed_of("fit")
    excluded = exclude(told, 0)
    assert excluded.seed_of_fit == excluded.seed_of("exclude")
    again = replace(excluded, entries=(*excluded.entries, entry_of()))
    assert again.seed_of_fit == excluded.seed_of("fit")
