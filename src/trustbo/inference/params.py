"""Read parameters, missions and models from a posterior."""

import json
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.arrays import in_order, joined_draws
from trustbo.data import Mission, sight_columns
from trustbo.errors import TrustboError, one_line, require_count, require_kind, require_whole
from trustbo.inference.density import Density, JointDraws
from trustbo.inference.functions.data import require_same_order
from trustbo.inference.functions.known import is_of_function
from trustbo.inference.place_maps import (
    in_order_of_places,
    place_group,
    place_maps_of,
    robots_in_bounds_of,
)
from trustbo.inference.variables import draws_of, prior_parameters
from trustbo.models.draws import NextMission
from trustbo.models.effects.effect import Effect, Theta
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.model import TrustModel
from trustbo.models.observations import Observations
from trustbo.models.params import TrustParams, assemble_params
from trustbo.models.record import effects_from_record, model_from_record, with_default_priors
from trustbo.models.visited import visited
from trustbo.stacking import require_same_team
from trustbo.workspace import Workspace

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Quantiles of predictions."""
_NEXT_MISSION_SEED = 20261123
"""Seed of the next mission's robot effects, so that bands are reproducible."""
_N_MEAN = 4096
"""Number of draws averaged to compute a prior mean."""
_ATTRIBUTES = ("family", "model_record", "robots", "features")
"""Attributes that a posterior must have."""
_NUMBERED = ("chain", "draw", "mission", "bound")
"""Axes of all posteriors whose labels are numbers."""
_AXES = (*_NUMBERED, "robot", "robot_", "feature", "feature_")
"""Order of the axes of arrays; other axes follow."""
_OF_VARIABLES = ("posterior", "prior")
"""Groups that contain the variables of a function."""


def as_fitted(who: str, value: object) -> xr.DataTree:
    """Return a posterior from `fit` in the order of the fit, which xarray may have changed.

    Robots and features are put in order by name, and chains, draws, missions, bounds and places by
    number, so that all that follows may read arrays by position.

    Raises:
        TrustboError: If the value is not a posterior from `fit`, it has no draws, or a robot or
            feature has another name than in the fit. The message names `who`.
    """
    posterior = require_fitted(who, value)
    return _in_order(posterior, names_in(posterior, "robot"), names_in(posterior, "feature"))


def require_fitted(who: str, value: object) -> xr.DataTree:
    """Return a posterior from `fit` as it is, for callers that read only its attributes.

    Raises TrustboError if the value is not a posterior from `fit`, or if it has no draws.
    """
    if not isinstance(value, xr.DataTree):
        remedy = " Give the attribute .posterior." if hasattr(value, "posterior") else ""
        raise TrustboError(f"{who} needs a posterior from fit; got {type(value).__name__}.{remedy}")

    missing = [name for name in _ATTRIBUTES if name not in value.attrs]
    if "posterior" not in value.children:
        missing.insert(0, "posterior")
    if missing:
        raise TrustboError(
            f"{who} needs a posterior from fit, but this DataTree has no {missing[0]!r}. Give the "
            "complete result of trustbo.fit, of this version."
        )

    sizes = value["posterior"].sizes
    lacks = [dim for dim in ("chain", "draw") if not sizes.get(dim)]
    if lacks:
        raise TrustboError(
            f"{who} needs the draws of a posterior, with the dims chain and draw, but there is no "
            f"{lacks[0]}. Keep all draws, or select with a list, such as posterior.isel(chain=[0])."
        )
    return value


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


def require_no_nan(draws: Mapping[str, np.ndarray]) -> None:
    """Raise TrustboError if a draw of a parameter is NaN."""
    for name, values in draws.items():
        bad = np.isnan(values.reshape(len(values), -1)).any(1).sum()
        if bad:
            raise TrustboError(
                f"{bad} of {len(values)} draws of {name!r} are NaN; drop these "
                "draws with posterior.isel(draw=...) instead of masking them."
            )


def require_variables(needed: Iterable[str], found: Iterable[Hashable]) -> None:
    """Raise TrustboError if a variable of the model is not among those of the posterior."""
    names = [str(name) for name in found]
    missing = [name for name in needed if name not in names]
    if missing:
        raise TrustboError(
            f"the posterior has no variable {missing[0]!r}, only {', '.join(names)}. Give a "
            "posterior from trustbo.fit with unchanged names."
        )


