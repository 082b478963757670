"""The posterior of hyperparameters of partially pooled robots whose rates are not Gaussian.

The scores are those of `hierarchical_target`: of the mean of beta0, the noises, the spreads, and
each robot's beta0. Given these, the coefficients c_i of all robots are jointly normal a priori,
with the covariance tau^2 I + s^2 11' of each coefficient, s being the prior sd of its mean. Their
chains of rates share them only within a robot, and expectation propagation integrates them out
together with trust (`ep.joint`); draws of them have weights that make it exact (`ep.draws`). The
means follow from the coefficients in closed form.
"""

import numpy as np

from trustbo.inference.evidence.ep import joint
from trustbo.inference.evidence.ep.draws import draw_weighted
from trustbo.inference.evidence.sites import SWEEPS
from trustbo.inference.samplers.hierarchical_target import HierarchicalScores
from trustbo.models.priors import Priors

_SETTLED = 8  # sweeps to find the sites' mode
_LEAST_TAU = 1e-4  # far below the scale of data, but precisions do not cancel
_LEAST_NOISE = 1e-6


class LatentHierarchicalTarget(HierarchicalScores):
    """Log posterior density of the scores, by expectation propagation."""

    n_pilot, n_final, n_corrected = 512, 1024, 1000
    log_sizes, steps = np.array([-2.2, -1.2, -0.2, 0.6]), (2, 2, 2)

    def __init__(
        self, chains: joint.Chains, sites: np.ndarray, priors: Priors, n_robots: int
    ) -> None:
        """Take the chains of `gather_chains(..., apart=True)`, sites to begin with, the priors."""
        super().__init__(priors, n_robots, chains.u.shape[2] - 1)
        self.chains, self._sites = chains, sites
        self._x0 = np.array([priors.x0_mean, priors.x0_sd], dtype=float)
        self._nu = max(8.0, 3.0 * n_robots * self.n_coefficients)

    def recentre(self, z: np.ndarray) -> None:
        """Recentre the sites, and the normal approximation of each robot's beta0, at one point."""
        theta, _ = self.constrain(z[None])
        (beta0, delta_w, delta_v, x0, P, g), _ = self._given(theta)
        fixed = x0, P[0], g[0], self.chains, self._sites
        self._sites = joint.settle(beta0[0], delta_w[0], delta_v[0], *fixed, _SETTLED)
        super().recentre(z)

    def log_likelihood(self, theta: dict[str, np.ndarray]) -> np.ndarray:
        """See `HierarchicalScores.log_likelihood`; by EP."""
        noises = theta["delta_w"], theta["delta_v"]
        ok = np.all([np.isfinite(noise) & (noise > _LEAST_NOISE) for noise in noises], axis=0)
        ok &= np.isfinite(theta["beta0"]).all(1)
        out = np.full(len(ok), -np.inf)
        given, log_det = self._given({name: values[ok] for name, values in theta.items()})
        value = joint.log_evidence(*given, self.chains, self._sites, SWEEPS)
        out[ok] = value + 0.5 * log_det
        return out

    def of_beta0(self, i: int, grid: np.ndarray, theta: dict[str, np.ndarray]) -> np.ndarray:
        """See `HierarchicalScores.of_beta0`."""
        many = {name: np.repeat(values, len(grid), axis=0) for name, values in theta.items()}
        many["beta0"][:, i] = grid
        return self.log_likelihood(many)

    def draw(
        self, z: np.ndarray, log_p: np.ndarray, chosen: np.ndarray, rng: np.random.Generator
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Parameters at the points of sorted indices, and the log weight of each draw."""
        unique, count = np.unique(chosen, return_counts=True)
        theta, log_prior = self.constrain(z[unique])
        given, log_det = self._given(theta)
        of_point = ((given[0][t], given[1][t], given[2][t], given[3], given[4][t], given[5][t])
                    for t in range(len(unique)))  # fmt: skip
        fixed = self.chains, self._sites, SWEEPS
        c, log_weight = draw_weighted(of_point, count, self._nu, *fixed, rng)
        log_weight += np.repeat(log_prior + 0.5 * log_det, count) - log_p[chosen]
        theta = {name: np.repeat(values, count, axis=0) for name, values in theta.items()}
        c = c.reshape(len(c), self.n_robots, self.n_coefficients)
        tau = self._tau(theta)
        mean, precision = self.of_means(theta)
        information = precision + self.n_robots / tau**2
        mu = (precision * mean + c.sum(1) / tau**2) / information
        mu += rng.standard_normal(mu.shape) / np.sqrt(information)
        return self.name_draws(theta, mu, c), log_weight

    def _tau(self, theta: dict[str, np.ndarray]) -> np.ndarray:
        return np.maximum(theta["tau"], _LEAST_TAU)

    def _given(self, theta: dict[str, np.ndarray]):
        """Arguments of the kernels at theta, and log |P| of the prior precision."""
        n_robots, p = self.n_robots, self.n_coefficients
        mean, precision = self.of_means(theta)  # (point, coefficient)
        information = self._tau(theta) ** -2.0
        total = precision + n_robots * information
        # Of tau^2 I + s^2 11' the inverse is I / tau^2 - 11' / tau^4 / (1 / s^2 + n / tau^2).
        P = np.zeros((len(information), n_robots, p, n_robots, p))
        for k in range(p):
            P[:, :, k, :, k] = -(information[:, k] ** 2 / total[:, k])[:, None, None]
            P[:, np.arange(n_robots), k, np.arange(n_robots), k] += information[:, k, None]
        P = P.reshape(len(information), n_robots * p, n_robots * p)
        log_det = (np.log(precision) - np.log(total) + n_robots * np.log(information)).sum(1)
        beta0 = self.from_line(theta["beta0"])
        return (
            beta0, theta["delta_w"], theta["delta_v"], self._x0, P, np.tile(mean, n_robots),
        ), log_det  # fmt: skip
