"""Gaussian process over bounds for the error of line of sight, without a state space.

This baseline uses line of sight and the rates of the bounds that missions have driven. It assumes
that the errors of line of sight are similar in bounds that are close to each other and have similar
directions. The method is regression kriging, as in geostatistics. The squared exponential kernel
depends on the middle and the direction of a bound, and all hyperparameters maximise the exact
marginal likelihood after each mission. The planned path is the best one under the upper 90 %
quantiles of all bounds. Trust has no memory. A mission takes 0.15 s.
"""

import warnings

import numpy as np
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from trustbo.campaign.campaign import Campaign
from trustbo.data import Mission
from trustbo.planning import Planner
from trustbo.workspace.moves import MOVES

from .paths import Path, PathPolicy, best_paths, line_of_sight, rates_of
from .running_mean import UPPER

_KERNEL = (
    ConstantKernel(0.05**2, (1e-6, 1.0))
    + ConstantKernel(0.1**2, (1e-5, 1.0)) * RBF([1.0, 1.0, 1.0, 1.0], (0.3, 30.0))
    + WhiteKernel(0.05**2, (1e-5, 0.1))
)
"""Errors shared by all bounds, those of a place and direction (in cells), and of a visit."""
_LEAST = 3
"""Rates from which hyperparameters are estimated; before, they are those above."""


class ResidualProcess(PathPolicy):
    """Policy by a Gaussian process of the error of line of sight."""

    __name__ = "residual process"

    def __init__(self, n_sd: float = UPPER) -> None:
        """Begin with line of sight; `n_sd` standard deviations are added to choose a path."""
        self.n_sd = n_sd
        self.rates: list[tuple[tuple[int, int, int], float]] = []
        self._fitted: tuple[int, GaussianProcessRegressor] | None = None

    def learn(self, campaign: Campaign, mission: Mission) -> None:
        """Add the rates of a mission."""
        self.rates += rates_of(mission)

    def choose(self, planner: Planner, rng: np.random.Generator) -> Path:
        """Best path under upper quantiles."""
        mean, sd = self.estimate(line_of_sight(planner))
        return best_paths(planner, np.clip(mean + self.n_sd * sd, 0.0, 1.0)[None])[0]

    def best(self, planner: Planner) -> Path:
        """Best path under the mean of the process."""
        mean, _ = self.estimate(line_of_sight(planner))
        return best_paths(planner, np.clip(mean, 0.0, 1.0)[None])[0]

    def estimate(self, sight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and sd of the rate of every bound, each (move, row, col), NaN without one."""
        there = np.isfinite(sight)
        mean, sd = np.full(sight.shape, np.nan), np.full(sight.shape, np.nan)
        process = self.process(sight)
        error, with_noise = process.predict(places(np.argwhere(there)), return_std=True)
        noise = getattr(process, "kernel_", process.kernel).k2.noise_level
        mean[there] = sight[there] + error
        sd[there] = np.sqrt(np.maximum(0.0, with_noise**2 - noise))
        return mean, sd

    def process(self, sight: np.ndarray) -> GaussianProcessRegressor:
        """Process given all missions; fitted once for each number of rates."""
        n = len(self.rates)
        if self._fitted is None or self._fitted[0] != n:
            bounds = np.array([bound for bound, _ in self.rates]).reshape(-1, 3)
            errors = np.array([rate - sight[bound] for bound, rate in self.rates])
            self._fitted = n, fitted(bounds, errors)
        return self._fitted[1]


def fitted(bounds: np.ndarray, errors: np.ndarray) -> GaussianProcessRegressor:
    """Process given errors of line of sight (error,) at bounds (error, 3), which may be none."""
    optimizer = "fmin_l_bfgs_b" if len(errors) >= _LEAST else None
    process = GaussianProcessRegressor(
        _KERNEL, optimizer=optimizer, n_restarts_optimizer=1, random_state=0
    )
    if len(errors):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of hyperparameters at their limits
            process.fit(places(bounds), errors)
    return process


def places(bounds: np.ndarray) -> np.ndarray:
    """Middle of bounds (bound, 3), in cells, and the sine and cosine of their direction."""
    steps = np.array(MOVES)[bounds[:, 0] % len(MOVES)]
    return np.hstack([bounds[:, 1:] - 0.5 * steps, steps / np.linalg.norm(steps, axis=1)[:, None]])


def greedy() -> ResidualProcess:
    """Process that takes the path it holds for the best."""
    return ResidualProcess(0.0)


def optimistic() -> ResidualProcess:
    """Process that takes the best path under upper quantiles."""
    return ResidualProcess()
