"""Parameters from the draws of a posterior."""

import json
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import xarray as xr

from trustbo.data import Mission, is_line_of_sight
from trustbo.inference.place_maps import place_maps_of
from trustbo.inference.posterior_tree import require_posterior
from trustbo.models.effects.robot import next_mission
from trustbo.models.params import Params, RobotParams, params_from
from trustbo.models.place import bounds_of
from trustbo.stacking import MissionBatch

_DAYS = 20261123  # seed of the next mission's effects: the same posterior has the same bands


def sites_of(posterior: xr.DataTree) -> dict[str, np.ndarray]:
    """All draws of a posterior by name, chains joined: leading axis (draw,)."""
    draws = posterior["posterior"].to_dataset()
    n = draws.sizes["chain"] * draws.sizes["draw"]
    # In one layout, whether just sampled or read from a file: sums over draws then round alike, and
    # a resumed campaign has the same bits.
    arrays = {
        str(name): array.transpose("chain", "draw", ...).values for name, array in draws.items()
    }
    return {name: np.ascontiguousarray(a).reshape(n, *a.shape[2:]) for name, a in arrays.items()}


def params_of(posterior: xr.DataTree, *, day: bool = False) -> Params:
    """All draws of a posterior as parameters, chains joined: leading axis (draw,).

    Args:
        posterior: DataTree from `fit`.
        day: Whether each draw has an effect of each robot drawn for the next mission, a bad day
            among them, for bands and predictions of rates; by default it has the expected one, for
            plans. Without effects of robots there is no difference.

    Returns:
        `TrustParams`, `RobotParams`, `CoupledParams` or `DriftParams`, according to the model. With
        effects of robots, `RobotParams` of the next mission: weights of line of sight have the
        effect of each robot, in which the last bad day is gone and what stays fades.

    Raises:
        TrustboError: No posterior of `fit`; or one with the drift of a `DriftTrust` that this
            process has not made.
    """
    params, sites = _params(require_posterior("params_of", posterior))
    if "robots" not in posterior.children:
        return params
    d, sd = next_mission(_robot_effect(posterior), sites, rho_of(posterior))
    if day:
        d = d + sd[:, None] * np.random.default_rng(_DAYS).standard_normal(d.shape)
    robots = (len(d), d.shape[1])
    fields = {
        name: np.broadcast_to(sites[name][:, None], robots)
        for name in ("beta0", "b", "delta_w", "delta_v")
    }
    beta = np.repeat(sites["beta"][:, None], robots[1], axis=1)
    slope = (1.0 - fields["beta0"]) * d
    sight = _sight(posterior["posterior"].to_dataset()["feature"].values)
    if sight:
        beta[:, :, sight] += slope[..., None] / len(sight)
    else:
        fields["b"] = fields["b"] + slope
    x0 = {name: getattr(params, name) for name in ("x0_mean", "x0_sd")}
    return RobotParams(beta=beta, **fields, **x0, **params.places)


def params_of_missions(
    posterior: xr.DataTree, missions: Sequence[Mission], batch: MissionBatch
) -> Params:
    """All draws as parameters of the missions that the posterior was fitted to.

    Effects of their places, and of robots in them, are in the intercepts.
    """
    params, _ = _params(posterior)
    params = params.flat()
    if params.places:
        params = params.on(bounds_of(missions, batch.contact_rate.shape[:2]))
    if "robots" not in posterior.children:
        return params
    return with_robots(params, _robot_effect(posterior), missions, batch)


def with_robots(
    params: Params, effect: np.ndarray, missions: Sequence[Mission], batch: MissionBatch
) -> Params:
    """Parameters of missions with effects d (draw, mission, robot) in their intercepts."""
    sight = _sight(missions[0].features)
    z = batch.awareness[..., sight].mean(3) if sight else np.ones(batch.contact_rate.shape)
    d = np.zeros((len(effect), len(z), 1, z.shape[2]))
    d[:, : effect.shape[1], 0] = effect
    b = np.asarray(params.b)
    b = b if b.ndim == 4 else b[:, None, None, None]
    rest = 1.0 - np.asarray(params.beta0)[:, None, None, None]  # pyright: ignore
    return params._replace(b=b + rest * d * z)


def rho_of(posterior: xr.DataTree) -> float:
    """Correlation of what stays of a robot between missions, see `RobotEffect`."""
    record = json.loads(posterior.attrs["model_record"])
    return float(record["effects"][0]["rho"])


def _params(posterior: xr.DataTree) -> tuple[Params, dict[str, np.ndarray]]:
    """Parameters without the effects of robots, and all draws by name."""
    sites = sites_of(posterior)
    params = params_from(sites, posterior.attrs)
    if "places" not in posterior.children:
        return params, sites
    maps = place_maps_of(posterior["places"].to_dataset(), sites)
    return params._replace(**maps), sites  # pyright: ignore


def _robot_effect(posterior: xr.DataTree) -> np.ndarray:
    """Effects d (draw, mission, robot), chains joined."""
    effect = posterior["robots"].to_dataset()["robot_effect"]
    values = effect.transpose("chain", "draw", "mission", "robot").values
    return values.reshape(-1, *values.shape[2:])


def _sight(features: Iterable[Any]) -> list[int]:
    return [m for m, name in enumerate(features) if is_line_of_sight(str(name))]
