"""The reference of every evidence of Gaussian rates: the joint normal of all of them, written out.

Trust is a linear function of x_0, process noise and coefficients, solved bound by bound from its
recursion; the covariance of the rates is formed and factored. It needs the cube of their number,
takes any columns, and shares no step with `gaussian`.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from trustbo.models.effects.effect import Group, Slots, Theta, dense_root


class Dense:
    """Joint normal of all rates, for one theta."""

    def __init__(
        self,
        slots: Slots,
        groups: Sequence[Group],
        theta: Theta,
        x0: tuple[float, float] = (0.5, 0.5),
        memory: str = "level",
    ) -> None:
        """Form the joint normal; `theta` has one point, of beta0 maybe (point, robot)."""
        (delta_w,), (delta_v,) = (theta[name] for name in ("delta_w", "delta_v"))
        of_robot = np.resize(theta["beta0"][0], slots.n_robots)
        n_chains, K = slots.y.shape
        U = np.concatenate([group.columns.toarray() for group in groups], axis=1)
        m = U.shape[1]
        # Each row of x: its mean, and its weights of coefficients, x_0 - E x_0, and process noise.
        mean, of_c = np.zeros((n_chains, K)), np.zeros((n_chains, K, m))
        of_noise = np.zeros((n_chains, K, n_chains, K + 1))
        for c, u in enumerate(U.reshape(n_chains, K, m)):
            last_mean, last_c, last_noise = x0[0], np.zeros(m), np.zeros((n_chains, K + 1))
            last_noise[c, 0], beta0 = x0[1], of_robot[slots.robot[c]]
            for k in range(K):
                last_mean, last_c, last_noise = (
                    beta0 * last_mean,
                    beta0 * last_c,
                    beta0 * last_noise,
                )
                last_c = last_c + u[k]
                if memory == "deviation":
                    last_c = last_c - (beta0 * u[k - 1] if k else 0.0)
                    last_mean -= 0.0 if k else beta0 * x0[0]
                last_noise = last_noise.copy()
                last_noise[c, k + 1] = delta_w
                mean[c, k], of_c[c, k], of_noise[c, k] = last_mean, last_c, last_noise
        priors = [group.prior(theta) for group in groups]
        self.prior_mean = np.concatenate([np.broadcast_to(p.mean, p.sd.shape)[0] for p in priors])
        self.prior_cov = np.zeros((m, m))
        start = 0
        for group, prior in zip(groups, priors, strict=True):
            n = prior.sd.shape[1]
            root = np.eye(n)
            for columns, one in zip(group.joined, prior.roots, strict=True):
                root[columns, columns] = dense_root(one)[0]
            root = prior.sd[0][:, None] * root
            self.prior_cov[start : start + n, start : start + n] = root @ root.T
            start += n
        seen = ~np.isnan(slots.y)
        self._of_c, noise = of_c[seen], of_noise[seen].reshape(seen.sum(), -1)
        self._off = slots.y[seen] - mean[seen] - self._of_c @ self.prior_mean
        # A chain counts by its density to the power of its weight w: N(V / w) and a constant.
        V = noise @ noise.T + delta_v**2 * np.eye(len(noise))
        w = np.broadcast_to(slots.weight[:, None], seen.shape)[seen]
        cov = self._of_c @ self.prior_cov @ self._of_c.T + V / np.sqrt(w[:, None] * w)
        self._factor = cho_factor(cov, lower=True)
        self._constant = -0.5 * (np.log(w) + w * np.log(2.0 * np.pi)).sum()
        for weight, mine in zip(slots.weight, _chains(seen), strict=True):
            self._constant += 0.5 * (1.0 - weight) * np.linalg.slogdet(V[np.ix_(mine, mine)])[1]

    def log_density(self) -> float:
        """Log density of the rates, in nats."""
        misfit = self._off @ cho_solve(self._factor, self._off)
        log_det = 2.0 * np.log(np.diag(self._factor[0])).sum()
        return float(self._constant - 0.5 * (misfit + log_det))

    def coefficients(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance of the coefficients given the rates."""
        cross = self.prior_cov @ self._of_c.T
        gain = cho_solve(self._factor, cross.T).T
        return self.prior_mean + gain @ self._off, self.prior_cov - gain @ cross.T


def _chains(seen: np.ndarray) -> list[np.ndarray]:
    """Indices of the rates of each chain among all measured ones."""
    return np.split(np.arange(seen.sum()), np.cumsum(seen.sum(1))[:-1])
