"""The learner of a NumPyro function: its fits, and its draws for planning."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from trustbo.arrays import joined_draws
from trustbo.data import Mission
from trustbo.errors import TrustboError, require_kind
from trustbo.inference.ahead import with_effects, with_prior_effects_ahead
from trustbo.inference.density import at
from trustbo.inference.functions.checks import require_fittable, require_unpadded_results
from trustbo.inference.functions.data import data_of_bounds, observations_of
from trustbo.inference.functions.draws import (
    N_CHECKED,
    FunctionDrift,
    draws_of_drift,
    function_drift,
    no_weights,
)
from trustbo.inference.functions.function import BATCH, FunctionModel, in_batches, keys_of
from trustbo.inference.functions.missions import FunctionData
from trustbo.inference.functions.sampling import NUTS, SAMPLERS, require_gradient, sampled
from trustbo.inference.functions.sites import Site, safe
from trustbo.inference.functions.source import OF_PRIOR, OfFunction
from trustbo.inference.functions.target import targets_of
from trustbo.inference.latent import N_PRIOR, Source
from trustbo.inference.learns import Learner
from trustbo.inference.options import Options
from trustbo.inference.order import in_order_of
from trustbo.inference.posterior import effects_of, names_in
from trustbo.inference.stored import require_no_nan, require_variables
from trustbo.inference.tree import Fitted, coords_of, default_draws
from trustbo.models.draws import Draws, NextMission
from trustbo.models.observations import Observations
from trustbo.models.record import effects_to_record
from trustbo.stacking import require_same_robots
from trustbo.workspace import Workspace

_INVENTED = 4
"""Number of bounds of an invented mission, with which a function is checked before missions."""
_N_MEAN = 500
"""Number of prior draws that are averaged for the first plan."""
_UNBOUNDED = (
    "all rates are equal, and ContactRate has no n_ticks, so the density has no limit where the "
    "noises are 0: pass the input n_ticks to ContactRate(n_ticks=)"
)


class FunctionLearner(Learner):
    """Learner of a NumPyro function; variables of single missions are always drawn."""

    samplers = SAMPLERS

    def record(self) -> dict[str, Any]:
        """See `Learner.record`."""
        return self.model.record()

    def sampled(
        self, missions: Sequence[Mission], workspace: Workspace | None, options: Options
    ) -> Fitted:
        """See `Learner.sampled`; raises TrustboError if the function is no model of the data."""
        known = FunctionData(self.model, missions, workspace)
        model = self.model
        data = known.data
        if workspace is not None:
            _require_plannable(self.model, workspace)
        require_fittable(model, data, known.sites, [len(mission.bounds) for mission in missions])
        effects = known.density.columns.effects

        prior = known.run("prior", keys_of(N_PRIOR, options.seed + OF_PRIOR))
        targets = targets_of(model, data, known.sites, known if effects else None)
        draws = options.draws or default_draws(effects, options.sampler)
        drawn = sampled(targets, prior, draws, options)
        if drawn.complaints and not known.resolution and _all_equal(known.observations):
            drawn.complaints.append(_UNBOUNDED)

        # The groups `posterior` and `prior` include sites of `numpyro.deterministic`.
        computed = model.computed_sites(data)
        sites = {**known.sites, **computed}

        def variables(values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
            whole = {**values, **_computed(known, values, computed)}
            return {safe(n): known.without_padding(whole[n], site) for n, site in sites.items()}

        posterior = variables(drawn.values)
        shapes = {name: posterior[safe(name)].shape[1:] for name in sites}
        sizes = {name: len(of_axis) for name, of_axis in coords_of(missions).items()}
        dims = _dims_of(sites, shapes, sizes)
        labels = {
            own: _labels_of(dim, n, missions)
            for name, site in sites.items()
            for own, dim, n in zip(dims[safe(name)], site.dims, shapes[name], strict=True)
        }
        common = [name for name, site in known.sites.items() if site.mission_axis is None]
        return Fitted(
            variables={"posterior": posterior, **(drawn.effects or {})},
            prior=variables(prior),
            dims=dims,
            labels=labels,
            effects=effects,
            observations=known.observations,
            statistics=drawn.statistics,
            attrs={
                "model": model.name,
                "model_record": model.text,
                "effects": json.dumps(effects_to_record(effects)),
                "family": model.family,
                "resolution": known.resolution,
                **drawn.attrs,
            },
            notes={"posterior": {"common": json.dumps(common)}},
            by_position=True,
            complaints=drawn.complaints,
            source=lambda tree: OfFunction.stored(known, tree),
        )

    def require_poolable(self, earlier: Sequence[Mission], robots: Sequence[str]) -> None:
        """See `Learner.require_poolable`.

        A function identifies robots by position, and it would take the cells of another map for
        those of the workspace.
        """
        model = self.model
        require_same_robots(model.in_short(), earlier, robots)
        of_places = [name for name in ("cell", "bound") if name in model.inputs]
        if of_places and any(mission.map for mission in earlier):
            raise TrustboError(
                f"{model.in_short()} takes the input {of_places[0]!r}, which has no meaning for "
                "earlier missions on another map; leave them out, or give a function of awareness."
            )

    def source(
        self, posterior: xr.DataTree, missions: Sequence[Mission], *, contrasts: bool = True
    ) -> Source:
        """See `Learner.source`; there are no contrasts."""
        return OfFunction.stored(FunctionData(self.model, missions), posterior)

    def read(
        self, posterior: xr.DataTree, workspace: Workspace | None, next_mission: Sequence[bool]
    ) -> Sequence[Draws]:
        """See `Learner.read`.

        Raises TrustboError if the workspace has different robots or features, or the same in a
        different order.
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
        drift = function_drift(self.model, values, robots, features, shape)
        effects = effects_of(posterior)
        if not effects:
            return [draws_of_drift(drift, resolution)] * len(next_mission)

        theta = drift.theta()
        parameters = no_weights(theta, features)
        found = with_effects(posterior, effects, theta, parameters, workspace, next_mission)
        return [draws_of_drift(drift, resolution, one) for one in found]

    def of_prior(self, n_draws: int, seed: int, whole: Workspace) -> Draws:
        """See `Learner.of_prior`."""
        return draws_of_drift(_prior_drift(self.model, n_draws, seed, whole))

    def of_prior_ahead(self, n_draws: int, seed: int, whole: Workspace) -> NextMission:
        """See `Learner.of_prior_ahead`."""
        drift = _prior_drift(self.model, n_draws, seed, whole)
        effects = self.model.effects(drift.nothing())
        if not effects:
            draws = draws_of_drift(drift)
            return NextMission(draws, draws)

        theta = drift.theta()
        parameters = no_weights(theta, whole.features)
        found = with_prior_effects_ahead(whole, effects, theta, parameters, seed)
        expected, drawn = (draws_of_drift(drift, effects=one) for one in found)
        return NextMission(expected, drawn)

    def mean_of_prior(self, whole: Workspace) -> Draws:
        """See `Learner.mean_of_prior`."""
        return self.of_prior(_N_MEAN, 0, whole).mean()

    def require_plannable(self, workspace: Workspace, sampler: str | None) -> None:
        """See `Learner.require_plannable`.

        Before there are missions, the checks of `sampled` are run on an invented mission. For NUTS,
        the density must have a gradient.
        """
        model = self.model
        _require_plannable(model, workspace)
        awareness = workspace.awareness.values
        z = np.moveaxis(awareness, 0, -2)  # (move, row, col, robot, feature)
        known = np.argwhere(~np.isnan(z).any((-2, -1)))[:_INVENTED]
        data = data_of_bounds(z[tuple(known.T)], known, workspace.features, measured=True)
        if model.needs_observations:
            data["observations"] = observations_of(data)
        sites = model.sites(data)
        if sampler == NUTS and not model.effects(data):
            require_gradient(targets_of(model, data, sites)[0])
        if not model.needs_observations:  # its data are not padded
            require_unpadded_results(model, data, sites, [len(known)])


