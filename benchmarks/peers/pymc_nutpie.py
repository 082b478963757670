"""The pooled model in PyMC, with trust integrated out by a Kalman filter in PyTensor, for nutpie.

The filter is unrolled over bounds and processes all sequences in parallel. All sequences have the
same variance, because no rate is missing.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
import nutpie
import pymc as pm
import pytensor.tensor as pt

from peers.numpyro_nuts import CHAINS, DRAWS

X0_MEAN, X0_VAR = 0.5, 0.25


def pooled(awareness: np.ndarray, rates: np.ndarray) -> pm.Model:
    """Model of awareness (mission, bound, robot, feature) and rates (mission, bound, robot)."""
    n_bounds, n_features = awareness.shape[1], awareness.shape[3]
    z = np.moveaxis(awareness, 1, 0).reshape(n_bounds, -1, n_features)
    y = np.moveaxis(rates, 1, 0).reshape(n_bounds, -1)
    n = y.shape[1]
    with pm.Model() as model:
        beta0, b = pm.Beta("beta0", 2.0, 2.0), pm.Normal("b", 0.0, 0.5)
        beta = pm.Normal("beta", 0.0, 1.0, shape=n_features)
        Q = pm.HalfNormal("delta_w", 0.2) ** 2
        R = pm.HalfNormal("delta_v", 0.2) ** 2
        drift = pt.as_tensor(z) @ beta + b
        m, P, total = pt.full((n,), X0_MEAN), X0_VAR, 0.0
        for k in range(n_bounds):
            m, P = beta0 * m + drift[k], beta0**2 * P + Q
            e, S = y[k] - m, P + R
            total += -0.5 * ((e**2).sum() / S + n * pt.log(2.0 * np.pi * S))
            gain = P / S
            m, P = m + gain * e, (1.0 - gain) * P
        pm.Potential("rates", total)
    return model


def samplers(
    awareness: np.ndarray, rates: np.ndarray
) -> dict[str, Callable[[int], tuple[dict, int]]]:
    """Samplers with a diagonal and a low-rank mass matrix, and nutpie's default warm-up.

    Args:
        awareness: Awareness (mission, bound, robot, feature).
        rates: Rates (mission, bound, robot).
    """
    compiled = nutpie.compile_pymc_model(pooled(awareness, rates))

    def sample(seed: int, adaptation: str) -> tuple[dict, int]:
        trace = nutpie.sample(
            compiled, draws=DRAWS, chains=CHAINS, cores=1, seed=seed, progress_bar=False,
            adaptation=adaptation,
        )  # fmt: skip
        draws = {name: np.asarray(v) for name, v in trace["posterior"].to_dataset().items()}
        return draws, int(trace["sample_stats"]["diverging"].sum())

    found = {
        "PyMC with nutpie": partial(sample, adaptation="diag"),
        "PyMC with nutpie, low-rank": partial(sample, adaptation="low_rank"),
    }
    for sampler in found.values():
        sampler(10_000)
    return found
