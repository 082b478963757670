"""Learning mission by mission: sums, weights, forgetting, and the moments of the later code."""

import numpy as np
import numpyro.distributions as dist
import pytest
from missions import simulate_missions
from references import dense_coupled

from trustbo.data import Mission
from trustbo.errors import ShapeError, TrustboError
from trustbo.inference import fit, params_of, sample_statistics
from trustbo.inference.evidence.statistics import gather
from trustbo.inference.updating import moment_matched, update_statistics
from trustbo.models import (
    CoupledTrust,
    HierarchicalTrust,
    PooledTrust,
    Priors,
    RobotParams,
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


def test_the_quadratic_form_of_changes_is_the_dense_joint_normal():
    missions = simulate_missions(3)
    missions[0] = with_a_gap(missions[0])
    model = PooledTrust(response="change")
    (statistics,) = update_statistics(model, None, missions)
    q = statistics.evaluate(THETA, 0.5)
    c = np.array([0.3, 0.2, 0.05])
    for i, (beta0, Q, R) in enumerate(THETA):
        found = q.alpha[i] - 2 * c @ q.h[i] + c @ q.P[i] @ c + q.log_det[i]
        found = -0.5 * (found + statistics.n_measured * np.log(2 * np.pi))
        expected = sum(
            dense_coupled(
                np.diag([beta0] * 3),
                m.awareness @ c[:2] + c[2],
                np.eye(3) * Q,
                np.eye(3) * R,
                0.5,
                0.5,
                m.contact_rate,
                model.lag,
            )[0]
            for m in missions
        )
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_missions_add_up_in_any_order():
    missions = [with_a_gap(m) if j == 2 else m for j, m in enumerate(simulate_missions(6))]
    model = PooledTrust()
    (whole,) = update_statistics(model, None, missions)
    statistics = None
    for mission in missions[::-1]:
        statistics = update_statistics(model, statistics, [mission])
    same(whole, statistics[0])
    assert whole.n_measured == statistics[0].n_measured


def test_a_weight_is_a_number_of_missions():
    missions = [with_a_gap(m) if j == 1 else m for j, m in enumerate(simulate_missions(3))]
    model = PooledTrust()
    batch = stack_missions(missions)
    weight = np.r_[2.0, 1.0, 0.0, np.ones(len(batch.contact_rate) - 3)]
    (weighted,) = gather(model, batch, weight)
    (repeated,) = update_statistics(model, None, [missions[0], missions[0], missions[1]])
    same(weighted, repeated)


def test_forgetting_is_a_weight_by_age():
    missions, model, statistics = simulate_missions(4), PooledTrust(), None
    for mission in missions:
        statistics = update_statistics(model, statistics, [mission], forgetting=0.5)
    batch = stack_missions(missions)
    weight = np.r_[0.125, 0.25, 0.5, 1.0, np.ones(4)]
    same(statistics[0], gather(model, batch, weight)[0])
    drawn = sample_statistics(model, statistics, n_draws=4000)
    by_fit = fit(missions, model, "exact", weights=weight[:4])
    for name in ("beta0", "b", "delta_v"):
        theirs = by_fit["posterior"][name].values.ravel()
        # The same target; two sets of draws of Kish size > 2000: 4 standard errors are 0.13 sd.
        assert abs(getattr(drawn.params, name).mean() - theirs.mean()) < 0.13 * theirs.std()
    assert by_fit["constant_data"]["weight"].values.tolist() == weight[:4].tolist()


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
    statistics = update_statistics(CoupledTrust(inter_robot="none"), None, missions)
    drawn = sample_statistics(CoupledTrust(inter_robot="none"), statistics, n_draws=100)
    assert isinstance(drawn.params, RobotParams)
    assert drawn.params.beta.shape == (100, 3, 2)


def test_matched_priors_have_the_posterior_s_moments():
    posterior = fit(simulate_missions(4), PooledTrust(), sampler="exact")
    draws = params_of(posterior)
    matched = moment_matched(draws, Priors())
    assert isinstance(matched.beta0, dist.Beta)
    for name in ("beta0", "b", "delta_w", "delta_v"):
        prior, values = getattr(matched, name), getattr(draws, name)
        np.testing.assert_allclose(float(prior.mean), values.mean(), rtol=1e-4)
        np.testing.assert_allclose(float(prior.variance), values.var(), rtol=1e-3)
    np.testing.assert_allclose(matched.beta.mean, draws.beta.mean(0), rtol=1e-5)
    again = fit(simulate_missions(1), PooledTrust(matched), sampler="exact")
    assert again.attrs["k_hat"] < 0.7


def test_what_does_not_add_up_is_named():
    missions, model = simulate_missions(2), PooledTrust()
    statistics = update_statistics(model, None, missions)
    with pytest.raises(TrustboError, match=r"forgetting must be in \(0, 1\]; got 0"):
        update_statistics(model, statistics, missions, forgetting=0)
    with pytest.raises(TrustboError, match=r"HierarchicalTrust.*share some parameters only"):
        update_statistics(HierarchicalTrust(), None, missions)
    other = PooledTrust(Priors(x0_mean=0.2))
    with pytest.raises(TrustboError, match="different x0_mean or response do not add up"):
        update_statistics(other, statistics, missions)
    one = [Mission.from_arrays(m.path, m.awareness[..., :1], m.contact_rate) for m in missions]
    with pytest.raises(ShapeError, match="statistics of 2 and 1 features do not add up"):
        update_statistics(model, statistics, one)
    apart = CoupledTrust(inter_robot="none")
    pair = [
        Mission.from_arrays(m.path, m.awareness[:, :2], m.contact_rate[:, :2]) for m in missions
    ]
    with pytest.raises(ShapeError, match="statistics are of 3 robots, the missions have 2"):
        update_statistics(apart, update_statistics(apart, None, missions), pair)
    with pytest.raises(ShapeError, match=r"weights must be \(2,\), one per mission; got \(3,\)"):
        fit(missions, weights=[1.0, 1.0, 1.0])
    with pytest.raises(TrustboError, match=r"weights must be in \[0, 1\]"):
        fit(missions, weights=[1.0, 2.0])
