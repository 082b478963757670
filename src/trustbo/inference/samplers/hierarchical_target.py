"""The posterior of hyperparameters of partially pooled robots with Gaussian rates.

Given beta0_i of each robot and the noises, each robot's rates are a quadratic form in its weights
and intercept c_i (`gram`). With c_i = mu + D e_i, D = diag(tau), e_i ~ N(0, 1) and a normal prior
of mu, first e_i and then mu integrate out in closed form. The remaining unknowns are, for I robots
and p of these coefficients, 4 + p + I scores: of mean_beta0, of the two noises, of the spreads
tau_beta0 and tau, and of each beta0_i; three robots and two features make ten.

mean_beta0 and beta0_i are not scores of their priors, as a small tau would make these a funnel. On
the real line, the likelihood of robot i's beta0 is approximated by a normal, fitted on a grid at
the mode of the noises. Given tau_beta0 the score of the mean is standard normal under these
likelihoods, and so is that of each robot given the mean and tau_beta0 (partially non-centred:
Papaspiliopoulos, Roberts and Skold 2007). This only moves coordinates; the target keeps the priors.
"""

from abc import ABC, abstractmethod

import numpy as np
from numpyro.distributions import constraints
from scipy import special

from trustbo.inference.evidence.gram import Statistics
from trustbo.inference.samplers import scores
from trustbo.inference.samplers.laplace import laplace
from trustbo.inference.samplers.small_matrices import backward, forward, small_cholesky
from trustbo.inference.samplers.student import Spanning, Student
from trustbo.models.priors import Priors
from trustbo.models.priors_numpy import log_prob, of_coefficients

_WIDE = 0.01  # variance added to a grid's estimate of a robot's beta0
_LEAST_TAU = 1e-6


