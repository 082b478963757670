"""numpyro's own MCMC object: on trustbo's model, and on plain models that sample latent trust."""

import contextlib
import io
from functools import partial

import jax
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.infer import MCMC, NUTS

NAMES = ("beta0", "beta", "b", "delta_w", "delta_v")


def marginal(model, awareness, rates, *, warmup, draws, chains):
    """Sampler of a trustbo model, latent trust integrated out, with a dense mass matrix."""
    return _sampler(model, True, model.dims, (awareness, rates), warmup, draws, chains)


def joint(awareness, rates, *, centred, warmup, draws, chains):
    """Sampler of the pooled model with latent trust as parameters; dense mass for the others."""
    model = partial(pooled_joint, centred=centred)
    return _sampler(model, [NAMES], NAMES, (awareness, rates), warmup, draws, chains)


def _sampler(model, dense_mass, names, args, warmup, draws, chains):
    # One object for all calls, and a progress bar, unseen: without one, numpyro 0.22 under JAX 0.12
    # compiles its loop anew for every chain. What finds the chains' starts it always compiles anew.
    mcmc = MCMC(
        NUTS(model, dense_mass=dense_mass),
        num_warmup=warmup,
        num_samples=draws,
        num_chains=chains,
        chain_method="sequential",
        progress_bar=True,
        jit_model_args=True,
    )

    def sampler(seed):
        with jax.enable_x64(True), contextlib.redirect_stderr(io.StringIO()):
            mcmc.run(jax.random.key(seed), *args)
            results = mcmc.get_samples(group_by_chain=True)
            return {name: np.asarray(results[name]) for name in names}

    return sampler


def pooled_joint(awareness, rates, *, centred):
    """The pooled model as one would write it down."""
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
    beta = numpyro.sample("beta", dist.Normal(0.0, 1.0).expand([awareness.shape[-1]]).to_event(1))
    b = numpyro.sample("b", dist.Normal(0.0, 0.5))
    delta_w = numpyro.sample("delta_w", dist.HalfNormal(0.2))
    delta_v = numpyro.sample("delta_v", dist.HalfNormal(0.2))
    drift = awareness @ beta + b
    each = dist.Normal(0.0, 1.0).expand(drift[:, 0].shape).to_event(2)
    x = 0.5 + 0.5 * numpyro.sample("x_0", each)
    for k in range(rates.shape[1]):
        ahead = beta0 * x + drift[:, k]
        if centred:
            x = numpyro.sample(f"x_{k + 1}", dist.Normal(ahead, delta_w).to_event(2))
        else:
            x = ahead + delta_w * numpyro.sample(f"x_{k + 1}", each)
        numpyro.sample(f"y_{k + 1}", dist.Normal(x, delta_v).to_event(2), obs=rates[:, k])
