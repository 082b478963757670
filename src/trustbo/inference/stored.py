"""Read parameters, effects, draws and missions that a posterior contains."""

import json
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import replace

import numpy as np
import xarray as xr

from trustbo.arrays import joined_draws
from trustbo.data import Mission
from trustbo.errors import TrustboError, require_kind
from trustbo.inference.class_target import ClassTarget
from trustbo.inference.density import JointDraws
from trustbo.inference.order import in_order_of
from trustbo.inference.posterior import model_of
from trustbo.inference.variables import draws_of
from trustbo.models.effects.effect import Effect
from trustbo.models.model import TrustModel
from trustbo.models.record import model_from_record
from trustbo.stacking import require_same_team


def parameters_of(
    posterior: xr.DataTree, model: TrustModel | None = None, group: str = "posterior"
) -> dict[str, np.ndarray]:
    """Return the parameter draws of a posterior by name, with chains joined in an axis (draw,).

    The group is `posterior` or `prior`. Variables that are not in the model, such as those added by
    a user, are left out.

    Raises:
        TrustboError: If the dims of a parameter differ from the model's, or if a draw is NaN, for
            example after masking with xarray.
    """
    if model is None:
        model = model_of(posterior)
    axes = model.dims | model.effect_dims
    draws = posterior[group].to_dataset()

    parameters = {}
    for name in map(str, draws):
        if name not in axes:
            continue

        array = draws[name]
        dims = ("chain", "draw", *axes[name])
        if set(array.dims) != set(dims):
            raise TrustboError(
                f"{name!r} of the posterior must have the dims {dims}; got {array.dims}. Give a "
                "posterior from trustbo.fit with all its dims."
            )
        parameters[name] = joined_draws(array, axes[name])

    require_no_nan(parameters)
    return parameters


def require_variables(needed: Iterable[str], found: Iterable[Hashable]) -> None:
    """Raise TrustboError if a variable of the model is not among those of the posterior."""
    names = [str(name) for name in found]
    missing = [name for name in needed if name not in names]
    if missing:
        raise TrustboError(
            f"the posterior has no variable {missing[0]!r}, only {', '.join(names)}. Give a "
            "posterior from trustbo.fit with unchanged names."
        )


def require_no_nan(draws: Mapping[str, np.ndarray]) -> None:
    """Raise TrustboError if a draw of a parameter is NaN."""
    for name, values in draws.items():
        bad = np.isnan(values.reshape(len(values), -1)).any(1).sum()
        if bad:
            raise TrustboError(
                f"{bad} of {len(values)} draws of {name!r} are NaN; drop these "
                "draws with posterior.isel(draw=...) instead of masking them."
            )


def values_of(posterior: xr.DataTree, effect: Effect) -> dict[str, np.ndarray]:
    """Return the variables of an effect by name, with chains joined in a leading axis (draw,)."""
    group = posterior[effect.group].to_dataset()
    axes = {name: axes or (...,) for name, axes in effect.variables.items() if name in group}
    return {name: joined_draws(group[name], of_name) for name, of_name in axes.items()}


def stored_draws(target: ClassTarget, posterior: xr.DataTree) -> JointDraws:
    """Return the draws of a posterior, with chains joined."""
    groups = {"posterior": parameters_of(posterior, target.model)}
    groups |= {effect.group: values_of(posterior, effect) for effect in target.model.effects}
    return draws_of(target, groups)


def read_posterior(
    posterior: xr.DataTree,
    missions: Iterable[Mission] | None = None,
    *,
    model: TrustModel | None = None,
) -> tuple[ClassTarget, JointDraws]:
    """Rebuild the `ClassTarget` and the draws of a DataTree, with chains joined.

    Args:
        posterior: DataTree from `fit`.
        missions: Fitted missions, with the features in the order of the posterior; needed if the
            posterior contains no data.
        model: Model of the posterior; needed if a prior has a class of the user's own.

    Raises:
        TrustboError: If the posterior contains no data and no missions are given, a custom model is
            not given, or a different model is given.
    """
    missions = require_same_team(missions_of(posterior) if missions is None else missions)
    features = missions[0].features
    posterior = in_order_of(posterior, missions[0].robots, features)

    if model is not None:
        require_kind("model", model, TrustModel, "give the model of the posterior")
        model = model.for_features(features)
    record = json.loads(posterior.attrs["model_record"])
    model = model_from_record(record, model).for_features(features)

    target = ClassTarget(model, model.observations(missions))
    return target, stored_draws(target, posterior)


def missions_of(posterior: xr.DataTree) -> list[Mission]:
    """Rebuild missions from the data of a posterior; raise TrustboError if there are no data."""
    if "constant_data" not in posterior.children:
        raise TrustboError(
            "this posterior contains only parameters; give the fitted missions with missions=. "
            "For result.posteriors[j], they are result.missions[: j + 1]."
        )

    data = posterior["constant_data"].to_dataset()
    data = data.assign(contact_rate=posterior["observed_data"].to_dataset()["contact_rate"])
    robots = [str(name) for name in data["robot"].values]
    features = [str(name) for name in data["feature"].values]

    missions = []
    for j in range(data.sizes["mission"]):
        one = data.isel(mission=j)
        was_made = one["row"].values >= 0
        if was_made.any():
            one = one.isel(bound=was_made)
            cells = zip(one["row"].values, one["col"].values, strict=True)
            path = [(int(one["start_row"]), int(one["start_col"])), *cells]
            post_sets = [str(name) for name in one["posts"].values] if "posts" in one else ()
        else:  # a mission without a map
            one = one.isel(bound=slice(int(one["n_bounds"])))
            path = None
            post_sets = ()

        mission = Mission.from_arrays(
            path,
            one["awareness"].values,
            one["contact_rate"].values,
            one["duration"].values,
            str(one["status"].values),
            n_ticks=one["n_ticks"].values,
            robots=robots,
            features=features,
            post_sets=post_sets,
        )
        if "map" in one:
            mission = replace(mission, map=str(one["map"].values))
        missions.append(mission)
    return missions
