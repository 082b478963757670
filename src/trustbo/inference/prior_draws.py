"""Draws and means of the parameters of a model class from its prior."""

from dataclasses import replace
from typing import Any

import numpy as np

from trustbo.errors import require_count, require_kind, require_whole
from trustbo.inference.ahead import with_prior_effects_ahead
from trustbo.inference.class_target import ClassTarget
from trustbo.inference.variables import prior_parameters
from trustbo.models.draws import NextMission
from trustbo.models.model import TrustModel
from trustbo.models.observations import Observations
from trustbo.models.params import TrustParams, assemble_params
from trustbo.workspace import Workspace

_N_MEAN = 4096
"""Number of draws averaged to compute a prior mean."""


def sample_prior(
    model: TrustModel, n_features: int, n_draws: int, seed: int, *, n_robots: int = 1
) -> TrustParams:
    """Draw parameters (draw, ...) from the prior, without effects.

    Args:
        model: Trust model.
        n_features: Number of features.
        n_draws: Number of draws.
        seed: Random seed; the same seed gives the same draws.
        n_robots: Number of robots, for models with separate parameters for each robot.

    Example:
        >>> model = tb.models.PooledTrust()
        >>> draws = tb.inference.sample_prior(model, n_features=3, n_draws=500, seed=0)
        >>> planner.plan(draws).bands.shape  # (quantile, bound, robot)
    """
    remedy = (
        "give a model such as PooledTrust(); for a NumPyro function, use numpyro.infer.Predictive"
    )
    require_kind("model", model, TrustModel, remedy)
    n_draws = require_count("n_draws", n_draws)
    seed = require_whole("seed", seed, 0)

    prior = _prior(model, n_features, n_robots)
    rng = np.random.default_rng(seed)
    parameters = prior_parameters(prior, n_draws, rng)
    return assemble_params(parameters, **_settings_of(model))


def sample_prior_ahead(
    model: TrustModel, workspace: Workspace, n_draws: int, seed: int
) -> NextMission:
    """Draw parameters (draw, ...) from the prior, with the effects of places and of robots.

    The effects of robots are those of the first mission.

    Args:
        model: Trust model.
        workspace: Workspace, whose features, robots and cells are used.
        n_draws: Number of draws.
        seed: Random seed; the same seed gives the same draws.
    """
    rng = np.random.default_rng(seed)

    prior = _prior(model, len(workspace.features), workspace.team.n_robots)
    parameters = prior_parameters(prior, n_draws, rng)
    drawn = model.scores(prior.observations).draw(n_draws, rng)
    parameters |= {name: drawn[name] for name in model.effect_dims}

    theta = model.derived(parameters)
    names = workspace.team.names, workspace.features
    expected, drawn = (
        assemble_params(values, **_settings_of(model), **places).in_order(*names)
        for values, places in with_prior_effects_ahead(
            workspace, model.effects, theta, parameters, seed
        )
    )
    return NextMission(expected, drawn)


def prior_mean(model: TrustModel, n_features: int, *, n_robots: int = 1) -> TrustParams:
    """Compute the prior mean of the parameters without effects; see `sample_prior`."""
    prior = _prior(model, n_features, n_robots)
    rng = np.random.default_rng(0)
    parameters = prior_parameters(prior, _N_MEAN, rng, even=True)
    parameters = {name: values.mean(0, keepdims=True) for name, values in parameters.items()}
    return assemble_params(parameters, **_settings_of(model))


def _settings_of(model: TrustModel) -> dict[str, Any]:
    """Return the arguments of `TrustParams` that are settings of a model."""
    return {**model.x0, "memory": model.memory, "family": model.family}


def _prior(model: TrustModel, n_features: int, n_robots: int) -> ClassTarget:
    """Make a `ClassTarget` without data or effects."""
    n_features = require_count("n_features", n_features)
    n_robots = require_count("n_robots", n_robots)

    unmeasured = np.full((1, 1, n_robots), np.nan)
    z = np.zeros((1, 1, n_robots, n_features))
    observations = Observations(unmeasured, z, unmeasured, ("",) * n_features)
    return ClassTarget(replace(model, effects=()), observations)
