"""Parameters from the draws of a posterior."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference.place_maps import place_maps_of
from trustbo.inference.posterior_tree import require_posterior
from trustbo.models.effects.effect import (
    Effect,
    NextMission,
    Slots,
    Theta,
    drift_of,
    rest_of,
)
from trustbo.models.params import DeviationRobotParams, Params, RobotParams, params_from
from trustbo.models.place import bounds_of
from trustbo.models.record import effects_from_record
from trustbo.stacking import MissionBatch

_DAYS = 20261123  # seed of the next mission's effects: the same posterior has the same bands


def sites_of(posterior: xr.DataTree) -> dict[str, np.ndarray]:
    """All draws of a posterior by name, chains joined: leading axis (draw,)."""
    draws = posterior["posterior"].to_dataset()
    return {str(name): _joined(array) for name, array in draws.items()}


def _joined(array: xr.DataArray, axes: Sequence[Any] = (...,)) -> np.ndarray:
    """Draws (draw, ...) with chains joined, other axes in an order, by default the given one.

    In one layout, whether just sampled or read from a file: sums over draws then round alike, and a
    resumed campaign has the same bits.
    """
    values = np.ascontiguousarray(array.transpose("chain", "draw", *axes).values)
    return values.reshape(values.shape[0] * values.shape[1], *values.shape[2:])  # also of none


def params_of(posterior: xr.DataTree, *, day: bool = False) -> Params:
    """All draws of a posterior as parameters, chains joined: leading axis (draw,).

    Args:
        posterior: DataTree from `fit`.
        day: Whether each draw has effects drawn for the next mission, a bad day of a robot among
            them, for bands and predictions of rates; by default it has the expected ones, for
            plans. Without effects other than of places there is no difference.

    Returns:
        `TrustParams`, `RobotParams` or `CoupledParams`, according to the model. With
        effects other than of places, `RobotParams` of the next mission: with `RobotEffect`, weights
        of line of sight have the effect of each robot, in which the last bad day is gone and what
        stays fades.

    Raises:
        TrustboError: No posterior of `fit`.
    """
    if is_of_people(require_posterior("params_of", posterior)):
        raise TrustboError(
            "a posterior of HumanTrust has no parameters of paths: for reports use "
            "trustbo.inference.predict_reports."
        )
    params, sites = _params(posterior)
    effects = effects_of(posterior)
    if not effects:
        return params
    attrs, features = posterior.attrs, posterior["posterior"].to_dataset()["feature"].values
    rng = np.random.default_rng(_DAYS) if day else None
    mission = NextMission(attrs["n_missions"], features.tolist(), attrs["n_robots"], rng)
    memory, robots = memory_of(posterior), (len(sites["beta0"]), mission.n_robots)
    theta = theta_of(sites, memory)
    fields = {
        name: np.broadcast_to(sites[name][:, None], robots)
        for name in ("beta0", "b", "delta_w", "delta_v")
    }
    beta = np.repeat(sites["beta"][:, None], mission.n_robots, axis=1)
    for effect in effects:
        weights, intercept = effect.ahead(values_of(posterior, effect), theta, mission)
        beta, fields["b"] = beta + weights, fields["b"] + intercept
    x0 = {name: getattr(params, name) for name in ("x0_mean", "x0_sd")}
    kind = RobotParams if memory == "level" else DeviationRobotParams
    return kind(beta=beta, **fields, **x0, **params.places)


def params_of_missions(
    posterior: xr.DataTree, missions: Sequence[Mission], batch: MissionBatch
) -> Params:
    """All draws as parameters of the missions that the posterior was fitted to.

    Effects of their places, and of robots in them, are in the intercepts.
    """
    params, sites = _params(posterior)
    params, effects = params.flat(), effects_of(posterior)
    if params.places:
        params = params.on(bounds_of(missions, batch.contact_rate.shape[:2]))
    values = [values_of(posterior, effect) for effect in effects]
    theta = theta_of(sites, memory_of(posterior))
    return with_effects(params, effects, values, theta, slots_of(missions, batch))


def with_effects(
    params: Params,
    effects: Sequence[Effect],
    values: Sequence[Mapping[str, np.ndarray]],
    theta: Theta,
    slots: Slots,
) -> Params:
    """Parameters of missions with effects, of which `values` are the variables, in the intercept.

    Params, values and theta are of draws, `slots` of every bound of the missions.
    """
    for effect, of_effect in zip(effects, values, strict=True):
        b = np.asarray(params.b)
        b = b if b.ndim == 4 else b[:, None, None, None]
        params = params._replace(b=b + drift_of(effect, of_effect, theta, slots))
    return params


def effects_of(posterior: xr.DataTree) -> tuple[Effect, ...]:
    """Effects in the model of a posterior, but those of places."""
    return effects_from_record(json.loads(posterior.attrs.get("model_record", "{}")))


def is_of_people(posterior: xr.DataTree) -> bool:
    """Whether a posterior is of `HumanTrust`."""
    return posterior.attrs.get("model") == "HumanTrust"


def memory_of(posterior: xr.DataTree) -> str:
    """Memory of the model of a posterior, see `PooledTrust`."""
    return posterior.attrs.get("memory", "level")


def values_of(posterior: xr.DataTree, effect: Effect) -> dict[str, np.ndarray]:
    """Variables of an effect by name, chains joined: leading axis (draw,)."""
    group = posterior[effect.noun].to_dataset()
    return {name: _joined(group[name], effect.variables[name]) for name in effect.variables}


def theta_of(sites: Mapping[str, np.ndarray], memory: str) -> Theta:
    """Hyperparameters and `rest` of draws by name, under the memory of `PooledTrust`.

    Without `rest` where memory is a matrix: no effect is of such a model.
    """
    return {**sites, "rest": rest_of(sites["beta0"], memory)} if "beta0" in sites else {**sites}


def slots_of(missions: Sequence[Mission], batch: MissionBatch) -> Slots:
    """All bounds of missions that effects other than of places are at."""
    return Slots.every(batch, len(missions), missions[0].features, None)


def _params(posterior: xr.DataTree) -> tuple[Params, dict[str, np.ndarray]]:
    """Parameters with no effects but those of places, and all draws by name."""
    sites = sites_of(posterior)
    params = params_from(sites, posterior.attrs)
    if "places" not in posterior.children:
        return params, sites
    maps = place_maps_of(posterior["places"].to_dataset(), sites)
    return params._replace(**maps), sites  # pyright: ignore
