"""Scores of robots whose parameters are drawn from a common distribution.

For I robots and p linear coefficients, 4 + p + I scores: of mean_beta0, of the two noises, of the
spreads tau_beta0 and tau of each coefficient, and of each robot's beta0; three robots and two
features make ten. Those of effects follow.

mean_beta0 and beta0_i are not scores of their priors, as a small tau would make these a funnel. On
the real line, the likelihood of robot i's beta0 is approximated by a normal, fitted on a grid at
the mode of the noises. Given tau_beta0 the score of the mean is standard normal under these
likelihoods, and so is that of each robot given the mean and tau_beta0 (partially non-centred:
Papaspiliopoulos, Roberts and Skold 2007). This only moves coordinates; the density keeps the
priors.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import jax
import numpy as np
from numpyro.distributions import constraints
from scipy import special

from trustbo.inference.samplers import scores
from trustbo.models.backend import namespace
from trustbo.models.effects.effect import Effect, Theta, scales_of
from trustbo.models.priors import Priors
from trustbo.models.priors_numpy import log_prob

_WIDE = 0.01  # variance added to a grid's estimate of a robot's beta0
_LEAST_TAU = 1e-6


class _Memory(NamedTuple):
    """Memory at scores, on the real line."""

    mean: np.ndarray  # (point,)
    beta0: np.ndarray  # (point, robot)
    tau: np.ndarray  # (point,)
    given_tau: tuple[np.ndarray, np.ndarray]  # mean and sd of the mean, each (point,)
    given_mean: tuple[np.ndarray, np.ndarray]  # of each robot's, (point, robot)


@scores.with_data("quantiles", "_beta0", "_prior", "_center", "_var")
class PerRobot(scores.Scores):
    """Scores of each robot's beta0, of its mean and spread, of noises and of spreads of weights."""

    fixed, pools = False, True

    def __init__(
        self, priors: Priors, effects: Sequence[Effect], n_robots: int, n_features: int
    ) -> None:
        """Take the priors, and effects other than the weights."""
        self._beta0, self.n_robots, self._n_tau = priors.beta0, n_robots, n_features + 2
        self.n_core = 3 + self._n_tau + n_robots
        super().__init__(priors, effects)
        self._unit = priors.beta0.support is constraints.unit_interval
        low, middle, high = self._to_line(scores.quantile(priors.beta0, np.array([-1.0, 0.0, 1.0])))
        self._prior = middle, (2.0 / (high - low)) ** 2
        self._center, self._var = np.full(n_robots, middle), np.ones(n_robots)

    def theta(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """See `Scores.theta`; beta0 is (point, robot), tau_beta (point, feature)."""
        _, delta_w, delta_v = self.quantiles.core(z).T
        memory, tau = self._memory(z), self._tau(z)
        mean = self._from_line(memory.mean)
        return {
            "beta0": self._from_line(memory.beta0),
            "delta_w": delta_w,
            "delta_v": delta_v,
            "mean_beta0": mean,
            "tau_beta0": memory.tau,
            "tau_beta": tau[:, 1:-1],
            "tau_b": tau[:, -1],
            "rest": 1.0 - mean,
            **scales_of(self.effects, z[:, self.n_core :]),
        }

    def log_prior(self, z: np.ndarray) -> np.ndarray:
        """See `Scores.log_prior`."""
        memory, n, xp = self._memory(z), 3 + self._n_tau, cast(Any, namespace(z))
        value = scores.log_prior(z[:, :n]) + 0.5 * z[:, 0] ** 2 + scores.LOG_ROOT_2PI
        value += scores.log_normal_density(z[:, self.n_core :])
        value += self._log_prior_of_mean(memory.mean) + xp.log(memory.given_tau[1])
        value += scores.log_normal_density(
            (memory.beta0 - memory.mean[:, None]) / memory.tau[:, None]
        )
        return value + (xp.log(memory.given_mean[1]) - xp.log(memory.tau)[:, None]).sum(1)

    def recentre(self, z: np.ndarray, log_density: Callable[[Theta], np.ndarray]) -> np.ndarray:
        """Refit the normal approximation of each robot's beta0 at the other parameters of z."""
        theta, memory = self.theta(z[None]), self._memory(z[None])
        grid = np.linspace(-3.5, 4.5, 49) if self._unit else np.linspace(-1.5, 1.5, 49)
        many = {name: np.repeat(values, len(grid), axis=0) for name, values in theta.items()}
        for i in range(self.n_robots):
            beta0 = np.repeat(theta["beta0"], len(grid), axis=0)
            beta0[:, i] = self._from_line(grid)
            value = np.nan_to_num(log_density(many | {"beta0": beta0}), nan=-np.inf)
            weight = np.exp(value - value.max())
            weight /= weight.sum()
            self._center[i] = weight @ grid
            self._var[i] = weight @ (grid - self._center[i]) ** 2 + _WIDE
        again, new = z.copy(), self._memory(z[None])
        again[0] = (memory.mean[0] - new.given_tau[0][0]) / new.given_tau[1][0]
        center, sd = self._given_mean(memory.mean, memory.tau)
        again[self.n_core - self.n_robots : self.n_core] = ((memory.beta0 - center) / sd)[0]
        return again

    def _memory(self, z: np.ndarray) -> _Memory:
        """Memory at scores (point, score)."""
        xp: Any = namespace(z)
        tau = xp.maximum(self._tau(z)[:, 0], _LEAST_TAU)
        information = 1.0 / (self._var + tau[:, None] ** 2)
        middle, precision = self._prior
        var = 1.0 / (information.sum(1) + precision)
        center = var * ((information * self._center).sum(1) + precision * middle)
        mean = center + xp.sqrt(var) * z[:, 0]
        given_mean = self._given_mean(mean, tau)
        own = z[:, self.n_core - self.n_robots : self.n_core]
        beta0 = given_mean[0] + given_mean[1] * own
        return _Memory(mean, beta0, tau, (center, xp.sqrt(var)), given_mean)

    def _given_mean(self, mean: np.ndarray, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and sd of each robot's beta0 given their mean and spread, (point, robot)."""
        xp: Any = namespace(tau)
        spread = tau[:, None] ** 2
        v = 1.0 / (1.0 / self._var + 1.0 / spread)
        return v * (self._center / self._var + mean[:, None] / spread), xp.sqrt(v)

    def _tau(self, z: np.ndarray) -> np.ndarray:
        """Spreads of beta0, weights and intercepts (point, spread)."""
        return self.quantiles.tau(z[:, 3 : 3 + self._n_tau])

    def _log_prior_of_mean(self, mean: np.ndarray) -> np.ndarray:
        """Log prior density of mean_beta0 on the real line."""
        log_density = log_prob(self._beta0, self._from_line(mean))
        if not self._unit:
            return log_density
        xp: Any = namespace(mean)
        return log_density - xp.logaddexp(0.0, -mean) - xp.logaddexp(0.0, mean)

    def _to_line(self, beta0: np.ndarray) -> np.ndarray:
        return special.logit(beta0) if self._unit else beta0

    def _from_line(self, x: np.ndarray) -> np.ndarray:
        expit = special.expit if namespace(x) is np else jax.nn.sigmoid
        return cast(np.ndarray, expit(x)) if self._unit else x
