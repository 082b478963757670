"""Weights of features and the intercept, which all robots share, or drawn for each of them."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from trustbo.models.backend import namespace
from trustbo.models.effects.effect import (
    Columns,
    Effect,
    Prior,
    Slots,
    Theta,
    dense_columns,
    hypot,
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
        xp: Any = namespace(tau)
        sd = hypot(of_mean.sd, tau)
        apart = xp.maximum(share_of(tau, sd), _LEAST)  # the correlation is apart I + alike 11'
        alike, diagonal, below = 1.0 - apart, [], []
        for _ in range(n):  # columns of its root, alike below the diagonal
            diagonal.append(xp.sqrt(apart + alike))
            below.append(alike / diagonal[-1])
            alike = alike * apart / (apart + alike)
        columns = (xp.stack(column, axis=-1)[..., None, :] for column in (diagonal, below))
        root = sum(
            x * where for x, where in zip(columns, (np.eye(n), np.tri(n, k=-1)), strict=True)
        )
        mean, sd = (xp.repeat(moment, n, axis=1) for moment in (of_mean.mean, sd))
        return Prior(mean, sd, list(xp.moveaxis(root, 1, 0)))

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
    xp: Any = namespace(theta["tau_b"])
    return xp.concatenate([theta["tau_beta"], theta["tau_b"][:, None]], axis=1)