def read_params(
    posterior: xr.DataTree, workspace: Workspace | None, next_mission: Sequence[bool]
) -> list[TrustParams]:
    """Return the parameters for each value of `next_mission`; see `params_of`."""
    if is_of_people(posterior):
        raise TrustboError(
            "a posterior of HumanTrust cannot be used for planning; to predict reports, use "
            "trustbo.inference.predict_reports."
        )
    names = names_in(posterior, "robot"), names_in(posterior, "feature")
    if workspace is not None:
        require_kind("workspace", workspace, Workspace, "give a trustbo.Workspace")
        names = workspace.team.names, workspace.features
    posterior = in_order_of(posterior, *names)

    model = model_of(posterior)
    parameters = parameters_of(posterior, model)
    needed = ("B0", "B") if "B0" in parameters else ("beta0", "beta", "b", "delta_w", "delta_v")
    require_variables(needed, parameters)

    others = {name: posterior.attrs[name] for name in ("x0_mean", "x0_sd")}
    others["memory"] = posterior.attrs.get("memory", "level")
    others["family"] = posterior.attrs["family"]
    theta = model.derived(parameters)
    return [
        assemble_params(values, **others, **places).in_order(*names)
        for values, places in with_effects(
            posterior, model.effects, theta, parameters, workspace, next_mission
        )
    ]


def with_effects(
    posterior: xr.DataTree,
    effects: Sequence[Effect],
    theta: Theta,
    parameters: Mapping[str, np.ndarray],
    workspace: Workspace | None,
    next_mission: Sequence[bool],
) -> list[tuple[dict[str, np.ndarray], dict[str, Any]]]:
    """Return parameters with the effects of robots in the next mission, and those of places.

    Args:
        posterior: DataTree from `fit`, in the order of its robots and features.
        effects: Effects of its model.
        theta: Hyperparameters (draw, ...) of the effects by name.
        parameters: Parameters (draw, ...) by name, which include the hyperparameters.
        workspace: Workspace, whose robots are those of the result; None for those of the posterior.
        next_mission: For each result, whether the effects of the next mission are drawn at random,
            and effects of robots in bounds are included. Otherwise, expected effects are used.

    Returns:
        Pairs of the parameters, and of the arguments of `TrustParams` with the effects of places.
    """
    places = posterior["places"].to_dataset() if "places" in posterior.children else None
    values = {effect: values_of(posterior, effect) for effect in _effects_of_robots(effects)}
    robots = names_in(posterior, "robot") if workspace is None else workspace.team.names
    ahead = _Ahead(theta, parameters, robots, names_in(posterior, "feature"), workspace)
    return ahead.with_effects(places, values, posterior.attrs["n_missions"], next_mission)


def _effects_of_robots(effects: Sequence[Effect]) -> list[Effect]:
    """Return the effects that act on robots, not on places."""
    return [effect for effect in effects if not isinstance(effect, PlaceEffect)]


class _Ahead(NamedTuple):
    """Parameters (draw, ...) of the next mission by name, before its effects are added."""

    theta: Theta
    parameters: Mapping[str, np.ndarray]
    robots: Sequence[str]
    features: Sequence[str]
    workspace: Workspace | None

    def with_effects(
        self,
        places: xr.Dataset | None,
        values: Mapping[Effect, Mapping[str, np.ndarray]],
        n_missions: int,
        next_mission: Sequence[bool],
    ) -> list[tuple[dict[str, np.ndarray], dict[str, Any]]]:
        """Add the effects of places and robots; see the function `with_effects`.

        `values` contains the variables of each effect of robots in the `n_missions` missions so
        far.
        """
        maps: dict[str, Any] = {}
        of_robots: dict[str, Any] = {}
        if places is not None:
            maps |= place_maps_of(places, self.parameters, self.workspace)
            if any(next_mission):
                of_robots["place_robot"] = robots_in_bounds_of(
                    places, self.parameters, self.robots, self.workspace
                )

        found = []
        for is_drawn in next_mission:
            changed = self._of_robots(values, n_missions, is_drawn)
            found.append(({**self.parameters, **changed}, maps | of_robots if is_drawn else maps))
        return found

    def _of_robots(
        self,
        values: Mapping[Effect, Mapping[str, np.ndarray]],
        n_missions: int,
        is_drawn: bool,
    ) -> dict[str, np.ndarray]:
        """Return the parameters (draw, robot, ...) that the robot effects change.

        If `is_drawn`, the effects are drawn at random; otherwise, their expected values are used.
        """
        if not values:
            return {}

        rng = np.random.default_rng(_NEXT_MISSION_SEED) if is_drawn else None
        shape = len(self.theta["inverse_gain"]), len(self.robots)
        slopes = [
            effect.predict_next(v, self.theta, n_missions, rng) for effect, v in values.items()
        ]
        slope = np.broadcast_to(sum(slopes), shape)

        # Robot effects act on line of sight, or on the intercept if it is not among the features.
        sight = sight_columns(self.features)
        weights = np.zeros((*shape, len(self.features)))
        if sight:
            weights[:, :, sight] = slope[..., None] / len(sight)
            slope = np.zeros(shape)

        b = self.parameters["b"].reshape(shape[0], -1) + slope
        if "B0" in self.parameters:
            B = self.parameters["B"].copy()
            robot = np.arange(shape[1])
            B[:, :, robot, robot] += np.swapaxes(weights, 1, 2)
            return {"b": b, "B": B}
        beta = self.parameters["beta"]
        return {"b": b, "beta": (beta if beta.ndim == 3 else beta[:, None]) + weights}


