"""Variables of a posterior by group and name, and their draws from the prior."""

from collections.abc import Mapping

import numpy as np

from trustbo.inference.density import Density, JointDraws, chunks
from trustbo.inference.engine import Prior
from trustbo.models.effects.effect import Theta


def to_variables(density: Density, draws: JointDraws) -> dict[str, dict[str, np.ndarray]]:
    """Return the variables of draws by group (`posterior` and one per effect) and name."""
    theta = draws.theta
    groups = {"posterior": _hyperparameters(density, theta)}
    ends = zip(density.ends[:-1], density.ends[1:], strict=True)
    for effect, (start, end) in zip(density.model.terms, ends, strict=True):
        of_effect = effect.to_variables(draws.c[:, start:end], theta, density.observations)
        groups.setdefault(effect.group or "posterior", {}).update(of_effect)
    return groups


def draws_of(density: Density, groups: Mapping[str, Mapping[str, np.ndarray]]) -> JointDraws:
    """Make draws from variables by group and name, as returned by `to_variables`."""
    parameters = groups["posterior"]
    model = density.model
    theta = model.derived(
        {n: parameters[n] for n in model.dims | model.effect_dims if n in parameters}
    )
    theta = {name: v for name, v in theta.items() if name not in ("beta", "b", "B")}

    c = [
        effect.coefficients(groups[effect.group or "posterior"], theta, density.observations)
        for effect in model.terms
    ]
    return JointDraws(theta, np.column_stack(c))


def draw_prior(density: Density, n: int, rng: np.random.Generator) -> JointDraws:
    """Draw hyperparameters and coefficients from the prior."""
    theta = density.model.theta(density.scores.draw(n, rng), density.observations.resolution)
    c = [density.prior(chunk).draw(rng) for _, chunk in chunks(theta)]
    return JointDraws(theta, np.concatenate(c))


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
    return {
        **_hyperparameters(density, theta),
        **model.weights.to_variables(c, theta, observations),
    }


def _hyperparameters(density: Density, theta: Theta) -> dict[str, np.ndarray]:
    """Select the hyperparameters that the group `posterior` contains."""
    names = density.model.dims.keys() | density.model.effect_dims.keys()
    return {name: values for name, values in theta.items() if name in names}
