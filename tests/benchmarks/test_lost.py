"""The benchmark of contact lost: its baselines learn, and its measures."""

from dataclasses import replace

import lost
import numpy as np
import pytest
from world_set import worlds


@pytest.fixture(scope="module")
def world():
    return replace(worlds()["synthetic-0"], name="synthetic-0-small", shape=(5, 5), cell=40.0)


@pytest.mark.parametrize("method", ["running mean", "residual process"])
def test_baselines_learn_from_each_mission(world, method):
    campaign = lost.campaign_of(world, "sw-ne", method, 2)
    learned = campaign.policy.rates
    n_rates = sum(map(len, learned.values())) if method == "running mean" else len(learned)
    assert n_rates == sum(len(mission.path) - 1 for mission in campaign.missions)
    assert not lost.METHODS[method]["policy"].rates  # other campaigns begin anew


def test_bounds_that_are_not_completed_count_as_lost(world):
    [mission] = lost.campaign_of(world, "sw-ne", "line of sight", 1).missions
    n_bounds = len(mission.path) - 1
    assert lost.lost_in(mission) == pytest.approx(n_bounds - mission.contact_rate.mean(1).sum())

    status = ["ok"] * (n_bounds - 1) + ["tipped"]
    failed = replace(mission, bound_status=tuple(status), status="tipped")
    assert lost.lost_in(failed) == pytest.approx(
        n_bounds - np.nansum(mission.contact_rate[:-1].mean(1))
    )
