"""Draws of parameters, and of contact rates, from the priors alone."""

from collections.abc import Iterable, Sequence
from functools import partial

import jax
import numpy as np
import xarray as xr
from jax import Array, random
from numpy.typing import ArrayLike
from numpyro import handlers

from trustbo.arrays import as_array
from trustbo.data import default_features
from trustbo.errors import ShapeError, TrustboError, require_whole
from trustbo.models.backend import in_batches, own_settings
from trustbo.models.model import TrustModel, require_model
from trustbo.models.params import Params
from trustbo.models.state_space.generate import draw_missions
from trustbo.models.ticks import broadcast_ticks, weigh_ticks
from trustbo.stacking import MissionBatch

_BATCH = 500  # draws computed at once


def prior_predictive(
    model: TrustModel,
    awareness: ArrayLike,
    *,
    n_ticks: ArrayLike | None = None,
    features: Sequence[str] = (),
    n_draws: int = 500,
    seed: int = 0,
) -> xr.DataTree:
    """Draw parameters and contact rates from the priors alone; one seed gives the same draws.

    Args:
        model: Trust model.
        awareness: Shape (mission, bound, robot, feature).
        n_ticks: Ticks, broadcast to (mission, bound, robot); the beta-binomial family needs them.
        features: Names of the features, by which default priors go; by default traversability,
            visibility, z3, ...
        n_draws: Number of draws.
        seed: Seed of the draws.

    Returns:
        ArviZ DataTree with the groups `prior` and `prior_predictive` (contact_rate[chain, draw,
        mission, bound, robot]).

    Raises:
        ShapeError: Awareness has other axes.
        TrustboError: The family needs n_ticks; or places have effects, which depend on paths.
    """
    require_model(model)
    z = as_array("awareness", awareness)
    if z.ndim != 4:
        raise ShapeError(f"awareness must be (mission, bound, robot, feature); got {z.shape}.")
    if model.effects:
        raise TrustboError(
            f"effects of {model.effects[0].noun} are of fitted missions: fit them, and take the "
            "posterior's group prior_predictive; or give a model without them."
        )
    if model.place is not None:
        raise TrustboError(
            "effects of places need the paths of missions: fit them, and take the posterior's "
            "group prior_predictive; or give a model with place=None."
        )
    ticks = broadcast_ticks(model.family, n_ticks, z.shape[:3])
    require_whole("n_draws", n_draws, 1)
    names = tuple(features) or default_features(z.shape[3])
    if len(names) != z.shape[3]:
        raise ShapeError(f"features must be {z.shape[3]} names; got {names}.")
    model = model.for_features(names).at_resolution(
        weigh_ticks(MissionBatch(z, np.zeros(z.shape[:3]), ticks))
    )
    drawn = draw_sites(model, z.shape[2:], n_draws, seed)
    params, rng = model.params(drawn, z.shape[3]).flat(), np.random.default_rng(seed + 1)
    missions = draw_missions(model.family, params, z, ticks, rng)
    drawn["contact_rate"] = missions.contact_rate
    dims = {**model.dims, "contact_rate": ("mission", "bound", "robot")}
    robots = [f"r{i + 1}" for i in range(z.shape[2])]
    coords = {
        "mission": np.arange(z.shape[0]),
        "bound": np.arange(1, z.shape[1] + 1),
        "robot": robots,
        "robot_": robots,
        "feature": list(names),
    }

    def group(names: Iterable[str]) -> xr.Dataset:
        variables = {n: (("chain", "draw", *dims[n]), drawn[n][None]) for n in names}
        used = {d for axes, _ in variables.values() for d in axes} & set(coords)
        index = {"chain": [0], "draw": np.arange(n_draws)}
        return xr.Dataset(variables, {d: coords[d] for d in coords if d in used} | index)

    groups = {"prior": group(model.dims), "prior_predictive": group(["contact_rate"])}
    return xr.DataTree.from_dict(groups)


def sample_prior(
    model: TrustModel, n_features: int, n_draws: int, seed: int, *, n_robots: int = 1
) -> Params:
    """Draws of the parameters from the prior, leading axis (draw,).

    Args:
        model: Trust model.
        n_features: Number of features.
        n_draws: Number of draws.
        seed: Seed; the same seed gives the same draws.
        n_robots: Number of robots, for models with separate parameters for each robot.
    """
    require_model(model)
    sizes = {"n_features": n_features, "n_robots": n_robots, "n_draws": n_draws}
    n_features, n_robots, n_draws = (require_whole(name, n, 1) for name, n in sizes.items())
    require_whole("seed", seed, 0)
    model = model.at_resolution({})
    drawn = draw_sites(model, (n_robots, n_features), n_draws, seed)
    return model.params(drawn, n_features)


def draw_sites(
    model: TrustModel, shape: tuple[int, int], n_draws: int, seed: int
) -> dict[str, np.ndarray]:
    """Draws of the parameters from the prior for (robots, features), by name.

    TrustboError: the model is invalid at these draws, see `TrustModel.check`.
    """
    sites = model.draw_prior(shape, n_draws, np.random.default_rng(seed))
    if sites is None:
        sites = _compiled_draws(model, shape, n_draws, seed)
    return sites | _effect_draws(model, n_draws, seed)


def _compiled_draws(
    model: TrustModel, shape: tuple[int, int], n_draws: int, seed: int
) -> dict[str, np.ndarray]:
    """Draws of the parameters by the model's sample statements, without those of places."""
    with own_settings():
        keys = random.split(random.key(seed), n_draws)
        return in_batches(partial(_parameter_draws, model, shape), keys, _BATCH)


def _effect_draws(model: TrustModel, n_draws: int, seed: int) -> dict[str, np.ndarray]:
    """Draws of the hyperparameters of effects."""
    drawn = {}
    if model.place is not None:
        drawn |= model.place.draw(n_draws, np.random.default_rng([seed, 1]))
    rng = np.random.default_rng([seed, 2])
    for effect in model.effects:
        drawn |= effect.draw(n_draws, rng)
    return drawn


@partial(jax.jit, static_argnames="shape")
def _parameter_draws(model: TrustModel, shape: tuple[int, int], keys: Array) -> dict[str, Array]:
    """Values of the sites of the model's program by name, one set per key."""
    program = partial(model.sample_params, *shape)

    def one(key: Array) -> dict[str, Array]:
        trace = handlers.trace(handlers.seed(program, key)).get_trace()
        return {name: trace[name]["value"] for name in model.sizes(*shape)}

    return jax.vmap(one)(keys)