def names_in(posterior: xr.DataTree, axis: str) -> tuple[str, ...]:
    """Return the names of the robots or features of a posterior, in the order of the fit."""
    return tuple(np.atleast_1d(posterior.attrs[f"{axis}s"]).tolist())  # a file has one as a text


def in_order_of(
    posterior: xr.DataTree, robots: Sequence[str], features: Sequence[str]
) -> xr.DataTree:
    """Return a posterior with its robots and features in the order of these names.

    All other labelled axes are put in order as by `as_fitted`. Parameters that all robots share
    apply to robots with any names. Robots that occur only in missions of earlier campaigns
    (attribute `other_robots`) are left out, unless they are in `robots`. Raises TrustboError if
    names differ or, for a posterior of a function, are in another order.
    """
    if is_by_position(posterior):
        require_same_order(
            posterior.attrs["model"],
            {axis: names_in(posterior, axis) for axis in ("robot", "feature")},
            {"robot": robots, "feature": features},
        )
    else:
        known = names_in(posterior, "robot")  # without those that were left out before
        others = np.atleast_1d(posterior.attrs.get("other_robots", [])).tolist()
        left_out = [name for name in others if name in known and name not in robots]
        if left_out:
            posterior = _without_robots(posterior, left_out)
        if "robot" not in posterior["posterior"].dims and "robots" not in posterior.children:
            robots = names_in(posterior, "robot")  # shared by all robots

    for axis, names in {"robot": robots, "feature": features}.items():
        _require_names(posterior, axis, names)
    return _in_order(posterior, robots, features)


def _require_names(posterior: xr.DataTree, axis: str, names: Sequence[str]) -> None:
    """Raise TrustboError if the robots or features of a posterior are not those of `names`."""
    found = [names_in(posterior, axis)]
    for group in posterior.children.values():
        if axis in group.indexes:
            found.append(tuple(str(name) for name in group.indexes[axis]))

    for have in found:
        if have and sorted(have) != sorted(names):
            raise TrustboError(
                f"the posterior has the {axis}s {', '.join(have)}, not {', '.join(names)}; fit "
                "missions with these names."
            )


def _in_order(
    posterior: xr.DataTree, robots: Sequence[str], features: Sequence[str]
) -> xr.DataTree:
    """Return a posterior with its robots and features in this order, and other axes by number."""
    names: dict[str, Sequence[Any] | None] = dict.fromkeys(_NUMBERED)
    dims: dict[str, list[str]] = {}
    if is_by_position(posterior):
        dims = json.loads(posterior["posterior"].attrs["dims"])
        for dim in {dim for of_variable in dims.values() for dim in of_variable}:
            names |= _names_along(posterior, dim, robots, features)
    for effect in effects_of(posterior):
        names |= effect.coords

    for axis, of_axis in {"robot": robots, "feature": features}.items():
        if of_axis:
            names[axis] = of_axis
            names[f"{axis}_"] = of_axis  # second axis of a matrix, or of means over robots

    given = {name: group.to_dataset() for name, group in posterior.children.items()}
    joined = ["posterior", *(effect.group for effect in effects_of(posterior))]
    matched = given | _of_common_draws({name: given[name] for name in joined if name in given})
    groups = {}
    for name, group in matched.items():
        ordered = in_order("the posterior", group, names)
        if name == "places":
            ordered = in_order_of_places(ordered)
        groups[name] = transposed(ordered, dims if name in _OF_VARIABLES else {})

    # Building a tree takes longer than all checks, and posteriors are usually in order.
    same_names = [tuple(robots), tuple(features)] == [
        names_in(posterior, "robot"),
        names_in(posterior, "feature"),
    ]
    if same_names and all(groups[name] is group for name, group in given.items()):
        return posterior

    whole = xr.DataTree.from_dict(groups)
    whole.attrs = posterior.attrs | {"robots": list(robots), "features": list(features)}
    return whole


