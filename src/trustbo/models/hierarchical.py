"""Separate coefficients for each robot, drawn from a common distribution."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import Distribution

from trustbo.models.effects.weights import RobotWeights
from trustbo.models.pooled import PooledTrust


@dataclass(frozen=True, repr=False)
class HierarchicalTrust(PooledTrust):
    """Model with separate coefficients for each robot, partially pooled towards a common mean.

    The weight of feature m and the intercept of robot i are ::

        beta_{i,m} ~ N(mean_beta_m, tau_beta_m^2)
        b_i ~ N(mean_b, tau_b^2)

    The means have the same priors as pooled coefficients, and the standard deviations tau have the
    prior `Priors.tau`. All robots share beta0 and the noise scales.

    Example:
        >>> posterior = tb.fit(missions, tb.models.HierarchicalTrust())
        >>> posterior["posterior"]["beta"].mean(("chain", "draw"))  # (robot, feature)
    """

    @property
    def weights(self) -> RobotWeights:  # pyright: ignore[reportIncompatibleVariableOverride]
        """See `TrustModel.weights`."""
        return RobotWeights(self.priors)

    def hyperpriors(self, n_robots: int, n_features: int) -> dict[str, Distribution]:
        """See `TrustModel.hyperpriors`."""
        tau: dist.Distribution = self.priors.tau
        spreads = {"tau_beta": tau.expand((n_features,)), "tau_b": tau}
        return super().hyperpriors(n_robots, n_features) | spreads

    def prior_terms(
        self, parameters: Mapping[str, np.ndarray]
    ) -> dict[str, tuple[str, np.ndarray]]:
        """See `TrustModel.prior_terms`; includes only the means of the robots' coefficients."""
        return {
            "mean_beta": ("beta", parameters["mean_beta"]),
            "mean_b": ("b", parameters["mean_b"]),
        }

    @property
    def dims(self) -> dict[str, tuple[str, ...]]:
        """See `TrustModel.dims`.

        `az.summary` would label the rows of `beta` incorrectly if a variable with only the axis
        `feature` came first.
        """
        return super().dims | {
            "beta": ("robot", "feature"),
            "b": ("robot",),
            "mean_beta": ("feature_",),
            "mean_b": (),
            "tau_beta": ("feature_",),
            "tau_b": (),
        }
