"""The pooled model with the likelihood of dynamax's linear Gaussian state-space model.

dynamax has no sampler for constrained parameters, so NumPyro's NUTS samples them. State and rate
are scalars. There is one sequence for each mission and robot, and all sequences are filtered in
parallel.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from dynamax.linear_gaussian_ssm.inference import lgssm_filter, make_lgssm_params

from peers.numpyro_nuts import nuts

X0_MEAN, X0_VAR = 0.5, 0.25


def log_likelihood(y: Any, drift: Any, beta0: Any, delta_w: Any, delta_v: Any) -> jax.Array:
    """Log density (sequence,) of rates (sequence, bound) given the drift (sequence, bound)."""

    def of_one(y: Any, drift: Any) -> Any:
        parameters = make_lgssm_params(
            initial_mean=(beta0 * X0_MEAN + drift[0])[None],
            initial_cov=jnp.reshape(beta0**2 * X0_VAR + delta_w**2, (1, 1)),
            dynamics_weights=jnp.reshape(beta0, (1, 1)),
            dynamics_cov=jnp.reshape(delta_w**2, (1, 1)),
            dynamics_bias=drift[:, None],  # entry k belongs to the transition to bound k
            emissions_weights=jnp.ones((1, 1)),
            emissions_cov=jnp.reshape(delta_v**2, (1, 1)),
        )
        return lgssm_filter(parameters, y[:, None]).marginal_loglik

    return jax.vmap(of_one)(y, drift)


def program(z: Any, y: Any) -> None:
    """Model of awareness (sequence, bound, feature) and rates (sequence, bound)."""
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
    beta = numpyro.sample("beta", dist.Normal(0.0, 1.0).expand([z.shape[2]]).to_event(1))
    b = numpyro.sample("b", dist.Normal(0.0, 0.5))
    delta_w = numpyro.sample("delta_w", dist.HalfNormal(0.2))
    delta_v = numpyro.sample("delta_v", dist.HalfNormal(0.2))

    log_p = log_likelihood(y, z @ beta + b, beta0, delta_w, delta_v)
    numpyro.factor("rates", log_p.sum())


def samplers(
    awareness: np.ndarray, rates: np.ndarray
) -> dict[str, Callable[[int], tuple[dict, int]]]:
    """The sampler by name; arguments as in `pymc_nutpie.samplers`."""
    n_bounds, n_features = awareness.shape[1], awareness.shape[3]
    z = np.moveaxis(awareness, 1, 2).reshape(-1, n_bounds, n_features)
    y = np.moveaxis(rates, 1, 2).reshape(-1, n_bounds)
    return {"dynamax's likelihood, NumPyro's NUTS": nuts(program, jnp.asarray(z), jnp.asarray(y))}
