"""Trust in real time against Bayes' rule written out over the draws."""

import numpy as np
import pytest
from models.likelihood.test_scalar import random_params
from references import dense_log_likelihood, dense_posterior_of_trust

from trustbo.errors import ShapeError, TrustboError
from trustbo.models import TrustFilter, TrustParams


def mixture(n_draws=4, seed=0):
    rng = np.random.default_rng(seed)
    draws = [random_params(rng) for _ in range(n_draws)]
    return draws, TrustParams(*(np.stack(v) for v in zip(*(d[:7] for d in draws), strict=True)))


def test_after_each_bound_trust_is_its_exact_posterior():
    draws, params = mixture()
    rng = np.random.default_rng(1)
    z, y = rng.uniform(size=(6, 3, 2)), rng.uniform(size=(6, 3))
    y[2, 1] = np.nan
    live = TrustFilter(params, n_robots=3)
    for k in range(1, 7):
        state = live.update(z[k - 1], y[k - 1])
        log_weight = [
            sum(dense_log_likelihood(*p[:7], z[:k, i], y[:k, i]) for i in range(3)) for p in draws
        ]
        weight = np.exp(log_weight - np.max(log_weight))
        weight /= weight.sum()
        np.testing.assert_allclose(live.weights, weight, rtol=1e-8)
        for i in range(3):
            moments = [dense_posterior_of_trust(*p[:7], z[:k, i], y[:k, i]) for p in draws]
            means = np.array([m[-1] for m, _ in moments])
            variances = np.array([v[-1, -1] for _, v in moments])
            mean = weight @ means
            np.testing.assert_allclose(state.mean[i], mean, rtol=1e-8)
            sd = np.sqrt(weight @ (variances + (means - mean) ** 2))
            np.testing.assert_allclose(state.sd[i], sd, rtol=1e-7)
    assert live.n_bounds == 6


def test_predicting_is_updating_with_nothing_measured():
    _, params = mixture()
    rng = np.random.default_rng(2)
    z = rng.uniform(size=(5, 3, 2))
    live = TrustFilter(params, n_robots=3)
    live.update(z[0], rng.uniform(size=3))
    ahead = live.predict(z[1:])
    before = live.state
    assert ahead.mean.shape == ahead.sd.shape == (4, 3)
    np.testing.assert_array_equal(live.state.mean, before.mean)  # predicting changes nothing
    for k in range(4):
        state = live.update(z[k + 1], np.full(3, np.nan))
        np.testing.assert_allclose(state.mean, ahead.mean[k], rtol=1e-12)
        np.testing.assert_allclose(state.sd, ahead.sd[k], rtol=1e-12)


def test_a_posterior_brings_its_robots_and_a_reset_starts_over(posterior):
    live = TrustFilter(posterior, max_draws=500)
    assert np.shape(live.params.beta) == (500, 2)
    first = live.update(np.full((3, 2), 0.5), [0.7, 0.8, 0.9])
    assert first.mean.shape == (3,)
    assert first.mean[0] < first.mean[1] < first.mean[2]
    live.reset()
    assert live.n_bounds == 0
    again = live.update(np.full((3, 2), 0.5), [0.7, 0.8, 0.9])
    np.testing.assert_array_equal(again.mean, first.mean)


def test_bad_input_is_named():
    _, params = mixture()
    with pytest.raises(TrustboError, match="say how many robots"):
        TrustFilter(params)
    live = TrustFilter(params, n_robots=3)
    good = np.full((3, 2), 0.5)
    with pytest.raises(ShapeError, match=r"awareness must be \(3 robots, 2 features\); got shape"):
        live.update(good[:2], [0.5, 0.5, 0.5])
    with pytest.raises(ShapeError, match=r"contact_rate must be \(3,\); got shape \(2,\)"):
        live.update(good, [0.5, 0.5])
    with pytest.raises(TrustboError, match=r"contact_rate must be in \[0, 1\]"):
        live.update(good, [0.5, 0.5, 1.5])
    with pytest.raises(TrustboError, match="awareness must not be NaN"):
        live.update(good * np.nan, [0.5, 0.5, 0.5])
    with pytest.raises(ShapeError, match=r"awareness must be \(bound, 3 robots"):
        live.predict(good)
    assert live.n_bounds == 0
