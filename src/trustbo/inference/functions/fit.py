"""Fit a model that is a NumPyro function, and complete its posterior."""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from trustbo.data import Mission
from trustbo.display import slow_bar
from trustbo.errors import TrustboError, require_kind
from trustbo.inference.draws import (
    effects_of,
    in_order_of,
    joined_draws,
    names_in,
    require_no_nan,
    require_variables,
    values_of,
    with_effects,
    with_prior_effects_ahead,
)
from trustbo.inference.functions.checks import require_fittable, require_unpadded_results
from trustbo.inference.functions.data import (
    RATES,
    Data,
    arrays_of,
    data_of,
    data_of_bounds,
    observations_of,
)
from trustbo.inference.functions.draws import (
    N_CHECKED,
    FunctionDrift,
    draws_of_drift,
    function_drift,
    no_weights,
)
from trustbo.inference.functions.effects import AddedEffects
from trustbo.inference.functions.function import EFFECTS, Found, FunctionModel
from trustbo.inference.functions.nuts import require_gradient
from trustbo.inference.functions.sampling import NUTS, Drawn, keys_of, sampled, targets_of
from trustbo.inference.functions.sites import Site, safe
from trustbo.inference.latent import Latent
from trustbo.inference.place_maps import place_group
from trustbo.inference.tree import N_PRIOR, add_groups, default_draws, kept_draws, to_datatree
from trustbo.models.backend import library_attrs
from trustbo.models.draws import Draws
from trustbo.models.families import FAMILIES
from trustbo.models.observations import Observations
from trustbo.models.record import effects_to_record
from trustbo.stacking import require_same_robots
from trustbo.statespace import kalman
from trustbo.statespace.form import Inputs, StateSpace
from trustbo.streams import stream
from trustbo.workspace import Workspace

_INVENTED = 4
"""Number of bounds of an invented mission, with which a function is checked before missions."""
_OF_PRIOR = 2
"""Offset of the seed of the draws in the groups `prior` and `prior_predictive`."""
_UNBOUNDED = (
    "all rates are equal, and ContactRate has no n_ticks, so the density has no limit where the "
    "noises are 0: pass the input n_ticks to ContactRate(n_ticks=)"
)
_SIZE = 200
"""Number of draws for which latent trust is drawn at once."""


def fit_function(
    missions: Sequence[Mission],
    model: FunctionModel,
    workspace: Workspace | None,
    sampler: str,
    draws: int | None,
    chains: int,
    warmup: int | None,
    seed: int,
    progress: bool,
    check: bool,
    start: xr.DataTree | None,
) -> tuple[xr.DataTree, list[str]]:
    """Fit a function to missions; for the arguments, see `trustbo.fit`.

    Returns:
        The posterior of the parameters, and a list of failed checks.

    Raises:
        TrustboError: If the function cannot be a model of these missions.
    """
    observations = Observations.from_missions(missions)
    data = _data_for(model, missions, observations)
    sites = model.sites(data)
    if workspace is not None:
        require_plannable(model, workspace)
    require_fittable(model, data, sites, [len(mission.bounds) for mission in missions])
    resolution = model.resolution(data)
    of_counts = resolution > 0.0
    effects = _effects_in(model, data, observations, missions, workspace, of_counts=of_counts)
    if effects is not None:
        _require_integrable(model, sampler)
    if draws is None:
        draws = default_draws(effects.effects if effects else (), sampler)

    prior = model.over_draws("prior", 1, data)(keys_of(N_PRIOR, seed + _OF_PRIOR))
    drawn = sampled(
        targets_of(model, data, sites, effects),
        prior,
        start,
        sampler,
        chains=chains,
        draws=draws,
        warmup=warmup,
        seed=seed,
        progress=progress,
        check=check,
    )

    if drawn.complaints and not resolution and _all_equal(observations):
        drawn.complaints.append(_UNBOUNDED)
    tree = _tree(model, drawn, prior, sites, missions, data, effects, seed)
    tree.attrs |= {
        "model": model.name,
        "model_record": model.text,
        "effects": json.dumps(effects_to_record(effects.effects if effects else ())),
        "family": model.family,
        "n_robots": observations.n_robots,
        "n_missions": len(missions),
        "resolution": resolution,
        "robots": list(missions[0].robots),
        "features": list(missions[0].features),
        "seed": seed,
        **drawn.attrs,
        **library_attrs(drawn.attrs["sampler"]),
    }
    return tree, drawn.complaints


