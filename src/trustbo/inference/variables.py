"""Variables of a posterior by group and name, and their draws from the prior."""

from collections.abc import Mapping

import numpy as np

from trustbo.inference.columns import Groups
from trustbo.inference.density import Density, JointDraws, chunks
from trustbo.inference.engine import Prior
from trustbo.models.effects.effect import Theta


def to_variables(density: Density, draws: JointDraws) -> dict[str, dict[str, np.ndarray]]:
    """Return the variables of draws by group (`posterior` and one per effect) and name."""
    groups = density.columns.to_variables(draws.c, draws.theta)
    groups["posterior"] = _hyperparameters(density, draws.theta) | groups["posterior"]
    return groups


def draws_of(density: Density, groups: Groups) -> JointDraws:
    """Make draws from variables by group and name, as returned by `to_variables`."""
    theta = _theta_of(density, groups["posterior"])
    return JointDraws(theta, density.columns.coefficients(groups, theta))


def with_prior_effects(
    density: Density, parameters: Mapping[str, np.ndarray], rng: np.random.Generator
) -> JointDraws:
    """Draw the effects from their prior given prior draws of the parameters, by name."""
    theta = _theta_of(density, parameters)
    c = np.concatenate([density.prior(chunk).draw(rng) for _, chunk in chunks(theta)])

    weights = density.model.weights.coefficients(parameters, theta, density.observations)
    c[:, : weights.shape[1]] = weights  # the parameters include them
    return JointDraws(theta, c)


def _theta_of(density: Density, parameters: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the hyperparameters of draws by name; see `Theta`."""
    model = density.model
    names = model.dims | model.effect_dims
    theta = model.derived({name: parameters[name] for name in names if name in parameters})
    return {name: v for name, v in theta.items() if name not in ("beta", "b", "B")}


def prior_parameters(
    density: Density, n: int, rng: np.random.Generator, *, even: bool = False
) -> dict[str, np.ndarray]:
    """Draw parameters (draw, ...) by name from the prior, without effects.

    With `even`, hyperparameters are evenly spaced quantiles, and coefficients are prior means.
    """
    model = density.model
    observations = density.observations
    theta = model.theta(density.scores.draw(n, rng, even=even), observations.resolution)

    weights = Prior.from_groups([model.weights.prior(theta, observations)])
    c = weights.mean if even else weights.draw(rng)
    of_weights = model.weights.to_variables(c, theta, observations)
    return {**_hyperparameters(density, theta), **of_weights}


def _hyperparameters(density: Density, theta: Theta) -> dict[str, np.ndarray]:
    """Select the hyperparameters that the group `posterior` contains."""
    names = density.model.dims.keys() | density.model.effect_dims.keys()
    return {name: values for name, values in theta.items() if name in names}
