"""Sites of a NumPyro function, with their axes (some run over missions) and sizes."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from trustbo.errors import TrustboError
from trustbo.inference.functions.data import RATES, Data, arrays_of, observations_of

_FROM_REPARAM = ("_decentered", "_base")
"""Suffixes of the latent variables to which NumPyro's reparametrisations move the plates."""
_N_AXES = {"awareness": 4, RATES: 3, "n_ticks": 3, "duration": 3, "cell": 2, "bound": 2}
"""Number of the axes (mission, bound, robot, feature) that an input has, by name."""
_MODULE = "$params"
"""Suffix of the site with the initial weights of a neural network in `numpyro.contrib.module`."""


class Site(NamedTuple):
    """Latent variable of a function, or a site of `numpyro.deterministic`."""

    dims: tuple[str, ...]
    """Names of its axes: those of its plates, and `name_dim_0` and so on for others."""
    mission_axis: int | None
    """Axis that runs over missions; None if the variable is common to all missions."""
    shape: tuple[int, ...]
    n_free: int
    """Number of its coordinates in unconstrained space; 0 if it is not a latent variable."""


def safe(name: str) -> str:
    """Return the name of a variable in a DataTree, in which "/" separates groups."""
    return name.replace("/", ".")


def latent_in(trace: Mapping[str, Any]) -> list[str]:
    """Return the names of the latent variables in a trace."""
    return [
        name for name, site in trace.items() if site["type"] == "sample" and not site["is_observed"]
    ]


def has_prior(name: str, trace: Mapping[str, Any]) -> bool:
    """Return whether a parameter holds the initial weights of a network whose weights are sampled.

    Such parameters come from `numpyro.contrib.module.random_flax_module` and similar functions.
    """
    network = name.removesuffix(_MODULE)
    return network != name and any(one.startswith(f"{network}/") for one in latent_in(trace))


def site_of(site: Mapping[str, Any], free: Any, plates: set[str]) -> Site:
    """Describe a latent variable; `plates` are those of the contact rates.

    Raises TrustboError if `infer={"event_dims": ...}` has more names than the site has axes.
    """
    shape = np.shape(site["value"])
    n_event = len(site["fn"].event_shape)
    axes = _axes_of_plates(shape, len(shape) - n_event, site["cond_indep_stack"])
    dims, mission_axis = _dims(site["name"], shape, axes, plates)

    others = [axis for axis in range(len(shape)) if axis not in axes]
    names = list(site["infer"].get("event_dims") or [])
    if len(names) > len(others):
        raise TrustboError(
            f"event_dims of the site {site['name']!r} has {len(names)} names, {names}, but the "
            f"site has {len(others)} axes without a plate; give one name for each axis."
        )
    n_first = max(n_event, len(names))  # without plates, axes of the batch may be named, too
    for axis, name in zip(others[len(others) - n_first :], names, strict=False):
        dims[axis] = str(name)
    return Site(tuple(dims), mission_axis, shape, int(np.prod(np.shape(free))))


def computed_site(
    traces: Sequence[Mapping[str, Any]], name: str, plates: set[str], mission_axis: int | None
) -> Site:
    """Describe a site of `numpyro.deterministic`; `mission_axis` is that of all missions, if known.

    NumPyro does not know how many axes of such a site belong to an event. The smallest number for
    which the plates have the right sizes in all traces is assumed.

    Args:
        traces: Traces of the function for the data, and for more missions, robots and features.
        name: Name of the site.
        plates: Plates of the contact rates.
        mission_axis: Axis of missions, also outside of plates; None if there is none.
    """
    found = [trace[name] for trace in traces]
    shapes = [np.shape(site["value"]) for site in found]
    stacks = [_stack_of(trace, name) for trace in traces]
    n_axes = len(shapes[0])

    axes: dict[int, str] = {}
    for n_event in range(n_axes):
        placed = [
            _axes_of_plates(shape, n_axes - n_event, stack)
            for shape, stack in zip(shapes, stacks, strict=True)
        ]
        axes = placed[0]
        if all(len(one) == len(stacks[0]) for one in placed):
            break

    dims, _ = _dims(name, shapes[0], axes, plates)
    _, _, more_robots, more_features = found
    for more, dim in ((more_robots, "robot"), (more_features, "feature")):
        for axis in axes_that_differ(found[0], more):
            if axis not in axes:
                dims[axis] = dim
    if mission_axis is not None:
        dims[mission_axis] = "mission"
    return Site(tuple(dims), mission_axis, shapes[0], 0)


def _stack_of(trace: Mapping[str, Any], name: str) -> Sequence[Any]:
    """Return the plates of a site, which a reparametrisation may have moved to another site."""
    stacks = [trace.get(f"{name}{suffix}", {}) for suffix in ("", *_FROM_REPARAM)]
    return next((s["cond_indep_stack"] for s in stacks if s.get("cond_indep_stack")), [])


def _axes_of_plates(shape: tuple[int, ...], n_batch: int, stack: Sequence[Any]) -> dict[int, str]:
    """Return the names of plates by the axis of an array that has the size of the plate."""
    axes = {n_batch + frame.dim: frame for frame in stack}  # `dim` counts from the last axis
    return {
        axis: frame.name
        for axis, frame in axes.items()
        if 0 <= axis < n_batch and shape[axis] == frame.size
    }


def _dims(
    name: str, shape: tuple[int, ...], axes: Mapping[int, str], plates: set[str]
) -> tuple[list[str], int | None]:
    """Return the names of the axes of a variable, and the axis that runs over missions."""
    dims = [axes.get(axis, f"{name}_dim_{axis}") for axis in range(len(shape))]
    mission_axis = None
    for axis, plate in axes.items():
        if plate in plates:
            dims[axis] = "mission"
            mission_axis = axis
    return dims, mission_axis


def plates_of_rates(trace: Mapping[str, Any]) -> set[str]:
    """Return the names of the plates of the contact rates, which are plates of missions."""
    return {frame.name for frame in trace[RATES]["cond_indep_stack"]}


def doubled(data: Data, axis: int) -> dict[str, Any]:
    """Return inputs with twice as many missions, bounds, robots or features (axes 0 to 3)."""
    arrays = {
        name: np.concatenate([values, values], axis)
        for name, values in arrays_of(data).items()
        if axis < _N_AXES[name]
    }
    more = {**data, **arrays}
    if axis == 3:
        more["features"] = (*data["features"], *(f"{name} 2" for name in data["features"]))
    if "observations" in data:
        more["observations"] = observations_of(more)
    return more


def axes_that_differ(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[int]:
    """Return the axes in which the values of two sites differ in length."""
    shapes = zip(np.shape(one["value"]), np.shape(other["value"]), strict=True)
    return [axis for axis, (n, m) in enumerate(shapes) if n != m]