def _require_integrable(model: FunctionModel, sampler: str) -> None:
    """Raise TrustboError if a sampler does not integrate the effects of a function out."""
    if sampler == NUTS:
        raise TrustboError(
            f"{model.in_short()} has effects, which only importance sampling integrates out; use "
            'sampler="auto".'
        )


def _effects_in(
    model: FunctionModel,
    data: Data,
    observations: Observations,
    missions: Sequence[Mission],
    workspace: Workspace | None = None,
    *,
    of_counts: bool = False,
) -> AddedEffects | None:
    """Return the effects of a function in missions, or None if it has none; see `AddedEffects`."""
    effects = model.effects(data)
    if not effects:
        return None
    return AddedEffects(effects, observations, missions, workspace, of_counts=of_counts)


def _all_equal(observations: Observations) -> bool:
    """Return whether all measured rates are equal."""
    rates = observations.contact_rate[~np.isnan(observations.contact_rate)]
    return bool(np.ptp(rates) == 0.0)


def with_latent_of_function(
    posterior: xr.DataTree,
    missions: Sequence[Mission],
    model: FunctionModel,
    *,
    progress: bool = True,
) -> xr.DataTree:
    """Add latent trust, log-likelihoods and predictions to a posterior of a function."""
    observations = Observations.from_missions(missions)
    data = _data_for(model, missions, observations)
    sites = model.sites(data)
    effects = _effects_in(model, data, observations, missions)
    sizes = posterior["posterior"].sizes
    n_draws = sizes["chain"] * sizes["draw"]
    n_missions = len(missions)
    seed = posterior.attrs["seed"]

    _, some = kept_draws(posterior)
    rng = stream(seed, "latent of a function")

    shape = observations.contact_rate.shape
    mean = np.zeros(shape)
    square = np.zeros(shape)
    log_likelihood = np.empty((n_draws, n_missions))
    log_prior: dict[str, list[np.ndarray]] = {}
    of_counts = True
    trust = np.empty((len(some), *shape))
    predicted = np.empty((len(some), *shape))
    with slow_bar("latent trust", " draws", progress, total=n_draws) as bar:
        for where, found in _evaluated(model, posterior, data, effects, np.arange(n_draws)):
            of_counts = bool(found.of_counts.all())
            log_likelihood[where] = found.log_likelihood[:, :n_missions]
            for name, of_site in found.log_prior.items():
                own = _without_padding(of_site[None], sites[name], n_missions)[0]
                log_prior.setdefault(safe(name), []).append(own.reshape(len(own), -1).sum(1))

            space, inputs = _form_of(found, n_missions, shape[1])
            x = _drawn_trust(space, inputs, observations, rng)
            rates = _replicated(space, inputs, observations, rng)
            mean += x.sum(0) / n_draws
            square += (x**2).sum(0) / n_draws

            begin = where[0]
            first, last = np.searchsorted(some, (begin, begin + len(x)))
            trust[first:last] = x[some[first:last] - begin]
            predicted[first:last] = rates[some[first:last] - begin]
            bar.update(len(found.log_likelihood))

    sd = np.sqrt(np.maximum(square - mean**2, 0.0))
    latent = Latent(trust, mean, sd, log_likelihood, predicted)
    replicated = _prior_predictive(model, data, observations, effects, seed)
    if "prior" in posterior.children:  # some of its draws may have been selected
        replicated = replicated[posterior["prior"].to_dataset()["draw"].values]
    densities = {name: np.concatenate(parts) for name, parts in log_prior.items()}
    of_counts = of_counts and _all_counted(observations)
    return add_groups(posterior, missions, latent, replicated, densities, of_counts=of_counts)


