"""Columns and priors of effects against covariances written out in full."""

import numpy as np
import pytest
from missions import walking_missions

from trustbo.errors import TrustboError
from trustbo.models import Priors
from trustbo.models.effects.effect import Slots, dense_root
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.effects.robot import RobotEffect, next_mission
from trustbo.models.effects.weights import Weights
from trustbo.models.place import bounds_of, visited
from trustbo.stacking import stack_missions

THETA = {
    name: np.array([value])
    for name, value in {
        "beta0": 0.3, "rest": 0.7, "tau_s": 0.3, "length_scale": 1.7, "tau_e": 0.1,
        "tau_slow": 0.2, "tau_day": 0.3,
    }.items()
}  # fmt: skip


def slots_of(missions, place=None, features=("line_of_sight", "slope"), weight=None):
    batch = stack_missions(missions)
    bounds = bounds_of(missions, batch.contact_rate.shape[:2])
    places = None if place is None else visited(bounds, place, 3, (5, 5))
    return Slots.of(batch, len(missions), features, weight, places)


def covariance(group, theta=THETA):
    """Covariance of the effect at every slot."""
    prior = group.prior(theta)
    root = np.eye(prior.sd.shape[1])
    for columns, one in zip(group.joined, prior.roots, strict=True):
        root[columns, columns] = dense_root(one)[0]
    scaled = group.columns @ (prior.sd[0][:, None] * root)
    return scaled @ scaled.T


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize(("cells", "bounds"), [(True, True), (True, False), (False, True)])
def test_places_have_the_covariance_of_cells_and_bounds(cells, bounds, shared):
    missions, place = walking_missions(1), PlaceEffect(cells=cells, bounds=bounds, shared=shared)
    slots = slots_of(missions, place)
    at = np.full((*slots.y.shape, 5), -1)
    for c, (j, i) in enumerate(zip(slots.mission, slots.robot, strict=True)):
        path = missions[j].path
        for k in range(len(path) - 1):
            at[c, k] = *path[k], *path[k + 1], i * (not shared)
    at = at.reshape(-1, 5)
    there = at[:, 0] >= 0
    robot = at[:, None, 4] == at[None, :, 4]
    gap = np.sqrt(3.0) * np.linalg.norm(at[:, None, 2:4] - at[None, :, 2:4], axis=2) / 1.7
    expected = cells * 0.3**2 * (1.0 + gap) * np.exp(-gap) * robot
    expected = expected + bounds * 0.1**2 * (at[:, None] == at[None]).all(2)
    expected = expected * there[:, None] * there
    assert not there.all()  # some bounds are padding
    np.testing.assert_allclose(covariance(place.group(slots)), expected, rtol=1e-9, atol=1e-12)


def test_effects_of_cells_and_bounds_add_up_to_the_coefficients():
    place, rng = PlaceEffect(), np.random.default_rng(0)
    slots = slots_of(walking_missions(2), place)
    group = place.group(slots)
    n = 4000
    prior = group.prior(THETA)
    e = rng.standard_normal((n, prior.sd.shape[1]))
    (columns,), (root,) = group.joined, prior.roots
    e[:, columns] = e[:, columns] @ root[0].T
    c = prior.sd * e
    theta = {name: np.repeat(value, n) for name, value in THETA.items()}
    named = group.name(c, theta, rng)
    sums = named["place"][:, group.visited.cell_of] + named["place_bound"]
    np.testing.assert_allclose(sums, c @ group.rotation, atol=1e-12)
    # Under the prior s and e are independent: variances within 5 standard errors of sqrt(2 / n).
    error = 5.0 * np.sqrt(2.0 / n)
    np.testing.assert_allclose(named["place"].var(0), 0.3**2, rtol=error)
    np.testing.assert_allclose(named["place_bound"].var(0), 0.1**2, rtol=error)
    s, e = named["place"][:, group.visited.cell_of], named["place_bound"]
    correlation = (s * e).mean(0) / (0.3 * 0.1)
    assert np.abs(correlation).max() < 5.0 / np.sqrt(n)


def test_a_robot_in_a_mission_has_a_part_that_stays_and_a_bad_day():
    slots = slots_of(walking_missions(3))
    m, i = (np.repeat(index, slots.y.shape[1]) for index in (slots.mission, slots.robot))
    sight, gap = slots.z[:, :, 0].ravel(), np.abs(m[:, None] - m[None])
    K = 0.2**2 * 0.9**gap + 0.3**2 * (gap == 0)
    expected = 0.7**2 * np.outer(sight, sight) * K * (i[:, None] == i[None])
    np.testing.assert_allclose(
        covariance(RobotEffect().group(slots)), expected, rtol=1e-12, atol=1e-15
    )


def test_without_line_of_sight_a_robot_has_a_constant():
    slots = slots_of(walking_missions(3), features=("slope", "visibility"))
    assert np.unique(RobotEffect().group(slots).columns.data).tolist() == [1.0]


@pytest.mark.parametrize(("slow", "day"), [(0.2, 0.3), (0.0, 0.3), (0.2, 0.0), (0.0, 0.0)])
def test_the_next_mission_is_that_of_dense_conditioning(slow, day):
    d = np.random.default_rng(0).normal(size=(1, 4, 2)) * np.hypot(slow, day)
    gap = np.abs(np.subtract.outer(np.arange(5), np.arange(5)))
    K = slow**2 * 0.9**gap + day**2 * (gap == 0)
    mean, variance = np.zeros(2), K[4, 4]
    if slow + day > 0.0:
        gain = np.linalg.solve(K[:4, :4], K[:4, 4])
        mean, variance = gain @ d[0], K[4, 4] - gain @ K[:4, 4]
    theta = {"tau_slow": np.array([slow]), "tau_day": np.array([day])}
    found, sd = next_mission(d, theta, 0.9)
    np.testing.assert_allclose(found[0], mean, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(sd[0], np.sqrt(variance), rtol=1e-12)


def test_a_bad_day_is_gone_the_next_mission():
    d, theta = np.full((1, 3, 2), -0.4), {"tau_slow": np.zeros(1), "tau_day": np.full(1, 0.3)}
    assert not next_mission(d, theta, 0.9)[0].any()


def test_weights_are_those_of_stationary_trust_where_the_priors_are():
    slots = slots_of(walking_missions(3))
    prior = Weights(Priors.of(("line_of_sight", "slope"))).group(slots).prior(THETA)
    np.testing.assert_allclose(prior.mean, [[0.7, 0.0, 0.0]], atol=1e-15)
    np.testing.assert_allclose(prior.sd, [[0.21, 0.175, 0.105]])


def test_a_robot_refuses_a_correlation_that_does_not_fade():
    with pytest.raises(TrustboError, match=r"rho must be between 0 and 1; got 1\.0"):
        RobotEffect(rho=1.0)
    with pytest.raises(TrustboError, match="tau_day"):
        RobotEffect(tau_day=0.0)