def _all_equal(observations: Observations) -> bool:
    """Return whether all measured rates are equal."""
    rates = observations.contact_rate[~np.isnan(observations.contact_rate)]
    return bool(np.ptp(rates) == 0.0)


def _prior_drift(
    model: FunctionModel, n_draws: int, seed: int, workspace: Workspace
) -> FunctionDrift:
    """Draw the variables of a function from the prior; return the drift without effects."""
    awareness = workspace.awareness.values
    n_robots, _, rows, cols, _ = awareness.shape
    features = tuple(workspace.features)
    data = _nothing(model, n_robots, features)
    sites = model.sites(data)

    drawn = in_batches(model.over_draws("prior", 1, data), keys_of(n_draws, seed))
    values = {name: drawn[name] for name, site in sites.items() if site.mission_axis is None}
    if not values:
        raise TrustboError(f"{model.in_short()} has no variable that is common to all missions.")
    return function_drift(model, values, workspace.team.names, features, (rows, cols))


def _require_plannable(model: FunctionModel, workspace: Workspace) -> None:
    """Raise TrustboError if a function cannot plan in a workspace."""
    drift = _prior_drift(model, N_CHECKED, 0, workspace)
    drift.require_plannable(workspace.awareness.values)


def _nothing(model: FunctionModel, n_robots: int, features: tuple[str, ...]) -> dict[str, Any]:
    """Return the inputs of a mission with one bound and no contact rates."""
    z = np.zeros((1, n_robots, len(features)))
    data = data_of_bounds(z, np.full((1, 3), -1), features)
    if model.needs_observations:
        data["observations"] = observations_of(data)
    return data


def _computed(
    known: FunctionData, values: Mapping[str, np.ndarray], sites: Mapping[str, Site]
) -> dict[str, np.ndarray]:
    """Compute the sites of `numpyro.deterministic` at values (draw, ...) of the variables."""
    if not sites:
        return {}

    n_draws = len(next(iter(values.values())))
    keys = keys_of(n_draws, 0)
    parts = []
    for begin in range(0, n_draws, BATCH):  # sites that are left out may be large
        some = slice(begin, begin + BATCH)
        found = known.run("deterministic", at(values, some), keys[some])
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
    taken = dict.fromkeys(("chain", "draw", "bound", *map(safe, sites)), -1)
    known = {**sizes, **taken}

    def label(name: str, dim: str, n: int) -> str:
        own = safe(dim)
        if known.get(own, n) != n:
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
    for name in sorted(dims, key=lambda name: -len(dims[name])):  # that of `tree.to_tree`
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
