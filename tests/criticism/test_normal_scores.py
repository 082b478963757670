"""Normal rates that stand for censored ones, counts and Student-t ones: their distribution."""

import jax
import numpy as np
import pytest
from scipy import stats
from scipy.linalg import solve_triangular

from trustbo.criticism.joint_normal import Point, gather, joint_normal
from trustbo.criticism.normal_scores import with_normal_rates
from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference import fit
from trustbo.models import PooledTrust, TrustParams
from trustbo.models.families import FAMILIES

TRUTHS = {
    "censored": TrustParams(0.6, np.array([0.5, 0.3]), 0.05, 0.12, 0.1, 0.5, 0.5),
    "beta_binomial": TrustParams(0.6, np.array([2.0, 1.0]), -0.3, 0.4, 0.25, 0.0, 1.5),
}
TICKS = 40


def drawn(family, seed):
    """Four missions of a known truth."""
    z = np.random.default_rng(seed).uniform(size=(4, 6, 3, 2))
    model = PooledTrust(observation=family)
    y = model.simulate(jax.random.key(seed), TRUTHS[family], z, n_ticks=TICKS).contact_rate
    counted = family == "beta_binomial"
    path, ticks = [(0, k) for k in range(7)], np.full((6, 3), TICKS if counted else np.nan)
    return [Mission.from_arrays(path, a, b, n_ticks=ticks) for a, b in zip(z, y, strict=True)]


def at_truth(posterior, truth):
    """The posterior with all draws at the truth."""
    draws = posterior["posterior"].to_dataset()
    values = {name: draws[name] * 0.0 + getattr(truth, name) for name in draws}
    posterior["posterior"] = draws.assign(values)
    return posterior


@pytest.mark.parametrize("family", TRUTHS)
def test_normal_rates_have_the_joint_normal_distribution(family):
    """Whitened by it, 12 data sets are standard normal, of each rate and in their products."""
    truth = TRUTHS[family]
    posterior = fit(drawn(family, 0), PooledTrust(observation=family), draws=100, whole=False)
    posterior, e = at_truth(posterior, truth), []
    for seed in range(12):
        missions = drawn(family, seed)
        data = gather(missions, None)
        given = posterior, missions, data, Point(truth, {}, 0.0, None)
        made, point = with_normal_rates(*given, seed)
        normal = joint_normal(point, made)
        factor = np.linalg.cholesky(normal.cov)
        e.append(solve_triangular(factor, made.y - normal.mean, lower=True))
        if family == "censored":
            high, low = data.rates >= 1.0, data.rates <= 0.0
            np.testing.assert_allclose(made.y[~(high | low)], data.rates[~(high | low)], rtol=1e-9)
            assert (made.y[high] >= 1.0).all()
            assert (made.y[low] <= 0.0).all()
    e = np.array(e)
    assert stats.kstest(e.ravel(), "norm").pvalue > 1e-3
    # 4 standard errors, of the mean product of successive rates
    assert abs((e[:, 1:] * e[:, :-1]).mean()) < 4.0 / np.sqrt(e.size)


@pytest.mark.parametrize("family", FAMILIES)
def test_probabilities_of_a_rate_are_those_of_its_draws(family):
    rng, trust = np.random.default_rng(0), np.array([-0.1, 0.4, 0.9, 1.1])[:, None]
    y, sd, n = np.array([0.0, 0.3, 0.85, 1.0])[:, None], 0.2, 20_000
    one, ticks = FAMILIES[family], np.full((4, 1), TICKS)
    linear = trust + sd * rng.standard_normal((4, n))
    rates = one.draw_rates(rng, np.broadcast_to(trust, (4, n)), linear, np.full((4, n), sd),
                           np.broadcast_to(ticks, (4, n)))  # fmt: skip
    found = one.probabilities(trust, np.full((4, 1), sd), y, ticks)
    for p, expected in zip(found, ((rates < y).mean(1), (rates <= y).mean(1)), strict=True):
        error = np.sqrt(np.maximum(expected * (1.0 - expected), 1.0 / n) / n)
        assert (np.abs(p[:, 0] - expected) < 4.0 * error).all()


def test_censored_rates_that_measure_changes_are_refused():
    missions = drawn("censored", 0)
    posterior = fit(missions, PooledTrust(observation="censored"), draws=100, whole=False)
    point = Point(TRUTHS["censored"], {}, 1.0, None)
    with pytest.raises(TrustboError, match="censored rates that measure trust; these measure its"):
        with_normal_rates(posterior, missions, gather(missions, None), point, 0)
