"""Parameters of the next mission, with the effects of robots and places in it."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from trustbo.data import sight_columns
from trustbo.errors import TrustboError, require_kind
from trustbo.inference.order import in_order_of
from trustbo.inference.place_maps import place_group, place_maps_of, robots_in_bounds_of
from trustbo.inference.posterior import is_of_people, model_of, names_in
from trustbo.inference.stored import parameters_of, require_variables, values_of
from trustbo.models.draws import COUPLED_DIMS, ROBOT_DIMS
from trustbo.models.effects.effect import Effect, Theta
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.params import TrustParams, assemble_params
from trustbo.models.visited import visited
from trustbo.workspace import Workspace

_NEXT_MISSION_SEED = 20261123
"""Seed of the next mission's robot effects, so that bands are reproducible."""


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
    require_variables(COUPLED_DIMS if "B0" in parameters else ROBOT_DIMS, parameters)

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
