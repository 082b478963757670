"""dynamax's Kalman filter as the likelihood of the pooled model, under blackjax's NUTS."""

from functools import partial

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
from dynamax.linear_gaussian_ssm import lgssm_filter
from dynamax.linear_gaussian_ssm.inference import make_lgssm_params
from jax.scipy.special import expit
from jax.scipy.stats import beta as beta_distribution
from jax.scipy.stats import norm


def pooled(awareness, rates, *, warmup, draws, chains):
    """Sampler with a dense mass matrix by window adaptation; all chains in one compiled call."""
    z = np.swapaxes(awareness, 1, 2).reshape(-1, awareness.shape[1], awareness.shape[3])
    y = np.swapaxes(rates, 1, 2).reshape(len(z), -1)

    def sampler(seed):
        with jax.enable_x64(True):
            keys = jax.random.split(jax.random.key(seed), chains)
            theta = run(keys, z, y, warmup, draws)
            results = jax.vmap(jax.vmap(constrain))(theta)
            return {name: np.asarray(a) for name, a in results.items()}

    return sampler


@partial(jax.jit, static_argnames=("warmup", "draws"))
def run(keys, z, y, warmup, draws):
    density = partial(log_density, z=z, y=y)

    def chain(key):
        key_start, key_warmup, key_run = jax.random.split(key, 3)
        start = jnp.asarray([0.0, 0.0, 0.0, 0.0, -2.0, -2.0])
        start = start + 0.5 * jax.random.normal(key_start, start.shape)
        adaptation = blackjax.window_adaptation(
            blackjax.nuts, density, is_mass_matrix_diagonal=False
        )
        (state, tuned), _ = adaptation.run(key_warmup, start, warmup)
        kernel = blackjax.nuts(density, **tuned)

        def advance(state, key):
            state, _ = kernel.step(key, state)
            return state, state.position

        return jax.lax.scan(advance, state, jax.random.split(key_run, draws))[1]

    return jax.lax.map(chain, keys)


def constrain(theta):
    return {
        "beta0": expit(theta[0]),
        "beta": theta[1:-3],
        "b": theta[-3],
        "delta_w": jnp.exp(theta[-2]),
        "delta_v": jnp.exp(theta[-1]),
    }


def log_density(theta, z, y):
    p = constrain(theta)
    prior = beta_distribution.logpdf(p["beta0"], 2.0, 2.0) + norm.logpdf(p["b"], 0.0, 0.5)
    prior += norm.logpdf(p["beta"]).sum()
    prior += norm.logpdf(p["delta_w"], 0.0, 0.2) + norm.logpdf(p["delta_v"], 0.0, 0.2)
    jacobian = jnp.log(p["beta0"] * (1.0 - p["beta0"])) + theta[-2] + theta[-1]
    F, Q = p["beta0"].reshape(1, 1), (p["delta_w"] ** 2).reshape(1, 1)

    def one(z, y):
        # dynamax starts with the first measured state, trust after bound 1.
        ssm = make_lgssm_params(
            initial_mean=(0.5 * p["beta0"] + z[0] @ p["beta"] + p["b"]).reshape(1),
            initial_cov=0.25 * F**2 + Q,
            dynamics_weights=F,
            dynamics_cov=Q,
            emissions_weights=jnp.ones((1, 1)),
            emissions_cov=(p["delta_v"] ** 2).reshape(1, 1),
            dynamics_bias=p["b"].reshape(1),
            dynamics_input_weights=p["beta"][None],
        )
        return lgssm_filter(ssm, y[:, None], z).marginal_loglik

    return prior + jacobian + jax.vmap(one)(z, y).sum()
