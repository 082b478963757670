"""Feature weights and intercepts: common to all robots, separate for each robot, or coupled."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from trustbo.models.effects.effect import LEAST, Effect, Theta, Values
from trustbo.models.observations import Observations
from trustbo.models.priors import Priors
from trustbo.statespace.matrices import namespace


@dataclass(frozen=True)
class Weights(Effect):
    """Feature weights and an intercept, with the Normal priors `beta` and `b`."""

    priors: Priors

    def design(self, observations: Observations) -> Any:
        """Return the features and a column of ones."""
        return sparse.csr_array(_inputs(observations))

    def prior(self, theta: Theta, observations: Observations) -> tuple[Any, list[Any]]:
        """Return independent priors on the coefficients, scaled if `Priors.stationary` is true."""
        mean, sd = self.moments(theta, observations)
        return mean, [sd**-2.0]

    def moments(self, theta: Theta, observations: Observations) -> tuple[Any, Any]:
        """Return the prior means and sds (point, [robot,] column) of the coefficients."""
        mean, sd = self.priors.coefficients(observations.awareness.shape[3])
        inverse_gain = theta["inverse_gain"][..., None]
        if not self.priors.stationary:
            inverse_gain = 0.0 * inverse_gain + 1.0  # ones, in NumPy or JAX
        return inverse_gain * mean, inverse_gain * sd

    def to_variables(self, c: np.ndarray, theta: Theta, observations: Observations) -> Values:
        """Return the weights `beta` (draw, feature) and the intercept `b` (draw,)."""
        return {"beta": c[:, :-1], "b": c[:, -1]}

    def coefficients(self, values: Values, theta: Theta, observations: Observations) -> np.ndarray:
        """See `Effect.coefficients`."""
        return np.column_stack([values["beta"], values["b"]])


@dataclass(frozen=True)
class RobotWeights(Weights):
    """Separate coefficients N(mu, tau^2) for each robot; the hyperparameter tau is in theta."""

    def design(self, observations: Observations) -> Any:
        """Return the features and a constant 1 for each robot; the robot varies fastest."""
        values = _inputs(observations)
        mine = np.tile(np.eye(observations.n_robots), (len(values) // observations.n_robots, 1))
        return sparse.csr_array((values[..., None] * mine[:, None]).reshape(len(values), -1))

    def prior(self, theta: Theta, observations: Observations) -> tuple[Any, list[Any]]:
        """Return a prior that correlates the robots' coefficients through a common mean."""
        n = observations.n_robots
        mean, sd = self.moments(theta, observations)
        tau = namespace(mean).maximum(_spreads(theta), LEAST)

        # (sd^2 11' + tau^2 I)^-1 by the formula of Sherman and Morrison.
        share = sd**2 / (tau**2 + n * sd**2)
        parts = [
            (np.eye(n) - share[:, m, None, None]) / tau[:, m, None, None] ** 2
            for m in range(mean.shape[1])
        ]
        return namespace(mean).repeat(mean, n, axis=1), parts

    def to_variables(self, c: np.ndarray, theta: Theta, observations: Observations) -> Values:
        """Return the weights `beta` (draw, robot, feature), intercepts `b` (draw, robot) and means.

        The means `mean_beta` and `mean_b` are expected values given the coefficients.
        """
        c = np.swapaxes(c.reshape(len(c), -1, observations.n_robots), 1, 2)

        # Posterior mean of a normal mean, given the coefficients of the robots.
        mean, sd = self.moments(theta, observations)
        gain = sd**2 / (sd**2 + _spreads(theta) ** 2 / observations.n_robots)
        mu = mean + gain * (c.mean(1) - mean)
        means = {"mean_beta": mu[:, :-1], "mean_b": mu[:, -1]}
        return {"beta": c[..., :-1], "b": c[..., -1]} | means

    def coefficients(self, values: Values, theta: Theta, observations: Observations) -> np.ndarray:
        """See `Effect.coefficients`."""
        c = np.concatenate([values["beta"], values["b"][..., None]], axis=-1)
        return np.swapaxes(c, 1, 2).reshape(len(c), -1)


@dataclass(frozen=True)
class CoupledWeights(Weights):
    """Weights B_m of feature m of robot l in the trust of robot i, and intercepts b_i."""

    def design(self, observations: Observations) -> Any:
        """Return the features of all robots and a constant 1, for each robot."""
        n = observations.n_robots
        inputs = observations.awareness.reshape(
            -1, 1, n * observations.awareness.shape[3]
        )  # (mission * bound, 1, (robot, m))
        inputs = np.concatenate([inputs, np.ones((*inputs.shape[:2], 1))], axis=2)
        values = np.eye(n)[:, :, None] * inputs[:, :, None]  # (..., robot, of robot, input)
        return sparse.csr_array(values.reshape(observations.contact_rate.size, -1))

    def prior(self, theta: Theta, observations: Observations) -> tuple[Any, list[Any]]:
        """Return the prior on the weights, with `Priors.coupling` for features of other robots."""
        n = observations.n_robots
        n_features = observations.awareness.shape[3]
        own = np.repeat(np.eye(n, dtype=bool), n_features, axis=1)
        own = np.column_stack([own, np.ones(n, dtype=bool)])  # (robot, input)
        feature = np.append(np.tile(np.arange(n_features), n), n_features)

        mean, sd = self.moments(theta, observations)
        coupling_mean, coupling_sd = self.priors.moments("coupling")
        xp = namespace(theta["inverse_gain"])
        means = xp.where(own, mean[..., feature], coupling_mean)
        sds = xp.where(own, sd[..., feature], coupling_sd)
        return means.reshape(len(means), -1), [sds.reshape(len(sds), -1) ** -2.0]

    def to_variables(self, c: np.ndarray, theta: Theta, observations: Observations) -> Values:
        """Return matrices `B` (draw, feature, robot, robot') and intercepts `b` (draw, robot)."""
        n = observations.n_robots
        c = c.reshape(len(c), n, -1)
        B = c[..., :-1].reshape(len(c), n, n, -1)
        return {"B": np.moveaxis(B, -1, 1), "b": c[..., -1]}

    def coefficients(self, values: Values, theta: Theta, observations: Observations) -> np.ndarray:
        """See `Effect.coefficients`."""
        B = np.moveaxis(values["B"], 1, -1)
        B = B.reshape(*B.shape[:2], -1)
        return np.concatenate([B, values["b"][..., None]], axis=2).reshape(len(B), -1)


def _inputs(observations: Observations) -> np.ndarray:
    """Return an array (observation, feature + 1) of the features and a column of ones."""
    z = observations.awareness.reshape(-1, observations.awareness.shape[3])
    return np.column_stack([z, np.ones(len(z))])


def _spreads(theta: Theta) -> Any:
    """Return the standard deviations tau (point, column) of the weights and the intercept."""
    xp: Any = namespace(theta["tau_b"])
    return xp.concatenate([theta["tau_beta"], theta["tau_b"][:, None]], axis=1)
