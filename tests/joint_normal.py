"""The reference of every evidence of Gaussian rates: the joint normal of all of them, written out.

Trust is a linear function of x_0, process noise and coefficients, solved bound by bound from its
recursion; the covariance of the rates is formed and factored. It needs the cube of their number,
takes any model and any columns, and shares no step with `inference.engine`.
"""

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal


class Dense:
    """Joint normal of all rates and coefficients, for one theta of arrays (1, ...)."""

    def __init__(self, model, observations, theta):
        """Form the joint normal."""
        n_missions, K, R = observations.contact_rate.shape
        U = np.concatenate([e.design(observations).toarray() for e in model.terms], axis=1)
        U = U.reshape(n_missions, K, R, -1)
        means, precisions = [], []
        for effect in model.terms:
            mean, parts = effect.prior(theta, observations)
            precisions += [part[0] if part.ndim == 3 else np.diag(part[0]) for part in parts]
            means.append(np.zeros(sum(p.shape[1] for p in parts)) if mean is None else mean[0])
        self.prior_mean = np.concatenate(means)
        self.prior_cov = block_diag(*(np.linalg.inv(Q) for Q in precisions))
        B0, Q, noise = _matrices(theta, R)
        x0 = np.full(R, model.x0["x0_mean"])
        mean, cov, of_c = [], [], []
        for u in U:
            # Trust is mean + of_c c + of_noise e: x_0, then process noise, then rates' noise.
            m, A, E = x0, np.zeros((R, U.shape[3])), np.zeros((R, R + 2 * K * R))
            E[:, :R] = model.x0["x0_sd"] * np.eye(R)
            rates = []
            for k in range(K):
                m, A, E = B0 @ m, B0 @ A + u[k], B0 @ E
                if model.memory == "deviation":
                    m = m - (B0 @ x0 if k == 0 else 0.0)
                    A = A - (B0 @ u[k - 1] if k else 0.0)
                E[:, R + k * R : R + (k + 1) * R] += np.linalg.cholesky(Q)
                measured = E.copy()
                measured[:, R + (K + k) * R : R + (K + k + 1) * R] += np.linalg.cholesky(noise)
                mean.append(m)
                of_c.append(A)
                rates.append(measured)
            rates = np.concatenate(rates)
            cov.append(rates @ rates.T)
        self.seen = ~np.isnan(observations.contact_rate.ravel())
        self.y = observations.contact_rate.ravel()[self.seen]
        self.of_c = np.concatenate(of_c)[self.seen]
        self.mean = np.concatenate(mean)[self.seen] + self.of_c @ self.prior_mean
        cov = block_diag(*cov)[np.ix_(self.seen, self.seen)]
        self.cov = cov + self.of_c @ self.prior_cov @ self.of_c.T

    def log_density(self):
        """Log density of the rates, in nats."""
        return multivariate_normal(self.mean, self.cov).logpdf(self.y)

    def coefficients(self):
        """Mean and covariance of the coefficients given the rates."""
        cross = self.prior_cov @ self.of_c.T
        gain = np.linalg.solve(self.cov, cross.T).T
        return self.prior_mean + gain @ (self.y - self.mean), self.prior_cov - gain @ cross.T


def _matrices(theta, R):
    """B0, and covariances of process noise and of rates' noise."""
    if "B0" in theta:
        return tuple(theta[name][0] for name in ("B0", "Delta_w", "Delta_v"))
    shared = theta["delta_s"][0] ** 2 if "delta_s" in theta else 0.0
    noise = theta["delta_v"][0] ** 2 * np.eye(R) + shared
    return theta["beta0"][0] * np.eye(R), theta["delta_w"][0] ** 2 * np.eye(R), noise
