"""Variables of a posterior by group and name, and their draws from the prior."""

from collections.abc import Mapping

import numpy as np

from trustbo.inference.density import Density, JointDraws, chunks
from trustbo.inference.engine import Prior
from trustbo.models.effects.effect import Theta


def to_variables(density: Density, draws: JointDraws) -> dict[str, dict[str, np.ndarray]]:
    """Return the variables of draws by group (`posterior` and one per effect) and name.

    Effects are stored in single precision, because they take most of the memory of a posterior and
    the error is far below their Monte Carlo error. Computations read them in double precision.
    """
    theta = draws.theta
    groups = {"posterior": _hyperparameters(density, theta)}
    ends = zip(density.ends[:-1], density.ends[1:], strict=True)
    for effect, (start, end) in zip(density.model.terms, ends, strict=True):
        own = draws.c[:, start:end].copy()  # a view would keep all columns in memory
        of_effect = effect.to_variables(own, theta, density.observations)
        if effect.group:
            of_effect = {name: v.astype(np.float32) for name, v in of_effect.items()}
        groups.setdefault(effect.group or "posterior", {}).update(of_effect)
    return groups


def draws_of(density: Density, groups: Mapping[str, Mapping[str, np.ndarray]]) -> JointDraws:
    """Make draws from variables by group and name, as returned by `to_variables`."""
    theta = _theta_of(density, groups["posterior"])
    c = []
    for effect in density.model.terms:
        stored = groups[effect.group or "posterior"]
        values = {name: np.asarray(v, dtype=float) for name, v in stored.items()}
        c.append(effect.coefficients(values, theta, density.observations))
    return JointDraws(theta, np.column_stack(c))


def with_prior_effects(
    density: Density, parameters: Mapping[str, np.ndarray], rng: np.random.Generator
) -> JointDraws:
    """Draw the effects from their prior given prior draws of the parameters, by name."""
    theta = _theta_of(density, parameters)
    observations = density.observations
    model = density.model

    weights = model.weights.coefficients(parameters, theta, observations)
    parts = []
    for where, chunk in chunks(theta):
        groups = [effect.prior(chunk, observations) for effect in model.effects]
        of_effects = Prior.from_groups(groups).draw(rng) if groups else weights[where, :0]
        parts.append(of_effects)
    return JointDraws(theta, np.column_stack([weights, np.concatenate(parts)]))


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
    return {
        **_hyperparameters(density, theta),
        **model.weights.to_variables(c, theta, observations),
    }


def _hyperparameters(density: Density, theta: Theta) -> dict[str, np.ndarray]:
    """Select the hyperparameters that the group `posterior` contains."""
    names = density.model.dims.keys() | density.model.effect_dims.keys()
    return {name: values for name, values in theta.items() if name in names}