class HierarchicalScores(ABC):
    """Log posterior density of the scores, for any likelihood given these."""

    n_pilot, widths = 1024, (1.1, 1.05)
    n_final: int
    """Points of the last proposal."""
    n_corrected: int | None
    log_sizes: np.ndarray
    """Scores of the size of the noises to search the mode from."""
    steps: tuple[int, ...]
    """Newton's steps before coordinates move to the mode, time after time."""

    def __init__(self, priors: Priors, n_robots: int, n_features: int) -> None:
        """Take the priors."""
        self.priors = priors
        self.n_robots, self.n_coefficients = n_robots, n_features + 1
        self.mean, self.precision = of_coefficients(priors.beta, priors.b, n_features)
        self._unit = priors.beta0.support is constraints.unit_interval
        low, middle, high = self.to_line(scores.quantile(priors.beta0, np.array([-1.0, 0.0, 1.0])))
        self._prior = middle, (2.0 / (high - low)) ** 2
        self._center, self._var = np.full(self.n_robots, middle), np.ones(self.n_robots)

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Log posterior density of scores (point, score), shape (point,)."""
        with np.errstate(all="ignore"):  # far out noises under- and overflow: no density there
            theta, log_prior = self.constrain(z)
            value = self.log_likelihood(theta) + log_prior
        return np.where(np.isfinite(value), value, -np.inf)

    @abstractmethod
    def log_likelihood(self, theta: dict[str, np.ndarray]) -> np.ndarray:
        """Log likelihood at hyperparameters, coefficients integrated out, (point,)."""

    @abstractmethod
    def of_beta0(self, i: int, grid: np.ndarray, theta: dict[str, np.ndarray]) -> np.ndarray:
        """Log likelihood, up to a constant, of robot i's beta0 on a grid, (point,).

        Other parameters are those of theta, with one point.
        """

    def first(self) -> Student:
        """Gaussian fit at the best mode, found from the best of a grid of noises."""
        axes = np.meshgrid(self.log_sizes, [-0.8, 0.0, 0.8], indexing="ij")
        grid = np.stack(axes, axis=-1).reshape(-1, 2)
        z = np.zeros((len(grid), 4 + self.n_coefficients + self.n_robots))
        z[:, 1:3] = grid
        self.recentre(z[len(z) // 2])
        z = z[[self.log_density(z).argmax()]]
        scale = np.eye(z.shape[1])[None]
        for n_steps in self.steps:  # the coordinates depend on the noises
            self.recentre(z[0])
            z[:, 0], z[:, -self.n_robots :] = 0.0, 0.0
            z, _, scale = laplace(self.log_density, z, n_steps)
        return Student(z[0], scale[0])

    def defensive(self, proposal: Student) -> Spanning:
        """Proposal that spans all angles between the two noises."""
        return Spanning.of(proposal, 2, widen=1.2)

    def constrain(self, z: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Hyperparameters of scores, beta0 on the real line, and the log prior density."""
        p, priors = self.n_coefficients, self.priors
        _, delta_w, delta_v = scores.beta0_and_noises(priors, np.insert(z[:, 1:3], 0, 0.0, 1)).T
        tau = np.maximum(scores.quantile(priors.tau, z[:, 3 : 4 + p]), _LEAST_TAU)
        spread = tau[:, :1] ** 2
        information = 1.0 / (self._var + spread)
        middle, precision = self._prior
        var = 1.0 / (information.sum(1) + precision)
        mean = (
            var * ((information * self._center).sum(1) + precision * middle)
            + np.sqrt(var) * z[:, 0]
        )
        v = 1.0 / (1.0 / self._var + 1.0 / spread)
        center = v * (self._center / self._var + mean[:, None] / spread)
        beta0 = center + np.sqrt(v) * z[:, 4 + p :]
        log_prior = scores.log_prior(z[:, : 4 + p]) + 0.5 * z[:, 0] ** 2 + scores.LOG_ROOT_2PI
        log_prior += self._log_prior_of_mean(mean) + 0.5 * np.log(var) + 0.5 * np.log(v).sum(1)
        log_prior += scores.log_normal_density((beta0 - mean[:, None]) / tau[:, :1])
        log_prior -= self.n_robots * np.log(tau[:, 0])
        named = {"mean": mean, "beta0": beta0, "delta_w": delta_w, "delta_v": delta_v}
        return named | {"tau_beta0": tau[:, 0], "tau": tau[:, 1:]}, log_prior

    def _log_prior_of_mean(self, mean: np.ndarray) -> np.ndarray:
        """Log prior density of mean_beta0 on the real line."""
        log_density = log_prob(self.priors.beta0, self.from_line(mean))
        if not self._unit:
            return log_density
        return log_density + special.log_expit(mean) + special.log_expit(-mean)

    def name_draws(
        self, theta: dict[str, np.ndarray], mu: np.ndarray, c: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Parameters of means (draw, coefficient) and coefficients (draw, robot, coefficient)."""
        return {
            "beta0": self.from_line(theta["beta0"]),
            "beta": c[..., :-1],
            "b": c[..., -1],
            "delta_w": theta["delta_w"],
            "delta_v": theta["delta_v"],
            "mean_beta0": self.from_line(theta["mean"]),
            "mean_beta": mu[:, :-1],
            "mean_b": mu[:, -1],
            "tau_beta0": theta["tau_beta0"],
            "tau_beta": theta["tau"][:, :-1],
            "tau_b": theta["tau"][:, -1],
        }

    def of_means(self, theta: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Prior mean and precision of the coefficients' means, each (point, coefficient)."""
        rest = np.ones_like(theta["mean"])[:, None]
        if self.priors.stationary:
            rest = 1.0 - self.from_line(theta["mean"])[:, None]
        return self.mean * rest, self.precision / rest**2

    def recentre(self, z: np.ndarray) -> None:
        """Refit the normal approximation of each robot's beta0 at the noises of one point."""
        theta, _ = self.constrain(z[None])
        grid = np.linspace(-3.5, 4.5, 49) if self._unit else np.linspace(-1.5, 1.5, 49)
        for i in range(self.n_robots):
            value = self.of_beta0(i, grid, theta)
            weight = np.exp(value - value.max())
            weight /= weight.sum()
            self._center[i] = weight @ grid
            self._var[i] = weight @ (grid - self._center[i]) ** 2 + _WIDE

    def to_line(self, beta0: np.ndarray) -> np.ndarray:
        """Beta0 on the real line."""
        return special.logit(beta0) if self._unit else beta0

    def from_line(self, x: np.ndarray) -> np.ndarray:
        """Beta0 from the real line."""
        return special.expit(x) if self._unit else x


class HierarchicalTarget(HierarchicalScores):
    """Log posterior density of the scores where rates are Gaussian."""

    n_final, n_corrected, steps = 4096, None, (8, 12)

    def __init__(self, statistics: Statistics, priors: Priors) -> None:
        """Take the statistics of each robot, and the priors."""
        super().__init__(priors, len(statistics), statistics[0].n_features)
        self.statistics = statistics
        spread = np.log(np.clip(max(s.spread for s in statistics) / 0.2, 1e-2, 3.0))
        self.log_sizes = spread - np.linspace(0.2, 3.0, 8)

    def log_likelihood(self, theta: dict[str, np.ndarray]) -> np.ndarray:
        """See `HierarchicalScores.log_likelihood`; exact."""
        return self._integrate(theta)[0]

    def of_beta0(self, i: int, grid: np.ndarray, theta: dict[str, np.ndarray]) -> np.ndarray:
        """See `HierarchicalScores.of_beta0`; with the means' prior for the coefficients'."""
        w, v = (np.full(len(grid), theta[name][0]) for name in ("delta_w", "delta_v"))
        q = self._quadratic(self.statistics[i], grid, w, v)
        P = q.P + np.diag(self.precision)
        h = q.h + self.precision * self.mean
        mean = np.linalg.solve(P, h[..., None])[..., 0]
        return -0.5 * (q.alpha + q.log_det - (h * mean).sum(1) + np.linalg.slogdet(P)[1])

    def draw(
        self, z: np.ndarray, log_p: np.ndarray, chosen: np.ndarray, rng: np.random.Generator
    ) -> tuple[dict[str, np.ndarray], None]:
        """Draw parameters at the chosen points; the draws are equally weighted."""
        theta, _ = self.constrain(z[chosen])
        _, (factor, half), robots = self._integrate(theta)
        mu = backward(factor, half + rng.standard_normal(half.shape))  # (coefficient, draw)
        tau = theta["tau"].T
        of_robots = np.stack([
            mu + tau * backward(L, r - (A * mu).sum(1) + rng.standard_normal(mu.shape))
            for L, A, r in robots
        ])  # fmt: skip
        return self.name_draws(theta, mu.T, np.moveaxis(of_robots, -1, 0)), None

    def _integrate(self, theta: dict[str, np.ndarray]):
        """Log likelihood (point,), coefficients integrated out.

        Also returns Cholesky factors and half-solved right sides, (coefficient, ..., point): for
        the precision of mu; and for each robot that of e_i and its dependence on mu.
        """
        beta0, tau = theta["beta0"], theta["tau"].T  # (coefficient, point)
        mean, precision = (moment.T for moment in self.of_means(theta))
        eye = np.eye(self.n_coefficients)[..., None]
        P, h, robots = precision * eye, precision * mean, []
        total = 0.5 * np.log(precision).sum(0) - 0.5 * (precision * mean**2).sum(0)
        for i, statistics in enumerate(self.statistics):
            q = self._quadratic(statistics, beta0[:, i], theta["delta_w"], theta["delta_v"])
            P_i, h_i = q.P.transpose(1, 2, 0), q.h.T
            L = small_cholesky(eye + tau[:, None] * P_i * tau)
            A = np.stack([forward(L, tau * P_i[:, j]) for j in range(len(tau))], axis=1)
            r = forward(L, tau * h_i)
            P = P + P_i - np.einsum("kin,kjn->ijn", A, A, optimize=True)
            h = h + h_i - (A * r[:, None]).sum(0)
            total -= 0.5 * (q.alpha + q.log_det - (r**2).sum(0))
            total -= np.log(np.einsum("kkn->kn", L)).sum(0)
            total -= statistics.n_measured * scores.LOG_ROOT_2PI
            robots.append((L, A, r))
        factor = small_cholesky(P)
        half = forward(factor, h)
        total += 0.5 * (half**2).sum(0) - np.log(np.einsum("kkn->kn", factor)).sum(0)
        return total, (factor, half), robots

    def _quadratic(self, statistics, beta0, delta_w, delta_v):
        theta = np.stack([self.from_line(beta0), delta_w**2, delta_v**2], axis=1)
        return statistics.evaluate(theta, self.priors.x0_sd)