def _of_common_draws(groups: dict[str, xr.Dataset]) -> dict[str, xr.Dataset]:
    """Return groups with the draws that all of them have, by the labels of chains and draws.

    Users drop the first draws of a chain, or keep every second one, in one group only.
    """
    for axis in ("chain", "draw"):
        found = {name: group[axis].values for name, group in groups.items() if axis in group.dims}
        first = found.get("posterior", np.empty(0))
        if all(np.array_equal(labels, first) for labels in found.values()):
            continue

        common = set(first.tolist()).intersection(*(set(one.tolist()) for one in found.values()))
        if not common or any(len(set(one.tolist())) < len(one) for one in found.values()):
            raise TrustboError(
                f"the groups {', '.join(found)} of the posterior have other labels of {axis}s, "
                f"{one_line([one.tolist() for one in found.values()])}; select the same draws in "
                "all groups, as with posterior.isel(draw=slice(500, None))."
            )
        kept = sorted(common)
        groups = {
            name: group.sel({axis: kept}) if name in found else group
            for name, group in groups.items()
        }
    return groups


def _names_along(
    posterior: xr.DataTree, axis: str, robots: Sequence[str], features: Sequence[str]
) -> dict[str, Sequence[Any] | None]:
    """Return the order of an axis of a function for `in_order`; empty if it has no known order.

    Axes of robots and features may have other names, such as that of the plate "robots".
    """
    index = posterior["posterior"].to_dataset().indexes.get(axis)
    if index is None:
        return {}
    if pd.api.types.is_numeric_dtype(index):
        return {axis: None}

    labels = {str(label) for label in index}
    for of_axis in (robots, features):
        if labels == set(of_axis):
            return {axis: of_axis}
    return {}


def transposed(group: xr.Dataset, dims: Mapping[str, Sequence[str]]) -> xr.Dataset:
    """Return a group with the axes of each variable in order.

    `dims` has the axes of the variables of a function, after (chain, draw), which may be in any
    order. The axes of all other variables have the order `_AXES`.
    """
    turned = {}
    for name, array in group.data_vars.items():
        axes = tuple(sorted(array.dims, key=_position))
        if name in dims:
            axes = ("chain", "draw", *dims[str(name)])
        if axes != array.dims and set(axes) == set(array.dims):
            turned[name] = array.transpose(*axes)
    return group.assign(turned) if turned else group


def _position(axis: Hashable) -> int:
    """Return the position of an axis in the order of the axes of posteriors."""
    return _AXES.index(axis) if axis in _AXES else len(_AXES)


def _without_robots(posterior: xr.DataTree, others: Sequence[str]) -> xr.DataTree:
    """Return a posterior without some robots."""

    def drop(group: xr.Dataset) -> xr.Dataset:
        axes = [axis for axis in ("robot", "robot_") if axis in group.indexes]
        return group.drop_sel({axis: list(others) for axis in axes})

    kept = posterior.map_over_datasets(drop)
    kept.attrs |= {
        "n_robots": posterior.attrs["n_robots"] - len(others),
        "robots": [name for name in names_in(posterior, "robot") if name not in others],
    }
    return kept


def is_by_position(posterior: xr.DataTree) -> bool:
    """Return whether a posterior is of a function, which identifies robots by their position."""
    return is_of_function(json.loads(posterior.attrs["model_record"]))


def effects_of(posterior: xr.DataTree) -> tuple[Effect, ...]:
    """Return the effects in the model of a posterior."""
    if is_by_position(posterior):
        return effects_from_record({"effects": json.loads(posterior.attrs["effects"])})
    return effects_from_record(json.loads(posterior.attrs["model_record"]))


