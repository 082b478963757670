"""Maps of trust and cost over the whole workspace."""

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.special import expit

from trustbo.models.params import Params
from trustbo.planning.posterior import choose
from trustbo.planning.setting import Setting, draws_of
from trustbo.planning.trustmap import best_map, robot_maps


def trust_map(
    setting: Setting,
    params: Params | xr.DataTree,
    *,
    per_robot: bool = False,
    x0: ArrayLike | None = None,
    draws: np.ndarray | None = None,
) -> xr.DataArray:
    """Largest expected trust with which each cell can be reached.

    Over the paths to each cell with the fewest possible bounds, or, unless `max_bounds` is
    "shortest", up to two more without turning straight back: with the default `max_bounds`,
    the goal's value is the terminal trust of the `terminal` plan. Longer walks, which an int
    admits, are left out, for they loiter to gather trust.

    Args:
        setting: Where.
        params: Parameters of any model; of draws, or a posterior, every draw's map.
        per_robot: One map per robot instead of the team's.
        x0: Expected trust at the start, shape () or (robot,): between bounds, that of a
            `TrustFilter`; by default `params.x0_mean`.
        draws: Which draws of the posterior these are; by default 0, 1, 2, ...

    Returns:
        DataArray (row, col), or (robot, row, col), with a leading (draw,) for draws; NaN where
        no robot can go.

    Raises:
        ShapeError: Parameters of other robots or features.
    """
    params = draws_of(params)
    if per_robot:
        values = robot_maps(
            setting.course, setting.dynamics(params, x0, draws=draws, team="min").flat()
        )
    else:
        values = best_map(setting.course, setting.dynamics(params, x0, draws=draws).flat())
    like = setting.workspace.awareness.isel(feature=0, drop=True)
    like = like if per_robot else like.isel(robot=0, drop=True)
    like = like.expand_dims(draw=len(values)) if params.leading else like
    found = like.copy(data=values if params.leading else values[0])
    return found.rename("trust").assign_attrs(long_name="expected trust")


def cost_map(
    setting: Setting,
    params: Params | xr.DataTree,
    *,
    per_robot: bool = False,
    x0: ArrayLike | None = None,
) -> xr.DataArray:
    """The paper's cost f = 1 - sigma(trust) of reaching each cell; see `trust_map`."""
    trust = trust_map(setting, params, per_robot=per_robot, x0=x0)
    cost = trust.copy(data=1.0 - expit(trust.values)).rename("cost")
    return cost.assign_attrs(long_name="cost 1 - sigma(trust)")


def trust_summary(
    setting: Setting,
    posterior: Params | xr.DataTree,
    *,
    per_robot: bool = False,
    n_draws: int = 200,
    seed: int = 0,
) -> xr.Dataset:
    """Mean and sd over draws of the trust map, and the mean cost.

    Args:
        setting: Where.
        posterior: What `fit` returned, or draws with leading axis (draw,).
        per_robot: One map per robot instead of the team's.
        n_draws: How many draws, taken at random without replacement.
        seed: Same seed, same draws.

    Returns:
        Dataset of `mean`, `sd` and `cost`, dims (row, col) or (robot, row, col).
    """
    params, chosen = choose(draws_of(posterior), n_draws, seed)
    trust = trust_map(setting, params, per_robot=per_robot, draws=chosen)
    cost = 1.0 - trust.copy(data=expit(trust.values))
    names = {"mean": "mean expected trust", "sd": "sd of expected trust"}
    summary = xr.Dataset({"mean": trust.mean("draw"), "sd": trust.std("draw")})
    summary["cost"] = cost.mean("draw").assign_attrs(long_name="mean cost 1 - sigma(trust)")
    for name, text in names.items():
        summary[name].attrs["long_name"] = text
    return summary
