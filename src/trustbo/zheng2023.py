"""Comparison with the 2023 code of the paper's authors: its priors and learning.

Nothing here is recommended. The public entries are `Priors.zheng2023()` and `moment_matched`.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpyro.distributions import Distribution


def vague_priors() -> dict[str, Any]:
    """Fields of `Priors`: normal with sd 10, noises half-Cauchy."""
    import jax
    import numpyro.distributions as dist

    with jax.enable_x64(True):
        vague, noise = dist.Normal(0.0, 10.0), dist.HalfCauchy(1.0)
    coefficients = dict.fromkeys(("beta0", "beta", "b", "coupling"), vague)
    return (
        coefficients | dict.fromkeys(("delta_w", "delta_v", "tau"), noise) | {"concentration": 1.0}
    )


def match_moments(draws: np.ndarray, prior: "Distribution") -> "Distribution":
    """Prior of the next mission: mean and sd of posterior draws (draw, ...), support of `prior`."""
    import numpyro.distributions as dist
    from numpyro.distributions import constraints

    mean, var = draws.mean(0), draws.var(0)
    if prior.support is constraints.unit_interval:
        total = mean * (1.0 - mean) / var - 1.0
        return dist.Beta(mean * total, (1.0 - mean) * total)
    if prior.support is constraints.positive:
        log_var = np.log1p(var / mean**2)
        return dist.LogNormal(np.log(mean) - 0.5 * log_var, np.sqrt(log_var))
    return dist.Normal(mean, np.sqrt(var))