def log_likelihood_of_function(
    posterior: xr.DataTree, missions: Sequence[Mission], model: FunctionModel
) -> tuple[np.ndarray, bool]:
    """Compute the log-likelihood (draw, mission) of missions at all draws of a posterior.

    The posterior may have been fitted to other rates of the same missions.

    Returns:
        The log-likelihoods, and whether they are of tick counts.
    """
    observations = Observations.from_missions(missions)
    data = _data_for(model, missions, observations)
    sizes = posterior["posterior"].sizes
    n_draws = sizes["chain"] * sizes["draw"]

    effects = _effects_in(model, data, observations, missions)
    of_counts = True
    log_likelihood = np.empty((n_draws, len(missions)))
    for where, found in _evaluated(model, posterior, data, effects, np.arange(n_draws)):
        of_counts = bool(found.of_counts.all())
        log_likelihood[where] = found.log_likelihood[:, : len(missions)]
    return log_likelihood, of_counts and _all_counted(observations)


def forms_of_function(
    posterior: xr.DataTree, missions: Sequence[Mission], model: FunctionModel, some: np.ndarray
) -> Iterator[tuple[StateSpace, Inputs, bool]]:
    """Run a function with some draws of its posterior, given by index.

    Yields:
        For each chunk of draws, the form (draw, group, member), the inputs (draw, mission, bound,
        group, member), and whether the log-likelihoods of these missions are of tick counts.
    """
    observations = Observations.from_missions(missions)
    data = _data_for(model, missions, observations)
    effects = _effects_in(model, data, observations, missions)
    n_missions, n_bounds = observations.contact_rate.shape[:2]
    for _, found in _evaluated(model, posterior, data, effects, some):
        space, inputs = _form_of(found, n_missions, n_bounds)
        yield space, inputs, bool(found.of_counts.all()) and _all_counted(observations)


def _evaluated(
    model: FunctionModel,
    posterior: xr.DataTree,
    data: Data,
    effects: AddedEffects | None,
    some: np.ndarray,
) -> Iterator[tuple[np.ndarray, Found]]:
    """Run a function with some draws of its posterior; yield chunks of indices with their results.

    The random key of a draw does not depend on which other draws are chosen. The results include
    the effects.
    """
    values = _padded_values(posterior, model.sites(data))
    keys = keys_of(len(next(iter(values.values()))), posterior.attrs["seed"])
    if effects is not None:
        theta = model.over_draws("theta", 2, data)(values, keys)
        of_effects = {effect.group: values_of(posterior, effect) for effect in effects.effects}
        values[EFFECTS] = _padded(effects.sum_of(of_effects, theta), data)
    evaluate = model.over_draws("evaluate", 2, data)
    for begin in range(0, len(some), _SIZE):
        where = some[begin : begin + _SIZE]
        yield where, evaluate({name: v[where] for name, v in values.items()}, keys[where])


def _padded(values: np.ndarray, data: Data) -> np.ndarray:
    """Pad values (draw, mission, bound, robot) with zeros to the missions and bounds of data."""
    shape = data[RATES].shape
    missing = [(0, n - own) for n, own in zip(shape, values.shape[1:], strict=True)]
    return np.pad(values, [(0, 0), *missing])


def _all_counted(observations: Observations) -> bool:
    """Return whether every measured rate has a number of ticks."""
    is_measured = ~np.isnan(observations.contact_rate)
    is_counted = observations.n_ticks > 0.0
    return bool((is_counted | ~is_measured).all())


