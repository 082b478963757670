"""Rank-one Bayes factors of rates that are not Gaussian: by a joint normal, and by EP itself."""

import numpy as np
import pytest
from joint_normal import Dense
from missions import walking_missions
from scipy import sparse

from trustbo.data import Mission
from trustbo.inference.evidence.gaussian import Gaussian
from trustbo.inference.evidence.sites import Sites
from trustbo.models import Priors
from trustbo.models.effects.effect import Independent, Slots
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.effects.robot import RobotEffect
from trustbo.models.effects.weights import Weights
from trustbo.models.families import FAMILIES
from trustbo.models.place import bounds_of, visited
from trustbo.stacking import stack_missions

FEATURES = ("line_of_sight", "slope")
FAMILY_NAMES = ("censored", "beta_binomial")
TICKS, SD = 20, 0.4


def sites_of(family, stretch, memory="level", *, apart=False):
    """Evidence of six missions whose rates are counted and stretched beyond the limits."""
    missions = []
    for m in walking_missions(11, 6, missing=0.2):
        y = np.round(np.clip(0.5 + stretch * (m.contact_rate - 0.5), 0.0, 1.0) * TICKS) / TICKS
        missions.append(
            Mission.from_arrays(m.path, m.awareness, y, n_ticks=np.full(y.shape, TICKS))
        )
    batch, priors = stack_missions(missions), Priors.of(FEATURES, family)
    bounds = bounds_of(missions, batch.contact_rate.shape[:2])
    places = visited(bounds, PlaceEffect(), batch.contact_rate.shape[2], (5, 5))
    slots = Slots.of(batch, len(missions), FEATURES, None, places)
    groups = [effect.group(slots) for effect in (Weights(priors), PlaceEffect(), RobotEffect())]
    x0 = float(priors.x0_mean), float(priors.x0_sd)

    def with_columns(*further):
        given = slots, [*groups, *further], FAMILIES[family], x0, memory
        return Sites(*given, apart=apart)

    return with_columns, slots, groups, x0


def theta_of(memory="level", n_robots=None):
    unit = np.ones((1, n_robots) if n_robots else 1)
    theta = {"beta0": 0.4 * unit, "rest": np.array([0.6 if memory == "level" else 1.0])}
    scales = {"delta_w": 0.1, "delta_v": 0.12, "tau_s": 0.2, "tau_e": 0.1, "length_scale": 2.0}
    scales |= {"tau_slow": 0.2, "tau_day": 0.1}
    return theta | {name: np.array([value]) for name, value in scales.items()}


def candidates(slots, seed=0):
    """Columns of one mission each, in two runs: their sums from some mission on."""
    rng, mission = np.random.default_rng(seed), np.repeat(slots.mission, slots.y.shape[1])
    dense = rng.uniform(size=(len(mission), 6)) * (rng.uniform(size=(len(mission), 6)) < 0.7)
    dense *= mission[:, None] == np.array([1, 3, 5, 0, 2, 4])
    run = np.array([0, 0, 0, 1, 1, 1])
    sums = [dense[:, i:][:, run[i:] == run[i]].sum(1) for i in range(6)]
    return sparse.csc_array(dense), run, sums


def gain(a, b):
    t2 = SD**2
    return -0.5 * np.log1p(t2 * a) + t2 * b**2 / (2.0 + 2.0 * t2 * a)


@pytest.mark.parametrize(("memory", "apart"), [("level", False), ("level", True),
                                               ("deviation", False)])  # fmt: skip
@pytest.mark.parametrize("family", FAMILY_NAMES)
def test_a_scan_is_that_of_the_joint_normal_of_the_sites(family, memory, apart, monkeypatch):
    """1e-9: what a normal of 80 rates leaves of 1e-16, whose noises differ by 1e4."""
    with_columns, slots, groups, x0 = sites_of(family, 1.5, memory, apart=apart)
    theta, seen, of_gaussian = theta_of(memory, slots.n_robots * apart), {}, Gaussian.scan
    monkeypatch.setattr(
        Gaussian, "scan", lambda self, *args: seen.update(args[0]) or of_gaussian(self, *args)
    )
    columns, run, sums = candidates(slots)
    a, b = with_columns().scan(theta, columns, run)
    rates = np.where(np.isnan(slots.y), np.nan, seen["rates"][0])
    for i, z in enumerate(sums):
        one = Independent(sparse.csr_array(z[:, None]), "change", SD / theta["rest"][0])
        with_it, without = (
            Dense(slots._replace(y=rates), g, theta, x0, memory, variances=seen["variances"][0])
            for g in ([*groups, one], groups)
        )
        difference = with_it.log_density() - without.log_density()
        np.testing.assert_allclose(gain(a, b)[0, i], difference, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("stretch", "share"), [(1.0, 0.0), (2.0, 0.1)])
@pytest.mark.parametrize("family", FAMILY_NAMES)
def test_a_bayes_factor_is_the_difference_of_two_evidences_by_ep(family, stretch, share):
    """To .05 nats; sites stay as they are without the column, which half a tenth of limits shows.

    The evidence with the column has its own sites: to second order in their difference both agree.
    Where a third of the rates are limits, a tenth of the factor is left.
    """
    with_columns, slots, _, _ = sites_of(family, stretch)
    theta = theta_of()
    columns, run, sums = candidates(slots, 1)
    a, b = with_columns().scan(theta, columns, run)

    def settled(*further):
        evidence = with_columns(*further)
        evidence.recentre(theta)
        return evidence.log_density(theta)[0]

    without = settled()
    for i, z in enumerate(sums):
        one = Independent(sparse.csr_array(z[:, None]), "change", SD / theta["rest"][0])
        difference = settled(one) - without
        assert abs(gain(a, b)[0, i] - difference) < 0.05 + share * abs(difference)
