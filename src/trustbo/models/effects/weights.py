"""Weights of features and the intercept, which all robots share."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpyro.distributions import Distribution

from trustbo.models.effects.effect import Columns, Prior, Slots, Theta, dense_columns
from trustbo.models.priors import Priors
from trustbo.models.priors_numpy import of_coefficients


@dataclass(frozen=True)
class Weights:
    """Effect of features and of a constant, under the priors of `beta` and `b`, both Normal."""

    priors: Priors
    names = ()

    def scales(self, scores: np.ndarray) -> dict[str, np.ndarray]:
        """No hyperparameters."""
        return {}

    def hyperpriors(self) -> dict[str, Distribution]:
        """No hyperparameters."""
        return {}

    def group(self, slots: Slots) -> "FeatureColumns":
        """See `Effect.group`."""
        constant = np.ones((*slots.z.shape[:2], 1))
        mean, precision = of_coefficients(self.priors.beta, self.priors.b, slots.z.shape[2])
        columns = dense_columns(np.concatenate([slots.z, constant], axis=2))
        return FeatureColumns(columns, mean, precision**-0.5, self.priors.stationary)


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
