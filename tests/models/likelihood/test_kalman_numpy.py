"""Latent trust after sampling, where the Kalman recursions are at their limits."""

import numpy as np

from trustbo.data import Mission
from trustbo.models import TrustParams
from trustbo.models.likelihood import kalman_numpy as trajectories
from trustbo.stacking import stack_missions


def test_process_noise_that_underflows_is_no_process_noise():
    rng = np.random.default_rng(0)
    path = [(0, k) for k in range(6)]
    mission = Mission.from_arrays(path, rng.uniform(size=(5, 2, 2)), rng.uniform(size=(5, 2)))
    batch = stack_missions([mission])
    found = []
    for delta_w in (1e-8, 1e-200):  # the square of the latter is 0
        params = TrustParams(0.6, np.array([0.3, 0.2]), 0.1, delta_w, 0.1)
        params = TrustParams(*(np.asarray(v, dtype=float)[None] for v in params))
        summary = trajectories.summarize(params, 0.0, batch)
        draw = trajectories.sample(params, 0.0, batch, np.random.default_rng(1))
        assert np.isfinite(draw).all()
        found.append((summary.mean, summary.sd, draw[..., :5, :]))
    for usual, limit in zip(*found, strict=True):
        # They differ by the noise of 1e-8, carried back over five bounds by 1 / beta0 each.
        np.testing.assert_allclose(limit, usual, atol=1e-6)
