"""The pooled model as printed in equations (3)-(4), with latent trust sampled by NumPyro's NUTS."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

from peers.numpyro_nuts import nuts

X0_MEAN, X0_SD = 0.5, 0.5


def program(z: Any, y: Any) -> None:
    """Model of awareness (bound, sequence, feature) and rates (bound, sequence)."""
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
    beta = numpyro.sample("beta", dist.Normal(0.0, 1.0).expand([z.shape[2]]).to_event(1))
    b = numpyro.sample("b", dist.Normal(0.0, 0.5))
    delta_w = numpyro.sample("delta_w", dist.HalfNormal(0.2))
    delta_v = numpyro.sample("delta_v", dist.HalfNormal(0.2))

    drift = z @ beta + b
    with numpyro.plate("sequence", y.shape[1]):
        x = numpyro.sample("x_0", dist.Normal(X0_MEAN, X0_SD))
        for k in range(len(y)):
            x = numpyro.sample(f"x_{k + 1}", dist.Normal(beta0 * x + drift[k], delta_w))
            numpyro.sample(f"y_{k + 1}", dist.Normal(x, delta_v), obs=y[k])


def samplers(
    awareness: np.ndarray, rates: np.ndarray
) -> dict[str, Callable[[int], tuple[dict, int]]]:
    """The sampler by name; arguments as in `pymc_nutpie.samplers`."""
    n_bounds, n_features = awareness.shape[1], awareness.shape[3]
    z = np.moveaxis(awareness, 1, 0).reshape(n_bounds, -1, n_features)
    y = np.moveaxis(rates, 1, 0).reshape(n_bounds, -1)
    return {"NumPyro's NUTS, latent trust sampled": nuts(program, jnp.asarray(z), jnp.asarray(y))}