def draws_of_function(
    model: FunctionModel,
    posterior: xr.DataTree,
    workspace: Workspace | None,
    next_mission: Sequence[bool],
) -> list[Draws]:
    """Return the draws of a posterior of a function, for the bounds of a workspace.

    Args:
        model: The function.
        posterior: Its posterior.
        workspace: The workspace, or None.
        next_mission: For each result, whether the effects of the next mission are drawn at random;
            see `params_of`.

    Raises:
        TrustboError: If the workspace has different robots or features, or the same in a different
            order.
    """
    robots = names_in(posterior, "robot")
    features = names_in(posterior, "feature")
    shape: Any = None
    if workspace is not None:
        require_kind("workspace", workspace, Workspace, "give a trustbo.Workspace")
        robots = workspace.team.names
        features = workspace.features
        shape = workspace.passable.shape
    posterior = in_order_of(posterior, robots, features)

    draws = posterior["posterior"].to_dataset()
    names = json.loads(draws.attrs["common"])
    require_variables(map(safe, names), draws)
    values = {name: joined_draws(draws[safe(name)]) for name in names}
    require_no_nan(values)
    resolution = float(posterior.attrs["resolution"])
    drift = function_drift(model, values, robots, features, shape)
    effects = effects_of(posterior)
    if not effects:
        return [draws_of_drift(drift, resolution)] * len(next_mission)

    theta = drift.theta()
    found = with_effects(
        posterior, effects, theta, no_weights(theta, features), robots, next_mission
    )
    return [draws_of_drift(drift, resolution, one) for one in found]


def prior_draws_of_function(
    model: FunctionModel, n_draws: int, seed: int, workspace: Workspace
) -> Draws:
    """Draw the variables of a function from the prior, without effects, for a workspace."""
    return draws_of_drift(_prior_drift(model, n_draws, seed, workspace))


def prior_draws_of_function_ahead(
    model: FunctionModel, n_draws: int, seed: int, workspace: Workspace
) -> Draws:
    """Draw the variables of a function from the prior, with the effects of the first mission."""
    drift = _prior_drift(model, n_draws, seed, workspace)
    effects = model.effects(drift.nothing())
    if not effects:
        return draws_of_drift(drift)

    theta = drift.theta()
    parameters = no_weights(theta, workspace.features)
    ahead = with_prior_effects_ahead(workspace, effects, theta, parameters, seed)
    return draws_of_drift(drift, effects=ahead)


def _prior_drift(
    model: FunctionModel, n_draws: int, seed: int, workspace: Workspace
) -> FunctionDrift:
    """Draw the variables of a function from the prior; return the drift without effects."""
    awareness = workspace.awareness.values
    n_robots, _, rows, cols, _ = awareness.shape
    features = tuple(workspace.features)
    data = _nothing(model, n_robots, features)
    sites = model.sites(data)

    drawn = model.over_draws("prior", 1, data)(keys_of(n_draws, seed))
    values = {name: drawn[name] for name, site in sites.items() if site.mission_axis is None}
    if not values:
        raise TrustboError(f"{model.in_short()} has no variable that is common to all missions.")
    return function_drift(model, values, workspace.team.names, features, (rows, cols))


def require_plannable(model: FunctionModel, workspace: Workspace) -> None:
    """Raise TrustboError if a function cannot plan in a workspace."""
    drift = _prior_drift(model, N_CHECKED, 0, workspace)
    drift.require_plannable(workspace.awareness.values)


def require_learnable(model: FunctionModel, workspace: Workspace, *, by_gradient: bool) -> None:
    """Raise TrustboError if a function cannot be fitted to any mission of a workspace.

    Before there are missions, the checks of `fit_function` are run on an invented mission. With
    `by_gradient`, the density must have a gradient.
    """
    awareness = workspace.awareness.values
    z = np.moveaxis(awareness, 0, -2)  # (move, row, col, robot, feature)
    known = np.argwhere(~np.isnan(z).any((-2, -1)))[:_INVENTED]
    data = data_of_bounds(z[tuple(known.T)], known, workspace.features, measured=True)
    if model.needs_observations:
        data["observations"] = observations_of(data)
    sites = model.sites(data)
    if by_gradient:
        if model.effects(data):
            _require_integrable(model, NUTS)
        require_gradient(model, targets_of(model, data, sites)[0].coordinates, data)
    if not model.needs_observations:  # its data are not padded
        require_unpadded_results(model, data, sites, [len(known)])


