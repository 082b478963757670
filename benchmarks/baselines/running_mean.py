"""Running mean of each bound, shrunk towards line of sight by empirical Bayes in closed form.

This baseline uses line of sight and the rates of the bounds that missions have driven. Bounds share
only the mean error of line of sight; apart from that, the rates in one bound give no information
about other bounds. The method is a bandit with one arm for each bound. It has no settings and makes
no assumption about trust. The planned path is the best one under the means (`greedy`) or under
their upper 90 % quantiles (`optimistic`). A mission takes less than 0.01 s.
"""

from collections import defaultdict

import numpy as np

from trustbo.campaign.campaign import Campaign
from trustbo.data import Mission
from trustbo.planning import Planner

from .paths import Path, PathPolicy, best_paths, line_of_sight, rates_of

UPPER = 1.2815515655446004
"""Upper 90 % quantile of a standard normal, as that of trustbo's policy `optimistic`."""
_PRIOR_SD, _NOISE_SD, _PSEUDO = 0.1, 0.03, 2.0
"""Sd over bounds and of a rate, in as many pseudo-observations."""


class RunningMean(PathPolicy):
    """Policy by means of the rates of each bound; `n_sd` of their sd are added to choose."""

    def __init__(self, n_sd: float = 0.0) -> None:
        """Begin with line of sight."""
        self.n_sd = n_sd
        self.rates: defaultdict[tuple[int, int, int], list[float]] = defaultdict(list)

    def learn(self, campaign: Campaign, mission: Mission) -> None:
        """Add the rates of a mission."""
        for bound, rate in rates_of(mission):
            self.rates[bound].append(rate)

    def choose(self, planner: Planner, rng: np.random.Generator) -> Path:
        """Best path under upper quantiles of the means."""
        return self._best(planner, self.n_sd)

    def best(self, planner: Planner) -> Path:
        """Best path under the means."""
        return self._best(planner, 0.0)

    def _best(self, planner: Planner, n_sd: float) -> Path:
        mean, sd = self.estimate(line_of_sight(planner))
        return best_paths(planner, np.clip(mean + n_sd * sd, 0.0, 1.0)[None])[0]

    def estimate(self, sight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and sd of the rate of every bound, each (move, row, col).

        Error r of line of sight: r_ej ~ N(m_e, s^2) in visit j to bound e, m_e ~ N(mu, tau^2).
        With mu, tau and s from moments, E[m_e] = mu + n_e / (n_e + s^2 / tau^2) (mean r_e - mu).
        """
        errors = [np.array(rates) - sight[bound] for bound, rates in self.rates.items()]
        means = np.array([r.mean() for r in errors])
        n, n_repeats = len(means), sum(len(r) - 1 for r in errors)
        mu = means.sum() / (n + _PSEUDO)
        between = (((means - mu) ** 2).sum() + _PSEUDO * _PRIOR_SD**2) / (n + _PSEUDO)
        within = sum(((r - r.mean()) ** 2).sum() for r in errors) + _PSEUDO * _NOISE_SD**2
        within /= n_repeats + _PSEUDO
        mean, sd = sight + mu, np.full(sight.shape, np.sqrt(between))
        for (bound, r), average in zip(self.rates.items(), means, strict=True):
            k = within / between
            mean[bound] = sight[bound] + mu + len(r) / (len(r) + k) * (average - mu)
            sd[bound] = np.sqrt(within / (len(r) + k))
        return mean, sd


def greedy() -> RunningMean:
    """Running mean that takes the path it holds for the best."""
    return RunningMean()


def optimistic() -> RunningMean:
    """Running mean that takes the best path under upper quantiles."""
    return RunningMean(UPPER)
