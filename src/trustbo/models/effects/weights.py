"""Weights of features and the intercept, which all robots share, or drawn for each of them."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trustbo.models.effects.effect import (
    Columns,
    Effect,
    Prior,
    Slots,
    Theta,
    dense_columns,
    share_of,
)
from trustbo.models.priors import Priors
from trustbo.models.priors_numpy import of_coefficients

_LEAST = 1e-8  # share of robots' differences in a variance: EP inverts the correlations


@dataclass(frozen=True)
class Weights(Effect):
    """Effect of features and of a constant, under the priors of `beta` and `b`, both Normal.

    With `by_robot` these are the priors of the means mu of the coefficients c_i of each robot,
    N(mu, tau^2); the spreads tau_beta and tau_b come with theta.
    """

    priors: Priors
    by_robot: bool = False

    def group(self, slots: Slots) -> "FeatureColumns | FeatureColumnsByRobot":
        """See `Effect.group`."""
        constant = np.ones((*slots.z.shape[:2], 1))
        mean, precision = of_coefficients(self.priors.beta, self.priors.b, slots.z.shape[2])
        values = np.concatenate([slots.z, constant], axis=2)
        moments = mean, precision**-0.5, self.priors.stationary
        shared = FeatureColumns(dense_columns(values), *moments)
        if not self.by_robot:
            return shared
        mine = slots.robot[:, None] == np.arange(n := slots.n_robots)
        apart = values[..., None] * mine[:, None, None]
        return FeatureColumnsByRobot(dense_columns(apart.reshape(*slots.y.shape, -1)), shared, n)


class FeatureColumns(NamedTuple):
    """Features, and 1."""

    columns: Columns
    mean: np.ndarray  # (column,)
    sd: np.ndarray
    stationary: bool
    joined = ()
    fades = False

    def prior(self, theta: Theta) -> Prior:
        """Independent coefficients, of stationary trust if these are what the priors are of."""
        rest = theta["rest"][:, None] if self.stationary else np.ones((len(theta["beta0"]), 1))
        return Prior(rest * self.mean, rest * self.sd)

    def name(self, c: np.ndarray, theta: Theta, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Weights beta (draw, feature) and intercept b (draw,)."""
        return {"beta": c[:, :-1], "b": c[:, -1]}


class FeatureColumnsByRobot(NamedTuple):
    """Features, and 1, of one robot each, the robot fastest."""

    columns: Columns
    shared: FeatureColumns
    n_robots: int
    fades = False

    @property
    def joined(self) -> list[slice]:
        """Robots' coefficients of one feature."""
        n = self.n_robots
        return [slice(i, i + n) for i in range(0, n * len(self.shared.mean), n)]

    def prior(self, theta: Theta) -> Prior:
        """Coefficients of one feature alike, as they share its mean."""
        n, of_mean, tau = self.n_robots, self.shared.prior(theta), _spreads(theta)
        sd = np.hypot(of_mean.sd, tau)
        apart = np.maximum(share_of(tau, sd), _LEAST)  # the correlation is apart I + alike 11'
        alike, root = 1.0 - apart, np.zeros((*sd.shape, n, n))
        for i in range(n):
            root[..., i, i] = np.sqrt(apart + alike)
            root[..., i + 1 :, i] = (alike / root[..., i, i])[..., None]
            alike = alike * apart / (apart + alike)
        mean, sd = (np.repeat(moment, n, axis=1) for moment in (of_mean.mean, sd))
        return Prior(mean, sd, list(np.moveaxis(root, 1, 0)))

    def name(self, c: np.ndarray, theta: Theta, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Weights beta (draw, robot, feature), intercepts b (draw, robot), and a draw of means."""
        c = np.swapaxes(c.reshape(len(c), -1, self.n_robots), 1, 2)
        prior, var = self.shared.prior(theta), _spreads(theta) ** 2 / self.n_robots
        gain = share_of(prior.sd, np.hypot(prior.sd, np.sqrt(var)))
        mu = prior.mean + gain * (c.mean(1) - prior.mean)
        mu += np.sqrt(gain * var) * rng.standard_normal(mu.shape)
        means = {"mean_beta": mu[:, :-1], "mean_b": mu[:, -1]}
        return {"beta": c[..., :-1], "b": c[..., -1]} | means


def _spreads(theta: Theta) -> np.ndarray:
    return np.column_stack([theta["tau_beta"], theta["tau_b"]])
