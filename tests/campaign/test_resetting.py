"""Places that may have changed since their last visit are drawn from the prior, so often."""

import numpy as np
import pytest

import trustbo as tb
from trustbo.campaign.resetting import chances, with_resets
from trustbo.models import PlaceEffect, PooledTrust

PATHS = ((3, 0), (2, 1), (1, 2), (0, 3)), ((3, 0), (2, 0), (1, 1), (0, 2), (0, 3))
SIGHT = np.random.default_rng(0).uniform(0.4, 0.9, (2, 4, 4, 1))


def missions_of():
    rng = np.random.default_rng(1)
    missions = []
    for j in range(6):
        rows, cols = np.array(PATHS[j > 1])[1:].T  # the first path in missions 1 and 2 alone
        z = np.swapaxes(SIGHT[:, rows, cols], 0, 1)
        rates = np.clip(z[..., 0] - 0.1 + 0.02 * rng.standard_normal(z.shape[:2]), 0.01, 0.99)
        missions.append(tb.Mission.from_arrays(PATHS[j > 1], z, rates, features=["line_of_sight"]))
    return missions


@pytest.fixture(scope="module")
def campaign():
    workspace = tb.Workspace.from_awareness(
        SIGHT, np.ones((4, 4), bool), features=["line_of_sight"]
    )
    campaign = tb.Campaign(
        workspace, (3, 0), (0, 3), model=PooledTrust(place=PlaceEffect()), seed=2, changes="reset"
    )
    for mission in missions_of():
        campaign.tell(mission, other_path=True)
    return campaign


def test_the_chance_of_a_cell_grows_since_its_last_visit_and_falls_with_what_was_seen():
    chance = chances(missions_of(), range(6), (4, 4), 6)
    assert chance[2, 1] == 4 / (4 + 1 + 40)  # visited in missions 1 and 2 of 6
    assert chance[1, 1] == 0.0  # visited in the last one
    assert chance[3, 3] == 0.0  # never visited: the prior anyway
    later = chances(missions_of(), range(6), (4, 4), 16)
    assert later[1, 1] == 10 / (10 + 3 + 40)


def test_draws_of_a_cell_come_from_the_prior_with_its_chance(campaign):
    tree = campaign.posteriors[-1]
    before = tb.inference.params_of(tree)
    chance = np.zeros((4, 4))
    chance[2, 1] = 0.5
    after = with_resets(before, tree, chance, seed=3)
    moved = (np.asarray(after.place) != np.asarray(before.place))[:, 0]
    assert abs(moved[:, 2, 1].mean() - 0.5) < 4.0 * np.sqrt(0.25 / len(moved))
    assert moved.sum() == moved[:, 2, 1].sum()
    bounds = (np.asarray(after.place_bound) != np.asarray(before.place_bound))[:, 0]
    np.testing.assert_array_equal(bounds.all(1)[:, 2, 1], moved[:, 2, 1])
    tau = tree["posterior"]["tau_s"].values.ravel()[moved[:, 2, 1]]
    score = np.asarray(after.place)[moved[:, 2, 1], 0, 2, 1] / tau
    assert abs(score.std() - 1.0) < 4.0 / np.sqrt(2.0 * len(score))


def test_the_belief_of_a_campaign_is_reset_the_same_after_it_is_read_again(campaign, tmp_path):
    spread = np.asarray(campaign.belief.place)[:, 0].std(0)
    whole = np.asarray(tb.inference.params_of(campaign.posteriors[-1]).place)[:, 0].std(0)
    assert spread[2, 1] > whole[2, 1]
    campaign.save(tmp_path / "run")
    again = tb.Campaign.load(tmp_path / "run")
    np.testing.assert_array_equal(np.asarray(again.belief.place), np.asarray(campaign.belief.place))