def require_poolable_with_function(
    model: FunctionModel, earlier: Sequence[Mission], robots: Sequence[str]
) -> None:
    """Raise TrustboError if a function cannot be fitted to missions of earlier campaigns.

    A function identifies robots by position, and it would take the cells of another map for those
    of the workspace.
    """
    require_same_robots(model.in_short(), earlier, robots)
    of_places = [name for name in ("cell", "bound") if name in model.inputs]
    if of_places and any(mission.map for mission in earlier):
        raise TrustboError(
            f"{model.in_short()} takes the input {of_places[0]!r}, which has no meaning for "
            "earlier missions on another map; leave them out, or give a function of awareness."
        )


def _data_for(
    model: FunctionModel, missions: Sequence[Mission], observations: Observations
) -> dict[str, Any]:
    """Return the inputs of a function; data that it takes as a single object are not padded."""
    data = data_of(missions, observations, moves="bound" in model.inputs)
    if model.needs_observations:
        n_missions, n_bounds = observations.contact_rate.shape[:2]
        data |= {name: v[:n_missions, :n_bounds] for name, v in arrays_of(data).items()}
        data["observations"] = observations
    return data


def _nothing(model: FunctionModel, n_robots: int, features: tuple[str, ...]) -> dict[str, Any]:
    """Return the inputs of a mission with one bound and no contact rates."""
    z = np.zeros((1, n_robots, len(features)))
    data = data_of_bounds(z, np.full((1, 3), -1), features)
    if model.needs_observations:
        data["observations"] = observations_of(data)
    return data


def _without_padding(values: np.ndarray, site: Site, n_missions: int) -> np.ndarray:
    """Drop the missions of the padding from values (chain, draw, ...)."""
    if site.mission_axis is None:
        return values
    return values.take(range(n_missions), axis=2 + site.mission_axis)


def _padded_values(posterior: xr.DataTree, sites: Mapping[str, Site]) -> dict[str, np.ndarray]:
    """Return draws (draw, ...) of the variables; values are arbitrary for padded missions."""
    draws = posterior["posterior"].to_dataset()
    values = {}
    for name, site in sites.items():
        array = joined_draws(draws[safe(name)])
        if site.mission_axis is not None:
            axis = 1 + site.mission_axis
            n_missing = site.shape[site.mission_axis] - array.shape[axis]
            last = array.take([-1] * n_missing, axis=axis)
            array = np.concatenate([array, last], axis=axis)
        values[name] = array
    return values


def _form_of(found: Found, n_missions: int, n_bounds: int) -> tuple[StateSpace, Inputs]:
    """Return the form (draw, group, member) and the inputs without padding."""
    fields = [None if value is None else value[:, 0] for value in found.space]
    inputs = [value[:, :n_missions, :n_bounds] for value in found.inputs]
    return StateSpace(*fields), Inputs(*inputs)


def _by_mission(inputs: Inputs) -> Iterator[list[Inputs]]:
    """Yield the inputs (draw, group, member) of each bound, for each mission."""
    drift = inputs.drift
    offset = np.broadcast_to(inputs.offset, drift.shape)
    for j in range(drift.shape[1]):
        yield [Inputs(drift[:, j, k], offset[:, j, k]) for k in range(drift.shape[2])]


