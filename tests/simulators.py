"""A simulator of the model itself: missions whose truth is known."""

import jax
import numpy as np

from trustbo.data import Mission
from trustbo.models import PooledTrust, TrustParams

TRUTH = TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)


class ModelSimulator:
    """Draws contact rates from the trust model with known parameters."""

    def __init__(self, workspace, truth=TRUTH, fail_at=None, blind=False):
        self.workspace, self.truth, self.fail_at, self.blind = workspace, truth, fail_at, blind

    def run(self, path, *, seed):
        z = np.swapaxes(self.workspace.awareness.values[:, *zip(*path[1:], strict=True)], 0, 1)
        status = "ok"
        if self.fail_at is not None:
            z, status = z[: self.fail_at], "stuck"
        sample = PooledTrust().simulate(
            jax.random.key(seed, impl="threefry2x32"), self.truth, z[None]
        )
        if self.blind:
            z = np.full_like(z, np.nan)
        rates = np.clip(sample.contact_rate[0], 0.0, 1.0)
        return Mission.from_arrays(path, z, rates, duration=np.full(len(z), 30.0), status=status)
