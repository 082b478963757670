"""Variables of a posterior by group and name, and their draws from the prior."""

from collections.abc import Mapping

import numpy as np

from trustbo.inference.class_target import ClassTarget
from trustbo.inference.columns import Groups
from trustbo.inference.density import JointDraws, chunks
from trustbo.inference.engine import Prior
from trustbo.models.effects.effect import Theta


def to_variables(target: ClassTarget, draws: JointDraws) -> dict[str, dict[str, np.ndarray]]:
    """Return the variables of draws by group (`posterior` and one per effect) and name."""
    groups = target.columns.to_variables(draws.c, draws.theta)
    groups["posterior"] = _hyperparameters(target, draws.theta) | groups["posterior"]
    return groups


def draws_of(target: ClassTarget, groups: Groups) -> JointDraws:
    """Make draws from variables by group and name, as returned by `to_variables`."""
    theta = _theta_of(target, groups["posterior"])
    return JointDraws(theta, target.columns.coefficients(groups, theta))


def with_prior_effects(
    target: ClassTarget, parameters: Mapping[str, np.ndarray], rng: np.random.Generator
) -> JointDraws:
    """Draw the effects from their prior given prior draws of the parameters, by name."""
    theta = _theta_of(target, parameters)
    c = np.concatenate([target.columns.prior(chunk).draw(rng) for _, chunk in chunks(theta)])

    weights = target.model.weights.coefficients(parameters, theta, target.observations)
    c[:, : weights.shape[1]] = weights  # the parameters include them
    return JointDraws(theta, c)


def _theta_of(target: ClassTarget, parameters: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the hyperparameters of draws by name; see `Theta`."""
    model = target.model
    names = model.dims | model.effect_dims
    theta = model.derived({name: parameters[name] for name in names if name in parameters})
    return {name: v for name, v in theta.items() if name not in ("beta", "b", "B")}


def prior_parameters(
    target: ClassTarget, n: int, rng: np.random.Generator, *, even: bool = False
) -> dict[str, np.ndarray]:
    """Draw parameters (draw, ...) by name from the prior, without effects.

    With `even`, hyperparameters are evenly spaced quantiles, and coefficients are prior means.
    """
    model = target.model
    observations = target.observations
    theta = model.theta(target.scores.draw(n, rng, even=even), observations.resolution)

    weights = Prior.from_groups([model.weights.prior(theta, observations)])
    c = weights.mean if even else weights.draw(rng)
    of_weights = model.weights.to_variables(c, theta, observations)
    return {**_hyperparameters(target, theta), **of_weights}


def _hyperparameters(target: ClassTarget, theta: Theta) -> dict[str, np.ndarray]:
    """Select the hyperparameters that the group `posterior` contains."""
    names = target.model.dims.keys() | target.model.effect_dims.keys()
    return {name: values for name, values in theta.items() if name in names}