def _drawn_trust(
    space: StateSpace, inputs: Inputs, observations: Observations, rng: np.random.Generator
) -> np.ndarray:
    """Draw trust (draw, mission, bound, robot) given the rates of all missions."""
    n_draws, _, n_bounds, n_groups, n = inputs.drift.shape
    trust = np.empty((n_draws, *observations.contact_rate.shape))
    for j, of_bounds in enumerate(_by_mission(inputs)):
        rates = observations.contact_rate[j].reshape(n_bounds, n_groups, n)
        drawn = kalman.draw_trust(space, of_bounds, rates, n_groups, rng)
        trust[:, j] = drawn.reshape(n_draws, n_bounds, -1)
    return trust


def _replicated(
    space: StateSpace, inputs: Inputs, observations: Observations, rng: np.random.Generator
) -> np.ndarray:
    """Draw replicated rates (draw, mission, bound, robot)."""
    n_draws, _, n_bounds, n_groups, n = inputs.drift.shape
    family = FAMILIES["gaussian"]
    rates = np.empty((n_draws, *observations.contact_rate.shape))
    for j, of_bounds in enumerate(_by_mission(inputs)):
        ticks = observations.n_ticks[j].reshape(n_bounds, n_groups, n)
        begin = kalman.initial(space, n_groups)
        drawn = kalman.forecast(space, begin, of_bounds, ticks, family, rng)
        rates[:, j] = np.stack([of_robots for _, of_robots in drawn], axis=1)
    return rates


def _prior_predictive(
    model: FunctionModel,
    data: Data,
    observations: Observations,
    effects: AddedEffects | None,
    seed: int,
) -> np.ndarray:
    """Draw rates (draw, mission, bound, robot) of the missions from the prior."""
    keys = keys_of(N_PRIOR, seed + _OF_PRIOR)
    values = dict(model.over_draws("prior", 1, data)(keys))
    if effects is not None:
        theta = model.over_draws("theta", 2, data)(values, keys)
        drawn = effects.sum_of_prior(theta, stream(seed, "prior effects"))
        values[EFFECTS] = _padded(drawn, data)
    found: Found = model.over_draws("evaluate", 2, data)(values, keys)
    n_missions, n_bounds = observations.contact_rate.shape[:2]
    space, inputs = _form_of(found, n_missions, n_bounds)
    rng = stream(seed, "prior predictive")
    return _replicated(space, inputs, observations, rng)


def _tree(
    model: FunctionModel,
    drawn: Drawn,
    prior: Mapping[str, np.ndarray],
    sites: Mapping[str, Site],
    missions: Sequence[Mission],
    data: Data,
    effects: AddedEffects | None,
    seed: int,
) -> xr.DataTree:
    """Build a DataTree from draws of the posterior, draws (draw, ...) of the prior, and data.

    The groups `posterior` and `prior` include sites of `numpyro.deterministic`.
    """
    computed = model.computed_sites(data)
    stored = {**sites, **computed}

    def by_chain(values: Mapping[str, np.ndarray], shape: tuple[int, ...]) -> dict[str, Any]:
        whole = {**values, **_computed(model, values, computed, data)}
        arrays = {name: whole[name].reshape(*shape, *whole[name].shape[1:]) for name in stored}
        return {
            safe(name): _without_padding(array, stored[name], len(missions))
            for name, array in arrays.items()
        }

    groups = {
        "posterior": by_chain(drawn.values, drawn.statistics["lp"].shape),
        "sample_stats": drawn.statistics,
        "prior": by_chain(prior, (1, N_PRIOR)),
    }
    shapes = {name: groups["posterior"][safe(name)].shape[2:] for name in stored}
    dims = _dims_of(stored, shapes, _sizes_of_axes(missions))
    labels = {
        own: _labels_of(dim, n, missions)
        for name, site in stored.items()
        for own, dim, n in zip(dims[safe(name)], site.dims, shapes[name], strict=True)
    }
    of_effects = {
        group: {
            name: v.reshape(*drawn.statistics["lp"].shape, *v.shape[1:]) for name, v in own.items()
        }
        for group, own in (drawn.effects or {}).items()
    }
    places = of_effects.pop("places", None)  # has its own axes
    added = effects.effects if effects else ()
    tree = to_datatree(groups | of_effects, missions, dims, added, labels=labels)
    if places is not None and effects is not None:
        at: Any = effects.observations.visited
        tree["places"] = xr.DataTree(place_group(places, at, missions[0].robots, seed))
    common = [name for name, site in sites.items() if site.mission_axis is None]
    tree["posterior"].attrs["common"] = json.dumps(common)
    tree["posterior"].attrs["dims"] = json.dumps(dims)
    return tree


