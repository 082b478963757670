"""A Gibbs sampler of the pooled model in NumPy: trust and parameters by turns."""

import numpy as np

CHAINS, WARMUP = 4, 500


def pooled(awareness, rates, sweeps):
    """Sampler of `sweeps` draws per chain; all chains side by side."""
    # (bound, sequence[, feature]): one row per robot and mission.
    z = np.moveaxis(awareness, 1, 0).reshape(awareness.shape[1], -1, awareness.shape[3])
    y = np.moveaxis(rates, 1, 0).reshape(len(z), -1)
    u = np.concatenate([z, np.ones((*y.shape, 1))], axis=-1)

    def sampler(seed):
        rng = np.random.default_rng(seed)
        c = rng.normal(0.0, 0.2, (CHAINS, u.shape[-1]))
        beta0, (Q, R) = rng.uniform(0.2, 0.8, CHAINS), rng.uniform(0.02, 0.1, (2, CHAINS)) ** 2
        kept = []
        for sweep in range(WARMUP + sweeps):
            x = draw_trust(rng, y, u, beta0, c, Q, R)
            beta0, c = draw_coefficients(rng, x, u, beta0, c, Q)
            moved = x[1:] - beta0[:, None] * x[:-1] - np.einsum("ksc,nc->kns", u, c)
            Q = draw_variance(rng, moved, Q)
            R = draw_variance(rng, y[:, None] - x[1:], R)
            if sweep >= WARMUP:
                kept.append((beta0, c, np.sqrt(Q), np.sqrt(R)))
        beta0_, c_, delta_w, delta_v = (
            np.swapaxes(np.array(a), 0, 1) for a in zip(*kept, strict=True)
        )
        parts = {"beta0": beta0_, "beta": c_[..., :-1], "b": c_[..., -1]}
        return parts | {"delta_w": delta_w, "delta_v": delta_v}

    return sampler


def draw_trust(rng, y, u, beta0, c, Q, R):
    """Latent trust (0..bound, chain, sequence) by forward filtering and backward sampling."""
    drift = np.einsum("ksc,nc->kns", u, c)
    m, P = np.full(drift.shape[1:], 0.5), np.full(CHAINS, 0.25)
    means, variances = [m], [P]
    for y_k, drift_k in zip(y, drift, strict=True):
        ahead = beta0**2 * P + Q
        gain = ahead / (ahead + R)
        m = beta0[:, None] * m + drift_k
        m = m + gain[:, None] * (y_k - m)
        P = (1.0 - gain) * ahead
        means.append(m)
        variances.append(P)
    noise = rng.standard_normal((len(means), *m.shape))
    x = [m + np.sqrt(P)[:, None] * noise[-1]]
    for k in range(len(y) - 1, -1, -1):
        m, P = means[k], variances[k]
        G = P * beta0 / (beta0**2 * P + Q)
        m = m + G[:, None] * (x[-1] - beta0[:, None] * m - drift[k])
        x.append(m + np.sqrt((1.0 - G * beta0) * P)[:, None] * noise[k])
    return np.array(x[::-1])


def draw_coefficients(rng, x, u, beta0, c, Q):
    """(beta0, c) given trust: the normal draw of a flat beta0, accepted for its Beta(2, 2)."""
    features = np.broadcast_to(u[:, None], (*x[1:].shape, u.shape[-1]))
    A = np.concatenate([x[:-1, ..., None], features], axis=-1)
    prior = np.append(0.0, np.append(np.ones(u.shape[-1] - 1), 4.0))  # precisions: beta, then b
    precision = np.einsum("knsi,knsj->nij", A, A, optimize=True) / Q[:, None, None]
    precision += np.diag(prior)
    rhs = np.einsum("knsi,kns->ni", A, x[1:], optimize=True) / Q[:, None]
    L = np.linalg.cholesky(precision)
    mean = np.linalg.solve(precision, rhs[..., None])
    spread = np.linalg.solve(np.swapaxes(L, 1, 2), rng.standard_normal(mean.shape))
    drawn = (mean + spread)[..., 0]
    proposed = drawn[:, 0]
    density = np.where((proposed > 0.0) & (proposed < 1.0), proposed * (1.0 - proposed), 0.0)
    accept = rng.random(CHAINS) * beta0 * (1.0 - beta0) < density
    return np.where(accept, proposed, beta0), np.where(accept[:, None], drawn[:, 1:], c)


def draw_variance(rng, residual, variance):
    """A noise given its values: the inverse gamma of a flat sd, accepted for HalfNormal(0.2)."""
    n, squares = residual.shape[0] * residual.shape[2], (residual**2).sum((0, 2))
    proposed = 0.5 * squares / rng.gamma(0.5 * (n - 1), size=CHAINS)
    accept = np.log(rng.random(CHAINS)) < (variance - proposed) / (2.0 * 0.2**2)
    return np.where(accept, proposed, variance)
