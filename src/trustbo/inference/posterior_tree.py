"""Layout of a posterior for ArviZ: named axes, no padding, the data included."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import xarray as xr

from trustbo.data import NOWHERE, Mission
from trustbo.errors import TrustboError
from trustbo.models.effects.effect import Effect
from trustbo.stacking import MissionBatch, stack_missions

_DIMS = {
    "trust": ("mission", "bound", "robot"),
    "trust_mean": ("mission", "bound", "robot"),
    "trust_sd": ("mission", "bound", "robot"),
    "contact_rate": ("mission", "bound", "robot"),
}
_ATTRIBUTES = "observation", "x0_mean", "x0_sd"


def require_posterior(who: str, value: object) -> xr.DataTree:
    """Return `value` if it is a posterior from `fit`, else raise TrustboError for `who`."""
    if not isinstance(value, xr.DataTree):
        remedy = " Give its .posterior." if hasattr(value, "posterior") else ""
        raise TrustboError(
            f"{who} takes a posterior from fit; got a {type(value).__name__}.{remedy}"
        )
    missing = [] if "posterior" in value.children else ["posterior"]
    missing += [name for name in _ATTRIBUTES if name not in value.attrs]
    if missing:
        raise TrustboError(
            f"{who} takes a posterior from fit; this DataTree has no {missing[0]!r}. Give one of "
            "trustbo.fit, whole."
        )
    return value


def to_datatree(
    groups: dict[str, dict[str, Any]],
    missions: Sequence[Mission],
    site_dims: dict[str, tuple[str, ...]],
    effects: Sequence[Effect] = (),
) -> xr.DataTree:
    """Name the axes, remove the padding, and set values after a mission's end to NaN.

    Args:
        groups: Arrays by group and name, with leading axes (chain, draw) except moments.
        missions: Missions of the posterior.
        site_dims: Axes of the model's parameters.
        effects: Effects of the model, whose variables are in some groups.
    """
    observed = stack_missions(missions, pad=False)
    n_missions, n_bounds = observed.contact_rate.shape[:2]
    lengths = np.array([len(m.bounds) for m in missions])
    ended = (np.arange(1, n_bounds + 1) > lengths[:, None])[..., None]  # (mission, bound, robot)
    coords = {
        "mission": np.arange(n_missions),
        "bound": np.arange(1, n_bounds + 1),
        "robot": list(missions[0].robots),
        "robot_": list(missions[0].robots),
        "feature": list(missions[0].features),
    }
    dims_of = _DIMS | site_dims
    for effect in effects:
        dims_of |= effect.variables
        coords |= effect.coords
    tree = {}
    for group, arrays in groups.items():
        draw = arrays.pop("draw", None)
        variables, used, shape = {}, set(), (0, 0)
        for name, array in arrays.items():
            dims = ("mission",) if group.endswith("log_likelihood") else dims_of.get(name, ())
            kept = array[(..., *(slice(len(coords[d])) for d in dims))]
            if "bound" in dims:
                kept = np.where(ended, np.nan, kept)
            if len(dims) < array.ndim:
                dims, shape = ("chain", "draw", *dims), array.shape[:2]
            variables[name] = (dims, kept)
            used |= set(dims)
        index = {"chain": np.arange(shape[0]), "draw": np.arange(shape[1])}
        index = index if draw is None else index | {"draw": draw}
        labelled = {name: labels for name, labels in (coords | index).items() if name in used}
        tree[group] = xr.Dataset(variables, labelled)
    tree["observed_data"], tree["constant_data"] = _data_groups(observed, missions, coords)
    return xr.DataTree.from_dict(tree)


def _data_groups(
    observed: MissionBatch, missions: Sequence[Mission], coords: dict[str, object]
) -> tuple[xr.Dataset, xr.Dataset]:
    shape = observed.contact_rate.shape
    duration, cell = np.full(shape, np.nan), np.full((*shape[:2], 2), -1)
    for j, mission in enumerate(missions):
        duration[j, : len(mission.bounds)] = mission.duration
        cell[j, : len(mission.bounds)] = [bound.cell for bound in mission.bounds]
    starts = [mission.path[0] if mission.has_map else NOWHERE for mission in missions]
    # Cells tell how many bounds a mission has, but where there are none.
    n_bounds = [len(mission.bounds) for mission in missions]
    counted = {} if all(m.has_map for m in missions) else {"n_bounds": (("mission",), n_bounds)}
    dims = ("mission", "bound", "robot")
    labelled = {name: coords[name] for name in dims}
    rates = xr.Dataset({"contact_rate": (dims, observed.contact_rate)}, labelled)
    constant = xr.Dataset(
        {
            "awareness": ((*dims, "feature"), observed.awareness),
            "duration": (dims, duration, {"units": "s"}),
            "n_ticks": (dims, observed.n_ticks, {"units": "1"}),
            "row": (("mission", "bound"), cell[..., 0]),
            "col": (("mission", "bound"), cell[..., 1]),
            "status": (("mission",), [mission.status for mission in missions]),
            "start_row": (("mission",), [row for row, _ in starts]),
            "start_col": (("mission",), [col for _, col in starts]),
            **counted,
        },
        labelled | {"feature": coords["feature"]},
    )
    return rates, constant


def of_no_map(posterior: xr.DataTree) -> bool:
    """Whether the posterior's missions, all that it holds, are of logs without a map."""
    if "constant_data" not in posterior.children:
        return False
    return bool((posterior["constant_data"].to_dataset()["row"].values < 0).all())


def missions_of(posterior: xr.DataTree) -> list[Mission]:
    """Missions rebuilt from the data in a posterior; TrustboError: it holds parameters alone."""
    if "constant_data" not in posterior.children:
        raise TrustboError(
            "this posterior holds parameters alone: give the missions it was fitted to, of "
            "result.posteriors[j] those of result.missions[: j + 1]."
        )
    data = posterior["constant_data"].to_dataset()
    data = data.assign(contact_rate=posterior["observed_data"].to_dataset()["contact_rate"])
    robots, features = ([str(n) for n in data[dim].values] for dim in ("robot", "feature"))
    missions = []
    for j in range(data.sizes["mission"]):
        one = data.isel(mission=j)
        made = one["row"].values >= 0
        has_map = bool(made.any())
        one = one.isel(bound=made if has_map else slice(int(one["n_bounds"])))
        cells = list(zip(one["row"].values, one["col"].values, strict=True))
        start = (int(one["start_row"]), int(one["start_col"]))
        z, y, seconds = (one[name].values for name in ("awareness", "contact_rate", "duration"))
        missions.append(
            Mission.from_arrays(
                [start, *cells] if has_map else None,
                z,
                y,
                seconds,
                str(one["status"].values),
                n_ticks=one["n_ticks"].values,
                robots=robots,
                features=features,
            )
        )
    return missions


def labelled_draws(sites: xr.Dataset) -> Iterator[tuple[str, str, tuple[int, ...], np.ndarray]]:
    """Label such as "beta[visibility]", name, index and draws (draw,) of every parameter."""
    for name, array in sites.data_vars.items():
        draws = array.transpose("chain", "draw", ...)
        dims, values = draws.dims[2:], draws.values.reshape(-1, *draws.shape[2:])
        for where in np.ndindex(*draws.shape[2:]):
            places = [str(draws[d].values[i]) for d, i in zip(dims, where, strict=True)]
            label = f"{name}[{', '.join(places)}]" if places else str(name)
            yield label, str(name), where, values[:, *where]