def _computed(
    model: FunctionModel, values: Mapping[str, np.ndarray], sites: Mapping[str, Site], data: Data
) -> dict[str, np.ndarray]:
    """Compute the sites of `numpyro.deterministic` at values (draw, ...) of the variables."""
    if not sites:
        return {}

    n_draws = len(next(iter(values.values())))
    keys = keys_of(n_draws, 0)
    compute = model.over_draws("deterministic", 2, data)
    parts = []
    for begin in range(0, n_draws, _SIZE):  # sites that are left out may be large
        some = slice(begin, begin + _SIZE)
        found = compute({name: v[some] for name, v in values.items()}, keys[some])
        parts.append({name: found[name] for name in sites})
    return {name: np.concatenate([part[name] for part in parts]) for name in sites}


def _dims_of(
    sites: Mapping[str, Site], shapes: Mapping[str, tuple[int, ...]], sizes: Mapping[str, int]
) -> dict[str, tuple[str, ...]]:
    """Return the names of the axes of variables, by name.

    The suffix `_plate` is added to the name of an axis if it is the name of a variable, or that of
    an axis of posteriors with a different size. The second axis of a variable with the same name
    has the suffix `_`, as in model classes.
    """
    taken = {"chain", "draw", "bound", *map(safe, sites)}
    known: dict[str, int] = {}

    def label(name: str, dim: str, n: int) -> str:
        own = safe(dim)
        if own in taken or sizes.get(own, n) != n:
            own = f"{own}_plate"
        if known.setdefault(own, n) != n:  # two plates with one name
            own = f"{safe(name)}_{own}"
        return own

    named: dict[str, tuple[str, ...]] = {}
    for name, site in sites.items():
        own: list[str] = []
        for dim, n in zip(site.dims, shapes[name], strict=True):
            one = label(name, dim, n)
            while one in own:
                one += "_"
            own.append(one)
        named[safe(name)] = tuple(own)
    return _in_one_order(named)


def _in_one_order(dims: Mapping[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
    """Return axes with the name of the variable added if their order differs between variables.

    `az.summary` would label the values of such a variable incorrectly; see `tree`.
    """
    order: list[str] = []
    renamed = dict(dims)
    for name in sorted(dims, key=lambda name: -len(dims[name])):  # that of `to_datatree`
        seen = [dim for dim in order if dim in dims[name]]
        n_seen = len(seen)
        if dims[name][:n_seen] != tuple(seen):
            renamed[name] = tuple(f"{name}_{dim}" for dim in dims[name])
        order += [dim for dim in renamed[name] if dim not in order]
    return renamed


def _labels_of(dim: str, n: int, missions: Sequence[Mission]) -> Any:
    """Return the labels of an axis: names of robots or features, if it has their name and size."""
    kind = dim.rsplit("/")[-1]  # without the prefixes of `numpyro.handlers.scope`
    names = {"robot": missions[0].robots, "feature": missions[0].features}
    for one, of_axis in names.items():
        if kind in (one, f"{one}s") and n == len(of_axis):
            return list(of_axis)
    return np.arange(n)


def _sizes_of_axes(missions: Sequence[Mission]) -> dict[str, int]:
    """Return the lengths of the axes that posteriors of all models have."""
    n_robots = len(missions[0].robots)
    return {
        "mission": len(missions),
        "bound": max(len(mission.bounds) for mission in missions),
        "robot": n_robots,
        "robot_": n_robots,
        "feature": len(missions[0].features),
        "feature_": len(missions[0].features),
    }