def is_of_people(posterior: xr.DataTree) -> bool:
    """Return whether the model of a posterior is `HumanTrust`."""
    return posterior.attrs.get("model") == "HumanTrust"


def values_of(posterior: xr.DataTree, effect: Effect) -> dict[str, np.ndarray]:
    """Return the variables of an effect by name, with chains joined in a leading axis (draw,)."""
    group = posterior[effect.group].to_dataset()
    axes = {name: axes or (...,) for name, axes in effect.variables.items() if name in group}
    return {name: joined_draws(group[name], of_name) for name, of_name in axes.items()}


def theta_of(posterior: xr.DataTree, parameters: Mapping[str, np.ndarray]) -> Theta:
    """Return the hyperparameters of draws by name, including `inverse_gain`; see `Theta`."""
    return model_of(posterior).derived(parameters)


def model_of(posterior: xr.DataTree) -> TrustModel:
    """Return the model of a posterior with default priors, on which draws do not depend."""
    return with_default_priors(json.loads(posterior.attrs["model_record"]))


def read_posterior(
    posterior: xr.DataTree,
    missions: Iterable[Mission] | None = None,
    *,
    model: TrustModel | None = None,
) -> tuple[Density, JointDraws]:
    """Rebuild the `Density` and the draws of a DataTree, with chains joined.

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

    density = Density(model, model.observations(missions))
    return density, stored_draws(density, posterior)


def stored_draws(density: Density, posterior: xr.DataTree) -> JointDraws:
    """Return the draws of a posterior, with chains joined."""
    groups = {"posterior": parameters_of(posterior, density.model)}
    groups |= {effect.group: values_of(posterior, effect) for effect in density.model.effects}
    return draws_of(density, groups)


def in_order_of_features(missions: Iterable[Mission], posterior: xr.DataTree) -> list[Mission]:
    """Return missions with their features in the order of a posterior.

    The order of the robots changes only for a posterior of a function. Raises TrustboError if the
    missions disagree or their names differ from those of the posterior.
    """
    missions = require_same_team(missions)
    features = names_in(posterior, "feature") or missions[0].features
    robots = missions[0].robots
    if is_by_position(posterior):
        robots = names_in(posterior, "robot")
    return [mission.in_order(robots, features, ()) for mission in missions]


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


def with_prior_effects_ahead(
    workspace: Workspace,
    effects: Sequence[Effect],
    theta: Theta,
    parameters: Mapping[str, np.ndarray],
    seed: int,
) -> list[tuple[dict[str, np.ndarray], dict[str, Any]]]:
    """Return parameters with the effects of the first mission from the prior; see `with_effects`.

    The effects of robots are first those expected, then drawn at random. `theta` and `parameters`
    contain draws (draw, ...) from the prior by name.
    """
    robots = workspace.team.names
    n_draws = len(theta["inverse_gain"])
    group = None
    for effect in (e for e in effects if isinstance(e, PlaceEffect)):
        nowhere = {
            "place": np.zeros((1, n_draws, 0)),
            "place_bound": np.zeros((1, n_draws, 0)),
            "place_robot": np.zeros((1, n_draws, 0, len(robots))),
        }
        nothing = np.full((1, 1, 3), -1)
        places = visited(nothing, workspace.grid.shape, n_posts=workspace.n_posts)
        group = place_group(nowhere, places, robots, f_e=effect.f_e, seed=seed)

    sizes = {"mission": 0, "robot": len(robots)}
    values = {}
    for effect in _effects_of_robots(effects):
        lengths = sizes | {axis: len(labels) for axis, labels in effect.coords.items()}
        values[effect] = {
            name: np.zeros((n_draws, *(lengths[axis] for axis in axes)))
            for name, axes in effect.variables.items()
        }
    ahead = _Ahead(theta, parameters, robots, workspace.features, workspace)
    return ahead.with_effects(group, values, 0, [False, True])


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


def _prior(model: TrustModel, n_features: int, n_robots: int) -> Density:
    """Make a `Density` without data or effects."""
    n_features = require_count("n_features", n_features)
    n_robots = require_count("n_robots", n_robots)

    unmeasured = np.full((1, 1, n_robots), np.nan)
    z = np.zeros((1, 1, n_robots, n_features))
    observations = Observations(unmeasured, z, unmeasured, ("",) * n_features)
    return Density(replace(model, effects=()), observations)


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
