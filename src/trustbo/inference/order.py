"""Put the axes of a posterior in the order of the fit or of given names.

xarray may change the order of axes and of their labels. All other modules read the arrays of a
posterior by position, after `as_fitted` or `in_order_of`.
"""

import json
from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from trustbo.arrays import in_order
from trustbo.data import Mission
from trustbo.errors import TrustboError, one_line
from trustbo.inference.functions.data import require_same_order
from trustbo.inference.place_maps import in_order_of_places
from trustbo.inference.posterior import effects_of, is_by_position, names_in, require_fitted
from trustbo.stacking import require_same_team

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
