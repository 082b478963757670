"""PyMC models of the pooled and the coupled form, sampled by nutpie.

The Kalman filters are written out in PyTensor: unrolled over bounds, all sequences side by side,
with one variance for all, since no rate is missing.
"""

import os
import tempfile

# PyTensor keeps compiled code on disk; an empty folder makes a first call what it says it is.
os.environ.setdefault("PYTENSOR_FLAGS", f"base_compiledir={tempfile.mkdtemp(prefix='pytensor')}")

import numpy as np
import nutpie
import pymc as pm
import pytensor.tensor as pt

CORES = min(2, len(os.sched_getaffinity(0)))
X0_MEAN, X0_VAR = 0.5, 0.25


def sampler_of(compiled, names=None, *, draws, chains, tune=None, low_rank=False, finish=None):
    """Sampler of a compiled model; `tune` None is nutpie's own choice."""

    def sampler(seed):
        trace = nutpie.sample(
            compiled,
            draws=draws,
            tune=tune,
            chains=chains,
            cores=min(CORES, chains),
            seed=seed,
            adaptation="low_rank" if low_rank else "diag",
            save_warmup=False,
            progress_bar=False,
        )
        posterior = trace["posterior"]
        results = {name: posterior[name].values for name in names or posterior.data_vars}
        return results if finish is None else finish(results)

    return sampler


def compile_model(model, *, with_jax=False):
    """By numba, which takes long and samples fast, or by JAX, which also takes the gradient."""
    if with_jax:
        return nutpie.compile_pymc_model(model, backend="jax", gradient_backend="jax")
    return nutpie.compile_pymc_model(model)


def pooled_priors(n_features):
    beta0 = pm.Beta("beta0", 2.0, 2.0)
    beta = pm.Normal("beta", 0.0, 1.0, shape=n_features)
    b = pm.Normal("b", 0.0, 0.5)
    return beta0, beta, b, pm.HalfNormal("delta_w", 0.2), pm.HalfNormal("delta_v", 0.2)


def by_bound(awareness, rates):
    """(bound, sequence, feature) and (bound, sequence), one sequence per robot and mission."""
    n_bounds, n_features = awareness.shape[1], awareness.shape[3]
    z = np.moveaxis(awareness, 1, 0).reshape(n_bounds, -1, n_features)
    return z, np.moveaxis(rates, 1, 0).reshape(n_bounds, -1)


def pooled_marginal(awareness, rates):
    z, y = by_bound(awareness, rates)
    n = y.shape[1]
    with pm.Model() as model:
        z, y_seen = pm.Data("z", z), pm.Data("y", y)
        beta0, beta, b, delta_w, delta_v = pooled_priors(awareness.shape[3])
        drift = z @ beta + b
        Q, R = delta_w**2, delta_v**2
        m, P, total = pt.full((n,), X0_MEAN), X0_VAR, 0.0
        for k in range(len(y)):
            m, P = beta0 * m + drift[k], beta0**2 * P + Q
            e, S = y_seen[k] - m, P + R
            total += -0.5 * ((e**2).sum() / S + n * pt.log(2.0 * np.pi * S))
            gain = P / S
            m, P = m + gain * e, (1.0 - gain) * P
        pm.Potential("rates", total)
    return model


def pooled_joint(awareness, rates):
    """Latent trust as parameters, non-centred."""
    z, y = by_bound(awareness, rates)
    with pm.Model() as model:
        z, y_seen = pm.Data("z", z), pm.Data("y", y)
        beta0, beta, b, delta_w, delta_v = pooled_priors(awareness.shape[3])
        drift = z @ beta + b
        noise = pm.Normal("noise", 0.0, 1.0, shape=(len(y) + 1, y.shape[1]))
        x, path = X0_MEAN + np.sqrt(X0_VAR) * noise[0], []
        for k in range(len(y)):
            x = beta0 * x + drift[k] + delta_w * noise[k + 1]
            path.append(x)
        pm.Normal("rates", pt.stack(path), delta_v, observed=y_seen)
    return model


def coupled_marginal(awareness, rates):
    n_missions, n_bounds, n, n_features = awareness.shape
    diagonal, off = np.arange(n), np.nonzero(~np.eye(n, dtype=bool))
    with pm.Model() as model:
        z, y = pm.Data("z", np.moveaxis(awareness, 1, 0)), pm.Data("y", np.moveaxis(rates, 1, 0))
        own = pm.Beta("B0_diagonal", 2.0, 2.0, shape=n)
        others = pm.Normal("B0_coupling", 0.0, 0.1, shape=n * (n - 1))
        B0 = pt.zeros((n, n))[diagonal, diagonal].set(own)[off].set(others)
        own = pm.Normal("B_diagonal", 0.0, 1.0, shape=(n_features, n))
        others = pm.Normal("B_coupling", 0.0, 0.1, shape=(n_features, n * (n - 1)))
        B = pt.zeros((n_features, n, n))[:, diagonal, diagonal].set(own)
        B = B[:, off[0], off[1]].set(others)
        b = pm.Normal("b", 0.0, 0.5, shape=n)
        Q, R = (covariance(f"Delta_{noise}", n) for noise in "wv")
        drift = b + sum(z[..., f] @ B[f].T for f in range(n_features))
        m, P, total = pt.full((n_missions, n), X0_MEAN), X0_VAR * pt.eye(n), 0.0
        for k in range(n_bounds):
            m, P = m @ B0.T + drift[k], B0 @ P @ B0.T + Q
            L = pt.linalg.cholesky(P + R)
            white = pt.linalg.solve_triangular(L, (y[k] - m).T, lower=True)
            gain = pt.linalg.solve_triangular(L, P, lower=True)
            total += -0.5 * (white**2).sum() - n_missions * pt.log(pt.diag(L)).sum()
            m, P = m + white.T @ gain, P - gain.T @ gain
        pm.Potential("rates", total)
    return model


def covariance(name, n):
    packed = pm.LKJCholeskyCov(
        name, n=n, eta=2.0, sd_dist=pm.HalfNormal.dist(0.2), compute_corr=False
    )
    factor = pm.expand_packed_triangular(n, packed)
    return factor @ factor.T


def coupled_matrices(results):
    """Sites of the coupled model as its parameters."""
    n = results["b"].shape[-1]
    diagonal, off, lower = np.arange(n), np.nonzero(~np.eye(n, dtype=bool)), np.tril_indices(n)

    def matrix(name):
        own, others = results[f"{name}_diagonal"], results[f"{name}_coupling"]
        full = np.zeros((*own.shape, n))
        full[..., diagonal, diagonal] = own
        full[..., off[0], off[1]] = others
        return full

    params = {"B0": matrix("B0"), "B": matrix("B"), "b": results["b"]}
    for name in ("Delta_w", "Delta_v"):
        factor = np.zeros((*results[name].shape[:-1], n, n))
        factor[..., lower[0], lower[1]] = results[name]
        params[name] = factor @ np.swapaxes(factor, -1, -2)
    return params
