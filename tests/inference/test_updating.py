"""Sums over missions, and weights of missions."""

import numpy as np
import pytest
from missions import simulate_missions

from trustbo.data import Mission
from trustbo.errors import ShapeError, TrustboError
from trustbo.inference import fit
from trustbo.inference.evidence.statistics import gather
from trustbo.models import (
    CoupledTrust,
    PooledTrust,
)
from trustbo.stacking import stack_missions

THETA = np.array([[0.5, 0.01, 0.02], [0.8, 0.03, 0.001], [-0.2, 0.2, 0.1]])


def same(one, other, rtol=1e-10):
    for a, b in zip(one.evaluate(THETA, 0.5), other.evaluate(THETA, 0.5), strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=1e-12)


def with_a_gap(mission):
    rates = mission.contact_rate.copy()
    rates[1, 2] = np.nan
    return Mission.from_arrays(mission.path, mission.awareness, rates)


def test_a_weight_is_a_number_of_missions():
    missions = [with_a_gap(m) if j == 1 else m for j, m in enumerate(simulate_missions(3))]
    model = PooledTrust()
    batch = stack_missions(missions)
    weight = np.r_[2.0, 1.0, 0.0, np.ones(len(batch.contact_rate) - 3)]
    (weighted,) = gather(model, batch, weight)
    (repeated,) = gather(model, stack_missions([missions[0], missions[0], missions[1]]))
    same(weighted, repeated)


def test_missions_of_less_weight_leave_a_wider_posterior():
    missions = simulate_missions(4)
    weighted = fit(missions, PooledTrust(), weights=[0.2, 0.4, 0.7, 1.0])["posterior"]
    assert float(weighted["delta_v"].std()) > 1.1 * float(
        fit(missions, PooledTrust())["posterior"]["delta_v"].std()
    )


def test_robots_with_nothing_in_common_are_so_many_pooled_fits():
    missions = simulate_missions(5)
    apart = fit(missions, CoupledTrust(inter_robot="none"), sampler="exact", seed=3)
    assert apart["posterior"]["beta"].dims == ("chain", "draw", "robot", "feature")
    for i in range(3):
        alone = [
            Mission.from_arrays(m.path, m.awareness[:, [i]], m.contact_rate[:, [i]])
            for m in missions
        ]
        one = fit(alone, PooledTrust(), sampler="exact", seed=3 + i)
        for name in ("beta0", "beta", "delta_w"):
            np.testing.assert_allclose(
                apart["posterior"][name].isel(robot=i).values, one["posterior"][name].values
            )
        np.testing.assert_allclose(
            apart["latent"]["trust_mean"].isel(robot=i).values,
            one["latent"]["trust_mean"].isel(robot=0).values,
            equal_nan=True,
        )


def test_weights_that_suit_no_missions_are_named():
    missions = simulate_missions(2)
    with pytest.raises(ShapeError, match=r"weights must be \(2,\), one per mission; got \(3,\)"):
        fit(missions, weights=[1.0, 1.0, 1.0])
    with pytest.raises(TrustboError, match=r"weights must be in \[0, 1\]"):
        fit(missions, weights=[1.0, 2.0])
