"""Latent trust after sampling, where the Kalman recursions are at their limits."""

import numpy as np
import pytest
from missions import simulate_missions
from references import dense_posterior_of_trust

from trustbo.data import Mission
from trustbo.inference import fit, params_of
from trustbo.inference.evidence import kalman_numpy as trajectories
from trustbo.models import PooledTrust, TrustParams
from trustbo.stacking import stack_missions


def test_process_noise_that_underflows_is_no_process_noise():
    rng = np.random.default_rng(0)
    path = [(0, k) for k in range(6)]
    mission = Mission.from_arrays(path, rng.uniform(size=(5, 2, 2)), rng.uniform(size=(5, 2)))
    batch = stack_missions([mission])
    found = []
    for delta_w in (1e-8, 1e-200):  # the square of the latter is 0
        params = TrustParams(0.6, np.array([0.3, 0.2]), 0.1, delta_w, 0.1)
        params = params.flat()
        summary = trajectories.summarize(params, 0.0, batch)
        draw = trajectories.sample(params, 0.0, batch, np.random.default_rng(1))
        assert np.isfinite(draw).all()
        found.append((summary.mean, summary.sd, draw[..., :5, :]))
    for usual, limit in zip(*found, strict=True):
        # They differ by the noise of 1e-8, carried back over five bounds by 1 / beta0 each.
        np.testing.assert_allclose(limit, usual, atol=1e-6)


@pytest.fixture(scope="module")
def with_losses():
    """Short and long missions: a last rate lost, one in the middle, and a robot never measured."""
    missions = simulate_missions(3)
    rates = [m.contact_rate.copy() for m in missions]
    rates[0][-2:, 0] = np.nan
    rates[1][:, 1] = np.nan
    rates[2][[2, 7], 2] = np.nan
    return [
        Mission.from_arrays(m.path, m.awareness, y) for m, y in zip(missions, rates, strict=True)
    ]


def test_trust_is_that_of_dense_conditioning_where_no_rate_was_measured(with_losses):
    n = 4000
    params = TrustParams(0.6, np.array([0.3, 0.2]), 0.1, 0.05, 0.08, 0.4, 0.3)
    draws = params.map(lambda v, _: np.repeat(np.asarray(v, dtype=float)[None], n, 0))
    batch = stack_missions(with_losses, pad=False)
    n_bounds = np.array([len(m.bounds) for m in with_losses])
    few = draws.map(lambda v, _: v[:2])
    summary = trajectories.summarize(few, 0.0, batch, n_bounds)
    drawn = trajectories.sample(draws, 0.0, batch, np.random.default_rng(0), n_bounds)
    for j, mission in enumerate(with_losses):
        for i in range(3):
            z, y = mission.awareness[:, i], mission.contact_rate[:, i]
            mean, covariance = dense_posterior_of_trust(*params[:7], z, y)
            K, sd = len(mean), np.sqrt(np.diag(covariance))
            np.testing.assert_allclose(summary.mean[j, :K, i], mean, rtol=1e-9)
            np.testing.assert_allclose(summary.sd[j, :K, i], sd, rtol=1e-6)
            # A covariance of 4000 draws: 5 standard errors of sd^2 sqrt(2 / 4000).
            off = np.cov(drawn[:, j, :K, i].T) - covariance
            assert np.abs(off / np.outer(sd, sd)).max() < 5 * np.sqrt(2 / n)


def test_a_posterior_knows_trust_where_no_rate_was_measured(with_losses):
    """The mean and variance over draws of dense conditioning given each, with one in forty."""
    posterior = fit(with_losses, PooledTrust())
    draws = params_of(posterior)
    picked = [draws.draw(d) for d in range(0, 4000, 40)]
    latent = posterior["latent"]
    for j, i in ((0, 0), (1, 1), (2, 2)):
        mission = with_losses[j]
        z, y = mission.awareness[:, i], mission.contact_rate[:, i]
        each = [dense_posterior_of_trust(*p[:7], z, y) for p in picked]
        means = np.array([m for m, _ in each])
        variance = np.mean([np.diag(c) for _, c in each], axis=0) + means.var(0)
        here = {"mission": j, "robot": f"r{i + 1}", "bound": slice(1, len(y))}
        sd = latent["trust_sd"].sel(here).values
        # 100 draws: a mean to .1 sd, an sd to 7 %; 4 of these.
        assert (np.abs(latent["trust_mean"].sel(here) - means.mean(0)) < 0.4 * sd).all()
        np.testing.assert_allclose(sd, np.sqrt(variance), rtol=0.3)
        spread = latent["trust"].sel(here).std(("chain", "draw")).values
        np.testing.assert_allclose(spread, sd, rtol=0.25)  # 200 trajectories: 5 % each
